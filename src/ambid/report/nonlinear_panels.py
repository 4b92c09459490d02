"""Panels of a nonlinear fit: records with their errors, coefficients with error bars, predictions with their bands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.nonlinear.fit import NonlinearFit
from ambid.report._drawing import (
    BAND,
    BOUND,
    MEASURED,
    NORMAL_95,
    NORMAL_99,
    PREDICTED,
    curve,
    grid,
    note,
    worst_stretch,
)
from ambid.report._panels import Traces
from ambid.report.nonlinear_parameters import coefficient_text, is_weight
from ambid.report.numbers import prefixed
from ambid.validate.nonlinear.runs import beyond, model_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


MOST_COEFFICIENTS = 25
_ROWS = 13  # of coefficients below each other
_LEAD = 500  # samples in which derivatives that are recursions settle


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Panel:
    """One record as it is drawn."""

    title: str
    traces: Traces
    second: bool = False  # whether the fit has not seen it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bars:
    """Coefficients as they are drawn, the most significant first."""

    names: tuple[str, ...]
    theta: Array  # (n_shown,), SI, values, and half of their 95 % intervals
    half_width: Array
    n_more: int  # coefficients that are not shown
    n_others: int  # estimated numbers that are no coefficients: weights of a network


def records_panel(figure: Figure | SubFigure, panels: Sequence[Panel]) -> None:
    """Draw several records beside each other, each output with its errors below."""
    across = columns_of(len(panels))
    n_y, down = len(panels[0].traces.names), -(-len(panels) // across)
    axes = figure.subplots(2 * n_y * down, across, squeeze=False, height_ratios=(1.7, 1.0) * (n_y * down))
    for k, panel in enumerate(panels):
        row, column = divmod(k, across)
        own = axes[2 * n_y * row : 2 * n_y * (row + 1), column]
        _record(own, panel, with_names=column == 0)
    for k in range(len(panels), across * down):
        for a in axes[2 * n_y * (down - 1) :, k % across]:
            a.axis("off")
    named = {label: h for a in axes.flat for h, label in zip(*a.get_legend_handles_labels(), strict=True)}
    figure.legend(list(named.values()), list(named), loc="outside upper center", fontsize=8, ncols=4, frameon=False)


def columns_of(n_panels: int) -> int:
    """Return how many records stand beside each other."""
    return n_panels if n_panels <= 3 else 2 if n_panels == 4 else 3


def _record(axes: NDArray[np.object_], panel: Panel, *, with_names: bool) -> None:
    traces, t = panel.traces, panel.traces.time_s
    for j, name in enumerate(traces.names):
        signals, errors = axes[2 * j], axes[2 * j + 1]
        scale, unit = prefixed(float(np.max(np.abs(traces.measured[:, j]))), traces.units[j])
        curve(signals, t, traces.measured[:, j] / scale, MEASURED, "measured")
        curve(signals, t, traces.predicted[:, j] / scale, PREDICTED, "predicted one step ahead")
        if traces.simulated is not None:
            free = traces.simulated[:, j] / scale
            signals.plot(t, free, "--", color=BOUND, linewidth=0.8, label="simulated from the input", zorder=1.5)
            signals.set_ylim(*_limits(traces.measured[:, j] / scale, free))
        sd = traces.innovation_sd[j]
        e = traces.measured[:, j] - traces.predicted[:, j]
        size, small = prefixed(3.0 * float(sd) if sd > 0 else float(np.max(np.abs(e))), traces.units[j])
        curve(errors, t, e / size, PREDICTED, None)
        for side in (-1, 1):
            errors.axhline(side * NORMAL_99 * sd / size, color=BOUND, linewidth=0.9, linestyle="--")
        note(errors, f"{100 * float(np.mean(np.abs(e) > NORMAL_99 * sd)):.2g} % outside")
        signals.tick_params(labelbottom=False)
        signals.sharex(errors)
        signals.set_ylabel(f"{name} [{unit}]" if with_names else f"[{unit}]", fontsize=9)
        errors.set_ylabel(f"error [{small}]" if with_names else f"[{small}]", fontsize=9)
        grid(signals, errors)
        for a in (signals, errors):
            a.tick_params(labelsize=8)
            if panel.second:
                a.set_facecolor("#fbf7ee")
    axes[0].set_title(panel.title, fontsize=9)
    axes[-1].set_xlabel("time [s]", fontsize=9)


def _limits(y: Array, free: Array) -> tuple[float, float]:
    """Limits for both; a free run that runs away would hide all else, and gets half the measured span at most."""
    low, high = float(np.min(y)), float(np.max(y))
    room = (high - low) or 1.0
    least, largest = max(float(np.min(free)), low - room / 2), min(float(np.max(free)), high + room / 2)
    return min(low, least) - 0.05 * room, max(high, largest) + 0.05 * room


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
    terms = fit.details.get("terms")
    if not isinstance(terms, Mapping) or fit.model is None:
        return set()
    several = len(fit.outputs) > 1
    chosen = {
        (f"y{o + 1}: " if several else "") + str(t["term"])
        for o, output in enumerate(fit.outputs)
        for t in terms.get(output, ())
    }
    below = {f"{x.split(': ')[0]}: " if several else "" for x in chosen}
    return {x for x in fit.model.names if x in chosen or any(x.startswith(f"{b}1/(") for b in below)}


def bars_height(bars: Bars) -> float:
    """Return the height of `bars_panel` in inches."""
    return 1.1 + 0.21 * min(len(bars.names), _ROWS)


def bars_panel(figure: Figure | SubFigure, bars: Bars) -> None:
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


def band_panel(figure: Figure | SubFigure, fit: NonlinearFit, data: IOData, where: str) -> None:
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
    t = np.arange(first, last) * data.dt
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
