"""What is said of a device: an acquisition under way and at its end, and the steps of a commissioning."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING

from ambid.errors import counted
from ambid.report.text import WIDTH, Paint, Style, columns, hanging, joined, plain
from ambid.settings.caller import setting

if TYPE_CHECKING:
    from ambid.acquisition.device import Counters
    from ambid.acquisition.quality import ColumnQuality, QualityReport
    from ambid.acquisition.recorder import Recorded
    from ambid.acquisition.session import Acquired, RunReport
    from ambid.report.commission_page import Step

_SHOWN = ("position", "current")  # roles whose signal-to-noise ratio is worth a place on the line
_ORDERED = ("voltage", "excitation", "reference")  # what the controller orders is known, and has no noise


def _next(step: str, folder: object) -> str:
    """Say what to do after a step that was not good enough."""
    return {
        "self-test": "correct what the self-test names; the output was never switched on",
        "rest": "correct sensors, wiring or calibrations; the output was never switched on",
        "polarity": "correct what is reversed, at the bench or in the rig; the rotor was not lifted",
        "levitate": "correct the bench, or [loop], [daq.trip] and the calibrations of the rig",
        "excite": f"give a smaller {setting('amplitude')} or another {setting('band')}, or correct the bench",
        "record": f"remove what disturbed the record; {folder}/record.h5 holds what was recorded",
        "identify": (
            f"record longer ({setting('seconds')}), excite more ({setting('amplitude')}) or in a wider "
            f"{setting('band')}, or correct the rig; the last line here tries a corrected rig without the bench"
        ),
        "validate": (
            f"look at {folder}/estimate.json: the model does not hold for the second record; excite less, or look for "
            "what changed between the two"
        ),
        "load": (
            f"the controller kept levitating with the loop before; look at {folder}/design.json, or commission without "
            f"{setting('redesign')}"
        ),
        "track": (
            f"look for what changed after the record: load, temperature, supply; {folder}/track.jsonl shows when"
        ),
    }.get(step, "see the reason above")


def progress_line(q: QualityReport, counters: Counters) -> str:
    """Write in a short line how an acquisition goes: time, rate, gaps, signal-to-noise ratio, saturation."""
    parts = [f"{q.seconds:.1f} s", _rate(q), f"{q.lost} lost"]
    if counters.damaged:
        parts.append(f"{counters.damaged} damaged")
    # before some periods of an excitation are over, nobody knows what is signal
    known = [c for c in q.columns if c.role in _SHOWN and c.snr_db is not None and c.noise_by == "periods"]
    parts += [f"{c.role} {c.snr_db:.0f} dB" for c in known]
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


def acquired_text(done: Acquired, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write what an acquisition gave, below its verdict; colour does not change the layout."""
    info, run, q, stored = done.info, done.run, done.quality, done.stored
    path = "no record" if done.recorded is None else done.recorded.path
    whole = "" if stored == run.wanted else f" of {run.wanted} wanted"
    head = (
        f"{path}: {counted(stored, 'sample')}{whole} at {q.rate_hz:g} Hz ({stored / q.rate_hz:.4g} s) from "
        f"{info.kind} {info.port}"
    )
    words = [paint(line, "dim") for line in textwrap.wrap(_noise_words(q), width)]
    words += textwrap.wrap(_line_words(run, done.counters), width)
    return joined([textwrap.wrap(head, width), _table(q, paint), words])


def recorded_text(made: Recorded, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write what a journal held, below its verdict."""
    del paint
    found, damage = made.survey, made.survey.damage
    text = (
        f"{made.path}: {counted(found.blocks, 'block')}, {counted(found.samples, 'sample')}, "
        f"{found.samples / made.rate_hz:.6g} s; {'complete' if damage.closed else 'cut off while recording'}"
    )
    if damage.tail_bytes and not damage.closed:
        text += f"; {counted(damage.tail_bytes, 'byte')} at the end of the journal are not a whole block"
    return textwrap.fill(text, width, break_on_hyphens=False)


def _line_words(run: RunReport, counters: Counters) -> str:
    words = (
        f"{counted(run.lost, 'sample')} lost, {counted(counters.damaged, 'frame')} damaged, "
        f"{counted(counters.overruns, 'block')} overrun"
    )
    if run.lost:
        words += f"; read it with {setting('gaps')}"
    busy = counters.controller.get("busy_us")
    if busy is not None:
        words += f"; longest controller tick {busy:.0f} us"
    if math.isfinite(counters.drift):
        words += f"; controller clock off by {1e6 * counters.drift:+.1f} ± {1e6 * counters.drift_sd:.1f} ppm"
    return words


def _noise_words(q: QualityReport) -> str:
    """Say what the column of noise is: neither way of telling it knows what the sensor's own noise is."""
    if q.columns and q.columns[0].noise_by == "periods":
        return (
            "noise: what does not repeat with the excitation (sensor noise and the response to disturbances); SNR: "
            "the repeating part over it"
        )
    return "noise: upper bound from sample-to-sample changes; fast motion counts as noise"


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
    lines = columns(rows)
    return [paint(lines[0], "dim"), *lines[1:]]


def _decibels(c: ColumnQuality) -> str:
    if c.snr_db is None:
        return "-"
    return f"{c.snr_db:.1f} dB" if math.isfinite(c.snr_db) else "no noise"


def step_text(step: Step, place: str, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write a step that was done; `place` says which of how many it is, such as ``"2/9"``."""
    mark = paint("✗", "bad") if step.reasons else paint("✓", "good")
    lines = [f"{mark} {place} {paint(step.name, 'strong')}"]
    said: list[tuple[str, Style | None]] = [(x, None) for x in step.findings if x]
    said += [(f"note: {c}", "dim") for c in step.cautions] + [(f"stopped: {r}", "bad") for r in step.reasons]
    for text, style in said:
        lines += [line if style is None else paint(line, style) for line in hanging("  ", text, width, 4, 2)]
    return "\n".join(lines)


def next_text(
    passed: bool, step: str, number: int, of: int, folder: str, *, command: str = "", width: int = WIDTH
) -> str:
    """Say where a commissioning ended, and what to do next.

    `passed`: whether it came to its end; `step`: the last one; `number`, `of`: which of how many it is; `folder`: where
    the files are; `command`: what is said to be run next, on a line of its own; `width`: columns of the terminal.
    Returns lines without the last line's end.
    """
    if passed:
        said = [
            f"commissioned; {folder} holds rig, records, estimate, report and track.",
            f"Next: read {folder}/report.html; follow the bench while it runs:",
        ]
    else:
        said = [
            f"stopped at {step}, step {number} of {of}; the output is off, and {folder} holds what was found,"
            f" {folder}/report.html shows it.",
            f"Next: {_next(step, folder)}. Then commission again, into another folder.",
        ]
    lines = [line for text in said for line in textwrap.wrap(text, width, break_on_hyphens=False)]
    return "\n".join([*lines, *([f"  {command}"] if command else [])])
