"""What an acquisition shows while it runs, and what is said of it at its end."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Protocol

from ambid.report.text import WIDTH, Paint, plain

if TYPE_CHECKING:
    from pathlib import Path

    from ambid.acquire.device import Counters, DeviceInfo
    from ambid.acquire.quality import ColumnQuality, QualityReport
    from ambid.acquire.session import RunReport

_SHOWN = ("position", "current")  # roles whose signal-to-noise ratio is worth a place on the line
_ORDERED = ("voltage", "excitation", "reference")  # what the controller orders is known, and has no noise


class Under(Protocol):
    """An acquisition under way: quality and counters so far."""

    @property
    def quality(self) -> QualityReport:
        """Of the samples."""
        ...

    @property
    def counters(self) -> Counters:
        """Of the line."""
        ...


class Finished(Protocol):
    """An acquisition that is over."""

    @property
    def info(self) -> DeviceInfo:
        """Who gave it."""
        ...

    @property
    def run(self) -> RunReport:
        """Of the device."""
        ...

    @property
    def quality(self) -> QualityReport:
        """Of the samples."""
        ...

    @property
    def counters(self) -> Counters:
        """Of the line."""
        ...

    @property
    def not_stored(self) -> int:
        """Samples that came and are not in the record."""
        ...


def progress_line(now: Under) -> str:
    """Write how an acquisition goes: time, rate, gaps, signal-to-noise ratio, saturation.

    `now`: so far. Returns one short line.
    """
    q = now.quality
    parts = [f"{q.seconds:.1f} s", _rate(q), f"{q.lost} lost"]
    if now.counters.damaged:
        parts.append(f"{now.counters.damaged} damaged")
    # before some periods of an excitation are over, nobody knows what is signal
    told = [c for c in q.columns if c.role in _SHOWN and c.snr_db is not None and c.noise_by == "periods"]
    parts += [f"{c.role} {c.snr_db:.0f} dB" for c in told]
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


def acquired_text(done: Finished, path: Path, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write what an acquisition gave, for people.

    `done`: from `ambid.job.acquire.acquire`; `path`: the record; `width`: columns of the terminal; `paint`: adds
    colour; the layout does not depend on it. Returns lines without the last line's end.
    """
    q, counters = done.quality, done.counters
    stored = done.run.samples - done.not_stored - q.repeated
    whole = "" if stored == done.run.wanted else f" of {done.run.wanted} wanted"
    head = (
        f"{path}: {stored} samples{whole} at {q.rate_hz:g} Hz ({stored / q.rate_hz:.4g} s) from"
        f" {done.info.kind} {done.info.port}"
    )
    lines = [*textwrap.wrap(head, width), "", *_table(q, paint), ""]
    lines += [paint(line, "dim") for line in textwrap.wrap(_noise_words(q), width)]
    lines += textwrap.wrap(_line_words(done.run, counters), width)
    if q.verdict:
        lines += ["", *(paint(x, "bad") for v in q.verdict for x in textwrap.wrap(v, width, subsequent_indent="  "))]
    return "\n".join(lines)


def _line_words(run: RunReport, counters: Counters) -> str:
    words = f"{run.lost} samples lost, {counters.damaged} frames damaged, {counters.overruns} blocks overrun"
    if run.lost:
        words += "; read it with --gaps"
    busy = counters.controller.get("busy_us")
    if busy is not None:
        words += f"; the controller worked {busy:.0f} us in its longest tick"
    if math.isfinite(counters.drift):
        words += f"; its clock is {1e6 * counters.drift:+.1f} ± {1e6 * counters.drift_sd:.1f} ppm off"
    return words


def _noise_words(q: QualityReport) -> str:
    """Say what the column of noise is: neither way of telling it knows what the sensor's own noise is."""
    if q.columns and q.columns[0].noise_by == "periods":
        return (
            "noise is what does not repeat with the excitation: the sensor's, and how the bench and its loop answer to"
            " disturbance; SNR is what repeats over it"
        )
    return "noise is what changes from sample to sample, at most: fast motion counts as noise too"


def _table(q: QualityReport, paint: Paint) -> list[str]:
    """Write one row for each column, in its own unit; SNR only where an excitation tells signal from noise."""
    rows = [("column", "mean", "rms about it", "noise", "SNR", "range used", "saturated")]
    for c in q.columns:
        unit = "" if c.unit == "1" else f" {c.unit}"
        sensed = c.role not in _ORDERED
        rows.append(
            (
                c.name,
                f"{c.mean:.4g}{unit}",
                f"{c.sd:.3g}{unit}",
                f"{c.noise_sd:.2g}{unit}" if sensed else "-",
                _decibels(c) if sensed and q.excited else "-",
                "-" if c.used is None else f"{100.0 * c.used:.0f} %",
                f"{100.0 * c.saturated:.2g} %",
            )
        )
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    return [paint(lines[0], "dim"), *lines[1:]]


def _decibels(c: ColumnQuality) -> str:
    if c.snr_db is None:
        return "-"
    return f"{c.snr_db:.1f} dB" if math.isfinite(c.snr_db) else "no noise"
