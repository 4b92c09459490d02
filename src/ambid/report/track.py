"""A track for people: the table of its end, its changes and decisions, and how fast it was."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from ambid.errors import counted
from ambid.estimation.estimate import EstimatedParameter
from ambid.estimation.result import Verdict, interval_95
from ambid.recursive.lines import Event, Track, TrackedValue, TrackHeader, TrackLine, TrackSummary
from ambid.report.document import Column, Document, Frame, Lines, Part, Section, Table, grid
from ambid.report.numbers import quantity, sized
from ambid.report.parameters import ParameterRow, varied, word_for_all
from ambid.report.text import WORDS, Cell, Line
from ambid.report.track_figures import TrackHistory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ambid.report.track_figures import Truth

_BAD = ("change", "reverted", "refused", "disturbed")
_MOST = 20  # events that are listed one by one


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
            if name in track.header.scale_sd:
                values = (x.parameters[name] for x in track.lines)
                columns[f"{name} sd_calibrated"] = [track.header.sd_calibrated(name, v) for v in values]
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
        Section(
            title="Parameters",
            parts=[track_table(header, last, track.verdict), Lines(lines=list(header.notes), indent=2)],
        ),
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
        sd = header.sd_calibrated(name, v)
        p = EstimatedParameter(
            name=name, unit=header.units.get(name, ""), value=v.value, sd=v.sd, role="free", identifiable=not v.stale,
            ci95=interval_95(v.value, v.sd), sd_calibrated=sd,
            ci95_calibrated=None if sd is None else interval_95(v.value, sd),
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
    q = quantity(v.value, v.sd, unit, ci95=interval_95(v.value, v.sd))
    return q.text, f"{q.low} … {q.high}" if q.low else ""


def change_words(v: TrackedValue, start: TrackedValue | None) -> str:
    """Say by how much a value has moved since the start.

    Returns such as ``"-15.1 %"``; empty where it cannot be said.
    """
    if start is None or not math.isfinite(v.value) or not math.isfinite(start.value) or start.value == 0:
        return ""
    if start.sd is not None and start.sd > abs(start.value):  # of a number that the start did not show
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
