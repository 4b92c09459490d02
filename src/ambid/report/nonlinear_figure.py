"""Figures of a nonlinear fit: measured, predicted, simulated; residuals; correlations, nonlinear ones too; training."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.nonlinear.fit import NonlinearFit
from ambid.report._drawing import BAND, MEASURED, grid
from ambid.report._panels import Traces, residuals_panel, signals_panel
from ambid.report.nonlinear_panels import (
    Panel,
    band_panel,
    bars_height,
    bars_of,
    bars_panel,
    columns_of,
    records_panel,
)
from ambid.validate.nonlinear.judge import leaves_colour_open
from ambid.validate.nonlinear.residual_tests import Correlation, correlations, material
from ambid.validate.nonlinear.runs import run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


_ACROSS = 5  # correlations beside each other
_MOST = 20
_RECORDS = 6  # that are drawn


def nonlinear_overview(fit: NonlinearFit, records: Sequence[IOData], second: IOData | None = None) -> Figure:
    """Draw all figures of a nonlinear fit on one page.

    `fit`: with a model; `second`: a further record that it was judged on.
    """
    from matplotlib.figure import Figure

    if not records:
        raise EstimationError("there is no record to draw. Pass those that the fit was estimated from")
    panels = _panels(fit, records, second)
    parts = _signals(panels)
    bars = bars_of(fit)
    if bars is not None:
        parts.append((bars_height(bars), lambda part: bars_panel(part, bars)))
    if fit.covariance is not None and (bars is None or bars.n_others):
        where, data = ("the second record", second) if second is not None else (_name(records[0], 0), records[0])
        parts.append((0.9 + 2.1 * data.n_outputs, lambda part: band_panel(part, fit, data, where)))
    shown = correlations_of(fit, records)
    if shown:
        rows = -(-len(shown) // _ACROSS)
        parts.append((1.9 * rows + 0.4, lambda part: _correlations(part, shown)))
    if any(c.training.size for c in fit.curves):
        parts.append((3.0 + 0.1 * len(fit.curves), lambda part: _training(part, fit)))
    heights = [h for h, _ in parts]
    page = Figure(figsize=(11.0, sum(heights) + 0.5), layout="constrained")
    page.suptitle(_title(fit, records, second), fontsize=13)
    figures: Any = page.subfigures(len(parts), 1, height_ratios=heights)
    for figure, (_, draw) in zip(np.atleast_1d(figures), parts, strict=True):
        draw(figure)
    return page


def _title(fit: NonlinearFit, records: Sequence[IOData], second: IOData | None) -> str:
    what = _name(records[0], 0) if len(records) == 1 else f"{len(records)} records"
    more = f", judged on {_name(second, 0)} too" if second is not None else ""
    left = len(records) - _RECORDS
    hidden = f" (the first {_RECORDS} are drawn, {left} more are not)" if left > 0 else ""
    return f"{what}: {fit.structure}{more}{hidden}"


def _name(data: IOData, k: int) -> str:
    return str(data.record.get("file") or f"record {k + 1}")


def _panels(fit: NonlinearFit, records: Sequence[IOData], second: IOData | None) -> list[Panel]:
    out = [Panel(title=_name(x, k), traces=traces_of(fit, x)) for k, x in enumerate(records[:_RECORDS])]
    if second is not None:
        title = f"second record, not fitted: {second.record.get('file') or 'record'}"
        out.append(Panel(title=title, traces=traces_of(fit, second), second=True))
    return out


def _signals(panels: list[Panel]) -> list[tuple[float, Any]]:
    """One record large, with a close view; several beside each other."""
    n_y, only = len(panels[0].traces.names), panels[0].traces
    if len(panels) == 1:
        return [
            (2.3 * n_y, lambda part: signals_panel(part, only)),
            (2.2 * n_y, lambda part: residuals_panel(part, only)),
        ]
    down = -(-len(panels) // columns_of(len(panels)))
    return [(0.4 + (0.5 + 2.7 * n_y) * down, lambda part: records_panel(part, panels))]


def traces_of(fit: NonlinearFit, data: IOData) -> Traces:
    """Run a record through a fit, without the samples at the start that are not predicted.

    Returns no simulation where it diverges, or without inputs.
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


def correlations_of(fit: NonlinearFit, records: Sequence[IOData]) -> list[Correlation]:
    """Correlate the errors with what the residual tests look at.

    Returns over all records; empty where they are too short, or errors are not finite.
    """
    found = [run(fit, x) for x in records]
    if not all(x.finite for x in found):
        return []
    prepared = material(fit, records, found, coloured=leaves_colour_open(fit, records, found))
    return [] if prepared is None else correlations(prepared, records[0].inputs, records[0].outputs)[:_MOST]


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
