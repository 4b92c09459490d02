"""Figures of a nonlinear fit: measured, predicted, simulated; residuals; correlations, nonlinear ones too; training."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ambid.identify.blackbox.data import IOData
from ambid.identify.nonlinear.fit import NonlinearFit
from ambid.report._drawing import BAND, MEASURED, grid
from ambid.report._panels import Traces, residuals_panel, signals_panel
from ambid.validate.nonlinear.judge import leaves_colour_open
from ambid.validate.nonlinear.residual_tests import Correlation, correlations, material
from ambid.validate.nonlinear.runs import run

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

Array = NDArray[np.float64]

_ACROSS = 5  # correlations beside each other
_MOST = 20


def nonlinear_overview(fit: NonlinearFit, data: IOData) -> Figure:
    """Draw all figures of a nonlinear fit on one page.

    Parameters
    ----------
    fit : NonlinearFit
        With a model.
    data : IOData
        One of the records that it came from, or another.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    EstimationError
        If the fit has failed, or the record does not belong to it.
    """
    from matplotlib.figure import Figure

    traces, shown = traces_of(fit, data), correlations_of(fit, data)
    parts: list[tuple[float, Any]] = [
        (2.3 * data.n_outputs, lambda part: signals_panel(part, traces)),
        (2.2 * data.n_outputs, lambda part: residuals_panel(part, traces)),
    ]
    if shown:
        rows = -(-len(shown) // _ACROSS)
        parts.append((1.9 * rows + 0.4, lambda part: _correlations(part, shown)))
    if fit.curves:
        parts.append((3.0, lambda part: _training(part, fit)))
    heights = [h for h, _ in parts]
    page = Figure(figsize=(11.0, sum(heights) + 0.5), layout="constrained")
    page.suptitle(f"{data.record.get('file') or 'record'}: {fit.structure}", fontsize=13)
    figures: Any = page.subfigures(len(parts), 1, height_ratios=heights)
    for figure, (_, draw) in zip(np.atleast_1d(figures), parts, strict=True):
        draw(figure)
    return page


def traces_of(fit: NonlinearFit, data: IOData) -> Traces:
    """Run a record through a fit, without the samples at the start that are not predicted.

    Parameters
    ----------
    fit : NonlinearFit
    data : IOData

    Returns
    -------
    Traces
        No simulation where it diverges, or without inputs.
    """
    found = run(fit, data)
    first = found.lag
    free = None if found.simulation is None or found.diverges_at is not None else data.y - found.simulation
    return Traces(
        time_s=np.arange(first, data.n_samples, dtype=np.float64) * data.dt,
        names=data.outputs,
        units=tuple(fit.units[o] for o in data.outputs),
        measured=data.y[first:],
        predicted=(data.y - found.one_step)[first:],
        simulated=None if free is None else free[first:],
        innovation_sd=np.sqrt(np.maximum(np.diag(fit.noise_covariance), 0.0)),
    )


def correlations_of(fit: NonlinearFit, data: IOData) -> list[Correlation]:
    """Correlate the errors with what the residual tests look at.

    Parameters
    ----------
    fit : NonlinearFit
    data : IOData

    Returns
    -------
    list of Correlation
        Empty where the record is too short, or the errors are not finite.
    """
    found = run(fit, data)
    if not found.finite:
        return []
    prepared = material(fit, [data], [found], coloured=leaves_colour_open(fit, [data], [found]))
    return [] if prepared is None else correlations(prepared, data.inputs, data.outputs)[:_MOST]


def _correlations(figure: Figure | SubFigure, shown: list[Correlation]) -> None:
    rows = -(-len(shown) // _ACROSS)
    axes = figure.subplots(rows, min(_ACROSS, len(shown)), squeeze=False, sharex=True)
    for a in axes.flat[len(shown) :]:
        a.axis("off")
    for a, c in zip(axes.flat, shown, strict=False):
        a.fill_between(c.lags, -c.band, c.band, color=BAND, alpha=0.6, linewidth=0, zorder=0)
        a.vlines(c.lags, 0, c.values, color=MEASURED, linewidth=1.4)
        a.axhline(0, color=MEASURED, linewidth=0.6)
        a.set_title(c.title, fontsize=9)
        a.tick_params(labelsize=8)
        grid(a)
    figure.suptitle("correlations over the lag in samples, with 99 % bounds (Billings and Voon 1986)", fontsize=10)


def _training(figure: Figure | SubFigure, fit: NonlinearFit) -> None:
    by_time, by_step = figure.subplots(1, 2, sharey=True)
    positive = [float(t) for c in fit.curves for t in c.seconds if t > 0]
    earliest = min(positive, default=1.0) / 2  # a logarithm has no zero
    for k, c in enumerate(fit.curves):
        color, seconds = f"C{k % 10}", np.maximum(c.seconds, earliest)
        by_time.plot(seconds, c.training, ".-", color=color, markersize=3, linewidth=1.0, label=c.method)
        by_step.plot(np.arange(c.training.size), c.training, ".-", color=color, markersize=3, linewidth=1.0)
        if c.held_out.size == c.training.size:
            by_time.plot(seconds, c.held_out, "--", color=color, linewidth=0.9)
            by_step.plot(np.arange(c.training.size), c.held_out, "--", color=color, linewidth=0.9)
    by_time.set_xlabel("time [s]")
    by_step.set_xlabel("iteration")
    by_time.set_xscale("log")
    by_time.set_yscale("log")
    by_time.set_ylabel("rms error / sd of output")
    by_time.set_title("learning curves (dashed: held out)", fontsize=10)
    by_time.legend(loc="upper right", fontsize=8, framealpha=0.85)
    grid(by_time, by_step)
