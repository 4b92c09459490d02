"""A nonlinear fit as a table for the terminal: 80 columns, readable without colour."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ambid.nonlinear.fit import LearningCurve, NonlinearFit
from ambid.nonlinear.structures import nonlinear_structure
from ambid.report.fit_text import validation_lines
from ambid.report.nonlinear_parameters import parameter_table
from ambid.report.numbers import sized
from ambid.report.text import WIDTH, Paint, check_lines, columns, plain, timing_line, warning_lines

_CURVES = 6  # learning curves that a terminal shows


def nonlinear_text(fit: NonlinearFit, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write a nonlinear fit for people.

    `width`: columns of the terminal; `paint`: adds colour; the layout does not depend on it. Returns header, settings,
    terms or sizes, fit, validation, criteria, learning curves, checks, warnings and timing, without a final line feed.
    Of a failed fit: header, settings, reason.
    """
    blocks = [
        _header(fit, width, paint),
        textwrap.wrap(f"no model: {fit.reason}", width) if fit.reason else [],
        [x for line in parameter_table(fit) for x in (textwrap.wrap(line, width) if len(line) > width else [line])],
        columns(_fit_rows(fit)) if fit.fit else [],
        [] if fit.validation is None else _validation(fit.validation, paint),
        _criteria_lines(fit, width),
        [x for line in curve_lines(fit.curves) for x in textwrap.wrap(line, width, subsequent_indent="  ")],
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

    `value`: a number, a word or several numbers. Returns several with a slash between.
    """
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "/".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


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

    `found`: as `ambid.validate.nonlinear.validation` gives it. Returns a header, a line for each output, and which part
    is extrapolated; errors in SI.
    """
    share = float(next(iter(found.values()))["extrapolated"])
    return [*validation_lines(found), f"outside the training data: {100 * share:.2g} % of it"]


def _criteria_lines(fit: NonlinearFit, width: int) -> list[str]:
    if not fit.criteria:
        return []
    text = ", ".join(f"{name} {value:.6g}" for name, value in fit.criteria.items())
    return textwrap.wrap(f"criteria: {text}; {fit.n_estimated} numbers estimated", width)


def curve_lines(curves: Sequence[LearningCurve]) -> list[str]:
    """Say in a line each how the trainings went.

    Returns of many the first and the last ones, and how many stand between.
    """
    said = [curve_line(c) for c in curves]
    between = len(said) - _CURVES
    if between <= 0:
        return said
    return [*said[: _CURVES // 2], f"… {between} more trainings; --json has them", *said[-(_CURVES // 2) :]]


def curve_line(curve: LearningCurve) -> str:
    """Say in one line how a training went.

    Returns method, iterations, time, errors at begin and end in multiples of the outputs' standard deviations.
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
