"""Panels over time: outputs beside their predictions, residuals and the tests of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.estimation.result import NORMAL_95
from ambid.record import Record
from ambid.report.drawing import (
    BAND,
    BOUND,
    GREEN,
    MEASURED,
    ORANGE,
    PREDICTED,
    PURPLE,
    Block,
    curve,
    head,
    log_axis,
    panel,
)
from ambid.report.numbers import prefixed
from ambid.report.picture import Arrays
from ambid.signals.spectra import power_spectrum

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_ZOOM = 240  # samples of a close view

_LAGS = 50


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
    input_units: tuple[str, ...] = ()
    title: str = ""  # which record it is, where several are drawn
    second: bool = False  # whether the fit has not seen it

    @property
    def errors(self) -> Array:
        """Measured less predicted, (n_samples, n_outputs)."""
        return self.measured - self.predicted

    def scale(self, j: int) -> tuple[float, str]:
        """Return the unit in which an output has readable numbers, and its size."""
        return prefixed(float(np.max(np.abs(self.measured[:, j]))), self.units[j])


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

    return Block(columns=[[panel(draw, j) for j in range(len(traces.names))] for draw in (whole, zoom)], widths=(3, 2))


def keep(axes: Axes, y: Array) -> None:
    """Give what runs away half the span of `y` at most."""
    low, high = float(np.nanmin(y)), float(np.nanmax(y))
    room = (high - low) or 1.0
    least, most = axes.get_ylim()
    axes.set_ylim(max(least, low - room / 2), min(most, high + room / 2))


def residuals_panel(traces: Traces) -> Block:
    """Draw residuals over time and over frequency."""
    columns = [[panel(_errors, traces, j, height=1.7) for j in range(len(traces.names))]]
    columns.append([panel(_spectrum, traces, j, height=1.7) for j in range(len(traces.names))])
    return Block(columns=columns, widths=(3, 2))


def whiteness_panel(traces: Traces, failed: Sequence[str] = ()) -> Block:
    """Correlate residuals with their own past and with past inputs; `failed`: names of checks that failed."""
    own = [panel(_own_past, traces, j, "residuals_white" not in failed, height=1.7) for j in range(len(traces.names))]
    columns = [own]
    for k in range(min(len(traces.input_names), 2)):
        sound = "residuals_uncorrelated" not in failed
        columns.append([panel(_past_input, traces, j, k, sound, height=1.7) for j in range(len(traces.names))])
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
    spectrum = power_spectrum(e, rate_hz, segment=max(min(e.size, 256), e.size // 40))
    inside = slice(1, -1)
    f, size = spectrum.frequency_hz[inside], np.sqrt(spectrum.density[inside])
    low, high = (np.sqrt(x[inside] / spectrum.density[inside]) for x in spectrum.confidence())
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


def records_panel(records: Sequence[Traces]) -> Block:
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

    n_y = len(records[0].names)
    columns = [[panel(draw, x, j, height=1.6) for x in records] for draw in (outputs, errors) for j in range(n_y)]
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


CLOSE = "Each sample predicted from all samples before it. Shaded: the stretch with the largest errors."

EVERY_SAMPLE = 50_000  # samples of a record, to which a page holds all of them

_STRETCHES = 5_000  # of a longer record, extremes of as many stretches are held, and as many samples around its errors

_VALUES = 20_000  # of all strips of records of many channels

_FEWEST = 400  # stretches of a record


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Line:
    """One signal; what it shows is `values` less `less`, each held once however many lines use it."""

    label: str
    color: str  # as report.css names it
    values: Array  # (n_samples,)
    less: Array | None = None
    scaled: bool = True  # whether the axis makes room for it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Strip:
    """Signals over one another, on one axis."""

    title: str
    unit: str
    scale: float  # of one unit, in that of the values
    lines: Sequence[Line]
    bound: float | None = None  # within ± this, 95 % are expected, in that of the values


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Strips:
    """Strips below each other, on one axis of time."""

    title: str
    time_s: Array  # (n_samples,), evenly spaced
    strips: Sequence[Strip]
    worst: tuple[int, int]  # samples of the largest errors: first, and behind the last; equal where there are none
    every_sample: int = EVERY_SAMPLE
    stretches: int = _STRETCHES

    def packed(self) -> list[dict[str, Any]]:
        """Return what the page's script draws: every sample; of long records extremes, and a stretch in full."""
        n = self.time_s.size
        if n <= self.every_sample:
            return [self._packed(0, n, 1)]
        close = self.stretches
        first = max(0, min(sum(self.worst) // 2 - close // 2, n - close))
        return [self._packed(0, n, -(-n // self.stretches)), self._packed(first, first + close, 1)]

    def _packed(self, first: int, last: int, every: int) -> dict[str, Any]:
        arrays, near = Arrays(), slice(first, last)

        def shown(line: Line) -> dict[str, Any]:
            entry: dict[str, Any] = {"label": line.label, "color": line.color, "scaled": line.scaled}
            if every == 1:
                entry["less"] = None if line.less is None else arrays.add(line.less[near])
                return entry | {"values": arrays.add(line.values[near])}
            x, edges = line.values if line.less is None else line.values - line.less, np.arange(0, last, every)
            return entry | {
                "low": arrays.add(np.fmin.reduceat(x, edges)),
                "high": arrays.add(np.fmax.reduceat(x, edges)),
            }

        strips = [
            {"title": s.title, "unit": s.unit, "scale": s.scale, "bound": s.bound, "lines": [shown(x) for x in s.lines]}
            for s in self.strips
        ]
        title, whole = self.title, (first, last) == (0, self.time_s.size)
        if not whole and self.worst[0] == self.worst[1]:
            title = f"{title or 'record'}, from {self.time_s[first]:.4g} to {self.time_s[last - 1]:.4g} s"
        step = (float(self.time_s[-1]) - float(self.time_s[0])) / max(self.time_s.size - 1, 1)
        return {
            "title": title, "start_s": float(self.time_s[first]), "step_s": step, "samples": last - first,
            "every": every, "worst": [x - first for x in self.worst], "strips": strips, "arrays": arrays.packed,
        }  # fmt: skip


def record_strips(record: Record, records: int = 1) -> Strips:
    """Return the channels of one of so many records as strips."""
    strips = []
    for c in record.channels:
        scale, unit = prefixed(float(np.nanmax(np.abs(c.values))), c.unit)
        line = Line(label="measured", color="measured", values=c.values)
        strips.append(Strip(title=c.name, unit=unit, scale=scale, lines=[line]))
    n = record.n_samples
    time_s = record.start_s + np.arange(n) / record.rate_hz
    title = str(record.provenance.get("file") or "")
    room = max(_FEWEST, _VALUES // (max(len(strips), 1) * records))
    return Strips(
        title=title, time_s=time_s, strips=strips, worst=(n // 2, n // 2), every_sample=3 * room, stretches=room
    )


def strips_of(traces: Traces) -> Strips:
    """Return outputs beside their predictions, innovations and inputs of a record as strips."""
    strips: list[Strip] = []
    visible = [j for j in range(len(traces.names)) if np.any(np.isfinite(traces.predicted[:, j]))]
    for j in visible:
        y, e, sd = traces.measured[:, j], traces.errors[:, j], traces.sd[..., j]
        lines = [
            Line(label="measured", color="measured", values=y),
            Line(label="predicted one step ahead", color="predicted", values=y, less=e),
        ]
        if traces.simulated is not None:
            free = traces.simulated[:, j]
            lines.append(Line(label="simulated from the input", color="bound", values=free, scaled=False))
        scale, unit = traces.scale(j)
        strips.append(Strip(title=traces.names[j], unit=unit, scale=scale, lines=lines))
        if sd.ndim:
            e, bound, scale, unit = e / sd, NORMAL_95, 1.0, "sd"
        else:
            bound, (scale, unit) = NORMAL_95 * float(sd), prefixed(float(np.nanmax(np.abs(e))), traces.units[j])
        line = Line(label="innovation", color="measured", values=e)
        strips.append(Strip(title=f"{traces.names[j]}: innovation", unit=unit, scale=scale, lines=[line], bound=bound))
    inputs = () if traces.inputs is None else traces.inputs.T
    for name, unit, x in zip(traces.input_names, traces.input_units, inputs, strict=True):
        scale, unit = prefixed(float(np.max(np.abs(x))), unit)
        line = Line(label="input", color="measured", values=x)
        strips.append(Strip(title=name, unit=unit, scale=scale, lines=[line]))
    worst = worst_stretch(np.nan_to_num(traces.errors[:, visible]))
    return Strips(title=traces.title, time_s=traces.time_s, strips=strips, worst=worst)
