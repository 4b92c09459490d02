"""What several figures draw alike: curves, bands, correlations, Bode diagrams, poles with their regions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.report.numbers import prefixed, quantity
from ambid.report.response import Pole, Response

if TYPE_CHECKING:
    from matplotlib.axes import Axes


MEASURED, PREDICTED, BAND, BOUND = "#444444", "#0b6fb8", "#9ecae8", "#c0392b"
NORMAL_95, NORMAL_99 = 1.959963984540054, 2.5758293035489004
_CHI2_95 = 5.991464547107979  # of two degrees of freedom
_PIXELS = 1200  # samples from which a curve is drawn as the band of its extremes
_ZOOM = 240  # samples of a close view


def curve(axes: Axes, t: Array, y: Array, color: str, label: str | None) -> None:
    """Draw a curve, or, where there are more samples than the paper shows, the band between its extremes."""
    options: dict[str, Any] = {} if label is None else {"label": label}
    if y.size <= 2 * _PIXELS:
        axes.plot(t, y, color=color, linewidth=0.8, **options)
        return
    edges = np.linspace(0, y.size, _PIXELS + 1).astype(int)[:-1]
    low, high = np.minimum.reduceat(y, edges), np.maximum.reduceat(y, edges)
    axes.fill_between(t[edges], low, high, color=color, linewidth=0.4, alpha=0.75, **options)


def worst_stretch(e: Array) -> tuple[int, int]:
    """First and last sample of the stretch with the largest errors, each output counted in its own spread."""
    length = min(_ZOOM, e.shape[0])
    size = np.sum((e / np.maximum(e.std(axis=0), 1e-300)) ** 2, axis=1)
    total = np.concatenate([[0.0], np.cumsum(size)])
    first = int(np.argmax(total[length:] - total[:-length]))
    return first, first + length


def autocorrelation(e: Array, n_lags: int) -> Array:
    """Return the autocorrelation coefficients of a signal of mean near zero.

    `e`: (n_samples,), such as innovations; `n_lags`: largest lag; at most n_samples - 1 are given. Returns (n_lags +
    1,), the first is 1.
    """
    power = float(e @ e)
    lags = range(1, min(n_lags, e.size - 1) + 1)
    return np.array([1.0, *(float(e[k:] @ e[:-k]) / power for k in lags)])


def magnitude_axis(
    axes: Axes,
    r: Response,
    *,
    label: str = "identified plant",
    band_label: str | None = None,
    colors: tuple[str, str] = (PREDICTED, BAND),
) -> None:
    size = np.abs(r.value)
    spread = np.exp(np.minimum(NORMAL_95 * r.log_sd, 20.0))
    about = band_label or f"95 % band (median ± {100 * (float(np.median(spread)) - 1):.2g} %)"
    axes.fill_between(r.frequency_hz, size / spread, size * spread, color=colors[1], label=about, linewidth=0)
    axes.loglog(r.frequency_hz, size, color=colors[0], linewidth=1.4, label=label)
    axes.set_xlim(r.frequency_hz[0], r.frequency_hz[-1])
    axes.set_ylim(0.5 * size.min(), 2 * size.max())


def unwrapped(value: NDArray[np.complex128], near: float = 0.0) -> Array:
    """Phase in rad without jumps, shape (n_frequencies,), begun within half a turn of `near`."""
    angle = np.unwrap(np.angle(value))
    return np.asarray(angle - 2 * np.pi * np.round((angle[0] - near) / (2 * np.pi)))


def phase_axis(axes: Axes, r: Response, *, near: float = 0.0, colors: tuple[str, str] = (PREDICTED, BAND)) -> None:
    angle = unwrapped(r.value, near)
    spread = np.minimum(NORMAL_95 * r.phase_sd, np.pi)
    low, high = np.rad2deg(angle - spread), np.rad2deg(angle + spread)
    axes.fill_between(r.frequency_hz, low, high, color=colors[1], linewidth=0)
    axes.semilogx(r.frequency_hz, np.rad2deg(angle), color=colors[0], linewidth=1.4)
    middle = np.rad2deg(angle)
    first, last = 45 * np.floor(middle.min() / 45 - 0.3), 45 * np.ceil(middle.max() / 45 + 0.3)
    step = 90 if last - first > 180 else 45
    axes.set_ylim(first, last)
    axes.set_yticks(np.arange(step * np.ceil(first / step), last + 1, step))


def pole_region(axes: Axes, pole: Pole, color: str) -> None:
    from matplotlib.patches import Ellipse

    if pole.covariance is None:
        return
    if abs(pole.value.imag) == 0:
        reach = NORMAL_95 * float(np.sqrt(pole.covariance[0, 0]))
        axes.plot([pole.value.real - reach, pole.value.real + reach], [0, 0], color=color, linewidth=4, alpha=0.35)
        return
    size, direction = np.linalg.eigh(pole.covariance)
    width, height = 2 * np.sqrt(_CHI2_95 * np.maximum(size, 0.0))
    angle = float(np.rad2deg(np.arctan2(direction[1, 0], direction[0, 0])))
    centre = (pole.value.real, pole.value.imag)
    axes.add_patch(Ellipse(centre, width, height, angle=angle, facecolor=color, alpha=0.35, linewidth=0))


def pole_words(pole: Pole) -> list[str]:
    spread = np.zeros(2) if pole.covariance is None else np.sqrt(np.maximum(np.diag(pole.covariance), 0.0))
    real = quantity(pole.value.real, float(spread[0]), "1").text.removesuffix(" 1")
    if pole.value.imag == 0:
        state = "unstable" if pole.value.real > 0 else "stable"
        return [
            real,
            f"    {state}, time constant {_seconds(1 / abs(pole.value.real))}" if pole.value.real else "    integrator",
            "",
        ]
    imaginary = quantity(pole.value.imag, float(spread[1]), "1").text.removesuffix(" 1")
    size = abs(pole.value)
    return [
        f"{real}",
        f"  ± j({imaginary})",
        f"    {size / (2 * np.pi):.4g} Hz, damping {-pole.value.real / size:.3g}",
        "",
    ]


def _seconds(t: float) -> str:
    scale, unit = prefixed(t, "s")
    return f"{t / scale:.3g} {unit}"


def note(axes: Axes, text: str) -> None:
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5}
    axes.text(0.995, 0.97, text, transform=axes.transAxes, fontsize=8, ha="right", va="top", bbox=box)


def grid(*axes: Axes) -> None:
    for a in axes:
        a.grid(True, color="#dddddd", linewidth=0.6)
        a.set_axisbelow(True)  # bands of long records would have lines across
        a.tick_params(labelsize=9)
