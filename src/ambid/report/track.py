"""A track for people: the table of its end, and the live view, a pure function from what is known now to rich."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from ambid.errors import counted
from ambid.estimation.estimate import EstimatedParameter
from ambid.estimation.result import NORMAL_95, Verdict
from ambid.recursive.lines import Event, Track, TrackedValue, TrackHeader, TrackLine, TrackSummary
from ambid.report.document import Column, Document, Frame, Lines, Part, Section, Table, grid
from ambid.report.numbers import quantity, sized
from ambid.report.parameters import ParameterRow, varied, word_for_all
from ambid.report.text import WORDS, Cell, Line
from ambid.report.track_figures import TrackHistory

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Group
    from rich.table import Table as Grid

    from ambid.report.track_figures import Truth
    from ambid.tracking.lines_file import LiveState

STATE_STYLES = {"tracking": "bold green", "changed": "bold red", "hold": "bold cyan", "frozen": "bold yellow"}
_BLOCKS, _PLAIN_BLOCKS = "▁▂▃▄▅▆▇█", "_.-=+*%#"
_BAD = ("change", "reverted", "refused", "disturbed")
_MOST = 20  # events that are listed one by one
_BAR = 25  # columns of a bar
_SPARK = 40  # columns of the error's recent past
_DECISIONS = 6
LATE_S = 0.2  # a lag beyond which is shown in red, s


def track_document(
    track: Track, *, events: Sequence[Event] = (), history: TrackHistory | None = None,
    truth: Callable[[Mapping[str, str]], Truth | None] | None = None,
) -> Document:  # fmt: skip
    """Describe a track; `history`: its lines as numbers, where they are at hand, `truth`: by the units of its names."""

    def lines() -> TrackHistory:
        return history or TrackHistory.of(track)

    def drawn(width: float) -> Figure:
        from ambid.report.track_figures import track_figure

        lines_drawn = lines()
        units = {name: lines_drawn.header.units.get(name, "") for name in lines_drawn.names}
        return track_figure(lines_drawn, truth=None if truth is None else truth(units), width=width)

    def frame() -> Frame:
        history = TrackHistory.of(track)
        columns: dict[str, Any] = {"t": history.t, "state": [x.state for x in track.lines], "error": history.error}
        for name in history.names:
            columns |= dict(zip((name, f"{name} sd"), history.values(name)[:2], strict=True))
        return "t", columns

    name = str(track.header.record.get("file") or "record")
    names = track.lines[-1].parameters if track.lines else ()
    return Document(
        title=f"{name}, track of {track.totals.seconds_of_record:.4g} s", sections=track_sections(track, events),
        figure=drawn, frame=frame,
        numbers=[(n, quantity(track[n].value, track[n].sd, track[n].unit).text) for n in names],
    )  # fmt: skip


def track_sections(track: Track, events: Sequence[Event] = ()) -> list[Section]:
    """Say what a track came to.

    `events`: decisions that are told in their order, beside the changes of the whole.
    """
    header, totals = track.header, track.totals
    name = str(header.record.get("file") or "record")
    about = f": model {header.model}, {header.method}, {totals.seconds_of_record:.4g} s at {header.rate_hz:g} Hz"
    stopped: list[Cell] = [] if totals.complete else [(" – stopped before its end", "bad")]
    head = Section(parts=[Lines(lines=[[(name, "strong"), about, *stopped]], wrap=False)])
    if not track.lines:
        return [head]
    last = track.lines[-1]
    error = "unknown" if math.isnan(last.error) else f"{last.error:.3g}"
    state = f"state at the end: {last.state}; model error {error}, limit {header.limit:g}"
    extra = [(name, value_words(v, header.units.get(name, ""))[0]) for name, v in last.extra.items()]
    return [
        head,
        Section(title="Parameters", parts=[track_table(header, last, track.verdict)]),
        Section(parts=[grid([("", ""), *extra], bare=True)] if extra else []),
        Section(parts=[Lines(lines=[state], wrap=False)]),
        Section(title="Events", parts=event_parts(events or totals.changes)),
        Section(parts=closing_parts(totals)),
    ]


@dataclass(frozen=True, kw_only=True)
class TrackedRow(ParameterRow):
    """A tracked parameter as the table of parameters sees it."""

    tracked: TrackedValue
    start: TrackedValue | None

    @property
    def text(self) -> str:
        """Value ± standard deviation, as far as they are known."""
        return value_words(self.tracked, self.parameter.unit)[0]

    @property
    def interval(self) -> str:
        """The 95 % interval; empty where there is none."""
        return value_words(self.tracked, self.parameter.unit)[1]

    @property
    def judged(self) -> Cell:
        """Whether the value follows the record."""
        if self.tracked.stale:
            return "STALE", "bad"
        word = word_for_all(self.verdict)
        return ("tracked", "good") if word == "usable" else WORDS[word]


def track_table(header: TrackHeader, last: TrackLine, verdict: Verdict) -> Table:
    """Return the parameters at the end of a track; `verdict`: on all of them."""
    rows = []
    for name, v in last.parameters.items():
        p = EstimatedParameter(
            name=name, unit=header.units.get(name, ""), value=v.value, sd=v.sd, role="free", identifiable=not v.stale,
            ci95=(v.value - NORMAL_95 * v.sd, v.value + NORMAL_95 * v.sd),
        )  # fmt: skip
        rows.append(TrackedRow(parameter=p, verdict=verdict, tracked=v, start=header.start.get(name)))
    change = Column(label="from start", cell=lambda row: change_words(row.tracked, row.start), right=True)
    columns = varied({"in SI": None}, {"95 % interval": [change]})
    place = next(k for k, column in enumerate(columns) if column.label == "95 % interval")
    columns[place] = replace(columns[place], right=False, spare=True)
    return Table(columns=columns, rows=rows)


def value_words(v: TrackedValue, unit: str) -> tuple[str, str]:
    """Write a tracked value and its interval, which is empty where there is none."""
    if not math.isfinite(v.value):
        return "unknown", ""
    if not math.isfinite(v.sd):
        return f"{sized(v.value, unit, 5)} ± ?", ""
    q = quantity(v.value, v.sd, unit, ci95=(v.value - NORMAL_95 * v.sd, v.value + NORMAL_95 * v.sd))
    return q.text, f"{q.low} … {q.high}" if q.low else ""


def change_words(v: TrackedValue, start: TrackedValue | None) -> str:
    """Say by how much a value has moved since the start.

    Returns such as ``"-15.1 %"``; empty where it cannot be said.
    """
    if start is None or not math.isfinite(v.value) or not math.isfinite(start.value) or start.value == 0:
        return ""
    percent = 100 * (v.value / start.value - 1)
    text = f"{percent:+.0f} %" if abs(percent) >= 1000 else f"{percent:+.2f} %"
    return text.replace("-0.00", "+0.00")


def event_parts(events: Sequence[Event]) -> list[Part]:
    """Return the last twenty events, one after the other: when, what, why; and how many came before."""
    latest = events[-_MOST:]
    earlier = [f"{len(events) - len(latest)} earlier events are omitted"] if len(latest) < len(events) else []
    lines: list[Line] = []
    for e in latest:
        who = f" {e.parameter}" if e.parameter else ""
        lines.append([f"{e.t:10.3f} s  ", (f"{e.kind}{who}: ", "bad" if e.kind in _BAD else "strong"), e.why])
    return [Lines(lines=earlier), Lines(lines=lines, hang=True, indent=14)]


def closing_parts(summary: TrackSummary) -> list[Part]:
    """Return counts, throughput and latency."""
    places = summary.counts.get("rejected", 0)
    rejected = counted(summary.rejected_samples, "sample") + " rejected"
    if places:
        rejected += f" in {counted(places, 'place')}"
    lines: list[Line] = [f"{counted(summary.updates, 'update')}, {counted(len(summary.changes), 'change')}, {rejected}"]
    if summary.counts:
        lines.append(f"events: {', '.join(f'{n} {kind}' for kind, n in summary.counts.items())}")
    speed = speed_words(summary.samples, summary.seconds_of_record, summary.computing_s)
    if speed:
        lines.append([(f"{summary.computing_s:.2g} s of computing: {speed}", "dim")])
    latency = summary.latency
    if latency is not None and math.isfinite(latency.median):
        lost = f"; {counted(latency.overruns, 'block')} LOST" if latency.overruns else ""
        median, p99, largest = (sized(x, "s", 3) for x in (latency.median, latency.p99, latency.largest))
        start = "" if latency.start is None else f", {sized(latency.start, 's', 3)} at the start"
        words = (
            f"lag from sample to decision: median {median}, 99 % {p99}, largest {largest}{start}; "
            f"{latency.late} late{lost}"
        )
        lines.append([(words, "bad" if lost else "dim")])
    return [Lines(lines=lines, wrap=False)]


def speed_words(samples: int, seconds_of_record: float, computing_s: float) -> str:
    """Say how fast a record went by.

    Returns such as ``"1.2 million samples/s, 60 times real time"``; empty where it is not known.
    """
    if not (computing_s > 0 and samples > 0):
        return ""
    rate = samples / computing_s
    pace = (
        f"{rate / 1e6:.3g} million" if rate >= 1e6 else f"{rate / 1e3:.3g} thousand" if rate >= 1e3 else f"{rate:.3g}"
    )
    return f"{pace} samples/s, {seconds_of_record / computing_s:.3g} times real time"


Parts = list[str | tuple[str, str]]  # of a line, those with a style of their own as pairs


def live_view(state: LiveState, *, wall_s: float, behind_s: float | None = None, ascii_only: bool = False) -> Group:
    """Make what is shown of a run that has a line.

    `wall_s`: since tracking began, s; `behind_s`: from a sample to what is decided on it in real time, s; `ascii_only`:
    for a terminal whose encoding has no blocks. Returns about 80 columns wide.
    """
    from rich.console import Group
    from rich.text import Text

    line = state.line
    assert line is not None
    after = [_error(state, line, ascii_only), _counts(state, line, wall_s), *_decisions(state)]
    head = _head(state, line, behind_s, ascii_only)
    first, *rest = (Text.assemble(*x, no_wrap=True, overflow="ellipsis") for x in (head, *after))
    return Group(first, Text(), _parameters(state, line, ascii_only), Text(), *rest)


def _head(state: LiveState, line: TrackLine, behind_s: float | None, ascii_only: bool) -> Parts:
    h, length = state.header, state.length_s
    mark = "*" if ascii_only else "●"
    word = (f"{mark} {line.state:<9}", STATE_STYLES[line.state])
    parts: Parts = [(str(h.record.get("file") or "record"), "bold"), f": model {h.model}, {h.method}\n", word]
    parts.append(f" t {line.t:.2f} s")
    if length:
        share = min(max((line.t - state.begin_s) / length, 0.0), 1.0)
        full = round(20 * share)
        on, off = ("#", ".") if ascii_only else ("█", "░")
        parts.append(f" of {state.begin_s + length:.4g} s  {on * full}{off * (20 - full)} {100 * share:.0f} %")
    if behind_s is not None:
        parts.append((f"  {sized(max(behind_s, 0.0), 's')} behind", "bold red" if behind_s > LATE_S else ""))
    return parts


def _parameters(state: LiveState, line: TrackLine, ascii_only: bool) -> Grid:
    from rich.table import Table as Grid
    from rich.text import Text

    table = Grid.grid(padding=(0, 2, 0, 0))
    for column in range(5):
        table.add_column(justify="right" if column == 2 else "left", no_wrap=True)
    table.add_row("", "value ± sd", "from start", "95 % interval", "", style="dim")
    numbers, ranges = {**line.parameters, **line.extra}, state.widened()
    for name, v in numbers.items():
        start = state.header.start.get(name)
        low, high = ranges.get(name, (math.nan, math.nan))
        bar = interval_bar(v.value, v.sd, math.nan if start is None else start.value, low, high, ascii_only=ascii_only)
        style = "yellow" if v.stale else ""
        table.add_row(
            Text(name, style="bold"),
            Text(value_words(v, state.header.units.get(name, ""))[0], style=style),
            Text(change_words(v, start), style=style),
            Text(bar, style="yellow" if v.stale else "cyan"),
            Text("STALE", style="bold yellow") if v.stale else Text(),
        )
    return table


def interval_bar(
    value: float, sd: float, start: float, low: float, high: float, *, width: int = _BAR, ascii_only: bool = False
) -> str:
    """Draw an interval between two ends: the value, its 95 % interval, and where it started.

    `low`, `high`: the ends; `width`: columns. Returns of `width` letters; blank where there is nothing to draw. An
    arrow stands where the value is beyond an end.
    """
    if not (math.isfinite(value) and high > low):
        return " " * width
    line, dot, mark, empty, before, behind = "-o|.<>" if ascii_only else "━●│·◀▶"

    def column(x: float) -> int:
        return math.floor((x - low) / (high - low) * (width - 1) + 0.5)

    cells = [empty] * width
    reach = NORMAL_95 * sd if math.isfinite(sd) else high - low
    for k in range(max(column(value - reach), 0), min(column(value + reach), width - 1) + 1):
        cells[k] = line
    if math.isfinite(start) and 0 <= column(start) < width:
        cells[column(start)] = mark
    place = column(value)
    if place < 0:
        cells[0] = before
    elif place >= width:
        cells[-1] = behind
    else:
        cells[place] = dot
    return "".join(cells)


def sparkline(values: Sequence[float], limit: float, *, width: int = _SPARK, ascii_only: bool = False) -> str:
    """Draw recent values as blocks, the largest of each stretch; half height is the limit.

    `values`: naN where one is not known; `limit`: positive; `width`: most columns. Returns a letter for each stretch, a
    blank for one without values; at twice the limit it is full.
    """
    blocks = _PLAIN_BLOCKS if ascii_only else _BLOCKS
    n = len(values)
    columns = min(width, n)
    letters = []
    for k in range(columns):
        part = [x for x in values[k * n // columns : (k + 1) * n // columns] if not math.isnan(x)]
        if not part:
            letters.append(" ")
            continue
        level = min(max(part) / (2 * limit), 1.0)
        letters.append(blocks[min(int(level * len(blocks)), len(blocks) - 1)])
    return "".join(letters)


def _error(state: LiveState, line: TrackLine, ascii_only: bool) -> Parts:
    error, limit, errors = line.error, state.header.limit, state.errors
    text = "  ?  " if math.isnan(error) else f"{error:5.3g}"
    over = (_PLAIN_BLOCKS if ascii_only else _BLOCKS)[4:]
    spark = sparkline(errors, limit, ascii_only=ascii_only)
    return [
        "model error ",
        (text, "bold red" if error > limit else "bold green"),
        f"  limit {limit:g}  ",
        *((letter, "red" if letter in over else "green") for letter in spark),
        (f"  last {sized(len(errors) * state.header.every_s, 's')}" if len(errors) > 1 else "", "dim"),
    ]


def _counts(state: LiveState, line: TrackLine, wall_s: float) -> Parts:
    done, tally = line.t - state.begin_s, state.tally
    parts: Parts = [f"{tally.updates} updates, {tally.rejected_samples} samples rejected"]
    if tally.open_changes:
        parts.append((f", {counted(len(tally.open_changes), 'open change')}", "bold red"))
    speed = speed_words(round(done * state.header.rate_hz), done, wall_s)
    return [*parts, (f"\n{speed}", "dim")] if speed else parts


def _decisions(state: LiveState) -> list[Parts]:
    events = state.events
    lines: list[Parts] = [[]] if events else []
    for e in events[-_DECISIONS:]:
        who = f" {e.parameter}" if e.parameter else ""
        what = (f"{e.kind}{who}: ", "bold red" if e.kind in _BAD else "bold")
        lines.append([(f"{e.t:10.3f} s  ", "dim"), what, " ".join(e.why.split())])
    return lines
