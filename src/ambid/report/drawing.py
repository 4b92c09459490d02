"""What all figures are made of: pages, curves, bands, signals, residuals, Bode diagrams, poles with their regions.

Everything is drawn on `matplotlib.figure.Figure` objects, without pyplot: no window system, no global state.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.bearing.measured import ModelResponse
from ambid.estimation.result import Verdict
from ambid.report.numbers import prefixed, response_unit
from ambid.report.text import WORDS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    Draw = Callable[[Figure | SubFigure], object]

Complex = NDArray[np.complex128]
Pair = tuple[int, int]  # output, input

MEASURED, PREDICTED, BAND, BOUND = "#444444", "#0b6fb8", "#9ecae8", "#c0392b"
NORMAL_95, NORMAL_99 = 1.959963984540054, 2.5758293035489004
FIGURE_ENDINGS = (".png", ".svg", ".pdf")
STYLES = {"good": "#1b7837", "doubt": "#b35900", "bad": "#b2182b"}
_NAMED = 6  # reasons that stand in a figure
_CHI2_95 = 5.991464547107979  # of two degrees of freedom
PIXELS = 1200  # samples from which a curve is drawn as the band of its extremes
_ZOOM = 240  # samples of a close view
_LAGS = 50
MOST_PAIRS = 6  # Bode diagrams beside each other; of more pairs the first are drawn, and the title says so


def stacked(title: str, parts: Sequence[tuple[float, Draw]], width: float = 11.0) -> Figure:
    """Return a page of drawings, one below the other, each with its height in inches."""
    from matplotlib.figure import Figure

    heights = [height for height, _ in parts]
    page = Figure(figsize=(width, sum(heights) + 0.5), layout="constrained")
    page.suptitle(title, fontsize=13)
    places: Any = page.subfigures(len(parts), 1, height_ratios=heights)
    for place, (_, draw) in zip(np.atleast_1d(places), parts, strict=True):
        draw(place)
    return page


def judged(figure: Figure, found: Verdict) -> Figure:
    """Put the verdict above a figure: its word in colour, and the names of the checks that speak against it."""
    from matplotlib.offsetbox import AnchoredOffsetbox, HPacker, TextArea

    words, style = WORDS[found.word]
    names = ", ".join(r.check for r in found.reasons[:_NAMED]) + (", …" if len(found.reasons) > _NAMED else "")
    parts = [
        ("verdict: ", {}),
        (words, {"color": STYLES[style], "weight": "bold"}),
        (f" – {names}" if names else "", {}),
    ]
    line = HPacker(children=[TextArea(x, textprops={"size": 10, **how}) for x, how in parts], pad=0, sep=0)
    box = AnchoredOffsetbox(
        "upper left", child=line, frameon=False, bbox_to_anchor=(0.0, 1.0), bbox_transform=figure.transFigure
    )
    box.set_in_layout(False)
    figure.add_artist(box)
    figure.suptitle(f"\n{figure.get_suptitle()}", fontsize=12)  # the empty line is its place
    return figure


def single(height: float, draw: Draw) -> Figure:
    """Return one drawing as a figure."""
    from matplotlib.figure import Figure

    page = Figure(figsize=(11.0, height + 0.1), layout="constrained")
    draw(page)
    return page


def save(figure: Figure, target: str | Path | BinaryIO, *, kind: str | None = None) -> None:
    """Write a figure.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        What to write.
    target : str, Path or binary file
        ``.png``, ``.svg`` or ``.pdf``.
    kind : str, optional
        Format, where the name does not tell it.
    """
    # no date inside: equal estimates give equal files
    dates = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    ending = kind or Path(str(target)).suffix.lower().removeprefix(".")
    figure.savefig(target, dpi=130, format=ending, metadata=dates.get(ending))


def curve(
    axes: Axes,
    t: Array,
    y: Array,
    color: str,
    label: str | None,
    *,
    linewidth: float = 0.8,
    alpha: float = 0.75,
    zorder: float | None = None,
) -> None:
    """Draw a curve, or, where there are more samples than the paper shows, the band between its extremes."""
    options: dict[str, Any] = {"color": color} | ({} if label is None else {"label": label})
    options |= {} if zorder is None else {"zorder": zorder}
    if y.size <= 2 * PIXELS:
        axes.plot(t, y, linewidth=linewidth, **options)
    else:
        axes.fill_between(*extremes(t, y, y), linewidth=linewidth / 2, alpha=alpha, **options)


def extremes(t: Array, low: Array, high: Array) -> tuple[Array, Array, Array]:
    """Return a band as the extremes of as many stretches as the paper shows, where it has more samples."""
    if t.size <= 2 * PIXELS:
        return t, low, high
    edges = np.linspace(0, t.size, PIXELS + 1).astype(int)[:-1]
    return t[edges], np.fmin.reduceat(low, edges), np.fmax.reduceat(high, edges)


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Traces:
    """Outputs of one record beside what a model says of them, SI."""

    time_s: Array  # (n_samples,), s
    names: tuple[str, ...]  # of the outputs
    units: tuple[str, ...]
    measured: Array  # (n_samples, n_outputs), and predicted one step ahead; NaN for what is not predicted
    predicted: Array
    # of the errors, as the model says: (n_outputs,), or (n_samples, n_outputs) where it varies
    sd: Array
    simulated: Array | None = None  # (n_samples, n_outputs)
    title: str = ""  # which record it is, where several are drawn
    second: bool = False  # whether the fit has not seen it


def signals_panel(figure: Figure | SubFigure, traces: Traces) -> None:
    """Measured against predicted: the whole record, and the stretch with the largest errors."""
    t = traces.time_s
    axes = figure.subplots(len(traces.names), 2, squeeze=False, width_ratios=(3, 2), sharex="col")
    first, last = worst_stretch(traces.measured - traces.predicted)
    for j, (whole, zoom) in enumerate(axes):
        scale = _outputs(whole, traces, j, simulation=False)
        y, p = traces.measured[first:last, j] / scale, traces.predicted[first:last, j] / scale
        zoom.plot(t[first:last], y, ".", color=MEASURED, markersize=3.5)
        zoom.plot(t[first:last], p, "-", color=PREDICTED, linewidth=1.0)
        if traces.simulated is not None:
            simulated = traces.simulated[first:last, j] / scale
            zoom.plot(t[first:last], simulated, "--", color=BOUND, linewidth=0.9, label="simulated from the input")
        whole.axvspan(t[first], t[last - 1], color="#f3d9a4", zorder=0)
        grid(whole, zoom)
    axes[0, 0].legend(loc="upper right", fontsize=8, ncols=3, framealpha=0.85)
    if traces.simulated is not None:
        axes[0, 1].legend(loc="upper left", fontsize=8, framealpha=0.85)
    _heads(axes, ("measured and predicted", "close view where the errors are largest"), ("time [s]", "time [s]"))


def residuals_panel(figure: Figure | SubFigure, traces: Traces) -> None:
    """Innovations over time with 99 % bounds, and their autocorrelation."""
    axes = figure.subplots(len(traces.names), 2, squeeze=False, width_ratios=(3, 2), sharex="col")
    for j, (over_time, over_lag) in enumerate(axes):
        _errors(over_time, traces, j, traces.names[j], " outside (1 % expected)")
        rho = autocorrelation(traces.measured[:, j] - traces.predicted[:, j], _LAGS)
        limit = NORMAL_99 / np.sqrt(traces.time_s.size)
        stems(over_lag, np.arange(1, rho.size), rho[1:], np.full(rho.size - 1, limit))
        reach = max(3 * limit, 1.1 * float(np.max(np.abs(rho[1:]), initial=0.0)))
        over_lag.set_ylim(-reach, reach)
        grid(over_time, over_lag)
    heads = (
        "residuals (measured - predicted) with 99 % bounds",
        "their autocorrelation with 99 % bounds of white noise",
    )
    _heads(axes, heads, ("time [s]", "lag [samples]"))


def records_panel(figure: Figure | SubFigure, found: Sequence[Traces]) -> None:
    """Draw several records below each other: measured and predicted outputs, then their errors with 99 % bounds."""
    n_y = len(found[0].names)
    ratios = (3,) * n_y + (2,) * n_y
    axes = figure.subplots(len(found), 2 * n_y, squeeze=False, sharex="row", width_ratios=ratios)
    for row, traces in zip(axes, found, strict=True):
        for j in range(n_y):
            whole, errors = row[j], row[n_y + j]
            if not np.any(np.isfinite(traces.predicted[:, j])):
                mean = float(traces.measured[:, j].mean())
                scale, unit = prefixed(abs(mean), traces.units[j])
                words = f"held at {mean / scale:.4g} {unit}"
                whole.text(0.5, 0.5, words, ha="center", va="center", fontsize=9, transform=whole.transAxes)
                whole.axis("off")
                errors.axis("off")
                continue
            _outputs(whole, traces, j)
            _errors(errors, traces, j, "error", " outside")
            grid(whole, errors)
        row[0].set_title(traces.title, fontsize=9, loc="left")
        for a in row:
            a.tick_params(labelsize=8)
            a.locator_params(axis="x", nbins=5)
            if traces.second:
                a.set_facecolor("#fbf7ee")
    for a in axes[-1]:
        a.set_xlabel("time [s]", fontsize=9)
    named = {label: h for a in axes.flat for h, label in zip(*a.get_legend_handles_labels(), strict=True)}
    figure.legend(list(named.values()), list(named), loc="outside upper center", fontsize=8, ncols=4, frameon=False)


def _outputs(axes: Axes, traces: Traces, j: int, *, simulation: bool = True) -> float:
    """Draw one output and return its scale; a free run that runs away gets half the measured span at most."""
    scale, unit = prefixed(float(np.max(np.abs(traces.measured[:, j]))), traces.units[j])
    y = traces.measured[:, j] / scale
    curve(axes, traces.time_s, y, MEASURED, "measured")
    curve(axes, traces.time_s, traces.predicted[:, j] / scale, PREDICTED, "predicted one step ahead")
    if simulation and traces.simulated is not None:
        free = traces.simulated[:, j] / scale
        axes.plot(traces.time_s, free, "--", color=BOUND, linewidth=0.8, label="simulated from the input", zorder=1.5)
        low, high = float(y.min()), float(y.max())
        room = (high - low) or 1.0
        least, largest = max(float(free.min()), low - room / 2), min(float(free.max()), high + room / 2)
        axes.set_ylim(min(low, least) - 0.05 * room, max(high, largest) + 0.05 * room)
    axes.set_ylabel(f"{traces.names[j]} [{unit}]")
    return scale


def _errors(axes: Axes, traces: Traces, j: int, name: str, words: str) -> None:
    """Draw the errors of one output with 99 % bounds, over their standard deviation where that varies."""
    e, sd = traces.measured[:, j] - traces.predicted[:, j], traces.sd[..., j]
    if sd.ndim:
        e, bound, label = e / sd, NORMAL_99, f"{name} / sd"
        reach = max(1.3 * NORMAL_99, float(np.nanquantile(np.abs(e), 0.999)))
        axes.set_ylim(-1.15 * reach, 1.15 * reach)
    else:
        scale, unit = prefixed(3 * float(sd) if sd > 0 else float(np.max(np.abs(e))), traces.units[j])
        e, bound, label = e / scale, NORMAL_99 * float(sd) / scale, f"{name} [{unit}]"
    curve(axes, traces.time_s, e, MEASURED, None)
    for side in (-bound, bound):
        axes.axhline(side, color=BOUND, linewidth=1.0, linestyle="--")
    note(axes, f"{100 * float(np.mean(np.abs(e[np.isfinite(e)]) > bound)):.2g} %{words}")
    axes.set_ylabel(label)


def stems(axes: Axes, lags: NDArray[np.int64], values: Array, limit: Array) -> None:
    """Draw correlations over their lags, with the bounds that those of white noise keep."""
    axes.vlines(lags, 0, values, color=MEASURED, linewidth=1.4)
    axes.fill_between(lags, -limit, limit, color=BAND, alpha=0.6, linewidth=0, zorder=0)
    axes.axhline(0, color=MEASURED, linewidth=0.6)


def _heads(axes: NDArray[np.object_], above: Sequence[str], below: Sequence[str]) -> None:
    for top, bottom, title, label in zip(axes[0], axes[-1], above, below, strict=True):
        top.set_title(title, fontsize=10)
        bottom.set_xlabel(label)


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
    found = np.unique(np.concatenate([np.geomspace(lowest_hz, nyquist_hz, n_frequencies), *extra]))
    return np.asarray(found[(found >= lowest_hz) & (found <= nyquist_hz)])


def bode_panel(
    figure: Figure | SubFigure,
    r: ModelResponse,
    inputs: Sequence[str],
    outputs: Sequence[str],
    units: Mapping[str, str],
    asides: Mapping[str, str],
) -> None:
    """Draw magnitude and phase of the first pairs with 95 % bands; `asides` by input stand in the titles."""
    pairs = [(o, i) for o in range(len(outputs)) for i in range(len(inputs))]
    axes = pair_axes(figure, pairs, inputs, outputs, units, asides)
    for (magnitude, phase), pair in zip(axes, pairs, strict=False):
        magnitude_axis(magnitude, r, pair)
        phase_axis(phase, r, pair)
        magnitude.legend(loc="lower left", fontsize=8, framealpha=0.85)
    if len(pairs) > len(axes):
        figure.suptitle(f"{len(axes)} of {len(pairs)} pairs", fontsize=10)


def pair_axes(
    figure: Figure | SubFigure,
    pairs: Sequence[Pair],
    inputs: Sequence[str],
    outputs: Sequence[str],
    units: Mapping[str, str],
    asides: Mapping[str, str] | None = None,
) -> list[tuple[Axes, Axes]]:
    """Return the axes of magnitude and phase of the first pairs (output, input), with titles and units."""
    shown = pairs[:MOST_PAIRS]
    axes = figure.subplots(2, len(shown), squeeze=False, sharex=True, height_ratios=(3, 2))
    for (o, i), magnitude, phase in zip(shown, *axes, strict=True):
        source, output = inputs[i], outputs[o]
        magnitude.set_ylabel(f"magnitude [{response_unit(units, output, source)}]")
        magnitude.set_title(f"{source} → {output}{(asides or {}).get(source, '')}", fontsize=10)
        phase.set_xlabel("frequency [Hz]")
        grid(magnitude, phase)
    axes[1, 0].set_ylabel("phase [°]")
    return list(zip(*axes, strict=True))


def magnitude_axis(
    axes: Axes,
    r: ModelResponse,
    pair: Pair,
    *,
    label: str = "identified plant",
    band_label: str | None = None,
    colors: tuple[str, str] = (PREDICTED, BAND),
    style: str = "-",
) -> None:
    """Draw the magnitude of a response with its 95 % band."""
    size = np.abs(r.G[:, *pair])
    spread = np.exp(np.minimum(NORMAL_95 * r.log_sd[:, *pair], 20.0))
    about = band_label or f"95 % band (median ± {100 * (float(np.median(spread)) - 1):.2g} %)"
    axes.fill_between(r.frequency_hz, size / spread, size * spread, color=colors[1], label=about, linewidth=0)
    axes.loglog(r.frequency_hz, size, color=colors[0], linewidth=1.4, label=label, linestyle=style)
    axes.set_xlim(r.frequency_hz[0], r.frequency_hz[-1])
    axes.set_ylim(0.5 * size.min(), 2 * size.max())


def unwrapped(value: Complex, near: float = 0.0, known: NDArray[np.bool_] | None = None) -> Array:
    """Phase in rad without jumps, shape (n_frequencies,), begun within half a turn of `near`.

    `known`: where noise leaves the phase known; elsewhere it stands within half a turn of its neighbours, since noise
    that is unwrapped walks away.
    """
    at = np.arange(value.size) if known is None or not known.any() else np.flatnonzero(known)
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


def poles_panel(
    figure: Figure | SubFigure,
    poles: Sequence[Pole],
    text: str,
    title: str,
    *,
    zeros: Sequence[Pole] = (),
    discrete: bool = False,
) -> None:
    """Draw poles and zeros with their 95 % regions and the border of stability, and beside them a text."""
    axes, beside = figure.subplots(1, 2, width_ratios=(1, 1))
    for pole in poles:
        p = pole.value
        color = BOUND if (abs(p) > 1 if discrete else p.real > 0) else PREDICTED
        axes.plot(p.real, p.imag, "x", color=color, markersize=8, markeredgewidth=1.8)
        pole_region(axes, pole, color)
    for zero in zeros:
        z = zero.value
        axes.plot(z.real, z.imag, "o", color=MEASURED, markersize=7, markerfacecolor="none", markeredgewidth=1.4)
        pole_region(axes, zero, MEASURED)
    axes.axhline(0, color=MEASURED, linewidth=0.8)
    if discrete:
        angle = np.linspace(0, 2 * np.pi, 361)
        axes.plot(np.cos(angle), np.sin(angle), color=MEASURED, linewidth=0.8)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("real part – outside the circle the plant is unstable")
        axes.set_ylabel("imaginary part")
    else:
        axes.margins(0.15)
        axes.axvline(0, color=MEASURED, linewidth=0.8)
        low, high = axes.get_xlim()
        axes.axvspan(0, max(high, 0.15 * -low), color="#fbe9e7", zorder=0)
        axes.set_xlim(low, max(high, 0.15 * -low))
        axes.set_xlabel("real part [rad/s] – right of zero the plant is unstable")
        axes.set_ylabel("imaginary part [rad/s]")
    axes.set_title(title, fontsize=10)
    grid(axes)
    beside.axis("off")
    beside.text(0.0, 0.97, text, fontsize=8, va="top", family="monospace", transform=beside.transAxes)


def note(axes: Axes, text: str) -> None:
    """Write a short note in the upper right corner."""
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5}
    axes.text(0.995, 0.97, text, transform=axes.transAxes, fontsize=8, ha="right", va="top", bbox=box)


def grid(*axes: Axes) -> None:
    """Draw a grid behind what is shown."""
    for a in axes:
        a.grid(True, color="#dddddd", linewidth=0.6)
        a.set_axisbelow(True)  # bands of long records would have lines across
        a.tick_params(labelsize=9)
