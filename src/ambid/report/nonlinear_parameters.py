"""The numbers of a nonlinear model for the terminal: terms with ratios, named parameters, a schedule, or sizes."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ambid.nonlinear.fit import NonlinearFit
from ambid.report.numbers import quantity
from ambid.report.text import columns

_SHOWN = 20  # rows that a terminal shows; the file has all
_WEIGHT = re.compile(r"\bunit \d|\bhidden\b|: bias\b")  # of a network: says nothing by itself
_SOURCES = {
    "information": "the information matrix",
    "laplace": "Laplace's approximation",
    "sandwich": "the sandwich formula, for coloured errors",
    "bootstrap": "bootstrap",
}


def parameter_table(fit: NonlinearFit) -> list[str]:
    """Write what a user wants of a model's numbers, and where their standard deviations come from.

    Returns terms with their error reduction ratios; the poles of a model with a schedule along it; parameters with
    names, if they are no more than twenty; of a network how many numbers it has. Empty for a failed fit.
    """
    if fit.model is None:
        return []
    if isinstance(fit.details.get("terms"), Mapping):
        rows = term_lines(fit)
    elif isinstance(fit.details.get("schedule"), Mapping):
        rows = schedule_lines(fit)
    else:
        rows = named_lines(fit)
    return [*rows, *_count(fit, shown=bool(rows))]


def is_weight(name: str) -> bool:
    """Return whether a parameter is a weight of a network's unit, which says nothing by itself."""
    return _WEIGHT.search(name) is not None


def _count(fit: NonlinearFit, *, shown: bool) -> list[str]:
    assert fit.model is not None
    known = "no standard deviations"
    if fit.sd is not None:
        known = f"standard deviations from {_SOURCES.get(fit.covariance_from, fit.covariance_from)}"
    elif "uncertainty" in fit.settings:
        known += " (--settings uncertainty=... asks for them)"
    size = fit.model.theta.size
    said = [f"{size} parameters, {fit.n_estimated} estimated, {known}{'' if shown else '; --json has them all'}"]
    effective = fit.details.get("effective_parameters")
    if isinstance(effective, (int, float)) and math.isfinite(effective) and round(effective, 1) < fit.n_estimated:
        said.append(f"as many as {effective:.3g} parameters would be without the prior")
    return said


def term_lines(fit: NonlinearFit) -> list[str]:
    """Write the first terms with coefficient, standard deviation and error reduction ratio.

    `fit`: with ``terms`` in its details. Returns a header and a line for each term, in the order of choice; ratios in
    percent of the output's energy, where there are any. Weights of a network beside them are counted.
    """
    assert fit.model is not None
    several, terms = len(fit.outputs) > 1, fit.details["terms"]
    assert isinstance(terms, Mapping)
    ratio = {
        (f"y{o + 1}: " if several else "") + str(t["term"]): t.get("err")
        for o, output in enumerate(fit.outputs)
        for t in terms[output]
    }
    named = [k for k, name in enumerate(fit.model.names) if not is_weight(name)]
    weights, rest = fit.model.theta.size - len(named), max(len(named) - _SHOWN, 0)
    rows: list[tuple[str, ...]] = [("term", _column(fit)), *(_row(fit, k) for k in named[:_SHOWN])]
    if any(isinstance(x, (int, float)) for x in ratio.values()):
        shares = ["ERR", *(_percent(ratio.get(fit.model.names[k])) for k in named[:_SHOWN])]
        rows = [(*r, x) for r, x in zip(rows, shares, strict=True)]
    more = [f"… and {rest} more; --json has them all"] if rest else []
    beside = [f"beside them a network of {weights} weights; --json has them"] if weights else []
    return [*columns(rows, right=(2,)), *more, *beside]


def named_lines(fit: NonlinearFit) -> list[str]:
    """Write parameters that have a meaning of their own.

    `fit`: with a model. Returns a header and a line each; empty for a network with weights, and for more than twenty.
    """
    assert fit.model is not None
    sd = fit.sd
    estimated = [k for k in range(fit.model.theta.size) if sd is None or sd[k] > 0]
    if len(estimated) > _SHOWN or any(is_weight(x) for x in fit.model.names):
        return []
    return columns([("parameter", _column(fit)), *(_row(fit, k) for k in estimated)])


def schedule_lines(fit: NonlinearFit) -> list[str]:
    """Write what a model with a schedule is where the schedule stands still: at its ends and in the middle.

    `fit`: with ``schedule`` and ``frozen`` in its details. Returns what the schedule is, then a header and a line for
    each place: poles in rad/s, gains at 0 Hz in SI, ± standard deviations.
    """
    schedule, table = fit.details["schedule"], fit.details.get("frozen")
    assert isinstance(schedule, Mapping)
    low, high, unit = float(schedule["low"]), float(schedule["high"]), str(schedule["unit"])
    signal = str(schedule["signal"])
    what = "the output, low-passed" if signal == "level" else signal
    slow = f" ({float(schedule['time_constant_s']):.3g} s)" if schedule.get("time_constant_s") else ""
    said = [f"schedule: {what}{slow}, {low:.4g} to {high:.4g} {unit} in training"]
    if not isinstance(table, Sequence) or not table:
        return said
    places = [table[0], table[len(table) // 2], table[-1]]
    gains = list(places[0].get("dc_gain", {}))
    head = (f"at [{unit}]", "poles [rad/s]", *(f"gain from {x} at 0 Hz" for x in gains))
    rows = [(f"{x['p']:.4g}", _poles(x["poles_rad_s"]), *(_pair(x["dc_gain"][g]) for g in gains)) for x in places]
    return [*said, *columns([head, *rows])]


def _poles(found: Sequence[Sequence[Any]]) -> str:
    """Real poles one by one, pairs once."""
    out = []
    for pole in found:
        real, imaginary, *sd = (math.nan if v is None else float(v) for v in pole)
        if imaginary < 0:
            continue
        text = _pair([real, sd[0] if sd else None])
        out.append(text if imaginary == 0 else f"{text} ± j {_pair([imaginary, sd[1] if len(sd) > 1 else None])}")
    return ", ".join(out)


def _pair(found: Sequence[Any]) -> str:
    value = float(found[0])
    sd = math.nan if len(found) < 2 or found[1] is None else float(found[1])
    return coefficient_text(value, sd if math.isfinite(sd) and sd > 0 else None) if math.isfinite(value) else "none"


def _row(fit: NonlinearFit, k: int) -> tuple[str, str]:
    assert fit.model is not None
    sd = None if fit.sd is None else float(fit.sd[k])
    return fit.model.names[k], coefficient_text(float(fit.model.theta[k]), sd)


def _column(fit: NonlinearFit) -> str:
    return "coefficient" if fit.sd is None else "coefficient ± sd"


def _percent(err: object) -> str:
    """In percent; small ratios, which fast sampling makes of all but the last output, in a power of ten."""
    if not isinstance(err, (int, float)):
        return ""
    return f"{100 * err:.3f} %" if err >= 1e-4 or err == 0 else f"{100 * err:.1e} %"


def coefficient_text(value: float, sd: float | None) -> str:
    """Write value ± sd; in a power of ten where decimals would be too many to read.

    `sd`: standard deviation, or another spread.
    """
    largest = max(abs(value), sd or 0.0)
    exponent = int(np.floor(np.log10(largest))) if largest else 0
    if sd is None:
        return f"{value:.5g}"
    if -4 <= exponent < 7:
        return quantity(value, sd, "1").text.removesuffix(" 1")
    scale = 10.0**exponent
    return f"({quantity(value / scale, sd / scale, '1').text.removesuffix(' 1')})e{exponent}"
