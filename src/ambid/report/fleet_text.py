"""Results of a fleet, as tables for the terminal, and as panels."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from ambid.errors import counted
from ambid.report.drawing import BOUND, MEASURED, Block, head, panel, said_panel, stacked
from ambid.report.numbers import prefixed, sized
from ambid.report.text import WIDTH, WORDS, Paint, columns, joined, plain, wrapped
from ambid.settings.caller import setting

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ambid.ledger.fleet_run import FleetRun

_SHOWN = 3  # records of one reason
_REASONS = 8


def fleet_title(found: FleetRun) -> str:
    """Return what a run is, in a few words."""
    return f"{found.job} of {counted(found.records, 'record')}"


def fleet_text(found: FleetRun, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write the results of a fleet, below their verdict."""
    n = found.counts
    parts = [f"{n['done']} done", *(f"{n[k]} {what}" for k, what in _COUNTED.items() if n[k])]
    rate = (n["done"] + n["failed"]) / max(found.seconds, 1e-9)
    lines = [
        f"{paint(fleet_title(found), 'strong')}: {', '.join(parts)}",
        f"{counted(found.workers, 'worker')}, {found.seconds:.3g} s, {rate:.3g} records/s"
        + (f"; ledger {found.ledger}" if found.ledger else ""),
    ]
    words = Counter(row.verdict for row in found.rows if row.verdict)
    judged = [f"{words[w]} {WORDS[w][0]}" for w in WORDS if words[w]]
    return joined([wrapped(lines, width, "  "), judged and [f"results: {', '.join(judged)}"],
                   _failures(found, width, paint), _spread(found, paint)])  # fmt: skip


_COUNTED = {"failed": "failed", "known": "known before", "left": "left"}


def _failures(found: FleetRun, width: int, paint: Paint) -> list[str]:
    reasons = found.failures
    lines = [paint("failures", "strong")] if reasons else []
    for reason, records in list(reasons.items())[:_REASONS]:
        names = ", ".join(records[:_SHOWN]) + (f" and {len(records) - _SHOWN} more" if len(records) > _SHOWN else "")
        lines += wrapped([f"{len(records)} x {reason}", f"    {names}"], width, "    ")
    more = len(reasons) - _REASONS
    return lines + ([f"and {counted(more, 'reason')} more; {setting('json')} has them all"] if more > 0 else [])


def _values(found: FleetRun, name: str) -> tuple[list[int], list[float], list[float]]:
    """Return row, value and standard deviation of a number where a record shows it."""
    shown = [(k, *row.values[name]) for k, row in enumerate(found.rows) if row.values.get(name, (None,))[0] is not None]
    return [k for k, _, _ in shown], [float(x or 0.0) for _, x, _ in shown], [s or 0.0 for _, _, s in shown]


def _names(found: FleetRun) -> list[str]:
    return list(dict.fromkeys(name for row in found.rows for name in row.values))


def _spread(found: FleetRun, paint: Paint) -> list[str]:
    rows: list[tuple[str, ...]] = []
    for name in _names(found):
        at, x, _ = _values(found, name)
        if at:
            unit = found.units.get(name, "1")
            low, middle, high = (sized(float(q), unit, 4) for q in np.quantile(x, (0.05, 0.5, 0.95)))
            rows.append((name, str(len(at)), middle, f"{low} .. {high}"))
    if not rows:
        return []
    table = columns([("", "records", "median", "9 of 10 within"), *rows], right=(1,))
    return [paint("over the records", "strong"), *table]


def fleet_figure(found: FleetRun, title: str, width: float) -> Figure:
    """Draw each number over the records, with its 95 % interval."""
    panels = [panel(_strip, found, name) for name in _names(found) if _values(found, name)[0]]
    return stacked(title, [Block(columns=[panels])] if panels else [said_panel("no record gave a number")], width)


def _strip(axes: Axes, found: FleetRun, name: str) -> None:
    at, x, s = (np.array(c, dtype=float) for c in _values(found, name))
    scale, unit = prefixed(float(np.max(np.abs(x))), found.units.get(name, "1"))
    axes.errorbar(at, x / scale, 1.96 * s / scale, fmt=".", color=MEASURED, markersize=3, linewidth=0.7)
    axes.axhline(float(np.median(x)) / scale, color=BOUND, linestyle=":", label="median")
    head(axes, f"{name}: {counted(len(at), 'record')}")
    axes.set_ylabel(f"{name} [{unit}]")
    axes.set_xlabel("record")
