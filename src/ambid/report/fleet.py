"""Results of a fleet, as tables for the terminal, and as panels."""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.errors import counted, listed
from ambid.report.document import Document, Lines, Section, grid, value_columns
from ambid.report.drawing import BOUND, MEASURED, Block, head, panel, said_panel, stacked
from ambid.report.numbers import prefixed, sized
from ambid.report.text import WORDS, Line
from ambid.settings.caller import setting

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ambid.ledger.store import FleetRun


_SHOWN = 3  # records of one reason

_REASONS = 8


def fleet_title(fleet: FleetRun) -> str:
    """Return what a run is, in a few words."""
    return f"{fleet.job} of {counted(fleet.records, 'record')}"


def fleet_document(fleet: FleetRun, _: Any) -> Document:
    """Describe what a fleet gave."""
    f, title = fleet, fleet_title(fleet)
    names = ("record", "bearing", "rig", "taken_at", "state", "status", "verdict", "checks", "reason", "seconds")
    columns: dict[str, list[object]] = {name: [getattr(row, name) for row in f.rows] for name in names}
    columns["checks"] = [", ".join(row.checks) for row in f.rows]
    return Document(
        title=title, sections=fleet_sections(f), figure=partial(fleet_figure, f, title),
        frame=lambda: ("record", columns | value_columns(f.rows, _names(f))),
    )  # fmt: skip


def fleet_sections(fleet: FleetRun) -> list[Section]:
    """Say what a fleet gave."""
    f, n = fleet, fleet.counts
    parts = [f"{n['done']} done", *(f"{n[k]} {what}" for k, what in _COUNTED.items() if n[k])]
    rate = (n["done"] + n["failed"]) / max(f.seconds, 1e-9)
    ledger = f"; ledger {f.ledger}" if f.ledger else ""
    head: list[Line] = [
        [(fleet_title(f), "strong"), f": {', '.join(parts)}"],
        f"{counted(f.workers, 'worker')}, {f.seconds:.3g} s, {rate:.3g} records/s{ledger}",
    ]
    words = Counter(row.verdict for row in f.rows if row.verdict)
    judged = ", ".join(f"{words[w]} {WORDS[w][0]}" for w in WORDS if words[w])
    failures = list[str]()
    for reason, records in list(f.failures.items())[:_REASONS]:
        names = listed(records, _SHOWN)
        failures += [f"{len(records)} x {reason}", f"    {names}"]
    more = len(f.failures) - _REASONS
    failures += [f"and {counted(more, 'reason')} more; {setting('json')} has them all"] if more > 0 else []
    spread: list[tuple[str, ...]] = []
    for name in _names(f):
        at, x, _ = _values(f, name)
        if at:
            unit = f.units.get(name, "1")
            low, middle, high = (sized(float(q), unit, 4) for q in np.quantile(x, (0.05, 0.5, 0.95)))
            spread.append((name, str(len(at)), middle, f"{low} .. {high}"))
    return [
        Section(parts=[Lines(lines=head, indent=2)]),
        Section(parts=[Lines(lines=[f"results: {judged}"] if judged else [], wrap=False)]),
        Section(heading=[("failures", "strong")], parts=[Lines(lines=failures, indent=4)]),
        Section(
            heading=[("over the records", "strong")],
            parts=[grid([("", "records", "median", "9 of 10 within"), *spread], right=(1,))] if spread else [],
        ),
    ]


_COUNTED = {"failed": "failed", "known": "in the ledger already", "left": "left"}


def _values(fleet: FleetRun, name: str) -> tuple[list[int], list[float], list[float]]:
    """Return row, value and standard deviation of a number where a record shows it."""
    points = [
        (k, *row.values[name]) for k, row in enumerate(fleet.rows) if row.values.get(name, (None,))[0] is not None
    ]
    return [k for k, _, _ in points], [float(x or 0.0) for _, x, _ in points], [s or 0.0 for _, _, s in points]


def _names(fleet: FleetRun) -> list[str]:
    return list(dict.fromkeys(name for row in fleet.rows for name in row.values))


def fleet_figure(fleet: FleetRun, title: str, width: float) -> Figure:
    """Draw each number over the records, with its 95 % interval."""
    panels = [panel(_strip, fleet, name) for name in _names(fleet) if _values(fleet, name)[0]]
    return stacked(title, [Block(columns=[panels])] if panels else [said_panel("no record gave a number")], width)


def _strip(axes: Axes, fleet: FleetRun, name: str) -> None:
    at, x, s = (np.array(c, dtype=float) for c in _values(fleet, name))
    scale, unit = prefixed(float(np.max(np.abs(x))), fleet.units.get(name, "1"))
    axes.errorbar(at, x / scale, 1.96 * s / scale, fmt=".", color=MEASURED, markersize=3, linewidth=0.7)
    axes.axhline(float(np.median(x)) / scale, color=BOUND, linestyle=":", label="median")
    head(axes, f"{name}: {counted(len(at), 'record')}")
    axes.set_ylabel(f"{name} [{unit}]")
    axes.set_xlabel("record")
