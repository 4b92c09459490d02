"""Figures of fits: records beside the model, Bode diagram and poles of a linear one; of a nonlinear one its predictions
with bands, and correlations.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ambid.arrays import Array
from ambid.bearing.measured import ModelResponse, with_spread
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.model import TransferModel, pole_covariance, zero_covariance
from ambid.blackbox.prediction import errors_ahead, errors_elsewhere, innovations_form, one_step, plant_form, simulation
from ambid.errors import counted
from ambid.estimation.result import NORMAL_95
from ambid.nonlinear.fit import NonlinearFit
from ambid.report.document import Part
from ambid.report.drawing import (
    BAND,
    BOUND,
    MEASURED,
    PREDICTED,
    WIDE,
    Block,
    head,
    log_axis,
    panel,
    said_panel,
    stacked,
)
from ambid.report.estimate_figures import AHEAD
from ambid.report.numbers import prefixed
from ambid.report.parameters import pole_table
from ambid.report.response_panels import bode_panel, frequency_grid, poles_panel, roots
from ambid.report.signals import (
    Traces,
    records_panel,
    residuals_panel,
    signals_panel,
    stems,
    whiteness_panel,
    worst_stretch,
)
from ambid.validation.fits import beyond, leaves_colour_open, model_of, nonlinear_residuals, run
from ambid.validation.residuals import P_LEAST, Correlation, correlations

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ambid.validation.comparison import Comparison

_ACROSS = 5  # correlations beside each other
_MOST = 20
_RECORDS = 6  # that are drawn
_LEAST_P = 1e-12  # p-value that is drawn as the smallest
_POLES = 12  # that a terminal shows
_WEIGHT = re.compile(r"\bunit \d|\bhidden\b|: bias\b")  # of a network: says nothing by itself
_LEAD = 500  # samples in which derivatives that are recursions settle


def fit_overview(
    fit: BlackBoxFit | NonlinearFit, records: Sequence[IOData], second: IOData | None = None, width: float = WIDE
) -> Figure:
    """Draw all figures of a fit with a model on one page.

    `second`: a further record that a nonlinear fit was judged on; `width`: of the page, inches. Without records what
    needs none is drawn, or that they lack; of a fit without a model its reason.
    """
    if fit.model is None:
        return stacked(_title(fit, records, second), [said_panel(getattr(fit, "reason", ""))], width)
    blocks = _signals(fit, records, second)
    if isinstance(fit, BlackBoxFit):
        if fit.inputs:
            blocks.append(bode_panel(fit_response(fit), fit.inputs, fit.outputs, fit.units))
        blocks.append(_poles(fit))
    else:
        blocks += _nonlinear_blocks(fit, records, second)
    return stacked(_title(fit, records, second), blocks or [said_panel("figures need the records")], width)


def comparison_figure(comparison: Comparison, held_out: IOData | None = None, width: float = WIDE) -> Figure:
    """Draw the errors of each structure on data that it has not seen, best first, and its residual tests.

    `held_out`: those data; then the best structure is drawn beside them.
    """
    entries = [x for x in comparison.entries if x.fit is not None]
    at = np.arange(len(entries))

    def named(axes: Axes) -> None:
        axes.set_yticks(at, [f"{x.structure}, {x.fit.n_estimated} numbers" for x in entries if x.fit is not None])
        axes.set_ylim(len(entries) - 0.5, -0.5)

    def unexplained(axes: Axes) -> None:
        kinds = (
            ([x.one_step for x in entries], "one step ahead", "o"),
            ([x.simulation for x in entries], "simulated", "D"),
        )
        sizes = [[np.nan if v is None else 100 * max(1 - v, 1e-6) for v in values] for values, *_ in kinds]
        for x, (_, label, mark) in zip(sizes, kinds, strict=True):
            axes.plot(x, at, mark, color=PREDICTED if mark == "o" else BOUND, label=label)
        log_axis(axes.xaxis, float(np.nanmin(sizes)) / 1.5, 1.5 * float(np.nanmax(sizes)))
        named(axes)
        axes.set_xlabel("not explained [% of the outputs]")
        head(axes, f"errors on the {comparison.judged_on}: smaller is better")

    def tests(axes: Axes) -> None:
        for name, mark, color in (("residuals_white", "o", PREDICTED), ("residuals_uncorrelated", "D", BOUND)):
            found_p = [x.fit.checks[name].p if x.fit is not None and name in x.fit.checks else None for x in entries]
            p = [np.nan if v is None else max(v, _LEAST_P) for v in found_p]
            axes.plot(p, at, mark, color=color, markerfacecolor="none", label=name.replace("_", " "))
        axes.axvline(P_LEAST, color=MEASURED, linestyle="--", linewidth=1.0, label="fails to the left")
        log_axis(axes.xaxis, _LEAST_P, 1.0)
        named(axes)
        axes.set_xlabel(f"p-value of the residual test (drawn from {_LEAST_P:g})")
        head(axes, "residual tests on the fitted data")

    height = 0.8 + 0.32 * len(entries)
    blocks = [Block(columns=[[panel(unexplained, height=height)], [panel(tests, height=height)]], shared=False)]
    if held_out is not None and entries and entries[0].fit is not None:
        traces = traces_of(entries[0].fit, held_out, second=True)
        blocks += [signals_panel(traces), residuals_panel(traces)]
    name, best = comparison.record.get("file") or "record", entries[0].structure if entries else "none"
    return stacked(f"{name}: structures compared, {best} predicts unseen data best", blocks, width)


def _nonlinear_blocks(fit: NonlinearFit, records: Sequence[IOData], second: IOData | None) -> list[Block]:
    """Bands of the predictions, correlations of the errors."""
    blocks: list[Block] = []
    if fit.covariance is not None and records:
        where, data = ("the second record", second) if second is not None else (_name(records[0], 0), records[0])
        blocks.append(_draw_band(fit, data, where))
    correlations_shown = _correlations(fit, records) if records else []
    if correlations_shown:
        blocks.append(_draw_correlations(correlations_shown))
    return blocks


def _title(fit: BlackBoxFit | NonlinearFit, records: Sequence[IOData], second: IOData | None) -> str:
    if not records:
        return fit.structure
    what = _name(records[0], 0) if len(records) == 1 else f"{len(records)} records"
    more = f", validated on {_name(second, 0)}" if second is not None else ""
    left = len(records) - _RECORDS
    hidden = f" (the first {_RECORDS} are drawn, {left} more are not)" if left > 0 else ""
    return f"{what}: {fit.structure}{more}{hidden}"


def _name(data: IOData, k: int) -> str:
    return str(data.record.get("file") or f"record {k + 1}")


def _signals(fit: BlackBoxFit | NonlinearFit, records: Sequence[IOData], second: IOData | None) -> list[Block]:
    """One record large, with a close view; several below each other."""
    if not records:
        return []
    traces = [traces_of(fit, x, _name(x, k)) for k, x in enumerate(records[:_RECORDS])]
    if second is not None:
        title = f"second record, not fitted: {second.record.get('file') or 'record'}"
        traces.append(traces_of(fit, second, title, second=True))
    if len(traces) > 1:
        return [records_panel(traces)]
    failed = [name for name, c in fit.checks.items() if not c.passed]
    return [signals_panel(traces[0]), residuals_panel(traces[0]), whiteness_panel(traces[0], failed)]


def traces_of(fit: BlackBoxFit | NonlinearFit, data: IOData, title: str = "", *, second: bool = False) -> Traces:
    """Run a record through a fit, without the samples at the start that are not predicted.

    Returns no simulation where it diverges, or without inputs.
    """
    ahead: dict[int, Array] = {}
    if isinstance(fit, BlackBoxFit):
        first, predicted = 0, one_step(innovations_form(fit), data.u, data.y, fit.offsets)
        free = simulation(plant_form(fit), data.u, data.y, fit.offsets)
        if second:
            errors = errors_elsewhere(fit, data)
            predicted, free = (
                data.y - errors.one_step,
                None if errors.simulation is None else data.y - errors.simulation,
            )
            for k in (k for k in AHEAD if k < data.n_samples // 2):
                late = np.full((k - 1, data.n_outputs), np.nan)
                ahead[k] = np.vstack([late, data.y[k - 1 :] - errors_ahead(errors, k)])
    else:
        result = run(fit, data)
        first, predicted = result.lag, data.y - result.one_step
        free = None if result.simulation is None or result.diverges_at is not None else data.y - result.simulation
    return Traces(
        title=title,
        second=second,
        time_s=data.start_s + np.arange(first, data.n_samples, dtype=np.float64) * data.dt,
        names=data.outputs,
        units=tuple(fit.units[o] for o in data.outputs),
        measured=data.y[first:],
        predicted=predicted[first:],
        simulated=None if free is None else free[first:],
        ahead=ahead,
        sd=np.sqrt(np.maximum(np.diag(fit.noise_covariance), 0.0)),
        inputs=data.u[first:],
        input_names=data.inputs,
        input_units=tuple(fit.units.get(i, "") for i in data.inputs),
    )


# --- a linear model -------------------------------------------------------------------------------------------------


def fit_response(fit: BlackBoxFit) -> ModelResponse:
    """Compute the frequency response of every pair with its spread, up to half the sampling rate."""
    nyquist = 0.5 / fit.dt
    lowest = max(1 / (int(str(fit.record["samples"])) * fit.dt), 1e-5 * nyquist)
    poles = fit.model.poles()
    s = poles if fit.model.dt is None else np.log(poles[np.abs(poles) > 0]) / fit.dt
    frequency = frequency_grid(s, lowest, nyquist)
    omega = 2 * np.pi * frequency
    G = fit.model.frequency_response(omega)
    slopes = np.zeros((*G.shape, 0)) if fit.covariance is None else fit.model.frequency_response_derivative(omega)
    return with_spread(fit.structure, frequency, G, slopes.astype(np.complex128), fit.covariance)


def _poles(fit: BlackBoxFit) -> Block:
    """Poles and zeros with 95 % regions, and beside them the poles in numbers."""
    poles, zeros = fit.model.poles(), fit.model.zeros()
    reach = 3 * max(1.0, float(np.max(np.abs(poles), initial=0.0)))
    near = np.abs(zeros) < reach
    covariance, of_poles, of_zeros = fit.covariance, None, None
    if covariance is not None:
        of_poles, of_zeros = pole_covariance(fit.model, covariance), zero_covariance(fit.model, covariance)[near]
    far = int(zeros.size - np.count_nonzero(near))
    hidden = f"; {counted(far, 'zero')} farther out" if far else ""
    delayed = ", without the delay" if isinstance(fit.model, TransferModel) and any(fit.model.delay) else ""
    return poles_panel(
        roots(poles, of_poles, 1e3),
        f"poles and zeros{hidden}{delayed}",
        zeros=roots(zeros[near], of_zeros, reach),
        discrete=fit.model.dt is not None,
    )


# --- a nonlinear model ----------------------------------------------------------------------------------------------


def _correlations(fit: NonlinearFit, records: Sequence[IOData]) -> list[Correlation]:
    """Correlate the errors with what the residual tests look at.

    Returns over all records; empty where they are too short, or errors are not finite.
    """
    results = [run(fit, x) for x in records]
    if not all(x.finite for x in results):
        return []
    prepared = nonlinear_residuals(fit, records, results, coloured=leaves_colour_open(fit, records, results))
    return [] if prepared is None else correlations(prepared, records[0].inputs, records[0].outputs)[:_MOST]


def _draw_correlations(correlations_shown: list[Correlation]) -> Block:
    def one(axes: Axes, c: Correlation) -> None:
        stems(axes, c.lags, c.values, c.band)
        axes.set_xlabel("lag [samples]")
        head(axes, c.title)

    columns = [[panel(one, c) for c in correlations_shown[k::_ACROSS]] for k in range(_ACROSS)]
    return Block(columns=[x for x in columns if x], title="correlations of residuals (Billings and Voon 1986)")


def _draw_band(fit: NonlinearFit, data: IOData, where: str) -> Block:
    """Draw the predicted outputs with their 95 % bands, where the errors are largest.

    `fit`: with a covariance; `where`: which record it is, for the title.
    """
    model = model_of(fit, data)
    predicted = model.predict(data.u, data.y)
    first, last = (k + model.lag for k in worst_stretch((data.y - predicted)[model.lag :]))
    lead = max(first - _LEAD, 0)
    slopes = model.jacobian(data.u[lead:last], data.y[lead:last])[first - lead :]
    assert fit.covariance is not None
    variance = np.maximum(np.einsum("tok,kl,tol->to", slopes, fit.covariance, slopes, optimize=True), 0.0)
    noise = np.maximum(np.diag(fit.noise_covariance), 0.0)
    outside = beyond(model.novelty(data.u, data.y)[first:last])
    t = data.start_s + np.arange(first, last) * data.dt

    def draw(axes: Axes, j: int, less: Array, what: str) -> None:
        points, middle = (x[first:last, j] - less[first:last, j] for x in (data.y, predicted))
        own, both = NORMAL_95 * np.sqrt(variance[:, j]), NORMAL_95 * np.sqrt(variance[:, j] + noise[j])
        scale, unit = prefixed(float(np.max(np.abs(points))), fit.units[data.outputs[j]])
        for half, color, label in ((both, BAND, "95 % of the measured"), (own, PREDICTED, "95 % of the prediction")):
            low, high = (middle - half) / scale, (middle + half) / scale
            axes.fill_between(t, low, high, color=color, alpha=0.5, linewidth=0, label=label)
        axes.plot(t, middle / scale, color=PREDICTED, linewidth=1.0, label="predicted one step ahead")
        inside = np.where(outside, np.nan, points / scale)
        axes.plot(t, inside, ".", color=MEASURED, markersize=3.5, label="measured")
        if np.any(outside):
            far = points[outside] / scale
            axes.plot(t[outside], far, "x", color=BOUND, markersize=4, label="measured, outside the training data")
        axes.set_xlabel("time [s]")
        axes.set_ylabel(f"{data.outputs[j]} [{unit}]")
        head(axes, what)

    views = ((np.zeros_like(predicted), f"{where}, where errors are largest"), (predicted, "measured less predicted"))
    columns = [[panel(draw, j, *v, height=2.1) for j in range(data.n_outputs)] for v in views]
    return Block(columns=columns, widths=(3, 2), title="predictions with their bands")


def is_weight(name: str) -> bool:
    """Return whether a parameter is a weight of a network's unit, which says nothing by itself."""
    return _WEIGHT.search(name) is not None


def pole_parts(fit: BlackBoxFit) -> list[Part]:
    """Return the first poles of a fit."""
    poles = fit.model.poles()
    spread = None if fit.covariance is None else pole_covariance(fit.model, fit.covariance)
    covariances = [None] * poles.size if spread is None else list(spread)
    upper = [k for k in range(poles.size) if poles[k].imag >= 0][:_POLES]
    return pole_table([(complex(poles[k]), covariances[k]) for k in upper], None if fit.model.dt is None else fit.dt)


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
