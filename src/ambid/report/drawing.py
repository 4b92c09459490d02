"""What all figures are made of: a panel is one pair of axes, a block a few panels, a figure blocks below each other.

Everything is drawn on `matplotlib.figure.Figure` objects, without pyplot: no window system, no global state. Colours
are those of Okabe and Ito, which stay apart for colour-blind readers. Every band is a 95 % interval.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.bearing.measured import ModelResponse
from ambid.estimation.result import Verdict
from ambid.report.numbers import prefixed, response_unit
from ambid.report.text import WORDS
from ambid.signals.response import FrequencyResponse
from ambid.signals.spectra import power_spectrum

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure, SubFigure

Complex = NDArray[np.complex128]
Pair = tuple[int, int]  # output, input

MEASURED, PREDICTED, BAND, BOUND = "#4d4d4d", "#0072b2", "#a9d1ec", "#d55e00"
GREEN, ORANGE, PURPLE, SKY = "#009e73", "#e69f00", "#cc79a7", "#56b4e9"
CYCLE = (PREDICTED, ORANGE, GREEN, PURPLE, SKY, BOUND, MEASURED)
NORMAL_95 = 1.959963984540054
FIGURE_ENDINGS = (".png", ".svg", ".pdf")
STYLES = {"good": "#1b7837", "doubt": "#b35900", "bad": "#b2182b"}
WIDE, NARROW = 11.0, 4.6  # inches: a page, and the screen of a telephone
PIXELS = 800  # stretches of which a long curve shows the extremes, about one for each column of pixels
MOST_PAIRS = 6  # Bode diagrams beside each other; of more pairs the first are drawn, and the title says so
_CHI2_95 = 5.991464547107979  # of two degrees of freedom
_ZOOM = 240  # samples of a close view
_LAGS = 50
_NEAR = 0.06  # of the span of all poles, from which two of them lie too close
_MARKS = 70  # frequencies at which a measured response stands beside a model
_STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.labelsize": 9,
    "axes.edgecolor": "#777777",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "axes.prop_cycle": "cycler('color', " + str(list(CYCLE)) + ")",
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "text.color": "#1a1a1a",
    "axes.labelcolor": "#1a1a1a",
    "lines.linewidth": 1.2,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """What is drawn on one pair of axes."""

    draw: Callable[[Axes], object]
    height: float = 1.9  # inches


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """Panels that belong together: columns side by side on a wide page, one below the other on a narrow one."""

    columns: Sequence[Sequence[Panel]]  # of each, its panels from top to bottom
    widths: tuple[float, ...] = ()  # of the columns, beside each other
    title: str = ""
    shared: bool = True  # whether the panels of a column have one horizontal axis
    legend: Sequence[Any] = ()  # entries beside those that the panels' artists make

    def height(self, width: float) -> float:
        """Return what the block needs on a page of some width, inches."""
        heights = [sum(p.height for p in column) for column in self.columns]
        return 0.55 + (max(heights) if width > NARROW else sum(heights))

    def draw(self, place: Figure | SubFigure, width: float) -> None:
        """Draw the block, with one legend below it, where it covers nothing."""
        columns = self.columns if width > NARROW else [[p for column in self.columns for p in column]]
        rows = max(len(column) for column in columns)
        tallest = [max((c[k].height for c in columns if k < len(c)), default=1.0) for k in range(rows)]
        axes = place.subplots(
            rows, len(columns), squeeze=False, height_ratios=tallest,
            width_ratios=self.widths or None if len(columns) > 1 else None,
            sharex="col" if self.shared and width > NARROW else False,
        )  # fmt: skip
        for column, below in zip(columns, axes.T, strict=True):
            for k, a in enumerate(below):
                if k >= len(column):
                    a.axis("off")
                    continue
                column[k].draw(a)
                if self.shared and width > NARROW and k + 1 < len(column):
                    a.set_xlabel("")
        named = {label: h for a in place.axes for h, label in zip(*a.get_legend_handles_labels(), strict=True)}
        named |= {h.get_label(): h for h in self.legend}
        if named:
            place.legend(
                list(named.values()), list(named), loc="outside lower center", ncols=5 if width > NARROW else 2
            )
        if self.title:
            place.suptitle(textwrap.fill(self.title, int(11 * width)), fontsize=10)


def stacked(title: str, blocks: Sequence[Block], width: float = WIDE) -> Figure:
    """Return a page of blocks, one below the other; `width` in inches."""
    import matplotlib
    from matplotlib.figure import Figure

    heights = [block.height(width) for block in blocks]
    with matplotlib.rc_context(_STYLE):
        page = Figure(figsize=(width, sum(heights) + 0.5 * bool(title)), layout="constrained")
        if title:
            page.suptitle(textwrap.fill(title, int(8 * width)), fontsize=12)
        places: Any = page.subfigures(len(blocks), 1, height_ratios=heights) if len(blocks) > 1 else page
        for place, block in zip(np.atleast_1d(places), blocks, strict=True):
            block.draw(place, width)
    return page


def judged(figure: Figure, found: Verdict) -> Figure:
    """Put the verdict above a figure: its word in colour, and the names of the checks that speak against it."""
    from matplotlib.offsetbox import AnchoredOffsetbox, HPacker, TextArea

    words, style = WORDS[found.word]
    names = textwrap.shorten(
        ", ".join(r.check for r in found.reasons), int(11 * figure.get_figwidth()) - 28, placeholder=" …"
    )
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


def single(block: Block, width: float = WIDE) -> Figure:
    """Return one block as a figure."""
    return stacked("", [block], width)


def head(axes: Axes, text: str, *, good: bool = True) -> None:
    """Write what a panel shows above it: in the colour of a warning where it speaks against the result."""
    axes.set_title(text if good else f"✗ {text}", color="#1a1a1a" if good else BOUND)


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
    linewidth: float = 0.9,
    alpha: float = 0.45,
    zorder: float | None = None,
) -> None:
    """Draw a curve, or, where there are more samples than the paper shows, the band between its extremes."""
    options: dict[str, Any] = {"color": color, "label": label} | ({} if zorder is None else {"zorder": zorder})
    if y.size <= 2 * PIXELS:
        axes.plot(t, y, linewidth=linewidth, **options)
    else:
        axes.fill_between(*extremes(t, y, y), linewidth=0.5, alpha=alpha, **options)


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

    `e`: (n_samples,), such as residuals; `n_lags`: largest lag; at most n_samples - 1 are given. Returns (n_lags + 1,),
    the first is 1.
    """
    return cross_correlation(e, e, n_lags)


def cross_correlation(e: Array, u: Array, n_lags: int) -> Array:
    """Return the correlation coefficients of e(t) with u(t - lag), lags 0 to `n_lags`, both of mean near zero."""
    size = float(np.sqrt((e @ e) * (u @ u))) or 1.0
    return np.array([float(e[k:] @ u[: u.size - k]) / size for k in range(min(n_lags, e.size - 1) + 1)])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Traces:
    """Outputs of one record beside what a model says of them, SI."""

    time_s: Array  # (n_samples,), s of the record
    names: tuple[str, ...]  # of the outputs
    units: tuple[str, ...]
    measured: Array  # (n_samples, n_outputs), and predicted one step ahead; NaN for what is not predicted
    predicted: Array
    # of the errors, as the model says: (n_outputs,), or (n_samples, n_outputs) where it varies
    sd: Array
    simulated: Array | None = None  # (n_samples, n_outputs)
    ahead: Mapping[int, Array] = field(default_factory=dict)  # by steps, such predictions, NaN before the first
    inputs: Array | None = None  # (n_samples, n_inputs)
    input_names: tuple[str, ...] = ()
    title: str = ""  # which record it is, where several are drawn
    second: bool = False  # whether the fit has not seen it

    @property
    def errors(self) -> Array:
        """Measured less predicted, (n_samples, n_outputs)."""
        return self.measured - self.predicted

    def scale(self, j: int) -> tuple[float, str]:
        """Return the unit in which an output has readable numbers, and its size."""
        return prefixed(float(np.max(np.abs(self.measured[:, j]))), self.units[j])


def said_panel(text: str) -> Block:
    """Return a text in the place of a figure: why there is none."""
    return Block(columns=[[Panel(draw=lambda axes: (axes.axis("off"), axes.set_title(textwrap.fill(text, 60))))]])


def signals_panel(traces: Traces) -> Block:
    """Measured against predicted: the whole record, and the stretch with the largest errors."""
    first, last = worst_stretch(traces.errors)
    near = slice(first, last)
    t = traces.time_s

    def whole(axes: Axes, j: int) -> None:
        _outputs(axes, traces, j, simulation=not traces.ahead)
        axes.axvspan(t[first], t[last - 1], color=ORANGE, alpha=0.3, zorder=0, label="shown close")
        head(axes, f"{traces.names[j]}, the whole record")

    def zoom(axes: Axes, j: int) -> None:
        scale, unit = traces.scale(j)
        y = traces.measured[near, j] / scale
        axes.plot(t[near], y, ".", color=MEASURED, markersize=3.5, label="measured")
        axes.plot(t[near], traces.predicted[near, j] / scale, color=PREDICTED, label="predicted one step ahead")
        runs = {f"predicted {k} steps ahead": x for k, x in traces.ahead.items()}
        runs |= {} if traces.simulated is None else {"simulated from the input": traces.simulated}
        for (label, x), color, dash in zip(runs.items(), (GREEN, PURPLE, BOUND), ("-", "-.", "--"), strict=False):
            axes.plot(t[near], x[near, j] / scale, dash, color=color, linewidth=1.0, label=label)
        keep(axes, y)
        axes.set_xlabel("time [s]")
        axes.set_ylabel(f"{traces.names[j]} [{unit}]")
        head(axes, "where the errors are largest")

    return Block(columns=[[_panel(draw, j) for j in range(len(traces.names))] for draw in (whole, zoom)], widths=(3, 2))


def _panel(draw: Callable[..., object], *which: Any, height: float = 1.9) -> Panel:
    return Panel(draw=lambda axes: draw(axes, *which), height=height)


def keep(axes: Axes, y: Array) -> None:
    """Give what runs away half the span of `y` at most."""
    low, high = float(np.nanmin(y)), float(np.nanmax(y))
    room = (high - low) or 1.0
    least, most = axes.get_ylim()
    axes.set_ylim(max(least, low - room / 2), min(most, high + room / 2))


def residuals_panel(traces: Traces) -> Block:
    """Draw residuals over time and over frequency."""
    columns = [[_panel(_errors, traces, j, height=1.7) for j in range(len(traces.names))]]
    columns.append([_panel(_spectrum, traces, j, height=1.7) for j in range(len(traces.names))])
    return Block(columns=columns, widths=(3, 2))


def whiteness_panel(traces: Traces, failed: Sequence[str] = ()) -> Block:
    """Correlate residuals with their own past and with past inputs; `failed`: names of checks that failed."""
    own = [_panel(_own_past, traces, j, "residuals_white" not in failed, height=1.7) for j in range(len(traces.names))]
    columns = [own]
    for k in range(min(len(traces.input_names), 2)):
        sound = "residuals_uncorrelated" not in failed
        columns.append([_panel(_past_input, traces, j, k, sound, height=1.7) for j in range(len(traces.names))])
    return Block(columns=columns)


def _own_past(axes: Axes, traces: Traces, j: int, sound: bool) -> None:
    rho = autocorrelation(traces.errors[:, j], _LAGS)
    _correlations(axes, np.arange(1, rho.size), rho[1:], NORMAL_95 / np.sqrt(traces.time_s.size))
    head(axes, f"autocorrelation: {traces.names[j]} residual is {'' if sound else 'not '}white", good=sound)


def _past_input(axes: Axes, traces: Traces, j: int, k: int, sound: bool) -> None:
    assert traces.inputs is not None
    e, u = traces.errors[:, j], traces.inputs[:, k] - traces.inputs[:, k].mean()
    rho = cross_correlation(e, u, _LAGS)[1:]  # a controller may answer the residual within the sample
    # variance of the coefficient of two independent signals: sum over all lags of both autocorrelations
    both = autocorrelation(e, _LAGS) * autocorrelation(u, _LAGS)
    limit = NORMAL_95 * np.sqrt(max(2 * float(both.sum()) - 1, 0.1) / e.size)
    _correlations(axes, np.arange(1, rho.size + 1), rho, limit)
    words = "uncorrelated" if sound else "correlated"
    head(axes, f"{traces.names[j]} residual × past {traces.input_names[k]}: {words}", good=sound)


def _correlations(axes: Axes, lags: NDArray[np.int64], rho: Array, limit: float) -> None:
    stems(axes, lags, rho, np.full(lags.size, limit))
    reach = max(3 * limit, 1.1 * float(np.max(np.abs(rho), initial=0.0)))
    axes.set_ylim(-reach, reach)
    axes.set_xlabel("lag [samples]")
    axes.set_ylabel("correlation")


def _spectrum(axes: Axes, traces: Traces, j: int) -> None:
    """Amplitude density of the residual, beside the level that white noise of its size has."""
    e = traces.errors[:, j]
    rate_hz = (e.size - 1) / float(traces.time_s[-1] - traces.time_s[0])
    found = power_spectrum(e, rate_hz, segment=max(min(e.size, 256), e.size // 40))
    inside = slice(1, -1)
    f, size = found.frequency_hz[inside], np.sqrt(found.density[inside])
    low, high = (np.sqrt(x[inside] / found.density[inside]) for x in found.confidence())
    level = float(np.sqrt(2 * np.var(e) / rate_hz))
    scale, unit = prefixed(level, traces.units[j])
    axes.fill_between(
        f, level / high / scale, level / low / scale, color=BAND, linewidth=0, label="95 % of white noise"
    )
    axes.semilogx(f, size / scale, color=MEASURED, linewidth=0.9, label="residual")
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel(f"[{unit}/√Hz]")
    log_axis(axes.yaxis, min(level / 3, float(size.min())) / scale, max(3 * level, float(size.max())) / scale)
    head(axes, f"spectrum of the {traces.names[j]} residual")


def log_axis(axis: Axis, low: float, high: float) -> None:
    """Make an axis logarithmic between limits, with plain numbers where it spans less than two decades."""
    from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullFormatter

    axis._set_axes_scale("log")  # type: ignore[attr-defined]
    wide = high > 100 * low
    axis.set_view_interval(low / 1.1, high * 1.1, ignore=True)
    axis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
    axis.set_major_formatter(LogFormatterSciNotation() if wide else "{x:g}")
    axis.set_minor_formatter(NullFormatter())


def records_panel(found: Sequence[Traces]) -> Block:
    """Draw several records below each other: measured and predicted outputs, then their errors over their sd."""

    def outputs(axes: Axes, traces: Traces, j: int) -> None:
        if not np.any(np.isfinite(traces.predicted[:, j])):
            mean = float(traces.measured[:, j].mean())
            scale, unit = prefixed(abs(mean), traces.units[j])
            words = f"{traces.names[j]} held at {mean / scale:.4g} {unit}"
            axes.text(0.5, 0.5, words, ha="center", va="center", transform=axes.transAxes)
            axes.axis("off")
        else:
            _outputs(axes, traces, j)
        head(axes, traces.title if j == 0 else "")

    def errors(axes: Axes, traces: Traces, j: int) -> None:
        if np.any(np.isfinite(traces.predicted[:, j])):
            _errors(axes, traces, j)
        else:
            axes.axis("off")

    n_y = len(found[0].names)
    columns = [[_panel(draw, x, j, height=1.6) for x in found] for draw in (outputs, errors) for j in range(n_y)]
    return Block(columns=columns, widths=(3,) * n_y + (2,) * n_y, shared=False)


def _outputs(axes: Axes, traces: Traces, j: int, *, simulation: bool = True) -> None:
    """Draw one output; a free run that runs away gets half the measured span at most."""
    scale, unit = traces.scale(j)
    y = traces.measured[:, j] / scale
    curve(axes, traces.time_s, y, MEASURED, "measured")
    curve(axes, traces.time_s, traces.predicted[:, j] / scale, PREDICTED, "predicted one step ahead")
    if simulation and traces.simulated is not None:
        free = traces.simulated[:, j] / scale
        curve(axes, traces.time_s, free, BOUND, "simulated from the input", alpha=0.3, zorder=1.5)
        keep(axes, y)
    axes.set_xlabel("time [s]")
    axes.set_ylabel(f"{traces.names[j]} [{unit}]")
    if traces.second:
        axes.set_facecolor("#fbf7ee")


def _errors(axes: Axes, traces: Traces, j: int) -> None:
    """Draw the errors of one output with 95 % bounds, over their standard deviation where that varies."""
    e, sd, name = traces.errors[:, j], traces.sd[..., j], f"{traces.names[j]} residual"
    if sd.ndim:
        e, bound, label = e / sd, NORMAL_95, "residual / sd"
        reach = max(2 * NORMAL_95, float(np.nanquantile(np.abs(e), 0.999)))
        axes.set_ylim(-1.15 * reach, 1.15 * reach)
    else:
        scale, unit = prefixed(3 * float(sd) if sd > 0 else float(np.max(np.abs(e))), traces.units[j])
        e, bound, label = e / scale, NORMAL_95 * float(sd) / scale, f"residual [{unit}]"
    curve(axes, traces.time_s, e, MEASURED, "residual")
    for side in (-bound, bound):
        axes.axhline(side, color=BOUND, linewidth=1.0, linestyle="--", label="95 % expected inside")
    outside = 100 * float(np.mean(np.abs(e[np.isfinite(e)]) > bound))
    head(axes, f"{name}: {outside:.2g} % outside" + (" (5 % expected)" if not sd.ndim else ""))
    axes.set_xlabel("time [s]")
    axes.set_ylabel(label)
    if traces.second:
        axes.set_facecolor("#fbf7ee")


def stems(axes: Axes, lags: NDArray[np.int64], values: Array, limit: Array) -> None:
    """Draw correlations over their lags, with the bounds that those of white noise keep."""
    axes.fill_between(lags, -limit, limit, color=BAND, linewidth=0, zorder=0, label="95 % of white noise")
    axes.vlines(lags, 0, values, color=MEASURED, linewidth=1.4)
    axes.axhline(0, color=MEASURED, linewidth=0.6)


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
    shown = pairs[:MOST_PAIRS]

    def above(axes: Axes, pair: Pair) -> None:
        source, output = inputs[pair[1]], outputs[pair[0]]
        magnitude(axes, pair)
        axes.set_ylabel(f"magnitude [{response_unit(units, output, source)}]")
        head(axes, f"{source} → {output}{(asides or {}).get(source, '')}")

    def below(axes: Axes, pair: Pair) -> None:
        phase(axes, pair)
        axes.set_ylabel("phase [°]")
        axes.set_xlabel("frequency [Hz]")

    columns = [[_panel(above, x, height=2.5), _panel(below, x, height=1.8)] for x in shown]
    return Block(columns=columns, title=f"{len(shown)} of {len(pairs)} pairs" if len(pairs) > len(shown) else "")


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


def marks(axes: Axes, frf: FrequencyResponse, pair: Pair, guide: ModelResponse | None = None) -> None:
    """Draw some lines of a measured response with 95 % intervals, where it is known: magnitudes, or, with a `guide`
    whose turn they take, phases.
    """
    radius = frf.confidence_radius()[:, *pair]
    known = np.flatnonzero(np.isfinite(radius) & (frf.frequency_hz > 0))
    if not known.size:
        return
    f = frf.frequency_hz[known]
    at = known[np.unique(np.searchsorted(f, np.geomspace(f[0], f[-1], _MARKS)).clip(max=f.size - 1))]
    x, G, radius = frf.frequency_hz[at], frf.G[at, *pair], radius[at]
    size, spread = np.abs(G), [np.minimum(radius, 0.999 * np.abs(G)), radius]
    if guide is not None:
        angle = unwrapped(guide.G[:, *pair])
        near = np.interp(np.log(x), np.log(guide.frequency_hz), angle)
        half = np.rad2deg(np.arcsin(np.minimum(radius / np.maximum(size, 1e-300), 1.0)))
        seen = half < 90
        x, half = x[seen], half[seen]
        size, spread = np.rad2deg(near + np.angle(G * np.exp(-1j * near)))[seen], [half, half]
        angle_ticks(axes, np.concatenate([np.rad2deg(angle), size]))
    axes.errorbar(
        x, size, spread, fmt="o", markersize=2.4, color=MEASURED, elinewidth=0.8, label="measured, 95 %", zorder=1.9
    )


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


def poles_panel(
    poles: Sequence[Pole],
    text: str,
    title: str,
    *,
    zeros: Sequence[Pole] = (),
    discrete: bool = False,
) -> Block:
    """Draw poles and zeros with their 95 % regions and the border of stability, close views, and a text of numbers.

    Poles that lie too close to be told apart on the scale of all of them are drawn again, larger.
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

    def words(axes: Axes) -> None:
        longest = max(map(len, text.splitlines()), default=1)
        room: float = 3.5 if crowd or axes.figure.figure.get_figwidth() <= NARROW else 4.9
        axes.axis("off")
        axes.grid(False)
        axes.text(
            0.0, 0.97, text, fontsize=min(8.0, room * 72 / (0.61 * longest)), va="top", family="monospace",
            transform=axes.transAxes, clip_on=False,
        )  # fmt: skip

    crowd = _crowd([p.value for p in (*poles, *zeros)])
    columns = [[Panel(draw=every, height=3.0)], [Panel(draw=words, height=1.0 + 0.14 * len(text.splitlines()))]]
    if crowd:
        columns.insert(1, [Panel(draw=close, height=3.0)])
    return Block(columns=columns, widths=(4, 3, 4) if crowd else (1, 1), shared=False)


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


def correlations_panel(names: Sequence[str], covariance: Array, values: Mapping[str, float]) -> Block:
    """Draw the correlation matrix of estimated parameters, and how well each is known."""
    sd = np.sqrt(np.diag(covariance))
    rho = covariance / np.outer(sd, sd)
    apart = np.abs(rho - np.eye(len(names)))
    i, j = divmod(int(np.argmax(apart)), len(names))

    def matrix(axes: Axes) -> None:
        axes.imshow(rho, cmap="PuOr_r", vmin=-1.0, vmax=1.0, aspect="auto")
        small = len(names) > 8
        for k, row in enumerate(rho):
            for m, x in enumerate(row):
                color = "white" if abs(x) > 0.75 else "#1a1a1a"
                axes.text(m, k, f"{x:.1f}" if small else f"{x:.2f}", ha="center", va="center", color=color, fontsize=7)
        axes.set_xticks(range(len(names)), names, rotation=45 if small else 0)
        axes.set_yticks(range(len(names)), names)
        axes.grid(False)
        size = float(np.linalg.cond(rho))
        condition = f"{size:.0f}" if size < 1e5 else f"{size:.0e}"
        head(axes, f"largest correlation {names[i]}, {names[j]}: {rho[i, j]:.3f}; condition number {condition}")

    def known(axes: Axes) -> None:
        size = np.array([abs(values[n]) for n in names])
        percent = 100 * NORMAL_95 * sd / np.where(size > 0, size, np.nan)
        at = np.arange(len(names))
        axes.barh(at, percent, color=[PREDICTED if x < 50 else BOUND for x in percent], height=0.55)
        log_axis(axes.xaxis, float(np.nanmin(percent)) / 2, float(np.nanmax(percent)))
        axes.set_yticks(at, names)
        axes.invert_yaxis()
        axes.set_xlabel("half of the 95 % interval [% of the value]")
        head(axes, "how well each parameter is known")

    height = max(2.2, 0.28 * len(names) + 0.6)
    return Block(columns=[[Panel(draw=draw, height=height)] for draw in (matrix, known)], shared=False)
