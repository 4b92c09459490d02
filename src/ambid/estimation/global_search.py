"""Global search by SciPy's differential evolution (Storn and Price 1997; best1bin, dithered mutation, Sobol start)
between bounds, scaled to 0 .. 1, and the rescue of fits whose ordinary starts fail. Equal seeds give equal results.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TypeVar

import numpy as np

from ambid.arrays import Array
from ambid.estimation.progress import Tick, silent
from ambid.estimation.search import PhysicalFit

STAGE = "global search"
_MUTATION = (0.5, 1.0)  # factor of the difference vectors, drawn anew for each generation
_RECOMBINATION = 0.9  # numbers of a physical model hang together: most of them change at once
_MEMBERS = 8  # of the population, for each number
_TOLERANCE = 1e-3  # spread of the costs, relative to their mean, at which a search has ended
_FEWEST = 16

F = TypeVar("F", bound=PhysicalFit)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GlobalFound:
    """Where a global search ended."""

    vector: Array  # (n,), with the least cost that was seen
    cost: float  # infinite where no vector has a finite one
    evaluations: int
    seconds: float
    # (n,), members of the last generation, best first: where refinement may begin, as several may lie in different
    # minima
    best: tuple[Array, ...]


def global_search(
    cost: Callable[[Array], float],
    low: Array,
    high: Array,
    *,
    seed: int | Sequence[int],
    evaluations: int,
    tick: Tick = silent,
    stage: str = STAGE,
) -> GlobalFound:
    """Search for the least cost between finite bounds `low` and `high` (n,), in at most `evaluations`; equal seeds give
    equal results. Scale before what spans decades (logarithm, inverse hyperbolic sine).
    """
    from scipy.optimize import differential_evolution
    from scipy.stats import qmc

    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    if low.shape != high.shape or not np.all(np.isfinite(low) & np.isfinite(high)) or not np.all(low < high):
        raise ValueError("bounds of a global search must be finite, and each lower one below its upper one")
    began, span, n, count = perf_counter(), high - low, low.size, 0
    least, vector = np.inf, low + 0.5 * span

    def value(z: Array) -> float:
        nonlocal count, least, vector
        if count >= evaluations:
            return np.inf
        member = low + z * span
        own = float(cost(member))
        count += 1
        if own < least:
            least, vector = own, member
        tick(stage, min(count / evaluations, 1.0))
        return own if np.isfinite(own) else np.inf

    size = max(_FEWEST, min(_MEMBERS * n, evaluations // 10))
    sobol = qmc.Sobol(n, seed=np.random.default_rng(seed)).random_base2(int(np.ceil(np.log2(size))))
    last = differential_evolution(
        value, [(0.0, 1.0)] * n, strategy="best1bin", init=sobol[:size], mutation=_MUTATION,
        recombination=_RECOMBINATION, maxiter=max(evaluations // size - 1, 1), tol=_TOLERANCE, polish=False,
        updating="deferred", seed=np.random.default_rng(seed),
    )  # fmt: skip
    order = np.argsort(last.population_energies, kind="stable")
    best = tuple(low + z * span for z in np.asarray(last.population, dtype=np.float64)[order])
    return GlobalFound(vector=vector, cost=least, evaluations=count, seconds=perf_counter() - began, best=best)


class BestByDelay:
    """The best vectors that a cost was evaluated at, one for each delay: each has minima of its own."""

    def __init__(self) -> None:
        self._best: dict[int, tuple[float, tuple[float, ...]]] = {}

    def note(self, delay: int, value: float, z: Array) -> None:
        """Take note of an evaluation."""
        if np.isfinite(value):
            self._best[delay] = min(self._best.get(delay, (np.inf, ())), (value, tuple(z.tolist())))

    def vectors(self) -> list[Array]:
        """Return them, best first."""
        return [np.array(z) for _, z in sorted(self._best.values())]


def rescued(
    before: F | None,
    why: str,
    look: Callable[[Tick], F | None],
    so_far: Callable[[], F | None],
    better: Callable[[F, F], bool],
    tick: Tick,
) -> F | None:
    """Return the better of a fit, not enough for `why`, and of one that `look` finds, None without either; where a
    KeyboardInterrupt ends it, `so_far` gives its best. Its `global_search` has ``why``, ``evaluations``, ``seconds``,
    ``criterion_before`` and ``criterion_after`` (per value, None where there is none), ``taken``, ``interrupted``.
    """
    began, count, interrupted = perf_counter(), 0, False

    def note(stage: str, done: float | None = None, /) -> None:
        nonlocal count
        count += stage == STAGE and done is not None
        tick(stage, None)

    try:
        after = look(note)
    except KeyboardInterrupt:
        interrupted, after = True, so_far()
        if before is None and (after is None or after.status == "failed"):
            raise
    taken = after is not None and after.status != "failed"
    if taken and after is not None and before is not None and before.status != "failed":
        taken = better(after, before)
    fit = after if taken else before
    if fit is None:
        return None
    report = {
        "why": why, "evaluations": count, "seconds": perf_counter() - began, "criterion_before": _per_value(before),
        "criterion_after": _per_value(after), "taken": taken, "interrupted": interrupted,
    }  # fmt: skip
    return replace(fit, global_search=report)


def _per_value(fit: PhysicalFit | None) -> float | None:
    return None if fit is None or fit.status == "failed" else fit.criterion / fit.problem.n_used


def describe_search(report: Mapping[str, object]) -> str:
    """Return what a fit's `global_search` did, in one sentence."""
    before, after = report["criterion_before"], report["criterion_after"]
    out = f"the ordinary start values failed ({report['why']}): "
    if report["interrupted"]:
        out += "a global search was interrupted and "
    else:
        out += f"a global search (differential evolution, {report['evaluations']} evaluations) "
    if not report["taken"]:
        return out + "found nothing better. Check columns, signs, units, delay and excitation"
    if before is None:
        return out + "found this fit"
    fall = float(str(before)) - float(str(after))
    return out + f"found this fit, whose likelihood criterion is {fall:.2g} per sample lower"
