"""What the linear grey box does where its starts fail: tell that they did, search globally, take the better fit.

Failed: no search converged, or a linear regression on past innovations and inputs explains much of the innovations.
Differential evolution minimises the innovations likelihood, finite nearly everywhere by its Riccati gain, over the
physical parameters (logarithms of rates, from one over the record's length to a few sampling rates, and of ratios of
signal sizes), the disturbances' level and a searched delay; offsets are zero, the first sample gives the initial state.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ambid.arrays import Array
from ambid.bearing.multistart import (
    FARTHEST,
    MAX_DELAY,
    Candidate,
    Delay,
    Signals,
    at_first_sample,
    candidate_problem,
    fixed_values,
    race,
)
from ambid.estimation.global_search import BestByDelay, global_search, rescued
from ambid.estimation.likelihood import Fit, Workspace, evaluate, search
from ambid.estimation.predictor import PredictorProblem, Scales, busiest, noise_floor
from ambid.estimation.progress import Tick, silent
from ambid.physics.linear_model import LinearModel, Parameter

EVALUATIONS = 1200  # of the likelihood, unless the caller says otherwise: 1 to 2 s, and as much for local searches
_BETTER = 0.5  # of the criterion, its numbers paid for (BIC), by which a fit must be better
_STRETCH = 2048  # samples on which the global search compares
_QUIET = (-9.0, 2.0)  # log disturbance level, relative to what sensor noise hides within a sample
_SMALL, _LARGE = 1e-3, 30.0  # R over |u|/|i|
_TRIED = 16  # places that are searched from: the best, and the best of each delay, as each has minima of its own


def rescue(
    before: Fit | None,
    why: str,
    model: LinearModel,
    signals: Signals,
    parameters: Sequence[Parameter],
    delay: Delay,
    how: Rescue,
    follow: Callable[[Sequence[Candidate]], Fit],
    tick: Callable[[], None] | None,
) -> Fit | None:
    """Search globally, then with `follow` locally from several candidates; `before`, `why`: see `rescued`; a
    KeyboardInterrupt of `tick` ends in the best so far, where there is any.
    """
    cost = likelihood_cost(model, signals, parameters, delay) if how.evaluations else None
    if cost is None:
        return before

    def look(note: Tick) -> Fit | None:
        candidates = global_candidates(cost, signals, how, tick=note)
        candidates = sorted((race(c, tick) for c in candidates), key=lambda c: c.criterion)
        return follow(candidates[:1]) if candidates else None

    def so_far() -> Fit | None:  # not a step further: what was found, with its information
        candidates = candidates_at(cost, signals, cost.best.vectors()[:1])
        return search(candidates[0].problem, candidates[0].vector, steps=0) if candidates else None

    return rescued(before, why, look, so_far, _better, lambda *_: tick() if tick is not None else None)


def _better(after: Fit, before: Fit) -> bool:
    """Whether the later fit says more of the data than its numbers cost, or as much and has converged."""
    # compared per sample, because a longer delay may leave fewer samples
    n = before.problem.n_used
    gain = n * (before.criterion / n - after.criterion / after.problem.n_used)
    gain += (before.problem.size - after.problem.size) * float(np.log(n))
    return gain > _BETTER or (gain > -_BETTER and after.status == "converged" != before.status)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rescue:
    """How a global search is made where one is needed."""

    evaluations: int  # at most; 0: none
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Coordinate:
    """One number that is searched, between 0 (-1 where it has a sign) and 1."""

    name: str  # a physical parameter, ``"level"`` or ``"delay"``
    low: float  # positive: the sizes searched between, logarithmically; the delay evenly, in samples
    high: float
    signed: bool = False

    def value(self, z: float) -> float:
        """Return the number at a coordinate."""
        if self.name in ("level", "delay"):
            return self.low + z * (self.high - self.low)
        size = self.low * (self.high / self.low) ** abs(z)
        return float(np.copysign(size, z)) if self.signed else size


@dataclass(frozen=True, kw_only=True, eq=False)
class LikelihoodCost:
    """The innovations likelihood of a record over `coordinates`."""

    model: LinearModel
    signals: Signals  # means taken off
    parameters: tuple[Parameter, ...]
    coordinates: tuple[Coordinate, ...]
    delay: float  # samples, where it is not searched
    scales: Scales  # of order one where the parameters' are; disturbances of 1
    _work: dict[int, Workspace] = field(default_factory=dict)  # by delay
    best: BestByDelay = field(default_factory=BestByDelay)

    def __call__(self, z: Array) -> float:
        """Return the criterion per sample at `z` (n_coordinates,); infinite where there is no predictor."""
        candidate = self.candidate(z, shared=True)
        if candidate is None:
            return np.inf
        value = candidate.criterion / candidate.problem.n_used
        self.best.note(candidate.problem.delay, value, z)
        return value

    def candidate(self, z: Array, *, shared: bool = False) -> Candidate | None:
        """Return the place to search from at `z`, None where there is no predictor; `shared`: reuse that delay's
        workspace.
        """
        at = {c.name: c.value(float(x)) for c, x in zip(self.coordinates, z, strict=True)}
        values = self.physical(at)
        delay = float(min(int(at["delay"]), FARTHEST)) if "delay" in at else self.delay
        if not all(values.get(name, 1.0) > 0.0 for name in ("m", "L")):  # fixed so by the user
            return None
        reach = np.max(np.abs(self.model.matrices(values).E) / self.scales.state[:, None], axis=0)
        if not np.all(np.isfinite(reach)) or np.any(reach <= 0.0):
            return None
        scales = replace(self.scales, disturbance=self.signals.rate_hz / reach)
        problem = candidate_problem(
            self.model, self.signals, self.parameters, values, scales, delay, max(MAX_DELAY, int(delay)) + 2
        )
        vector = np.zeros(problem.size)
        vector[problem.slices["physical"]] = np.array([values[k] for k in problem.estimated]) / problem.magnitude
        first = problem.slices["noise"].start
        vector[first : first + len(self.model.disturbances)] = at["level"]
        work = self._workspace(problem) if shared else Workspace(problem)
        value, _ = evaluate(problem, at_first_sample(problem, vector), work)
        if not np.isfinite(value):
            return None
        return Candidate(criterion=value, problem=problem, vector=at_first_sample(problem, vector))

    def physical(self, at: Mapping[str, float]) -> dict[str, float]:
        """Return the physical parameters from sizes and rates."""
        out = fixed_values(self.parameters)
        out |= {name: at[name] for name in ("R", "L", "k_i") if name in at}
        if "m" in at:  # the rate at which the force k_i i moves the mass as far as was seen
            out["m"] = abs(out["k_i"]) * self.ratio / at["m"] ** 2
        elif "m" not in out and "k_x" in {p.name for p in self.parameters}:
            out["m"] = 1.0
        if "k_x" in at:
            out["k_x"] = out["m"] * at["k_x"] * abs(at["k_x"])
        if "c" in at:
            out["c"] = out["m"] * at["c"]
        return out

    @property
    def ratio(self) -> float:
        """Size of the current over that of the position, A/m."""
        size = _sizes(self.model, self.signals)
        return size["current"] / size["position"]

    def _workspace(self, problem: PredictorProblem) -> Workspace:
        """Return the workspace of a delay."""
        if problem.delay not in self._work:
            self._work[problem.delay] = Workspace(problem)
        return self._work[problem.delay]


def likelihood_cost(
    model: LinearModel, signals: Signals, parameters: Sequence[Parameter], delay: Delay
) -> LikelihoodCost | None:
    """Set up what is searched globally, bounds from the data; None for a model whose numbers have no known bounds."""
    if model.name not in ("one-axis", "coil", "rotor"):
        return None
    centred = replace(signals, u=signals.u - signals.u.mean(axis=0), y=signals.y - signals.y.mean(axis=0))
    stretch = busiest(centred.u, _STRETCH)
    part = replace(centred, u=centred.u[stretch], y=centred.y[stretch])
    floor = noise_floor(part.y)
    state = np.array([floor[model.outputs.index(s)] if s in model.outputs else 0.0 for s in model.states])
    state[state == 0] = floor[0] * signals.rate_hz / 20  # as `scales_for` has it
    scales = Scales(
        state=state, input=np.std(part.u, axis=0), output=floor, disturbance=np.ones(len(model.disturbances))
    )
    return LikelihoodCost(
        model=model,
        signals=part,
        parameters=tuple(parameters),
        coordinates=_coordinates(model, part, parameters, delay),
        delay=0.0 if delay == "auto" else float(delay),
        scales=scales,
    )


def _sizes(model: LinearModel, signals: Signals) -> dict[str, float]:
    """Standard deviation of each channel, by role."""
    deviations = np.std(np.hstack([signals.u, signals.y]), axis=0)
    return dict(zip((*model.inputs, *model.outputs), deviations.tolist(), strict=True))


def _coordinates(
    model: LinearModel, signals: Signals, parameters: Sequence[Parameter], delay: Delay
) -> tuple[Coordinate, ...]:
    """What is searched, and between what: nothing slower than the record, nothing much faster than its samples."""
    size = _sizes(model, signals)
    slow, fast = 2 * np.pi * signals.rate_hz / signals.y.shape[0], 3.0 * signals.rate_hz
    free = {p.name: p for p in parameters if p.role != "fixed"}
    out = [Coordinate(name="level", low=_QUIET[0], high=_QUIET[1])]
    if delay == "auto":
        out.append(Coordinate(name="delay", low=0.0, high=FARTHEST + 1.0))
    if "voltage" in size:
        volts = size["voltage"] / size["current"]
        bounds = {"R": (_SMALL * volts, _LARGE * volts), "L": (volts / fast / 10.0, volts / slow)}
        out += [Coordinate(name=k, low=low, high=high) for k, (low, high) in bounds.items() if k in free]
    if "position" in size:
        moves = size["position"] / size["current"]
        if "k_i" in free and "voltage" in size:  # by the motional voltage
            low = size["voltage"] / size["position"] / fast
            out.append(Coordinate(name="k_i", low=low, high=low * fast / slow, signed=True))
        elif "k_i" in free:  # by the motion; only its ratio to the mass is seen, which is 1 where it is not known
            mass = fixed_values(parameters).get("m", 1.0)
            out.append(Coordinate(name="k_i", low=mass * moves * slow**2, high=mass * moves * fast**2, signed=True))
        if "m" in free and ("voltage" in size or "k_i" not in free):
            out.append(Coordinate(name="m", low=slow, high=fast))
        rates = {"k_x": (slow, fast), "c": (0.01 * slow, fast)}
        out += [Coordinate(name=k, low=low, high=high, signed=True) for k, (low, high) in rates.items() if k in free]
    return tuple(out)


def global_candidates(
    cost: LikelihoodCost,
    signals: Signals,
    how: Rescue,
    *,
    tick: Tick = silent,
) -> list[Candidate]:
    """Search globally for places of the whole record to search from: the best, then the best of each delay."""
    low = np.array([-1.0 if c.signed else 0.0 for c in cost.coordinates])
    end = global_search(cost, low, np.ones(low.size), seed=[how.seed, 6], evaluations=how.evaluations, tick=tick)
    return candidates_at(cost, signals, (end.vector, *cost.best.vectors(), *end.best[: _TRIED // 5]))[:_TRIED]


def candidates_at(cost: LikelihoodCost, signals: Signals, vectors: Sequence[Array]) -> list[Candidate]:
    """Return the whole record's candidates at several vectors (n_coordinates,), in that order; those that differ."""
    centred = replace(signals, u=signals.u - signals.u.mean(axis=0), y=signals.y - signals.y.mean(axis=0))
    whole, out = replace(cost, signals=centred), list[Candidate]()
    for z in vectors:
        candidate = whole.candidate(z)
        if candidate is not None and not any(candidate.like(c) for c in out):
            out.append(candidate)
    return out
