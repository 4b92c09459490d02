"""Figure of a track: each parameter with its 95 % band over time, beside the truth where it is known.

Below them the model error against its limit, and the supervisor's state. Long tracks are drawn as their extremes.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.estimation.result import NORMAL_95
from ambid.recursive.lines import Event, Track, TrackHeader, TrackLine
from ambid.report.drawing import (
    BAND,
    BOUND,
    GREEN,
    MEASURED,
    PIXELS,
    PREDICTED,
    SKY,
    WIDE,
    Block,
    Panel,
    curve,
    extremes,
    panel,
    stacked,
)
from ambid.report.numbers import prefixed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STATES = ("tracking", "changed", "hold", "frozen")
Truth = Mapping[str, tuple[Array, Array]]

_TRUTH, _MARK, _STALE, _OVER = "#000000", BOUND, "#d9d9d9", BOUND
_STATE_COLOURS = {"tracking": GREEN, "changed": BOUND, "hold": SKY, "frozen": "#bdbdbd"}
_STATE_HATCHES = {"tracking": "", "changed": "xxx", "hold": "...", "frozen": "///"}
_MARKED: dict[str, Any] = {
    "change": "-.",
    "reverted": ":",
    "disturbed": "--",
}  # events that get a vertical mark, and its line style
_LEAST = 0.004  # part of the width that the shortest state is drawn with, so that none is lost
_UNKNOWN = (np.nan, np.nan, 0.0)
_LEVELS = 2  # rows in which names of events stand over each other


class TrackHistory:
    """A track that is added to line by line, kept as numbers."""

    def __init__(self, header: TrackHeader) -> None:
        """Begin before the first line."""
        self.header = header
        self.events: list[Event] = []
        self._lines = array("d")  # t, error, state of each
        self._columns: dict[str, array[float]] = {}  # value, sd, stale of each line, up to the last that has them

    @classmethod
    def of(cls, track: Track) -> Self:
        """Take over a whole track."""
        history = cls(track.header)
        for line in track.lines:
            history.add(line)
        return history

    def add(self, line: TrackLine) -> None:
        """Add one line; numbers of `extra` stand behind the parameters, and are NaN before their first line."""
        n = self.n_lines
        self._lines.extend((line.t, line.error, STATES.index(line.state)))
        self.events += line.events
        for name, v in {**line.parameters, **line.extra}.items():
            column = self._columns.setdefault(name, array("d"))
            column.extend(_UNKNOWN * (n - len(column) // 3))
            column.extend((v.value, v.sd, v.stale))

    @property
    def n_lines(self) -> int:
        """Number of lines."""
        return len(self._lines) // 3

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters, then what was tracked beside them."""
        return tuple(self._columns)

    @property
    def t(self) -> Array:
        """End of each reporting interval, shape (n_lines,), s of record."""
        return np.array(self._lines[::3])

    @property
    def error(self) -> Array:
        """Model error, shape (n_lines,), 1 where the model predicts as well as when it was identified."""
        return np.array(self._lines[1::3])

    @property
    def state(self) -> NDArray[np.int8]:
        """Place in `STATES`, shape (n_lines,)."""
        return np.array(self._lines[2::3], dtype=np.int8)

    def values(self, name: str) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return value and sd (SI, NaN where not given) and whether it was frozen, (n_lines,) each, of one name."""
        column = self._columns[name]
        rest = array("d", _UNKNOWN * (self.n_lines - len(column) // 3))
        value, sd, stale = np.array(column + rest).reshape(-1, 3).T
        return value, sd, stale > 0


def track_figure(track: Track | TrackHistory, *, truth: Truth | None = None, width: float = WIDE) -> Figure:
    """Draw a track.

    Parameters
    ----------
    track : Track or TrackHistory
        With one line at least.
    truth : Mapping of parameter to (t, values), optional
        Each of shape (n,), s of record and SI.
    width : float, optional
        Inches.

    Returns
    -------
    matplotlib.figure.Figure
        One panel for each parameter, the error against its limit, the states.
    """
    history = track if isinstance(track, TrackHistory) else TrackHistory.of(track)
    names, truth, head = history.names, truth or {}, history.header
    marks = [e for e in history.events if e.kind in _MARKED and np.isfinite(e.t)]

    def parameter(axes: Axes, name: str) -> None:
        _parameter_panel(axes, history, name, truth.get(name))
        _event_marks(axes, marks, name, history, width)
        bottom(axes)

    def error(axes: Axes) -> None:
        _error_panel(axes, history)
        _event_marks(axes, marks, None, history, width)
        bottom(axes)

    def state(axes: Axes) -> None:
        _state_strip(axes, history)
        bottom(axes)

    def bottom(axes: Axes) -> None:
        axes.set_xlim(*_extent(history))
        axes.set_xlabel("time [s of record]")

    panels = [panel(parameter, name, height=1.55) for name in names]
    panels += [Panel(draw=error, height=1.35), Panel(draw=state, height=0.5)]
    page = stacked(
        f"{head.record.get('file') or 'record'}: model {head.model}, {head.method}",
        [Block(columns=[panels], legend=_legend(history, bool(set(truth) & set(names)), marks))], width,
    )  # fmt: skip
    page.align_ylabels(page.axes[:-1])
    return page


def _extent(history: TrackHistory) -> tuple[float, float]:
    t = history.t
    return float(t[0]) - history.header.every_s, float(t[-1])


def _parameter_panel(axes: Axes, history: TrackHistory, name: str, truth: tuple[Array, Array] | None) -> None:
    value, sd, stale = history.values(name)
    t, half = history.t, NORMAL_95 * sd
    low, high = _limits(value, sd, truth, history)
    scale, unit = prefixed(max(abs(low), abs(high)), history.header.units.get(name, ""))
    for first, last in runs(stale):
        axes.axvspan(t[first] - history.header.every_s, t[last], color=_STALE, linewidth=0, zorder=0)
    axes.fill_between(*extremes(t, (value - half) / scale, (value + half) / scale), color=BAND, linewidth=0, zorder=1)
    if t.size == 1:
        axes.errorbar(t, value / scale, half / scale, color=PREDICTED, marker="o", capsize=4, zorder=3)
    else:
        curve(axes, t, value / scale, PREDICTED, None, linewidth=1.4, alpha=1.0, zorder=3)
    if truth is not None:
        axes.plot(truth[0], truth[1] / scale, color=_TRUTH, linewidth=1.1, linestyle=(0, (4, 2)), zorder=4)
        _say(axes, truth_words(t, value, sd, stale, truth))
    axes.set_ylim(low / scale, high / scale)
    axes.set_ylabel(f"{name} [{unit}]" if unit else name)
    axes.ticklabel_format(axis="y", style="plain", useOffset=False)
    axes.set_axisbelow(True)
    _say_change(axes, history, name, float(value[-1]))


def _limits(value: Array, sd: Array, truth: tuple[Array, Array] | None, history: TrackHistory) -> tuple[float, float]:
    """Values, truth and the band where it is usual: a band that begins wide may leave the panel."""
    finite = value[np.isfinite(value)]
    usual = sd[np.isfinite(sd)]
    reach = 1.15 * NORMAL_95 * float(np.median(usual)) if usual.size else 0.0
    parts = [finite - reach, finite + reach]
    if truth is not None:
        first, last = _extent(history)
        inside = (truth[0] >= first) & (truth[0] <= last) & np.isfinite(truth[1])
        parts.append(truth[1][inside])
    every = np.concatenate(parts)
    if not every.size:
        return 0.0, 1.0
    low, high = float(every.min()), float(every.max())
    if not high > low:
        spread = 0.01 * abs(low) or 1.0
        return low - spread, high + spread
    return low - 0.06 * (high - low), high + 0.22 * (high - low)  # names of events stand at the top


def _say_change(axes: Axes, history: TrackHistory, name: str, last: float) -> None:
    """Write the change since the start above the panel, as the table says it: in per cent of a start of either sign."""
    begin = history.header.start.get(name)
    if begin is not None and begin.value and np.isfinite(last / begin.value):
        _say(axes, f"{100 * (last / begin.value - 1):+.3g} % from start", "left")


def truth_words(t: Array, value: Array, sd: Array, stale: NDArray[np.bool_], truth: tuple[Array, Array]) -> str:
    """Say how a track keeps to the truth.

    `t`, `value`, `sd`: (n_lines,), s and SI; `stale`: (n_lines,), lines that are left out; `truth`: (n,). Returns share
    of the lines whose interval holds the truth, and the median distance; empty where nothing can be said.
    """
    use = ~stale & np.isfinite(value) & np.isfinite(sd) & (t >= truth[0][0]) & (t <= truth[0][-1] + 1e-9)
    if not use.any():
        return ""
    true = np.interp(t[use], truth[0], truth[1])
    off = np.abs(value[use] - true)
    inside = 100 * float(np.mean(off <= NORMAL_95 * sd[use]))
    size, usual = float(np.median(np.abs(true))), float(np.median(sd[use]))
    # lines of one record share their data: its share says little without how far outside the truth lies
    own = f" ({float(np.median(off)) / usual:.1f} sd)" if usual else ""
    away = f", median distance {100 * float(np.median(off)) / size:.2g} %{own}" if size else ""
    return f"truth inside the band in {inside:.0f} % of the lines{away}"


def _say(axes: Axes, text: str, where: Literal["left", "right"] = "right") -> None:
    """Write above the panel, where nothing is hidden."""
    axes.set_title(text, fontsize=8, loc=where, color="#333333", pad=3)


def _event_marks(axes: Axes, marks: Sequence[Event], name: str | None, history: TrackHistory, width: float) -> None:
    """Draw a vertical line for each, and in the panel of the parameter that moved its name."""
    first, last = _extent(history)
    ends: list[float] = [-np.inf] * _LEVELS
    for e in marks:
        if not first <= e.t <= last:
            continue
        own = e.parameter == name if e.parameter in history.names else name is None
        axes.axvline(e.t, color=_MARK, linewidth=1.0, linestyle=_MARKED[e.kind], alpha=1.0 if own else 0.35, zorder=2)
        if not own:
            continue
        text, at = event_words(e), (e.t - first) / max(last - first, 1e-300)
        wide = 0.0068 * WIDE / width * len(text)
        left = at + wide > 0.99
        begin = at - wide if left else at
        level = next((k for k, end in enumerate(ends) if end < begin), None)
        if level is None:
            continue
        ends[level] = begin + wide
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.8}
        axes.annotate(
            text, (at, 0.96 - 0.14 * level), xycoords="axes fraction", xytext=(-4 if left else 4, 0),
            textcoords="offset points", fontsize=8, color=_MARK, ha="right" if left else "left", va="top", bbox=box,
            zorder=6,
        )  # fmt: skip


def event_words(event: Event) -> str:
    """Name an event in a few words.

    Returns such as ``"k_i change at 20.03 s"``.
    """
    who = f"{event.parameter} " if event.parameter else ""
    return f"{who}{event.kind} at {event.t:.4g} s"


def _error_panel(axes: Axes, history: TrackHistory) -> None:
    t, error, limit = history.t, history.error, history.header.limit
    if t.size == 1:
        axes.plot(t, error, "o", color=MEASURED)
    curve(axes, t, error, MEASURED, None, linewidth=1.0, alpha=1.0)
    at, _, high = extremes(t, error, error)
    axes.fill_between(at, limit, high, where=list(high > limit), color=_OVER, alpha=0.55, linewidth=0, step="mid")
    axes.axhline(limit, color=_OVER, linewidth=1.2, linestyle="--")
    finite = error[np.isfinite(error)]
    top = max(1.25 * limit, 1.05 * float(finite.max(initial=0.0)))
    if top > 10 * limit and float(finite.min(initial=1.0)) > 0:
        axes.set_yscale("log")
        axes.set_ylim(0.5 * float(finite.min()), 3 * top)
    else:
        axes.set_ylim(0, 1.2 * top)
    axes.set_ylabel("model error")
    over = 100 * float(np.mean(finite > limit)) if finite.size else 0.0
    unknown = 100 * float(np.mean(~np.isfinite(error)))
    missing = f", not known in {unknown:.2g} %" if unknown else ""
    _say(axes, f"beyond the limit in {over:.2g} % of the lines{missing}")
    axes.set_axisbelow(True)


def _state_strip(axes: Axes, history: TrackHistory) -> None:
    t, state = history.t, history.state
    begin_s, end_s = _extent(history)
    least = _LEAST * (end_s - begin_s)
    for code, name in enumerate(STATES):
        for first, last in runs(state == code):
            begin = t[first - 1] if first else begin_s
            short = t[last] < begin + least
            axes.axvspan(
                begin,
                begin + least if short else t[last],
                facecolor=_STATE_COLOURS[name],
                hatch=_STATE_HATCHES[name],
                edgecolor="white",
                linewidth=0,
                zorder=2 if short else 1,
            )
    axes.set_yticks([])
    axes.set_ylim(0, 1)
    axes.set_ylabel("state", rotation=0, ha="right", va="center")
    axes.tick_params(labelsize=9)


def _legend(history: TrackHistory, has_truth: bool, marks: Sequence[Event]) -> list[Any]:
    """Return the entries of the legend of the page, which stands below it: nothing is hidden by it."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    thin = f", extremes of {history.n_lines // PIXELS} lines each" if history.n_lines > 2 * PIXELS else ""
    entries: list[Any] = [
        Line2D([], [], color=PREDICTED, linewidth=1.4, label=f"accepted value{thin}"),
        Patch(color=BAND, label="95 % interval"),
    ]
    if has_truth:
        entries.append(Line2D([], [], color=_TRUTH, linestyle=(0, (4, 2)), linewidth=1.1, label="truth"))
    if any(history.values(name)[2].any() for name in history.names):
        entries.append(Patch(color=_STALE, label="stale: no information"))
    entries += [
        Line2D([], [], color=_MARK, linestyle=_MARKED[kind], linewidth=1.0, label=kind)
        for kind in dict.fromkeys(e.kind for e in marks)
    ]
    entries.append(Line2D([], [], color=_OVER, linestyle="--", linewidth=1.2, label="model error limit"))
    for code, name in enumerate(STATES):
        if (history.state == code).any():
            entries.append(
                Patch(facecolor=_STATE_COLOURS[name], hatch=_STATE_HATCHES[name], edgecolor="white", label=name)
            )
    return entries


def runs(flags: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield the stretches in which a flag is set.

    `flags`: (n,). Returns `first, last`: both inside the stretch.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    for k in range(0, edges.size, 2):
        yield int(edges[k]), int(edges[k + 1]) - 1
