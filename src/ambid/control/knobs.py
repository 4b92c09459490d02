"""LQG, whose few knobs are set by the worst of many plants, as it promises nothing on others than its own (Doyle
1978): a grid, then along each knob. Of responses computed once, y = H w and w = W y:

S = (I - H W)⁻¹ at the positions, x/f = G_x + H_x W (I - H W)⁻¹ G_y, w/n = W (I - H W)⁻¹.

At the commands (I - W H)⁻¹ is limited beside.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ambid.acquisition.law_words import LAW_STATES
from ambid.acquisition.settings import held_by
from ambid.arrays import Array, Complex
from ambid.control.closed import Plant
from ambid.control.design import Goals, closed_loop_of, examine, mean_over, noise_of, worst_of
from ambid.control.lqg import SampledPlant, Weights, lqg, reduced
from ambid.control.tuning import raised, said
from ambid.control.zones import ZONES
from ambid.errors import EstimationError, ModelError, RigError
from ambid.estimation.progress import Tick
from ambid.physics.law import StateLaw
from ambid.physics.loop import Limits, Loop, Noise
from ambid.rig import Rig
from ambid.simulation.plant import signals_fed_back

_FREQUENCIES = 150
_BEYOND = 1e2  # score of a law that passes a limit, before its excess
_LOST = 1e3  # and of one that does not hold all plants
_SLACK = 0.03  # by which limits are kept from: other plants judge
_SETTLED = 3.0  # time constants of the slowest pole that count as settled, until force steps say how many
_ROUNDS = 4  # of that
_FIRST, _FINEST = 4.0, 1.15  # factors on the knobs between tries

Knobs = tuple[float, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Family:
    """Plants that one law must hold, the one it is designed for first."""

    plants: tuple[Plant, ...]
    noise: tuple[float, float] = (0.0, 0.0)  # of position and current, m and A rms

    @cached_property
    def sampled(self) -> tuple[SampledPlant, ...]:
        """Each over one sample."""
        return tuple(SampledPlant.of(p) for p in self.plants)

    @cached_property
    def frequency_hz(self) -> Array:
        """Where the responses are looked at, close around the resonances of the first plant."""
        return self.plants[0].grid(_FREQUENCIES)

    @cached_property
    def responses(self) -> tuple[Complex, Complex, Complex, Complex]:
        """H and G at what is fed back, by commands and forces, then at the magnets, (n_plants, n, ...)."""
        parts = []
        for plant in self.plants:
            by_forces, by_inputs = closed_loop_of(plant, Loop(), self.frequency_hz).pushed
            rows, n_y, n = signals_fed_back(plant.model), plant.space.C.shape[0], len(plant.axes)
            forces = by_forces[:, :, plant.space.E.shape[1] :]
            parts.append((by_inputs[:, rows], forces[:, rows], by_inputs[:, n_y:], forces[:, n_y : n_y + n]))
        H, G, H_x, G_x = (np.stack(x) for x in zip(*parts, strict=True))
        return H, G, H_x, G_x

    def poles(self, law: StateLaw) -> Array:
        """Return the largest modulus of the poles on each plant."""
        return np.array([sampled.largest_pole(law) for sampled in self.sampled])

    def peaks(self, law: StateLaw) -> tuple[Array, Array]:
        """Return the peak of the sensitivity on each plant, of any axis: at its position signal, at its command."""
        H, W = self.responses[0], law.response(self.frequency_hz)
        position = self.sampled[0].kinds[0]
        signals = np.linalg.inv(np.eye(H.shape[2]) - H @ W)[..., position, position]
        commands = np.diagonal(np.linalg.inv(np.eye(H.shape[3]) - W @ H), axis1=2, axis2=3)
        return np.max(np.abs(signals), axis=(1, 2)), np.max(np.abs(commands), axis=(1, 2))

    def figures(self, law: StateLaw) -> dict[str, float]:
        """Return the worst of each of `FIGURES` (settling by the slowest pole), the peak at the commands, and the
        largest pole, which is alone where a plant is not held.
        """
        largest = float(np.max(self.poles(law)))
        if largest >= 1.0:
            return {"pole": largest}
        H, G, H_x, G_x = self.responses
        W = law.response(self.frequency_hz)
        answer = W @ np.linalg.inv(np.eye(H.shape[2]) - H @ W)
        soft = np.diagonal(G_x + H_x @ (answer @ G), axis1=2, axis2=3)
        sd = np.zeros(H.shape[2])
        for rows, x in zip(self.sampled[0].kinds, self.noise, strict=True):
            sd[rows] = x
        power = np.sum(np.abs(answer * sd) ** 2, axis=3)
        noise = np.sqrt(mean_over(self.frequency_hz, np.moveaxis(power, 1, 0)))
        position, command = self.peaks(law)
        decay = -math.log(largest) * law.rate_hz
        return {
            "peak": float(np.max(position)), "compliance": float(np.max(np.abs(soft))), "noise": float(np.max(noise)),
            "settling": _SETTLED / decay, "command": float(np.max(command)), "pole": largest,
        }  # fmt: skip


@dataclass(kw_only=True, eq=False)
class _Tries:
    """Laws for the first of some plants by their knobs (effort, disturbances, integral's time), each made and looked at
    once.
    """

    family: Family
    rig: Rig
    limits: Limits
    most: int  # tries that are expected
    tick: Tick

    def __post_init__(self) -> None:
        self._known: dict[Knobs, tuple[StateLaw | None, Mapping[str, float]]] = {}

    def at(self, knobs: Knobs) -> tuple[StateLaw | None, Mapping[str, float]]:
        """Return the law and its figures; none where the knobs give no law."""
        key = tuple(round(math.log(x), 6) for x in knobs)
        if key not in self._known:
            self.tick("tune", min((len(self._known) + 1) / self.most, 0.99))
            try:
                law = self._law(knobs)
                self._known[key] = law, self.family.figures(law)
            except EstimationError:  # no law with these knobs
                self._known[key] = None, {"pole": math.inf}
        return self._known[key]

    def _law(self, knobs: Knobs) -> StateLaw:
        """Return a law that fits in the words of the rig's controller; EstimationError where there is none."""
        effort, disturbance, integral = knobs
        weights, noise = Weights.of(self.limits, integral), self.rig.noise or Noise()
        law = lqg(self.family.plants[0], weights, noise, effort=effort, disturbance=disturbance).law
        if self.rig.daq is None:
            return law
        each = [weights.position, weights.current if math.isfinite(weights.current) else 1.0]
        axes = law.D.shape[0]
        sizes = np.tile(each[: law.D.shape[1] // axes], axes)
        for order in range(min(law.order, LAW_STATES), 1, -1):  # modes that nearly cancel do not fit in its words
            with suppress(ModelError, RigError):
                less = reduced(law, order, sizes, weights.command)[0]
                held_by(self.rig, Loop(law=less))
                return less
        raise EstimationError("no LQG law of these weights fits in the words of the rig's controller")


@dataclass(frozen=True, kw_only=True, eq=False)
class Score:
    """How good figures are for goals: small is good; a law that passes a limit is worse than any other."""

    goals: Goals
    minimise: tuple[str, ...]
    limits: dict[str, float]

    @classmethod
    def of(cls, goals: Goals) -> Score:
        """Return the score of a design's goals; the peak at the commands stays in zone A."""
        limits = {n: x * math.exp(-_SLACK) for n, x in goals.limits.items()}
        return cls(goals=goals, minimise=goals.minimise, limits={**limits, "command": ZONES[0][0]})

    def __call__(self, figures: Mapping[str, float]) -> float:
        """Return the score."""
        if figures["pole"] >= 1.0:
            return _LOST + figures["pole"]
        excess = max((math.log(figures[n] / x) for n, x in self.limits.items()), default=-math.inf)
        goal = max(math.log(figures[n] / self.goals.reference[n]) for n in self.minimise)
        return _BEYOND + excess if excess > 0.0 else goal

    def met(self, figures: Mapping[str, float]) -> bool:
        """Whether no limit is passed."""
        return self(figures) < _BEYOND


def _search(tries: _Tries, score: Score, grid: Sequence[Knobs]) -> Knobs:
    """Return the knobs of least score: the best of a grid, then by ever smaller steps, of the first two together too,
    as the border of a limit may run between them.
    """

    def at(knobs: Knobs) -> float:
        return score(tries.at(knobs)[1])

    best, step = min(grid, key=at), math.sqrt(_FIRST)
    while step > _FINEST:
        around = [tuple(x * step**d for x, d in zip(best, way, strict=True)) for way in _ways(len(best))]
        nearest = min(around, key=at)
        if at(nearest) < at(best):
            best = nearest
        else:
            step = math.sqrt(step)
    return best


def _ways(n: int) -> list[tuple[int, ...]]:
    """Return directions in which `n` knobs change."""
    pairs = [(a, b, *[0] * (n - 2)) for a in (-1, 0, 1) for b in (-1, 0, 1) if a or b]
    return [*pairs, *(tuple(side * (j == k) for j in range(n)) for k in range(2, n) for side in (-1, 1))]


def design_lqg(plants: Sequence[Plant], rig: Rig, goals: Goals, tick: Tick) -> Loop:
    """Return the loop whose law, for the first of some plants, does best on the worst of them; EstimationError where
    none meets the limits.
    """
    settling = goals.limits.get("settling", goals.reference["settling"])
    if rig.limits is None:
        raise EstimationError("the rig gives no [limits]; LQG weighs by them. Give limits.position and limits.voltage")
    grid: list[Knobs] = [
        (_FIRST**a, _FIRST**b, settling / (c * _SETTLED))
        for a in range(-2, 2)
        for b in range(-2, 3)
        for c in (1.0, 1.5)
    ]
    noise, score = noise_of(rig.noise, {})[:2], Score.of(goals)
    family = Family(plants=tuple(plants), noise=noise)
    tries = _Tries(family=family, rig=rig, limits=rig.limits, most=6 * len(grid), tick=tick)
    for _ in range(_ROUNDS):
        best = _search(tries, score, grid)
        law, figures = tries.at(best)
        if law is None or not score.met(figures):
            break
        loop = Loop(law=law, delay=0.0 if rig.loop is None else rig.loop.delay)
        settled = worst_of([examine(p, loop, noise).figures for p in plants]).settling
        over = settled / goals.limits.get("settling", math.inf)
        if over <= 1.0:
            return loop
        score.limits["settling"] = figures["settling"] * math.exp(-_SLACK) / over
        grid = [*grid, best]
    raise EstimationError(_refusal(tries, score, grid))


def _refusal(tries: _Tries, score: Score, grid: Sequence[Knobs]) -> str:
    """Say which limit to move, and how far: the one that has to give way least, the others kept."""
    ways, goals = [], score.goals
    for limit in goals.limits:
        alone = replace(score, minimise=(limit,), limits={n: x for n, x in score.limits.items() if n != limit})
        figures = tries.at(_search(tries, alone, grid))[1]
        if alone.met(figures) and figures[limit] > score.limits[limit]:
            ways.append((figures[limit] / score.limits[limit], limit))
    limits = ", ".join(said(n, x) for n, x in goals.limits.items())
    if not ways:
        return f"no LQG law meets the limits ({limits}), nor where any one of them is left out. Raise several of them"
    ratio, limit = min(ways)
    least = ratio * goals.limits[limit]
    return (
        f"no LQG law meets the limits ({limits}) on all plants; with the others kept, {said(limit, least)} is the "
        f"least. Give {raised(limit, least)}, or raise another"
    )
