"""Items of the acceptance report: what records and the identified machine show of each standard, beside its limit."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ambid.arrays import Array, Complex
from ambid.control.acceptance import Item, Outcome, Part, dynamic_stiffness, outcome_of, outcome_of_zone, stiffness_sd
from ambid.control.closed import ClosedLoop
from ambid.control.limits import CLEARANCE_SHARE, residual_unbalance, vibration_limit
from ambid.control.margins import Margins, synchronous
from ambid.control.zones import DISPLACEMENT, ZONES, Grade
from ambid.errors import EstimationError
from ambid.estimation.modes import EstimatedNumber
from ambid.estimation.result import NORMAL_95
from ambid.job.closed_loop import spectra_of
from ambid.job.rotor import LEAST, RotorRecord, balance_planes
from ambid.physics.loop import UNLIMITED
from ambid.physics.rotor_model import Bearing, RotorModel
from ambid.record import Record
from ambid.rig import Rig
from ambid.rig.rotor import Operation
from ambid.rotor.balance import Machine as Rotor
from ambid.rotor.balance import Turned
from ambid.rotor.estimate import RotorEstimate
from ambid.rotor.passage import Passage, changes_speed, displacements, positions_of, track_passage, turning_of, whirl_of
from ambid.rotor.resonance import (
    CRITICALLY_DAMPED,
    SCALING,
    Peak,
    Resonance,
    Resonances,
    peaks,
    resonances,
    scaled_to_limit,
    separations,
)
from ambid.rotor.synchronous import Separated, separate
from ambid.settings.caller import setting

_RPM = 30.0 / math.pi
_SECTORS, _ROUND = 8, 0.5  # directions; the least reach over the largest, of a rotor that is moved along its stops
_STOP, _STAYS = 0.95, 0.3  # quantile of a direction that is its stop; share of the samples near the stops
_SPLIT = 8  # parts of a record without excitation, whose scatter is that of its mean
_STEPS, _LIKE = 400, 0.05  # speeds of a response; relative difference of critical speeds that are one
_NEAR = 0.03  # of the maximum speed, within which a record is one at it
_LAST = 0.005  # of it, by which the mean of the last block of a run-up may be below it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bench:
    """A record and what it is."""

    record: Record  # channels named by role
    name: str
    kind: str  # "rest", "speed", "run-up" or "stops"
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
    """Tell a run-up by the range of its speed, and a rotor moved along its stops by how far it comes all around."""
    record = read.bench
    if record.n_samples < LEAST:
        raise EstimationError(f"record {read.name} has {record.n_samples} samples; a rotor needs {LEAST}. Take more")
    dead = next((role for role in positions_of(record, model) if not np.ptp(record[role].values) > 0.0), None)
    if dead is not None:
        raise EstimationError(
            f"record {read.name}: {dead} is the same in every sample, and would pass for a bearing at rest. "
            "Check its sensor and column, or omit the record"
        )
    if changes_speed(record):
        top = float(np.max(np.abs(turning_of(record).speed(record.rate_hz))))
        return Bench(record=record, name=read.name, kind="run-up", speed=top, apart=None)
    if read.speed == 0.0 and not {"angle", "tacho", "speed"}.isdisjoint(record.names):
        turns = float(np.ptp(turning_of(record).angle)) / (2.0 * np.pi)
        if turns > 1.0:
            raise EstimationError(
                f"record {read.name} is given as at rest, and turns {turns:.4g} times by its own account. Correct "
                f"{setting('speed_rpm')}, or omit it"
            )
    apart = separate(record, model, read.speed)
    kind = "speed" if apart.response is not None else "rest"
    if kind == "rest" and apart.excitation is None and all(_reach(record, b.axes) for b in model.bearings):
        kind = "stops"
    return Bench(record=record, name=read.name, kind=kind, speed=apart.speed, apart=apart)


def _reach(record: Record, axes: Sequence[str]) -> float:
    """Return how far a rotor comes in the direction in which it comes least far, m; 0 where it does not stop there for
    some samples in every direction.
    """
    y = np.column_stack([record[f"{axis}_position"].values for axis in axes])
    if len(axes) == 1:
        y = np.column_stack([y, np.zeros(y.shape[0])])
        sector, n = (y[:, 0] < 0.0).astype(int), 2
    else:
        sector, n = (np.angle(y @ [1.0, 1j]) / (2.0 * np.pi) * _SECTORS).round().astype(int) % _SECTORS, _SECTORS
    size = np.linalg.norm(y, axis=1)
    tops = [np.quantile(size[sector == k], _STOP) if np.any(sector == k) else 0.0 for k in range(n)]
    return float(min(tops)) if min(tops) > _ROUND * max(tops) and np.mean(size > 0.8 * min(tops)) > _STAYS else 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Turn:
    """What turns with the rotor in a record at one speed."""

    orders: tuple[int, ...]
    amplitude: Mapping[str, Complex]  # by role, of each order
    sd: Mapping[str, float]  # of the first
    apart: bool  # whether the response to an excitation is taken out of it


@dataclass(frozen=True, eq=False)
class Machine:
    """What all items are made from."""

    estimate: RotorEstimate
    rig: Rig
    benches: Sequence[Bench]

    @property
    def steady(self) -> list[Bench]:
        """Records at rest or at one speed."""
        return [b for b in self.benches if b.kind in ("rest", "speed")]

    @cached_property
    def passages(self) -> dict[str, Passage]:
        """What turns with the rotor in each run-up, by its record."""
        runs = [b for b in self.benches if b.kind == "run-up"]
        return {b.name: track_passage(b.record, self.estimate.plant) for b in runs}

    @cached_property
    def turning(self) -> dict[str, Turn]:
        """What turns with the rotor in each record at one speed, by its record."""
        return {b.name: self._turn(b) for b in self.steady if b.apart is not None and b.apart.response is not None}

    def _turn(self, b: Bench) -> Turn:
        """Take the response to the excitation out where it falls on the speed or its harmonics."""
        assert b.apart is not None
        r, plant = b.apart.response, self.estimate.plant.at_speed(b.speed)
        assert r is not None
        spectra = spectra_of(b.apart.record, plant, b.speed) if any(r.together) else None
        parts = [Turned(record=0, response=r, spectra=spectra).own(order) for order in r.orders]
        at = {role: k for k, role in enumerate(r.roles[: parts[0][0].size])}
        return Turn(
            orders=r.orders, amplitude={x: np.array([a[k] for a, _, _ in parts]) for x, k in at.items()},
            sd={x: float(parts[0][1][k]) for x, k in at.items()}, apart=all(apart for *_, apart in parts),
        )  # fmt: skip

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
        if axial and (self.operation.touch_down is not None or self.operation.axial_touch_down is not None):
            return self.operation.axial_touch_down  # of which the radial one says nothing
        return self.rig.clearance

    def operates_at(self, speed: float) -> bool:
        """Whether a speed in rad/s is one of continuous operation."""
        low, top = self.speeds
        return (1.0 - _NEAR) * low <= abs(speed) <= (1.0 + _NEAR) * top

    def largest(self, b: Bench, bearing: Bearing) -> float:
        """Return the largest displacement in a bearing in any sample, m."""
        return displacements(b.record, self.estimate.plant)[bearing.name]

    def load(self, plane: str) -> float | None:
        """Return the mass that the bearing in a plane carries, kg; None: it is no bearing's plane, or not of two."""
        n, radial = self.estimate.numbers, [f"{b.name}.z" for b in self.estimate.plant.bearings if not b.axial]
        if len(radial) != 2 or plane not in radial:
            return None
        other = radial[1 - radial.index(plane)]
        return abs(n["m"] * (n["z_cg"] - n[other]) / (n[plane] - n[other]))

    def gain_sd(self, role: str) -> float:
        """Return how well the gain of a channel is known."""
        return next((c.gain_sd or 0.0 for c in self.rig.channels if c.role == role), 0.0)

    def vibration_at_maximum(self) -> dict[str, tuple[float, float, str]]:
        """Return the synchronous vibration of radial positions, peak to peak in m, with its spread and the record: of a
        record at the maximum speed, else of a run-up there; empty where there is none.
        """
        top, plant = self.speeds[1], self.estimate.plant
        radial = [r for r in plant.outputs if "_position" in r and not _axial(plant, r)]
        near = [b for b in self.steady if b.name in self.turning and abs(abs(b.speed) - top) < _NEAR * top]
        if near:
            name = min(near, key=lambda b: abs(abs(b.speed) - top)).name
            of, said = self.turning[name], "" if self.turning[name].apart else ", with the excitation"
            return {x: (2.0 * abs(of.amplitude[x][0]), 2.0 * of.sd[x], f"{name}{said}") for x in radial}
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
        *_sensitivity(machine, margins), *_vibration(machine), *_bearings(machine, loop), *_critical(machine, loop),
        *_unbalance(machine), *_collocation(machine), *_capacity(machine), *_touch_down(machine),
    ]  # fmt: skip


def _item(
    part: Part, what: str, value: float, sd: float, unit: str, words: str = "", *, outcome: Outcome = "reported",
    limit: float | None = None, limits: str = "",
) -> Item:  # fmt: skip
    return Item(
        part=part, what=what, value=float(value), sd=float(sd), unit=unit, words=words, outcome=outcome, limit=limit,
        limits=limits,
    )  # fmt: skip


def _missing(part: Part, what: str, record: str) -> Item:
    """Return an item that these records cannot show, and which would."""
    return Item(part=part, what=what, outcome="missing", words=f"{record} would")


def _sensitivity(machine: Machine, margins: Mapping[str, Margins]) -> Iterator[Item]:
    """Judge the sensitivity as measured; one that no excitation shows, but the loop as identified, is reported."""
    for name, m in margins.items():
        for axis, s in m.sensitivity.items():
            zone = s.rating
            hz = s.measured_frequency_hz if zone.source == "measured" else s.frequency_hz
            yield _item(
                "sensitivity", f"axis {axis}, {name}", zone.value, zone.sd, "dB",
                f"zone {zone.words}, {zone.source}, at {hz:.4g} Hz",
                outcome="reported" if s.measured is None else outcome_of_zone(zone),
                limit=20.0 * math.log10(ZONES[1][0]), limits="sensitivity",
            )  # fmt: skip
    shown = [m for m in margins.values() if all(s.measured is not None for s in m.sensitivity.values())]
    if not shown:
        record = "a record at rest or at a speed with an excitation logged as reference of each axis"
        yield _missing("sensitivity", "all axes", record)
    elif not any(m.speed and machine.operates_at(m.speed) for m in shown):
        yield _missing("sensitivity", "at speed", "a record at the maximum speed with excitation")


def _vibration(machine: Machine) -> Iterator[Item]:
    """Judge the largest displacement from the centre in each bearing, in each record at a speed."""
    turning = [b for b in machine.benches if b.kind in ("speed", "run-up")]
    for b in turning:
        for bearing in machine.estimate.plant.bearings:
            clearance, what = machine.clearance(axial=bearing.axial), f"bearing {bearing.name}, {b.name}"
            if clearance is None:
                key = "operation.axial_touch_down" if bearing.axial else "operation.touch_down"
                yield _missing("vibration", what, f"a rig with {key}")
                continue
            value, sd, how = _displacement(machine, b, bearing)
            grade = Grade.of_displacement(value / clearance, sd / clearance)
            yield _item(
                "vibration", what, value, sd, "m",
                f"zone {grade.words}, {100.0 * value / clearance:.3g} % of the clearance, {how}",
                outcome="reported" if b.kind == "run-up" else outcome_of_zone(grade),
                limit=DISPLACEMENT[1][0] * clearance, limits="displacement",
            )  # fmt: skip
    if not any(b.kind == "speed" and machine.operates_at(b.speed) for b in turning):
        yield _missing("vibration", "steady operation", "a record at the maximum speed")


def _displacement(machine: Machine, b: Bench, bearing: Bearing) -> tuple[float, float, str]:
    """Return the largest displacement from the zero of the sensors, m, with its spread and how it was found: in the
    samples, or, where the record is excited, of the mean and what turns with the rotor.
    """
    roles = [f"{axis}_position" for axis in bearing.axes]
    gain = max(machine.gain_sd(role) for role in roles)
    of = machine.turning.get(b.name)
    if of is None or not of.apart or b.apart is None or b.apart.excitation is None:
        top = machine.largest(b, bearing)
        return top, gain * top, "largest sample"
    mean = [float(b.record[role].values.mean()) for role in roles]
    turn = np.exp(1j * np.outer(np.linspace(0.0, 2.0 * np.pi, 720), of.orders))
    waves = np.column_stack([(turn @ of.amplitude[role]).real for role in roles])
    top = float(np.max(np.linalg.norm(mean + waves, axis=1)))
    return top, math.hypot(*(of.sd[role] for role in roles), gain * top), "mean and synchronous part"


def _bearings(machine: Machine, loop: ClosedLoop | None) -> Iterator[Item]:
    if loop is None:
        record = "a record with an excitation logged as reference, or [loop] in the rig,"
        yield _missing("bearings", "force by displacement", record)
        return
    axes, top, G = loop.plant.axes, machine.speeds[1], np.abs(loop.compliance)
    if top:
        at = loop.at(np.array([top / (2.0 * np.pi)]))
        values, sd, where = dynamic_stiffness(at)[0], stiffness_sd(at)[0], f"at {top * _RPM:.5g} 1/min, axis"
        for axis, x, s in zip(axes, values, sd, strict=True):
            yield _item("bearings", f"stiffness {where} {axis}", x.real, s.real, "N/m")
            yield _item("bearings", f"damping {where} {axis}", x.imag / top, s.imag / top, "N s/m")
    for j, axis in enumerate(axes):
        k = int(np.argmax(G[:, j]))
        words = f"of the rotor in the closed loop, at {loop.frequency_hz[k]:.4g} Hz"
        yield _item("bearings", f"least dynamic stiffness, axis {axis}", 1.0 / G[k, j], 0.0, "N/m", words)


def _critical(machine: Machine, loop: ClosedLoop | None) -> Iterator[Item]:
    """Judge the separation of each critical speed from the range of operation, by its amplification factor."""
    if machine.resonances is None:
        record = "a record of a run-up or coast-down with a channel of angle, pulses or speed"
        yield _missing("critical", "critical speeds", record)
        return
    top, alone = machine.speeds[1], _of_unbalance(machine, loop)
    beside = [_beside(r, alone) for r in machine.resonances.resonances]
    margins = separations([r for r, _ in beside], machine.speeds)
    for k, (x, (r, near)) in enumerate(zip(margins, beside, strict=True), 1):
        factor, needed = r.amplification, x.required_most > 0.0
        way = "" if r.forward is None else f", {100.0 * r.forward:.0f} % of the motion forward"
        words = f"damping ratio {100.0 * r.damping.value:.3g} %, largest in bearing {r.plane}{way}"
        if near is not None:
            words += f"; {near.speed * _RPM:.5g} 1/min by the machine as identified, without run-out"
        else:
            words += "; what run-out of the sensors does to it is not in its spread"
        how = "by half-power points" if r.half_power else "1/(2 damping ratio)"
        if r.speed.identifiable:
            yield _item("critical", f"critical speed {k}", r.speed.value, r.speed.sd, "rad/s", words)
        else:
            how += (
                f", about {round(r.speed.value * _RPM, -2):.0f} 1/min: too well damped for its numbers to be measured"
            )
        words = how if needed else f"{how}; critically damped, no separation is needed"
        if near is not None and near.amplification is not None:
            words += f"; {near.amplification:.3g} by the machine as identified"
        yield _item(
            "critical", f"amplification factor {k}", factor.value, factor.sd, "1", words,
            limit=CRITICALLY_DAMPED, limits="amplification",
        )  # fmt: skip
        if needed:
            place = "within" if x.actual == 0.0 else "above" if r.speed.value > top else "below"
            fails = x.actual + NORMAL_95 * x.sd < x.required
            yield _item(
                "critical", f"separation {k}", 100.0 * x.actual, 100.0 * x.sd, "%", f"{place} the range of operation",
                outcome="passed" if x.passed else "failed" if fails else "doubt",
                limit=100.0 * x.required_most, limits="separation",
            )  # fmt: skip
    fastest = max(float(p.speed.max()) for p in machine.passages.values())
    words = "a critical speed above it is not seen"
    yield _item("critical", "highest speed of the run-ups", fastest, 0.0, "rad/s", words)
    if fastest < (1.0 - _LAST) * top:
        yield _missing("critical", "critical speeds up to the maximum", f"a run-up to {top * _RPM:.5g} 1/min")


def _beside(r: Resonance, alone: Sequence[Peak]) -> tuple[Resonance, Peak | None]:
    """Return a resonance with what the run-out of the sensors may do to it in its spread, and the peak beside it of the
    machine as identified, which has none.
    """
    near = min(alone, key=lambda p: abs(p.speed - r.speed.value), default=None)
    if near is None or r.critically_damped or abs(near.speed / r.speed.value - 1.0) > _LIKE:
        return r, None
    factor = r.amplification.value if near.amplification is None else near.amplification
    return replace(r, speed=_wider(r.speed, near.speed), amplification=_wider(r.amplification, factor)), near


def _wider(x: EstimatedNumber, other: float) -> EstimatedNumber:
    sd = math.hypot(x.sd, other - x.value)
    return EstimatedNumber.of(x.value, sd, visible=x.identifiable)


def _of_unbalance(machine: Machine, loop: ClosedLoop | None) -> list[Peak]:
    """Return the peaks of what the identified unbalance alone does in the loop as identified, over the speed."""
    e, planes = machine.estimate, machine.estimate.synchronous.get("unbalance", {}).get("planes", {})
    if loop is None or not machine.passages or not planes or not all(p["identifiable"] for p in planes.values()):
        return []
    rotor = Rotor.of(e, balance_planes(e, machine.rig))
    force = sum(p["value"] * np.exp(1j * p["phase"]) * rotor.shape(name) for name, p in planes.items())
    speed = np.linspace(1.0 / _STEPS, 1.0, _STEPS) * machine.fastest
    moved = synchronous(loop, rotor, speed / (2.0 * np.pi), np.asarray(force)[:, None], None)[:, :, 0]
    passage, first = next(iter(machine.passages.values())), len(e.plant.inputs)
    at = [first + e.plant.outputs.index(role) for role in passage.roles]
    sizes = [whirl_of(moved[:, [at[x], at[y]]], np.zeros((_STEPS, 2))).major for _, x, y in passage.planes]
    return [p for size in sizes for p in peaks(speed, size)]


def _unbalance(machine: Machine) -> Iterator[Item]:
    """Judge the unbalance that is left, and the synchronous vibration at the maximum speed."""
    top, s = machine.speeds[1], machine.estimate.synchronous
    planes = s.get("unbalance", {}).get("planes", {})
    if top and planes and all(p["identifiable"] for p in planes.values()):
        whole = ("static", s["unbalance"]["static"], machine.estimate.numbers["m"])
        for what, x, load in [whole, *((name, p, machine.load(name)) for name, p in planes.items())]:
            limit = None if load is None else residual_unbalance(load, top)
            outcome = "reported" if limit is None else outcome_of(x["value"], x["sd"], limit)
            yield _item(
                "unbalance", f"unbalance, {what}", x["value"], x["sd"], "kg m", outcome=outcome, limit=limit,
                limits="unbalance" if limit else "",
            )  # fmt: skip
    else:
        seen = f" ({s['hint']})" if s.get("hint") else ""
        yield _missing("unbalance", f"unbalance by plane{seen}", "records at two speeds with angle or pulses")
    yield from _scaled(machine)
    at = machine.vibration_at_maximum()
    if not at:
        record = f"a record at the maximum speed, {top * _RPM:.5g} 1/min, or a run-up to it,"
        yield _missing("unbalance", "vibration at the maximum speed", record)
    for role, (value, sd, name) in at.items():
        spread, limit = math.hypot(sd, machine.gain_sd(role) * value), vibration_limit(top, running=True)
        yield _item(
            "unbalance", f"synchronous vibration, {role.replace('_', ' ')}", value, spread, "m",
            f"peak to peak, {name}", outcome=outcome_of(value, spread, limit), limit=limit, limits="vibration",
        )  # fmt: skip


def _scaled(machine: Machine) -> Iterator[Item]:
    """Compare the response of a run-up, scaled to the limit of vibration, with the clearance."""
    clearance, (low, top) = machine.clearance(), machine.speeds
    low = min(low, (1.0 - _NEAR) * top)
    runs = {name: p for name, p in machine.passages.items() if ((p.speed >= low) & (p.speed <= top)).any()}
    if not runs or clearance is None:
        record = "a run-up to the maximum speed, with operation.touch_down in the rig,"
        yield _missing("unbalance", "response scaled to the limit", record)
        return
    limit, room = 0.5 * vibration_limit(top), CLEARANCE_SHARE * clearance
    for name, p in runs.items():
        for plane, one, other in p.planes:
            whirl, speed, steady = p.whirl(plane), p.speed, p.amplitude[:0, [one, other]]
            if machine.resonances is not None and machine.resonances.roles == p.roles:  # higher than what passes it
                speed = np.append(speed, machine.resonances.speed)
                steady = machine.resonances.response[:, [one, other]]
            held = whirl_of(steady, np.zeros(steady.shape)).major
            x = scaled_to_limit(speed, np.append(whirl.major, held), (low, top), limit, room)
            near = [int(np.argmin(np.abs(p.speed - w))) for w in (x.at, x.largest_at)]
            relative = (math.sqrt(2.0) * whirl.sd / whirl.major)[near]
            gain = machine.gain_sd(p.roles[one]) if x.factor in SCALING else 0.0  # else it drops out
            size, sd = 2.0 * x.largest, 2.0 * x.largest * math.hypot(gain, *relative)
            yield _item(
                "unbalance", f"response scaled to the limit, bearing {plane}, {name}", size, sd, "m",
                f"peak to peak at {x.largest_at * _RPM:.5g} 1/min, {x.factor:.3g} times as measured",
                outcome=outcome_of(size, sd, 2.0 * room), limit=2.0 * room, limits="scaled",
            )  # fmt: skip


def _collocation(machine: Machine) -> Iterator[Item]:
    """Say, mode by mode, whether magnet and sensor of a bearing move alike."""
    e = machine.estimate
    if not e.modes and machine.rig.modes.count == 0:
        yield _item("collocation", "bending modes", 0.0, 0.0, "1", "modes.count of the rig")
    elif not e.modes:
        record = "none lies in the excited band; a record excited up to the first one"
        yield _missing("collocation", "bending modes", record)
    radial = [(b, k) for b in e.plant.bearings if not b.axial for k in range(len(b.z_sensors))]
    for r, mode in enumerate(e.modes, 1):
        for b, k in radial:
            names = (f"mode{r}.{b.name}.z", f"mode{r}.{b.sensor_parameter(k)}")
            magnet, sensor = (e.numbers[n] for n in names)
            ratio = sensor / magnet
            sd = _spread(e.covariance_of(names), np.array([-ratio, 1.0]) / magnet)
            side = "in phase" if ratio > 2.0 * sd else "opposed: a node lies between" if ratio < -2.0 * sd else "unsure"
            what = f"mode {r} ({mode.frequency_hz.value:.4g} Hz), bearing {b.name}{f', sensor {k + 1}' if k else ''}"
            yield _item("collocation", what, ratio, sd, "1", f"motion at the sensor over that at the magnet, {side}")


def _spread(covariance: Array, slope: Array) -> float:
    return math.sqrt(max(float(slope @ covariance @ slope), 0.0))


def _means(b: Bench, role: str) -> Array:
    """Return the mean of a channel in each period of the excitation, without one in parts of the record."""
    values, e = b.record[role].values, None if b.apart is None else b.apart.excitation
    if e is not None and e.count > 1:
        return np.asarray(values[e.first : e.first + e.period * e.count].reshape(e.count, -1).mean(axis=1))
    return np.array([x.mean() for x in np.array_split(values, _SPLIT)])


def _capacity(machine: Machine) -> Iterator[Item]:
    """Say how much of its force each magnet needs for what it carries, by its current and position in the mean."""
    e, limits = machine.estimate, machine.rig.limits
    most = min(abs(x) for x in (UNLIMITED if limits is None else limits.current))
    for axis in e.plant.axes:
        role, loads = f"{axis}_current", list[tuple[float, float]]()
        names = (f"{axis}.k_i", f"{axis}.k_x")
        k_i, k_x = (e.numbers[n] for n in names)
        for b in (b for b in machine.steady if role in b.record):
            means = np.array([_means(b, f"{axis}_{q}") for q in ("current", "position")])
            i, x = means.mean(axis=1)
            scatter = float(np.std([k_i, -k_x] @ means, ddof=1)) / math.sqrt(means.shape[1])
            of_numbers = _spread(e.covariance_of(names), np.array([i, -x]))
            loads.append((abs(k_i * i - k_x * x), math.hypot(of_numbers, machine.gain_sd(role) * k_i * i, scatter)))
        if not math.isfinite(most) or not loads:
            what = "a rig with loop.limits.current" if loads else f"a record with the current of axis {axis}"
            yield _missing("capacity", f"axis {axis}", what)
            continue
        (load, sd), capacity = max(loads), abs(k_i) * most
        words = f"static load beside k_i times the largest current, {100.0 * load / capacity:.2g} % of it"
        yield _item(
            "capacity", f"axis {axis}", load, sd, "N", words, outcome=outcome_of(load, sd, capacity), limit=capacity
        )


def _touch_down(machine: Machine) -> Iterator[Item]:
    """Compare the largest displacement of any record with the clearance, and that with what the stops show."""
    stops = [b for b in machine.benches if b.kind == "stops"]
    for bearing in machine.estimate.plant.bearings:
        clearance = machine.clearance(axial=bearing.axial)
        if clearance is not None:
            top = max((machine.largest(b, bearing) for b in machine.benches if b not in stops), default=0.0)
            sd = max(machine.gain_sd(f"{axis}_position") for axis in bearing.axes) * top
            yield _item(
                "touch_down", f"largest displacement, bearing {bearing.name}", top, sd, "m",
                f"{100.0 * top / clearance:.3g} % of the clearance, in any sample of any record",
                outcome=outcome_of(top, sd, clearance), limit=clearance,
            )  # fmt: skip
        for b in stops:
            reach = _reach(b.record, bearing.axes)
            sd = machine.gain_sd(f"{bearing.axes[0]}_position") * reach
            words = f"least way to the stops, {b.name}"
            if clearance is not None:
                words += f"; {clearance * 1e6:.4g} um in the rig"
            yield _item("touch_down", f"clearance, bearing {bearing.name}", reach, sd, "m", words)
    if not stops:
        record = "a record of the rotor set down and moved along its stops in every direction"
        yield _missing("touch_down", "the clearance itself", record)
