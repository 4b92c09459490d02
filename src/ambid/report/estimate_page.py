"""The page of physical parameters: of one record, or of a nonlinear bearing from several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.arrays import Array
from ambid.estimation.estimate import Estimate
from ambid.physics.bearing_numbers import BEARING_NUMBERS
from ambid.physics.linear_model import model
from ambid.report.drawing import single
from ambid.report.estimate_text import (
    curve_rows,
    delay_lines,
    names_words,
    output_rows,
    seconds_of,
    sensitivity_lines,
    validation_rows,
)
from ambid.report.figures import BearingEvidence, Evidence
from ambid.report.page import Page, Section, check_table
from ambid.report.signal_panels import Traces
from ambid.report.strips import strips_of
from ambid.report.text import checks_of, other_warnings, parameter_rows

if TYPE_CHECKING:
    from ambid.report.page import Cell, Table

_CAPTIONS = {
    "signals": (
        "Measured and predicted",
        "Each sample predicted from all samples before it. Shaded: the stretch with the largest errors. Long records "
        "are drawn by the extremes of short stretches.",
    ),
    "residuals": (
        "Residuals",
        "What the predictions leave of the measurement. For a right model 5 % of them lie outside the dashed bounds, "
        "and their spectrum is flat.",
    ),
    "whiteness": (
        "Residual tests",
        "Residuals of a right model are correlated neither with their own past nor with past inputs. The verdicts are "
        "those of the checks, which allow for the estimated parameters; the bands do not.",
    ),
    "bode": (
        "Frequency response of the identified plant",
        "From the physical parameters, with the 95 % interval that their covariance gives. Points: measured without a "
        "model, hold and delay of the input taken out.",
    ),
    "poles": ("Poles", "Of the identified plant in open loop, with their 95 % regions."),
    "correlations": (
        "Uncertainty of the parameters",
        "Parameters with a correlation near ±1 are known only together: what the data show is their combination. "
        "A large condition number says the same of more than two.",
    ),
    "force": (
        "Force",
        "Force of the magnet over position and current, and how well it is known. Points: samples of the free rotor.",
    ),
    "curves": (
        "Curves",
        "From one co-energy, so that force and back-EMF agree. Dotted outside the recorded range: there the law "
        "extrapolates, which the interval does not cover.",
    ),
    "map": (
        "Range of the records",
        "Each point is a sample. For one magnet, a rotor at rest lies where the force equals its weight.",
    ),
    "records": (
        "Records",
        "Each sample predicted from all samples before it; residuals over the standard deviation that the predictor "
        "expects of them. For a right model 5 % lie outside the dashed bounds.",
    ),
}
_SIGNS = "Sign convention: force = k_i · current − k_x · position; an attracting magnet has k_x < 0."
_SOURCES = {"information": "information matrix", "robust": "scatter over the record (robust)"}


def estimate_page(evidence: Evidence | BearingEvidence) -> Page:
    """Return the page of an estimate, with its figures."""
    e = evidence.estimate
    sections = [
        _parameters(e),
        Section(
            title="Correlations of the estimated parameters", tables=[correlations(e.covariance_names, e.covariance)],
            folded=True,
        ),
        *([] if isinstance(e, Estimate) else [_curves(e)]),
        Section(title="Delay and fit", paragraphs=_said(e), tables=[output_rows(e)]),
        Section(title="Checks", tables=[check_table(e.checks)]),
        *([] if e.validation is None else [second_section(e.validation)]),
        *(
            Section(
                title=_CAPTIONS[name][0], caption=_CAPTIONS[name][1], figure=partial(single, block),
                signals=[strips_of(t) for t in _traces(evidence)] if name in ("signals", "records") else (),
            )
            for name, block in evidence.drawings().items()
        ),
        Section(title="Rig", text=str(e.rig.get("text") or ""), folded=True),
    ]  # fmt: skip
    about = _about_record(e) if isinstance(e, Estimate) else _about_records(e)
    provenance = [*about.pop("provenance"), ("rig", str(e.rig.get("name") or "–"))]
    provenance += [("operating point", ", ".join(f"{role} {x:.6g}" for role, x in e.operating_point.items()) + " (SI)")]
    provenance += [("computing time", f"{sum(e.timing_s.values()):.3g} s")] if e.timing_s else []
    return Page(
        **about,
        warnings=other_warnings(e.checks, e.warnings),
        sections=[s for s in sections if s.tables or s.text or s.figure],
        provenance=provenance,
    )


def _traces(evidence: Evidence | BearingEvidence) -> Sequence[Traces]:
    return evidence.traces if isinstance(evidence, BearingEvidence) else (evidence.traces,)


def _parameters(e: Any) -> Section:
    meaning = {spec.name: spec.meaning for spec in (*model(e.model).parameters, *BEARING_NUMBERS)}
    rows: list[Sequence[Cell]] = [("", "meaning", "value ± sd", "95 % interval", "in SI", "verdict")]
    for name, *more, words, style in parameter_rows(e.parameters, e.verdict):
        rows.append((name, (meaning[name], ""), *more, (words, style)))
    note = f"{_SIGNS} Standard deviations are from the {_SOURCES[e.covariance_method]}."
    return Section(title="Parameters", tables=[rows], note=note)


def _said(e: Any) -> list[str]:
    return [*delay_lines(e), *sensitivity_lines(getattr(e, "sensitivity", {}))]


def _curves(e: Any) -> Section:
    note = "Value ± standard deviation; * no record came there: the law extrapolates."
    return Section(title="Curves over position and current", tables=curve_rows(e), note=note)


def second_section(validation: Mapping[str, Any]) -> Section:
    """Return how an estimate does on a second record, as a section."""
    tables: list[Table] = [validation_rows(validation), check_table(checks_of(validation))]
    return Section(title="On the second record", tables=tables)


def _about_record(e: Estimate) -> dict[str, Any]:
    """Title, subtitle and origin of an estimate from one record."""
    record = e.record
    samples, rate = int(str(record["samples"])), float(str(record["rate_hz"]))
    return {
        "title": f"{record.get('file') or 'record'}: physical parameters",
        "subtitle": f"{e.rig.get('name') or 'no rig'} – model {e.model}, {samples} samples at {rate:g} Hz"
        f" ({samples / rate:.4g} s), search {e.status}",
        "history": _steps(record),
        "provenance": [
            ("record", str(record.get("file") or "–")),
            ("SHA-256 of the record", str(record.get("sha256") or "–")),
        ],
    }


def _about_records(e: Any) -> dict[str, Any]:
    """Title, subtitle and origin of a nonlinear bearing."""
    named = list(zip(e.noise, e.records, strict=True))
    return {
        "title": f"{names_words(list(e.noise))}: nonlinear bearing",
        "subtitle": f"{e.rig.get('name') or 'no rig'} – {e.law}, {seconds_of(e):.4g} s in all, search {e.status}",
        "history": [f"{name}: {step}" for name, record in named for step in _steps(record)],
        "provenance": [(name, f"SHA-256 {record.get('sha256') or '–'}") for name, record in named],
    }


def _steps(record: Mapping[str, object]) -> list[str]:
    history = record.get("history")
    return [str(step) for step in history] if isinstance(history, (list, tuple)) else []


def correlations(names: tuple[str, ...], covariance: Array) -> list[list[str]]:
    """Write a covariance (n, n) as a table of correlations."""
    sd = np.sqrt(np.diag(covariance))
    rows = covariance / np.outer(sd, sd)
    return [["", *names], *([name, *(f"{x:.3f}" for x in row)] for name, row in zip(names, rows, strict=True))]
