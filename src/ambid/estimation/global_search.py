"""Global search by differential evolution (Storn and Price 1997), a start for fits whose ordinary starts fail.

Numbers are searched for between bounds, scaled to 0 .. 1; SciPy's `differential_evolution` does it, strategy best1bin
with dithered mutation, from a Sobol sequence; the result depends on the seed alone. Local refinement is the caller's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from ambid.arrays import Array
from ambid.estimation.progress import Tick, silent

STAGE = "global search"
_MUTATION = (0.5, 1.0)  # factor of the difference vectors, drawn anew for each generation
_RECOMBINATION = 0.9  # numbers of a physical model hang together: most of them change at once
_MEMBERS = 8  # of the population, for each number
_TOLERANCE = 1e-3  # spread of the costs, relative to their mean, at which a search has ended
_FEWEST = 16


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
    keep: Callable[[Array, float], None] | None = None,
) -> GlobalFound:
    """Search for the least cost between bounds.

    `low`, `high`: (n,), finite, low below high. Scale what spans decades before (logarithm, inverse hyperbolic sine);
    `seed`: equal seeds give equal results; `evaluations`: of `cost`, at most.
    """
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    if low.shape != high.shape or not np.all(np.isfinite(low) & np.isfinite(high)) or not np.all(low < high):
        raise ValueError("bounds of a global search must be finite, and each lower one below its upper one")
    began = perf_counter()
    run = _Run(cost=cost, low=low, span=high - low, budget=evaluations, tick=tick, stage=stage, keep=keep)
    last = _evolved(run, _first_generation(low.size, evaluations, seed), seed)
    return GlobalFound(
        vector=run.vector,
        cost=run.least,
        evaluations=run.done,
        seconds=perf_counter() - began,
        best=tuple(low + z * (high - low) for z in last),
    )


class _Run:
    """What a search has seen so far, in the order of the members."""

    def __init__(
        self, *, cost: Callable[[Array], float], low: Array, span: Array, budget: int, tick: Tick, stage: str,
        keep: Callable[[Array, float], None] | None,
    ) -> None:  # fmt: skip
        self.cost, self.low, self.span, self.budget = cost, low, span, budget
        self.tick, self.stage, self.keep = tick, stage, keep
        self.done, self.least, self.vector = 0, np.inf, low + 0.5 * span

    def value(self, z: Array) -> float:
        """Return the cost of a member; infinite beyond the budget."""
        if self.done >= self.budget:
            return np.inf
        found = float(self.cost(self.low + z * self.span))
        self.done += 1
        if found < self.least:
            self.least, self.vector = found, self.low + z * self.span
            if self.keep is not None:
                self.keep(self.vector, found)
        self.tick(self.stage, min(self.done / self.budget, 1.0))
        return found if np.isfinite(found) else np.inf


def _first_generation(n: int, budget: int, seed: int | Sequence[int]) -> Array:
    """A Sobol sequence."""
    from scipy.stats import qmc

    size = max(_FEWEST, min(_MEMBERS * n, budget // 10))
    power = int(np.ceil(np.log2(size)))
    return np.asarray(qmc.Sobol(n, seed=np.random.default_rng(seed)).random_base2(power), dtype=np.float64)[:size]


def _evolved(run: _Run, first: Array, seed: int | Sequence[int]) -> Array:
    """Members of the last generation, best first."""
    from scipy.optimize import differential_evolution

    found = differential_evolution(
        run.value, [(0.0, 1.0)] * first.shape[1], strategy="best1bin", init=first, mutation=_MUTATION,
        recombination=_RECOMBINATION, maxiter=max(run.budget // first.shape[0] - 1, 1), tol=_TOLERANCE, polish=False,
        updating="deferred", seed=np.random.default_rng(seed),
    )  # fmt: skip
    order = np.argsort(found.population_energies, kind="stable")
    return np.asarray(found.population, dtype=np.float64)[order]
