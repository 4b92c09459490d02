"""The report: one HTML file with everything in it, for the archive and for other people."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from importlib.resources import files
from typing import Any

import numpy as np

from ambid.identify.estimate import Estimate
from ambid.physics.models import model
from ambid.report.figures import Evidence, figures, save
from ambid.report.numbers import quantity
from ambid.report.text import delay_lines, fit_rows, other_warnings, validation_rows, verdict

_CAPTIONS = {
    "signals": (
        "Measured and predicted",
        "Each sample predicted from all samples before it. Shaded: the stretch shown on the right.",
    ),
    "residuals": (
        "Innovations",
        "What is left of the measurement. For a right model they are white: about 1 % outside the bounds, no pattern.",
    ),
    "bode": (
        "Frequency response of the identified plant",
        "From the physical parameters, with the 95 % band that their covariance gives, up to half the sampling rate.",
    ),
    "poles": ("Poles", "Of the identified plant in open loop, with the 95 % regions that the covariance gives."),
}
_LIBRARIES = ("ambid", "numpy", "scipy", "numba")


def report_html(evidence: Evidence, *, made: str = "") -> str:
    """Write the report of an estimate.

    Parameters
    ----------
    evidence : Evidence
        Estimate and the replayed record it came from.
    made : str
        Date of the report, for its provenance; left out where empty.

    Returns
    -------
    str
        HTML; figures are inside it.
    """
    from jinja2 import Environment, StrictUndefined

    source = files("ambid").joinpath("data", "report.html.j2").read_text(encoding="utf-8")
    template = Environment(autoescape=True, undefined=StrictUndefined).from_string(source)
    return template.render(**_content(evidence, made))


def _content(evidence: Evidence, made: str) -> dict[str, Any]:
    e = evidence.estimate
    samples, rate = int(str(e.record["samples"])), float(str(e.record["rate_hz"]))
    correlation = _correlations(e)
    return {
        "title": f"{e.record.get('file') or 'record'}: physical parameters",
        "subtitle": f"{e.rig.get('name') or 'no rig'} – model {e.model}, {samples} samples at {rate:g} Hz"
        f" ({samples / rate:.4g} s), search {e.status}",
        "status": e.status,
        "warnings": other_warnings(e),
        "parameters": _parameters(e),
        "method": e.covariance_method,
        "correlation_names": list(e.covariance_names),
        "correlations": list(zip(e.covariance_names, correlation, strict=True)),
        "delays": delay_lines(e),
        "fits": fit_rows(e),
        "checks": [{"name": name, "passed": c.passed, "detail": c.detail} for name, c in e.checks.items()],
        "validation": None if e.validation is None else _validation(e.validation),
        "figures": _figures(evidence),
        "provenance": _provenance(e, made),
        "history": _listed(e.record.get("history")),
        "rig": str(e.rig.get("text") or ""),
    }


def _parameters(e: Estimate) -> list[dict[str, str]]:
    meaning = {spec.name: spec.meaning for spec in model(e.model).parameters}
    rows = []
    for p in e.parameters:
        q = quantity(p.value, p.sd, p.unit, ci95=p.ci95)
        style = "dim" if p.role == "fixed" else "good" if p.identifiable else "bad"
        interval = f"{q.low} … {q.high}" if q.low else ""
        rows.append(
            {"name": p.name, "meaning": meaning[p.name], "text": q.text, "interval": interval, "si": q.si,
             "verdict": verdict(p), "style": style}
        )  # fmt: skip
    return rows


def _correlations(e: Estimate) -> list[list[str]]:
    sd = np.sqrt(np.diag(e.covariance))
    return [[f"{x:.3f}" for x in row] for row in e.covariance / np.outer(sd, sd)]


def _validation(validation: Mapping[str, Any]) -> dict[str, Any]:
    checks = [{"name": n, "passed": c["passed"], "detail": c["detail"]} for n, c in validation["checks"].items()]
    return {"fits": validation_rows(validation), "checks": checks}


def _figures(evidence: Evidence) -> list[dict[str, str]]:
    found = []
    for name, figure in figures(evidence).items():
        title, caption = _CAPTIONS[name]
        buffer = io.BytesIO()
        save(figure, buffer, kind="png")
        found.append({"title": title, "caption": caption, "png": base64.b64encode(buffer.getvalue()).decode()})
    return found


def _provenance(e: Estimate, made: str) -> list[tuple[str, str]]:
    rows = [("record", str(e.record.get("file") or "–")), ("SHA-256 of the record", str(e.record.get("sha256") or "–"))]
    rows += [("rig", str(e.rig.get("name") or "–"))]
    rows += [("operating point", ", ".join(f"{role} {x:.6g}" for role, x in e.operating_point.items()) + " (SI)")]
    rows += [("computing time", f"{sum(e.timing_s.values()):.3g} s")] if e.timing_s else []
    rows += [("made", made)] if made else []
    return [*rows, ("versions", ", ".join(f"{name} {version(name)}" for name in _LIBRARIES))]


def _listed(history: object) -> Sequence[str]:
    return [str(step) for step in history] if isinstance(history, (list, tuple)) else []
