"""Panels that every overview has: measured against predicted, and the innovations with their autocorrelation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ambid.arrays import Array
from ambid.report._drawing import (
    BAND,
    BOUND,
    MEASURED,
    NORMAL_99,
    PREDICTED,
    autocorrelation,
    curve,
    grid,
    note,
    worst_stretch,
)
from ambid.report.numbers import prefixed

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure


_LAGS = 50


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Traces:
    """Outputs beside what a model says of them, SI."""

    time_s: Array  # (n_samples,), s
    names: tuple[str, ...]  # of the outputs
    units: tuple[str, ...]
    measured: Array  # (n_samples, n_outputs), predicted one step ahead
    predicted: Array
    simulated: Array | None  # (n_samples, n_outputs), or None
    innovation_sd: Array  # (n_outputs,), as the model says


def signals_panel(figure: Figure | SubFigure, traces: Traces) -> None:
    """Measured against predicted: the whole record, and the stretch with the largest errors."""
    t = traces.time_s
    axes = figure.subplots(len(traces.names), 2, squeeze=False, width_ratios=(3, 2), sharex="col")
    innovations = traces.measured - traces.predicted
    first, last = worst_stretch(innovations)
    for j, role in enumerate(traces.names):
        whole, zoom = axes[j]
        scale, unit = _axis_unit(traces, j, traces.measured[:, j])
        y, p = traces.measured[:, j] / scale, traces.predicted[:, j] / scale
        curve(whole, t, y, MEASURED, "measured")
        curve(whole, t, p, PREDICTED, "predicted one step ahead")
        zoom.plot(t[first:last], y[first:last], ".", color=MEASURED, markersize=3.5)
        zoom.plot(t[first:last], p[first:last], "-", color=PREDICTED, linewidth=1.0)
        if traces.simulated is not None:
            simulated = traces.simulated[first:last, j] / scale
            zoom.plot(t[first:last], simulated, "--", color=BOUND, linewidth=0.9, label="simulated from the input")
        whole.axvspan(t[first], t[last - 1], color="#f3d9a4", zorder=0)
        whole.set_ylabel(f"{role} [{unit}]")
        grid(whole, zoom)
    axes[0, 0].set_title("measured and predicted", fontsize=10)
    axes[0, 1].set_title("close view where the errors are largest", fontsize=10)
    axes[0, 0].legend(loc="upper right", fontsize=8, ncols=3, framealpha=0.85)
    if traces.simulated is not None:
        axes[0, 1].legend(loc="upper left", fontsize=8, framealpha=0.85)
    axes[-1, 0].set_xlabel("time [s]")
    axes[-1, 1].set_xlabel("time [s]")


def residuals_panel(figure: Figure | SubFigure, traces: Traces) -> None:
    """Innovations over time with 99 % bounds, and their autocorrelation."""
    t = traces.time_s
    axes = figure.subplots(len(traces.names), 2, squeeze=False, width_ratios=(3, 2), sharex="col")
    sds = traces.innovation_sd
    for j, role in enumerate(traces.names):
        over_time, over_lag = axes[j]
        e = traces.measured[:, j] - traces.predicted[:, j]
        scale, unit = _axis_unit(traces, j, 3 * sds[j : j + 1])
        curve(over_time, t, e / scale, MEASURED, None)
        bound = NORMAL_99 * sds[j]
        for side in (-bound, bound):
            over_time.axhline(side / scale, color=BOUND, linewidth=1.0, linestyle="--")
        outside = 100 * float(np.mean(np.abs(e) > bound))
        over_time.set_ylabel(f"{role} [{unit}]")
        note(over_time, f"{outside:.2g} % outside (1 % expected)")
        rho = autocorrelation(e, _LAGS)
        limit = NORMAL_99 / np.sqrt(e.size)
        over_lag.vlines(np.arange(1, rho.size), 0, rho[1:], color=MEASURED, linewidth=1.4)
        over_lag.axhspan(-limit, limit, color=BAND, alpha=0.6, zorder=0)
        over_lag.axhline(0, color=MEASURED, linewidth=0.6)
        reach = max(3 * limit, 1.1 * float(np.max(np.abs(rho[1:]), initial=0.0)))
        over_lag.set_ylim(-reach, reach)
        grid(over_time, over_lag)
    axes[0, 0].set_title("innovations (measured - predicted) with 99 % bounds", fontsize=10)
    axes[0, 1].set_title("their autocorrelation with 99 % bounds of white noise", fontsize=10)
    axes[-1, 0].set_xlabel("time [s]")
    axes[-1, 1].set_xlabel("lag [samples]")


def _axis_unit(traces: Traces, j: int, values: Array) -> tuple[float, str]:
    return prefixed(float(np.max(np.abs(values))), traces.units[j])
