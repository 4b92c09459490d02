"""What is said of a device: an acquisition under way and at its end, and the steps of a commissioning."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ambid.errors import counted
from ambid.record import read_record
from ambid.report.document import Document, Lines, Section, Table, grid, numbers_of
from ambid.report.text import Cell
from ambid.settings.caller import setting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ambid.acquisition.device import Counters
    from ambid.acquisition.quality import ColumnQuality, QualityReport
    from ambid.acquisition.recorder import Recorded
    from ambid.acquisition.session import Acquired


_SHOWN = ("position", "current")  # roles whose signal-to-noise ratio is worth a place on the line

_ORDERED = ("voltage", "excitation", "reference")  # what the controller orders is known, and has no noise


def progress_line(q: QualityReport, counters: Counters) -> str:
    """Write in a short line how an acquisition goes: time, rate, gaps, signal-to-noise ratio, saturation."""
    parts = [f"{q.seconds:.1f} s", _rate(q), f"{q.lost} lost"]
    if counters.damaged:
        parts.append(f"{counters.damaged} damaged")
    # before some periods of an excitation are over, nobody knows what is signal
    columns = [c for c in q.columns if c.role in _SHOWN and c.snr_db is not None and c.noise_by == "periods"]
    parts += [f"{c.role} {c.snr_db:.0f} dB" for c in columns]
    saturated = max((c.saturated for c in q.columns), default=0.0)
    if saturated > 0.0:
        parts.append(f"saturated {100.0 * saturated:.1f} %")
    return ", ".join(parts)


def _rate(q: QualityReport) -> str:
    """The rate as it comes; of a bench that is played faster than real, how much faster."""
    pace = q.measured_hz / q.rate_hz
    if not math.isfinite(pace):
        return f"{q.rate_hz:g} Hz"
    return f"{q.measured_hz:.0f} Hz" if 0.5 < pace < 2.0 else f"{q.rate_hz:g} Hz at {pace:.2g} times real time"


def acquired_document(acquired: Acquired, source: Any) -> Document:
    """Describe an acquisition; `source`: where its record lies."""
    a = acquired
    path = "no record" if a.recorded is None else str(a.recorded.path)

    def drawn(width: float) -> Figure:
        from ambid.report.record import record_figure

        at = source or (a.recorded is not None and a.recorded.path)
        record = read_record(at, gaps="interpolate") if at and Path(at).exists() else None
        return record_figure(record, f"{path}, from {a.info.kind} {a.info.port}", a.quality.columns, width)

    return Document(
        title=f"{path}, {a.stored} samples from {a.info.kind} {a.info.port}", sections=acquired_sections(a),
        figure=drawn, frame=lambda: ("name", numbers_of(a.quality.columns)),
    )  # fmt: skip


def recorded_document(recorded: Recorded, source: Any) -> Document:
    """Describe what was recovered from a journal; `source`: where the record lies."""
    r = recorded
    title = f"{r.path}, {r.survey.samples} samples from a journal"

    def drawn(width: float) -> Figure:
        from ambid.report.record import record_figure

        return record_figure(read_record(source or r.path, gaps="interpolate"), title, (), width)

    return Document(
        title=title, sections=recorded_sections(r), figure=drawn,
        frame=lambda: ("path", {"path": [str(r.path)], **numbers_of([r.survey])}),
    )  # fmt: skip


def acquired_sections(acquired: Acquired) -> list[Section]:
    """Say what an acquisition gave."""
    info, run, q, stored = acquired.info, acquired.run, acquired.quality, acquired.stored
    path = "no record" if acquired.recorded is None else acquired.recorded.path
    whole = "" if stored == run.wanted else f" of {run.wanted} wanted"
    head = (
        f"{path}: {counted(stored, 'sample')}{whole} at {q.rate_hz:g} Hz ({stored / q.rate_hz:.4g} s) from "
        f"{info.kind} {info.port}"
    )
    counters = acquired.counters
    words = (
        f"{counted(run.lost, 'sample')} lost, {counted(counters.damaged, 'frame')} damaged, "
        f"{counted(counters.overruns, 'block')} overrun"
    )
    if run.lost:
        words += f"; read it with {setting('gaps')}"
    busy = counters.controller.get("busy_us")
    if busy is not None:
        words += f"; longest controller tick {busy:.0f} us"
    return [
        Section(parts=[Lines(lines=[head])]),
        Section(title="Columns", parts=[_table(q)]),
        Section(parts=[Lines(lines=[_noise_words(q)], style="dim"), Lines(lines=[words])]),
    ]


def recorded_sections(recorded: Recorded) -> list[Section]:
    """Say what a journal held."""
    survey, damage = recorded.survey, recorded.survey.damage
    text = (
        f"{recorded.path}: {counted(survey.blocks, 'block')}, {counted(survey.samples, 'sample')}, "
        f"{survey.samples / recorded.rate_hz:.6g} s; {'complete' if damage.closed else 'cut off while recording'}"
    )
    if damage.tail_bytes and not damage.closed:
        text += f"; {counted(damage.tail_bytes, 'byte')} at the end of the journal are not a whole block"
    return [Section(parts=[Lines(lines=[["", text]], hang=True)])]


def _noise_words(q: QualityReport) -> str:
    """Say what the column of noise is: neither way of telling it knows what the sensor's own noise is."""
    if q.columns and q.columns[0].noise_by == "periods":
        return (
            "noise: what does not repeat with the excitation (sensor noise and the response to disturbances); SNR: "
            "the repeating part over it"
        )
    return "noise: upper bound from sample-to-sample changes; fast motion counts as noise"


def _table(q: QualityReport) -> Table:
    """Return one row for each column, in its own unit; SNR only where an excitation tells signal from noise."""
    labels = ("column", "mean", "rms about it", "noise", "SNR", "range used", "saturated")
    rows: list[Sequence[Cell]] = [[(label, "dim") for label in labels]]
    for c in q.columns:
        unit = "" if c.unit == "1" else f" {c.unit}"
        sensed = c.role not in _ORDERED
        rows.append(
            (
                f"{c.name} [1]" if c.unit == "1" else c.name,
                f"{c.mean:.4g}{unit}",
                f"{c.sd:.3g}{unit}",
                f"{c.noise_sd:.2g}{unit}" if sensed else "-",
                _decibels(c) if sensed and q.excited else "-",
                "-" if c.used is None else f"{100.0 * c.used:.0f} %",
                f"{100.0 * c.saturated:.2g} %",
            )
        )
    return grid(rows)


def _decibels(c: ColumnQuality) -> str:
    if c.snr_db is None:
        return "-"
    return f"{c.snr_db:.1f} dB" if math.isfinite(c.snr_db) else "no noise"
