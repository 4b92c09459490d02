"""Figures of fits: records beside the model, Bode diagram and poles of a linear one; of a nonlinear one coefficients,
predictions with bands, correlations, learning curves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from ambid.arrays import Array
from ambid.bearing.measured import ModelResponse, with_spread
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.model import TransferModel, pole_covariance, zero_covariance
from ambid.blackbox.prediction import innovations_form, one_step, plant_form, simulation
from ambid.nonlinear.fit import NonlinearFit
from ambid.report.drawing import (
    BAND,
    BOUND,
    MEASURED,
    MOST_PAIRS,
    NORMAL_95,
    PREDICTED,
    Traces,
    bode_panel,
    frequency_grid,
    grid,
    poles_panel,
    records_panel,
    residuals_panel,
    roots,
    signals_panel,
    stacked,
    stems,
    worst_stretch,
)
from ambid.report.fit_text import is_weight, pole_lines, term_ratios
from ambid.report.numbers import prefixed
from ambid.report.text import coefficient_text
from ambid.units import counted
from ambid.validation.fits import beyond, leaves_colour_open, model_of, nonlinear_residuals, run
from ambid.validation.residuals import Correlation, correlations

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from ambid.report.drawing import Draw
    from ambid.validation.comparison import Comparison

MOST_COEFFICIENTS = 25
_ACROSS = 5  # correlations beside each other
_MOST = 20
_RECORDS = 6  # that are drawn
_ROWS = 13  # of coefficients below each other
_LEAD = 500  # samples in which derivatives that are recursions settle


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bars:
    """Coefficients as they are drawn, the most significant first."""

    names: tuple[str, ...]
    theta: Array  # (n_shown,), SI, values, and half of their 95 % intervals
    half_width: Array
    n_more: int  # coefficients that are not shown
    n_others: int  # estimated numbers that are no coefficients: weights of a network


def fit_overview(fit: BlackBoxFit | NonlinearFit, records: Sequence[IOData], second: IOData | None = None) -> Figure:
    """Draw all figures of a fit with a model on one page.

    `second`: a further record that a nonlinear fit was judged on. Without records what needs none is drawn.
    """
    if fit.model is None:
        reason = getattr(fit, "reason", "")
        return stacked(_title(fit, records, second), [(1.0, lambda place: place.text(0.5, 0.5, reason, ha="center"))])
    parts, n_y = _signals(fit, records, second), len(fit.outputs)
    width = max(11.0, 4.5 * n_y) if len(records) > 1 or second is not None else 11.0
    if isinstance(fit, BlackBoxFit):
        if fit.inputs:
            asides: dict[str, str] = {}
            parts.append(
                (4.6, lambda place: bode_panel(place, fit_response(fit), fit.inputs, fit.outputs, fit.units, asides))
            )
        parts.append((3.6, lambda place: _poles(place, fit)))
        width = max(width, 3.3 * min(MOST_PAIRS, len(fit.inputs) * n_y))
    else:
        parts += _nonlinear_parts(fit, records, second)
    return stacked(_title(fit, records, second), parts, width)


def comparison_figure(found: Comparison) -> Figure:
    """Draw the fit of each structure on data that it has not seen, best first."""
    entries = [x for x in found.entries if x.fit is not None]

    def draw(place: Figure | SubFigure) -> None:
        axes, at = place.subplots(), np.arange(len(entries))
        for values, label, color, shift in (
            ([x.one_step for x in entries], "one step", PREDICTED, -0.2),
            ([x.simulation for x in entries], "simulation", BAND, 0.2),
        ):
            axes.barh(at + shift, [np.nan if v is None else v for v in values], 0.38, color=color, label=label)
        axes.set_yticks(at, [f"{x.structure}{' (failed checks)' if x.failed else ''}" for x in entries])
        axes.invert_yaxis()
        axes.set_xlabel(f"fit on the {found.judged_on}, 1 is perfect")
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, fontsize=8)
        grid(axes)

    name = found.record.get("file") or "record"
    return stacked(f"{name}: structures compared", [(1.4 + 0.5 * len(entries), draw)])


def _nonlinear_parts(fit: NonlinearFit, records: Sequence[IOData], second: IOData | None) -> list[tuple[float, Draw]]:
    """Coefficients or bands, correlations of the errors, learning curves."""
    parts: list[tuple[float, Draw]] = []
    bars = bars_of(fit)
    if bars is not None:
        rows = min(len(bars.names), _ROWS)
        parts.append((1.1 + 0.21 * rows, lambda place: _draw_bars(place, bars)))
    if fit.covariance is not None and (bars is None or bars.n_others) and records:
        where, data = ("the second record", second) if second is not None else (_name(records[0], 0), records[0])
        parts.append((0.9 + 2.1 * data.n_outputs, lambda place: _draw_band(place, fit, data, where)))
    shown = _correlations(fit, records) if records else []
    if shown:
        parts.append((1.9 * -(-len(shown) // _ACROSS) + 0.4, lambda place: _draw_correlations(place, shown)))
    if any(c.training.size for c in fit.curves):
        parts.append((3.0 + 0.1 * len(fit.curves), lambda place: _draw_training(place, fit)))
    return parts


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


def _signals(
    fit: BlackBoxFit | NonlinearFit, records: Sequence[IOData], second: IOData | None
) -> list[tuple[float, Draw]]:
    """One record large, with a close view; several below each other."""
    if not records:
        return []
    found = [traces_of(fit, x, _name(x, k)) for k, x in enumerate(records[:_RECORDS])]
    if second is not None:
        title = f"second record, not fitted: {second.record.get('file') or 'record'}"
        found.append(traces_of(fit, second, title, second=True))
    n_y, only = len(fit.outputs), found[0]
    if len(found) == 1:
        return [
            (2.3 * n_y, lambda place: signals_panel(place, only)),
            (2.2 * n_y, lambda place: residuals_panel(place, only)),
        ]
    return [(0.4 + 1.8 * len(found), lambda place: records_panel(place, found))]


def traces_of(fit: BlackBoxFit | NonlinearFit, data: IOData, title: str = "", *, second: bool = False) -> Traces:
    """Run a record through a fit, without the samples at the start that are not predicted.

    Returns no simulation where it diverges, or without inputs.
    """
    if isinstance(fit, BlackBoxFit):
        first, predicted = 0, one_step(innovations_form(fit), data.u, data.y, fit.offsets)
        free = simulation(plant_form(fit), data.u, data.y, fit.offsets)
    else:
        found = run(fit, data)
        first, predicted = found.lag, data.y - found.one_step
        free = None if found.simulation is None or found.diverges_at is not None else data.y - found.simulation
    return Traces(
        title=title,
        second=second,
        time_s=data.start_s + np.arange(first, data.n_samples, dtype=np.float64) * data.dt,
        names=data.outputs,
        units=tuple(fit.units[o] for o in data.outputs),
        measured=data.y[first:],
        predicted=predicted[first:],
        simulated=None if free is None else free[first:],
        sd=np.sqrt(np.maximum(np.diag(fit.noise_covariance), 0.0)),
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


def _poles(figure: Figure | SubFigure, fit: BlackBoxFit) -> None:
    """Poles and zeros with 95 % regions, and beside them the poles in numbers."""
    poles, zeros = fit.model.poles(), fit.model.zeros()
    reach = 3 * max(1.0, float(np.max(np.abs(poles), initial=0.0)))
    near = np.abs(zeros) < reach
    known, of_poles, of_zeros = fit.covariance, None, None
    if known is not None:
        of_poles, of_zeros = pole_covariance(fit.model, known), zero_covariance(fit.model, known)[near]
    far = int(zeros.size - np.count_nonzero(near))
    hidden = f"; {counted(far, 'zero')} farther out" if far else ""
    delayed = ", without the delay" if isinstance(fit.model, TransferModel) and any(fit.model.delay) else ""
    poles_panel(
        figure,
        roots(poles, of_poles, 1e3),
        "\n".join(pole_lines(fit)),
        f"poles (x) and zeros (o), 95 % regions{hidden}{delayed}",
        zeros=roots(zeros[near], of_zeros, reach),
        discrete=fit.model.dt is not None,
    )


# --- a nonlinear model ----------------------------------------------------------------------------------------------


def _correlations(fit: NonlinearFit, records: Sequence[IOData]) -> list[Correlation]:
    """Correlate the errors with what the residual tests look at.

    Returns over all records; empty where they are too short, or errors are not finite.
    """
    found = [run(fit, x) for x in records]
    if not all(x.finite for x in found):
        return []
    prepared = nonlinear_residuals(fit, records, found, coloured=leaves_colour_open(fit, records, found))
    return [] if prepared is None else correlations(prepared, records[0].inputs, records[0].outputs)[:_MOST]


def _draw_correlations(figure: Figure | SubFigure, shown: list[Correlation]) -> None:
    rows = -(-len(shown) // _ACROSS)
    axes = figure.subplots(rows, min(_ACROSS, len(shown)), squeeze=False, sharex=True)
    for a in axes.flat[len(shown) :]:
        a.axis("off")
    for a, c in zip(axes.flat, shown, strict=False):
        stems(a, c.lags, c.values, c.band)
        a.set_title(c.title, fontsize=9)
        a.tick_params(labelsize=8)
        grid(a)
    figure.suptitle("correlations over the lag in samples, with 99 % bounds (Billings and Voon 1986)", fontsize=10)


def _draw_training(figure: Figure | SubFigure, fit: NonlinearFit) -> None:
    by_time, by_step = figure.subplots(1, 2, sharey=True)
    positive = [float(t) for c in fit.curves for t in c.seconds if t > 0]
    earliest = min(positive, default=1.0) / 2  # a logarithm has no zero
    methods = [c.method for c in fit.curves]
    names = [f"{k + 1}. {m}" if methods.count(m) > 1 else m for k, m in enumerate(methods)]
    for k, c in enumerate(fit.curves):
        color, seconds = f"C{k % 10}", np.maximum(c.seconds, earliest)
        by_time.plot(seconds, c.training, ".-", color=color, markersize=3, linewidth=1.0, label=names[k])
        by_step.plot(np.arange(c.training.size), c.training, ".-", color=color, markersize=3, linewidth=1.0)
        if c.held_out.size == c.training.size:
            by_time.plot(seconds, c.held_out, "--", color=color, linewidth=0.9)
            by_step.plot(np.arange(c.training.size), c.held_out, "--", color=color, linewidth=0.9)
    by_time.set_xlabel("time [s]")
    by_step.set_xlabel("iteration")
    by_step.xaxis.get_major_locator().set_params(integer=True)
    _scaled(by_time, "x", [x for c in fit.curves for x in np.maximum(c.seconds, earliest)])
    _scaled(by_time, "y", [x for c in fit.curves for x in (*c.training, *c.held_out)])
    by_time.set_ylabel("rms error / sd of output")
    by_time.set_title("learning curves (dashed: held out)", fontsize=10)
    columns = 1 if max(map(len, names)) > 60 else 2
    figure.legend(loc="outside lower center", fontsize=8, ncols=min(columns, len(names)), frameon=False)
    grid(by_time, by_step)


def _scaled(axes: Axes, which: Literal["x", "y"], values: list[float]) -> None:
    """A logarithmic axis where values span more than a factor of 5; labels that do not run into each other."""
    from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullFormatter

    finite = [float(v) for v in values if np.isfinite(v) and v > 0]
    if not finite or max(finite) < 5 * min(finite):
        if which == "y" and finite and max(finite) < 1.01 * min(finite):  # a search that began where it ended is flat
            axes.set_ylim(0.98 * min(finite), 1.02 * max(finite))
        return
    if which == "x":
        axes.set_xscale("log")
    else:
        axes.set_yscale("log")
    axis = axes.xaxis if which == "x" else axes.yaxis
    wide = max(finite) > 100 * min(finite)
    axis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
    axis.set_major_formatter(LogFormatterSciNotation() if wide else "{x:g}")
    axis.set_minor_formatter(NullFormatter())


def bars_of(fit: NonlinearFit) -> Bars | None:
    """Return the coefficients that are worth a bar each.

    Returns none where there are no standard deviations, or the numbers say nothing one by one: more than 25 that are
    not named after terms, or weights of a network. Of a model with terms only these are shown.
    """
    sd, model = fit.sd, fit.model
    if sd is None or model is None:
        return None
    worth = estimated = np.flatnonzero(sd > 0)
    named = term_names(fit)
    if named:
        worth = np.array([k for k in worth if model.names[k] in named], dtype=int)
    elif worth.size > MOST_COEFFICIENTS or any(map(is_weight, model.names)):
        return None
    if not worth.size:
        return None
    order = worth[np.argsort(-np.abs(model.theta[worth]) / sd[worth], kind="stable")]
    shown = order[:MOST_COEFFICIENTS]
    return Bars(
        names=tuple(model.names[k] for k in shown),
        theta=model.theta[shown],
        half_width=NORMAL_95 * sd[shown],
        n_more=int(order.size - shown.size),
        n_others=int(estimated.size - order.size),
    )


def term_names(fit: NonlinearFit) -> set[str]:
    """Return the names of the parameters that belong to chosen terms.

    `fit`: with a model. Returns empty for a structure without terms.
    """
    if fit.model is None:
        return set()
    several, chosen = len(fit.outputs) > 1, term_ratios(fit)
    below = {f"{x.split(': ')[0]}: " if several else "" for x in chosen}
    return {x for x in fit.model.names if x in chosen or any(x.startswith(f"{b}1/(") for b in below)}


def _draw_bars(figure: Figure | SubFigure, bars: Bars) -> None:
    """Draw coefficients with their 95 % intervals, each on a scale of its own: they differ by orders of magnitude."""
    columns = -(-len(bars.names) // _ROWS)
    per = -(-len(bars.names) // columns)
    axes = figure.subplots(1, columns, squeeze=False)[0]
    for c, a in enumerate(axes):
        _bars(a, bars, slice(c * per, (c + 1) * per), per)
    more = f"; {bars.n_more} more, less significant, are not shown" if bars.n_more else ""
    title = "coefficients with 95 % intervals, each on its own scale; red: zero lies inside"
    figure.suptitle(f"{title}{more}", fontsize=10)


def _bars(axes: Axes, bars: Bars, part: slice, rows: int) -> None:
    names, values, halves = bars.names[part], bars.theta[part], bars.half_width[part]
    at = rows - 1 - np.arange(len(names))
    for y, value, half in zip(at, values, halves, strict=True):
        far = abs(value) + half
        color = BOUND if abs(value) < half else PREDICTED
        axes.errorbar(value / far, y, xerr=half / far, fmt="o", color=color, markersize=3.5, capsize=2.5, linewidth=1.2)
    axes.axvline(0, color=MEASURED, linewidth=0.8)
    texts = [f"{n} = {coefficient_text(float(v), float(h))}" for n, v, h in zip(names, values, halves, strict=True)]
    axes.set_yticks(at, texts)
    axes.set_xticks([0.0], ["0"])
    axes.set_xlim(-1.1, 1.1)
    axes.set_ylim(-0.7, rows - 0.3)
    grid(axes)
    axes.tick_params(labelsize=8)


def _draw_band(figure: Figure | SubFigure, fit: NonlinearFit, data: IOData, where: str) -> None:
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
    axes = figure.subplots(data.n_outputs, 2, squeeze=False, sharex="col", width_ratios=(3, 2))
    for j, name in enumerate(data.outputs):
        y, p = data.y[first:last, j], predicted[first:last, j]
        own, both = NORMAL_95 * np.sqrt(variance[:, j]), NORMAL_95 * np.sqrt(variance[:, j] + noise[j])
        for a, middle, points in ((axes[j, 0], p, y), (axes[j, 1], np.zeros_like(p), y - p)):
            scale, unit = prefixed(float(np.max(np.abs(points))), fit.units[name])
            for half, color, label in (
                (both, BAND, "95 % of the measured"),
                (own, PREDICTED, "95 % of the prediction"),
            ):
                low, high = (middle - half) / scale, (middle + half) / scale
                a.fill_between(t, low, high, color=color, alpha=0.5, linewidth=0, label=label)
            a.plot(t, middle / scale, color=PREDICTED, linewidth=1.0, label="predicted one step ahead")
            inside = np.where(outside, np.nan, points / scale)
            a.plot(t, inside, ".", color=MEASURED, markersize=3.5, label="measured")
            if np.any(outside):
                far = points[outside] / scale
                a.plot(t[outside], far, "x", color=BOUND, markersize=4, label="measured, outside the training data")
            a.set_ylabel(f"{name} [{unit}]" if a is axes[j, 0] else f"[{unit}]")
            grid(a)
    for a, title in zip(axes[0], (f"{where}, where errors are largest", "measured - predicted"), strict=True):
        a.set_title(title, fontsize=10)
        axes[-1, 0].set_xlabel("time [s]")
        axes[-1, 1].set_xlabel("time [s]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", fontsize=8, ncols=5, frameon=False)
    figure.suptitle("predictions with their bands", fontsize=10)
