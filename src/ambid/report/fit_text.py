"""Black-box fits, nonlinear fits and measured frequency responses as tables for the terminal."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.fit import BlackBoxFit, any_structure
from ambid.blackbox.model import TransferModel, pole_covariance
from ambid.nonlinear.fit import nonlinear_structure
from ambid.report.estimate_text import names_words, physics_text, second_lines
from ambid.report.modes_text import modal_body
from ambid.report.numbers import prefixed, quantity, response_unit, sized
from ambid.report.tables import sensitivity_text
from ambid.report.text import (
    WIDTH,
    Paint,
    check_lines,
    coefficient_text,
    columns,
    criteria_lines,
    ending,
    fit_rows,
    joined,
    plain,
    pole_table,
    status_words,
    timing_lines,
    title_line,
    warning_lines,
    wrapped,
)
from ambid.settings.caller import setting
from ambid.units import UNKNOWN
from ambid.validation.sensitivity import SensitivityAnalysis

if TYPE_CHECKING:
    from ambid.bearing.measured import Measured
    from ambid.nonlinear.fit import LearningCurve, NonlinearFit

_COEFFICIENTS = 24  # that a terminal shows; the file has all
_NAMED = ("coefficients", "parameters")  # of a structure whose coefficients are those of a physical form
_TERMS = 20  # rows of terms and named parameters
_TRAININGS = 6  # learning curves
_SINGULAR_VALUES = 8
_WEIGHT = re.compile(r"\bunit \d|\bhidden\b|: bias\b")  # of a network: says nothing by itself
_SOURCES = {
    "information": "the information matrix",
    "laplace": "Laplace's approximation",
    "sandwich": "the sandwich formula, for coloured errors",
    "bootstrap": "bootstrap",
}


def fit_text(fit: BlackBoxFit | NonlinearFit, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write a fit below its verdict; colour does not change the layout. Of a failed fit the settings and the reason."""
    trainings: list[str] = []
    if isinstance(fit, BlackBoxFit):
        own = [coefficient_lines(fit), pole_lines(fit, paint=paint)]
        none = "none (unstable, or no input)"
    else:
        own = [textwrap.wrap(f"no model: {fit.reason}", width) if fit.reason else [], _number_lines(fit, width)]
        none = "none (diverges, or no input)"
        trainings = wrapped(curve_lines(fit.curves), width, "  ")
    second = [] if fit.validation is None else [paint("on the second record", "strong"), *second_lines(fit.validation)]
    return joined(
        [
            _header(fit, width, paint),
            *own,
            columns(fit_rows(fit.fit, fit.units, none)) if fit.fit else [],
            second,
            criteria_lines(fit.criteria, fit.n_estimated, width),
            trainings,
            *ending(fit, width=width, paint=paint),
            *([derived_text(x, width=width, paint=paint)] for x in getattr(fit, "derived", {}).values()),
        ]
    )


def derived_text(found: Any, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write what was derived from a fit: the sensitivity of its coefficients, or physical parameters."""
    if isinstance(found, SensitivityAnalysis):
        return sensitivity_text(found, width=width, paint=paint)
    return physics_text(found, width=width, paint=paint)


def _header(fit: BlackBoxFit | NonlinearFit, width: int, paint: Paint) -> list[str]:
    """Say what was fitted to which records, with which settings."""
    signals = (f"from {', '.join(fit.inputs)} to " if fit.inputs else "of ") + ", ".join(fit.outputs)
    if isinstance(fit, BlackBoxFit):
        records: Sequence[Mapping[str, object]] = [fit.record]
        about = [f"{any_structure(fit.structure).summary}; {settings_text(fit.orders)}; {signals}"]
    else:
        records = fit.records
        about = [f"{nonlinear_structure(fit.structure).summary}; {signals}"]
        about += [f"settings: {settings_text(fit.settings)}; seed {fit.seed}"]
    names = [str(x.get("file") or "record") for x in records]
    total = sum(int(str(x["samples"])) for x in records)
    first = title_line(names_words(names), fit.structure, total, 1 / fit.dt, fit.status, paint)
    return [first, *wrapped([", ".join(names)] if len(names) > 1 else [], width), *wrapped(about, width)]


def settings_text(settings: Mapping[str, object]) -> str:
    """Write orders or settings with their names."""
    return ", ".join(f"{k} = {setting_text(v)}" for k, v in settings.items())


def setting_text(value: object) -> str:
    """Write an order or a setting as the command line takes it, several numbers with a slash between."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "/".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


# --- coefficients and poles of a linear model -----------------------------------------------------------------------


def coefficient_lines(fit: BlackBoxFit, *, without: Sequence[int] = ()) -> list[str]:
    """Write the coefficients that are not fixed by the structure, each with its standard deviation, `without` some."""
    theta, sd = fit.model.theta, fit.sd
    free = np.setdiff1d(np.nonzero(theta != np.round(theta) if sd is None else sd > 0)[0], without)
    named: Mapping[str, Any] = {k: x for part in _NAMED for k, x in fit.details.get(part, {}).items()}  # type: ignore[attr-defined]
    rows = [
        (fit.model.names[k], coefficient_text(float(theta[k]), 0.0 if sd is None else float(sd[k])))
        for k in free[: 0 if named else _COEFFICIENTS]
    ]
    rows += [(f"{k} [{x['unit']}]", coefficient_text(x["value"], x["sd"])) for k, x in named.items()]
    if not rows:
        return []
    head = ("", "value" if sd is None else "value ± sd")
    table: list[tuple[str, ...]] = [head, *rows]
    if len(rows) > 8:
        half = -(-len(rows) // 2)
        right = [*rows[half:], ("", "")][:half]
        table = [(*a, *b) for a, b in zip([head, *rows[:half]], [head, *right], strict=True)]
    rest = 0 if named else free.size - len(rows)
    return [*columns(table), *([f"… and {rest} more; {setting('json')} has them all"] if rest else [])]


def pole_lines(fit: BlackBoxFit, *, paint: Paint = plain) -> list[str]:
    """Write the first poles of a fit."""
    poles = fit.model.poles()
    spread = None if fit.covariance is None else pole_covariance(fit.model, fit.covariance)
    known = [None] * poles.size if spread is None else list(spread)
    shown = [k for k in range(poles.size) if poles[k].imag >= 0][: _COEFFICIENTS // 2]
    dt = None if fit.model.dt is None else fit.dt
    return pole_table([(complex(poles[k]), known[k]) for k in shown], dt, paint=paint)


# --- numbers of a nonlinear model -----------------------------------------------------------------------------------


def _number_lines(fit: NonlinearFit, width: int) -> list[str]:
    """Write terms with ratios, named parameters or a schedule, and where their standard deviations come from."""
    if fit.model is None:
        return []
    if isinstance(fit.details.get("terms"), Mapping):
        rows = term_lines(fit)
    elif isinstance(fit.details.get("schedule"), Mapping):
        rows = schedule_lines(fit)
    else:
        rows = named_lines(fit)
    lines = [*rows, *_count(fit, shown=bool(rows))]
    return [x for line in lines for x in (textwrap.wrap(line, width) if len(line) > width else [line])]


def is_weight(name: str) -> bool:
    """Return whether a parameter is a weight of a network's unit, which says nothing by itself."""
    return _WEIGHT.search(name) is not None


def _count(fit: NonlinearFit, *, shown: bool) -> list[str]:
    assert fit.model is not None
    known = "no standard deviations"
    if fit.sd is not None:
        known = f"standard deviations from {_SOURCES.get(fit.covariance_from, fit.covariance_from)}"
    elif "uncertainty" in fit.settings:
        known += f" ({setting('orders', 'uncertainty=...')} gives them)"
    size, rest = fit.model.theta.size, "" if shown else f"; {setting('json')} has them all"
    lines = [f"{size} parameters, {fit.n_estimated} estimated, {known}{rest}"]
    effective = fit.details.get("effective_parameters")
    if isinstance(effective, (int, float)) and math.isfinite(effective) and round(effective, 1) < fit.n_estimated:
        lines.append(f"regularised to {effective:.3g} effective parameters")
    return lines


def term_ratios(fit: NonlinearFit) -> dict[str, object]:
    """Return the error reduction ratio of each chosen term by the name of its parameter, None where it has none."""
    terms, several = fit.details.get("terms"), len(fit.outputs) > 1
    if not isinstance(terms, Mapping):
        return {}
    return {
        (f"y{o + 1}: " if several else "") + str(t["term"]): t.get("err")
        for o, output in enumerate(fit.outputs)
        for t in terms.get(output, ())
    }


def term_lines(fit: NonlinearFit) -> list[str]:
    """Write the first terms in the order of choice, with error reduction ratios in percent where there are any.

    `fit` has ``terms`` in its details. Weights of a network beside them are counted.
    """
    assert fit.model is not None
    ratio = term_ratios(fit)
    named = [k for k, name in enumerate(fit.model.names) if not is_weight(name)]
    weights, rest = fit.model.theta.size - len(named), max(len(named) - _TERMS, 0)
    rows: list[tuple[str, ...]] = [("term", _column(fit)), *(_row(fit, k) for k in named[:_TERMS])]
    if any(isinstance(x, (int, float)) for x in ratio.values()):
        shares = ["ERR", *(_percent(ratio.get(fit.model.names[k])) for k in named[:_TERMS])]
        rows = [(*r, x) for r, x in zip(rows, shares, strict=True)]
    more = [f"… and {rest} more; {setting('json')} has them all"] if rest else []
    beside = [f"and a network of {weights} weights; {setting('json')} has them"] if weights else []
    return [*columns(rows, right=(2,)), *more, *beside]


def named_lines(fit: NonlinearFit) -> list[str]:
    """Write parameters that have a meaning of their own; none for a network, or for more than twenty."""
    assert fit.model is not None
    sd = fit.sd
    estimated = [k for k in range(fit.model.theta.size) if sd is None or sd[k] > 0]
    if len(estimated) > _TERMS or any(map(is_weight, fit.model.names)):
        return []
    return columns([("parameter", _column(fit)), *(_row(fit, k) for k in estimated)])


def schedule_lines(fit: NonlinearFit) -> list[str]:
    """Write what a model with a schedule is where the schedule stands still: at its ends and in the middle.

    `fit` has ``schedule`` and ``frozen`` in its details; poles in rad/s, gains at 0 Hz in SI, ± standard deviations.
    """
    schedule, table = fit.details["schedule"], fit.details.get("frozen")
    assert isinstance(schedule, Mapping)
    low, high, unit = float(schedule["low"]), float(schedule["high"]), str(schedule["unit"])
    signal = str(schedule["signal"])
    what = "the output, low-passed" if signal == "level" else signal
    slow = f" ({float(schedule['time_constant_s']):.3g} s)" if schedule.get("time_constant_s") else ""
    head = [f"schedule: {what}{slow}, {low:.4g} to {high:.4g} {unit} in training"]
    if not isinstance(table, Sequence) or not table:
        return head
    places = [table[0], table[len(table) // 2], table[-1]]
    gains = list(places[0].get("dc_gain", {}))
    names = (f"at [{unit}]", "poles [rad/s]", *(f"gain from {x} at 0 Hz" for x in gains))
    rows = [(f"{x['p']:.4g}", _poles(x["poles_rad_s"]), *(_number(x["dc_gain"][g]) for g in gains)) for x in places]
    return [*head, *columns([names, *rows])]


def _poles(found: Sequence[Sequence[Any]]) -> str:
    """Real poles one by one, pairs once."""
    out = []
    for pole in found:
        real, imaginary, *sd = (math.nan if v is None else float(v) for v in pole)
        if imaginary < 0:
            continue
        text = _number([real, sd[0] if sd else None])
        out.append(text if imaginary == 0 else f"{text} ± j {_number([imaginary, sd[1] if len(sd) > 1 else None])}")
    return ", ".join(out)


def _number(found: Sequence[Any]) -> str:
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


def curve_lines(curves: Sequence[LearningCurve]) -> list[str]:
    """Say in a line each how the trainings went; of many the first and the last ones."""
    lines = [curve_line(c) for c in curves]
    between, half = len(lines) - _TRAININGS, _TRAININGS // 2
    if between <= 0:
        return lines
    return [*lines[:half], f"… {between} more trainings; {setting('json')} has them", *lines[-half:]]


def curve_line(curve: LearningCurve) -> str:
    """Say in one line how a training went: steps, time, errors in multiples of the outputs' standard deviations."""
    n = curve.training.size
    if not n:
        return f"{curve.method}: no iterations"
    text = (
        f"{curve.method}: {n} step{'' if n == 1 else 's'}, {sized(float(curve.seconds[-1]), 's')}, error"
        f" {curve.training[0]:.3g} -> {curve.training[-1]:.3g} of the output"
    )
    held = curve.held_out[np.isfinite(curve.held_out)]
    return text + (f", held out {held[0]:.3g} -> {np.min(held):.3g}" if held.size else "")


# --- frequency responses --------------------------------------------------------------------------------------------


def frf_text(measured: Measured, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write a measured response, and what was fitted to it, for people; colour does not change the layout."""
    fit, estimate = measured.fit, measured.estimate
    return joined(
        [
            _response_header(measured, width, paint),
            pair_lines(measured, width=width),
            _distortion_lines(measured, width),
            [] if fit is None else _response_fit_lines(fit, width, paint),
            [] if estimate is None else [physics_text(estimate, width=width, paint=paint)],
            [] if measured.modal is None else [modal_body(measured.modal, width=width, paint=paint)],
            warning_lines(warnings_of(measured), width=width, paint=paint),
            timing_lines(measured.timing_s, paint=paint),
        ]
    )


def _response_header(measured: Measured, width: int, paint: Paint) -> list[str]:
    frf, record = measured.response, measured.record
    name, samples = str(record.get("file") or "record"), int(str(record.get("samples", 0)))
    first = f"{paint(name, 'strong')}: frequency response"
    if samples:
        first = title_line(name, "frequency response", samples, frf.rate_hz, "converged", paint)
    reference = f", reference {', '.join(measured.references)}" if measured.references else ""
    loop = ", declared open loop" if measured.open_loop else ""
    signals = f"from {', '.join(frf.inputs)} to {', '.join(frf.outputs)}{reference}{loop}"
    f = frf.frequency_hz
    method = f"{frf.method}{_periods(frf.details)}; {f.size} lines, {sized(f[0], 'Hz')} to {sized(f[-1], 'Hz')}"
    return [first, *textwrap.wrap(signals, width), *textwrap.wrap(method, width)]


def _periods(details: Any) -> str:
    if "period" not in details:
        return ""
    counts = "+".join(str(n) for n in details["periods"])
    dropped = sum(details.get("dropped_periods", ()))
    return f", {counts} periods of {details['period']} samples" + (f" ({dropped} more left out)" if dropped else "")


def pair_lines(measured: Measured, *, width: int = WIDTH) -> list[str]:
    """Write size and quality of the response of every pair: medians over the lines, in percent of the magnitude."""
    frf, noise, distortion = measured.response, measured.response.noise_sd, measured.distortion_sd
    size = frf.magnitude
    rows: list[tuple[str, ...]] = [("", "|G|", "sd", "noise", "distortion", "coherence")]
    for j, o in enumerate(frf.outputs):
        for k, i in enumerate(frf.inputs):
            g = size[:, j, k]
            shares = [_share(sd, g, j, k) for sd in (frf.sd, noise, distortion)]
            coherence = "–" if frf.coherence is None else f"{float(np.median(frf.coherence[:, j])):.4f}"
            rows.append((f"{i} → {o}", _range(g, response_unit(frf.units, o, i)), *shares, coherence))
    lines = columns(rows, right=(2, 3, 4, 5))
    if max(map(len, lines)) > width:
        lines = columns([(row[0], *row[2:]) for row in rows], right=(1, 2, 3, 4))
    if max(map(len, lines)) > width:  # names too long to stand beside anything: each on a line of its own
        head, *values = columns([("  ", *row[2:]) for row in rows], right=(1, 2, 3, 4))
        named = [[*textwrap.wrap(row[0], width), line] for row, line in zip(rows[1:], values, strict=True)]
        lines = [head, *(line for pair in named for line in pair)]
    about = "medians over the lines, of |G|"
    about += "; noise and distortion were not separated" if distortion is None else ""
    return [*lines, *textwrap.wrap(f"({about})", width)]


def _range(g: Array, unit: str) -> str:
    low, high = float(np.min(g)), float(np.max(g))
    scale, shown = (1.0, unit) if unit.startswith((UNKNOWN, "1/")) else prefixed(high, unit)
    return f"{low / scale:.3g} … {high / scale:.3g} {shown}".removesuffix(" 1")


def _share(sd: Array | None, g: Array, j: int, k: int) -> str:
    if sd is None:
        return "–"
    with np.errstate(divide="ignore"):
        return f"{100 * float(np.median(sd[:, j, k] / g)):.2g} %"


def _distortion_lines(measured: Measured, width: int) -> list[str]:
    """Levels at the lines that the excitation left out, beside the signal."""
    found: Any = measured.response.details.get("distortions")
    if found is None:
        return []
    rows: list[tuple[str, ...]] = [("at lines without excitation", "even", "its noise", "odd", "its noise")]
    for k, output in enumerate(measured.response.outputs):
        signal = _rms(found.signal, k)
        cells = [found.even, found.even_noise, found.odd, found.odd_noise]
        rows.append((output, *("–" if x is None or not x.size else _decibel(_rms(x, k), signal) for x in cells)))
    return [
        *columns(rows, right=(1, 2, 3, 4)),
        *textwrap.wrap("(rms of a line relative to that of an excited one)", width),
    ]


def _rms(levels: Array, k: int) -> float:
    return float(np.sqrt(np.mean(levels[:, k] ** 2)))


def _decibel(x: float, beside: float) -> str:
    return f"{20 * np.log10(x / beside):.1f} dB" if x > 0 and beside > 0 else "none"


def _response_fit_lines(fit: BlackBoxFit, width: int, paint: Paint) -> list[str]:
    summary = any_structure(fit.structure).summary
    about = f"{fit.structure}: {summary}; {settings_text(fit.orders)}{status_words(fit.status)}"
    lines = textwrap.wrap(about, width)
    lines[0] = lines[0].replace(fit.structure, paint(fit.structure, "strong"), 1)
    first, repeated = _first_entry(fit)
    if fit.structure == "frf-ml":  # states are in coordinates of the method's own: their numbers say nothing
        lines += coefficient_lines(fit, without=repeated)
    lines += [*pole_lines(first, paint=paint), *_late_lines(fit), *_laguerre_lines(fit, width)]
    return [*lines, *check_lines(fit.checks, width=width, paint=paint)]


def _first_entry(fit: BlackBoxFit) -> tuple[BlackBoxFit, list[int]]:
    """The fit of the first entry where all share a denominator, which has all the poles, and places of its copies."""
    model = fit.model
    dens = [d for row in model.den for d in row] if isinstance(model, TransferModel) else []
    if not isinstance(model, TransferModel) or len(dens) < 2 or not all(np.array_equal(d, dens[0]) for d in dens):
        return fit, []
    places = [(o or i, which, range(p.start, p.stop)) for o, which, i, p in model.blocks()]
    own = [k for other, _, place in places if not other for k in place]
    copies = [k for other, which, place in places if other and which == "den" for k in place]
    first = TransferModel(num=((model.num[0][0],),), den=((model.den[0][0],),), dt=model.dt, delay=model.delay[:1])
    covariance = None if fit.covariance is None else fit.covariance[np.ix_(own, own)]
    return replace(fit, model=first, covariance=covariance), copies


def _late_lines(fit: BlackBoxFit) -> list[str]:
    delay, sd = (fit.details.get(k) for k in ("delay_s", "delay_sd_s"))
    if not delay and sd is None:
        return []
    value = float(str(delay))
    text = quantity(value, 0.0 if sd is None else float(str(sd)), "s").text
    return [f"delay {text} ({value / fit.dt:.4g} samples)"]


def _laguerre_lines(fit: BlackBoxFit, width: int) -> list[str]:
    d: Any = fit.details
    if "condition_without" not in d:
        return []
    values = " ".join(f"{s:.3g}" for s in d["singular_values"][:_SINGULAR_VALUES])
    more = " …" if len(d["singular_values"]) > _SINGULAR_VALUES else ""
    text = (
        f"Laguerre operator p = {d['p']:.4g} rad/s: condition {d['condition']:.3g} of {d['block_rows']} block rows, "
        f"{d['condition_without']:.3g} without it; singular values {values}{more} (noise alone: about 1)"
    )
    return textwrap.wrap(text, width)


def warnings_of(measured: Measured) -> list[str]:
    """Return all warnings, each once, without what only repeats a failed check; those of the response first."""
    found = [*measured.response.warnings]
    for x in (measured.fit, measured.estimate):
        if x is None:
            continue
        said = [c.detail for c in x.checks.values() if not c.passed]
        for whole in x.warnings:
            warning = whole
            for detail in said:  # it stands with the checks
                warning = warning.replace(f"{detail}; ", "")
            if not warning.endswith(tuple(said)):
                found.append(warning)
    return list(dict.fromkeys(found))
