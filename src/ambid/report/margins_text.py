"""The margins of a loop as tables for the terminal: sensitivity, openings, compliance, an axis a row."""

from __future__ import annotations

import numpy as np

from ambid.control.margins import AxisSensitivity, Disk, Margins, Opening
from ambid.control.room import QUANTITIES, Demand
from ambid.report.numbers import sized
from ambid.report.text import (
    WIDTH,
    Paint,
    columns,
    ending,
    joined,
    plain,
    pure,
    record_line,
)
from ambid.simulation.margins import STANDARD

TURN = 30.0 / np.pi  # 1/min in a rad/s
_NONE = "–"


def margins_text(found: Margins, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write the margins of a loop, below their verdict."""
    head = record_line(found, f"loop of {'a record' if found.of == 'record' else 'an estimate'}", paint)
    return joined(
        [
            [head, _whence(found)],
            _sensitivity(found, paint),
            _openings(found, paint),
            _compliance(found, paint),
            _room(found, paint),
            *ending(found, width=width, paint=paint),
        ]
    )


def _whence(found: Margins) -> str:
    of = "the rig's [loop]"
    if found.controller["source"] == "record":
        orders = found.controller["order"]
        assert isinstance(orders, list | tuple)
        of = f"identified from the record, order {max(int(str(n)) for n in orders)}"
    turning = f", at {found.speed * TURN:.6g} 1/min" if found.speed else ""
    return f"model {found.model}{turning}; controller: {of}"


def _sensitivity(found: Margins, paint: Paint) -> list[str]:
    rows: list[tuple[str, ...]] = [("axis", "peak", "at", "zone", "measured", "bandwidth")]
    for axis, s in found.sensitivity.items():
        peak = f"{pure(s.peak_db.value, s.peak_db.sd)} dB"
        wide = _NONE if s.bandwidth_hz is None else sized(s.bandwidth_hz, "Hz")
        rows.append((axis, peak, sized(s.frequency_hz, "Hz"), s.zone, _measured(s), wide))
    limits = found.standard["limits_db"]
    assert isinstance(limits, list | tuple)
    lines = [paint(f"sensitivity at the position signals (zones of {STANDARD})", "strong"), *columns(rows)]
    ends = " and ".join([", ".join(f"{x:g}" for x in limits[:-1]), f"{limits[-1]:g}"])
    lines.append(f"zones end at {ends} dB; check these limits against the text of the standard")
    if len(found.sensitivity) > 1:
        of = {name: float(str(found.largest_singular[name])) for name in ("peak_db", "frequency_hz")}
        at = f"{of['peak_db']:.2f} dB at {sized(of['frequency_hz'], 'Hz')}"
        lines.append(f"all axes together, largest singular value: {at}")
    return lines


def _measured(s: AxisSensitivity) -> str:
    if s.measured_peak_db is None or s.measured_frequency_hz is None:
        return _NONE
    return f"{pure(s.measured_peak_db, s.measured_sd_db or 0.0)} dB at {sized(s.measured_frequency_hz, 'Hz')}"


def _openings(found: Margins, paint: Paint) -> list[str]:
    rows: list[tuple[str, ...]] = [("axis", "opened at", "gain", "phase", "delay", "disk margin", "peak")]
    for axis, of in found.margins.items():
        rows += [(axis, "position", *opening_cells(of.position)), ("", "input", *opening_cells(of.command))]
    return [paint("margins, one loop opened, the others closed", "strong"), *columns(rows)]


def opening_cells(of: Opening) -> tuple[str, ...]:
    """Write gain, phase, delay, disk margin and peak of a loop that is opened."""
    gain = f"{_number(of.gain_down)} … {_number(of.gain_up)}"
    phase = _NONE if of.phase_deg is None else f"{of.phase_deg:.0f}°"
    delay = _NONE if of.delay_s is None else sized(of.delay_s, "s")
    return (gain, phase, delay, _disk(of.disk), f"{of.peak_db:.2f} dB")


def _disk(of: Disk | None) -> str:
    return _NONE if of is None else f"{_number(of.gain_down)} … {_number(of.gain_up)}, {of.phase_deg:.0f}°"


def _number(x: float | None) -> str:
    return "any" if x is None else f"{x:.2g}"


def _compliance(found: Margins, paint: Paint) -> list[str]:
    rows: list[tuple[str, ...]] = [("axis", "least dynamic stiffness", "at")]
    rows += [(axis, sized(1.0 / c.largest, "N/m"), sized(c.frequency_hz, "Hz")) for axis, c in found.compliance.items()]
    return [paint("compliance at the magnets", "strong"), *columns(rows)]


def _room(found: Margins, paint: Paint) -> list[str]:
    """Noise, and what comes to a limit first: a row an axis; nothing where neither noise nor limits are known."""
    if found.noise is None and all(r.force_step is None for r in found.room.values()):
        return []
    rows: list[tuple[str, ...]] = [("axis", *QUANTITIES, "force step", "unbalance")]
    for axis, r in found.room.items():
        force = _NONE if r.force_step is None else f"{sized(r.force_step, 'N')}, {r.force_limit}"
        turned = _NONE if r.unbalance is None else f"{1e6 * r.unbalance:.3g} g mm, {r.unbalance_limit}"
        cells = (_demand(r.quantities.get(q), unit) for q, unit in QUANTITIES.items())
        rows.append((axis, *cells, force, turned))
    whose = "not known" if found.noise is None else f"of the {found.noise}"
    title = f"noise ({whose}), rms in the room before a limit; what comes to its limit first"
    lines = [paint(title, "strong"), *columns(rows)]
    v = found.vibration
    if v is not None:
        top, at, role = max(
            (float(x.max()), float(v.frequency_hz[int(np.argmax(x))]), n) for n, x in v.amplitude.items()
        )
        clear = "" if v.clearance is None else f", {100.0 * top / v.clearance:.2g} % of the clearance"
        lines.append(
            f"unbalance and run-out of the rig: up to {sized(top, 'm')}{clear} ({role} at {60 * at:.0f} 1/min)"
        )
    return lines


def _demand(of: Demand | None, unit: str) -> str:
    if of is None or (of.rms is None and of.room is None):
        return _NONE
    if of.room is None:
        return sized(of.rms or 0.0, unit)
    share = "" if of.rms is None or not of.room else f"{100.0 * of.rms / of.room:.2g} % of "
    return f"{share}{sized(of.room, unit)}"
