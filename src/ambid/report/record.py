"""Figures of records: every channel over time, close, and over frequency, with its noise and its faults."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.errors import AmbidError, counted
from ambid.estimation.result import RecordEntry
from ambid.record import Record
from ambid.report.document import Document, Lines, Section, grid, numbers_of
from ambid.report.drawing import (
    BOUND,
    GREEN,
    MEASURED,
    ORANGE,
    PREDICTED,
    WIDE,
    Block,
    curve,
    head,
    into,
    log_axis,
    panel,
    said_panel,
    stacked,
)
from ambid.report.numbers import prefixed, sized
from ambid.report.text import Line
from ambid.signals.faults import find_dropouts, find_outliers, find_saturation, resolution
from ambid.signals.spectra import power_spectrum, snr
from ambid.units import UNKNOWN

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ambid.validation.inspection import ChannelLook, Inspection


_MOST = 8  # channels that are drawn

_CLOSE = 200  # samples of a close view

_ROW = 1.6  # inches


def record_figure(
    record: Record | None, title: str, looks: Sequence[Any] = (), width: float = WIDE, ax: Any = None
) -> Figure:
    """Draw every channel of a record; without a record the range, mean and spread of each, from `looks`.

    `looks`: with ``name``, ``unit``, ``least``, ``most``, ``mean`` and ``sd`` of each channel; `ax`: axes to draw into.
    """
    channels: Sequence[Any] = looks if record is None else record.channels
    names = [c.name for c in channels[:_MOST]]
    hidden = f" (the first {_MOST} of {len(channels)} channels)" if len(channels) > _MOST else ""
    if not names:
        return stacked(title, [said_panel("no channels")], width)
    if record is None:
        block = Block(columns=[[panel(_range, c, height=0.9) for c in looks[:_MOST]]], shared=False)
    else:
        views: Sequence[Callable[..., object]] = (_whole, _close, _spectrum)
        columns = [[panel(view, record, name, height=_ROW) for name in names] for view in views]
        block = Block(columns=columns, widths=(4, 3, 3))
    return into(ax, lambda: stacked(f"{title}{hidden}", [block], width))


def inspection_document(inspection: Inspection, source: Record | None) -> Document:
    """Describe what a record holds."""
    i, name = inspection, RecordEntry.of(inspection.record).name
    return Document(
        title=f"{name}, {i.record['samples']} samples at {i.record['rate_hz']:g} Hz", sections=inspection_sections(i),
        figure=partial(record_figure, source, f"{name}: channels", i.channels),
        frame=lambda: ("name", numbers_of(i.channels)),
    )  # fmt: skip


def inspection_sections(inspection: Inspection) -> list[Section]:
    """Say what a record holds: its channels, the columns for each role, its history."""
    i, record = inspection, RecordEntry.of(inspection.record)
    head: Line = [
        (record.name, "strong"),
        f": {counted(record.samples, 'sample')} at {record.rate_hz:.6g} Hz, {record.seconds:.6g} s from "
        f"{record.start_s:g} s",
    ]
    rows: list[tuple[str, ...]] = [("channel", "unit", "min", "max", "mean", "sd", "step", "SNR")]
    rows += [_row(c) for c in i.channels]
    mark: list[Line] = [] if i.faults else [[("✓", "good"), " no saturation, drop-outs or outliers"]]
    likely: list[Line] = []
    for role, names in i.roles.items():
        likely += names and [[(f"{role}: likely", "strong"), f" {names[0]}"], *(f"  or {x}" for x in names[1:])]
    history = [f"history: {'; '.join(record.history)}"] if record.history else []
    return [
        Section(parts=[Lines(lines=[head], indent=2)]),
        Section(title="Channels", parts=[grid(rows, right=range(2, 8))]),
        *(Section(parts=[Lines(lines=lines, indent=2)]) for lines in ([*mark, *i.notes], likely, history)),
    ]


def _row(c: ChannelLook) -> tuple[str, ...]:
    size = max(abs(c.least), abs(c.most))
    scale, unit = (1.0, c.source_unit) if c.unit in (UNKNOWN, "1") else prefixed(size, c.unit)
    numbers = [f"{v / scale:.5g}" for v in (c.least, c.most, c.mean, c.sd)]
    return c.name, f"[{unit}]", *numbers, "–" if c.step is None else f"{c.step / scale:.3g}", c.snr


def _scale(record: Record, name: str) -> tuple[float, str]:
    c = record.channel(name)
    return (1.0, c.source_unit) if c.unit in (UNKNOWN, "1") else prefixed(float(np.max(np.abs(c.values))), c.unit)


def _whole(axes: Axes, record: Record, name: str) -> None:
    """All samples, the limits where the channel is clipped, drop-outs and outliers."""
    x, t, (scale, unit) = record.channel(name).values, record.time_s, _scale(record, name)
    curve(axes, t, x / scale, MEASURED, "samples, or their extremes")
    clipped, lost, far = (_found(look, record, name) for look in (find_saturation, find_dropouts, find_outliers))
    for limit in (clipped.lower, clipped.upper) if clipped else ():
        if limit:
            axes.axhline(limit.value / scale, color=BOUND, linestyle="--", linewidth=1.0, label="saturated here")
    for first, count in lost.spans if lost else ():
        axes.axvspan(t[first], t[first + count - 1], color=ORANGE, alpha=0.4, label="drop-out")
    if far and far.count:
        axes.plot(t[far.indices], x[far.indices] / scale, "x", color=BOUND, markersize=5, label="outlier")
    first, last = _middle(x.size)
    axes.axvspan(t[first], t[last - 1], color=PREDICTED, alpha=0.25, linewidth=0, label="shown close")
    axes.set_ylabel(f"{name} [{unit}]")
    axes.set_xlabel("time [s]")
    faults = [f"{100 * clipped.fraction:.2g} % saturated"] if clipped and clipped.count else []
    faults += [_lost(lost.count, x.size)] if lost and lost.count else []
    faults += [counted(far.count, "outlier")] if far and far.count else []
    head(axes, f"{name}: {', '.join(faults) or 'no saturation, drop-outs or outliers'}", good=not faults)


def _lost(count: int, n: int) -> str:
    return "never changes" if count == n else f"{counted(count, 'sample')} lost"


def _found(look: Callable[[Record, str], Any], record: Record, name: str) -> Any:
    try:
        return look(record, name)
    except AmbidError:  # too short to tell
        return None


def _middle(n: int) -> tuple[int, int]:
    first = max(0, (n - _CLOSE) // 2)
    return first, min(n, first + _CLOSE)


def _close(axes: Axes, record: Record, name: str) -> None:
    x, scale = record.channel(name).values, _scale(record, name)[0]
    at = slice(*_middle(x.size))
    axes.plot(record.time_s[at], x[at] / scale, ".-", color=MEASURED, markersize=2.5, linewidth=0.7)
    axes.set_xlabel("time [s]")
    steps = _found(resolution, record, name)
    physical = record.channel(name).unit not in (UNKNOWN, "1")
    quantised = steps is not None and steps.quantised and steps.step > 0
    size = (
        sized(steps.step, record.channel(name).unit) if quantised and physical else f"{steps.step:.3g}" if steps else ""
    )
    head(axes, f"{name}, {min(x.size, _CLOSE)} samples" + (f", steps of {size}" if quantised else ""))


def _spectrum(axes: Axes, record: Record, name: str) -> None:
    """Amplitude density, beside those of the noise and of the rounding to whole steps."""
    x, rate_hz = record.channel(name).values, record.rate_hz
    axes.set_xlabel("frequency [Hz]")
    if not np.ptp(x) > 0:
        head(axes, f"{name} is constant", good=False)
        return
    spectrum = power_spectrum(x, rate_hz)
    size = np.sqrt(spectrum.density[1:])
    unit = record.channel(name).unit
    top = float(size.max())
    scale, shown_unit = (1.0, "1") if unit in (UNKNOWN, "1") else prefixed(top, unit)
    axes.semilogx(spectrum.frequency_hz[1:], size / scale, color=MEASURED, linewidth=0.9, label="spectrum")
    noise, steps = _found(snr, record, name), _found(resolution, record, name)
    levels = [(noise.noise_sd, GREEN, "noise, unpredictable part")] if noise else []
    levels += [(steps.noise_sd, ORANGE, "rounding to steps")] if steps else []
    lowest = float(size[size > 0].min(initial=top))
    for sd, color, label in levels:
        if sd > 0:
            level = sd * np.sqrt(2 / rate_hz)
            lowest = min(lowest, level)
            axes.axhline(level / scale, color=color, linewidth=1.2, linestyle="--", label=label)
    log_axis(axes.yaxis, max(lowest / 2, 1e-9 * top) / scale, 2 * top / scale)
    axes.set_ylabel(f"[{shown_unit}/√Hz]")
    head(
        axes, f"{name}, signal over noise {noise.db:.0f} dB" if noise and np.isfinite(noise.db) else f"{name}, spectrum"
    )


def _range(axes: Axes, c: Any) -> None:
    """Smallest, largest and mean value of a channel and its standard deviation."""
    physical = c.unit not in (UNKNOWN, "1")
    scale, unit = prefixed(max(abs(c.least), abs(c.most)), c.unit) if physical else (1.0, c.unit)
    axes.plot(np.array([c.least, c.most]) / scale, [0, 0], "|-", color=MEASURED, label="range")
    axes.errorbar(c.mean / scale, 0, xerr=c.sd / scale, fmt="o", color=PREDICTED, capsize=4, label="mean ± sd")
    axes.set_yticks([])
    axes.set_xlabel(f"{c.name} [{unit}]")
