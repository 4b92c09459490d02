"""Figure of a history: each parameter with its 95 % band over the dates of the records, events and changes of the rig.

A number that no record showed, or of an estimate that is not to be used, is a gap with a mark at the bottom.
"""

from __future__ import annotations

from datetime import UTC
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import counted
from ambid.estimation.result import NORMAL_95
from ambid.ledger.entry import Note
from ambid.ledger.history import History, Series
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
from ambid.report.numbers import prefixed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MANY = 6  # parameters from which panels stand in two columns
_POINTS = 400  # estimates up to which each is a point
_KINDS = {"rig": (GREEN, "--")}  # others: an event's
_EVENT = (PURPLE, ":")


def history_figure(found: History, title: str, width: float) -> Figure:
    """Draw a history, a panel a parameter."""
    names = list(found.measured)
    if not names:
        return stacked(title, [said_panel("no parameter was estimated")], width)
    split = -(-len(names) // 2) if len(names) > _MANY else len(names)
    groups = [names[:split], names[split:]] if len(names) > split else [names]
    columns = [[panel(draw_parameter, found, name, height=1.7) for name in group] for group in groups]
    return stacked(title, [Block(columns=columns, widths=(1.0,) * len(columns))], width)


def dates(at: Array) -> NDArray[np.datetime64]:
    """Return times, s since 1970, as matplotlib takes them."""
    return (1000.0 * at).astype("datetime64[ms]")


def draw_parameter(axes: Axes, found: History, name: str) -> float:
    """Draw a parameter over time, and return the scale of the drawing."""
    from matplotlib import dates as calendar

    s = found.measured[name]
    known = np.isfinite(s.value)
    t, half = dates(s.taken_at), NORMAL_95 * s.sd
    scale, unit = prefixed(float(np.max(np.abs(s.value[known]), initial=0.0)), s.unit)
    x: Any = t
    axes.fill_between(x, (s.value - half) / scale, (s.value + half) / scale, color=BAND, linewidth=0, label="95 % band")
    axes.plot(x, s.value / scale, color=PREDICTED, linewidth=0.9)
    if known.sum() <= _POINTS:
        doubt = np.array([found.estimates[k].verdict == "caution" for k in s.estimate], dtype=bool)
        for which, colour, label in (
            (known & ~doubt, PREDICTED, "usable"),
            (known & doubt, ORANGE, "use with caution"),
        ):
            if which.any():
                axes.errorbar(
                    x[which], s.value[which] / scale, half[which] / scale, fmt="o", color=colour, markersize=3.5,
                    elinewidth=0.9, label=label,
                )  # fmt: skip
    _limits(axes, s.value[known] / scale, half[known] / scale)
    _gaps(axes, x, s)
    for note in found.events:
        _mark(axes, note, name)
    first, last = found.estimates[0].taken_at, found.estimates[-1].taken_at
    room = 0.02 * (last - first) or 43200.0
    axes.set_xlim(*dates(np.array([first - room, last + room])))
    place: Any = calendar.AutoDateLocator(tz=UTC)  # type: ignore[no-untyped-call]
    axes.xaxis.set_major_locator(place)
    axes.xaxis.set_major_formatter(calendar.ConciseDateFormatter(place, tz=UTC))  # type: ignore[no-untyped-call]
    axes.set_xlabel("record taken (UTC)")
    axes.set_ylabel(f"{name} [{unit}]" if unit not in ("", "1") else name)
    out = int(known.size - known.sum())
    head(axes, f"{counted(int(known.sum()), 'value')}{f', {out} not known' if out else ''}", good=bool(known.any()))
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
