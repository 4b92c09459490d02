"""The estimate of a nonlinear bearing as a table for the terminal: 80 columns, readable without colour."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

import numpy as np

from ambid.bearing.magnet.result import Curve, NonlinearBearingEstimate
from ambid.estimation.estimate import Check
from ambid.report.numbers import prefixed, quantity, sized
from ambid.report.text import (
    WIDTH,
    Paint,
    check_lines,
    columns,
    parameter_lines,
    plain,
    timing_line,
    warning_lines,
)

_POSITIONS, _CURRENTS = 5, 3  # of the table of curves
_UNITS = {"position": "m", "current": "A"}


def bearing_text(estimate: NonlinearBearingEstimate, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write an estimate for people.

    `width`: columns of the terminal; `paint`: adds colour; the layout does not depend on it. Returns header, warnings,
    numbers, curves, delay, fit by record, checks, validation and timing, without a final line feed.
    """
    blocks = [
        header_lines(estimate, width=width, paint=paint),
        warning_lines(other_warnings(estimate), width=width, paint=paint),
        parameter_lines(estimate, width=width, paint=paint, finished=estimate.status == "converged"),
        curve_lines(estimate, width=width),
        delay_lines(estimate),
        columns(fit_rows(estimate)),
        check_lines(estimate.checks, width=width, paint=paint),
        [] if estimate.validation is None else validation_lines(estimate.validation, width=width, paint=paint),
        [paint(timing_line(estimate.timing_s), "dim")] if estimate.timing_s else [],
    ]
    return "\n\n".join("\n".join(block) for block in blocks if block)


def header_lines(estimate: NonlinearBearingEstimate, *, width: int = WIDTH, paint: Paint = plain) -> list[str]:
    """Say what was identified from what, and whether the search converged.

    `width`: columns of the terminal; `paint`: adds colour. Returns the law and how long the records are; their names,
    those of a held rotor apart.
    """
    records = estimate.records
    seconds = sum(float(str(r["samples"])) / float(str(r["rate_hz"])) for r in records)
    names = list(estimate.noise)
    verdict = "" if estimate.status == "converged" else paint(f" – {estimate.status}", "bad")
    more = [t for t, on in (("eddy pole", estimate.eddy), ("drift", estimate.drift)) if on]
    law = ", ".join([str(estimate.law), *more])
    first = names[0] if len(names) == 1 else f"{len(names)} records"
    lines = [f"{paint(first, 'strong')}: {law}, {seconds:.4g} s{verdict}"]
    for words, held in (("moving", False), ("held", True)):
        of = [n for n, r in zip(names, records, strict=True) if bool(r["held"]) == held]
        if of and len(names) > 1:
            lines += textwrap.wrap(f"{words}: {', '.join(of)}", width, subsequent_indent="  ", break_on_hyphens=False)
    return lines


def other_warnings(estimate: NonlinearBearingEstimate) -> list[str]:
    """Return the warnings that say more than the detail of a failed check, which stands with the checks."""
    said = {c.detail for c in estimate.checks.values()}
    return [w for w in estimate.warnings if w not in said]


def curve_lines(estimate: NonlinearBearingEstimate, *, width: int = WIDTH) -> list[str]:
    """Write k_i, k_x and L over gap and current, each with its standard deviation.

    `width`: columns of the terminal; where they are too few, the middle current stands alone. Returns a table for each,
    over positions and currents where the free rotor usually was; * marks points that no record came to.
    """
    x = np.linspace(*estimate.usual["position"], _POSITIONS)
    i = np.linspace(*estimate.usual["current"], _CURRENTS)
    rows = curve_rows(estimate, x, i)
    if max(len(line) for block in rows for line in columns(block)) > width:
        rows = curve_rows(estimate, x, i[1:2])
    lines: list[str] = []
    for block in rows:
        lines += ["", *columns(block)] if lines else columns(block)
    if any("*" in cell for block in rows for row in block for cell in row):
        lines += ["* no record came there: the law extrapolates, which its deviation does not know"]
    return lines


def curve_rows(
    estimate: NonlinearBearingEstimate, position: np.ndarray, current: np.ndarray
) -> list[list[tuple[str, ...]]]:
    """Make tables of k_i, k_x and L over position and current.

    `position`: (n_positions,), m; `current`: (n_currents,), A. Returns three tables, each with a header.
    """
    grid = np.meshgrid(position, current, indexing="ij")
    found = estimate.curves(grid[0].ravel(), grid[1].ravel())
    scale, unit = prefixed(float(np.max(np.abs(position))), "m")
    heads = [f"at {c:.3g} A" for c in current]
    tables = []
    seen = {"k_i": found.inside, "k_x": found.inside, "L": found.coil_inside}
    for name, curve in (("k_i", found.k_i), ("k_x", found.k_x), ("L", found.L)):
        cells, shown = _cells(curve, seen[name])
        table = [(f"{name} [{shown}]", *heads)]
        for k, x in enumerate(position.tolist()):
            row = cells[k * len(heads) : (k + 1) * len(heads)]
            table.append((f"  {x / scale:.4g} {unit}", *row))
        tables.append(table)
    return tables


def _cells(curve: Curve, inside: np.ndarray) -> tuple[list[str], str]:
    """Values with standard deviations, all in the unit that suits the largest."""
    scale, unit = prefixed(float(np.max(np.abs(curve.value))), curve.unit)
    cells = []
    for value, sd, seen in zip(curve.value / scale, curve.sd / scale, inside, strict=True):
        digits = 1 - int(np.floor(np.log10(sd))) if sd > 0 else 4
        digits = min(max(digits, 0), 6)
        cells.append(f"{value:.{digits}f} ± {sd:.{digits}f}{'' if seen else ' *'}")
    return cells, unit


def delay_lines(estimate: NonlinearBearingEstimate) -> list[str]:
    """Say by how much the voltage is delayed, at each sampling rate."""
    lines = []
    for rate, d in estimate.delay.items():
        total = d.samples + d.fraction
        count = f"{total:.3g}" if d.sd is None else quantity(total, d.sd, "1").text.removesuffix(" 1")
        plural = "" if count == "1" else "s"
        time = f" ({sized(total / float(rate.removesuffix(' Hz')), 's')})" if total else ""
        lines.append(f"delay of voltage at {rate}: {count} sample{plural}{time}, {d.how}")
    return lines


def fit_rows(estimate: NonlinearBearingEstimate) -> list[tuple[str, ...]]:
    """Make a table of the one-step fit of each output on each record.

    Returns a header and a row for each record; of a held rotor the position is not predicted.
    """
    rows: list[tuple[str, ...]] = [("one-step fit", "position", "innovations", "current", "innovations")]
    for name, fits in estimate.fit.items():
        cells: list[str] = []
        for role, unit in _UNITS.items():
            f = fits.get(role)
            cells += ["held", ""] if f is None else [f"{f.one_step:.4f}", f"{sized(f.innovation_sd, unit)} rms"]
        rows.append((name, *cells))
    return rows


def validation_lines(validation: Mapping[str, Any], *, width: int = WIDTH, paint: Paint = plain) -> list[str]:
    """Write how an estimate does on a further record.

    `validation`: as `ambid.validate.nonlinear_bearing.validation` gives it; `width`: columns of the terminal; `paint`:
    adds colour. Returns fits of each output, then the checks.
    """
    checks = {
        name: Check(passed=bool(c["passed"]), detail=str(c["detail"]), p=c.get("p"))
        for name, c in validation["checks"].items()
    }
    return [
        paint(f"on the second record ({validation['samples']} samples)", "strong"),
        *columns(validation_rows(validation)),
        *check_lines(checks, width=width, paint=paint),
    ]


def validation_rows(validation: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Make a table of the fit of each output on a further record.

    `validation`: as `ambid.validate.nonlinear_bearing.validation` gives it.
    """
    rows: list[tuple[str, ...]] = [("fit", "one step", "innovations", "of those at identification")]
    for role, f in validation["fit"].items():
        rms = f"{sized(float(f['innovation_rms']), _UNITS[role])} rms"
        rows.append((role, f"{f['one_step']:.4f}", rms, f"{100 * float(f['ratio']):.3g} %"))
    return rows
