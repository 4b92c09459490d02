"""Plants that a loop must hold: drawn around an estimate (draw 0), each with what was changed.

Beside the covariance: a rotor away from rest and another load, at k_x, k_i and L of the co-energy there (thesis eq.
1.9, 2.7); a roughly realised delay; eddy currents; a warm coil; less damped bending modes of another assembly. Without
a magnet's numbers the law is two opposed ones': k_i = 4 k' i0/s0² cos alpha and -k_x = 4 k' i0²/s0³ cos alpha give
i0/s0 = -k_x/k_i and, without leakage, L = -k_i²/k_x; the gap s0 is assumed, twice the travel inside the limits, as
touch-down bearings stand at half of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.control.closed import Plant
from ambid.errors import EstimationError, ModelError, RigError
from ambid.estimation.estimate import Check
from ambid.physics.law_magnet import BEARING_NUMBERS, LawMagnet
from ambid.physics.linear_model import LinearModel, OneAxis, Parameter, ParameterSpec, StateSpace
from ambid.physics.loop import UNLIMITED, Interval
from ambid.physics.magnet import CoEnergy, Energy
from ambid.physics.nonlinear import NonlinearPlant
from ambid.physics.rotor_model import EDDY, RotorModel
from ambid.rig import Rig, RigMagnet
from ambid.simulation.rig_bench import plant_of_rig, rest_of_rig
from ambid.validation.facts import GRAVITY

COPPER = 0.0039
"""Rise of the resistance of copper over its value at 20 °C, 1/K."""

GAP_OF_TRAVEL = 2.0
"""Air gap over the travel to the touch-down bearing, where no gap is given."""

_NARROW = 0.3  # relative standard deviation up to which a number is drawn in its logarithm
_TRIES = 100  # of one draw
_STEPS = 6  # of Newton's method; the force is nearly a square of the current
_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0  # whose multiples are spread evenly
_UNITS = {spec.name: spec.unit for spec in BEARING_NUMBERS}
_TOLD = 3  # numbers that `Drawn.words` names


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """How far plants are drawn from the estimate; 0 switches a source off."""

    covariance: float = 1.0  # factor on the standard deviations of what was identified
    delay: float = 0.5  # samples by which the delay is longer or shorter at most
    # share of the way to the limits by which the rotor is away from rest at most, and the current from what holds the
    # rotor there
    position: float = 0.15
    current: float = 0.15
    # largest time constant of the eddy currents in samples; where the rig's [magnet] has their pole, over its own
    eddy: float = 0.5
    warm_k: tuple[float, float] = (-10.0, 60.0)  # kelvin by which the coil is colder or warmer than it was
    frequency: float = 0.03  # relative change of the frequencies of bending modes at most
    damping: float = 0.5  # share of their damping that may be missing

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self)):
            value, pair = getattr(self, name), name == "warm_k"
            if np.shape(value) != ((2,) if pair else ()) or np.asarray(value).dtype.kind not in "fiu":
                number = "two numbers, such as -10:60" if pair else "one number"
                raise ModelError(f"spread.{name} is {value!r}; it must be {number}. Correct it")
            if pair:
                continue
            if not (math.isfinite(value) and value >= 0.0):
                raise ModelError(f"spread.{name} is {value}; it must be zero or positive. Correct it")
        if max(self.position, self.current, self.damping, self.frequency) >= 1.0:
            raise ModelError("spread.position, current, damping and frequency are shares below 1. Correct them")
        if not -200.0 < self.warm_k[0] <= self.warm_k[1] < math.inf:
            raise ModelError(f"spread.warm_k is {self.warm_k}; the colder comes first. Swap or correct them")


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawn:
    """One plant, and what was changed."""

    plant: Plant  # without covariance
    number: int  # of the draw; 0 is the estimate
    # "position" (m) from rest and "current" (A) from what holds the rotor there, "delay" (samples), "eddy_s" (s),
    # "warm_k" (K), "speed" (rad/s), relative change of every number of the model by its name; of a rotor by axis
    changed: Mapping[str, float]

    def words(self) -> str:
        """Say what was changed, on one line."""
        texts, by_axis = [], sorted(self.changed.items(), key=lambda item: -abs(item[1]))
        for kind, words in _WORDS.items():
            axes = [(name, x) for name, x in by_axis if name.rsplit(".", 1)[-1] == kind]
            for name, x in axes[:1]:  # of a rotor the axis that is changed most
                axis = f"axis {name.partition('.')[0]}: " if "." in name else ""
                texts.append(axis + words.format(x * _SHOWN.get(kind, 1.0)))
        sizes = sorted(
            ((n, x) for n, x in self.changed.items() if n.rsplit(".", 1)[-1] not in _WORDS), key=lambda x: -abs(x[1])
        )
        texts += [f"{n} {100.0 * x:+.2g} %" for n, x in sizes[:_TOLD] if abs(x) >= 0.005]
        return ", ".join(texts) or "the estimate itself"


_WORDS = {
    "position": "rotor {:+.3g} µm from rest", "current": "current {:+.2g} A", "delay": "delay {:+.2f} samples",
    "eddy_s": "eddy currents {:.3g} µs", "warm_k": "coil {:+.0f} K", "speed": "{:.0f} rpm",
}  # fmt: skip
_SHOWN = {"position": 1e6, "eddy_s": 1e6, "speed": 30.0 / math.pi}  # over SI


@dataclass(frozen=True, kw_only=True, eq=False)
class Draws:
    """Plants as they were drawn."""

    plants: tuple[Drawn, ...]  # the estimate first
    rejected: int  # draws without physical sense, which were drawn again
    assumed: tuple[str, ...]  # what the draws take for granted, a line each


def draw_plants(
    plant: Plant, rig: Rig, n: int, *, seed: int, spread: Spread | None = None,
    point: Mapping[str, float] | None = None,
) -> Draws:  # fmt: skip
    """Return `n` plants, the estimate first, by the rig's magnet and limits; draw k of a seed is the same whatever `n`
    is. `point`: of rest, as an estimate's ``operating_point``, default the rig's. EstimationError if hardly any is
    physical.
    """
    spread = spread or Spread()
    at = rig.operating_point if point is None else point
    laws, assumed = laws_of(plant, rig, at)
    plants_drawn, rejected = [Drawn(plant=replace(plant, names=(), covariance=None), number=0, changed=_NONE)], 0
    for number in range(1, n):
        rng = np.random.default_rng([seed, number])
        for _ in range(_TRIES):
            drawn = _drawn(plant, rig, laws, spread, rng)
            if drawn is not None:
                break
            rejected += 1
        else:
            raise EstimationError(
                f"none of {_TRIES} plants drawn by the estimate's covariance is physical: the record does not show the "
                "numbers. Identify them from a longer or stronger record, or lower the spread of the covariance"
            )
        plants_drawn.append(replace(drawn, number=number))
    return Draws(plants=tuple(plants_drawn), rejected=rejected, assumed=assumed)


_NONE: Mapping[str, float] = MappingProxyType({})


def over_speeds(draws: Draws, speeds: Interval) -> Draws:
    """Return a rotor's plants between two speeds in rad/s: the estimate at its own, two draws at the ends.
    EstimationError where the estimate does not know what a turning rotor does.
    """
    plants = list(draws.plants[:1])
    for k, drawn in enumerate(draws.plants[1:]):
        share = k if k < 2 else (k * _GOLDEN) % 1.0
        speed, plant_model = speeds[1] - share * (speeds[1] - speeds[0]), drawn.plant.model
        assert isinstance(plant_model, RotorModel)
        turned = plant_model.at_speed(speed)
        missing = [p.name for p in turned.parameters if p.name not in drawn.plant.theta]
        if missing:
            raise EstimationError(
                f"the estimate does not know {', '.join(missing)}, which a turning rotor has. Identify it with a "
                "record at speed too, or give speeds 0:0"
            )
        plants.append(replace(
            drawn, plant=replace(drawn.plant, model=turned), changed={"speed": speed, **drawn.changed}
        ))  # fmt: skip
    return replace(draws, plants=tuple(plants))


@dataclass(frozen=True, slots=True, kw_only=True)
class Law:
    """The magnet of one axis: its law, where it rests, and the ways from there that are open."""

    energy: Energy
    rest: tuple[float, float]  # position, m, and current, A
    position: Interval  # from rest, m
    current: Interval  # from rest, A
    known: bool  # whether the rig gives the law, or its gap
    rigs: Literal["", "free", "fixed"] = ""  # of the rig's own numbers: whether they are starts of a search alone

    def numbers(self, x: float, i: float) -> Array:
        """Return k_x, k_i, L at some position and current."""
        w = self.energy
        return np.array([w.displacement_coefficient(x, i), w.force_per_current(x, i), w.inductance(x, i)])

    def holding(self, x: float) -> float:
        """Return the current with the force of rest at another position, by Newton's steps."""
        i, load = self.rest[1], self.energy.force(*self.rest)
        for _ in range(_STEPS):
            i -= (self.energy.force(x, i) - load) / self.energy.force_per_current(x, i)
        return i


def _drawn(plant: Plant, rig: Rig, laws: Mapping[str, Law], spread: Spread, rng: np.random.Generator) -> Drawn | None:
    """Return one plant; None where it is not physical."""
    theta, delays = _scattered(plant, spread.covariance, rng)
    changed: dict[str, float] = {}
    for axis, law in laws.items():
        ends = (*law.position, *law.current)
        shares = rng.uniform(-1.0, 1.0, size=2) * (spread.position, spread.current)
        way = [float(s * abs(ends[2 * k + (s > 0.0)])) for k, s in enumerate(shares)]
        x = law.rest[0] + way[0]
        ratio = law.numbers(x, law.holding(x) + way[1]) / law.numbers(*law.rest)
        if not np.all(ratio > 0.0):
            return None
        for name, factor in zip(("k_x", "k_i", "L"), ratio.tolist(), strict=True):
            if axis + name in theta:
                theta[axis + name] *= factor
        changed |= {f"{axis}{n}": x for n, x, s in zip(("position", "current"), way, shares, strict=True) if s}
    warm = float(rng.uniform(*spread.warm_k))
    coils = [name for name in theta if name.rsplit(".", 1)[-1] == "R"]
    for name in coils:
        theta[name] *= 1.0 + COPPER * warm
    changed |= {"warm_k": warm} if coils and warm else {}
    for name in theta:
        if name.startswith("mode") and name.endswith((".omega", ".zeta")):
            u = float(rng.uniform(-1.0, 1.0))
            theta[name] *= 1.0 + spread.frequency * u if name.endswith("omega") else 1.0 - spread.damping * (1 - u) / 2
    shift = float(rng.uniform(max(-spread.delay, -float(delays.min())), spread.delay))
    changed |= {"delay": shift} if shift else {}
    drawn_model, eddy_s = _lagged(plant, rig, theta, spread, rng)
    changed |= {"eddy_s": eddy_s} if eddy_s else {}
    if not all(
        math.isfinite(theta[s.name]) and (theta[s.name] > 0.0 or not s.positive) for s in drawn_model.parameters
    ):
        return None
    rates = {n: x / plant.theta[n] - 1.0 for n, x in theta.items() if n in plant.theta and plant.theta[n] != 0.0}
    if any(rates.get(n, 0.0) <= -1.0 for n in theta if n.rsplit(".", 1)[-1] in ("k_i", "k_x")):
        return None  # a sign turned round is not scatter but another plant
    drawn = replace(plant, model=drawn_model, theta=theta, delays=delays + shift, names=(), covariance=None)
    return Drawn(plant=drawn, number=-1, changed=changed | {n: x for n, x in rates.items() if x})


def _scattered(plant: Plant, factor: float, rng: np.random.Generator) -> tuple[dict[str, float], Array]:
    """Return numbers and delays drawn from the covariance, through the correlations; well-known positive numbers in
    their logarithm, so that a direction that scales all stays that.
    """
    theta, delays = dict(plant.theta), plant.delays.copy()
    if plant.covariance is None or not plant.names:
        return theta, delays
    sd = np.sqrt(np.maximum(np.diag(plant.covariance), 0.0))
    scale = np.where(sd > 0.0, sd, 1.0)
    values, vectors = np.linalg.eigh(plant.covariance / np.outer(scale, scale))
    drawn = factor * scale * (vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(sd.size)))
    positive = {s.name for s in plant.model.parameters if s.positive}
    roles = [f"{role}.delay" for role in plant.model.inputs]
    for name, step, spread in zip(plant.names, drawn.tolist(), sd.tolist(), strict=True):
        if name in roles:
            delays[roles.index(name)] = max(delays[roles.index(name)] + step, 0.0)
        elif name in theta:
            value = theta[name]
            narrow = value != 0.0 and (name in positive or spread < _NARROW * abs(value))
            theta[name] = value * math.exp(min(step / value, 50.0)) if narrow else value + step
    return theta, delays


@dataclass(frozen=True, slots=True)
class _EddyAxis(OneAxis):
    """One axis whose force follows current and position behind a pole a: p' = a (k_i i - k_x x - p)."""

    parameters: tuple[ParameterSpec, ...] = (*OneAxis().parameters, EDDY)
    states: tuple[str, ...] = ("position", "velocity", "current", "force")

    def matrices(self, theta: Mapping[str, float]) -> StateSpace:
        """Return A (4, 4), B (4, 1), E (4, 2), C (2, 4)."""
        space = OneAxis().matrices(theta)
        A, a = np.zeros((4, 4)), theta["a"]
        A[:3, :3] = space.A
        A[1] = [0.0, space.A[1, 1], 0.0, 1.0 / theta["m"]]
        A[3] = [-a * theta["k_x"], 0.0, a * theta["k_i"], -a]
        below = np.zeros((1, 2))
        return StateSpace(
            A=A, B=np.vstack([space.B, below[:, :1]]), E=np.vstack([space.E, below]),
            C=np.hstack([space.C, below.T]),
        )  # fmt: skip


def _lagged(
    plant: Plant, rig: Rig, theta: dict[str, float], spread: Spread, rng: np.random.Generator
) -> tuple[LinearModel, float]:
    """Return the model with eddy currents, their pole written into `theta`, and their further time constant in s; a
    pole that the estimate has is kept: the covariance says how it scatters.
    """
    pole = None if rig.magnet is None or not rig.magnet.eddy else rig.magnet.known("a")
    own = 1.0 / plant.rate_hz if pole is None or not pole.value else 1.0 / pole.value
    lag = float(rng.uniform(0.0, 1.0)) * spread.eddy * own
    plant_model = plant.model
    if lag == 0.0 or not isinstance(plant_model, OneAxis | RotorModel):
        return plant_model, 0.0
    if "a" in theta:
        theta["a"] = 1.0 / (1.0 / theta["a"] + lag)
        return plant_model, lag
    theta["a"] = 1.0 / lag
    return (
        replace(plant_model, extras=(*plant_model.extras, "a")) if isinstance(plant_model, RotorModel) else _EddyAxis()
    ), lag


UNKNOWN_SINGLE = "neither the rig's [magnet] nor its numbers at rest tell the law of one magnet"


_AGREES, _FAR = 0.05, 4.0  # relative difference from a law that is none, and one in standard deviations
_BALANCED = 0.3  # relative difference of force and weight, from which a point is not the law's


def _whose(magnet: RigMagnet, names: Sequence[str]) -> Literal["", "free", "fixed"]:
    """Return whether a rig gives the numbers of a magnet's law, and holds them fixed."""
    own = [magnet.known(n) for n in (*names, *(["i0"] if magnet.kind == "pair" else []))]
    if any(p is None or p.value is None for p in own):
        return ""
    return "fixed" if all(p is not None and p.role == "fixed" for p in own) else "free"


def magnet_check(laws: Mapping[str, Law], theta: Mapping[str, float], sd: Mapping[str, float] = _NONE) -> Check | None:
    """Check that k_x and k_i, with standard deviations where they are estimated, are those of the rig's [magnet]; a
    start of its search may be off. None where the rig does not give the law, or not at this point.
    """
    law = laws.get("")
    if law is None or not law.rigs:
        return None
    numbers = dict(zip(("k_x", "k_i"), law.numbers(*law.rest)[:2].tolist(), strict=True))
    weight, known = theta["m"] * GRAVITY, law.energy.force(*law.rest)
    if known and not abs(abs(known) / weight - 1.0) < _BALANCED:
        return None
    values = {n: theta[n] / x - 1.0 for n, x in numbers.items() if n in theta and x}
    far = [n for n, off in values.items() if abs(off) > max(_AGREES, _FAR * sd.get(n, 0.0) / abs(numbers[n]))]
    text = ", ".join(f"{n} = {theta[n]:.4g}, by the law {numbers[n]:.4g} ({100.0 * values[n]:+.2g} %)" for n in far)
    return Check(
        passed=not far or (bool(sd) and law.rigs == "free"), values=values,
        detail=f"the rig's [magnet] contradicts {text}: what lies away from rest is that law's. Correct its numbers, "
        "or those of [parameters]" if far else "k_x and k_i are those of the rig's [magnet]",
    )  # fmt: skip


def nominal_of(rig: Rig, theta: Mapping[str, float], at: Mapping[str, float]) -> NonlinearPlant:
    """Return the nonlinear plant of a rig's [magnet]; what the rig leaves out of one axis is what an estimate `theta`
    at the operating point `at` says: m, R and c, and of one magnet strength, length and leakage (thesis eq. 1.9, 2.7).

    With i = -2 m g/k_i, which holds the weight, g(d) = k/d has d = i k_i/k_x, k = -k_i d²/i and L_leak = L - k/d, and
    L_g exp(-d/zeta) has zeta = i k_i/(2 k_x). RigError or ModelError where numbers are missing still.
    """
    magnet = rig.magnet or RigMagnet()
    body = tuple(replace(p, value=theta[p.name]) if p.value is None and p.name in theta else p for p in rig.parameters)
    known = {p.name: p for p in magnet.parameters if p.value is not None}
    value = {name: p.value or 0.0 for name, p in known.items()}
    g, x = value.get("g", GRAVITY), at.get("position", 0.0) - value.get("x_offset", 0.0)
    found = dict[str, float]()
    k_x, k_i = theta.get("k_x", 0.0), theta.get("k_i", 0.0)
    if magnet.kind == "single" and not magnet.saturation and k_x < 0.0 and k_i:
        i = -2.0 * theta["m"] * g / k_i if g else at.get("current", 0.0)
        if magnet.gap == "exponential":
            zeta = value.get("zeta", 0.5 * i * k_i / k_x)
            found = {"zeta": zeta, "L_g": value.get("L_g", -k_i * zeta / i * math.exp(x / zeta)) if i and zeta else 0.0}
            share = found["L_g"] * math.exp(-x / zeta) if zeta else 0.0
        else:
            s = value.get("s", i * k_i / k_x - x)
            found = {"s": s, "k": value.get("k", -k_i * (s + x) ** 2 / i) if i else 0.0}
            share = found["k"] / (s + x) if s + x else 0.0
        found["L_leak"] = max(theta.get("L", share) - share, 0.0)
    numbers = tuple(Parameter(name=n, unit=_UNITS[n], value=v) for n, v in found.items() if n not in known)
    kept = tuple(p for p in magnet.parameters if p.name not in {n.name for n in numbers})
    return plant_of_rig(replace(rig, parameters=body, magnet=replace(magnet, parameters=(*kept, *numbers))))


def laws_of(plant: Plant, rig: Rig, at: Mapping[str, float]) -> tuple[dict[str, Law], tuple[str, ...]]:
    """Return the law of each axis by the prefix of its numbers, and what is assumed of it."""
    plant_model, theta = plant.model, plant.theta
    prefixes = [f"{axis}." for axis in plant_model.axes] if isinstance(plant_model, RotorModel) else [""]
    prefixes = [p for p in prefixes if f"{p}k_x" in theta and f"{p}k_i" in theta]
    travel, most = (UNLIMITED, UNLIMITED) if rig.limits is None else (rig.limits.position, rig.limits.current)
    if not isinstance(plant_model, RotorModel) and rig.magnet is not None:
        if not travel[0] < at.get("position", 0.0) < travel[1]:  # a record of deviations from rest
            at = rig.operating_point
        try:
            nominal = nominal_of(rig, theta, at)
            assert isinstance(nominal.magnet, LawMagnet)
            x, i = at.get("position", math.nan), at.get("current", math.nan)
            if not (travel[0] < x < travel[1] and most[0] < i < most[1]):  # unknown, or of deviations from rest
                rest = rest_of_rig(rig, nominal)
                x, i = rest.position, rest.current
            law = Law(
                energy=nominal.magnet.coenergy,
                rest=(x, i),
                position=_ways(x, travel),
                current=_ways(i, most),
                known=True,
                rigs=_whose(rig.magnet, nominal.magnet.law.names[:2]),
            )
            how = "" if law.rigs else ", with the numbers of the estimate"
            return {"": law}, (f"the law of the magnet is the rig's [magnet]{how}",)
        except (RigError, ModelError):  # some numbers are to be found by an identification
            if rig.magnet.kind == "single":
                return {}, (f"{UNKNOWN_SINGLE}: the plants are those of the rotor at rest",)
    if not all(map(math.isfinite, travel)):
        return {}, ("limits.position is not given: the plants are those of the rotor at rest",)
    pulled = [p for p in prefixes if theta[f"{p}k_x"] < 0.0 and theta[f"{p}k_i"] != 0.0]
    if not pulled:
        return {}, ("k_x is not negative, which no magnet's law explains: the plants are those of the rotor at rest",)
    known_gap = None if rig.magnet is None else rig.magnet.known("s")
    half = (travel[1] - travel[0]) / 2.0
    gap = known_gap.value if known_gap is not None and known_gap.value else GAP_OF_TRAVEL * half
    laws = {}
    for p in pulled:
        k_x, k_i, L = theta[f"{p}k_x"], abs(theta[f"{p}k_i"]), theta.get(f"{p}L", 0.0)
        energy = CoEnergy.opposed(k_i=k_i, k_x=k_x, L=max(L, -(k_i**2) / k_x), gap=gap)
        middle = at.get("position", 0.0) if not isinstance(plant_model, RotorModel) else 0.0
        inside = middle if travel[0] < middle < travel[1] else (travel[0] + travel[1]) / 2.0
        laws[p] = Law(
            energy=energy, rest=(0.0, 0.0), position=_ways(inside, travel),
            current=_ways(0.0, most) if all(map(math.isfinite, most)) else (-energy.i0, energy.i0),
            known=known_gap is not None and bool(known_gap.value),
        )  # fmt: skip
    whose = (
        "the rig's gap"
        if known_gap is not None and known_gap.value
        else "a gap of twice the travel inside limits.position"
    )
    return laws, (f"the law of the magnets is that of two opposed ones with {whose}, {1e6 * gap:.4g} µm",)


def _ways(rest: float, ends: Interval) -> Interval:
    """Return the ways down and up from rest that limits leave; none where there is no limit."""
    low, high = rest - ends[0], ends[1] - rest
    return (-low if math.isfinite(low) else 0.0, high if math.isfinite(high) else 0.0)
