"""Physical parameters as tables for the terminal: of a record, a nonlinear bearing, a black box, a response."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.bearing.magnet_result import Curve, NonlinearBearingEstimate
from ambid.errors import counted
from ambid.estimation.estimate import Estimate, Judged
from ambid.physics.linear_model import model
from ambid.report.numbers import prefixed, sized
from ambid.report.text import (
    WIDTH,
    Paint,
    check_lines,
    checks_of,
    columns,
    delay_line,
    fit_rows,
    fraction,
    joined,
    other_warnings,
    parameter_lines,
    plain,
    pure,
    record_line,
    status_words,
    timing_lines,
    warning_lines,
)

if TYPE_CHECKING:
    from ambid.bearing.frequency import FrequencyEstimate
    from ambid.bearing.physical import PhysicalFit
    from ambid.validation.second_result import Validation

AnyEstimate = Estimate | NonlinearBearingEstimate

_POSITIONS, _CURRENTS = 5, 3  # of the table of curves
_UNITS = {"position": "m", "current": "A"}


def estimate_text(estimate: AnyEstimate, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write an estimate, linear or of a nonlinear bearing, below its verdict; colour does not change the layout."""
    curves = curve_lines(estimate, width=width) if isinstance(estimate, NonlinearBearingEstimate) else []
    warnings = warning_lines(other_warnings(estimate.checks, estimate.warnings), width=width, paint=paint)
    validation = estimate.validation
    return joined(
        [
            header_lines(estimate, width=width, paint=paint),
            warnings if curves else [],
            parameter_lines(estimate.parameters, width=width, paint=paint, found=estimate.verdict),
            curves,
            delay_lines(estimate),
            columns(output_rows(estimate)),
            sensitivity_lines(getattr(estimate, "sensitivity", {})),
            check_lines(estimate.checks, width=width, paint=paint, above=True),
            [] if validation is None else validation_lines(validation, width=width, paint=paint),
            [] if curves else warnings,
            timing_lines(estimate.timing_s, paint=paint),
        ]
    )


def header_lines(estimate: AnyEstimate, *, width: int = WIDTH, paint: Paint = plain) -> list[str]:
    """Say what was identified from what, and whether the search converged; of several records their names."""
    if isinstance(estimate, Estimate):
        return [record_line(estimate, f"model {estimate.model}", paint)]
    names = list(estimate.noise)
    law = ", ".join([str(estimate.law), *(["eddy pole"] * estimate.eddy), *(["drift"] * estimate.drift)])
    verdict = status_words(estimate.status, paint)
    lines = [f"{paint(names_words(names), 'strong')}: {law}, {seconds_of(estimate):.4g} s{verdict}"]
    for words, held in (("moving", False), ("held", True)):
        of = [n for n, r in zip(names, estimate.records, strict=True) if bool(r["held"]) == held]
        if of and len(names) > 1:
            lines += textwrap.wrap(f"{words}: {', '.join(of)}", width, subsequent_indent="  ", break_on_hyphens=False)
    return lines


def names_words(names: list[str]) -> str:
    """Name one record, or say how many there are."""
    return names[0] if len(names) == 1 else f"{len(names)} records"


def seconds_of(estimate: NonlinearBearingEstimate) -> float:
    """Return the length of all records in s."""
    return sum(float(str(r["samples"])) / float(str(r["rate_hz"])) for r in estimate.records)


def curve_lines(estimate: NonlinearBearingEstimate, *, width: int = WIDTH) -> list[str]:
    """Return tables of k_i, k_x and L over positions and currents where the free rotor usually was.

    On a narrow terminal the middle current stands alone; * marks points that no record came to.
    """
    tables = curve_rows(estimate)
    if max(len(line) for table in tables for line in columns(table)) > width:
        tables = curve_rows(estimate, current=np.array([np.mean(estimate.usual["current"])]))
    lines: list[str] = []
    for table in tables:
        lines += ["", *columns(table)] if lines else columns(table)
    if any("*" in cell for table in tables for row in table for cell in row):
        lines += ["* outside the recorded range: the law extrapolates; its sd does not cover that"]
    return lines


def curve_rows(
    estimate: NonlinearBearingEstimate, position: Array | None = None, current: Array | None = None
) -> list[list[tuple[str, ...]]]:
    """Return a table each of k_i, k_x and L over positions in m and currents in A, where the free rotor usually was."""
    position = np.linspace(*estimate.usual["position"], _POSITIONS) if position is None else position
    current = np.linspace(*estimate.usual["current"], _CURRENTS) if current is None else current
    grid = np.meshgrid(position, current, indexing="ij")
    found = estimate.curves(grid[0].ravel(), grid[1].ravel())
    scale, unit = prefixed(float(np.max(np.abs(position))), "m")
    heads = [f"at {c:.3g} A" for c in current]
    tables = []
    seen = {"k_i": found.inside, "k_x": found.inside, "L": found.coil_inside}
    for name, inside in seen.items():
        cells, shown = _cells(getattr(found, name), inside)
        table = [(f"{name} [{shown}]", *heads)]
        for k, x in enumerate(position.tolist()):
            table.append((f"  {x / scale:.4g} {unit}", *cells[k * len(heads) : (k + 1) * len(heads)]))
        tables.append(table)
    return tables


def _cells(curve: Curve, inside: NDArray[np.bool_]) -> tuple[list[str], str]:
    """Values with standard deviations, all in the unit that suits the largest."""
    scale, unit = prefixed(float(np.max(np.abs(curve.value))), curve.unit)
    cells = []
    for value, sd, seen in zip(curve.value / scale, curve.sd / scale, inside, strict=True):
        digits = 1 - int(np.floor(np.log10(sd))) if sd > 0 else 4
        digits = min(max(digits, 0), 6)
        cells.append(f"{value:.{digits}f} ± {sd:.{digits}f}{'' if seen else ' *'}")
    return cells, unit


def delay_lines(estimate: AnyEstimate) -> list[str]:
    """Say by how much each input is delayed; of a bearing the voltage, at each sampling rate."""
    if isinstance(estimate, Estimate):
        rate = float(str(estimate.record["rate_hz"]))
        return [delay_line(role, d, rate) for role, d in estimate.delay.items()]
    return [delay_line(f"voltage at {rate}", d, float(rate.removesuffix(" Hz"))) for rate, d in estimate.delay.items()]


def output_rows(estimate: AnyEstimate) -> list[tuple[str, ...]]:
    """Return a table of the fit of each output; of a bearing on each record, where of a held rotor the current."""
    if isinstance(estimate, Estimate):
        return fit_rows(estimate.fit, model(estimate.model).units, "unstable in open loop")
    rows: list[tuple[str, ...]] = [("one-step fit", "position", "innovations", "current", "innovations")]
    for name, fits in estimate.fit.items():
        cells: list[str] = []
        for role, unit in _UNITS.items():
            f = fits.get(role)
            cells += ["held", ""] if f is None else [f"{f.one_step:.4f}", f"{sized(f.innovation_sd, unit)} rms"]
        rows.append((name, *cells))
    return rows


def sensitivity_lines(sensitivity: Mapping[str, Any]) -> list[str]:
    """Say the peak of the sensitivity of one axis, predicted and measured; nothing where it is not known."""
    lines = []
    for s in sensitivity.values():
        peak, seen = s["peak_db"], s["measured_peak_db"]
        spread = s.get("measured_sd_db") or 0.0
        measured = (
            "" if seen is None else f"; measured {pure(seen, spread)} dB at {sized(s['measured_frequency_hz'], 'Hz')}"
        )
        at = f"{pure(peak['value'], peak['sd'] or 0.0)} dB at {sized(s['frequency_hz'], 'Hz')}"
        lines.append(f"sensitivity of the loop: {at}, zone {s['zone']} of ISO 14839-3{measured}")
    return lines


def validation_lines(validation: Mapping[str, Any], *, width: int = WIDTH, paint: Paint = plain) -> list[str]:
    """Write how an estimate does on a second record: the fit of each output, then the checks."""
    return [
        paint(f"on the second record ({counted(int(validation['samples']), 'sample')})", "strong"),
        *columns(validation_rows(validation)),
        *check_lines(checks_of(validation), width=width, paint=paint),
    ]


def validation_rows(validation: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a table of the fit of each output on a second record: some steps ahead, or beside identification."""
    fits = validation["fit"]
    first = next(iter(fits.values()))
    if "k_step" in first:
        horizons = list(first["k_step"])
        rows = [("fit", *(f"{k} ahead" for k in horizons), "simulation")]
        for role, f in fits.items():
            free = "unstable in open loop" if f["simulation"] is None else fraction(f["simulation"])
            rows.append((role, *(fraction(f["k_step"][k]) for k in horizons), free))
        return rows
    if "over_noise" in first:
        rows = [("fit", "explained", "left over", "over its noise")]
        for role, f in fits.items():
            left = sized(float(f["innovation_rms"]), "A" if role.endswith("_current") else "m")
            rows.append((role, fraction(f["one_step"]), f"{left} rms", f"{float(f['over_noise']):.3g}"))
        return rows
    rows = [("fit", "one step", "innovations", "relative to identification")]
    for role, f in fits.items():
        rms = f"{sized(float(f['innovation_rms']), _UNITS[role])} rms"
        rows.append((role, f"{f['one_step']:.4f}", rms, f"{100 * float(f['ratio']):.3g} %"))
    return rows


def validation_text(found: Validation, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write how a result does on a further record, below its verdict."""
    first = next(iter(found.fit.values()))
    of_fit = isinstance(first["one_step"], Mapping)
    lines = second_lines(found.fit) if of_fit else columns(validation_rows({"fit": found.fit}))
    head = f"{paint(found.record or 'record', 'strong')} tested with {found.estimate or 'a result'}, {found.model}"
    checks = check_lines(found.checks, width=width, paint=paint, above=True)
    return joined([[f"{head}; {found.samples} samples"], lines, checks])


def second_lines(validation: Mapping[str, Any]) -> list[str]:
    """Write how a fit does on a second record, by output; errors in SI. Of a nonlinear fit what is extrapolated too."""
    rows: list[tuple[str, ...]] = [("fit", "one step", "rmse", "simulation", "rmse")]
    for output, found in validation.items():
        rows.append((output, *_pair(found["one_step"]), *_pair(found.get("simulation"))))
    outside = next((found.get("extrapolated") for found in validation.values()), None)
    more = [] if outside is None else [f"outside the training data: {100 * float(outside):.2g} % of it"]
    return [*columns(rows), *more]


def _pair(found: Mapping[str, Any] | None) -> tuple[str, str]:
    return ("–", "–") if found is None or found["fit"] is None else (fraction(found["fit"]), f"{found['rmse']:.4g}")


def physics_text(found: PhysicalFit | FrequencyEstimate, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write the physical parameters that follow from a black-box fit or a measured response, and their checks."""
    d = found.delay
    spread = "" if d.sd is None else f" ± {d.sd:.2g}"
    delay = f"delay {counted(f'{d.samples + d.fraction:.4g}{spread}', 'sample')}, {d.how}"
    if not isinstance(found, Judged):
        low, high = found.band_hz
        about, checks = f", from {found.structure}", {"agreement": found.misfit}
        delay += f"; from {sized(low, 'Hz')} to {sized(high, 'Hz')}"
        warnings = other_warnings(checks, found.warnings)
    else:  # its warnings stand with those of the response
        about, checks, warnings = status_words(found.status, paint), dict(found.checks), []
    lines = [
        paint(f"physical parameters of model {found.model}", "strong") + about,
        *parameter_lines(found.parameters, width=width, paint=paint, found=found.verdict),
        delay,
        *check_lines(checks, width=width, paint=paint),
        *warning_lines(warnings, width=width, paint=paint),
    ]
    return "\n".join(lines)
