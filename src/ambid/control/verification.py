"""A loop tried on the nonlinear simulator: lift-off, force step, impact, unbalance, and noise, in that case alone, so
that loops can be compared number by number. Limits of the command, quantisation and delay act as on the bench. Orbits
are judged by ISO 14839-2, whose zone B ends at 0.4 of the clearance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.control.benches import Answer, Workbench, integrates, slowest_pole, workbench
from ambid.control.closed import Plant
from ambid.errors import ModelError
from ambid.estimation.estimate import Check
from ambid.estimation.progress import Tick, silent
from ambid.physics.loop import Loop
from ambid.physics.rotor_model import RotorModel
from ambid.rig.rig import Rig
from ambid.simulation.plant import closed_loop_poles
from ambid.simulation.scenarios import GRADE, TOP_SPEED

KINDS = ("lift-off", "force step", "impact", "unbalance", "noise", "limit cycle")
"""What is tried, in the order in which it is told."""

ORBIT = 0.4
"""Largest orbit over the clearance for operation without limit of time: the end of zone B of ISO 14839-2."""

_STEP = 0.1  # force step over what an axis can hold
_IMPACT_S = 0.5e-3  # for which an impact has all that an axis can hold
_SETTLED = 0.02  # of the peak
_LIFTED = 0.05  # of the way from the stop: away from it, and at rest
_AT_STOP = 1e-3  # of the clearance: nearer is contact
_CYCLE = 0.05  # largest limit cycle over the clearance
_LONGEST = {True: 12_000, False: 60_000}  # samples of a case, of a rotor and of one axis
_RUN_UP_S = 1.5
_SPEEDS = 10
_FASTEST = 0.1  # of the rate: highest frequency of rotation that is tried
_POINTS = 250  # of a trace
_RPM = 30.0 / math.pi


@dataclass(frozen=True, slots=True, kw_only=True)
class Trials:
    """How hard a loop is tried; what is None follows from the plant and the rig."""

    # N, of the step, of all axes or of each; default a tenth of what the limits let the axis hold
    force: float | tuple[float, ...] | None = None
    # N s, of the impact; default all that the axis can hold, for half a millisecond
    impulse: float | tuple[float, ...] | None = None
    # kg m; default that of the rig, else balance quality G 2.5 (ISO 21940-11) at the highest speed
    unbalance: float | None = None
    speed: float | None = None  # highest, rad/s; default the rotor's own, else 15 000 rpm


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trace:
    """What is drawn of a case, thinned: of the axis that moved most."""

    over: str  # "time", s, or "speed", rad/s: then the largest values at that speed
    at: Array  # (n,)
    position: Array  # from rest, m
    current: Array
    command: Array

    def __post_init__(self) -> None:
        for name in ("at", "position", "current", "command"):  # four digits are more than a figure shows
            x = getattr(self, name)
            size = float(np.abs(x).max(initial=0.0))
            object.__setattr__(self, name, np.round(x, 4 - math.floor(math.log10(size))) if size else x)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Case:
    """One thing that was done to a loop, and what came of it."""

    kind: str  # of `KINDS`
    name: str  # with the axis or the stop
    passed: bool
    detail: str
    size: float | None = None  # of what was done, in `unit`
    unit: str = ""
    peak: float | None = None  # largest distance from rest, m; of a lift-off beyond it; None: it broke off
    settling_s: float | None = None  # None: not settled
    steady: float | None = None  # distance from rest in the end, m; of noise and limit cycles their rms
    contact: bool = False  # of a lift-off: after it left the stop
    saturated: float = 0.0  # share of samples with a limited command
    peak_current: float | None = None
    peak_command: float | None = None
    over_current: float = 0.0  # share of samples with a current beyond its limits
    rms: tuple[float, float, float] | None = None  # of noise: position, m, current, A, command, V; the largest axis
    trace: Trace | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Verification:
    """What a loop did on one plant."""

    plant: str  # which one
    clearance: float | None  # way from rest to the nearer stop, m; None where the rig gives no stop
    cases: tuple[Case, ...]
    assumed: tuple[str, ...] = ()  # what the simulation takes for granted

    @property
    def passed(self) -> bool:
        """Whether no case failed."""
        return all(case.passed for case in self.cases)

    def of_kind(self, kind: str) -> tuple[Case, ...]:
        """Return the cases of a kind."""
        return tuple(case for case in self.cases if case.kind == kind)


def verify(
    plant: Plant, rig: Rig, loop: Loop, *, name: str = "the estimate", trials: Trials | None = None,
    nonlinear: bool = True,
) -> Verification:  # fmt: skip
    """Try a loop on a plant, the nonlinear one that linearises to it unless told otherwise, its delay in place of the
    loop's; `rig`: limits, noise, resolutions, point of rest and magnet.
    """
    bench, todo = workbench(plant, rig, loop, nonlinear=nonlinear), trials or Trials()
    trying = _Trying(bench=bench, trials=todo)
    cases = [*trying.lift_off(), *trying.force_steps(), *trying.impacts(), *trying.unbalance()]
    cases += [*trying.noise(), *trying.limit_cycle]
    return Verification(
        plant=name,
        clearance=trying.clearance if math.isfinite(trying.clearance) else None,
        cases=tuple(cases),
        assumed=(*bench.assumed, trying.assumed),
    )


def verify_all(plants: Mapping[str, Plant], rig: Rig, loop: Loop, *, tick: Tick = silent) -> tuple[Verification, ...]:
    """Try a loop on plants by name, the estimate first: all are pushed as it is, and only its traces are kept."""
    todo, results = Trials(), list[Verification]()
    for k, (name, plant) in enumerate(plants.items()):
        tick("nonlinear simulation", k / len(plants))
        if not k:
            first = _Trying(bench=workbench(plant, rig, loop), trials=todo)
            todo = replace(
                todo, force=tuple(first.sizes(todo.force, _STEP)),
                impulse=tuple(first.sizes(todo.impulse, _IMPACT_S)), speed=first.speed,
                unbalance=first.moment if "m" in plant.theta else None,
            )  # fmt: skip
        found = verify(plant, rig, loop, name=name, trials=todo)
        plain = found.cases if not k else tuple(replace(case, trace=None) for case in found.cases)
        results.append(replace(found, cases=plain))
    return tuple(results)


def checks_of_verifications(verifications: Sequence[Verification]) -> dict[str, Check]:
    """Return a check for each kind of case over all plants, which says what failed and where."""
    checks: dict[str, Check] = {}
    for kind in KINDS:
        cases = [(v, case) for v in verifications for case in v.of_kind(kind)]
        failed = [f"{case.name} on {v.plant}: {case.detail}" for v, case in cases if not case.passed]
        if not cases:
            continue
        v, worst = max(cases, key=lambda x: _share(x[1], x[0]))
        checks[kind.replace(" ", "_").replace("-", "_")] = Check(
            passed=not failed, values={"cases": float(len(cases)), "failed": float(len(failed))},
            detail="; ".join(failed[:3]) + (f"; and {len(failed) - 3} more" if len(failed) > 3 else "") if failed else
            f"{worst.name} on {v.plant}: {worst.detail}",
        )  # fmt: skip
    return checks


def _share(case: Case, verification: Verification) -> float:
    return math.inf if case.peak is None else case.peak / (verification.clearance or 1.0)


def _length(x: float) -> str:
    return f"{1e3 * x:.3g} mm" if abs(x) >= 1e-3 else f"{1e6 * x:.3g} µm"


def _time(x: float) -> str:
    return f"{x:.3g} s" if x >= 1.0 else f"{1e3 * x:.3g} ms"


@dataclass(frozen=True, kw_only=True)
class _Trying:
    """A loop that is tried."""

    bench: Workbench
    trials: Trials

    # --- what the cases share -----------------------------------------------------------------------------------------

    @property
    def rate_hz(self) -> float:
        return self.bench.plant.rate_hz

    @property
    def axes(self) -> tuple[str, ...]:
        return self.bench.plant.axes

    @property
    def clearance(self) -> float:
        return min(map(abs, self.bench.stops))

    @property
    def many(self) -> bool:
        return len(self.axes) > 1

    @cached_property
    def samples(self) -> int:
        """Of a case in which the slowest pole dies out."""
        slow = slowest_pole(self.bench)
        most = _LONGEST[self.many]
        return most if not math.isfinite(slow) else min(max(round(8.0 * slow * self.rate_hz), 400), most)

    @property
    def speed(self) -> float:
        speed = self.trials.speed if self.trials.speed is not None else self.bench.top_speed or TOP_SPEED
        return min(speed, 2.0 * math.pi * _FASTEST * self.rate_hz)

    @property
    def moment(self) -> float:
        return self.own_moment if self.trials.unbalance is None else self.trials.unbalance

    @property
    def own_moment(self) -> float:
        """Unbalance unless told otherwise, kg m."""
        return self.bench.moment or self.bench.plant.theta["m"] * GRADE / self.speed

    @property
    def assumed(self) -> str:
        """Say how the rotor is out of balance."""
        if "m" not in self.bench.plant.theta:
            return "the model has no mass: no unbalance is tried"
        whose = "as the rig says" if self.bench.moment else f"G {1e3 * GRADE:g} of ISO 21940-11 there"
        if self.moment != self.own_moment:
            whose = "as asked for"
        planes = " in the planes of the bearings" if self.many else ""
        return f"an unbalance of {1e6 * self.moment:.3g} g mm{planes} at up to {self.speed * _RPM:.0f} rpm, {whose}"

    def touching(self, position: Array) -> NDArray[np.bool_]:
        """Return in which samples each axis lies on a stop."""
        low, high = self.bench.stops
        if not math.isfinite(self.clearance):
            return np.zeros(position.shape, dtype=np.bool_)
        slack = _AT_STOP * self.clearance
        return np.asarray((position <= low + slack) | (position >= high - slack))

    def case(self, kind: str, name: str, answer: Answer, text: str, *, trace: Trace, **more: Any) -> Case:
        """Return a case with what is told of every one."""
        n = answer.position.shape[0]
        values: dict[str, Any] = {
            "contact": bool(self.touching(answer.position).any()),
            "peak": float(np.abs(answer.position).max()),
        } | more
        texts = [text]
        if values["contact"]:
            texts.append("it touches a stop again" if kind == KINDS[0] else "it touches a stop")
        if answer.limited:
            texts.append(f"the command is limited in {100.0 * answer.limited / n:.2g} % of the samples")
        if answer.over:
            texts.append(f"the current is beyond its limits in {100.0 * answer.over / n:.2g} %")
        return Case(
            kind=kind,
            name=name,
            detail=", ".join(texts),
            saturated=answer.limited / n,
            over_current=answer.over / n,
            peak_current=float(np.abs(answer.current).max(initial=0.0)),
            peak_command=float(np.abs(answer.command).max()),
            trace=trace,
            **values,
        )  # fmt: skip

    def traced(self, answer: Answer, axis: int) -> Trace:
        """Return the trace of an axis over time."""
        n = answer.position.shape[0]
        places = np.unique(((n - 1) * np.linspace(0.0, 1.0, _POINTS) ** 2).round().astype(int))  # closer at first
        places = np.union1d(places, np.argmax(np.abs(answer.position[:, axis])))
        coil = min(axis, answer.current.shape[1] - 1)
        return Trace(
            over="time", at=places / self.rate_hz, position=answer.position[places, axis],
            command=answer.command[places, axis],
            current=answer.current[places, coil] if coil >= 0 else np.zeros(places.size),
        )  # fmt: skip

    def broken(self, kind: str, name: str, problem: ModelError) -> Case:
        return Case(kind=kind, name=name, passed=False, detail=str(problem))

    def settled(self, position: Array, band: float) -> float | None:
        """Return when all axes stay within a band, s; None: not before the last tenth."""
        outside = np.flatnonzero((np.abs(position) > band).any(axis=1))
        last = int(outside[-1]) + 1 if outside.size else 0
        return None if last > 0.9 * position.shape[0] else last / self.rate_hz

    @cached_property
    def resolution(self) -> float:
        """Motion below which a quantised controller leaves the rotor, m."""
        cycle = max((case.peak or 0.0 for case in self.limit_cycle), default=0.0)
        return 2.0 * max(self.bench.noise.position_resolution, cycle)

    # --- the cases ----------------------------------------------------------------------------------------------------

    def lift_off(self) -> list[Case]:
        """Begin on each stop, without current: of a rotor its vertical and its axial axes."""
        plant_model, cases = self.bench.plant.model, []
        lying = np.ones(len(self.axes))
        if isinstance(plant_model, RotorModel) and {0, 1} <= set(plant_model.planes):
            lying = np.array([float(plane != 0) for _, plane in plant_model.placed])
        for side, stop in zip(("lower", "upper"), self.bench.stops, strict=True):
            name = f"lift-off from the {side} stop"
            if not math.isfinite(stop):
                continue
            try:
                answer = self.bench.respond(self.samples, start=stop * lying, speed=0.0)
            except ModelError as problem:
                cases.append(self.broken("lift-off", name, problem))
                continue
            cases.append(self.lifted(name, answer, stop, lying))
        return cases

    def lifted(self, name: str, answer: Answer, stop: float, lying: Array) -> Case:
        away = (np.abs(answer.position[:, lying > 0.0]) < (1.0 - _LIFTED) * abs(stop)).all(axis=1)
        left = int(np.argmax(away)) if away.any() else None  # what it does before, on the stop, is no contact
        settling = self.settled(answer.position, max(_LIFTED * abs(stop), self.resolution))
        again = left is not None and bool(self.touching(answer.position)[left:].any())
        beyond = float((-np.sign(stop) * answer.position[:, lying > 0.0]).max())
        text = (
            "the rotor stays on the stop" if left is None else
            f"the rotor levitates after {_time(settling)}, {100.0 * beyond / abs(stop):.0f} % beyond rest"
            if settling is not None else f"it does not come to rest in {_time(answer.position.shape[0] / self.rate_hz)}"
        )  # fmt: skip
        return self.case(
            "lift-off", name, answer, text, trace=self.traced(answer, int(np.argmax(lying))), size=stop, unit="m",
            peak=max(beyond, 0.0), settling_s=settling, steady=self._end(answer), contact=again,
            passed=settling is not None and not again,
        )  # fmt: skip

    def _end(self, answer: Answer) -> float:
        last = answer.position[-max(answer.position.shape[0] // 10, 1) :]
        return float(np.abs(last.mean(axis=0)).max())

    def force_steps(self) -> list[Case]:
        """Push each axis with a force that stays."""
        return [
            self._pushed("force step", j, size, np.ones(self.samples), "N")
            for j, size in enumerate(self.sizes(self.trials.force, _STEP))
        ]

    def impacts(self) -> list[Case]:
        """Push each axis for a sample."""
        shape = np.zeros(self.samples)
        shape[0] = self.rate_hz
        return [
            self._pushed("impact", j, size, shape, "N s")
            for j, size in enumerate(self.sizes(self.trials.impulse, _IMPACT_S))
        ]

    def sizes(self, sizes: float | tuple[float, ...] | None, share: float) -> list[float]:
        room = share * self.bench.room if sizes is None else np.broadcast_to(sizes, len(self.axes))
        return [float(x) for x in room]

    def _pushed(self, kind: str, j: int, size: float, shape: Array, unit: str) -> Case:
        name = f"{kind} on axis {self.axes[j]}" if self.many else kind
        load = np.zeros((shape.size, len(self.axes)))
        load[:, j] = size * shape
        try:
            answer = self.bench.respond(shape.size, load=load)
        except ModelError as problem:
            return self.broken(kind, name, problem)
        peak = float(np.abs(answer.position).max())
        band = max(_SETTLED * peak, self.resolution)
        steady, contact = self._end(answer), bool(self.touching(answer.position).any())
        stays = kind == "force step" and not integrates(self.bench.loop)
        moved = answer.position - answer.position[-1] if stays else answer.position
        settling = self.settled(moved, band)
        text = f"{size:.3g} {unit} move it by {_length(peak)}"
        text += ", it does not come to rest" if settling is None else f", at rest after {_time(settling)}"
        if stays or steady > band:
            text += f", {_length(steady)} away"
        good = not contact and settling is not None and (stays or steady <= band)
        return self.case(
            kind, name, answer, text, trace=self.traced(answer, j), size=size, unit=unit, settling_s=settling,
            steady=steady, passed=good,
        )  # fmt: skip

    def unbalance(self) -> list[Case]:
        """Turn the rotor up to its highest speed."""
        if "m" not in self.bench.plant.theta:
            return []
        try:
            return [self._run_up()] if not self.many else self._speeds()
        except ModelError as problem:
            return [self.broken("unbalance", "unbalance", problem)]

    def _run_up(self) -> Case:
        """Turn ever faster: m e W² cos of the integrated speed W."""
        rate = self.rate_hz
        n = round(_RUN_UP_S * rate)
        t = (np.arange(n) + 0.5) / rate
        speed = self.speed * t * rate / n
        load = self.moment * speed**2 * np.cos(0.5 * speed * t)
        answer = self.bench.respond(n, load=load[:, None])
        edges = np.linspace(0, n, _POINTS // 2 + 1).round().astype(int)[:-1]
        most = [np.maximum.reduceat(np.abs(x[:, 0]), edges) for x in answer[:3]]
        return self._orbit(answer, float(speed[np.argmax(np.abs(answer.position[:, 0]))]), "run-up", speed[edges], most)

    def _speeds(self) -> list[Case]:
        """Turn steadily at many speeds, on the linear plant; then at the worst one and the highest with all magnets."""
        cases: list[Case] = []
        speeds = self._looked_at()
        for kind, weights in self._shares().items():
            linear = [self._turned(w, weights, linear=True) for w in speeds]
            sizes = np.array([np.abs(x.position).max() for x in linear])
            worst = int(np.argmax(sizes))
            answers = {k: self._turned(speeds[k], weights, linear=False) for k in {worst, len(speeds) - 1}}
            most = [np.array([np.abs(x[q]).max() for x in linear]) for q in range(3)]
            for k, answer in answers.items():
                for q in range(3):
                    most[q][k] = np.abs(answer[q]).max()
            at = max(answers, key=lambda k: np.abs(answers[k].position).max())
            cases.append(self._orbit(answers[at], speeds[at], f"{kind} unbalance", np.array(speeds), most))
        return cases

    def _orbit(self, answer: Answer, speed: float, name: str, at: Array, most: Sequence[Array]) -> Case:
        peak = float(np.abs(answer.position).max())
        share = peak / self.clearance if math.isfinite(self.clearance) else 0.0
        text = f"at most {_length(peak)} at {speed * _RPM:.0f} rpm"
        text += f", {100.0 * share:.3g} % of the clearance" if share else ""
        text += f", more than the {100.0 * ORBIT:g} % of ISO 14839-2 zone B" if share > ORBIT else ""
        return self.case(
            "unbalance", name, answer, text, size=self.moment, unit="kg m", passed=share <= ORBIT,
            trace=Trace(over="speed", at=at, position=most[0], current=most[1], command=most[2]),
        )  # fmt: skip

    def _looked_at(self) -> list[float]:
        """Return speeds up to the highest, and those that meet a little damped pole of the loop."""
        bench = self.bench
        z = closed_loop_poles(bench.plant.theta, bench.loop, self.rate_hz, of=bench.plant.model)
        s = np.log(z[np.abs(z) > 0.0].astype(complex)) * self.rate_hz
        own = s.imag[(s.imag > 0.05 * self.speed) & (s.imag < self.speed) & (-s.real < 0.3 * np.abs(s))]
        return [float(w) for w in np.union1d(np.linspace(self.speed / _SPEEDS, self.speed, _SPEEDS), own)]

    def _shares(self) -> dict[str, Array]:
        """Return how the unbalance is split among the axes: statically by the levers, and as a couple."""
        plant_model, theta = self.bench.plant.model, self.bench.plant.theta
        assert isinstance(plant_model, RotorModel)
        z = {b.name: theta[f"{b.name}.z"] - theta["z_cg"] for b in plant_model.bearings if not b.axial}
        names, far = list(z), max(z.values(), default=0.0) - min(z.values(), default=0.0)
        part = {name: 1.0 / len(names) for name in names}
        if len(names) == 2 and far > 0.0:
            part = {name: abs(z[other]) / (abs(z[name]) + abs(z[other])) for name, other in (names, names[::-1])}
        static = np.array([part.get(b.name, 0.0) for b, _ in plant_model.placed])
        signs = np.array([-1.0 if names and b.name == names[-1] else 1.0 for b, _ in plant_model.placed])
        return {"static": static, "couple": static * signs} if len(names) > 1 else {"static": static}

    def _turned(self, speed: float, weights: Array, *, linear: bool) -> Answer:
        rate = self.rate_hz
        settle = min(max(self.samples // 2, round(6.0 * math.pi * rate / speed)), _LONGEST[True] // 2)
        n = settle + math.ceil(2.0 * math.pi * rate / speed)
        angle: Array = speed * (np.arange(n, dtype=np.float64) + 0.5) / rate
        load = self._whirl(weights, speed * np.ones(n), angle)
        answer = self.bench.respond(n, load=load, speed=speed, linear=linear)
        return answer._replace(**{q: getattr(answer, q)[settle:] for q in ("position", "current", "command")})

    def _whirl(self, weights: Array, speed: Array, angle: Array) -> Array:
        """Return the forces of the unbalance on the axes, (n, n_axes)."""
        plant_model = self.bench.plant.model
        assert isinstance(plant_model, RotorModel)
        turn = {0: np.cos(angle), 1: np.sin(angle), 2: np.zeros(angle.size)}
        each = [w * turn[p] for w, (_, p) in zip(weights, plant_model.placed, strict=True)]
        return np.asarray(self.moment * (speed**2)[:, None] * np.column_stack(each))

    def noise(self) -> list[Case]:
        """Leave the loop alone with its noise."""
        plant_model = self.bench.plant.model
        n = min(max(round(0.5 * self.rate_hz), 2000), _LONGEST[self.many])
        try:
            answer = self.bench.respond(n, seed=0)
        except ModelError as problem:
            return [self.broken("noise", "noise", problem)]
        rms = tuple(float(np.std(x[n // 5 :], axis=0).max(initial=0.0)) for x in answer[:3])
        text = f"rms {_length(rms[0])}, {1e3 * rms[1]:.3g} mA, {rms[2]:.3g} V"
        contact = bool(self.touching(answer.position).any())
        axis = int(np.argmax(np.std(answer.position, axis=0)))
        return [
            self.case("noise", "noise", answer, text, trace=self.traced(answer, axis), steady=rms[0],
                      unit=plant_model.units[plant_model.inputs[0]], rms=rms, passed=not contact)
        ]  # fmt: skip

    @cached_property
    def limit_cycle(self) -> list[Case]:
        """Let quantisation alone keep the rotor moving."""
        noise = self.bench.noise
        if not any((noise.position_resolution, noise.current_resolution, noise.voltage_resolution)):
            return []
        load = np.zeros((self.samples, len(self.axes)))
        load[0] = self.rate_hz * _IMPACT_S * _STEP * self.bench.room
        try:
            answer = self.bench.respond(self.samples, load=load)
        except ModelError as problem:
            return [self.broken("limit cycle", "limit cycle", problem)]
        last = answer.position[-answer.position.shape[0] // 4 :]
        size, axis = float(0.5 * np.ptp(last, axis=0).max()), int(np.argmax(np.ptp(last, axis=0)))
        text = f"quantisation keeps it moving by {_length(size)}"
        return [
            self.case("limit cycle", "limit cycle", answer, text, trace=self.traced(answer, axis), peak=size,
                      steady=float(np.std(last, axis=0).max()), passed=size <= _CYCLE * self.clearance)
        ]  # fmt: skip
