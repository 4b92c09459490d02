"""Results of a fleet, as tables for the terminal, and as panels."""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.errors import counted, listed
from ambid.report.document import Document, Lines, Section, grid, value_columns
from ambid.report.drawing import BAND, BOUND, MEASURED, PREDICTED, Block, head, panel, said_panel, stacked
from ambid.report.numbers import prefixed, quantity, sized
from ambid.report.text import WORDS, Line
from ambid.settings.caller import setting
from ambid.validation.coverage import Coverage, Covered

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


_MOST_REASONS = 5


def coverage_title(coverage: Coverage) -> str:
    """Return what was done, in a few words."""
    return f"{coverage.job} of {counted(len(coverage.trials), 'simulated record')} of {coverage.rig}"


def coverage_document(coverage: Coverage, _: Any) -> Document:
    """Describe a Monte Carlo over a rig."""
    c, title = coverage, coverage_title(coverage)
    columns: dict[str, list[object]] = {n: [getattr(t, n) for t in c.trials] for n in ("seed", "verdict", "reason")}
    return Document(
        title=title, sections=coverage_sections(c), figure=partial(coverage_figure, c, title),
        frame=lambda: ("seed", columns | value_columns(c.trials, c.truth)),
    )  # fmt: skip


def coverage_sections(coverage: Coverage) -> list[Section]:
    """Say bias, spread and coverage of each parameter."""
    c, n = coverage, coverage.counts
    failed = [f"{n['failed']} failed"] * bool(n["failed"])
    words = ", ".join([*(f"{n[w]} {WORDS[w][0]}" for w in WORDS if n[w]), *failed])
    head: list[Line] = [[(coverage_title(c), "strong"), f": {words}"], f"{c.seconds:.3g} s"]
    rows: list[tuple[str, ...]] = [
        ("", "truth", "mean ± sd of it", "bias/sd", "sd said/seen", "95 % hold", "(95 %)", "max |z|")
    ]
    rows += [_row(r, c.units.get(r.name, "")) for r in c.rows]
    reasons = Counter(t.reason for t in c.trials if t.reason).most_common(_MOST_REASONS)
    return [
        Section(parts=[Lines(lines=head, indent=2)]),
        Section(title="Parameters", parts=[grid(rows)]),
        Section(
            heading=[("failures", "strong")],
            parts=[Lines(lines=[f"{k} x {reason}" for reason, k in reasons], indent=4)],
        ),
    ]


def _row(r: Covered, unit: str) -> tuple[str, ...]:
    low, high = (100 * x for x in r.coverage)
    unknown = f" ({r.unknown} not seen)" if r.unknown else ""
    return (
        r.name, sized(r.truth, unit), quantity(r.truth + r.bias, r.bias_sd, unit).text, f"{r.bias / r.said:+.2f}",
        f"{r.ratio[0]:.2f} to {r.ratio[1]:.2f}", f"{r.inside} of {r.runs}{unknown}", f"{low:.1f} to {high:.1f} %",
        f"{r.largest_z:.2g}",
    )  # fmt: skip


def coverage_figure(coverage: Coverage, title: str, width: float) -> Figure:
    """Draw how often intervals hold the truth, and the errors in standard deviations."""
    rows = coverage.rows
    if not rows:
        return stacked(title, [said_panel("no run gave a number")], width)

    def shares(axes: Axes) -> None:
        at = np.arange(len(rows))
        low, high = (100 * np.array([r.coverage[k] for r in rows]) for k in (0, 1))
        middle = np.array([100 * r.inside / r.runs for r in rows])
        axes.errorbar(middle, at, xerr=(np.maximum(middle - low, 0), np.maximum(high - middle, 0)), fmt="o",
                      color=PREDICTED, label="share, 95 %")  # fmt: skip
        axes.axvline(95.0, color=BOUND, linewidth=1.0, label="said")
        axes.set_yticks(at, [r.name for r in rows])
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_xlabel("95 % intervals that hold the truth [%]")

    def errors(axes: Axes) -> None:
        from scipy.stats import norm

        z = np.concatenate([coverage.z(r.name) for r in rows])
        reach = max(4.0, float(np.ceil(np.max(np.abs(z)))))
        axes.hist(z, bins=np.linspace(-reach, reach, 41).tolist(), density=True, color=BAND, label="all parameters")
        x = np.linspace(-reach, reach, 200)
        axes.plot(x, norm.pdf(x), color=MEASURED, label="standard normal")
        axes.set_xlabel("error / standard deviation")
        head(axes, f"rms {np.sqrt(np.mean(z**2)):.2f}, largest {np.max(np.abs(z)):.2g}")

    tall = max(2.5, 0.22 * len(rows))
    block = Block(columns=[[panel(shares, height=tall)], [panel(errors, height=tall)]], shared=False)
    return stacked(title, [block], width)
