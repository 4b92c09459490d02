"""Items of the acceptance report: what records and the identified machine show of each standard, beside its limit."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ambid.arrays import Array
from ambid.control.acceptance import (
    Item,
    Part,
    dynamic_stiffness,
    outcome_of,
    stiffness_sd,
)
from ambid.control.closed import ClosedLoop
from ambid.control.limits import AMPLIFICATION, CLEARANCE_SHARE, residual_unbalance, vibration_limit
from ambid.control.margins import Margins
from ambid.control.zones import DISPLACEMENT, LONG_TERM, ZONES, Grade
from ambid.errors import EstimationError
from ambid.estimation.result import NORMAL_95
from ambid.job.rotor import RotorRecord
from ambid.physics.loop import UNLIMITED
from ambid.physics.rotor_model import RotorModel
from ambid.record import Record
from ambid.rig import Rig
from ambid.rig.rotor import Operation
from ambid.rotor.estimate import RotorEstimate
from ambid.rotor.passage import Passage, changes_speed, track_passage, turning_of
from ambid.rotor.resonance import Resonances, resonances, scaled_to_limit, separations
from ambid.rotor.synchronous import Separated, separate

_RPM = 30.0 / math.pi
_NEAR = 0.03  # of the maximum speed, within which a record is one at it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bench:
    """A record and what it is."""

    record: Record  # channels named by role
    name: str
    kind: str  # "rest", "speed" or "run-up"
    speed: float  # rad/s; of a run-up the highest
    apart: Separated | None  # its synchronous part; None of a run-up


def benches_of(readings: Sequence[RotorRecord], model: RotorModel) -> list[Bench]:
    """Recognise records by what they hold; those of one name are numbered."""
    benches = [_bench(read, model) for read in readings]
    names = [b.name for b in benches]
    return [
        replace(b, name=f"{b.name} {names[: k + 1].count(b.name)}") if names.count(b.name) > 1 else b
        for k, b in enumerate(benches)
    ]


def _bench(read: RotorRecord, model: RotorModel) -> Bench:
    """Tell a run-up by the range of its speed from a record at one speed or at rest."""
    if changes_speed(read.bench):
        top = float(np.max(np.abs(turning_of(read.bench).speed(read.bench.rate_hz))))
        return Bench(record=read.bench, name=read.name, kind="run-up", speed=top, apart=None)
    apart = separate(read.bench, model, read.speed)
    kind = "rest" if apart.response is None else "speed"
    return Bench(record=read.bench, name=read.name, kind=kind, speed=apart.speed, apart=apart)


@dataclass(frozen=True, eq=False)
class Machine:
    """What all items are made from."""

    estimate: RotorEstimate
    rig: Rig
    benches: Sequence[Bench]

    @property
    def steady(self) -> list[Bench]:
        """Records at rest or at one speed."""
        return [b for b in self.benches if b.kind != "run-up"]

    @cached_property
    def passages(self) -> dict[str, Passage]:
        """What turns with the rotor in each run-up, by its record."""
        runs = [b for b in self.benches if b.kind == "run-up"]
        return {b.name: track_passage(b.record, self.estimate.plant) for b in runs}

    @cached_property
    def resonances(self) -> Resonances | None:
        """The resonances that the run-ups pass; None: there is no run-up."""
        return resonances(list(self.passages.values())) if self.passages else None

    @property
    def fastest(self) -> float:
        """The highest speed of any record and of operation, rad/s."""
        return max(self.speeds[1], *(abs(b.speed) for b in self.benches))

    @property
    def operation(self) -> Operation:
        """What the rig says that it is accepted for."""
        return self.rig.operation or Operation()

    @property
    def speeds(self) -> tuple[float, float]:
        """Minimum and maximum continuous speed: the rig's, else that of the fastest record."""
        assert self.rig.rotor is not None
        fastest = max((abs(b.speed) for b in self.steady), default=0.0)
        top = self.operation.maximum_speed or abs(self.rig.rotor.speed) or fastest
        return self.operation.minimum_speed or top, top

    def clearance(self, *, axial: bool = False) -> float | None:
        """Return the radial clearance in the touch-down bearings, or that along the shaft, m."""
        own = self.operation.axial_touch_down
        return own if axial and own is not None else self.rig.clearance

    def gain_sd(self, role: str) -> float:
        """Return how well the gain of a channel is known."""
        return next((c.gain_sd or 0.0 for c in self.rig.channels if c.role == role), 0.0)

    def vibration_at_maximum(self) -> dict[str, tuple[float, float, str]]:
        """Return the synchronous vibration of radial positions, peak to peak in m, with its spread and the record: of a
        record at the maximum speed, else of a run-up there; empty where there is none.
        """
        top, plant = self.speeds[1], self.estimate.plant
        radial = [r for r in plant.outputs if "_position" in r and not _axial(plant, r)]
        near = [b for b in self.steady if top and abs(abs(b.speed) / top - 1.0) < _NEAR and b.apart is not None]
        for b in sorted(near, key=lambda b: abs(abs(b.speed) - top)):
            r = None if b.apart is None else b.apart.response
            if r is not None:
                return {x: (2.0 * abs(r.of(x)), 2.0 * float(r.sd()[r.roles.index(x)]), b.name) for x in radial}
        for name, p in self.passages.items():
            k = int(np.argmin(np.abs(p.speed - top)))
            if abs(p.speed[k] / top - 1.0) < _NEAR:
                size, sd = 2.0 * np.abs(p.amplitude[k]), 2.0 * p.sd[k]
                return {x: (float(size[i]), float(sd[i]), name) for i, x in enumerate(p.roles) if x in radial}
        return {}


def _axial(plant: RotorModel, role: str) -> bool:
    return plant.placed[plant.axes.index(role.split("_")[0])][0].axial


def items_of(machine: Machine, margins: Mapping[str, Margins], loop: ClosedLoop | None) -> list[Item]:
    """Return all items; `margins`: of the loop of each steady record, `loop`: that of the fastest."""
    return [
        *_sensitivity(margins), *_vibration(machine), *_bearings(machine, loop), *_critical(machine),
        *_unbalance(machine), *_collocation(machine), *_capacity(machine), *_touch_down(machine),
    ]  # fmt: skip


def _sensitivity(margins: Mapping[str, Margins]) -> Iterator[Item]:
    part: Part = "sensitivity"
    for name, m in margins.items():
        for axis, s in m.sensitivity.items():
            zone = s.rating
            hz = s.measured_frequency_hz if zone.source == "measured" else s.frequency_hz
            sure = zone.worst in LONG_TERM
            yield Item(
                part=part, what=f"axis {axis}, {name}", value=zone.peak_db, sd=zone.sd_db, unit="dB",
                outcome="passed" if sure else "doubt" if zone.letters[0] in LONG_TERM else "failed",
                limit=20.0 * math.log10(ZONES[1][0]), limits=part,
                words=f"zone {zone.words}, {zone.source}, at {hz:.4g} Hz",
            )  # fmt: skip
    if not margins:
        yield Item(
            part=part, what="all axes", outcome="missing",
            words="a record at rest or at a speed with an excitation logged as reference of each axis would",
        )  # fmt: skip
    elif not any(m.speed for m in margins.values()):
        yield Item(
            part=part, what="at speed", outcome="missing",
            words="a record at the maximum speed with excitation would",
        )  # fmt: skip


def _vibration(machine: Machine) -> Iterator[Item]:
    """Judge the largest displacement from the centre in each bearing, in each record at a speed."""
    part: Part = "vibration"
    turning = [b for b in machine.benches if b.kind != "rest"]
    for b in turning:
        for bearing in machine.estimate.plant.bearings:
            clearance = machine.clearance(axial=bearing.axial)
            what = f"bearing {bearing.name}, {b.name}"
            if clearance is None:
                place = "operation.axial_touch_down" if bearing.axial else "operation.touch_down"
                yield Item(part=part, what=what, outcome="missing", words=f"a rig with {place} would")
                continue
            value, sd, how = _displacement(machine, b, bearing.axes)
            grade = Grade.of_displacement(value / clearance, sd / clearance)
            sure = grade.worst in LONG_TERM
            yield Item(
                part=part, what=what, value=value, sd=sd, unit="m", limit=DISPLACEMENT[1][0] * clearance,
                limits="displacement",
                outcome="reported" if b.kind == "run-up" else
                "passed" if sure else "doubt" if grade.letters[0] in LONG_TERM else "failed",
                words=f"zone {grade.words}, {100.0 * value / clearance:.3g} % of the clearance, {how}",
            )  # fmt: skip
    if not any(b.kind == "speed" for b in turning):
        words = "a record at the maximum speed would"
        yield Item(part=part, what="steady operation", outcome="missing", words=words)


def _displacement(machine: Machine, b: Bench, axes: Sequence[str]) -> tuple[float, float, str]:
    """Return the largest displacement from the zero of the sensors, m, with its spread and how it was found: in the
    samples, or, where the record is excited, of the mean and what turns with the rotor.
    """
    roles = [f"{axis}_position" for axis in axes]
    samples = np.column_stack([b.record[role].values for role in roles])
    gain = max(machine.gain_sd(role) for role in roles)
    if b.apart is None or b.apart.excitation is None or b.apart.response is None:
        top = float(np.max(np.linalg.norm(samples, axis=1)))
        return top, gain * top, "largest sample"
    r = b.apart.response
    at = [r.roles.index(role) for role in roles]
    turn = np.linspace(0.0, 2.0 * np.pi, 720)
    waves = np.einsum("ko,oj->kj", np.exp(1j * np.outer(turn, r.orders)), r.amplitude[:, at]).real
    top = float(np.max(np.linalg.norm(samples.mean(axis=0) + waves, axis=1)))
    return top, math.hypot(float(np.linalg.norm(r.sd()[at])), gain * top), "mean and synchronous part"


def _bearings(machine: Machine, loop: ClosedLoop | None) -> Iterator[Item]:
    part: Part = "bearings"
    if loop is None:
        yield Item(
            part=part, what="force by displacement", outcome="missing",
            words="a record with an excitation logged as reference would, or [loop] in the rig",
        )  # fmt: skip
        return
    top = machine.speeds[1]
    if top:
        at = loop.at(np.array([top / (2.0 * np.pi)]))
        values, sd = dynamic_stiffness(at)[0], stiffness_sd(at)[0]
        for j, axis in enumerate(loop.plant.axes):
            where = f"axis {axis} at {top * _RPM:.5g} 1/min"
            for what, x, spread, unit in (
                ("stiffness", values[j].real, sd[j].real, "N/m"),
                ("damping", values[j].imag / top, sd[j].imag / top, "N s/m"),
            ):
                yield Item(
                    part=part, what=f"{what}, {where}", value=float(x), sd=float(spread), unit=unit, outcome="reported"
                )
    G = np.abs(loop.compliance)
    for j, axis in enumerate(loop.plant.axes):
        k = int(np.argmax(G[:, j]))
        yield Item(
            part=part, what=f"least dynamic stiffness of the rotor, axis {axis}", value=float(1.0 / G[k, j]),
            unit="N/m", outcome="reported", words=f"at {loop.frequency_hz[k]:.4g} Hz, loop closed",
        )  # fmt: skip


def _critical(machine: Machine) -> Iterator[Item]:
    """Judge the separation of each critical speed from the range of operation, by its amplification factor."""
    part: Part = "critical"
    if machine.resonances is None:
        yield Item(
            part=part, what="critical speeds", outcome="missing",
            words="a record of a run-up or coast-down with a channel of angle, pulses or speed would",
        )  # fmt: skip
        return
    top = machine.speeds[1]
    for k, x in enumerate(separations(machine.resonances.resonances, machine.speeds), 1):
        r, way = x.resonance, ""
        if r.forward is not None:
            way = f", {100.0 * r.forward:.0f} % of the motion forward"
        yield Item(
            part=part, what=f"critical speed {k}", value=r.speed.value, sd=r.speed.sd, unit="rad/s", outcome="reported",
            words=f"damping ratio {100.0 * r.damping.value:.3g} %, largest in bearing {r.plane}{way}",
        )  # fmt: skip
        how = "by half-power points" if r.half_power else "1/(2 damping ratio)"
        yield Item(
            part=part, what=f"amplification factor {k}", value=r.amplification.value, sd=r.amplification.sd, unit="1",
            limit=AMPLIFICATION, limits="amplification", outcome="reported",
            words=f"{how}: critically damped, no separation is needed" if r.critically_damped else how,
        )  # fmt: skip
        if r.critically_damped:
            continue
        lies = "within the range of operation" if x.actual == 0.0 else "above it" if r.speed.value > top else "below it"
        fails = x.actual + NORMAL_95 * x.sd < x.required
        yield Item(
            part=part, what=f"separation {k}", value=100.0 * x.actual, sd=100.0 * x.sd, unit="%",
            limit=100.0 * x.required_most, limits="separation",
            outcome="passed" if x.passed else "failed" if fails else "doubt", words=lies,
        )  # fmt: skip
    fastest = max(float(p.speed.max()) for p in machine.passages.values())
    if not machine.resonances.resonances:
        yield Item(part=part, what="no critical speed", outcome="reported", words="in the range of the run-ups")
    if top and fastest < top:
        words = f"a run-up to the maximum speed, {top * _RPM:.5g} 1/min, would"
        yield Item(part=part, what="critical speeds up to the maximum", outcome="missing", words=words)


def _unbalance(machine: Machine) -> Iterator[Item]:
    """Judge the unbalance that is left, and the synchronous vibration at the maximum speed."""
    part: Part = "unbalance"
    top, s = machine.speeds[1], machine.estimate.synchronous
    m = machine.estimate.numbers["m"]
    planes = s.get("unbalance", {}).get("planes", {})
    if planes and all(p["identifiable"] for p in planes.values()):
        whole = s["unbalance"]["static"]
        for what, x, load in [("static", whole, m), *((name, p, _load(machine, name)) for name, p in planes.items())]:
            limit = None if load is None else residual_unbalance(load, top)
            yield Item(
                part=part, what=f"unbalance, {what}", value=x["value"], sd=x["sd"], unit="kg m", limit=limit,
                limits="unbalance" if limit else "",
                outcome="reported" if limit is None else outcome_of(x["value"], x["sd"], limit),
            )  # fmt: skip
    else:
        words = s.get("hint") or "a record at a speed with angle or pulses would"
        yield Item(part=part, what="unbalance by plane", outcome="missing", words=str(words))
    yield from _scaled(machine)
    limit, at = vibration_limit(top), machine.vibration_at_maximum()
    if not at:
        words = f"a record at the maximum speed, {top * _RPM:.5g} 1/min, or a run-up to it would"
        yield Item(part=part, what="vibration at the maximum speed", outcome="missing", words=words)
    for role, (value, sd, name) in at.items():
        spread = math.hypot(sd, machine.gain_sd(role) * value)
        yield Item(
            part=part, what=f"synchronous vibration, {role.replace('_', ' ')}", value=value, sd=spread, unit="m",
            limit=limit, limits="vibration", outcome=outcome_of(value, spread, limit), words=f"peak to peak, {name}",
        )  # fmt: skip


def _scaled(machine: Machine) -> Iterator[Item]:
    """Compare the response of a run-up, scaled to the limit of vibration, with the clearance."""
    part: Part = "unbalance"
    clearance = machine.clearance()
    if machine.passages and clearance is not None:
        limit, room = 0.5 * vibration_limit(machine.speeds[1]), CLEARANCE_SHARE * clearance
        for name, p in machine.passages.items():
            for plane, _, _ in p.planes:
                try:
                    x = scaled_to_limit(p.speed, p.whirl(plane).major, machine.speeds, limit, room)
                except EstimationError:
                    continue
                yield Item(
                    part=part, what=f"response scaled to the limit, bearing {plane}, {name}", value=2.0 * x.largest,
                    unit="m", limit=2.0 * room, limits="scaled", outcome="passed" if x.passed else "failed",
                    words=f"peak to peak at {x.largest_at * _RPM:.5g} 1/min, {x.factor:.3g} times as measured",
                )  # fmt: skip
    else:
        words = "a run-up to the maximum speed, with operation.touch_down in the rig, would"
        yield Item(part=part, what="response scaled to the limit", outcome="missing", words=words)


def _load(machine: Machine, plane: str) -> float | None:
    """Return the mass that the bearing in a plane carries, kg; None: it is no bearing's plane, or not one of two."""
    e = machine.estimate
    radial = [b for b in e.plant.bearings if not b.axial]
    if len(radial) != 2 or plane not in {f"{b.name}.z" for b in radial}:
        return None
    other = next(f"{b.name}.z" for b in radial if f"{b.name}.z" != plane)
    z, far = e.numbers[plane], e.numbers[other]
    return abs(e.numbers["m"] * (e.numbers["z_cg"] - far) / (z - far))


def _collocation(machine: Machine) -> Iterator[Item]:
    """Say, mode by mode, whether magnet and sensor of a bearing move alike."""
    part: Part = "collocation"
    e = machine.estimate
    for r in range(1, len(e.modes) + 1):
        for b in (b for b in e.plant.bearings if not b.axial):
            for k in range(len(b.z_sensors)):
                names = (f"mode{r}.{b.name}.z", f"mode{r}.{b.sensor_parameter(k)}")
                magnet, sensor = (e.numbers[n] for n in names)
                C = e.covariance_of(names)
                ratio = sensor / magnet
                g = np.array([-ratio, 1.0]) / magnet
                sd = math.sqrt(max(float(g @ C @ g), 0.0))
                side = "in phase" if ratio > 2.0 * sd else "opposed: a node lies between" if ratio < -2.0 * sd else None
                yield Item(
                    part=part, what=f"mode {r} ({e.modes[r - 1].frequency_hz.value:.4g} Hz), bearing {b.name}",
                    value=ratio, sd=sd, unit="1", outcome="reported",
                    words=f"motion at the sensor over that at the magnet, {side or 'its sign is not known'}",
                )  # fmt: skip
    if not e.modes:
        yield Item(
            part=part, what="bending modes", outcome="missing",
            words="none lies in the excited band; a record excited up to the first one would",
        )  # fmt: skip


def _capacity(machine: Machine) -> Iterator[Item]:
    """Say how much of its force each magnet needs for what it carries, by its current and position in the mean."""
    part: Part = "capacity"
    e, limits = machine.estimate, machine.rig.limits
    high = UNLIMITED if limits is None else limits.current
    most = min(abs(high[0]), abs(high[1]))
    for axis in e.plant.axes:
        role = f"{axis}_current"
        seen = [b for b in machine.steady if role in b.record]
        if not math.isfinite(most) or not seen:
            what = "a rig with loop.limits.current" if seen else f"a record with the current of axis {axis}"
            yield Item(part=part, what=f"axis {axis}", outcome="missing", words=f"{what} would")
            continue
        k_i, k_x = e.numbers[f"{axis}.k_i"], e.numbers[f"{axis}.k_x"]
        C = e.covariance_of((f"{axis}.k_i", f"{axis}.k_x"))
        loads = list[tuple[float, float]]()
        for b in seen:
            i, x = (float(np.mean(b.record[f"{axis}_{q}"].values)) for q in ("current", "position"))
            g = np.array([i, -x])
            spread = math.hypot(math.sqrt(max(float(g @ C @ g), 0.0)), machine.gain_sd(role) * k_i * i)
            loads.append((abs(k_i * i - k_x * x), spread))
        load, sd = max(loads)
        yield Item(
            part=part, what=f"axis {axis}", value=load, sd=sd, unit="N", limit=abs(k_i) * most,
            outcome=outcome_of(load, sd, abs(k_i) * most),
            words=f"static load beside k_i times the largest current, {100.0 * load / (abs(k_i) * most):.2g} % of it",
        )  # fmt: skip


def _touch_down(machine: Machine) -> Iterator[Item]:
    """Compare the largest displacement of any record with the clearance, which these records do not measure."""
    part: Part = "touch_down"
    for bearing in machine.estimate.plant.bearings:
        clearance = machine.clearance(axial=bearing.axial)
        if clearance is not None:
            tops = [_largest(b.record, bearing.axes) for b in machine.benches]
            yield Item(
                part=part, what=f"largest displacement, bearing {bearing.name}", value=max(tops), unit="m",
                limit=clearance, outcome="passed" if max(tops) < clearance else "failed",
                words=f"{100.0 * max(tops) / clearance:.3g} % of the clearance, with the excitation",
            )  # fmt: skip
    yield Item(
        part=part, what="the clearance itself", outcome="missing",
        words="a record of the rotor set down and moved along its stops in every direction would",
    )  # fmt: skip


def _largest(record: Record, axes: Sequence[str]) -> float:
    samples: Array = np.column_stack([record[f"{axis}_position"].values for axis in axes])
    return float(np.max(np.linalg.norm(samples, axis=1)))
