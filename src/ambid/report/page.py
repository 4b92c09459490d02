"""The report: one HTML file with everything in it, for the archive and for other people."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from importlib.metadata import version
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.arrays import Array
from ambid.estimation.estimate import Estimate
from ambid.physics.bearing_numbers import BEARING_NUMBERS
from ambid.physics.linear_model import model
from ambid.report.drawing import save
from ambid.report.estimate_text import (
    curve_rows,
    delay_lines,
    names_words,
    output_rows,
    seconds_of,
    validation_rows,
)
from ambid.report.figures import BearingEvidence, Evidence, figures
from ambid.report.text import WORDS, other_warnings, parameter_rows

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_CAPTIONS = {
    "signals": (
        "Measured and predicted",
        "Each sample predicted from all samples before it. Shaded: the stretch shown on the right.",
    ),
    "residuals": (
        "Innovations",
        "Measured minus predicted. The residuals of a correct model are white: about 1 % outside the bounds, no "
        "pattern.",
    ),
    "bode": (
        "Frequency response of the identified plant",
        "Computed from the physical parameters up to half the sampling rate, with the 95 % band that follows from "
        "their covariance.",
    ),
    "poles": (
        "Poles",
        "Poles of the identified plant in open loop, with the 95 % regions that follow from the covariance.",
    ),
    "curves": (
        "Curves",
        "From one co-energy, so that force and back-EMF agree, with the bands that follow from the covariance. "
        "Dotted outside the recorded range: there the law extrapolates, which the band does not cover.",
    ),
    "map": (
        "Range of the records",
        "Each point is a sample. For one magnet, the line shows where its force equals the weight; a rotor at rest "
        "lies on it.",
    ),
    "records": (
        "Records",
        "Each sample predicted from all samples before it; errors relative to the standard deviation expected by "
        "the predictor. The errors of a correct model are white: about 1 % outside the bounds, no pattern.",
    ),
}
_LIBRARIES = ("ambid", "numpy", "scipy", "numba")


def report_html(evidence: Evidence | BearingEvidence, *, made: str = "") -> str:
    """Return the report of an estimate as HTML with its figures inside; `made` is its date, left out where empty."""
    from jinja2 import Environment, StrictUndefined

    source = files("ambid").joinpath("data", "report.html.j2").read_text(encoding="utf-8")
    template = Environment(autoescape=True, undefined=StrictUndefined).from_string(source)
    return template.render(**_content(evidence, made))


def _content(evidence: Evidence | BearingEvidence, made: str) -> dict[str, Any]:
    e = evidence.estimate
    meaning = {spec.name: spec.meaning for spec in (*model(e.model).parameters, *BEARING_NUMBERS)}
    about = _about_record(e) if isinstance(e, Estimate) else _about_records(e)
    judged = e.validation
    validation = None if judged is None else {"fits": validation_rows(judged), "checks": judged["checks"]}
    provenance = [*about.pop("origin"), ("rig", str(e.rig.get("name") or "–"))]
    provenance += [("operating point", ", ".join(f"{role} {x:.6g}" for role, x in e.operating_point.items()) + " (SI)")]
    provenance += [("computing time", f"{sum(e.timing_s.values()):.3g} s")] if e.timing_s else []
    provenance += [("made", made)] if made else []
    provenance += [("versions", ", ".join(f"{name} {version(name)}" for name in _LIBRARIES))]
    return {
        **about,
        "conclusion": WORDS[e.verdict.word],
        "reasons": e.verdict.reasons,
        "warnings": other_warnings(e.checks, e.warnings),
        "parameters": parameter_rows(e.parameters, e.verdict),
        "meaning": meaning,
        "method": e.covariance_method,
        "correlation_names": list(e.covariance_names),
        "correlations": list(zip(e.covariance_names, correlations(e.covariance), strict=True)),
        "delays": delay_lines(e),
        "fits": output_rows(e),
        "checks": e.checks,
        "validation": validation,
        "figures": _embedded(figures(evidence)),
        "provenance": provenance,
        "rig": str(e.rig.get("text") or ""),
    }


def _about_record(e: Estimate) -> dict[str, Any]:
    """Title, subtitle and origin of an estimate from one record."""
    record = e.record
    samples, rate = int(str(record["samples"])), float(str(record["rate_hz"]))
    return {
        "title": f"{record.get('file') or 'record'}: physical parameters",
        "subtitle": f"{e.rig.get('name') or 'no rig'} – model {e.model}, {samples} samples at {rate:g} Hz"
        f" ({samples / rate:.4g} s), search {e.status}",
        "curves": [],
        "history": _steps(record),
        "origin": [
            ("record", str(record.get("file") or "–")),
            ("SHA-256 of the record", str(record.get("sha256") or "–")),
        ],
    }


def _about_records(e: Any) -> dict[str, Any]:
    """Title, subtitle, curves and origin of a nonlinear bearing."""
    named = list(zip(e.noise, e.records, strict=True))
    return {
        "title": f"{names_words(list(e.noise))}: nonlinear bearing",
        "subtitle": f"{e.rig.get('name') or 'no rig'} – {e.law}, {seconds_of(e):.4g} s in all, search {e.status}",
        "curves": curve_rows(e),
        "history": [f"{name}: {step}" for name, record in named for step in _steps(record)],
        "origin": [(name, f"SHA-256 {record.get('sha256') or '–'}") for name, record in named],
    }


def _steps(record: Mapping[str, object]) -> list[str]:
    history = record.get("history")
    return [str(step) for step in history] if isinstance(history, (list, tuple)) else []


def correlations(covariance: Array) -> list[list[str]]:
    """Write a covariance (n, n) as correlations."""
    sd = np.sqrt(np.diag(covariance))
    return [[f"{x:.3f}" for x in row] for row in covariance / np.outer(sd, sd)]


def _embedded(drawn: Mapping[str, Figure]) -> list[dict[str, str]]:
    found = []
    for name, figure in drawn.items():
        title, caption = _CAPTIONS[name]
        buffer = io.BytesIO()
        save(figure, buffer, kind="png")
        found.append({"title": title, "caption": caption, "png": base64.b64encode(buffer.getvalue()).decode()})
    return found
