"""Bearings watched over time: alarms and trends as text, and a panel for each parameter with an alarm."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.errors import counted
from ambid.ledger.monitor import Alarm, Trend, Watched
from ambid.report.drawing import BOUND, ORANGE, Block, head, panel, said_panel, stacked
from ambid.report.history_figures import dates, draw_parameter
from ambid.report.history_text import day, percent
from ambid.report.text import WIDTH, Paint, columns, hanging, joined, plain
from ambid.settings.caller import setting

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SHOWN = 40  # trends
_PANELS = 8


def watch_text(found: Watched, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write what was watched, below its verdict: alarms with date and cause, then what moved without one."""
    rules = ", ".join(str(r) for r in found.rules)
    n = counted(len(found.bearings), "bearing")
    head_lines = hanging(f"{paint(n, 'strong')} watched for ", rules, width, 2, first=len(n) + 13)
    alarms: list[str] = []
    for a in found.alarms:
        alarms += hanging(f"{a.bearing}  ", _alarm(a), width, 4, first=len(a.bearing) + 2)
    moved = [t for t in found.trends if t.kind != "none"]
    rows = [_trend(t) for t in moved[:_SHOWN]]
    rest, still = len(moved) - _SHOWN, len(found.trends) - len(moved)
    return joined(
        [
            head_lines,
            [paint("alarms", "strong"), *alarms] if alarms else ["no alarm"],
            [paint("what moved", "strong"), *columns(rows, right=())] if rows else [],
            [f"{counted(rest, 'more')} in {setting('json')}"] if rest > 0 else [],
            [f"{counted(still, 'parameter')} without a change"] if still else [],
        ]
    )


def _alarm(a: Alarm) -> str:
    past = "" if a.cleared is None else f", cleared {day(a.cleared)}"
    how = "stepped" if a.kind == "step" else "crossed the limit"
    return (
        f"{a.parameter} {percent(a.change, a.change_sd)} (alarm {a.rule}), raised {day(a.raised)}{past}; {how} "
        f"{day(a.at)} (95 %: {day(a.at_from)} to {day(a.at_to)}); {a.cause}"
    )


def _trend(t: Trend) -> tuple[str, ...]:
    if t.kind == "step":
        return t.bearing, t.parameter, f"step of {percent(t.step or 0.0, t.step_sd or 0.0)}", day(t.at or 0.0)
    reach = "; ".join(f"{rule} between {day(a)[:10]} and {day(b)[:10]}" for rule, (a, b) in t.limits.items())
    return t.bearing, t.parameter, f"{percent(t.per_month or 0.0, t.per_month_sd or 0.0)} a month", reach


def watch_title(found: Watched) -> str:
    """Return the title of figure and page."""
    return f"{counted(len(found.bearings), 'bearing')}, {counted(len(found.standing), 'alarm')} standing"


def watch_figure(found: Watched, title: str, width: float) -> Figure:
    """Draw the parameters with alarms, with limit, date and its interval."""
    if found.used is None:
        return stacked(title, [said_panel("figures need the histories, which a file of alarms does not hold")], width)
    histories = {h.bearing: h for h in found.used}
    first = {(a.bearing, a.parameter): a for a in reversed(found.alarms)}
    shown = list(reversed(first.values()))[:_PANELS]
    if not shown:
        return stacked(title, [said_panel("no alarm")], width)

    def draw(axes: Axes, a: Alarm) -> None:
        scale = draw_parameter(axes, histories[a.bearing], a.parameter)
        limit = a.limit / scale
        axes.axhline(limit, color=BOUND, linewidth=1.0, label="limit")
        at: Any = dates(np.array([a.at_from, a.at_to, a.raised]))
        axes.axvspan(at[0], at[1], color=ORANGE, alpha=0.35, linewidth=0, label="date, 95 %")
        axes.axvline(at[2], color=BOUND, linestyle="--", linewidth=1.0, label="alarm raised")
        low, high = axes.get_ylim()
        room = 0.05 * (high - low)
        axes.set_ylim(min(low, limit - room), max(high, limit + room))
        head(axes, f"{a.bearing}: {a.cause}", good=a.cleared is not None)

    return stacked(title, [Block(columns=[[panel(draw, a, height=2.0) for a in shown]], shared=False)], width)
