"""The live view of a track: a pure function from what is known now to something that rich can show.

Parameters with intervals as numbers and bars, the error against its limit, state, last decisions, throughput, keys.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING

from ambid.recursive.lines import Event, TrackHeader, TrackLine
from ambid.report.numbers import sized
from ambid.report.track_text import change_words, speed_words, value_words
from ambid.track.lines_file import NORMAL_95

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

STATE_STYLES = {"tracking": "bold green", "changed": "bold red", "hold": "bold cyan", "frozen": "bold yellow"}
KEYS = "h hold   t track   a accept   r revert   q end"
_BLOCKS, _PLAIN_BLOCKS = "▁▂▃▄▅▆▇█", "_.-=+*%#"
_BAD = ("change", "reverted", "refused", "disturbed")
_BAR = 25  # columns of a bar
_SPARK = 40  # columns of the error's recent past
_DECISIONS = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackView:
    """What a live view shows."""

    header: TrackHeader
    line: TrackLine  # the last one
    errors: tuple[float, ...] = ()  # model errors of recent lines, oldest first
    decisions: tuple[Event, ...] = ()  # recent events, oldest first
    # between which its bar is drawn, SI
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=lambda: MappingProxyType({}))
    begin_s: float = 0.0  # begin of the first reporting interval, s of record
    length_s: float | None = None  # of the record, s; None where it is not known
    wall_s: float = 0.0  # since tracking began, s
    behind_s: float | None = None  # by how much tracking is behind a record that is replayed in real time, s
    rejected: int = 0
    updates: int = 0
    open_changes: int = 0  # changes that are not answered by accepted values
    keys: bool = False  # whether the operator can press keys
    pressed: str = ""  # the flag that the operator set last; empty without


def live_view(view: TrackView, *, ascii_only: bool = False) -> Group:
    """Make what is shown.

    `ascii_only`: for a terminal whose encoding has no blocks. Returns about 80 columns wide.
    """
    from rich.console import Group
    from rich.text import Text

    parts: list[Text | Table] = [
        _head(view, ascii_only),
        Text(),
        _parameters(view, ascii_only),
        Text(),
        _error(view, ascii_only),
        _counts(view),
        *_decisions(view),
    ]
    if view.keys:
        pressed = f"   (pressed: {view.pressed})" if view.pressed else ""
        parts += [Text(), Text(f"keys: {KEYS}{pressed}", style="dim", no_wrap=True, overflow="ellipsis")]
    return Group(*parts)


def _head(view: TrackView, ascii_only: bool) -> Text:
    from rich.text import Text

    h, t = view.header, view.line.t
    done = t - view.begin_s
    name = str(h.record.get("file") or "record")
    text = Text(no_wrap=True, overflow="ellipsis")
    text.append(f"{name}", style="bold").append(f": model {h.model}, {h.method}\n")
    mark = "*" if ascii_only else "●"
    text.append(f"{mark} {view.line.state:<9}", style=STATE_STYLES[view.line.state])
    text.append(f" t {t:.2f} s")
    if view.length_s:
        share = min(max(done / view.length_s, 0.0), 1.0)
        full = round(20 * share)
        on, off = ("#", ".") if ascii_only else ("█", "░")
        text.append(f" of {view.begin_s + view.length_s:.4g} s  {on * full}{off * (20 - full)} {100 * share:.0f} %")
    if view.behind_s is not None:
        late = view.behind_s > 10 * h.every_s
        text.append(f"  {sized(max(view.behind_s, 0.0), 's')} behind", style="bold red" if late else "")
    return text


def _parameters(view: TrackView, ascii_only: bool) -> Table:
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2, 0, 0))
    for column in range(5):
        table.add_column(justify="right" if column == 2 else "left", no_wrap=True)
    table.add_row("", "value ± sd", "from start", "95 % interval", "", style="dim")
    numbers = {**view.line.parameters, **view.line.extra}
    for name, v in numbers.items():
        start = view.header.start.get(name)
        low, high = view.ranges.get(name, (math.nan, math.nan))
        bar = interval_bar(v.value, v.sd, math.nan if start is None else start.value, low, high, ascii_only=ascii_only)
        style = "yellow" if v.stale else ""
        table.add_row(
            Text(name, style="bold"),
            Text(value_words(v, view.header.units.get(name, ""))[0], style=style),
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


def _error(view: TrackView, ascii_only: bool) -> Text:
    from rich.text import Text

    error, limit = view.line.error, view.header.limit
    text = Text(no_wrap=True, overflow="ellipsis")
    shown = "  ?  " if math.isnan(error) else f"{error:5.3g}"
    text.append("model error ").append(shown, style="bold red" if error > limit else "bold green")
    text.append(f"  limit {limit:g}  ")
    over = (_PLAIN_BLOCKS if ascii_only else _BLOCKS)[4:]
    for letter in sparkline(view.errors, limit, ascii_only=ascii_only):
        text.append(letter, style="red" if letter in over else "green")
    if len(view.errors) > 1:
        text.append(f"  last {sized(len(view.errors) * view.header.every_s, 's')}", style="dim")
    return text


def _counts(view: TrackView) -> Text:
    from rich.text import Text

    done = view.line.t - view.begin_s
    text = Text(no_wrap=True, overflow="ellipsis")
    text.append(f"{view.updates} updates, {view.rejected} samples rejected")
    if view.open_changes:
        plural = "" if view.open_changes == 1 else "s"
        text.append(f", {view.open_changes} open change{plural}", style="bold red")
    speed = speed_words(round(done * view.header.rate_hz), done, view.wall_s)
    if speed:
        text.append(f"\n{speed}", style="dim")
    return text


def _decisions(view: TrackView) -> list[Text]:
    from rich.text import Text

    if not view.decisions:
        return []
    lines = [Text()]
    for e in view.decisions[-_DECISIONS:]:
        text = Text(no_wrap=True, overflow="ellipsis")
        text.append(f"{e.t:10.3f} s  ", style="dim")
        who = f" {e.parameter}" if e.parameter else ""
        text.append(f"{e.kind}{who}: ", style="bold red" if e.kind in _BAD else "bold").append(" ".join(e.why.split()))
        lines.append(text)
    return lines
