"""The report of a nonlinear bearing: one HTML file with everything in it."""

from __future__ import annotations

from typing import Any

import numpy as np

from ambid.bearing.magnet.result import NonlinearBearingEstimate
from ambid.physics.bearing_numbers import BEARING_NUMBERS
from ambid.physics.models import model
from ambid.report.bearing_figure import BearingEvidence, bearing_figures
from ambid.report.bearing_text import curve_rows, delay_lines, fit_rows, other_warnings, validation_rows
from ambid.report.page import correlations, embedded, library_versions, parameter_cells, rendered

_CAPTIONS = {
    "curves": (
        "Curves",
        "From one co-energy, so that force and motional voltage agree, with the bands that the covariance gives. "
        "Dotted where no record came: there the law extrapolates, and the band does not know it.",
    ),
    "map": (
        "Where the records were",
        "Each point a sample. For one magnet, the line on which its force is the weight: a rotor at rest stands on it.",
    ),
    "records": (
        "Records",
        "Each sample predicted from all samples before it; errors over the standard deviation that the predictor "
        "expects of them. For a right model they are white: about 1 % outside the bounds, no pattern.",
    ),
}


def bearing_html(evidence: BearingEvidence, *, made: str = "") -> str:
    """Write the report of an estimate.

    `made`: date of the report, for its provenance; left out where empty. Returns HTML; figures are inside it.
    """
    return rendered(_content(evidence, made))


def _content(evidence: BearingEvidence, made: str) -> dict[str, Any]:
    e = evidence.estimate
    meaning = {spec.name: spec.meaning for spec in (*model(e.model).parameters, *BEARING_NUMBERS)}
    seconds = sum(float(str(r["samples"])) / float(str(r["rate_hz"])) for r in e.records)
    names = list(e.noise)
    first = names[0] if len(names) == 1 else f"{len(names)} records"
    checks = [{"name": name, "passed": c.passed, "detail": c.detail} for name, c in e.checks.items()]
    return {
        "title": f"{first}: nonlinear bearing",
        "subtitle": f"{e.rig.get('name') or 'no rig'} – {e.law}, {seconds:.4g} s in all, search {e.status}",
        "status": e.status,
        "warnings": other_warnings(e),
        "parameters": parameter_cells(e.parameters, meaning, finished=e.status == "converged"),
        "method": e.covariance_method,
        "correlation_names": list(e.covariance_names),
        "correlations": list(zip(e.covariance_names, correlations(e.covariance), strict=True)),
        "curves": curve_rows(
            e, np.linspace(*e.usual["position"], 5), np.linspace(*e.usual["current"], 3)
        ),
        "delays": delay_lines(e),
        "fits": fit_rows(e),
        "checks": checks,
        "validation": _validation(e),
        "figures": embedded(bearing_figures(evidence), _CAPTIONS),
        "provenance": _provenance(e, made),
        "history": [f"{name}: {step}" for name, r in zip(names, e.records, strict=True) for step in _steps(r)],
        "rig": str(e.rig.get("text") or ""),
    }  # fmt: skip


def _validation(e: NonlinearBearingEstimate) -> dict[str, Any] | None:
    if e.validation is None:
        return None
    found: Any = e.validation["checks"]
    checks = [{"name": n, "passed": c["passed"], "detail": c["detail"]} for n, c in found.items()]
    return {"fits": validation_rows(e.validation), "checks": checks}


def _steps(record: Any) -> list[str]:
    history = record.get("history")
    return [str(step) for step in history] if isinstance(history, (list, tuple)) else []


def _provenance(e: NonlinearBearingEstimate, made: str) -> list[tuple[str, str]]:
    rows = [(name, f"SHA-256 {r.get('sha256') or '–'}") for name, r in zip(e.noise, e.records, strict=True)]
    rows += [("rig", str(e.rig.get("name") or "–"))]
    rows += [("operating point", ", ".join(f"{role} {x:.6g}" for role, x in e.operating_point.items()) + " (SI)")]
    rows += [("computing time", f"{sum(e.timing_s.values()):.3g} s")] if e.timing_s else []
    rows += [("made", made)] if made else []
    return [*rows, ("versions", library_versions())]
