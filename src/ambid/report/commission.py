"""A commissioning for people: its steps, each with what it found and saw; the same page where it ended early."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.acquisition.trials import Pulse
from ambid.arrays import Array
from ambid.control.design import Design
from ambid.control.margins import Margins
from ambid.estimation.estimate import fields_json
from ambid.report.design import loops_block
from ambid.report.document import Document, Lines, Part, Preformatted, Section, Table, grid
from ambid.report.drawing import (
    BAND,
    BOUND,
    MEASURED,
    ORANGE,
    PREDICTED,
    Block,
    curve,
    head,
    log_axis,
    panel,
    single,
    stacked,
)
from ambid.report.margins import sensitivity_panel
from ambid.report.numbers import prefixed, sized
from ambid.report.text import WIDTH, Cell, Line
from ambid.settings.caller import command, setting
from ambid.signals.spectra import power_spectrum
from ambid.simulation.margins import LoopMargins

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_NO_NUMBERS: Mapping[str, float] = MappingProxyType({})


_SEEN = frozenset({"pictures", "parts"})  # of the page, not of the file


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One step, done."""

    name: str
    findings: tuple[str, ...] = ()  # what was measured, one line each
    reasons: tuple[str, ...] = ()  # why it is not good enough, and what to do, one line each; empty: it is
    cautions: tuple[str, ...] = ()  # what a reader should know although the step is good enough
    numbers: Mapping[str, float] = field(default_factory=lambda: _NO_NUMBERS)  # the same as numbers, SI
    pictures: tuple[Picture, ...] = ()  # what it saw
    parts: tuple[Part, ...] = ()  # tables and lines that a page shows beside
    remedy: str = ""  # what to do after it where it is not what its kind of step asks for

    @property
    def passed(self) -> bool:
        """Whether commissioning may go on."""
        return not self.reasons

    def as_json(self) -> dict[str, object]:
        """Return its fields and whether it ``passed``, without what is only for the page; what is not known is None."""
        return {**fields_json(self, without=tuple(_SEEN)), "passed": self.passed}


def _still() -> str:
    own_page = command("identify", "record.h5", rig="rig.toml", report="record.html")
    return (
        "Signals of this page stand still. The record's own page, in which they are zoomed down to the samples, is "
        f"written in this folder by: {own_page}"
    )


def commission_document(
    commissioned: Any, device: str, rig: str, more: Mapping[str, Callable[[], Sequence[Section]]]
) -> Document:
    """Describe a commissioning, also one that ended early.

    `device`: which and where, `rig`: its text; `more`: by step, sections of the page that follow its own.
    """
    c, title = commissioned, f"Commissioning: {commissioned.rig.name}"
    count = len(c.names)

    parts = [part for k, step in enumerate(c.steps, 1) for part in step_section(step, f"{k}/{count}").parts]

    def pages() -> list[Section]:
        recorded = any(step.name == "record" for step in c.steps)
        sections = [Section(title="Steps", parts=[_overview(c.steps, c.names)], note=_still() if recorded else "")]
        for step in c.steps:
            sections.append(_section(step, f"{c.names.index(step.name) + 1}. {step.name}"))
            sections += [
                Section(title=p.title, caption=p.caption, figure=partial(single, p.block)) for p in step.pictures[1:]
            ]
            sections += more[step.name]() if step.name in more else ()
        return [*sections, *([Section(title="Rig", parts=[Preformatted(text=rig)], folded=True)] if rig else [])]

    return Document(
        title=title, subtitle=device,
        sections=[Section(parts=parts, page=False)],
        figure=lambda width: stacked(title, [p.block for step in c.steps for p in step.pictures], width),
        frame=lambda: ("step", {"step": [s.name for s in c.steps], "passed": [s.passed for s in c.steps]}),
        drawings=pages,
        provenance=[("rig", str(c.rig.source or c.rig.name)), ("device", device), ("folder", str(c.folder))],
    )  # fmt: skip


def _overview(steps: Sequence[Step], names: Sequence[str]) -> Table:
    """One row for each step, those that were not reached too."""
    rows: list[Sequence[Cell]] = [("", "outcome", "")]
    done = {step.name: step for step in steps}
    for k, name in enumerate(names, 1):
        step = done.get(name)
        if step is None:
            rows.append((f"{k}. {name}", ("not reached", "dim"), ""))
        elif step.passed:
            words: Cell = ("passed", "good") if not step.cautions else ("passed, see the note", "doubt")
            rows.append((f"{k}. {name}", words, (step.findings[-1] if step.findings else "", "")))
        else:
            rows.append((f"{k}. {name}", ("stopped", "bad"), (step.reasons[0], "")))
    return grid(rows)


def _section(step: Step, title: str) -> Section:
    """What a step found, why it stopped, and its first picture."""
    rows: list[Sequence[Cell]] = [("", "what stands against it")]
    rows += [("stopped", (text, "bad")) for text in step.reasons]
    rows += [("note", (text, "doubt")) for text in step.cautions]
    picture = step.pictures[0] if step.pictures else None
    return Section(
        title=f"{'✓' if step.passed else '✗'} {title}",
        parts=[
            Lines(lines=[text for text in step.findings if text]),
            *([grid(rows)] if len(rows) > 1 else []),
            *step.parts,
        ],
        figure=None if picture is None else partial(single, picture.block),
        note="" if picture is None else picture.caption,
    )


Bounds = Mapping[str, tuple[float, float]]  # trips by role, SI

UNITS = {"position": "m", "current": "A", "voltage": "V"}

_MOST = 20_000  # samples of a trace that are kept

_PULSES = 4  # beside each other

_BEGIN_S = 0.25  # of lift-off that is drawn closer

_ROW = 1.5  # inches

_CIRCLE = 3.0  # sensitivity of the circle around -1


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """What a step saw, drawn when a page asks for it."""

    title: str
    caption: str
    block: Block


def rest_picture(signals: Mapping[str, Array], rate_hz: float) -> Picture:
    """Traces of the sensors with the output off, about their means, and the density of their noise."""
    about = {
        role: signals[role] - signals[role].mean()
        for role in ("position", "current")
        if signals.get(role, _NONE).size > 1
    }
    traces = [panel(_trace, role, values, rate_hz, (), height=_ROW) for role, values in about.items()]
    spectra = [panel(_spectrum, role, values, rate_hz, height=_ROW) for role, values in about.items()]
    return Picture(
        title="Sensors at rest",
        caption="Output off: the noise of the sensors alone. A line in the spectrum is pick-up: mains, or a converter.",
        block=Block(columns=[traces, spectra], widths=(3.0, 2.0)),
    )


def pulses_picture(pulses: Sequence[Pulse]) -> Picture:
    """The first pulses and the last ones, with what the current and the position did."""
    numbered = list(enumerate(pulses, 1))
    panels_of = [*numbered[: _PULSES // 2], *numbered[max(_PULSES // 2, len(pulses) - _PULSES // 2) :]]
    reach = {role: max(float(np.max(np.abs(_about_begin(p, role)), initial=0.0)) for p in pulses) for role in UNITS}
    columns = [
        [panel(_pulse, k, p, role, reach[role], height=_ROW) for role in ("voltage", "current", "position")]
        for k, p in panels_of
    ]
    return Picture(
        title="Polarity pulses",
        caption=f"{len(panels_of)} of {len(pulses)} pulses without feedback, each about what was before it; shaded"
        " while the voltage is ordered. They grow until the rotor leaves its stop.",
        block=Block(columns=columns),
    )


def trace_picture(
    title: str,
    caption: str,
    signals: Mapping[str, Array],
    rate_hz: float,
    trips: Bounds,
    *,
    from_s: float | None = None,
) -> Picture:
    """Traces by role over time with the controller's trips; the beginning closer, and shaded, up to `from_s`."""
    drawn = {role: signals[role][:_MOST] for role in UNITS if signals.get(role, _NONE).size}
    whole = [panel(_trace, role, y, rate_hz, trips.get(role, ()), from_s, height=_ROW) for role, y in drawn.items()]
    if from_s is None:
        return Picture(title=title, caption=caption, block=Block(columns=[whole]))
    n = round(_BEGIN_S * rate_hz)
    begin = [panel(_trace, role, y[:n], rate_hz, trips.get(role, ()), height=_ROW) for role, y in drawn.items()]
    return Picture(title=title, caption=caption, block=Block(columns=[begin, whole], widths=(2.0, 3.0)))


def trials_picture(
    tried: Sequence[tuple[float, float]], use: float, last: Mapping[str, Array], rate_hz: float, trips: Bounds
) -> Picture:
    """Which part of the available range each amplitude used, and the position of the last trial within its trips."""
    role = "position" if "position" in last else "current"
    columns = [[panel(_trials, tried, use, height=2.4)]]
    if last.get(role, _NONE).size:
        columns.append([panel(_trace, role, last[role][:_MOST], rate_hz, trips.get(role, ()), height=2.4)])
    return Picture(
        title="Trials of the amplitude",
        caption="The amplitude grows from trial to trial until it uses its part of the way to the nearest trip. The"
        " last trial over time; dashed: the controller's trips.",
        block=Block(columns=columns, widths=(2.0, 3.0)[: len(columns)], shared=False),
    )


def margins_picture(loops: Mapping[str, LoopMargins], margins: Margins | None) -> Picture:
    """Nyquist curve of loops by name, and the sensitivity at the position within the zones of ISO 14839-3."""
    caption = (
        "Nyquist curve of the loop opened at the controller's output: the farther it stays from -1, the more gain and "
        "phase may change; circle: a sensitivity of 3 there."
    )
    columns = [[panel(_nyquist, loops, height=3.2)]]
    if margins is not None:
        caption += " Sensitivity at the position, by which the loop is judged, with the zones of ISO 14839-3."
        columns.append([panel(sensitivity_panel, margins, "x", height=3.2)])
    widths = (2.0, 3.0)[: len(columns)]
    return Picture(
        title="Margins of the loop", caption=caption, block=Block(columns=columns, widths=widths, shared=False)
    )


def design_picture(design: Design) -> Picture:
    """Both loops of a redesign, as predicted."""
    caption = "On the estimate, and shaded up to the worst of the plants around it; the step is of 1 N."
    return Picture(title="The loop before and after", caption=caption, block=loops_block(design))


def measured_picture(loops: Mapping[str, Margins]) -> Picture:
    """Sensitivity of loops by name, by plant and controller, and as measured."""
    caption = "Lines: by the plant and the controller; dots: as the records show it. Zones of ISO 14839-3."
    panels = [[panel(sensitivity_panel, margins, "x", height=2.6)] for margins in loops.values()]
    return Picture(
        title=f"Measured: {', '.join(loops)}", caption=caption,
        block=Block(columns=panels, widths=(1.0,) * len(panels), shared=False),
    )  # fmt: skip


_NONE: Array = np.empty(0)


def _trace(
    axes: Axes, role: str, values: Array, rate_hz: float, ends: Sequence[float], shaded_s: float | None = None
) -> None:
    """Draw a quantity over time, within its trips."""
    scale, unit = prefixed(float(np.max(np.abs(values), initial=0.0)), UNITS[role])
    curve(axes, np.arange(values.size) / rate_hz, values / scale, MEASURED, None)
    for end in ends:
        if math.isfinite(end):
            axes.axhline(end / scale, color=BOUND, linestyle="--", linewidth=1.0)
    if shaded_s is not None:
        axes.axvspan(0.0, shaded_s, color="#eeeeee", zorder=0)
    axes.set_ylabel(f"{role} [{unit}]")
    axes.set_xlabel("time [s]")
    axes.margins(x=0.0)


def _spectrum(axes: Axes, role: str, values: Array, rate_hz: float) -> None:
    """Draw the amplitude density of a noise."""
    spectrum = power_spectrum(values, rate_hz)
    size = np.sqrt(spectrum.density[1:])
    scale, unit = prefixed(float(size.max()), UNITS[role])
    axes.plot(spectrum.frequency_hz[1:], size / scale, color=PREDICTED, linewidth=1.0)
    if size.min() > 0.0:
        log_axis(axes.yaxis, float(size.min()) / scale, float(size.max()) / scale)
    log_axis(axes.xaxis, float(spectrum.frequency_hz[1]), float(spectrum.frequency_hz[-1]))
    axes.set_ylabel(f"[{unit}/√Hz]")
    axes.set_xlabel("frequency [Hz]")
    head(axes, f"{sized(float(values.std()), UNITS[role])} rms")


def _about_begin(pulse: Pulse, role: str) -> Array:
    """Return a trace of a pulse about its mean before the pulse, (n_samples,), SI."""
    values: Array = getattr(pulse, role)
    before = values[pulse.time_s < 0.0]
    return values - (before.mean() if before.size else 0.0)


def _pulse(axes: Axes, number: int, pulse: Pulse, role: str, reach: float) -> None:
    """Draw one quantity of a pulse, all pulses on one scale."""
    scale, unit = prefixed(reach, UNITS[role])
    axes.axvspan(0.0, 1e3 * pulse.hold_s, color="#f6e3bd", zorder=0)
    axes.plot(1e3 * pulse.time_s, _about_begin(pulse, role) / scale, color=MEASURED)
    axes.set_xlim(-1e3 * pulse.hold_s, 3e3 * pulse.hold_s)
    axes.set_ylim(-1.1 * (reach or scale) / scale, 1.1 * (reach or scale) / scale)
    axes.set_ylabel(f"{role} [{unit}]")
    axes.set_xlabel("time [ms]")
    if role == "voltage":
        head(axes, f"pulse {number}: {sized(pulse.volts, 'V')}")


def _trials(axes: Axes, tried: Sequence[tuple[float, float]], use: float) -> None:
    """Draw what each amplitude used."""
    if tried:
        size, currents = np.array(tried).T
        axes.axhspan(75.0 * use, 120.0 * use, color=BAND, alpha=0.6, linewidth=0, label="wanted")
        axes.plot(size, 100.0 * currents, "o-", color=PREDICTED, markersize=5, linewidth=0.8, label="trial")
    axes.set_ylim(0.0, None)
    axes.set_xlim(0.0, None)
    axes.set_xlabel("amplitude [V]")
    axes.set_ylabel("used of the range [%]")


def _nyquist(axes: Axes, loops: Mapping[str, LoopMargins]) -> None:
    """Draw the loops near the critical point."""
    for (name, loop), (colour, style) in zip(loops.items(), ((PREDICTED, "-"), (ORANGE, "--")), strict=False):
        axes.plot(loop.open_loop.real, loop.open_loop.imag, color=colour, linestyle=style, label=name)
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    axes.plot(np.cos(angle), np.sin(angle), color=MEASURED, linewidth=0.6, linestyle=":")
    axes.plot(-1.0 + np.cos(angle) / _CIRCLE, np.sin(angle) / _CIRCLE, color=BOUND, linewidth=0.9)
    axes.plot(-1.0, 0.0, "+", color=BOUND, markersize=10, markeredgewidth=1.6)
    axes.set_aspect("equal")
    axes.set_xlim(-3.0, 1.5)
    axes.set_ylim(-2.0, 2.0)
    axes.set_xlabel("real part of L")
    axes.set_ylabel("imaginary part of L")
    head(axes, f"at the controller's output: modulus margin {1.0 / max(loop.peak[0] for loop in loops.values()):.2f}")


def step_section(step: Step, place: str) -> Section:
    """Return a step that was done; `place` says which of how many it is, such as ``"2/9"``."""
    mark = ("✗", "bad") if step.reasons else ("✓", "good")
    lines: list[Line] = [["  ", x] for x in step.findings if x]
    cautions: list[Line] = [["  ", f"note: {c}"] for c in step.cautions]
    reasons: list[Line] = [["  ", f"stopped: {r}"] for r in step.reasons]
    return Section(
        parts=[
            Lines(lines=[[mark, f" {place} ", (step.name, "strong")]], wrap=False),
            Lines(lines=lines, hang=True, indent=4),
            Lines(lines=cautions, hang=True, indent=4, style="dim"),
            Lines(lines=reasons, hang=True, indent=4, style="bad"),
        ]
    )


def next_text(
    passed: bool, step: str, number: int, total: int, folder: str, *, command: str = "", remedy: str = ""
) -> str:
    """Say where a commissioning ended, and what to do next.

    `passed`: whether it came to its end; `step`: the last one; `number`, `total`: which of how many it is; `folder`:
    where the files are; `command`: what is said to be run next, on a line of its own; `remedy`: the step's. Returns
    lines without the last line's end.
    """
    if passed:
        said = [
            f"commissioned; {folder} holds rig, records, estimate, report and track.",
            f"Next: read {folder}/report.html; follow the bench while it runs:",
        ]
    else:
        said = [
            f"stopped at {step}, step {number} of {total}; the output is off, and {folder} holds what was found,"
            f" {folder}/report.html shows it.",
            f"Next: {remedy or _next(step, folder)}. Then commission again, into another folder.",
        ]
    lines = [line for text in said for line in textwrap.wrap(text, WIDTH, break_on_hyphens=False)]
    return "\n".join([*lines, *([f"  {command}"] if command else [])])


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
