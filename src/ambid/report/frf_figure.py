"""Figure of a measured frequency response: lines with 95 % bands, noise and distortion, the fitted models over it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.frequency.measured import Measured, ModelResponse, model_responses
from ambid.report._drawing import BAND, BOUND, MEASURED, PREDICTED, grid, magnitude_axis, phase_axis, unwrapped
from ambid.report.frf_text import response_unit
from ambid.report.response import Response

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_PAIRS = 6  # diagrams beside each other; of more pairs the first are drawn, and the title says so
_NOISE, _DISTORTION, _RANGE = "#5f9a3f", "#d58a1f", "#d4d4d4"
_MODELS: tuple[tuple[str, str, Literal["-", "--"]], ...] = (
    (PREDICTED, BAND, "-"),
    (BOUND, "#f1c4be", "--"),
)  # line and band of the black-box fit and of the physical parameters
_GRID = 800  # frequencies at which a model is drawn


def figure(measured: Measured) -> Figure:
    """Draw magnitude and phase of every pair."""
    from matplotlib.figure import Figure

    frf = measured.response
    pairs = [(j, k) for j in range(frf.n_outputs) for k in range(frf.n_inputs)]
    shown, f = pairs[:_PAIRS], frf.frequency_hz
    models = model_responses(measured, np.geomspace(f[0], f[-1], _GRID)) if f.size > 1 else ()
    page = Figure(figsize=(max(8.0, 5.5 * len(shown)), 7.0), layout="constrained")
    axes = page.subplots(2, len(shown), squeeze=False, sharex=True, height_ratios=(3, 2))
    for column, (j, k) in enumerate(shown):
        magnitude, phase = axes[:, column]
        _magnitude(magnitude, measured, models, j, k)
        _phase(phase, measured, models, j, k)
        magnitude.set_title(f"{frf.inputs[k]} → {frf.outputs[j]}", fontsize=10)
        magnitude.set_ylabel(f"magnitude [{response_unit(frf.units, frf.outputs[j], frf.inputs[k])}]")
        phase.set_xlabel("frequency [Hz]")
        grid(magnitude, phase)
    axes[1, 0].set_ylabel("phase [°]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    page.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 3), fontsize=9)
    name = measured.record.get("file") or "record"
    some = f" ({len(shown)} of {len(pairs)} pairs)" if len(pairs) > len(shown) else ""
    page.suptitle(f"{name}: frequency response, {frf.method}{some}", fontsize=12)
    return page


def _magnitude(axes: Axes, measured: Measured, models: tuple[ModelResponse, ...], j: int, k: int) -> None:
    """Measured lines with their band, the levels under them, the models over them."""
    frf = measured.response
    f, size, radius = frf.frequency_hz, frf.magnitude[:, j, k], frf.confidence_radius()[:, j, k]
    noise = None if frf.noise_sd is None else frf.noise_sd[:, j, k]
    distortion = None if measured.distortion_sd is None else measured.distortion_sd[:, j, k]
    levels = [(frf.sd[:, j, k], _NOISE, "sd of measured")] if distortion is None else []
    levels += [(noise, _NOISE, "noise sd")] if distortion is not None and noise is not None else []
    levels += [(distortion, _DISTORTION, "distortion sd")] if distortion is not None else []
    drawn = [x[x > 0] for x, _, _ in levels if np.any(x > 0)]
    bottom = 0.5 * min([float(size[size > 0].min()), *(float(np.percentile(x, 2)) for x in drawn)])
    top = 2.0 * float(np.max(size))
    axes.fill_between(
        f, np.maximum(size - radius, 0.1 * bottom), size + radius, color=_RANGE, linewidth=0, label="measured, 95 %"
    )
    for m, (line, band, style) in zip(models, _MODELS, strict=False):
        magnitude_axis(axes, _pair(m, j, k), label=m.source, band_label=f"{m.source}, 95 %", colors=(line, band))
        axes.lines[-1].set_linestyle(style)
    axes.plot(f, size, ".", color=MEASURED, markersize=_marker(f.size), label="measured", zorder=1.8)
    for x, color, label in levels:
        axes.plot(
            f, np.where(x > 0, x, np.nan), ".", color=color, markersize=0.8 * _marker(f.size), label=label, zorder=1.7
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    if f.size > 1:
        axes.set_xlim(f[0], f[-1])
    axes.set_ylim(bottom, top)


def _phase(axes: Axes, measured: Measured, models: tuple[ModelResponse, ...], j: int, k: int) -> None:
    """Phase, unwrapped beginning near zero; where |G| is lost in its sd the band is all angles."""
    frf = measured.response
    f, size, radius = frf.frequency_hz, frf.magnitude[:, j, k], frf.confidence_radius()[:, j, k]
    angle = np.rad2deg(_angle(frf.G[:, j, k], f, models, j, k))
    ratio = np.minimum(radius / np.maximum(size, 1e-300), 1.0)
    spread = np.where(ratio < 1, np.rad2deg(np.arcsin(ratio)), 180.0)
    near = float(unwrapped(models[0].G[:, j, k])[0]) if models else 0.0  # a phase near ±180° begins on one side
    curves = [np.rad2deg(unwrapped(m.G[:, j, k], near)) for m in models]
    for m, (line, band, style) in zip(models, _MODELS, strict=False):
        phase_axis(axes, _pair(m, j, k), near=near, colors=(line, band))
        axes.lines[-1].set_linestyle(style)
    axes.fill_between(f, angle - spread, angle + spread, color=_RANGE, linewidth=0, zorder=0.5)
    axes.plot(f, angle, ".", color=MEASURED, markersize=_marker(f.size), zorder=1.8)
    axes.set_xscale("log")
    middle = np.concatenate([angle[ratio < 0.5] if np.any(ratio < 0.5) else angle, *curves])
    first, last = 45 * np.floor(middle.min() / 45 - 0.3), 45 * np.ceil(middle.max() / 45 + 0.3)
    step = 45 if last - first <= 180 else 90 if last - first <= 720 else 180 * np.ceil((last - first) / 1440)
    axes.set_ylim(first, last)
    axes.set_yticks(np.arange(step * np.ceil(first / step), last + 1, step))


def _angle(G: NDArray[np.complex128], f: Array, models: tuple[ModelResponse, ...], j: int, k: int) -> Array:
    """Phase of the lines in rad: the turn nearest to a model's, which noise does not make jump."""
    if not models:
        return unwrapped(G)
    near = np.interp(f, models[0].frequency_hz, unwrapped(models[0].G[:, j, k]))
    return np.asarray(near + np.angle(G * np.exp(-1j * near)))


def _pair(m: ModelResponse, j: int, k: int) -> Response:
    return Response(
        source="",
        output="",
        frequency_hz=m.frequency_hz,
        value=m.G[:, j, k],
        log_sd=m.log_sd[:, j, k],
        phase_sd=m.phase_sd[:, j, k],
    )


def _marker(n: int) -> float:
    return 4.0 if n <= 300 else 2.0 if n <= 3000 else 1.0
