"""The margins of a loop as tables for the terminal: sensitivity, openings, compliance, an axis a row."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.arrays import Array
from ambid.control.margins import QUANTITIES, AxisSensitivity, Demand, Margins, Opening, Vibration
from ambid.control.zones import LONG_TERM, STANDARD, ZONES
from ambid.estimation.result import RecordEntry
from ambid.report.document import Document, Lines, Section, ending, grid, numbers_of
from ambid.report.drawing import BOUND, MEASURED, PREDICTED, Block, head, log_axis, panel, stacked
from ambid.report.numbers import prefixed, sized
from ambid.report.text import pure, title_line

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


TURN = 30.0 / np.pi  # 1/min in a rad/s

_NONE = "–"


def margins_document(margins: Margins, _: Any) -> Document:
    """Describe the margins of a loop."""
    m = margins
    title = f"{RecordEntry.of(m.record).name}, margins of the loop of model {m.model}"
    columns: dict[str, list[object]] = {"axis": list(m.sensitivity), **numbers_of(list(m.sensitivity.values()))}
    columns |= numbers_of([m.margins[axis] for axis in m.sensitivity])
    return Document(
        title=title, sections=margins_sections(m), figure=partial(margins_figure, m, title),
        frame=lambda: ("axis", columns),
    )  # fmt: skip


def margins_sections(margins: Margins) -> list[Section]:
    """Say the margins of a loop."""
    m, record = margins, RecordEntry.of(margins.record)
    origin = "the rig's [loop]"
    if m.controller["source"] == "record":
        orders = m.controller["order"]
        assert isinstance(orders, list | tuple)
        origin = f"identified from the record, order {max(int(str(n)) for n in orders)}"
    turning = f", at {m.speed * TURN:.6g} 1/min" if m.speed else ""
    head = title_line(record, f"loop of {'a record' if m.of == 'record' else 'an estimate'}", m.status)
    about = f"model {m.model}{turning}; controller: {origin}"
    opened = [
        (axis if k == 0 else "", name, *opening_cells(opening))
        for axis, of_axis in m.margins.items()
        for k, (name, opening) in enumerate((("position", of_axis.position), ("input", of_axis.command)))
    ]
    soft = [(axis, sized(1.0 / c.largest, "N/m"), sized(c.frequency_hz, "Hz")) for axis, c in m.compliance.items()]
    return [
        Section(parts=[Lines(lines=[head, about], wrap=False)]),
        _sensitivity(m),
        Section(
            heading=[("margins, one loop opened, the others closed", "strong")],
            parts=[grid([("axis", "opened at", "gain", "phase", "delay", "disk margin", "peak"), *opened])],
        ),
        Section(
            heading=[("compliance at the magnets", "strong")],
            parts=[grid([("axis", "least dynamic stiffness", "at"), *soft])],
        ),
        *_room(m),
        *ending(m),
    ]


def _sensitivity(m: Margins) -> Section:
    rows: list[tuple[str, ...]] = [("axis", "peak", "at", "zone", "measured", "bandwidth")]
    for axis, s in m.sensitivity.items():
        peak = f"{pure(s.peak_db.value, s.peak_db.sd)} dB"
        wide = _NONE if s.bandwidth_hz is None else sized(s.bandwidth_hz, "Hz")
        rows.append((axis, peak, sized(s.frequency_hz, "Hz"), s.rating.words, _measured(s), wide))
    limits = m.standard["limits_db"]
    assert isinstance(limits, list | tuple)
    ends = " and ".join([", ".join(f"{x:g}" for x in limits[:-1]), f"{limits[-1]:g}"])
    lines = [
        f"zones end at {ends} dB; check these limits against the text of the standard",
        "a zone is that of the measured peak where there is one, by its 95 % interval",
    ]
    if len(m.sensitivity) > 1:
        top, hz = (float(str(m.largest_singular[name])) for name in ("peak_db", "frequency_hz"))
        lines.append(f"all axes together, largest singular value: {top:.2f} dB at {sized(hz, 'Hz')}")
    return Section(
        heading=[(f"sensitivity at the position signals (zones of {STANDARD})", "strong")],
        parts=[grid(rows), Lines(lines=lines, wrap=False)],
    )


def _measured(s: AxisSensitivity) -> str:
    if s.measured_peak_db is None or s.measured_frequency_hz is None:
        return _NONE
    return f"{pure(s.measured_peak_db, s.measured_sd_db or 0.0)} dB at {sized(s.measured_frequency_hz, 'Hz')}"


def opening_cells(opening: Opening) -> tuple[str, ...]:
    """Write gain, phase, delay, disk margin and peak of a loop that is opened."""
    gain = f"{_number(opening.gain_down)} … {_number(opening.gain_up)}"
    phase = _NONE if opening.phase_deg is None else f"{opening.phase_deg:.0f}°"
    delay = _NONE if opening.delay_s is None else sized(opening.delay_s, "s")
    d = opening.disk
    disk = _NONE if d is None else f"{_number(d.gain_down)} … {_number(d.gain_up)}, {d.phase_deg:.0f}°"
    return (gain, phase, delay, disk, f"{opening.peak_db:.2f} dB")


def _number(x: float | None) -> str:
    return "any" if x is None else f"{x:.2g}"


def _room(m: Margins) -> list[Section]:
    """Noise, and what comes to a limit first: a row an axis; nothing where neither noise nor limits are known."""
    if m.noise is None and all(r.force_step is None for r in m.room.values()):
        return []
    rows: list[tuple[str, ...]] = [("axis", *QUANTITIES, "force step", "unbalance")]
    for axis, r in m.room.items():
        force = _NONE if r.force_step is None else f"{sized(r.force_step, 'N')}, {r.force_limit}"
        turned = _NONE if r.unbalance is None else f"{1e6 * r.unbalance:.3g} g mm, {r.unbalance_limit}"
        rows.append((axis, *(_demand(r.quantities.get(q), unit) for q, unit in QUANTITIES.items()), force, turned))
    source = "not known" if m.noise is None else f"of the {m.noise}"
    title = f"noise ({source}), rms in the room before a limit; what comes to its limit first"
    lines, v = list[str](), m.vibration
    if v is not None:
        top, hz, role = max(
            (float(x.max()), float(v.frequency_hz[int(np.argmax(x))]), n) for n, x in v.amplitude.items()
        )
        clear = "" if v.clearance is None else f", {100.0 * top / v.clearance:.2g} % of the clearance"
        most = f"up to {sized(top, 'm')}{clear} ({role} at {60 * hz:.0f} 1/min)"
        lines.append(f"unbalance and run-out of the rig: {most}")
    return [Section(heading=[(title, "strong")], parts=[grid(rows), Lines(lines=lines, wrap=False)])]


def _demand(demand: Demand | None, unit: str) -> str:
    if demand is None or (demand.rms is None and demand.room is None):
        return _NONE
    if demand.room is None:
        return sized(demand.rms or 0.0, unit)
    share = "" if demand.rms is None or not demand.room else f"{100.0 * demand.rms / demand.room:.2g} % of "
    return f"{share}{sized(demand.room, unit)}"


_DB = (-12.0, 16.0)


def margins_figure(margins: Margins, title: str, width: float) -> Figure:
    """Draw sensitivity and compliance, a row an axis."""
    axes = list(margins.sensitivity)
    block = Block(
        columns=[
            [panel(sensitivity_panel, margins, axis, height=2.2) for axis in axes],
            [panel(_compliance, margins, axis, height=2.2) for axis in axes],
        ],
        widths=(3.0, 2.0),
    )
    blocks, curves = [block], margins.curves
    if curves.stiffness:
        dynamic = [
            panel(signed_panel, curves.frequency_hz, values, name, unit, height=2.2)
            for values, name, unit in (
                (curves.stiffness, "dynamic stiffness", "N/m"), (curves.damping, "dynamic damping", "N s/m")
            )
        ]  # fmt: skip
        blocks.append(Block(columns=[[x] for x in dynamic], widths=(1.0, 1.0), shared=False))
    if margins.vibration is not None:
        blocks.append(Block(columns=[[panel(_vibration, margins.vibration, height=2.2)]], shared=False))
    return stacked(title, blocks, width)


def zone_lines(axes: Axes) -> None:
    """Draw the borders of the zones of ISO 14839-3 over sensitivities in dB."""
    for k, (most, zone) in enumerate(ZONES):  # names side by side: the borders are nearer than a line of text
        level = 20.0 * math.log10(most)
        axes.axhline(level, color=BOUND, linestyle=":", linewidth=0.9)
        axes.annotate(
            f"zone {zone}", (1.0, level), xycoords=("axes fraction", "data"), xytext=(-4 - 42 * k, -2),
            textcoords="offset points", ha="right", va="top", fontsize=8, color=BOUND,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.3},
        )  # fmt: skip


def sensitivity_panel(axes: Axes, margins: Margins, axis: str) -> None:
    """Draw the sensitivity of an axis, predicted and measured, within the zones."""
    curves, s = margins.curves, margins.sensitivity[axis]
    measured = curves.measured.get(axis)
    if measured is not None:
        size = 20.0 * np.log10(np.maximum(measured.ratio, 1e-12))
        axes.plot(measured.frequency_hz, size, ".", color=MEASURED, markersize=3, alpha=0.6, label="measured")
    predicted = 20.0 * np.log10(np.abs(curves.sensitivity[axis]))
    axes.plot(curves.frequency_hz, predicted, color=PREDICTED, label="plant and controller")
    zone_lines(axes)
    log_axis(axes.xaxis, float(curves.frequency_hz[0]), float(curves.frequency_hz[-1]))
    axes.set_ylim(_DB[0], max(_DB[1], s.peak_db.value + 2.0))
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel("sensitivity [dB]")
    zone = s.rating
    good, hz = zone.worst in LONG_TERM, s.measured_frequency_hz if zone.source == "measured" else s.frequency_hz
    head(axes, f"axis {axis}: {zone.source} {zone.value:.2f} dB at {hz:.3g} Hz, zone {zone.words}", good=good)


def _compliance(axes: Axes, margins: Margins, axis: str) -> None:
    size, compliance = margins.curves.compliance[axis], margins.compliance[axis]
    scale, unit = prefixed(compliance.largest, "m/N")
    axes.plot(margins.curves.frequency_hz, size / scale, color=PREDICTED)
    f = margins.curves.frequency_hz
    log_axis(axes.xaxis, float(f[0]), float(f[-1]))
    log_axis(axes.yaxis, max(float(size.min()), 1e-5 * compliance.largest) / scale, compliance.largest / scale)
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel(f"compliance [{unit}]")
    head(axes, f"least stiffness {sized(1.0 / compliance.largest, 'N/m')} at {compliance.frequency_hz:.3g} Hz")


def signed_panel(axes: Axes, frequency_hz: Array, values: Mapping[str, Array], name: str, unit: str) -> None:
    """Draw quantities of either sign by axis, in the logarithm beyond their smallest size over the frequencies."""
    size = np.abs(np.concatenate(list(values.values())))
    least = float(np.quantile(size, 0.3))
    scale, unit = prefixed(least, unit)
    for axis, x in values.items():
        axes.plot(frequency_hz, x / scale, label=axis if len(values) > 1 else None)
    decade = (1.0 + 1e-9) * 10.0 ** round(math.log10(max(least / scale, 1e-300)))  # just above: no tick below
    axes.set_yscale("symlog", linthresh=decade, linscale=2.0)
    axes.axhline(0.0, color=BOUND, linewidth=0.6)
    log_axis(axes.xaxis, float(frequency_hz[0]), float(frequency_hz[-1]))
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel(f"{name} [{unit}]")


def _vibration(axes: Axes, vibration: Vibration) -> None:
    """Draw the vibration over the speed, and the clearance where it is near."""
    top = max(float(x.max()) for x in vibration.amplitude.values())
    scale, unit = prefixed(top, "m")
    for role, x in vibration.amplitude.items():
        axes.plot(60.0 * vibration.frequency_hz, x / scale, label=role.replace("_", " "))
    if vibration.clearance is not None and vibration.clearance < 3.0 * top:
        axes.axhline(vibration.clearance / scale, color=BOUND, linestyle="--", label="clearance")
    axes.set_ylim(0.0, None)
    axes.margins(x=0.0)
    axes.set_xlabel("speed [1/min]")
    axes.set_ylabel(f"vibration [{unit}]")
    clear = "no clearance is given" if vibration.clearance is None else f"clearance {sized(vibration.clearance, 'm')}"
    head(axes, f"unbalance{' and run-out' if vibration.runout else ''} of the rig; {clear}")
