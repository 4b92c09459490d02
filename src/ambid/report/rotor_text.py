"""The estimate of a rotor as text: one table for the rotor and its bending modes, one for each bearing by axis."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from ambid.estimation.estimate import Delay, EstimatedParameter
from ambid.physics.rotor_model import Bearing, position_role
from ambid.physics.shaft import Shaft
from ambid.report.estimate_text import validation_lines
from ambid.report.numbers import quantity, sized
from ambid.report.orbit_panels import synchronous_lines
from ambid.report.rotor_drawing import expected_rotor, partners_of
from ambid.report.text import (
    WIDTH,
    Paint,
    check_lines,
    columns,
    joined,
    late,
    other_warnings,
    parameter_lines,
    plain,
    pure,
    status_words,
    timing_lines,
    warning_lines,
)
from ambid.rotor.estimate import RotorEstimate
from ambid.units import parse_unit

_UNSEEN = "✗"
TURN = 30.0 / 3.141592653589793  # 1/min in a rad/s


def rotor_text(estimate: RotorEstimate, *, shaft: Shaft | None = None, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write the estimate of a rotor, below its verdict; `shaft`: its drawing."""
    e = estimate
    of_rotor = parameter_lines(machine(e), width=width, paint=paint, found=e.verdict)
    of_bearings = [bearing_lines(e, b, width=width, paint=paint) for b in e.plant.bearings]
    unseen = any(_UNSEEN in line for lines in of_bearings for line in lines)
    return joined(
        [
            record_lines(e, paint),
            ["rotor" + of_rotor[0][5:], *of_rotor[1:]],
            columns(mode_rows(e, shaft)) if e.modes else [],
            *of_bearings,
            [f"{paint(_UNSEEN, 'bad')} not identifiable from these data"] if unseen else [],
            synchronous_lines(e, width),
            check_lines(e.checks, width=width, paint=paint, above=True),
            [] if e.validation is None else validation_lines(e.validation, width=width, paint=paint),
            warning_lines(other_warnings(e.checks, e.warnings), width=width, paint=paint),
            timing_lines(e.timing_s, paint=paint),
        ]
    )


def record_lines(estimate: RotorEstimate, paint: Paint = plain) -> list[str]:
    """Say what was identified, and from which records at which speeds."""
    e, n = estimate, len(estimate.plant.axes)
    what = f"rotor on {n} {'axis' if n == 1 else 'axes'}"
    lines = [
        f"{paint(str(r.get('file') or 'record'), 'strong')}: {'' if len(e.records) > 1 else f'{what}, '}{taken(r)}"
        for r in e.records
    ]
    if len(lines) == 1:
        return [lines[0] + status_words(e.status, paint)]
    return [f"{what}, from {len(lines)} records{status_words(e.status, paint)}", *lines]


def taken(record: Mapping[str, object]) -> str:
    """Say how long a record is, at which rate and speed."""
    rate, speed = float(str(record["rate_hz"])), float(str(record["speed"]))
    periods, seconds = record.get("periods"), int(str(record["samples"])) / rate
    long = f"{periods} periods of {float(str(record['period_s'])):.4g} s" if periods else f"{seconds:.4g} s"
    return f"{long} at {rate:g} Hz, {f'{speed * TURN:.6g} 1/min' if speed else 'at rest'}"


def machine(estimate: RotorEstimate) -> list[EstimatedParameter]:
    """Return the parameters that belong to no bearing."""
    return [p for p in estimate.parameters if "." not in p.name]


def mode_rows(estimate: RotorEstimate, shaft: Shaft | None = None) -> list[tuple[str, ...]]:
    """Return a table of the bending modes, beside what a drawing expects of each."""
    rotor = None if shaft is None else expected_rotor(estimate.modes, shaft)
    expected = [] if rotor is None else ["from the drawing"]
    rows: list[tuple[str, ...]] = [("bending mode", "frequency", "damping ratio", *expected, "")]
    for r, (m, k) in enumerate(zip(estimate.modes, partners_of(estimate.modes, rotor), strict=True), 1):
        f, z = m.frequency_hz, m.damping
        shown = "" if m.identifiable else f"{_UNSEEN} not identifiable"
        cells = [] if rotor is None else ["–" if k is None else f"{rotor.omega[k + 2] / (2 * math.pi):.5g} Hz"]
        ratio = f"{pure(100 * z.value, 100 * z.sd)} %"
        rows.append((f"  {r}", quantity(f.value, f.sd, "Hz").text, ratio, *cells, shown))
    return rows


def bearing_lines(estimate: RotorEstimate, bearing: Bearing, *, width: int = WIDTH, paint: Paint = plain) -> list[str]:
    """Return the table of a bearing, a column for each axis; one table below the other where that is too wide."""
    lines = columns(bearing_rows(estimate, bearing, bearing.axes))
    if max(map(len, lines)) > width:
        lines = [x for axis in bearing.axes for x in columns(bearing_rows(estimate, bearing, (axis,)))]
    return [line.replace(_UNSEEN, paint(_UNSEEN, "bad")) for line in lines]


def bearing_rows(estimate: RotorEstimate, bearing: Bearing, axes: Sequence[str]) -> list[tuple[str, ...]]:
    """Return parameters, delays and fits of some axes of a bearing, then its planes."""
    e = estimate
    rows: list[tuple[str, ...]] = [(f"bearing {bearing.name}", *axes)]
    own = {axis: [p for p in e.parameters if p.name.startswith(f"{axis}.")] for axis in axes}
    for what in dict.fromkeys(p.name.split(".", 1)[1] for axis in axes for p in own[axis]):
        of = {p.name: p for axis in axes for p in own[axis]}
        rows.append((what, *(_cell(of.get(f"{axis}.{what}")) for axis in axes)))
    delays = [next((d for role, d in e.delay.items() if role.startswith(f"{axis}_")), None) for axis in axes]
    rows.append(("delay", *(_late(d, float(str(e.record["rate_hz"]))) for d in delays)))
    fitted = [*(position_role("", k) for k in range(len(bearing.z_sensors))), "_current"]
    rows += [
        (f"fit of {role[1:]}", *(_fit(e, f"{axis}{role}") for axis in axes))
        for role in fitted
        if any(f"{axis}{role}" in e.fit for axis in axes)
    ]
    loops = [e.sensitivity.get(axis) for axis in axes]
    if any(loops):
        rows.append(("sensitivity", *("" if s is None else _loop(s) for s in loops)))
    planes = [p for p in e.parameters if p.name.startswith(f"{bearing.name}.")]
    blank = [""] * (len(axes) - 1)
    rows += [(_plane(p.name.split(".", 1)[1]), _cell(p), *blank) for p in planes]
    return rows


def _cell(p: EstimatedParameter | None) -> str:
    """A parameter in a cell: value ± sd, and where it comes from unless it is free."""
    if p is None:
        return ""
    text = quantity(p.value, p.sd, p.unit).text
    return f"{'' if p.identifiable else f'{_UNSEEN} '}{text}{'' if p.role == 'free' else f', {p.role}'}"


def _late(d: Delay | None, rate_hz: float) -> str:
    return "" if d is None else f"{late(d, rate_hz)}{', given' if d.how == 'given' else ''}"


def _fit(e: RotorEstimate, role: str) -> str:
    if role not in e.fit:
        return ""
    unit = parse_unit(e.plant.units[role]).si
    return f"{e.fit[role].one_step:.4f}, {sized(e.fit[role].innovation_sd, unit)} rms left"


def _loop(found: dict[str, object]) -> str:
    """The peak of an axis' sensitivity and its zone by ISO 14839-3."""
    peak = found["peak_db"]
    assert isinstance(peak, dict)
    return f"{pure(float(peak['value']), float(peak['sd'] or 0.0))} dB, zone {found['zone']}"


def _plane(what: str) -> str:
    """Name a plane of a bearing: z, z_sensor, z_sensor2 …"""
    return "plane" if what == "z" else f"{what.removeprefix('z_').replace('sensor', 'sensor plane ')}".strip()
