"""Panels of linear models: Bode diagrams with what was measured, poles and zeros, correlations of parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.bearing.measured import ModelResponse
from ambid.estimation.result import NORMAL_95
from ambid.report.drawing import BAND, BOUND, MEASURED, PREDICTED, Block, Panel, head, panel
from ambid.report.numbers import response_unit
from ambid.signals.response import FrequencyResponse

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Complex = NDArray[np.complex128]
Pair = tuple[int, int]  # output, input

MOST_PAIRS = 6  # Bode diagrams beside each other; of more pairs the first are drawn, and the title says so
_CHI2_95 = 5.991464547107979  # of two degrees of freedom
_NEAR = 0.06  # of the span of all poles, from which two of them lie too close
_MARKS = 18  # frequencies of each decade at which a measured response stands beside a model


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pole:
    """A pole or zero with the covariance of its real and imaginary part; None where it has none of first order."""

    value: complex
    covariance: Array | None  # (2, 2)


def roots(values: Complex, covariance: Array | None, most: float) -> list[Pole]:
    """Return roots with their spread where it is less than `most`: that of a multiple root is infinite."""
    if covariance is None:
        return [Pole(value=complex(x), covariance=None) for x in values]
    usable = [bool(np.all(np.isfinite(c)) and np.max(np.abs(c)) < most**2) for c in covariance]
    return [
        Pole(value=complex(x), covariance=c if use else None)
        for x, c, use in zip(values, covariance, usable, strict=True)
    ]


def frequency_grid(poles: Complex | Array, lowest_hz: float, nyquist_hz: float, n_frequencies: int = 600) -> Array:
    """Return frequencies in Hz, even in the logarithm, with more points at lightly damped poles (rad/s)."""
    extra = [
        abs(p) / (2 * np.pi) + abs(p.real) / (2 * np.pi) * np.linspace(-5, 5, 41)
        for p in poles
        if p.imag > 0 and lowest_hz < abs(p) / (2 * np.pi) < nyquist_hz
    ]
    grid = np.unique(np.concatenate([np.geomspace(lowest_hz, nyquist_hz, n_frequencies), *extra]))
    return np.asarray(grid[(grid >= lowest_hz) & (grid <= nyquist_hz)])


def bode_panel(
    r: ModelResponse,
    inputs: Sequence[str],
    outputs: Sequence[str],
    units: Mapping[str, str],
    asides: Mapping[str, str] | None = None,
    measured: FrequencyResponse | None = None,
) -> Block:
    """Draw magnitude and phase of the first pairs with 95 % bands; `asides` by input stand in the titles.

    `measured`: the same response without a model, drawn as points with their 95 % intervals where it is known.
    """

    def magnitude(axes: Axes, pair: Pair) -> None:
        magnitude_axis(axes, r, pair)
        if measured is not None:
            marks(axes, measured, pair)

    def phase(axes: Axes, pair: Pair) -> None:
        phase_axis(axes, r, pair)
        if measured is not None:
            marks(axes, measured, pair, guide=r)

    return pairs_panel(magnitude, phase, inputs, outputs, units, asides)


def pairs_panel(
    magnitude: Callable[[Axes, Pair], object],
    phase: Callable[[Axes, Pair], object],
    inputs: Sequence[str],
    outputs: Sequence[str],
    units: Mapping[str, str],
    asides: Mapping[str, str] | None = None,
) -> Block:
    """Return a column of magnitude and phase for each of the first pairs (output, input), with titles and units."""
    pairs = [(o, i) for o in range(len(outputs)) for i in range(len(inputs))]
    first_pairs = pairs[:MOST_PAIRS]

    def above(axes: Axes, pair: Pair) -> None:
        source, output = inputs[pair[1]], outputs[pair[0]]
        magnitude(axes, pair)
        axes.set_ylabel(f"magnitude [{response_unit(units, output, source)}]")
        head(axes, f"{source} → {output}{(asides or {}).get(source, '')}")

    def below(axes: Axes, pair: Pair) -> None:
        phase(axes, pair)
        axes.set_ylabel("phase [°]")
        axes.set_xlabel("frequency [Hz]")

    columns = [[panel(above, x, height=2.5), panel(below, x, height=1.8)] for x in first_pairs]
    return Block(
        columns=columns, title=f"{len(first_pairs)} of {len(pairs)} pairs" if len(pairs) > len(first_pairs) else ""
    )


def magnitude_axis(
    axes: Axes,
    r: ModelResponse,
    pair: Pair,
    *,
    label: str = "identified plant",
    band_label: str = "95 % interval",
    colors: tuple[str, str] = (PREDICTED, BAND),
    style: str = "-",
) -> None:
    """Draw the magnitude of a response with its 95 % band."""
    size = np.abs(r.G[:, *pair])
    spread = np.exp(np.minimum(NORMAL_95 * r.log_sd[:, *pair], 20.0))
    axes.fill_between(r.frequency_hz, size / spread, size * spread, color=colors[1], label=band_label, linewidth=0)
    axes.loglog(r.frequency_hz, size, color=colors[0], linewidth=1.4, label=label, linestyle=style)
    axes.set_xlim(r.frequency_hz[0], r.frequency_hz[-1])
    axes.set_ylim(0.5 * size.min(), 2 * size.max())


def marks(
    axes: Axes, frf: FrequencyResponse, pair: Pair, guide: ModelResponse | None = None, *, per_decade: int = _MARKS
) -> None:
    """Draw some lines of a measured response with 95 % intervals, where it is known: magnitudes, or, with a `guide`
    whose turn they take, phases.
    """
    radius = frf.confidence_radius()[:, *pair]
    finite = np.flatnonzero(np.isfinite(radius) & (frf.frequency_hz > 0))
    if not finite.size:
        return
    f = frf.frequency_hz[finite]
    at = finite[
        np.unique(
            np.searchsorted(f, np.geomspace(f[0], f[-1], 2 + int(per_decade * np.log10(f[-1] / f[0])))).clip(
                max=f.size - 1
            )
        )
    ]
    x, G, radius = frf.frequency_hz[at], frf.G[at, *pair], radius[at]
    size, spread = np.abs(G), [np.minimum(radius, 0.999 * np.abs(G)), radius]
    if guide is not None:
        angle = unwrapped(guide.G[:, *pair])
        near = np.interp(np.log(x), np.log(guide.frequency_hz), angle)
        half = np.rad2deg(np.arcsin(np.minimum(radius / np.maximum(size, 1e-300), 1.0)))
        visible = half < 90
        x, half = x[visible], half[visible]
        size, spread = np.rad2deg(near + np.angle(G * np.exp(-1j * near)))[visible], [half, half]
        angle_ticks(axes, np.concatenate([np.rad2deg(angle), size]))
    axes.errorbar(
        x, size, spread, fmt="o", markersize=2.4, color=MEASURED, elinewidth=0.8, label="measured, 95 %", zorder=1.9
    )


def unwrapped(value: Complex, near: float = 0.0, valid: NDArray[np.bool_] | None = None) -> Array:
    """Phase in rad without jumps, shape (n_frequencies,), begun within half a turn of `near`.

    `valid`: where noise leaves the phase known; elsewhere it stands within half a turn of its neighbours, since noise
    that is unwrapped walks away.
    """
    at = np.arange(value.size) if valid is None or not valid.any() else np.flatnonzero(valid)
    line = np.unwrap(np.angle(value[at]))
    guide = np.interp(np.arange(value.size), at, line - 2 * np.pi * np.round((line[0] - near) / (2 * np.pi)))
    return np.asarray(guide + np.angle(value * np.exp(-1j * guide)))


def phase_axis(
    axes: Axes,
    r: ModelResponse,
    pair: Pair,
    *,
    near: float = 0.0,
    colors: tuple[str, str] = (PREDICTED, BAND),
    style: str = "-",
) -> None:
    """Draw the phase of a response with its 95 % band, begun within half a turn of `near` (rad)."""
    angle = unwrapped(r.G[:, *pair], near)
    spread = np.minimum(NORMAL_95 * r.phase_sd[:, *pair], np.pi)
    low, high = np.rad2deg(angle - spread), np.rad2deg(angle + spread)
    axes.fill_between(r.frequency_hz, low, high, color=colors[1], linewidth=0)
    axes.semilogx(r.frequency_hz, np.rad2deg(angle), color=colors[0], linewidth=1.4, linestyle=style)
    axes.set_xlim(r.frequency_hz[0], r.frequency_hz[-1])
    angle_ticks(axes, np.rad2deg(angle))


def angle_ticks(axes: Axes, degrees: Array) -> None:
    """Let an axis hold angles, with ticks at whole parts of a turn."""
    first, last = 45 * np.floor(degrees.min() / 45 - 0.3), 45 * np.ceil(degrees.max() / 45 + 0.3)
    step = 45 if last - first <= 180 else 90 if last - first <= 720 else 180 * np.ceil((last - first) / 1440)
    axes.set_ylim(first, last)
    axes.set_yticks(np.arange(step * np.ceil(first / step), last + 1, step))


def pole_region(axes: Axes, pole: Pole, color: str) -> None:
    """Draw the 95 % region of a pole or zero; of a real one an interval."""
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


def poles_panel(poles: Sequence[Pole], title: str, *, zeros: Sequence[Pole] = (), discrete: bool = False) -> Block:
    """Draw poles and zeros with their 95 % regions and the border of stability, and close views.

    Poles that lie too close to be separated on the scale of all of them are drawn again, larger.
    """

    def every(axes: Axes) -> None:
        _roots(axes, poles, zeros, discrete=discrete)
        axes.margins(0.15)
        if discrete:
            axes.set_aspect("equal", adjustable="datalim")
        else:
            low, high = axes.get_xlim()
            axes.set_xlim(low, max(high, 0.15 * -low))
        head(axes, title)

    def close(axes: Axes) -> None:
        _roots(axes, poles, zeros, discrete=discrete)
        (left, right), (low, high) = _window(crowd)
        axes.set_xlim(left, right)
        axes.set_ylim(low, high)
        head(axes, f"close view of {len(crowd)} of them")

    crowd = _crowd([p.value for p in (*poles, *zeros)])
    views = (every, close) if crowd else (every,)
    return Block(columns=[[Panel(draw=view, height=3.0)] for view in views], widths=(4, 3)[: len(views)], shared=False)


def _crowd(values: Sequence[complex]) -> list[complex]:
    """Roots that have a neighbour too near for the scale of all: those about the largest such group."""
    span = max((abs(a - b) for a in values for b in values), default=0.0)
    groups = [[b for b in values if abs(a - b) < _NEAR * span] for a in values]
    return max((g for g in groups if len(g) > 1 and max(abs(a - g[0]) for a in g) > 0), key=len, default=[])


def _window(crowd: Sequence[complex]) -> list[tuple[float, float]]:
    """Limits of the real and the imaginary part around some roots, of one size, so that circles stay round."""
    real, imaginary = [x.real for x in crowd], [x.imag for x in crowd]
    half = 0.75 * max(max(real) - min(real), max(imaginary) - min(imaginary))
    return [((min(x) + max(x)) / 2 - half, (min(x) + max(x)) / 2 + half) for x in (real, imaginary)]


def _roots(axes: Axes, poles: Sequence[Pole], zeros: Sequence[Pole], *, discrete: bool) -> None:
    """Poles, zeros, their regions and the border of stability; unstable poles in the colour of a warning."""
    for pole in poles:
        p = pole.value
        unstable = abs(p) > 1 if discrete else p.real > 0
        color, label = (BOUND, "unstable pole") if unstable else (PREDICTED, "pole")
        axes.plot(p.real, p.imag, "x", color=color, markersize=8, markeredgewidth=1.8, label=label)
        pole_region(axes, pole, color)
    for zero in zeros:
        z = zero.value
        axes.plot(z.real, z.imag, "o", color=MEASURED, markersize=7, markerfacecolor="none", label="zero")
        pole_region(axes, zero, MEASURED)
    axes.axhline(0, color=MEASURED, linewidth=0.8)
    if discrete:
        angle = np.linspace(0, 2 * np.pi, 3601)
        axes.plot(np.cos(angle), np.sin(angle), color=MEASURED, linewidth=0.8, label="border of stability")
    else:
        axes.axvline(0, color=MEASURED, linewidth=0.8, label="border of stability")
    unit = "" if discrete else " [rad/s]"
    axes.set_xlabel(f"real part{unit}")
    axes.set_ylabel(f"imaginary part{unit}")
