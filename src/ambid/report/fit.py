"""Black-box and nonlinear fits as people see them: coefficients, poles, terms, trainings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ambid.blackbox.fit import BlackBoxFit, any_structure
from ambid.errors import counted
from ambid.estimation.result import RecordEntry
from ambid.nonlinear.fit import NonlinearFit, nonlinear_structure
from ambid.report.document import Document, Frame, Lines, Part, Section, ending, grid
from ambid.report.estimate import physics_section, second_parts, signals_and_figures
from ambid.report.fit_figures import comparison_figure, fit_overview, is_weight, pole_parts, term_ratios, traces_of
from ambid.report.numbers import sized
from ambid.report.parameters import fit_table, parameter_table, short_numbers
from ambid.report.text import Cell, Line, coefficient_text, fraction, names_words, title_line
from ambid.settings.caller import setting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ambid.nonlinear.fit import LearningCurve
    from ambid.report.signals import Traces
    from ambid.settings.caller import setting
    from ambid.validation.comparison import Comparison, Entry


AnyFit = BlackBoxFit | NonlinearFit

_COEFFICIENTS = 24  # that a terminal shows; the file has all

_NAMED = ("coefficients", "parameters")  # of a structure whose coefficients are those of a physical form
_TERMS = 20  # rows of terms and named parameters

_TRAININGS = 6  # learning curves


_SOURCES = {
    "information": "the information matrix",
    "laplace": "Laplace's approximation",
    "sandwich": "the sandwich formula, for coloured errors",
}


def fit_document(fit: AnyFit, source: Any) -> Document:
    """Describe a fit; `source`: its records, alone or with the second record behind them."""
    first, second = source if isinstance(source, tuple) else (() if source is None else (source,), None)

    def traces() -> Sequence[Traces]:
        own = [traces_of(fit, x, title=f"record {k}" if len(first) > 1 else "") for k, x in enumerate(first, 1)]
        return own + ([] if second is None else [traces_of(fit, second, second=True, title="second record")])

    def drawn(width: float) -> Figure:
        return fit_overview(fit, first, second, width)

    signals = f"{', '.join(fit.inputs)}{' → ' if fit.inputs else ''}{', '.join(fit.outputs)}"
    return Document(
        title=f"{signals}, {fit.structure}", sections=fit_sections(fit), figure=drawn,
        drawings=lambda: signals_and_figures(traces(), drawn), frame=parameter_table(fit.parameters).frame,
        numbers=short_numbers(fit.parameters),
    )  # fmt: skip


def fit_sections(fit: AnyFit) -> list[Section]:
    """Say what was fitted; of a failed fit its settings and the reason."""
    trainings = list[str]()
    own: list[Section]
    if isinstance(fit, BlackBoxFit):
        own = [
            Section(title="Coefficients", parts=coefficient_parts(fit)),
            Section(title="Poles", parts=pole_parts(fit)),
        ]
        none = "none (unstable, or no input)"
    else:
        reason = Lines(lines=[f"no model: {fit.reason}"] if fit.reason else [])
        own = [Section(parts=[reason]), Section(title="Coefficients", parts=number_parts(fit))]
        none = "none (diverges, or no input)"
        trainings = curve_lines(fit.curves)
    second = [] if fit.validation is None else second_parts(fit.validation)
    text = ", ".join(f"{name} {value:.6g}" for name, value in fit.criteria.items())
    return [
        Section(parts=_header(fit)),
        *own,
        Section(title="Fit", parts=[fit_table(fit.fit, fit.units, none)]),
        Section(heading=[("on the second record", "strong")], parts=second),
        Section(parts=[Lines(lines=[f"criteria: {text}; {fit.n_estimated} parameters estimated"] if text else [])]),
        Section(parts=[Lines(lines=trainings, indent=2)]),
        *ending(fit),
        *(physics_section(x) for x in getattr(fit, "derived", {}).values()),
    ]


def _header(fit: AnyFit) -> list[Part]:
    """Say what was fitted to which records, with which settings."""
    signals = (f"from {', '.join(fit.inputs)} to " if fit.inputs else "of ") + ", ".join(fit.outputs)
    if isinstance(fit, BlackBoxFit):
        records = [RecordEntry.of(fit.record)]
        about = [f"{any_structure(fit.structure).summary}; {settings_text(fit.orders)}; {signals}"]
    else:
        records = [RecordEntry.of(record) for record in fit.records]
        about = [f"{nonlinear_structure(fit.structure).summary}; {signals}"]
        about += [f"settings: {settings_text(fit.settings)}; seed {fit.seed}"]
    names = [record.name for record in records]
    whole = RecordEntry(file=names_words(names), samples=sum(x.samples for x in records), rate_hz=1 / fit.dt)
    first = title_line(whole, fit.structure, fit.status)
    listed = [", ".join(names)] if len(names) > 1 else []
    return [Lines(lines=[first], wrap=False), Lines(lines=[*listed, *about])]


def settings_text(settings: Mapping[str, object]) -> str:
    """Write orders or settings with their names."""
    return ", ".join(f"{k} = {setting_text(v)}" for k, v in settings.items())


def setting_text(value: object) -> str:
    """Write an order or a setting as the command line takes it, several numbers with a slash between."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "/".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


# --- coefficients and poles of a linear model -----------------------------------------------------------------------


def coefficient_parts(fit: BlackBoxFit, *, without: Sequence[int] = ()) -> list[Part]:
    """Return the coefficients that are not fixed by the structure, each with its standard deviation, `without` some."""
    theta, sd = fit.model.theta, fit.sd
    free = np.setdiff1d(np.nonzero(theta != np.round(theta) if sd is None else sd > 0)[0], without)
    by_name: dict[str, Any] = {}
    for part in _NAMED:
        by_name |= cast("Mapping[str, Any]", fit.details.get(part, {}))
    rows = [
        (fit.model.names[k], coefficient_text(float(theta[k]), 0.0 if sd is None else float(sd[k])))
        for k in free[: 0 if by_name else _COEFFICIENTS]
    ]
    rows += [(f"{k} [{x['unit']}]", coefficient_text(x["value"], x["sd"])) for k, x in by_name.items()]
    if not rows:
        return []
    head = ("", "value" if sd is None else "value ± sd")
    table: list[tuple[str, ...]] = [head, *rows]
    if len(rows) > 8:
        half = -(-len(rows) // 2)
        right = [*rows[half:], ("", "")][:half]
        table = [(*a, *b) for a, b in zip([head, *rows[:half]], [head, *right], strict=True)]
    return [grid(table), _rest(0 if by_name else free.size - len(rows))]


def _rest(n: int) -> Lines:
    return Lines(lines=[f"… and {n} more; {setting('json')} has them all"] if n > 0 else [])


# --- numbers of a nonlinear model -----------------------------------------------------------------------------------


def number_parts(fit: NonlinearFit) -> list[Part]:
    """Return terms with ratios, named parameters or a schedule, and where their standard deviations come from."""
    if fit.model is None:
        return []
    if isinstance(fit.details.get("terms"), Mapping):
        parts = term_parts(fit)
    elif isinstance(fit.details.get("schedule"), Mapping):
        parts = schedule_parts(fit)
    else:
        parts = named_parts(fit)
    return [*parts, Lines(lines=_count(fit, readable=bool(parts)))]


def _count(fit: NonlinearFit, *, readable: bool) -> list[str]:
    assert fit.model is not None
    remark = "no standard deviations"
    if fit.sd is not None:
        remark = f"standard deviations from {_SOURCES.get(fit.covariance_from, fit.covariance_from)}"
    elif "uncertainty" in fit.settings:
        remark += f" ({setting('orders', 'uncertainty=...')} gives them)"
    size, rest = fit.model.theta.size, "" if readable else f"; {setting('json')} has them all"
    lines = [f"{size} parameters, {fit.n_estimated} estimated, {remark}{rest}"]
    effective = fit.details.get("effective_parameters")
    if isinstance(effective, (int, float)) and math.isfinite(effective) and round(effective, 1) < fit.n_estimated:
        lines.append(f"regularised to {effective:.3g} effective parameters")
    return lines


def term_parts(fit: NonlinearFit) -> list[Part]:
    """Return the first terms in the order of choice, with error reduction ratios in percent where there are any.

    Weights of a network beside them are counted.
    """
    assert fit.model is not None
    ratio = term_ratios(fit)
    readable = [k for k, name in enumerate(fit.model.names) if not is_weight(name)]
    weights = fit.model.theta.size - len(readable)
    rows: list[tuple[str, ...]] = [("term", _column(fit)), *(_row(fit, k) for k in readable[:_TERMS])]
    if any(isinstance(x, (int, float)) for x in ratio.values()):
        shares = ["ERR", *(_percent(ratio.get(fit.model.names[k])) for k in readable[:_TERMS])]
        rows = [(*r, x) for r, x in zip(rows, shares, strict=True)]
    network = [f"and a network of {weights} weights; {setting('json')} has them"] if weights else []
    return [grid(rows, right=(2,)), _rest(len(readable) - _TERMS), Lines(lines=network)]


def named_parts(fit: NonlinearFit) -> list[Part]:
    """Return parameters that have a meaning of their own; none for a network, or for more than twenty."""
    assert fit.model is not None
    sd = fit.sd
    estimated = [k for k in range(fit.model.theta.size) if sd is None or sd[k] > 0]
    if len(estimated) > _TERMS or any(map(is_weight, fit.model.names)):
        return []
    return [grid([("parameter", _column(fit)), *(_row(fit, k) for k in estimated)])]


def schedule_parts(fit: NonlinearFit) -> list[Part]:
    """Return what a model with a schedule is where the schedule stands still: at its ends and in the middle.

    Poles in rad/s, gains at 0 Hz in SI, ± standard deviations.
    """
    schedule, frozen = fit.details["schedule"], fit.details.get("frozen")
    assert isinstance(schedule, Mapping)
    low, high, unit = float(schedule["low"]), float(schedule["high"]), str(schedule["unit"])
    signal = str(schedule["signal"])
    what = "the output, low-passed" if signal == "level" else signal
    slow = f" ({float(schedule['time_constant_s']):.3g} s)" if schedule.get("time_constant_s") else ""
    head = Lines(lines=[f"schedule: {what}{slow}, {low:.4g} to {high:.4g} {unit} in training"])
    if not isinstance(frozen, Sequence) or not frozen:
        return [head]
    places = [frozen[0], frozen[len(frozen) // 2], frozen[-1]]
    gains = list(places[0].get("dc_gain", {}))
    names = (f"at [{unit}]", "poles [rad/s]", *(f"gain from {x} at 0 Hz" for x in gains))
    rows = [(f"{x['p']:.4g}", _poles(x["poles_rad_s"]), *(_number(x["dc_gain"][g]) for g in gains)) for x in places]
    return [head, grid([names, *rows])]


def _poles(poles: Sequence[Sequence[Any]]) -> str:
    """Real poles one by one, pairs once."""
    out = []
    for pole in poles:
        real, imaginary, *sd = (math.nan if v is None else float(v) for v in pole)
        if imaginary < 0:
            continue
        text = _number([real, sd[0] if sd else None])
        out.append(text if imaginary == 0 else f"{text} ± j {_number([imaginary, sd[1] if len(sd) > 1 else None])}")
    return ", ".join(out)


def _number(pole: Sequence[Any]) -> str:
    value = float(pole[0])
    sd = math.nan if len(pole) < 2 or pole[1] is None else float(pole[1])
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
    values = curve.held_out[np.isfinite(curve.held_out)]
    return text + (f", held out {values[0]:.3g} -> {np.min(values):.3g}" if values.size else "")


def comparison_document(comparison: Comparison, source: Any) -> Document:
    """Describe a comparison; `source`: the data that it was judged on."""

    def frame() -> Frame:
        names = ("structure", "orders", "one_step", "simulation", "seconds", "n_estimated", "bic", "failed")
        rows = [(x.structure, x.orders, x.one_step, x.simulation, x.seconds, x.fit and x.fit.n_estimated,
                 x.fit and x.fit.criteria.get("bic"), ", ".join(x.failed)) for x in comparison.entries]  # fmt: skip
        return "structure", dict(zip(names, zip(*rows, strict=True), strict=True))

    name = RecordEntry.of(comparison.record).name
    return Document(
        title=f"{name}, {len(comparison.entries)} structures compared", sections=comparison_sections(comparison),
        figure=partial(comparison_figure, comparison, source), frame=frame,
    )  # fmt: skip


def comparison_sections(comparison: Comparison) -> list[Section]:
    """Say how structures compare, the best first."""
    c = comparison
    signals = f"{', '.join(c.inputs)} → " if c.inputs else ""
    place = "a second record" if c.judged_on == "second record" else f"the {c.judged_on}"
    head: Line = [
        (str(c.record.get("file") or "record"), "strong"),
        f": {signals}{', '.join(c.outputs)}; {counted(c.fitted_samples, 'sample')} fitted, validated on {place} "
        f"({c.judged_samples})",
    ]
    fitted = [x for x in c.entries if x.fit is not None]
    least = min((x.fit.criteria["bic"] for x in fitted if x.fit and "bic" in x.fit.criteria), default=0.0)
    labels = ("structure", "orders", "d", "BIC", "one-step", "simulation", "s", "checks")
    rows: list[tuple[Cell, ...]] = [
        tuple((cell, "dim") for cell in _entry(x, least)) if x.failed else _entry(x, least) for x in fitted
    ]
    remarks = [
        f"{x.structure} was not fitted: {x.refusal}"
        if x.fit is None
        else f"{x.structure} failed: {', '.join(x.failed)}"
        for x in c.entries
        if x.fit is None or x.failed
    ]
    meaning = (
        "d: estimated parameters; BIC: above the smallest, on the data fitted; one-step, simulation: fit on data "
        f"not used, 1 - |e|/|y - mean|; s: seconds, choice of orders included. {c.meaning}."
    )
    return [
        Section(parts=[Lines(lines=[head])]),
        Section(title="Structures", parts=[grid([labels, *rows], right=(2, 3, 4, 5, 6))]),
        Section(parts=[Lines(lines=remarks, indent=2)]),
        Section(parts=[Lines(lines=[meaning])]),
    ]


def _entry(entry: Entry, least: float) -> tuple[str, ...]:
    fit = entry.fit
    if fit is None:
        return (entry.structure,)
    bic = fit.criteria.get("bic")
    return (
        entry.structure,
        " ".join(f"{k}={_order(v)}" for k, v in entry.orders.items()),
        str(fit.n_estimated),
        "–" if bic is None else f"+{bic - least:.1f}" if abs(bic - least) < 1e5 else f"+{bic - least:.3g}",
        fraction(entry.one_step),
        fraction(entry.simulation),
        f"{entry.seconds:.2f}",
        f"{len(entry.failed)} failed" if entry.failed else "passed",
    )


def _order(value: object) -> str:
    return "/".join(str(v) for v in value) if isinstance(value, tuple) else str(value)
