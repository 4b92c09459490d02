"""A bearing over time, and what a ledger holds, as tables for the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import fields
from datetime import UTC
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.control.zones import Zone
from ambid.errors import counted
from ambid.estimation.result import NORMAL_95
from ambid.ledger.alarm import Alarm
from ambid.ledger.entry import Correction, Note, day
from ambid.ledger.history import History, Series
from ambid.ledger.monitor import Watched
from ambid.ledger.store import Failure, KnownBearing
from ambid.ledger.trends import Trend
from ambid.report.document import Document, Frame, Lines, Section, grid
from ambid.report.drawing import (
    BAND,
    BOUND,
    GREEN,
    MEASURED,
    ORANGE,
    PREDICTED,
    PURPLE,
    Block,
    head,
    panel,
    said_panel,
    stacked,
)
from ambid.report.numbers import prefixed, quantity
from ambid.report.text import Line, Paint, columns, joined, plain
from ambid.settings.caller import setting

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_SHOWN = 12  # events, and failures


def percent(value: float, sd: float) -> str:
    """Write a relative change."""
    return f"{quantity(100 * value, 100 * sd, '1').text} %"


def history_document(history: History, _: Any) -> Document:
    """Describe a bearing over time."""
    h = history
    title = f"{h.bearing}, history of {counted(len(h.estimates), 'estimate')}"

    def frame() -> Frame:
        columns: dict[str, Any] = {"taken_at": dates(np.array([e.taken_at for e in h.estimates]))}
        columns |= {name: [getattr(e, name) for e in h.estimates] for name in ("record", "verdict", "failed")}
        for name, s in h.measured.items():
            for what, values in ((name, s.value), (f"{name} sd", s.sd)):
                columns[what] = np.full(len(h.estimates), np.nan)
                columns[what][s.estimate] = values
        return "taken_at", columns

    return Document(title=title, sections=history_sections(h), figure=partial(history_figure, h, title), frame=frame)


def history_sections(history: History) -> list[Section]:
    """Say the latest number of each parameter, and what happened."""
    h, n = history, len(history.estimates)
    counts = {w: sum(e.verdict == w for e in h.estimates) for w in ("usable", "caution", "unusable")}
    span = f"{day(h.estimates[0].taken_at)} to {day(h.estimates[-1].taken_at)} UTC"
    head: list[Line] = [
        [(h.bearing, "strong"), f": {counted(n, 'estimate')}, {span}"],
        f"verdicts: {counts['usable']} usable, {counts['caution']} with caution, {counts['unusable']} not to be used",
    ]
    older = h.left_out or sum(e.superseded for e in h.estimates)
    if older:
        shown = f"left out; {setting('every')} lists them" if h.left_out else "listed too"
        head.append(f"{counted(older, 'estimate')} superseded ({shown}): of a record and job the newest version counts")
    rows: list[tuple[str, ...]] = [("", "latest value ± sd", "taken", "since the first", "known")]
    rows += [_row(s, n, _zone(h, s)) for s in h.measured.values()]
    events: list[Line] = []
    for e in h.events[-_SHOWN:]:
        parameter = f"{e.parameter}: " if e.parameter else ""
        events.append([f"{day(e.at)}  {e.kind}  ", parameter + e.text])
    corrected: list[Line] = [[head, text] for head, text in map(_correction, h.corrections[-_SHOWN:])]
    rest = len(h.events) - _SHOWN
    more = [f"{counted(rest, 'earlier event')} in {setting('json')}"] if rest > 0 else []
    return [
        Section(parts=[Lines(lines=head, wrap=False)]),
        Section(title="Parameters", parts=[grid(rows)]),
        Section(
            heading=[("events", "strong")] if events else "",
            parts=[Lines(lines=more), Lines(lines=events, hang=True, indent=4)],
        ),
        Section(
            heading=[("corrections", "strong")] if corrected else "",
            parts=[Lines(lines=corrected, hang=True, indent=4)],
        ),
    ]


def _zone(h: History, s: Series) -> str:
    """Say the zone of the latest peak of a sensitivity, nothing of another number."""
    axis, _, what = s.name.rpartition(".")
    finite = np.flatnonzero(np.isfinite(s.value))
    if what != "sensitivity" or not finite.size:
        return ""
    z, measured = int(finite[-1]), h.measured.get(f"{axis}.sensitivity_measured")
    pair = None
    if measured is not None:
        at = np.flatnonzero((measured.estimate == s.estimate[z]) & np.isfinite(measured.value))
        pair = (float(measured.value[at[0]]), float(measured.sd[at[0]])) if at.size else None
    return f", zone {Zone.of((float(s.value[z]), float(s.sd[z])), pair).words}"


def _row(s: Series, n: int, zone: str) -> tuple[str, ...]:
    finite = np.flatnonzero(np.isfinite(s.value))
    count = f"{finite.size} of {n}"
    if not finite.size:
        return s.name, "never identifiable", "", "", count
    a, z = int(finite[0]), int(finite[-1])
    latest = quantity(float(s.value[z]), float(s.sd[z]), s.unit).text
    change = ""
    if a != z and s.value[a]:
        change = percent(float(s.value[z] / s.value[a] - 1), math.hypot(s.sd[a], s.sd[z]) / abs(float(s.value[a])))
    return s.name, latest + zone, day(float(s.taken_at[z])), change, count


def _correction(c: Correction) -> tuple[str, str]:
    return f"{c.number}  {day(c.at)}  ", f"{c.text}, by {c.who}" + (f": {c.why}" if c.why else "")


def bearings_text(
    bearings: Sequence[KnownBearing], failures: Iterable[Failure], corrections: Sequence[Correction] = (), *,
    paint: Paint = plain,
) -> str:  # fmt: skip
    """Write what a ledger holds: its bearings, the records that gave no estimate, and what was corrected last."""
    rows = [("bearing", "rig", "estimates", "first", "last")]
    rows += [(b.name, b.plant, str(b.estimates), day(b.first), day(b.last)) for b in bearings]
    failed, last = list(failures), corrections[-_SHOWN:]
    lines = [f"{f.record or f.sha[:12]} ({f.bearing}): {f.reason}" for f in failed[:_SHOWN]]
    rest = len(failed) - _SHOWN
    title = paint(f"{counted(len(failed), 'record')} without an estimate", "strong")
    return joined(
        [
            columns(rows, right=(2,)) if bearings else ["no estimates yet"],
            [title, *lines, *([f"… and {rest} more"] if rest > 0 else [])] if failed else [],
            [paint("corrections", "strong"), *map("".join, map(_correction, last))] if last else [],
        ]
    )


_TRENDS = 40  # trends

_PANELS = 8


def watch_document(watched: Watched, _: Any) -> Document:
    """Describe bearings that are watched."""
    title = f"{counted(len(watched.bearings), 'bearing')}, {counted(len(watched.open), 'open alarm')}"
    return Document(
        title=title, sections=watch_sections(watched), figure=partial(watch_figure, watched, title),
        frame=lambda: ("bearing", {
            **{f.name: [getattr(a, f.name) for a in watched.alarms] for f in fields(Alarm) if f.name != "noted"},
            "noted": [noted_text(a).removeprefix(", ") for a in watched.alarms],
        }),
    )  # fmt: skip


def watch_sections(watched: Watched) -> list[Section]:
    """Say what was watched: alarms with date and cause, then what moved without one."""
    w = watched
    rules = ", ".join(map(str, (*w.rules, *w.records)))
    head: Line = [(counted(len(w.bearings), "bearing"), "strong"), " watched for ", rules]
    groups = [
        ("alarms", [a for a in w.alarms if a.open]),
        ("acknowledged and silenced alarms", [a for a in w.standing if not a.open]),
        ("cleared alarms", [a for a in w.alarms if a.cleared is not None]),
    ]
    moved = [t for t in w.trends if t.kind != "none"]
    rest, still = len(moved) - _TRENDS, len(w.trends) - len(moved)
    rows = [_trend(t) for t in moved[:_TRENDS]]
    return [
        Section(parts=[Lines(lines=[head], hang=True, indent=2)]),
        *(_alarms(heading, alarms) for heading, alarms in groups),
        Section(parts=[Lines(lines=[] if w.standing else ["no alarm stands"])]),
        Section(heading=[("what moved", "strong")], parts=[grid([("",) * 4, *rows], bare=True)] if rows else []),
        Section(parts=[Lines(lines=[f"{counted(rest, 'more')} in {setting('json')}"] if rest > 0 else [])]),
        Section(parts=[Lines(lines=[f"{counted(still, 'parameter')} without a change"] if still else [])]),
    ]


def _alarms(heading: str, alarms: Sequence[Alarm]) -> Section:
    lines: list[Line] = [[f"{a.bearing}  ", _alarm(a)] for a in alarms]
    return Section(heading=[(heading, "strong")] if lines else "", parts=[Lines(lines=lines, hang=True, indent=4)])


def _alarm(a: Alarm) -> str:
    past = "" if a.cleared is None else f", cleared {day(a.cleared)}"
    raised = f"(alarm {a.rule}), raised {day(a.raised)}{past}{noted_text(a)}"
    if a.change is None or a.change_sd is None:
        return f"{a.parameter or 'records'} {raised}; {a.cause}"
    how = "stepped" if a.kind == "step" else "crossed the limit"
    return (
        f"{a.parameter} {percent(a.change, a.change_sd)} {raised}; {how} "
        f"{day(a.at)} (95 %: {day(a.at_from)} to {day(a.at_to)}); {a.cause}"
    )


def noted_text(a: Alarm) -> str:
    """Say who has taken note of an alarm, until when and why."""
    if a.noted is None:
        return ""
    word = "silenced" if a.noted.kind == "silence" else "acknowledged"
    until = "" if a.noted.until is None else f" until {day(a.noted.until)}"
    return f", {word} {day(a.noted.at)} by {a.noted.who}{until}: {a.noted.why}"


def _trend(t: Trend) -> tuple[str, ...]:
    if t.kind == "step":
        return t.bearing, t.parameter, f"step of {percent(t.step or 0.0, t.step_sd or 0.0)}", day(t.at or 0.0)
    reach = "; ".join(f"{rule} between {day(a)[:10]} and {day(b)[:10]}" for rule, (a, b) in t.limits.items())
    return t.bearing, t.parameter, f"{percent(t.per_month or 0.0, t.per_month_sd or 0.0)} a month", reach


def watch_figure(watched: Watched, title: str, width: float) -> Figure:
    """Draw the parameters with alarms, with limit, date and its interval, and when records came."""
    if watched.used is None:
        return stacked(title, [said_panel("figures need the histories, which a file of alarms does not hold")], width)
    histories = {h.bearing: h for h in watched.used}
    first = {(a.bearing, a.parameter): a for a in reversed(watched.alarms) if a.bearing in histories}
    alarms = list(reversed(first.values()))[:_PANELS]
    if not alarms:
        return stacked(title, [said_panel("no alarm")], width)

    def draw(axes: Axes, a: Alarm) -> None:
        h, scale = histories[a.bearing], 1.0
        if a.parameter:
            scale = draw_parameter(axes, h, a.parameter)
        else:
            _draw_records(axes, h, a)
        at: Any = dates(np.array([a.at_from, a.at_to, a.raised]))
        label = "from the last sound record to the next" if a.change is None else "date, 95 %"
        axes.axvspan(at[0], at[1], color=ORANGE, alpha=0.35, linewidth=0, label=label)
        axes.axvline(at[2], color=BOUND, linestyle="--", linewidth=1.0, label="alarm raised")
        if a.limit is not None:
            limit = a.limit / scale
            axes.axhline(limit, color=BOUND, linewidth=1.0, label="limit")
            low, high = axes.get_ylim()
            room = 0.05 * (high - low)
            axes.set_ylim(min(low, limit - room), max(high, limit + room))
        head(axes, f"{a.bearing}: {a.cause.partition(';')[0]}", good=not a.open)

    panels = [panel(draw, a, height=2.0 if a.parameter else 1.0) for a in alarms]
    return stacked(title, [Block(columns=[panels], shared=False)], width)


def _draw_records(axes: Axes, history: History, a: Alarm) -> None:
    """Draw when records were taken, a row for each verdict."""
    for k, (word, colour) in enumerate((("unusable", BOUND), ("caution", ORANGE), ("usable", PREDICTED))):
        at: Any = dates(np.array([e.taken_at for e in history.estimates if e.verdict == word]))
        axes.plot(at, np.full(at.size, k), "|", color=colour, markersize=7)
    ends = sorted([history.estimates[0].taken_at, history.estimates[-1].taken_at, a.at_from, a.at_to])
    _calendar(axes, ends[0], ends[-1])
    axes.set_yticks(range(3), ["do not use", "caution", "usable"])
    axes.set_ylim(-0.6, 2.6)


def _calendar(axes: Axes, first: float, last: float) -> None:
    """Let the horizontal axis be of dates between two times, s since 1970."""
    from matplotlib import dates as calendar

    room = 0.02 * (last - first) or 43200.0
    axes.set_xlim(*dates(np.array([first - room, last + room])))
    place: Any = calendar.AutoDateLocator(tz=UTC)  # type: ignore[no-untyped-call]
    axes.xaxis.set_major_locator(place)
    axes.xaxis.set_major_formatter(calendar.ConciseDateFormatter(place, tz=UTC))  # type: ignore[no-untyped-call]
    axes.set_xlabel("record taken (UTC)")


_MANY = 6  # parameters from which panels stand in two columns

_POINTS = 400  # estimates up to which each is a point

_KINDS = {"rig": (GREEN, "--")}  # others: an event's

_EVENT = (PURPLE, ":")


def history_figure(history: History, title: str, width: float) -> Figure:
    """Draw a history, a panel a parameter."""
    names = list(history.measured)
    if not names:
        return stacked(title, [said_panel("no parameter was estimated")], width)
    split = -(-len(names) // 2) if len(names) > _MANY else len(names)
    groups = [names[:split], names[split:]] if len(names) > split else [names]
    columns = [[panel(draw_parameter, history, name, height=1.7) for name in group] for group in groups]
    return stacked(title, [Block(columns=columns, widths=(1.0,) * len(columns))], width)


def dates(at: Array) -> NDArray[np.datetime64]:
    """Return times, s since 1970, as matplotlib takes them."""
    return (1000.0 * at).astype("datetime64[ms]")


def draw_parameter(axes: Axes, history: History, name: str) -> float:
    """Draw a parameter over time, and return the scale of the drawing."""
    s = history.measured[name]
    finite = np.isfinite(s.value)
    t, half = dates(s.taken_at), NORMAL_95 * s.sd
    scale, unit = prefixed(float(np.max(np.abs(s.value[finite]), initial=0.0)), s.unit)
    x: Any = t
    axes.fill_between(x, (s.value - half) / scale, (s.value + half) / scale, color=BAND, linewidth=0, label="95 % band")
    axes.plot(x, s.value / scale, color=PREDICTED, linewidth=0.9)
    if finite.sum() <= _POINTS:
        doubt = np.array([history.estimates[k].verdict == "caution" for k in s.estimate], dtype=bool)
        for which, colour, label in (
            (finite & ~doubt, PREDICTED, "usable"),
            (finite & doubt, ORANGE, "use with caution"),
        ):
            if which.any():
                axes.errorbar(
                    x[which], s.value[which] / scale, half[which] / scale, fmt="o", color=colour, markersize=3.5,
                    elinewidth=0.9, label=label,
                )  # fmt: skip
    _limits(axes, s.value[finite] / scale, half[finite] / scale)
    _gaps(axes, x, s)
    for note in history.events:
        _mark(axes, note, name)
    _calendar(axes, history.estimates[0].taken_at, history.estimates[-1].taken_at)
    axes.set_ylabel(f"{name} [{unit}]" if unit not in ("", "1") else name)
    out = int(finite.size - finite.sum())
    head(axes, f"{counted(int(finite.sum()), 'value')}{f', {out} not known' if out else ''}", good=bool(finite.any()))
    return scale


def _limits(axes: Axes, value: Array, half: Array) -> None:
    """Show values and usual bands; one wide band does not flatten all the rest."""
    if not value.size:
        axes.set_yticks([])
        return
    reach = np.minimum(half, 3.0 * float(np.median(half)))
    low, high = float(np.min(value - reach)), float(np.max(value + reach))
    room = 0.12 * (high - low) or 0.01 * abs(high) or 1.0
    axes.set_ylim(low - 1.4 * room, high + room)


def _gaps(axes: Axes, t: Any, s: Series) -> None:
    """Mark at the bottom where no number stands."""
    unseen = ~s.identifiable
    refused = s.identifiable & ~np.isfinite(s.value)
    for which, mark, colour, label in (
        (unseen, "|", MEASURED, "not identifiable"),
        (refused, "x", BOUND, "do not use"),
    ):
        if which.any():
            at = np.full(int(which.sum()), 0.05)
            axes.plot(
                t[which], at, mark, color=colour, markersize=6, transform=axes.get_xaxis_transform(), label=label,
                clip_on=False,
            )  # fmt: skip


def _mark(axes: Axes, note: Note, name: str) -> None:
    """Draw an event of this parameter or of the whole bearing; of another parameter faint."""
    colour, style = _KINDS.get(note.kind, _EVENT)
    own = note.parameter in ("", name)
    at: Any = dates(np.array([note.at]))[0]
    label = None if not own else "change of the rig" if note.kind == "rig" else "event"
    axes.axvline(
        at, color=colour, linestyle=style, linewidth=1.2 if own else 0.8, alpha=1.0 if own else 0.3, label=label
    )
    if note.parameter == name:
        axes.annotate(
            note.kind, (at, 1.0), xycoords=("data", "axes fraction"), xytext=(3, -2), textcoords="offset points",
            va="top", fontsize=8, color=colour,
        )  # fmt: skip
