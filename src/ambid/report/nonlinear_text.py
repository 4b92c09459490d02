"""A nonlinear fit as a table for the terminal: 80 columns, readable without colour."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ambid.identify.nonlinear.fit import LearningCurve, NonlinearFit
from ambid.identify.nonlinear.structures import nonlinear_structure
from ambid.report.fit_text import validation_lines
from ambid.report.numbers import quantity, sized
from ambid.report.text import WIDTH, Paint, check_lines, columns, plain, timing_line, warning_lines

_SHOWN = 20  # terms that a terminal shows; the file has all


def nonlinear_text(fit: NonlinearFit, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write a nonlinear fit for people.

    Parameters
    ----------
    fit : NonlinearFit
    width : int
        Columns of the terminal.
    paint : callable
        Adds colour; the layout does not depend on it.

    Returns
    -------
    str
        Header, settings, terms or sizes, fit, validation, criteria, learning curves, checks, warnings and timing,
        without a final line feed. Of a failed fit: header, settings, reason.
    """
    blocks = [
        _header(fit, width, paint),
        textwrap.wrap(f"no model: {fit.reason}", width) if fit.reason else [],
        [x for line in parameter_table(fit) for x in (textwrap.wrap(line, width) if len(line) > width else [line])],
        columns(_fit_rows(fit)) if fit.fit else [],
        [] if fit.validation is None else _validation(fit.validation, paint),
        _criteria_lines(fit, width),
        [x for c in fit.curves for x in textwrap.wrap(curve_line(c), width, subsequent_indent="  ")],
        check_lines(fit.checks, width=width, paint=paint),
        warning_lines(fit.warnings, width=width, paint=paint),
        [paint(x, "dim") for x in textwrap.wrap(timing_line(fit.timing_s), width)] if fit.timing_s else [],
    ]
    return "\n\n".join("\n".join(block) for block in blocks if block)


def _header(fit: NonlinearFit, width: int, paint: Paint) -> list[str]:
    samples = [int(str(x["samples"])) for x in fit.records]
    names = [str(x.get("file") or "record") for x in fit.records]
    name = names[0] if len(names) == 1 else f"{len(names)} records"
    verdict = "" if fit.status == "converged" else paint(f" – {fit.status}", "bad")
    signals = f"from {', '.join(fit.inputs)} to " if fit.inputs else "of "
    total = sum(samples)
    first = (
        f"{paint(name, 'strong')}: {fit.structure}, {total} samples at {1 / fit.dt:g} Hz ({total * fit.dt:.4g} s)"
        f"{verdict}"
    )
    told = ", ".join(f"{k} = {setting_text(v)}" for k, v in fit.settings.items())
    about = f"{nonlinear_structure(fit.structure).summary}; {signals}{', '.join(fit.outputs)}"
    listed = textwrap.wrap(", ".join(names), width) if len(names) > 1 else []
    return [first, *listed, *textwrap.wrap(about, width), *textwrap.wrap(f"settings: {told}; seed {fit.seed}", width)]


def setting_text(value: object) -> str:
    """Write a setting as the command line takes it.

    Parameters
    ----------
    value : object
        A number, a word or several numbers.

    Returns
    -------
    str
        Several with a slash between.
    """
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "/".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def parameter_table(fit: NonlinearFit) -> list[str]:
    """Write the terms of a polynomial model with their error reduction ratios, or how large a network is.

    Parameters
    ----------
    fit : NonlinearFit

    Returns
    -------
    list of str
        Empty for a failed fit.
    """
    if fit.model is None:
        return []
    if isinstance(fit.details.get("terms"), Mapping):
        return term_lines(fit)
    sd = fit.sd
    known = "no standard deviations" if sd is None else f"standard deviations from {_SOURCES[fit.covariance_from]}"
    said = [f"{fit.model.theta.size} parameters, {fit.n_estimated} estimated, {known}; --json has them all"]
    effective = fit.details.get("effective_parameters")
    if isinstance(effective, (int, float)) and math.isfinite(effective):
        said.append(f"as many as {effective:.3g} parameters would be without the prior")
    return said


_SOURCES = {
    "information": "the information matrix",
    "laplace": "Laplace's approximation",
    "sandwich": "the sandwich formula, for coloured errors",
    "bootstrap": "bootstrap",
}


def term_lines(fit: NonlinearFit) -> list[str]:
    """Write the first terms with coefficient, standard deviation and error reduction ratio.

    Parameters
    ----------
    fit : NonlinearFit
        With ``terms`` in its details.

    Returns
    -------
    list of str
        A header and a line for each term, in the order of choice; ratios in percent of the output's energy.
    """
    assert fit.model is not None
    several, terms = len(fit.outputs) > 1, fit.details["terms"]
    assert isinstance(terms, Mapping)
    ratio = {
        (f"y{o + 1}: " if several else "") + str(t["term"]): t.get("err")
        for o, output in enumerate(fit.outputs)
        for t in terms[output]
    }
    theta, sd = fit.model.theta, fit.sd
    rows = []
    for k, name in enumerate(fit.model.names[:_SHOWN]):
        err = ratio.get(name)
        rows.append((name, coefficient_text(float(theta[k]), None if sd is None else float(sd[k])), _percent(err)))
    rest = theta.size - len(rows)
    more = [f"… and {rest} more; --json has them all"] if rest else []
    head = ("term", "coefficient" if sd is None else "coefficient ± sd", "ERR")
    return [*columns([head, *rows], right=(2,)), *more]


def _percent(err: object) -> str:
    """In percent; small ratios, which fast sampling makes of all but the last output, in a power of ten."""
    if not isinstance(err, (int, float)):
        return ""
    return f"{100 * err:.3f} %" if err >= 1e-4 or err == 0 else f"{100 * err:.1e} %"


def coefficient_text(value: float, sd: float | None) -> str:
    """Write value ± sd; in a power of ten where decimals would be too many to read.

    Parameters
    ----------
    value : float
    sd : float or None
        Standard deviation, or another spread.

    Returns
    -------
    str
    """
    largest = max(abs(value), sd or 0.0)
    exponent = int(np.floor(np.log10(largest))) if largest else 0
    if sd is None:
        return f"{value:.5g}"
    if -4 <= exponent < 7:
        return quantity(value, sd, "1").text.removesuffix(" 1")
    scale = 10.0**exponent
    return f"({quantity(value / scale, sd / scale, '1').text.removesuffix(' 1')})e{exponent}"


def _fit_rows(fit: NonlinearFit) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [("fit", "one step", "simulation", "innovations")]
    for output, f in fit.fit.items():
        free = "none (diverges, or no input)" if f.simulation is None else f"{f.simulation:.4f}"
        rows.append((output, f"{f.one_step:.4f}", free, f"{sized(f.innovation_sd, fit.units[output])} rms"))
    return rows


def _validation(found: Mapping[str, Any], paint: Paint) -> list[str]:
    return [paint("on the second record", "strong"), *second_record_lines(found)]


def second_record_lines(found: Mapping[str, Any]) -> list[str]:
    """Write how a nonlinear fit does on a second record.

    Parameters
    ----------
    found : Mapping[str, object]
        As `ambid.validate.nonlinear.validation` gives it.

    Returns
    -------
    list of str
        A header, a line for each output, and which part is extrapolated; errors in SI.
    """
    share = float(next(iter(found.values()))["extrapolated"])
    return [*validation_lines(found), f"outside the training data: {100 * share:.2g} % of it"]


def _criteria_lines(fit: NonlinearFit, width: int) -> list[str]:
    if not fit.criteria:
        return []
    text = ", ".join(f"{name} {value:.6g}" for name, value in fit.criteria.items())
    return textwrap.wrap(f"criteria: {text}; {fit.n_estimated} numbers estimated", width)


def curve_line(curve: LearningCurve) -> str:
    """Say in one line how a training went.

    Parameters
    ----------
    curve : LearningCurve

    Returns
    -------
    str
        Method, iterations, time, errors at begin and end in multiples of the outputs' standard deviations.
    """
    if not curve.training.size:
        return f"{curve.method}: no iterations"
    n = curve.training.size
    text = (
        f"{curve.method}: {n} step{'' if n == 1 else 's'}, {sized(float(curve.seconds[-1]), 's')}, error"
        f" {curve.training[0]:.3g} -> {curve.training[-1]:.3g} of the output"
    )
    held = curve.held_out[np.isfinite(curve.held_out)]
    return text + (f", held out {held[0]:.3g} -> {np.min(held):.3g}" if held.size else "")
