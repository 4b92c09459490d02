"""The design of a controller as tables for the terminal: both loops, the worst plant, the new [loop]."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.arrays import Array
from ambid.control.design import FIGURES, Design, Situation
from ambid.control.verification import KINDS, Case, Verification
from ambid.control.zones import STANDARD, zone_of
from ambid.estimation.result import RecordEntry
from ambid.report.document import Document, Lines, Section, ending, grid, numbers_of
from ambid.report.drawing import BOUND, MEASURED, PREDICTED, Block, head, log_axis, panel, stacked
from ambid.report.margins import opening_cells, zone_lines
from ambid.report.numbers import prefixed, sized
from ambid.report.text import title_line

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_NONE = "–"

NAMES = {
    "peak": "peak of sensitivity", "compliance": "compliance, largest", "noise": "noise in the command",
    "settling": "force step settled", "pole": "slowest pole",
}  # fmt: skip


def design_document(design: Design, _: Any) -> Document:
    """Describe a designed controller."""
    loops = {"before": design.before, "after": design.after}
    worst = {f"worst.{name}": [getattr(s.worst, name) for s in loops.values()] for name in (*FIGURES, "pole")}
    columns: dict[str, list[object]] = {"loop": list(loops), **numbers_of([s.figures for s in loops.values()]), **worst}
    title = f"{RecordEntry.of(design.record).name}, controller for model {design.model}"
    return Document(
        title=title, sections=design_sections(design), figure=partial(design_figure, design, title),
        frame=lambda: ("loop", columns),
    )  # fmt: skip


def design_sections(design: Design) -> list[Section]:
    """Say what was designed."""
    d, goals = design, design.goals
    limits = ", ".join(f"{name} up to {figure_text(name, x).partition(' (')[0]}" for name, x in goals.limits.items())
    aims = f"method {d.method}; small: {' and '.join(goals.minimise)}; limits on all plants: {limits}"
    head = title_line(RecordEntry.of(d.record), f"controller for model {d.model}", d.status)
    rows: list[tuple[str, ...]] = [("axis", "opened at", "loop", "gain", "phase", "delay", "disk margin")]
    for axis in d.after.margins:
        for place in ("position", "command"):
            for words, s in (("before", d.before), ("after", d.after)):
                cells = opening_cells(getattr(s.margins[axis], place))[:4]
                rows.append((axis, place.replace("command", "input"), words, *cells))
    return [
        Section(parts=[Lines(lines=[head], wrap=False), Lines(lines=[aims], indent=2)]),
        _figures(d),
        *_speeds(d),
        Section(heading=[("margins on the estimate, one loop opened", "strong")], parts=[grid(rows)]),
        *([verification_section((d.trials["before"], d.trials["after"]))] if d.trials else []),
        _plants(d),
        _loop(d),
        *ending(d),
    ]


def figure_text(name: str, x: float) -> str:
    """Write a figure."""
    if not np.isfinite(x):
        return _NONE
    if name == "peak":
        decibel = 20.0 * np.log10(x)
        return f"{decibel:.2f} dB ({zone_of(decibel)})"
    return sized(x, {**FIGURES, "pole": "1/s"}[name])


def _zone_of(situation: Situation) -> str:
    return max((s.rating for s in situation.sensitivity.values()), key=lambda z: z.upper_db).words


def _figures(d: Design) -> Section:
    rows: list[tuple[str, ...]] = [("", "before", "after", "worst before", "worst after")]
    for name, words in NAMES.items():
        sizes = [getattr(x, name) for s in (d.before, d.after) for x in (s.figures, s.worst)]
        cells = [figure_text(name, sizes[k]) for k in (0, 2, 1, 3)]
        if name == "peak":  # of the estimate it is known how well
            cells[:2] = (f"{20.0 * np.log10(sizes[k]):.2f} dB" for k in (0, 2))
        rows.append((words, *cells))
        if name == "peak":
            rows.append(("its zone", *(_zone_of(s) for s in (d.before, d.after)), "", ""))
    if len(d.after.sensitivity) > 1:
        both = (f"{20.0 * np.log10(s.singular):.2f} dB" for s in (d.before, d.after))
        rows.append(("largest singular value", *both, "", ""))
    for quantity, unit in (("voltage", "V"), ("current", "A"), ("position", "m")):
        both_rms = [
            max((x[quantity] for x in s.rms.values() if quantity in x), default=0.0) for s in (d.before, d.after)
        ]
        if any(both_rms):
            rows.append((f"{quantity} by all noise, rms", *(sized(x, unit) for x in both_rms), "", ""))
    n = d.plants["verification"]
    stable = [f"{int(str(n)) - s.unstable} of {n}" for s in (d.before, d.after)]
    rows.append(("plants that are held", "", "", *stable))
    note = f"A to D: zones of {STANDARD}; check their limits against its text"
    return Section(
        heading=[(f"both loops: on the estimate, and the worst of {n} plants around it", "strong")],
        parts=[grid(rows), Lines(lines=[note], wrap=False)],
    )


def _speeds(d: Design) -> list[Section]:
    sweep = d.over_speed
    if sweep is None:
        return []
    rows = [
        (f"{w * _RPM:.0f}", *(figure_text("peak", x[k]) for x in sweep.peak.values()))
        for k, w in enumerate(sweep.speed)
    ]
    heading = [("highest peak over the speed, of some plants that judge", "strong")]
    return [Section(heading=heading, parts=[grid([("rpm", *sweep.peak), *rows])])]


def _plants(d: Design) -> Section:
    worst, plants = d.worst_plant, d.plants
    assumed = plants["assumed"]
    assert isinstance(assumed, list | tuple)
    peak = f"{worst.peak_db:.2f} dB, zone {worst.zone}" if np.isfinite(worst.peak_db) else "not held"
    again = f", {plants['rejected']} drawn again" if plants["rejected"] else ""
    lines = [
        f"tuned over {plants['tuning']} plants, judged by {plants['verification']} others{again}; the worst, draw "
        f"{worst.number}: {peak}, with {worst.words}",
        *map(str, assumed),
    ]
    return Section(heading=[("plants", "strong")], parts=[Lines(lines=lines, indent=2)])


def _loop(d: Design) -> Section:
    heading = [("the new [loop]", "strong")]
    if d.after.loop["kind"] != "pid":
        A = d.after.loop["A"]
        assert isinstance(A, list | tuple)
        return Section(heading=heading, parts=[Lines(lines=[f"a state-space law of order {len(A)}"], wrap=False)])
    rows: list[tuple[str, ...]] = [("", "before", "after", "")]
    units = {"kp": "V/m", "ki": "V/(m s)", "kd": "V s/m", "kc": "V/A", "derivative_cutoff_hz": "Hz"}
    for name, unit in units.items():
        gains = [loop.get(name) for loop in (d.before.loop, d.after.loop)]
        rows.append((name, *(_NONE if x is None else f"{float(str(x)):.5g}" for x in gains), unit))
    return Section(heading=heading, parts=[grid(rows)])


_LOOPS = (("before", MEASURED), ("after", PREDICTED))

_DB = (-20.0, 16.0)

_RPM = 30.0 / np.pi

_SHALLOW = 1e-4  # of the largest compliance: the lowest that is drawn


def design_figure(design: Design, title: str, width: float) -> Figure:
    """Draw both loops, a row of panels an axis."""
    blocks = [loops_block(design)]
    if design.over_speed is not None:
        blocks.append(Block(columns=[[panel(_over_speed, design, height=2.4)]]))
    if design.trials:
        blocks.append(verification_block(design.trials["before"][0], design.trials["after"][0]))
    return stacked(title, blocks, width)


def loops_block(design: Design) -> Block:
    """Return panels of both loops: sensitivity, compliance and force step."""
    axes = list(design.after.sensitivity)
    columns = [[panel(draw, design, axis, height=2.4) for axis in axes] for draw in (_sensitivity, _compliance, _step)]
    return Block(columns=columns, widths=(4.0, 3.0, 3.0), shared=False)


def _sensitivity(axes: Axes, design: Design, axis: str) -> None:
    tops = []
    for name, color in _LOOPS:
        curves = design.curves[name]
        mean, high = (20.0 * np.log10(x[axis]) if axis in x else None for x in (curves.sensitivity, curves.highest))
        _between(axes, curves.frequency_hz, mean, high, color, name)
        tops += [x.max() for x in (mean, high) if x is not None]
    zone_lines(axes)
    f = design.curves["after"].frequency_hz
    log_axis(axes.xaxis, float(f[0]), float(f[-1]))
    axes.set_ylim(_DB[0], max(_DB[1], min(max(tops) + 2.0, 40.0)))
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel("sensitivity [dB]")
    was, now = (s.sensitivity[axis] for s in (design.before, design.after))
    good = design.checks["zone"].passed
    peaks = f"{was.peak_db.value:.1f} → {now.peak_db.value:.1f} dB"
    head(axes, f"axis {axis}: {peaks}, zone {was.rating.words} → {now.rating.words}", good=good)


def _over_speed(axes: Axes, design: Design) -> None:
    speeds = design.over_speed
    assert speeds is not None
    tops = {name: x[np.isfinite(x)] for name, x in speeds.peak.items()}
    for (name, peak), color in zip(speeds.peak.items(), (MEASURED, PREDICTED, BOUND), strict=False):
        decibels = 20.0 * np.log10(np.where(np.isfinite(peak), peak, np.nan))
        axes.plot(
            speeds.speed * _RPM,
            decibels,
            color=color,
            marker=".",
            label=name,
        )
    zone_lines(axes)
    axes.set_ylim(0.0, max(_DB[1], min(20.0 * np.log10(max(x.max(initial=1.0) for x in tops.values())) + 2.0, 40.0)))
    axes.set_xlabel("speed [1/min]")
    axes.set_ylabel("peak of sensitivity [dB]")
    lost = [
        f"{name} loses plants at {np.sum(~np.isfinite(x))} speeds"
        for name, x in speeds.peak.items()
        if len(tops[name]) < x.size
    ]
    head(
        axes,
        "; ".join(["worst of some plants over the speed", *lost]),
        good=bool(np.isfinite(speeds.peak["after"]).all()),
    )


def _compliance(axes: Axes, design: Design, axis: str) -> None:
    most = max(s.compliance[axis].largest for s in (design.before, design.after))
    scale, unit = prefixed(most, "m/N")
    tops = [most / scale]
    for name, color in _LOOPS:
        curves = design.curves[name]
        mean, high = (x[axis] / scale if axis in x else None for x in (curves.compliance, curves.softest))
        _between(axes, curves.frequency_hz, mean, high, color, name)
        tops += [x.max() for x in (mean, high) if x is not None]
    f = design.curves["after"].frequency_hz
    log_axis(axes.xaxis, float(f[0]), float(f[-1]))
    log_axis(axes.yaxis, _SHALLOW * max(tops), max(tops))
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel(f"compliance [{unit}]")
    was, now = (sized(s.compliance[axis].largest, "m/N") for s in (design.before, design.after))
    head(axes, f"largest {was} → {now}")


def _step(axes: Axes, design: Design, axis: str) -> None:
    steps = [(curves.time_s, curves.step[axis]) for curves in (design.curves[name] for name, _ in _LOOPS)]
    scale, unit = prefixed(max(float(np.max(np.abs(x))) for _, x in steps), "m")
    for (t, x), (name, color) in zip(steps, _LOOPS, strict=True):
        axes.plot(1e3 * t, x / scale, color=color, label=f"{name}, on the estimate")
    axes.set_xlabel("time [ms]")
    axes.set_ylabel(f"deflection [{unit}]")
    was, now = (sized(s.figures.settling, "s") for s in (design.before, design.after))
    head(axes, f"1 N settled in {was} → {now}")


def _between(axes: Axes, f: Array, mean: Array | None, high: Array | None, color: str, name: str) -> None:
    """Draw what the estimate has, and up to where the plants around it go."""
    if mean is not None:
        axes.plot(f, mean, color=color, label=f"{name}, on the estimate")
        if high is not None:
            axes.fill_between(f, mean, high, color=color, alpha=0.25, linewidth=0.0, label=f"{name}, plants around it")


_DRAWN = KINDS[:4]

_MEANING = (
    "limits, quantisation and delay act; lift-off: time to rest, overshoot; force step, impact: largest deflection, "
    "time to rest; noise: rms of position and command; else the largest deflection"
)

_REST = 1.6  # settling times that are drawn

_BEYOND = 3.0  # of a panel's other curve and of the stops: what is farther is cut off

Pair = tuple[Sequence[Verification], Sequence[Verification]]

"""Both loops, before and after, on the same plants: the estimate first."""


def verification_section(loops: Pair) -> Section:
    """Return the worst case of each kind, on the estimate and over the other plants, and what is assumed."""
    many = len(loops[0]) > 1
    groups = [[v[:1] for v in loops], *([[v[1:] for v in loops]] if many else [])]
    rows = [("", "before", "after", *(("worst before", "worst after") if many else ()))]
    for kind in KINDS:
        cells = [_cell(_worst(runs, kind)) for group in groups for runs in group]
        if any(cell != _NONE for cell in cells):
            rows.append((kind, *cells))
    title = "nonlinear simulation: on the estimate"
    title += f", and the worst of {len(loops[0]) - 1} other plants" if many else ""
    sizes = [
        f"{kind} of {sized(c.size, c.unit)}" for kind in KINDS[1:3] for c in loops[0][0].of_kind(kind)[:1] if c.size
    ]
    lines = [_MEANING, *([", ".join(sizes)] if sizes else []), *loops[0][0].assumed]
    return Section(heading=[(title, "strong")], parts=[grid(rows), Lines(lines=lines, indent=2)])


def _worst(verifications: Sequence[Verification], kind: str) -> Case | None:
    """Return the case that failed, else the one that moved most."""
    cases = [case for v in verifications for case in v.of_kind(kind)]

    def far(case: Case) -> tuple[bool, float]:
        return not case.passed, math.inf if case.peak is None else case.peak

    return max(cases, key=far, default=None)


def _cell(case: Case | None) -> str:
    if case is None:
        return _NONE
    if case.peak is None:
        return "breaks off"
    if case.contact:
        return "touches a stop"
    at = "never" if case.settling_s is None else sized(case.settling_s, "s")
    if case.kind == "lift-off":
        return at if case.settling_s is None or not case.size else f"{at}, {100.0 * case.peak / abs(case.size):.0f} %"
    if case.rms is not None:
        return f"{sized(case.rms[0], 'm')}, {sized(case.rms[2], case.unit)}"
    return f"{sized(case.peak, 'm')}, {at}" if case.kind in ("force step", "impact") else sized(case.peak, "m")


def verification_block(before: Verification, after: Verification) -> Block:
    """Draw how the rotor moves in both loops on one plant: a panel a kind, of the axis that moves most."""
    kinds = [kind for kind in _DRAWN if _worst([after], kind) is not None]
    panels = [panel(_moved, before, after, kind, height=2.2) for kind in kinds]
    return Block(
        columns=[panels[k::2] for k in range(min(2, len(panels)))], shared=False,
        title=f"nonlinear simulation of {after.plant}",
    )  # fmt: skip


def _moved(axes: Axes, before: Verification, after: Verification, kind: str) -> None:
    case = _worst([after], kind)
    assert case is not None
    partner = next((x for x in before.of_kind(kind) if x.name == case.name), None)
    pairs = [(partner, "before", MEASURED), (case, "after", PREDICTED)]
    curves = [(x.trace, name, color) for x, name, color in pairs if x is not None and x.trace is not None]
    if not curves:
        head(axes, f"{case.name}: breaks off", good=False)
        return
    largest = max(float(np.abs(trace.position).max()) for trace, _, _ in curves)
    scale, unit = prefixed(largest, "m")
    turning = curves[-1][0].over == "speed"
    span = max(float(trace.at[-1]) for trace, _, _ in curves)
    rests = [x.settling_s for x in (partner, case) if x is not None and x.settling_s]
    if rests and not turning and len(rests) == len(curves):
        span = min(span, _REST * max(rests))
    time, second = (_RPM, "1/min") if turning else _of_time(span)
    for trace, name, color in curves:
        axes.plot(trace.at * time, trace.position / scale, color=color, label=name)
    if after.clearance is not None and after.clearance < _BEYOND * largest:
        for end in (after.clearance,) if turning else (-after.clearance, after.clearance):
            axes.axhline(end / scale, color=BOUND, linestyle=":", linewidth=0.9, label="stop")
    axes.set_xlim(0.0, 1.02 * span * time)
    axes.set_xlabel(f"{'speed' if turning else 'time'} [{second}]")
    axes.set_ylabel(f"{'largest deflection' if turning else 'position'} [{unit}]")
    head(axes, f"{case.name}: {_cell(partner)} → {_cell(case)}", good=case.passed)


def _of_time(span: float) -> tuple[float, str]:
    scale, unit = prefixed(span, "s")
    return 1.0 / scale, unit
