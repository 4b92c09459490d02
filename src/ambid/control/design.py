"""What is asked of a controller, what it does on one plant and on many, and the design as a result.

It is judged on plants of `ambid.control.drawn` that the search has not seen. Figures to be small are minimised
together, the largest over the plants of each over that of the present loop, of the peak no more than zone A allows; all
are limited, by the present loop's where nothing else is said, as the peak alone is smallest without an integrator.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.prediction import discrete_to_control
from ambid.control.closed import ClosedLoop, Plant
from ambid.control.controller import controller_of_loop
from ambid.control.drawn import Drawn
from ambid.control.margins import (
    AxisMargins,
    AxisSensitivity,
    Compliance,
    compliance_by_axis,
    margins_by_axis,
    room_by_axis,
    sensitivity_by_axis,
)
from ambid.control.verification import Verification
from ambid.control.zones import ZONES, zone_of
from ambid.errors import EstimationError, ModelError, nearest
from ambid.estimation.estimate import Check, Judged
from ambid.estimation.progress import Tick, silent
from ambid.physics.law import StateLaw, beside
from ambid.physics.linear_model import LinearModel, discretise, model
from ambid.physics.loop import Loop, Noise
from ambid.physics.rotor_model import RotorModel
from ambid.rig import Rig, rig_from_text
from ambid.simulation.plant import closed_loop_matrix, fed_back

SCHEMA = "ambid.design/1"
FIGURES: Mapping[str, str] = MappingProxyType(
    {
        "peak": "", "compliance": "m/N", "noise": "V", "settling": "s",
    }
)  # fmt: skip
"""What a design is judged by, with units: peak of the sensitivity, largest displacement by a force, noise of the
sensors in the command, and the time in which a force step is settled."""
GOALS = ("peak", "compliance")
SETTLED = 0.05
"""Part of the largest deflection by a force step, below which it is settled."""
SAME = 1.005
"""Of a limit: what is as good as it."""
CIRCLE = 1e-9  # a pole no nearer to the unit circle is stable
_SPAN = 1e-4  # of the rate: the lowest frequency that is shown
FREQUENCIES = 320
"""At which many plants are looked at, beside those around their resonances."""
_LONGEST = 20.0  # time constants of the slowest pole over which a force step is looked at
_MOST = 2**17  # samples of it
_ENOUGH = 2048  # of them that tell when it is settled
_SHOWN = 400  # of it that are drawn
_TURNED = 9  # speeds at which the peak is told


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """What a loop does on one plant, each the worst of its axes."""

    peak: float  # of the sensitivity at the position signals, as a ratio
    compliance: float  # largest, m/N
    noise: float  # of the sensors in the command, V rms
    settling: float  # of a force step, s
    pole: float  # decay of the slowest pole, 1/s; negative where it grows

    @property
    def stable(self) -> bool:
        """Whether the loop holds the plant."""
        return self.pole > 0.0

    @property
    def peak_db(self) -> float:
        """Peak of the sensitivity in dB."""
        return float(20.0 * np.log10(self.peak))


UNSTABLE = Figures(peak=math.inf, compliance=math.inf, noise=math.inf, settling=math.inf, pole=-math.inf)
"""The figures of a loop that does not hold the plant."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Goals:
    """What is minimised, over which figures of reference, and what limits the others."""

    minimise: tuple[str, ...]
    reference: Mapping[str, float]
    limits: Mapping[str, float]

    @classmethod
    def of(cls, minimise: Sequence[str], limits: Mapping[str, float], before: Figures) -> Goals:
        """Return the goals of a design; no figure, goal or not, must become worse where nothing limits it."""
        if isinstance(minimise, str) or not isinstance(minimise, Sequence):
            raise ModelError(f"goals are {minimise!r}; give them as a list, such as ('peak', 'noise')")
        for name in (*minimise, *limits):
            if name not in FIGURES:
                names = f"{', '.join(FIGURES)}.{nearest(name, list(FIGURES))}"
                raise ModelError(f"figure {name!r} of a design is unknown; known: {names} Give one of them")
        if not minimise:
            raise ModelError("a design needs a goal. Give at least one of " + ", ".join(FIGURES))
        for name, x in limits.items():
            if not math.isfinite(x):
                raise ModelError(f"limit {name} is {x:g}; it must be a finite number. Correct it")
            if not x > (1.0 if name == "peak" else 0.0):
                raise ModelError(f"limit {name} is {x:g} {FIGURES[name]}; no loop is that good. Raise it")
        present = {name: getattr(before, name) for name in FIGURES}
        return cls(
            minimise=tuple(minimise), reference={**present, "peak": min(before.peak, ZONES[0][0])},
            limits={**present, **limits},
        )  # fmt: skip

    def missed(self, worst: Figures) -> tuple[str, ...]:
        """Return the limits that figures pass."""
        return tuple(name for name, x in self.limits.items() if getattr(worst, name) > SAME * x)

    def closer(self, goals: Goals, worst: Figures) -> Goals | None:
        """Return what to ask for, where `goals` led to figures that pass these limits; None where they do not."""
        beyond = {name: getattr(worst, name) / self.limits[name] for name in self.missed(worst)}
        if not beyond or not all(map(math.isfinite, beyond.values())):
            return None
        return replace(
            goals, limits={n: x / (beyond[n] * SAME if n in beyond else 1.0) for n, x in goals.limits.items()}
        )


def on(loop: Loop, plant: Plant) -> Loop:
    """Return a loop with the delay of a plant."""
    return replace(loop, delay=float(np.max(plant.delays)))


def closed_loop_of(plant: Plant, loop: Loop, frequency_hz: Array | None = None) -> ClosedLoop:
    """Return the closed loop of a plant and a rig's [loop]; default: at frequencies close where something happens."""
    controller = controller_of_loop(loop, plant.model, plant.rate_hz)
    if frequency_hz is None:
        return ClosedLoop.of(plant, controller)
    return ClosedLoop(plant=plant, controller=controller, frequency_hz=frequency_hz)


def noise_of(noise: Noise | None, sensor_sd: Mapping[str, float]) -> tuple[float, float, str]:
    """Return the noise of position and current, m and A rms, with what is assumed of it: the rig's, else the estimated
    `sensor_sd`.
    """
    values = [(noise or Noise()).sensor_rms(kind) for kind in ("position", "current")]
    if any(values):
        return values[0], values[1], "the noise of the sensors is the rig's [noise]"
    sds = [[x for name, x in sensor_sd.items() if name.endswith(kind)] for kind in ("position", "current")]
    if any(map(any, sds)):
        return max(sds[0], default=0.0), max(sds[1], default=0.0), "the noise of the sensors is as estimated"
    return 1e-6, 0.0, "nothing says how noisy the sensors are: 1 µm rms is taken"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Examined:
    """A loop on one plant: its figures, and the moduli of its curves by axis; none where the plant is not held."""

    figures: Figures
    frequency_hz: Array = field(default_factory=lambda: np.empty(0))
    sensitivity: Array = field(default_factory=lambda: np.empty((0, 0)))  # (n, n_axes)
    compliance: Array = field(default_factory=lambda: np.empty((0, 0)))


def examine(plant: Plant, loop: Loop, noise: tuple[float, float]) -> Examined:
    """Say what a loop does on a plant, by its poles, responses around them, and a force step."""
    z = closed_loop_matrix(plant.theta, on(loop, plant), plant.rate_hz, of=plant.model)
    if not np.isfinite(z).all():
        return Examined(figures=UNSTABLE)
    if loop.law is None and loop.ki == 0.0:  # an integral that nothing feeds
        count = len(plant.model.inputs)
        keep = np.r_[: z.shape[0] - 3 * count, z.shape[0] - 2 * count : z.shape[0]]
        z = z[np.ix_(keep, keep)]
    poles = np.linalg.eigvals(z)
    largest = float(np.max(np.abs(poles)))
    if largest > 1.0 - CIRCLE:
        return Examined(figures=UNSTABLE)
    f, own = plant.grid(FREQUENCIES), np.abs(np.angle(poles)) * plant.rate_hz / (2.0 * np.pi)
    loop_at = closed_loop_of(plant, loop, np.union1d(f, own[(own > f[0]) & (own < f[-1])]))
    pole = -math.log(max(largest, 1e-300)) * plant.rate_hz
    S, G = np.abs(loop_at.of_axes), np.abs(loop_at.compliance)
    figures = Figures(
        peak=float(np.max(S)), compliance=float(np.max(G)), noise=float(np.max(noise_in_command(loop_at, noise))),
        settling=settling_of(plant, z, pole)[0], pole=pole,
    )  # fmt: skip
    return Examined(figures=figures, frequency_hz=loop_at.frequency_hz, sensitivity=S, compliance=G)


def mean_over(frequency_hz: Array, power: Array) -> Array:
    """Return the mean of a power over all frequencies up to half the rate, along the first axis (trapezoidal rule)."""
    f = np.concatenate([[0.0], frequency_hz])
    padded = np.concatenate([power[:1], power])
    return np.asarray(np.trapezoid(padded, f, axis=0) / f[-1])


def noise_in_command(loop: ClosedLoop, noise: tuple[float, float]) -> Array:
    """Return the rms of each command by white noise of the sensors, (n_u,)."""
    sd = np.where(np.isin(np.arange(loop.H.shape[1]), loop.positions), *noise)
    answer = loop.answers[:, :, -loop.H.shape[1] :]
    return np.asarray(np.sqrt(mean_over(loop.frequency_hz, np.sum(np.abs(answer * sd) ** 2, axis=2))))


def force_step(plant: Plant, z: Array, n: int, doublings: int = 0) -> Array:
    """Return positions (n, n_axes), m, after a step of 1 N on each axis in turn; `z`: matrix of the closed loop.
    Samples by doubling, x[k + m] = z^m x[k] + x[m]; of each 2^`doublings` the last.
    """
    whole = float(np.max(plant.delays))
    d, _ = discretise(plant.space, 1.0 / plant.rate_hz, fraction=whole - math.floor(whole))
    axes, first = len(plant.axes), [group[0] for group in plant.sensors]
    pushed = np.zeros((z.shape[0], axes))
    pushed[: d.A.shape[0]] = d.E[:, :axes]
    power = z
    for _ in range(doublings):
        pushed, power = power @ pushed + pushed, power @ power
    states = pushed[:, None]  # (n_states, n, n_axes)
    while states.shape[1] < n:
        more = (power @ states.reshape(z.shape[0], -1)).reshape(states.shape) + states[:, -1:]
        states, power = np.concatenate([states, more], axis=1), power @ power
    return np.asarray(np.einsum("ij,jki->ki", d.C[first], states[: d.A.shape[0], :n]))


def settling_of(plant: Plant, z: Array, pole: float) -> tuple[float, Array, Array]:
    """Return when the deflection by a force step last leaves `SETTLED` of its largest; times in s, and deflections."""
    n = int(min(max(_LONGEST / pole * plant.rate_hz, 64.0), _MOST))
    doublings = max(int(math.log2(n / _ENOUGH)), 0)
    n, every = n >> doublings, 2**doublings
    x = force_step(plant, z, n, doublings)
    final = x[-1]
    off = np.abs(x - final)
    last = [int(np.flatnonzero(o > SETTLED * max(o.max(), 1e-300))[-1]) + 2 if o.max() else 0 for o in off.T]
    return every * max(last) / plant.rate_hz, every * np.arange(1, n + 1) / plant.rate_hz, x


def worst_of(figures: Sequence[Figures]) -> Figures:
    """Return the worst of each figure over the plants that are held; `UNSTABLE` where none is."""
    stable = [f for f in figures if f.stable]
    if not stable:
        return UNSTABLE
    worst = {name: max(getattr(f, name) for f in stable) for name in FIGURES}
    return Figures(**worst, pole=min(f.pole for f in stable))


def verify(
    plants: Sequence[Drawn], loop: Loop, noise: tuple[float, float], tick: Tick = silent
) -> tuple[Examined, ...]:
    """Examine a loop on each plant, in their order."""
    examined = []
    for k, drawn in enumerate(plants):
        tick("verify", k / len(plants))
        examined.append(examine(drawn.plant, loop, noise))
    return tuple(examined)


@dataclass(frozen=True, slots=True, kw_only=True)
class Situation:
    """A loop, on the estimate and on the plants that judge."""

    loop: Mapping[str, object]  # gains, or matrices, as [loop] has them
    figures: Figures  # on the estimate
    worst: Figures  # the worst of each over the plants that are held
    unstable: int  # plants that are not held
    singular: float  # largest singular value of the sensitivity of all axes together on the estimate, as a ratio
    sensitivity: Mapping[str, AxisSensitivity]
    margins: Mapping[str, AxisMargins]
    compliance: Mapping[str, Compliance]
    # rms by axis of position, current and command on the estimate, m, A and V, by disturbances as well as the noise of
    # the sensors; empty where nothing is known of them
    rms: Mapping[str, Mapping[str, float]] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True, slots=True, kw_only=True)
class WorstPlant:
    """The plant with the highest peak of the sensitivity in the new loop."""

    number: int  # of its draw
    words: str  # what was changed
    changed: Mapping[str, float]
    peak_db: float
    zone: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopCurves:
    """What is drawn of one loop, by axis."""

    frequency_hz: Array  # (n,)
    sensitivity: Mapping[str, Array]  # modulus on the estimate, (n,)
    highest: Mapping[str, Array]  # over the drawn plants
    compliance: Mapping[str, Array]  # modulus on the estimate, m/N
    softest: Mapping[str, Array]  # over the drawn plants
    time_s: Array  # (n_samples,)
    step: Mapping[str, Array]  # deflection of the estimate by a force step of 1 N, m


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OverSpeed:
    """The highest peak of the sensitivity over some of the plants that judge, by the speed of the rotor."""

    speed: Array  # (n,), rad/s
    # "before" and "after", (n,), as a ratio, infinite where one of the plants is not held
    peak: Mapping[str, Array]

    @classmethod
    def of(cls, plants: Sequence[Plant], loops: Mapping[str, Loop], speeds: tuple[float, float]) -> OverSpeed:
        """Return the curve of loops over speeds in rad/s."""
        at = np.linspace(*speeds, _TURNED)

        def peaks(loop: Loop) -> Array:
            turned = [[replace(p, model=_turning(p.model, w)) for p in plants] for w in at.tolist()]
            return np.array([max(examine(p, loop, (0.0, 0.0)).figures.peak for p in each) for each in turned])

        return cls(speed=at, peak={name: peaks(loop) for name, loop in loops.items()})


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Design(Judged):
    """A controller, designed on an estimate and verified on plants around it.

    Attributes
    ----------
    status : {"converged", "stalled", "failed"}
        Of the estimate that the plant comes from.
    model : str
    method : str
        "pid": the present structure, tuned.
    record : Mapping[str, object]
        That the estimate comes from.
    goals : Goals
    before, after : Situation
    worst_plant : WorstPlant
    rate_hz : float
        Of the controller.
    plants : Mapping[str, object]
        ``tuning`` and ``verification``: how many plants; ``rejected``: draws without physical sense; ``seeds``;
        ``assumed``: what the draws take for granted.
    checks : Mapping[str, Check]
    curves : Mapping[str, LoopCurves]
        ``before`` and ``after``.
    over_speed : OverSpeed, optional
        Of a rotor that turns.
    trials : Mapping[str, tuple of Verification]
        ``before`` and ``after``: nonlinear simulation on the estimate, then on the worst plants.
    warnings : tuple of str
    timing_s : Mapping[str, float]
    rig : Mapping[str, object]
        With the new [loop].
    """

    status: Literal["converged", "stalled", "failed"]
    model: str
    method: str
    record: Mapping[str, object]
    goals: Goals
    before: Situation
    after: Situation
    worst_plant: WorstPlant
    rate_hz: float
    plants: Mapping[str, object]
    checks: Mapping[str, Check]
    curves: Mapping[str, LoopCurves]
    over_speed: OverSpeed | None = None
    trials: Mapping[str, tuple[Verification, ...]] = field(default_factory=lambda: MappingProxyType({}))
    warnings: tuple[str, ...] = ()
    timing_s: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    rig: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def new_rig(self) -> Rig:
        """The rig with the new [loop], as ``-o`` writes it."""
        return rig_from_text(str(self.rig["text"]), Path(str(self.rig["folder"])) / "rig.toml")

    @property
    def loop(self) -> Loop:
        """The new loop."""
        loop = self.new_rig.loop
        assert loop is not None
        return loop

    def to_control(self) -> Any:
        """Return the new controller as a discrete-time control.StateSpace; needs the extra ``ambid[control]``.

        SI units, from what is fed back (position and current of each axis) to the commands, the sign included.
        """
        law = self.law
        return discrete_to_control(law.A, law.B, law.C, law.D, 1.0 / law.rate_hz)

    @property
    def law(self) -> StateLaw:
        """The new loop as a law of all axes."""
        plant_model = self._model
        axes, pairs = len(plant_model.inputs), fed_back(plant_model)
        if self.loop.law is not None:
            return self.loop.law
        return beside([self.loop.as_law(self.rate_hz, current=bool(pairs[j, 1] >= 0)) for j in range(axes)])

    @property
    def _model(self) -> LinearModel:
        rotor = self.new_rig.rotor
        return model(self.model) if rotor is None else rotor


def _turning(plant_model: LinearModel, speed: float) -> LinearModel:
    assert isinstance(plant_model, RotorModel)
    return plant_model.at_speed(speed)


def situation_of(
    examined: Sequence[Examined], estimate: Plant, loop: Loop, noise: Mapping[str, float] | None
) -> Situation:
    """Return what there is to say of a loop; `estimate`: with its covariance; `noise`: as `room_by_axis` takes it."""
    closed = closed_loop_of(estimate, loop)
    rooms = {} if noise is None else room_by_axis(closed, noise, defaultdict(lambda: None), None)
    return Situation(
        loop=loop_entry(loop), figures=examined[0].figures, worst=worst_of([x.figures for x in examined]),
        unstable=sum(not x.figures.stable for x in examined), sensitivity=sensitivity_by_axis(closed),
        singular=float(np.max(closed.singular)),
        margins=margins_by_axis(closed), compliance=compliance_by_axis(closed),
        rms={axis: {q: d.rms for q, d in x.quantities.items() if d.rms is not None} for axis, x in rooms.items()},
    )  # fmt: skip


def curves_of(examined: Sequence[Examined], estimate: Plant, loop: Loop, until_s: float) -> LoopCurves:
    """Return the curves of a loop on the plants, and its force step up to a time."""
    f, axes = np.geomspace(_SPAN * estimate.rate_hz, 0.499 * estimate.rate_hz, FREQUENCIES), estimate.axes

    def over(curve: str, plants: Sequence[Examined]) -> Mapping[str, Array]:
        stable = [x for x in plants if x.figures.stable]
        curves = [[np.interp(f, x.frequency_hz, y) for y in getattr(x, curve).T] for x in stable]
        return dict(zip(axes, np.max(curves, axis=0), strict=True)) if stable else {}

    z = closed_loop_matrix(estimate.theta, on(loop, estimate), estimate.rate_hz, of=estimate.model)
    n = min(max(int(until_s * estimate.rate_hz), 16), _MOST)
    x = force_step(estimate, z, n)
    places = np.unique(np.geomspace(1, n, _SHOWN).round().astype(int)) - 1
    return LoopCurves(
        frequency_hz=f, sensitivity=over("sensitivity", examined[:1]), highest=over("sensitivity", examined),
        compliance=over("compliance", examined[:1]), softest=over("compliance", examined),
        time_s=(places + 1) / estimate.rate_hz, step=dict(zip(axes, x[places].T, strict=True)),
    )  # fmt: skip


def loop_entry(loop: Loop) -> dict[str, object]:
    """Return a loop as a result keeps it: JSON numbers only."""
    if loop.law is not None:
        return {
            "kind": "state-space",
            "rate_hz": loop.law.rate_hz,
            **{n: getattr(loop.law, n).tolist() for n in "ABCDG"},
        }
    cutoff = loop.derivative_cutoff_hz if math.isfinite(loop.derivative_cutoff_hz) else None
    gains = {name: getattr(loop, name) for name in ("kp", "ki", "kd", "kc")}
    return {"kind": "pid", **gains, "derivative_cutoff_hz": cutoff, "delay": loop.delay}


def hardest(plants: Sequence[Drawn], examined: Sequence[Examined]) -> dict[str, Plant]:
    """Return the estimate, and the plant with the highest peak; of one axis also the softest and the slowest one."""
    figures, names = [x.figures for x in examined], ("peak", "compliance", "settling")
    worst = {
        int(np.argmax([getattr(f, name) for f in figures]))
        for name in names[: 1 if len(plants[0].plant.axes) > 1 else 3]
    }
    return {
        "the estimate": plants[0].plant,
        **{f"draw {plants[k].number}": plants[k].plant for k in sorted(worst - {0})},
    }


def worst_plant(plants: Sequence[Drawn], examined: Sequence[Examined]) -> WorstPlant:
    """Return the plant with the highest peak, or the first that is not held."""
    k = int(np.argmax([x.figures.peak for x in examined]))
    drawn, peak_db = plants[k], examined[k].figures.peak_db
    return WorstPlant(
        number=drawn.number, words=drawn.words(), changed=drawn.changed, zone=zone_of(peak_db), peak_db=peak_db
    )


def checks_of(goals: Goals, before: Situation, after: Situation, worst: WorstPlant, n: int) -> dict[str, Check]:
    """Judge stability, limits and zone of the new loop over the plants, and whether it is better at all."""
    missed = goals.missed(after.worst)
    text = f"{n - after.unstable} of {n} plants drawn around the estimate are held"
    gains = [getattr(after.worst, g) < getattr(before.worst, g) for g in goals.minimise] or [True]
    return {
        "stability": Check(
            passed=after.unstable == 0, values={"unstable": after.unstable, "plants": n},
            detail=text if not after.unstable else f"only {text}; the worst: {worst.words}. Lower the spread, or "
            "give up some goals",
        ),
        "limits": Check(
            passed=not missed,
            detail="the limits are met on all plants" if not missed else
            f"over the plants that judge, {', '.join(missed)} is beyond its limit. Raise it, or tune over more plants",
        ),
        "zone": Check(
            passed=worst.zone in "AB", values={"peak_db": worst.peak_db},
            detail=f"the largest sensitivity of all plants is {worst.peak_db:.1f} dB, zone {worst.zone} of ISO 14839-3",
        ),
        "improvement": Check(
            passed=any(gains), detail="the new loop is better than the present one" if any(gains) else
            f"the new loop is no better in {', '.join(goals.minimise)} than the present one. Keep that",
        ),
    }  # fmt: skip


def refuse_unheld(figures: Figures, what: str) -> None:
    """Refuse a present loop that does not hold the estimate: nothing can be compared with it."""
    if not figures.stable:
        raise EstimationError(
            f"the rig's [loop] does not hold {what}; a design is compared with the present loop. Correct [loop]"
        )
