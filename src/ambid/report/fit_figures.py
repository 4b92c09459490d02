"""Figures of a black-box fit: measured and predicted, residuals with bounds, Bode with uncertainty, poles and zeros."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.response import one_step, simulation
from ambid.blackbox.spread import pole_covariance, zero_covariance
from ambid.blackbox.transfer_model import TransferModel
from ambid.report._drawing import BOUND, MEASURED, PREDICTED, grid, magnitude_axis, phase_axis, pole_region
from ambid.report._panels import Traces, residuals_panel, signals_panel
from ambid.report.fit_text import pole_lines
from ambid.report.response import Pole, Response
from ambid.validate.blackbox.predictor import innovations_form, plant_form

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


_PAIRS = 6  # Bode diagrams beside each other; of more pairs the first are drawn, and the title says so


def overview(fit: BlackBoxFit, data: IOData) -> Figure:
    """Draw all figures of a fit on one page.

    `data`: the record that it came from, or another.
    """
    from matplotlib.figure import Figure

    n_y, traces = data.n_outputs, traces_of(fit, data)
    parts: list[tuple[float, Any]] = [
        (2.3 * n_y, lambda part: signals_panel(part, traces)),
        (2.2 * n_y, lambda part: residuals_panel(part, traces)),
    ]
    if fit.inputs:
        parts.append((4.6, lambda part: _bode(part, fit)))
    parts.append((3.6, lambda part: _poles(part, fit)))
    heights = [h for h, _ in parts]
    pairs = min(_PAIRS, len(fit.inputs) * n_y)
    page = Figure(figsize=(max(11.0, 3.3 * pairs), sum(heights) + 0.5), layout="constrained")
    page.suptitle(f"{fit.record.get('file') or 'record'}: {fit.structure}", fontsize=13)
    figures: Any = page.subfigures(len(parts), 1, height_ratios=heights)
    for figure, (_, draw) in zip(figures, parts, strict=True):
        draw(figure)
    return page


def traces_of(fit: BlackBoxFit, data: IOData) -> Traces:
    """Run a record through a fit."""
    model = innovations_form(fit)
    return Traces(
        time_s=np.arange(data.n_samples, dtype=np.float64) * data.dt,
        names=data.outputs,
        units=tuple(fit.units[o] for o in data.outputs),
        measured=data.y,
        predicted=one_step(model, data.u, data.y, fit.offsets),
        simulated=simulation(plant_form(fit), data.u, data.y, fit.offsets),
        innovation_sd=np.sqrt(np.diag(fit.noise_covariance)),
    )


def responses(fit: BlackBoxFit, n_frequencies: int = 600) -> tuple[Response, ...]:
    """Compute the frequency response of every pair with its uncertainty, up to half the sampling rate.

    `n_frequencies`: spaced evenly in the logarithm, with more points at lightly damped poles. Returns output by output.
    """
    frequency = _frequencies(fit, n_frequencies)
    omega = 2 * np.pi * frequency
    G = fit.model.frequency_response(omega)
    log_sd, phase_sd = np.zeros(G.shape), np.zeros(G.shape)
    if fit.covariance is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = np.nan_to_num(fit.model.frequency_response_derivative(omega) / G[..., None])
        log_sd, phase_sd = (
            np.sqrt(np.maximum(np.einsum("...i,ij,...j->...", J, fit.covariance, J), 0.0))
            for J in (relative.real, relative.imag)
        )
    return tuple(
        Response(
            source=source,
            output=output,
            frequency_hz=frequency,
            value=G[:, o, i],
            log_sd=log_sd[:, o, i],
            phase_sd=phase_sd[:, o, i],
        )
        for o, output in enumerate(fit.outputs)
        for i, source in enumerate(fit.inputs)
    )


def _frequencies(fit: BlackBoxFit, n_frequencies: int) -> Array:
    nyquist = 0.5 / fit.dt
    lowest = max(1 / (int(str(fit.record["samples"])) * fit.dt), 1e-5 * nyquist)
    poles = fit.model.poles()
    s = poles if fit.model.dt is None else np.log(poles[np.abs(poles) > 0]) / fit.dt
    extra = [
        abs(p) / (2 * np.pi) + abs(p.real) / (2 * np.pi) * np.linspace(-5, 5, 41)
        for p in s
        if p.imag > 0 and lowest < abs(p) / (2 * np.pi) < nyquist
    ]
    found = np.unique(np.concatenate([np.geomspace(lowest, nyquist, n_frequencies), *extra]))
    return np.asarray(found[(found >= lowest) & (found <= nyquist)])


def _bode(figure: Figure | SubFigure, fit: BlackBoxFit) -> None:
    found = responses(fit)
    shown = found[:_PAIRS]
    axes = figure.subplots(2, len(shown), squeeze=False, sharex=True, height_ratios=(3, 2))
    for j, r in enumerate(shown):
        magnitude, phase = axes[:, j]
        magnitude_axis(magnitude, r)
        phase_axis(phase, r)
        if not j:
            phase.set_ylabel("phase [°]")
        magnitude.set_ylabel(f"magnitude [{fit.units[r.output]}/{fit.units[r.source]}]")
        phase.set_xlabel("frequency [Hz]")
        magnitude.set_title(f"{r.source} → {r.output}", fontsize=10)
        magnitude.legend(loc="lower left", fontsize=8, framealpha=0.85)
        grid(magnitude, phase)
    if len(found) > len(shown):
        figure.suptitle(f"{len(shown)} of {len(found)} pairs", fontsize=10)


def _poles(figure: Figure | SubFigure, fit: BlackBoxFit) -> None:
    """Poles and zeros with 95 % regions, and beside them the poles in numbers."""
    axes, beside = figure.subplots(1, 2, width_ratios=(3, 3))
    discrete = fit.model.dt is not None
    poles, zeros = fit.model.poles(), fit.model.zeros()
    spread = pole_covariance(fit.model, fit.covariance) if fit.covariance is not None else None
    for k, p in enumerate(poles):
        unstable = abs(p) > 1 if discrete else p.real > 0
        color = BOUND if unstable else PREDICTED
        axes.plot(p.real, p.imag, "x", color=color, markersize=8, markeredgewidth=1.8)
        _region(axes, p, None if spread is None else spread[k], color, 1e3)
    reach = 3 * max(1.0, float(np.max(np.abs(poles), initial=0.0)))
    near = np.abs(zeros) < reach
    seen = zeros[near]
    axes.plot(seen.real, seen.imag, "o", color=MEASURED, markersize=7, markerfacecolor="none", markeredgewidth=1.4)
    if fit.covariance is not None:
        for z, of_zero in zip(seen, zero_covariance(fit.model, fit.covariance)[near], strict=True):
            _region(axes, z, of_zero, MEASURED, reach)
    hidden = f"; {zeros.size - seen.size} zero(s) farther out" if seen.size < zeros.size else ""
    _stability(axes, discrete)
    delayed = isinstance(fit.model, TransferModel) and any(fit.model.delay)
    axes.set_title(f"poles (x) and zeros (o), 95 % regions{hidden}{', delay apart' if delayed else ''}", fontsize=10)
    grid(axes)
    beside.axis("off")
    text = "\n".join(pole_lines(fit))
    beside.text(0.0, 0.97, text, fontsize=9, va="top", family="monospace", transform=beside.transAxes)


def _region(axes: Axes, root: complex, covariance: Array | None, color: str, most: float) -> None:
    """Draw it where there is one, and not much wider than the figure: a multiple root has no spread of first order."""
    usable = covariance is not None and np.all(np.isfinite(covariance)) and np.max(np.abs(covariance)) < most**2
    pole_region(axes, Pole(value=complex(root), covariance=covariance if usable else None), color)


def _stability(axes: Axes, discrete: bool) -> None:
    axes.axhline(0, color=MEASURED, linewidth=0.8)
    if discrete:
        angle = np.linspace(0, 2 * np.pi, 361)
        axes.plot(np.cos(angle), np.sin(angle), color=MEASURED, linewidth=0.8)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("real part – outside the circle the plant is unstable")
        axes.set_ylabel("imaginary part")
        return
    axes.margins(0.15)
    axes.axvline(0, color=MEASURED, linewidth=0.8)
    axes.set_xlabel("real part [rad/s] – right of zero the plant is unstable")
    axes.set_ylabel("imaginary part [rad/s]")
