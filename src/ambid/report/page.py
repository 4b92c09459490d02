"""The report: one HTML file with everything in it, for the archive and for other people."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ambid.estimation.estimate import Estimate, EstimatedParameter
from ambid.physics.models import model
from ambid.report.figures import Evidence, figures, save
from ambid.report.numbers import quantity
from ambid.report.text import delay_lines, fit_rows, other_warnings, style_of, validation_rows, verdict

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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

    `evidence`: estimate and the replayed record it came from; `made`: date of the report, for its provenance; left out
    where empty. Returns HTML; figures are inside it.
    """
    return rendered(_content(evidence, made))


def rendered(content: Mapping[str, Any]) -> str:
    """Fill the page.

    `content`: what its template names. Returns HTML; texts are escaped.
    """
    from jinja2 import Environment, StrictUndefined

    source = files("ambid").joinpath("data", "report.html.j2").read_text(encoding="utf-8")
    template = Environment(autoescape=True, undefined=StrictUndefined).from_string(source)
    return template.render(**content)


def _content(evidence: Evidence, made: str) -> dict[str, Any]:
    e = evidence.estimate
    samples, rate = int(str(e.record["samples"])), float(str(e.record["rate_hz"]))
    meaning = {spec.name: spec.meaning for spec in model(e.model).parameters}
    return {
        "title": f"{e.record.get('file') or 'record'}: physical parameters",
        "subtitle": f"{e.rig.get('name') or 'no rig'} – model {e.model}, {samples} samples at {rate:g} Hz"
        f" ({samples / rate:.4g} s), search {e.status}",
        "status": e.status,
        "warnings": other_warnings(e),
        "parameters": parameter_cells(e.parameters, meaning, finished=e.status == "converged"),
        "method": e.covariance_method,
        "correlation_names": list(e.covariance_names),
        "correlations": list(zip(e.covariance_names, correlations(e.covariance), strict=True)),
        "curves": [],
        "delays": delay_lines(e),
        "fits": fit_rows(e),
        "checks": [{"name": name, "passed": c.passed, "detail": c.detail} for name, c in e.checks.items()],
        "validation": None if e.validation is None else _validation(e.validation),
        "figures": embedded(figures(evidence), _CAPTIONS),
        "provenance": _provenance(e, made),
        "history": _listed(e.record.get("history")),
        "rig": str(e.rig.get("text") or ""),
    }


def parameter_cells(
    parameters: Sequence[EstimatedParameter], meaning: Mapping[str, str], *, finished: bool
) -> list[dict[str, str]]:
    """Make the rows of the table of parameters.

    `meaning`: what each is, in a line; `finished`: whether the search converged. Returns ``name``, ``meaning``,
    ``text``, ``interval``, ``si``, ``verdict`` and ``style`` of each.
    """
    rows = []
    for p in parameters:
        q = quantity(p.value, p.sd, p.unit, ci95=p.ci95)
        style = style_of(p, finished=finished)
        interval = f"{q.low} … {q.high}" if q.low else ""
        rows.append(
            {"name": p.name, "meaning": meaning[p.name], "text": q.text, "interval": interval, "si": q.si,
             "verdict": verdict(p, finished=finished), "style": style}
        )  # fmt: skip
    return rows


def correlations(covariance: NDArray[np.float64]) -> list[list[str]]:
    """Write a covariance as correlations.

    `covariance`: (n, n).
    """
    sd = np.sqrt(np.diag(covariance))
    return [[f"{x:.3f}" for x in row] for row in covariance / np.outer(sd, sd)]


def _validation(validation: Mapping[str, Any]) -> dict[str, Any]:
    checks = [{"name": n, "passed": c["passed"], "detail": c["detail"]} for n, c in validation["checks"].items()]
    return {"fits": validation_rows(validation), "checks": checks}


def embedded(drawn: Mapping[str, Figure], captions: Mapping[str, tuple[str, str]]) -> list[dict[str, str]]:
    """Put figures into the page.

    `captions`: title and caption of each. Returns ``title``, ``caption`` and ``png`` of each.
    """
    found = []
    for name, figure in drawn.items():
        title, caption = captions[name]
        buffer = io.BytesIO()
        save(figure, buffer, kind="png")
        found.append({"title": title, "caption": caption, "png": base64.b64encode(buffer.getvalue()).decode()})
    return found


def library_versions() -> str:
    """Name the libraries that a result hangs on, with their versions."""
    return ", ".join(f"{name} {version(name)}" for name in _LIBRARIES)


def _provenance(e: Estimate, made: str) -> list[tuple[str, str]]:
    rows = [("record", str(e.record.get("file") or "–")), ("SHA-256 of the record", str(e.record.get("sha256") or "–"))]
    rows += [("rig", str(e.rig.get("name") or "–"))]
    rows += [("operating point", ", ".join(f"{role} {x:.6g}" for role, x in e.operating_point.items()) + " (SI)")]
    rows += [("computing time", f"{sum(e.timing_s.values()):.3g} s")] if e.timing_s else []
    rows += [("made", made)] if made else []
    return [*rows, ("versions", library_versions())]


def _listed(history: object) -> Sequence[str]:
    return [str(step) for step in history] if isinstance(history, (list, tuple)) else []
