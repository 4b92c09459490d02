"""What the nonlinear bearing does where its start values fail: search globally, and keep the better fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ambid.arrays import Array
from ambid.bearing.magnet_likelihood import BearingFit, criterion, search
from ambid.bearing.magnet_problem import BearingProblem, BearingRecord
from ambid.estimation.global_search import STAGE, BestByDelay, global_search, rescued
from ambid.estimation.likelihood import PAST
from ambid.estimation.predictor import noise_floor
from ambid.estimation.progress import Tick, silent
from ambid.estimation.search import NOT_CONVERGED, predictable
from ambid.estimation.uncertainty import explained_by_past

_ITERATIONS = 15  # iterations from each place found
_CHOICE = 2.0  # numbers' worth (BIC) by which a fit must be better: in noisy records delays and places nearly tie
_EVEN = 0.5  # of the criterion: a fit with the same delay that has converged is taken where it is no worse
EVALUATIONS = 800  # of the likelihood: one to three seconds
_PAST = 10  # samples of voltages that a regression looks at
_LOOKED = 4096  # samples of each record that it looks at
_SAMPLES = 4000  # of all records together, on which the global search compares
_SHORTEST = 500  # samples of one record
_WIDTH = 30.0  # factor about a start value
_SHARE = 3.0  # factor about the strength that the weight says
_LONGEST = 6  # samples of delay
_FORCE, _VOLTAGE = (1e-4, 3.0), (3e-3, 3.0)  # noise levels, over what the sensors would show as such
_TRIED = 4  # delays that are searched from


def rescue(
    before: BearingFit,
    records: Sequence[BearingRecord],
    finish: Callable[[BearingFit], BearingFit],
    *,
    search_delay: bool,
    seed: int,
    evaluations: int,
    tick: Tick | None,
) -> BearingFit:
    """Return the fit, or a better one from a global search where its start values failed. `before`: of all records, at
    the end of the ordinary way; `finish`: what follows a search over all; `evaluations`: of the likelihood, at most, 0
    for none; `seed`: equal ones give equal results; a KeyboardInterrupt of `tick` ends in the best so far.
    """
    why, tick = failure(before) if evaluations else "", tick or silent
    if not why:
        return before
    try:
        tick(STAGE, None)
    except KeyboardInterrupt:  # before it began: the fit has not failed, it was ended
        return before
    cost = bearing_cost(before, search_delay=search_delay)

    def look(note: Tick) -> BearingFit | None:
        places = global_problems(cost, seed=seed, evaluations=evaluations, tick=note)
        fits = [search(p, p.start(), iterations=_ITERATIONS, tick=note) for p in places]
        fits = [f for f in fits if f.status != "failed"]
        if not fits:
            return None
        nearest = min(fits, key=lambda f: f.criterion)
        return finish(search(_whole(nearest.problem, records, before.problem.skip), nearest.vector, tick=note))

    def so_far() -> BearingFit | None:  # not a step further: what was found, with its information
        places = cost.found()
        if not places:
            return None
        whole = _whole(places[0], records, before.problem.skip)
        return search(whole, whole.start(), iterations=0)

    return rescued(before, why, look, so_far, _better, tick) or before


def _whole(problem: BearingProblem, records: Sequence[BearingRecord], skip: int) -> BearingProblem:
    """The problem of all records, from the sample on from which the first fit saw them, where the delay lets it."""
    return replace(problem, records=tuple(records), skip=max(skip, int(max(problem.delays.values())) + 8))


def _better(after: BearingFit, before: BearingFit) -> bool:
    """Whether the later fit says more of the data than its numbers cost, or as much and has converged."""
    same = replace(before.problem, skip=after.problem.skip)  # the samples that both have: a longer delay leaves fewer
    n, gain = same.n_used, criterion(same, before.vector) - after.criterion
    gain += (before.problem.size - after.problem.size) * float(np.log(n))
    if gain > _CHOICE * np.log(n):
        return True
    return (
        gain > -_EVEN and after.problem.delays == before.problem.delays and after.status == "converged" != before.status
    )


def failure(fit: BearingFit) -> str:
    """Return why a fit failed; empty where it converged, or a linear regression on the past explains little of what it
    leaves.
    """
    if fit.status == "converged":
        return predictable(max(_unexplained(fit, r) for r in range(len(fit.problem.records))))
    return NOT_CONVERGED


def _unexplained(fit: BearingFit, r: int) -> float:
    """Part of the normalised errors' variance that a regression on past errors and voltages explains, by record."""
    assert fit.at is not None
    innovations = fit.at.innovations[r]
    e = (innovations.e / np.sqrt(innovations.s))[:_LOOKED, 1 if fit.problem.records[r].held else 0 :]
    u = fit.problem.records[r].u[: e.shape[0], None]
    return explained_by_past([(e, ((e, PAST), (u, _PAST)))])[0]


@dataclass(frozen=True, kw_only=True, eq=False)
class BearingCost:
    """The likelihood of short records over numbers between 0 and 1."""

    problem: BearingProblem  # delays whole and not in the vector; its numbers are the start values
    names: tuple[str, ...]  # what is searched: numbers, ``"force"``, ``"voltage"`` (levels), ``"delay"``
    # of each, in the logarithm (a single magnet's ``s`` and the delay: as they are; ``k`` or ``L_g`` of a magnet that
    # carries a weight: over what the weight says)
    bounds: tuple[tuple[float, float], ...]
    weight: float  # that one magnet carries, N; 0 for a pair
    best: BestByDelay = field(default_factory=BestByDelay)  # so that an interruption loses nothing

    def __call__(self, z: Array) -> float:
        """Return the criterion per measured value at `z` (n_names,); infinite where there is no predictor."""
        problem = self.at(z)
        if problem is None:
            return np.inf
        with np.errstate(all="ignore"):
            value = criterion(problem, problem.start()) / problem.n_used
        self.best.note(int(next(iter(problem.delays.values()))), value, z)
        return value

    def found(self) -> list[BearingProblem]:
        """Return the problems at the best vectors that were evaluated, of a few delays, best first."""
        places = [self.at(z) for z in self.best.vectors()[:_TRIED]]
        return [p for p in places if p is not None]

    def at(self, z: Array) -> BearingProblem | None:
        """Return the problem that starts at `z` (n_names,); None where the gap would close."""
        low, high = np.array(self.bounds).T
        at = dict(zip(self.names, (low + z * (high - low)).tolist(), strict=True))
        problem = self.problem
        values = {n.name: n.value for n in problem.numbers}
        values |= {k: v if k == "s" and not problem.law.pair else np.exp(v) for k, v in at.items() if k in values}
        free = [r for r in problem.records if not r.held]
        x, i, u = (float(np.mean(np.concatenate(c))) for c in zip(*((*r.kept.T, r.u) for r in free), strict=True))
        if self.weight:
            first, second = problem.law.names[:2]
            length = values[second]
            if problem.law.gap == "exponential":
                balanced = 2.0 * self.weight * length * np.exp(x / length) / i**2
            else:
                if length + min(float(r.kept[:, 0].min()) for r in free) <= 0.0:
                    return None
                balanced = 2.0 * self.weight * (length + x) ** 2 / i**2
            values[first] = balanced * values[first] if first in at else values[first]
        estimated = {n.name for n in problem.estimated}
        if "v_offset" in estimated:
            values["v_offset"] = u - values["R"] * i
        if not all(np.isfinite(v) for v in values.values()):
            return None
        centre = _levels(problem, values, np.exp(at["force"]), np.exp(at["voltage"]))
        delays = problem.delays
        if "delay" in at:
            rate = free[0].rate_hz
            whole = float(min(int(at["delay"]), _LONGEST))
            delays = {r: whole / rate * r for r in delays} | {rate: whole}
        numbers = tuple(replace(n, value=float(values[n.name])) if n.estimated else n for n in problem.numbers)
        return replace(problem, numbers=numbers, noise_center=centre, delays=delays)


def _levels(problem: BearingProblem, values: dict[str, float], force: float, voltage: float) -> Array:
    """Noise levels of each record, from what its sensors' roughness says (as `with_noise` has them)."""
    centre = np.zeros_like(problem.noise_center)
    for r, record in enumerate(problem.records):
        floor, rate = np.log(noise_floor(record.kept)), record.rate_hz
        own = floor + np.log([values["m"] * rate**2 * force, values["L_leak"] * rate * voltage])
        centre[r] = np.concatenate([floor, own, own - np.log(30.0)])
    return centre


def bearing_cost(fit: BearingFit, *, search_delay: bool) -> BearingCost:
    """Set up what is searched globally, about the start values of a fit of all records."""
    old = fit.problem
    count = max(_SAMPLES // len(old.records), _SHORTEST)
    whole = {r: float(round(d)) for r, d in old.delays.items()} if search_delay else old.delays
    problem = replace(
        old, records=tuple(r.first(count) for r in old.records), delays=whole, free_delay=frozenset(),
        skip=max(old.skip, _LONGEST + 8),
    )  # fmt: skip
    values = {n.name: n.value for n in problem.numbers}
    weight = 0.0 if problem.law.pair else values["m"] * values["g"]
    names: list[str] = ["force", "voltage"]
    bounds = [(np.log(_FORCE[0]), np.log(_FORCE[1])), (np.log(_VOLTAGE[0]), np.log(_VOLTAGE[1]))]
    distance = np.concatenate([r.kept[:, 0] for r in problem.records if not r.held])
    for n in problem.estimated:
        if n.signed and not (n.name == "s" and not problem.law.pair):
            continue  # offsets and differences: small, and found by what follows
        names.append(n.name)
        if n.name == "s" and n.signed:
            bounds.append((-0.9 * float(distance.min()), 3.0 * float(np.mean(distance))))
        elif weight and n.name == problem.law.names[0]:
            bounds.append((-np.log(_SHARE), np.log(_SHARE)))
        else:
            width = np.log(_WIDTH) if not np.isfinite(n.prior_sd) else 4.0 * n.prior_sd / abs(n.value)
            width = min(width, np.log(_WIDTH))
            bounds.append((np.log(n.value) - width, np.log(n.value) + width))
    if search_delay:
        names.append("delay")
        bounds.append((0.0, _LONGEST + 1.0))
    return BearingCost(problem=problem, names=tuple(names), bounds=tuple(bounds), weight=weight)


def global_problems(cost: BearingCost, *, seed: int, evaluations: int, tick: Tick = silent) -> list[BearingProblem]:
    """Search globally for problems with better start values: of the short records, the best of each of a few delays, in
    order.
    """
    n = len(cost.names)
    global_search(cost, np.zeros(n), np.ones(n), seed=[seed, 7], evaluations=evaluations, tick=tick)
    return cost.found()
