"""The job of accepting a machine: records at rest, at speed and of run-ups in, its items by ISO 14839 and API 617 out.

Read -> identify the machine, or take an estimate -> its loop in each record -> items, each beside its limit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.control.acceptance import (
    PARTS,
    Acceptance,
    Item,
    Part,
    Stiffness,
    dynamic_stiffness,
    outcome_of,
    stiffness_sd,
)
from ambid.control.closed import ClosedLoop
from ambid.control.limits import residual_unbalance, vibration_limit
from ambid.control.margins import Margins
from ambid.control.zones import DISPLACEMENT, LONG_TERM, ZONES, Grade
from ambid.errors import AmbidError, EstimationError, counted
from ambid.estimation.estimate import Check
from ambid.estimation.linear import one_thread
from ambid.estimation.progress import Tick, silent
from ambid.job.data import Clock, Reading, RigSource, Source, known_rig, origin, rig_entry, sources_of
from ambid.job.loop_margins import given, margins_and_loop
from ambid.job.rotor import RotorRecord, identify_rotor, read_records
from ambid.physics.loop import UNLIMITED
from ambid.physics.rotor_model import RotorModel
from ambid.record import GapPolicy, Record
from ambid.rig import Rig
from ambid.rig.rotor import Operation
from ambid.rotor.estimate import RotorEstimate
from ambid.rotor.synchronous import Separated, separate
from ambid.settings.caller import setting
from ambid.settings.calls import of_job

_NEAR = 0.03  # of the maximum speed, within which a record is one at it
_FREQUENCIES = 200
_ABOVE = 1.05  # of the speed, up to which stiffness is drawn at least


@of_job("accept")
def accept(
    records: Source | Sequence[Source],
    rig: RigSource | None = None,
    *,
    estimate: RotorEstimate | str | Path | None = None,
    speed_rpm: float | Sequence[float] | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: GapPolicy | None = None,
    units: Mapping[str, str] | None = None,
    layout: Mapping[str, str] | None = None,
    tick: Tick | None = None,
) -> Acceptance:
    """Say what a machine on magnetic bearings shows of ISO 14839-2, ISO 14839-3 and API 617, item by item.

    A record is recognised by what it holds: at rest, at a speed, or of a run-up or coast-down by their speed. An item
    that no record shows names the record that would.

    Parameters
    ----------
    records : file, Record, DataFrame, Dataset or dict of arrays, or several of them
        Of one rotor on magnetic bearings; at rest and at speed with periodic excitation, run-ups without.
    rig : Rig, path, dict or TOML text, optional
        What is known of the machine, with ``[operation]``; default: that of the estimate.
    estimate : RotorEstimate, str or Path, optional
        The machine; default: identified from the records at rest and at speed.
    speed_rpm : float or sequence of float, optional
        Speed of each record in rpm; default: as its angle or speed, or the rig, says.
    from_s, to_s, rate_hz, gaps, units, layout : optional
        As `ambid.identify`.
    tick : callable, optional
        Called with the name of the present stage; may raise to interrupt.

    Returns
    -------
    Acceptance

    Raises
    ------
    AmbidError
        If records, rig or estimate break a rule.
    EstimationError
        If it is no rotor on many axes, or the machine cannot be identified.
    """
    say, clock = tick or silent, Clock()
    reading = Reading(from_s=from_s, to_s=to_s, rate_hz=rate_hz, gaps=gaps, units=units, layout=layout)
    of_machine: Any = None
    if estimate is not None:
        of_machine, bench = given(estimate, rig)
    else:
        bench = known_rig(rig)
    if bench.rotor is None:
        raise EstimationError(
            f"a machine is accepted on many axes; the rig's model is {bench.model!r}, of one axis. Give the rig of a "
            f"rotor, with [bearings.X], or use 'ambid margins'"
        )
    benches = [_bench_of(r, bench.rotor) for r in read_records(sources_of(records), bench, speed_rpm, say, **reading)]
    clock.lap("read")
    steady = [b for b in benches if b.kind != "run-up"]
    if of_machine is None:
        if not steady:
            raise EstimationError(
                "the machine is identified from a record at rest or at a speed, with excitation; these are run-ups "
                f"alone. Give one, or {setting('estimate')}"
            )
        speeds = [b.speed * 30.0 / math.pi for b in steady]
        of_machine = identify_rotor([b.record for b in steady], bench, speed_rpm=speeds, tick=say)
    clock.lap("identify")
    say("items")
    with one_thread():
        result = _acceptance(_Machine(of_machine, bench, benches), clock)
    clock.lap("items")
    return replace(result, timing_s=clock.laps, used=tuple(b.record for b in benches))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Bench:
    """A record and what it is."""

    record: Record  # channels named by role
    name: str
    kind: str  # "rest", "speed" or "run-up"
    speed: float  # rad/s; of a run-up the highest
    apart: Separated | None  # its synchronous part; None of a run-up


def _bench_of(read: RotorRecord, model: RotorModel) -> _Bench:
    """Tell a run-up by the range of its speed from a record at one speed or at rest."""
    apart = separate(read.bench, model, read.speed)
    kind = "rest" if apart.response is None else "speed"
    return _Bench(record=read.bench, name=read.name, kind=kind, speed=apart.speed, apart=apart)


@dataclass(frozen=True, eq=False)
class _Machine:
    """What all items are made from."""

    estimate: RotorEstimate
    rig: Rig
    benches: Sequence[_Bench]

    @property
    def steady(self) -> list[_Bench]:
        return [b for b in self.benches if b.kind != "run-up"]

    @property
    def operation(self) -> Operation:
        return self.rig.operation or Operation()

    @property
    def speeds(self) -> tuple[float, float]:
        """Minimum and maximum continuous speed: the rig's, else that of the fastest record."""
        assert self.rig.rotor is not None
        fastest = max((abs(b.speed) for b in self.steady), default=0.0)
        top = self.operation.maximum_speed or abs(self.rig.rotor.speed) or fastest
        return self.operation.minimum_speed or top, top

    def clearance(self, *, axial: bool = False) -> tuple[float | None, str]:
        """Return a clearance in m and where it comes from."""
        own = self.operation.axial_touch_down if axial else self.operation.touch_down
        if own is not None:
            return own, ""
        low, high = UNLIMITED if self.rig.limits is None else self.rig.limits.position
        least = min(abs(low), abs(high))
        return (least, "of loop.limits.position") if math.isfinite(least) else (None, "")

    def gain_sd(self, role: str) -> float:
        """Return how well the gain of a channel is known."""
        return next((c.gain_sd or 0.0 for c in self.rig.channels if c.role == role), 0.0)

    def at_maximum(self) -> _Bench | None:
        """Return the steady record at the maximum speed."""
        top = self.speeds[1]
        near = [b for b in self.steady if top and abs(abs(b.speed) / top - 1.0) < _NEAR]
        return min(near, key=lambda b: abs(abs(b.speed) - top), default=None)


def _acceptance(machine: _Machine, clock: Clock) -> Acceptance:
    e, loops = machine.estimate, dict[str, tuple[Margins, ClosedLoop]]()
    warnings = list[str]()
    for b in machine.steady:
        try:
            loops[b.name] = margins_and_loop(e, machine.rig, b.record, b.speed)
        except AmbidError as error:
            warnings.append(f"{b.name}: no sensitivity: {error}")
    clock.lap("margins")
    loop = None
    if loops:
        fastest = max((b for b in machine.steady if b.name in loops), key=lambda b: abs(b.speed))
        loop = loops[fastest.name][1]
    items = [
        *_sensitivity({name: m for name, (m, _) in loops.items()}), *_vibration(machine),
        *_bearings(machine, loop), *_critical(), *_unbalance(machine), *_collocation(machine),
        *_capacity(machine), *_touch_down(machine),
    ]  # fmt: skip
    clearance, source = machine.clearance()
    if source:
        warnings.append(
            f"the radial clearance is that {source}: give operation.touch_down in the rig, as the touch-down bearings "
            "have it"
        )
    return Acceptance(
        status=e.status, model=e.model, record=origin(machine.benches[0].record),
        records=tuple({**origin(b.record), "file": b.name, "kind": b.kind, "speed": b.speed} for b in machine.benches),
        items=tuple(items), checks=_checks(machine, items), margins={name: m for name, (m, _) in loops.items()},
        stiffness=None if loop is None else _curves(machine, loop), estimate=e, clearance=clearance,
        speeds=machine.speeds, calibration=_calibration(machine.rig), warnings=tuple(warnings),
        rig=rig_entry(machine.rig),
    )  # fmt: skip


def _checks(machine: _Machine, items: Sequence[Item]) -> dict[str, Check]:
    """Judge each part by its items, what cannot be seen, and the estimate of the machine."""
    checks = dict[str, Check]()
    for part, title in PARTS.items():
        own = [x for x in items if x.part == part and x.outcome in ("passed", "doubt", "failed")]
        against = [x for x in own if x.outcome != "passed"]
        worst = next((x for x in against if x.outcome == "failed"), against[0] if against else None)
        if worst is not None:
            said = f"{worst.what}{f', {worst.words}' if worst.words else ''}"
            passes = "does not keep its limit" if worst.outcome == "failed" else "may not keep its limit"
            more = f", and {counted(len(against) - 1, 'other item')}" if len(against) > 1 else ""
            source = "" if worst.confirmed else "; the limit is unconfirmed"
            checks[part] = Check(passed=False, detail=f"{said} {passes}{more}{source}. See '{title}'")
        elif own:
            checks[part] = Check(passed=True, detail=f"{counted(len(own), 'item')} within the limits")
    missing = [x for x in items if x.outcome == "missing"]
    checks["complete"] = Check(
        passed=not missing,
        detail="every item is seen in these records" if not missing else
        f"{counted(len(missing), 'item')} cannot be seen in these records: {'; '.join(x.what for x in missing)}. "
        "Each says which record would show it",
    )  # fmt: skip
    e = machine.estimate
    reasons = "; ".join(f"{r.check}: {r.text}" for r in e.verdict.reasons)
    checks["estimate"] = Check(
        passed=e.passed, detail=f"of the machine: {reasons}" if reasons else "the estimate of the machine is usable"
    )
    return checks


def _calibration(rig: Rig) -> dict[str, str]:
    """Say what is known of the calibration of the channels; those of which the same is said stand together."""
    alike = dict[str, list[str]]()
    for c in rig.channels:
        words = ["as recorded" if c.calibration is None else str(c.calibration.source or "gain and offset of the rig")]
        words.append("its error is not given" if c.gain_sd is None else f"gain known to {100.0 * c.gain_sd:.2g} %")
        alike.setdefault(", ".join(words), []).append(c.role)
    return {", ".join(roles): said for said, roles in alike.items()}


# --- items ----------------------------------------------------------------------------------------------------------


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


def _vibration(machine: _Machine) -> Iterator[Item]:
    """Judge the largest displacement from the centre in each bearing, in each record at a speed."""
    part: Part = "vibration"
    turning = [b for b in machine.benches if b.kind != "rest"]
    for b in turning:
        for bearing in machine.estimate.plant.bearings:
            clearance, _ = machine.clearance(axial=bearing.axial)
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


def _displacement(machine: _Machine, b: _Bench, axes: Sequence[str]) -> tuple[float, float, str]:
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


def _bearings(machine: _Machine, loop: ClosedLoop | None) -> Iterator[Item]:
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
            where = f"axis {axis} at {top * 30.0 / math.pi:.5g} 1/min"
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


def _curves(machine: _Machine, loop: ClosedLoop) -> Stiffness:
    """Return the dynamic stiffness of the bearings over frequency."""
    rate = loop.plant.rate_hz
    top = max(_ABOVE * machine.speeds[1] / (2.0 * np.pi), 0.1 * rate)
    f = np.geomspace(1e-4 * rate, min(top, 0.49 * rate), _FREQUENCIES)
    D = dynamic_stiffness(loop.at(f))
    axes = loop.plant.axes
    return Stiffness(
        frequency_hz=f, real={a: D[:, j].real for j, a in enumerate(axes)},
        imaginary={a: D[:, j].imag for j, a in enumerate(axes)},
    )  # fmt: skip


def _critical() -> Iterator[Item]:
    part: Part = "critical"
    yield Item(
        part=part, what="critical speeds", outcome="missing",
        words="a record of a run-up or coast-down with a channel of angle, pulses or speed would",
    )  # fmt: skip


def _unbalance(machine: _Machine) -> Iterator[Item]:
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
    at = machine.at_maximum()
    if at is None or at.apart is None or at.apart.response is None:
        words = f"a record at the maximum speed, {top * 30.0 / math.pi:.5g} 1/min, would"
        yield Item(part=part, what="vibration at the maximum speed", outcome="missing", words=words)
        return
    r, limit = at.apart.response, vibration_limit(top)
    for role in (x for x in machine.estimate.plant.outputs if "_position" in x and not _axial(machine, x)):
        value = 2.0 * abs(r.of(role))
        sd = math.hypot(2.0 * float(r.sd()[r.roles.index(role)]), machine.gain_sd(role) * value)
        yield Item(
            part=part, what=f"synchronous vibration, {role.replace('_', ' ')}", value=value, sd=sd, unit="m",
            limit=limit, limits="vibration", outcome=outcome_of(value, sd, limit), words="peak to peak",
        )  # fmt: skip


def _load(machine: _Machine, plane: str) -> float | None:
    """Return the mass that the bearing in a plane carries, kg; None: it is no bearing's plane, or not one of two."""
    e = machine.estimate
    radial = [b for b in e.plant.bearings if not b.axial]
    if len(radial) != 2 or plane not in {f"{b.name}.z" for b in radial}:
        return None
    other = next(f"{b.name}.z" for b in radial if f"{b.name}.z" != plane)
    z, far = e.numbers[plane], e.numbers[other]
    return abs(e.numbers["m"] * (e.numbers["z_cg"] - far) / (z - far))


def _axial(machine: _Machine, role: str) -> bool:
    plant = machine.estimate.plant
    return plant.placed[plant.axes.index(role.split("_")[0])][0].axial


def _collocation(machine: _Machine) -> Iterator[Item]:
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


def _capacity(machine: _Machine) -> Iterator[Item]:
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


def _touch_down(machine: _Machine) -> Iterator[Item]:
    """Compare the largest displacement of any record with the clearance, which these records do not measure."""
    part: Part = "touch_down"
    for bearing in machine.estimate.plant.bearings:
        clearance, source = machine.clearance(axial=bearing.axial)
        if clearance is not None:
            tops = [_largest(b.record, bearing.axes) for b in machine.benches]
            yield Item(
                part=part, what=f"largest displacement, bearing {bearing.name}", value=max(tops), unit="m",
                limit=clearance, outcome="passed" if max(tops) < clearance else "failed",
                words=f"{100.0 * max(tops) / clearance:.3g} % of the clearance {source or 'of the rig'}",
            )  # fmt: skip
    yield Item(
        part=part, what="the clearance itself", outcome="missing",
        words="a record of the rotor set down and moved along its stops in every direction would",
    )  # fmt: skip


def _largest(record: Record, axes: Sequence[str]) -> float:
    samples: Array = np.column_stack([record[f"{axis}_position"].values for axis in axes])
    return float(np.max(np.linalg.norm(samples, axis=1)))
