"""Figures of an estimate: measured against predicted, residuals with bounds, Bode with uncertainty, poles.

Everything is drawn on `matplotlib.figure.Figure` objects, without pyplot: no window system, no global state.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ambid.identify.estimate import Estimate
from ambid.physics.models import model
from ambid.report.numbers import prefixed, quantity
from ambid.report.response import Pole, Response, poles, responses
from ambid.validate.second_record import Replay

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

Array = NDArray[np.float64]

_MEASURED, _PREDICTED, _BAND, _BOUND = "#444444", "#0b6fb8", "#9ecae8", "#c0392b"
_NORMAL_95, _NORMAL_99 = 1.959963984540054, 2.5758293035489004
_CHI2_95 = 5.991464547107979  # of two degrees of freedom
_PIXELS = 1200  # samples from which a curve is drawn as the band of its extremes
_ZOOM = 240  # samples of a close view
_LAGS = 50


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evidence:
    """What the figures of an estimate show beside it.

    Attributes
    ----------
    estimate : Estimate
    run : Replay
        A record run through the estimate's predictor.
    start_s : float
        Time of the record's first sample in s.
    """

    estimate: Estimate
    run: Replay
    start_s: float = 0.0

    @property
    def rate_hz(self) -> float:
        """Sampling rate in Hz."""
        return self.run.fit.problem.rate_hz

    @property
    def time_s(self) -> Array:
        """Time of the rows of `run`, shape (n_used,), in s."""
        return self.start_s + (self.run.first + np.arange(self.run.measured.shape[0])) / self.rate_hz

    @property
    def outputs(self) -> tuple[str, ...]:
        """Roles of the columns of `run`."""
        return model(self.estimate.model).outputs


def overview(evidence: Evidence) -> Figure:
    """Draw all figures on one page.

    Parameters
    ----------
    evidence : Evidence
        Estimate and replayed record.

    Returns
    -------
    matplotlib.figure.Figure
        Signals, residuals, Bode and poles, one below the other.
    """
    from matplotlib.figure import Figure

    n_y = len(evidence.outputs)
    heights = [2.3 * n_y, 2.2 * n_y, 4.6, 3.4]
    page = Figure(figsize=(11, sum(heights) + 0.5), layout="constrained")
    name = evidence.estimate.record.get("file") or "record"
    page.suptitle(f"{name}: model {evidence.estimate.model}", fontsize=13)
    parts: Any = page.subfigures(4, 1, height_ratios=heights)
    for part, draw in zip(parts, (_signals, _residuals, _bode, _poles), strict=True):
        draw(part, evidence)
    return page


def figures(evidence: Evidence) -> dict[str, Figure]:
    """Draw the figures one by one, as a report shows them.

    Parameters
    ----------
    evidence : Evidence
        Estimate and replayed record.

    Returns
    -------
    dict of str to matplotlib.figure.Figure
        ``signals``, ``residuals``, ``bode`` and ``poles``.
    """
    from matplotlib.figure import Figure

    n_y = len(evidence.outputs)
    drawings = {
        "signals": (2.4 * n_y, _signals),
        "residuals": (2.2 * n_y, _residuals),
        "bode": (4.8, _bode),
        "poles": (3.4, _poles),
    }
    found = {}
    for name, (height, draw) in drawings.items():
        found[name] = Figure(figsize=(11, height), layout="constrained")
        draw(found[name], evidence)
    return found


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


def _signals(figure: Figure | SubFigure, evidence: Evidence) -> None:
    """Measured against predicted: the whole record, and the stretch with the largest errors."""
    run, t = evidence.run, evidence.time_s
    axes = figure.subplots(len(evidence.outputs), 2, squeeze=False, width_ratios=(3, 2), sharex="col")
    first, last = _worst_stretch(run.innovations)
    for j, role in enumerate(evidence.outputs):
        whole, zoom = axes[j]
        scale, unit = _axis_unit(evidence, role, run.measured[:, j])
        y, p = run.measured[:, j] / scale, run.predicted[:, j] / scale
        _curve(whole, t, y, _MEASURED, "measured")
        _curve(whole, t, p, _PREDICTED, "predicted one step ahead")
        zoom.plot(t[first:last], y[first:last], ".", color=_MEASURED, markersize=3.5)
        zoom.plot(t[first:last], p[first:last], "-", color=_PREDICTED, linewidth=1.0)
        if run.simulated is not None:
            simulated = run.simulated[first:last, j] / scale
            zoom.plot(t[first:last], simulated, "--", color=_BOUND, linewidth=0.9, label="simulated from the input")
        whole.axvspan(t[first], t[last - 1], color="#f3d9a4", zorder=0)
        whole.set_ylabel(f"{role} [{unit}]")
        _grid(whole, zoom)
    axes[0, 0].set_title("measured and predicted", fontsize=10)
    axes[0, 1].set_title("close view where the errors are largest", fontsize=10)
    axes[0, 0].legend(loc="upper right", fontsize=8, ncols=3, framealpha=0.85)
    if run.simulated is not None:
        axes[0, 1].legend(loc="upper left", fontsize=8, framealpha=0.85)
    axes[-1, 0].set_xlabel("time [s]")
    axes[-1, 1].set_xlabel("time [s]")


def _residuals(figure: Figure | SubFigure, evidence: Evidence) -> None:
    """Innovations over time with 99 % bounds, and their autocorrelation."""
    run, t = evidence.run, evidence.time_s
    axes = figure.subplots(len(evidence.outputs), 2, squeeze=False, width_ratios=(3, 2), sharex="col")
    sds = np.sqrt(np.diag(evidence.estimate.noise.innovation_covariance))
    for j, role in enumerate(evidence.outputs):
        over_time, over_lag = axes[j]
        e = run.innovations[:, j]
        scale, unit = _axis_unit(evidence, role, 3 * np.array([sds[j]]))
        _curve(over_time, t, e / scale, _MEASURED, None)
        bound = _NORMAL_99 * sds[j]
        for side in (-bound, bound):
            over_time.axhline(side / scale, color=_BOUND, linewidth=1.0, linestyle="--")
        outside = 100 * float(np.mean(np.abs(e) > bound))
        over_time.set_ylabel(f"{role} [{unit}]")
        _note(over_time, f"{outside:.2g} % outside (1 % expected)")
        rho = autocorrelation(e, _LAGS)
        limit = _NORMAL_99 / np.sqrt(e.size)
        over_lag.vlines(np.arange(1, rho.size), 0, rho[1:], color=_MEASURED, linewidth=1.4)
        over_lag.axhspan(-limit, limit, color=_BAND, alpha=0.6, zorder=0)
        over_lag.axhline(0, color=_MEASURED, linewidth=0.6)
        reach = max(3 * limit, 1.1 * float(np.max(np.abs(rho[1:]), initial=0.0)))
        over_lag.set_ylim(-reach, reach)
        _grid(over_time, over_lag)
    axes[0, 0].set_title("innovations (measured - predicted) with 99 % bounds", fontsize=10)
    axes[0, 1].set_title("their autocorrelation with 99 % bounds of white noise", fontsize=10)
    axes[-1, 0].set_xlabel("time [s]")
    axes[-1, 1].set_xlabel("lag [samples]")


def _note(axes: Axes, text: str) -> None:
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5}
    axes.text(0.995, 0.97, text, transform=axes.transAxes, fontsize=8, ha="right", va="top", bbox=box)


def autocorrelation(e: Array, n_lags: int) -> Array:
    """Return the autocorrelation coefficients of a signal of mean near zero.

    Parameters
    ----------
    e : ndarray, shape (n_samples,)
        Such as innovations.
    n_lags : int
        Largest lag; at most n_samples - 1 are given.

    Returns
    -------
    ndarray, shape (n_lags + 1,)
        The first is 1.
    """
    power = float(e @ e)
    lags = range(1, min(n_lags, e.size - 1) + 1)
    return np.array([1.0, *(float(e[k:] @ e[:-k]) / power for k in lags)])


def _bode(figure: Figure | SubFigure, evidence: Evidence) -> None:
    """Magnitude and phase of each output per input, with 95 % bands."""
    found = responses(evidence.estimate)
    axes = figure.subplots(2, len(found), squeeze=False, sharex=True, height_ratios=(3, 2))
    units = model(evidence.estimate.model).units
    for j, r in enumerate(found):
        magnitude, phase = axes[:, j]
        _magnitude(magnitude, r)
        _phase(phase, r)
        magnitude.set_ylabel(f"magnitude [{units[r.output]}/{units[r.source]}]")
        phase.set_ylabel("phase [°]")
        phase.set_xlabel("frequency [Hz]")
        late = evidence.estimate.delay[r.source]
        note = (
            f", without its delay of {late.samples + late.fraction:.3g} samples" if late.samples + late.fraction else ""
        )
        magnitude.set_title(f"{r.source} → {r.output}{note}", fontsize=10)
        magnitude.legend(loc="lower left", fontsize=8, framealpha=0.85)
        _grid(magnitude, phase)


def _magnitude(axes: Axes, r: Response) -> None:
    size = np.abs(r.value)
    spread = np.exp(np.minimum(_NORMAL_95 * r.log_sd, 20.0))
    label = f"95 % band (median ± {100 * (float(np.median(spread)) - 1):.2g} %)"
    axes.fill_between(r.frequency_hz, size / spread, size * spread, color=_BAND, label=label, linewidth=0)
    axes.loglog(r.frequency_hz, size, color=_PREDICTED, linewidth=1.4, label="identified plant")
    axes.set_xlim(r.frequency_hz[0], r.frequency_hz[-1])
    axes.set_ylim(0.5 * size.min(), 2 * size.max())


def _phase(axes: Axes, r: Response) -> None:
    angle = np.unwrap(np.angle(r.value))
    angle -= 2 * np.pi * np.round(angle[0] / (2 * np.pi))
    spread = np.minimum(_NORMAL_95 * r.phase_sd, np.pi)
    low, high = np.rad2deg(angle - spread), np.rad2deg(angle + spread)
    axes.fill_between(r.frequency_hz, low, high, color=_BAND, linewidth=0)
    axes.semilogx(r.frequency_hz, np.rad2deg(angle), color=_PREDICTED, linewidth=1.4)
    middle = np.rad2deg(angle)
    first, last = 45 * np.floor(middle.min() / 45 - 0.3), 45 * np.ceil(middle.max() / 45 + 0.3)
    step = 90 if last - first > 180 else 45
    axes.set_ylim(first, last)
    axes.set_yticks(np.arange(step * np.ceil(first / step), last + 1, step))


def _poles(figure: Figure | SubFigure, evidence: Evidence) -> None:
    """Poles with 95 % regions, and beside them in numbers."""
    axes, beside = figure.subplots(1, 2, width_ratios=(3, 2))
    found = poles(evidence.estimate)
    for pole in found:
        unstable = pole.value.real > 0
        color = _BOUND if unstable else _PREDICTED
        axes.plot(pole.value.real, pole.value.imag, "x", color=color, markersize=8, markeredgewidth=1.8)
        _region(axes, pole, color)
    axes.margins(0.15)
    axes.axvline(0, color=_MEASURED, linewidth=0.8)
    axes.axhline(0, color=_MEASURED, linewidth=0.8)
    low, high = axes.get_xlim()
    axes.axvspan(0, max(high, 0.15 * -low), color="#fbe9e7", zorder=0)
    axes.set_xlim(low, max(high, 0.15 * -low))
    axes.set_xlabel("real part [rad/s] – right of zero the plant is unstable")
    axes.set_ylabel("imaginary part [rad/s]")
    axes.set_title("poles of the identified plant, 95 % regions", fontsize=10)
    _grid(axes)
    beside.axis("off")
    lines = ["pole [rad/s]", "", *(line for pole in found if pole.value.imag >= 0 for line in _in_words(pole))]
    beside.text(0.0, 0.97, "\n".join(lines), fontsize=10, va="top", family="monospace", transform=beside.transAxes)


def _region(axes: Axes, pole: Pole, color: str) -> None:
    from matplotlib.patches import Ellipse

    if pole.covariance is None:
        return
    if abs(pole.value.imag) == 0:
        reach = _NORMAL_95 * float(np.sqrt(pole.covariance[0, 0]))
        axes.plot([pole.value.real - reach, pole.value.real + reach], [0, 0], color=color, linewidth=4, alpha=0.35)
        return
    size, direction = np.linalg.eigh(pole.covariance)
    width, height = 2 * np.sqrt(_CHI2_95 * np.maximum(size, 0.0))
    angle = float(np.rad2deg(np.arctan2(direction[1, 0], direction[0, 0])))
    centre = (pole.value.real, pole.value.imag)
    axes.add_patch(Ellipse(centre, width, height, angle=angle, facecolor=color, alpha=0.35, linewidth=0))


def _in_words(pole: Pole) -> list[str]:
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


def _curve(axes: Axes, t: Array, y: Array, color: str, label: str | None) -> None:
    """Draw a curve, or, where there are more samples than the paper shows, the band between its extremes."""
    options: dict[str, Any] = {} if label is None else {"label": label}
    if y.size <= 2 * _PIXELS:
        axes.plot(t, y, color=color, linewidth=0.8, **options)
        return
    edges = np.linspace(0, y.size, _PIXELS + 1).astype(int)[:-1]
    low, high = np.minimum.reduceat(y, edges), np.maximum.reduceat(y, edges)
    axes.fill_between(t[edges], low, high, color=color, linewidth=0.4, alpha=0.75, **options)


def _worst_stretch(e: Array) -> tuple[int, int]:
    """First and last sample of the stretch with the largest errors, each output counted in its own spread."""
    length = min(_ZOOM, e.shape[0])
    size = np.sum((e / np.maximum(e.std(axis=0), 1e-300)) ** 2, axis=1)
    total = np.concatenate([[0.0], np.cumsum(size)])
    first = int(np.argmax(total[length:] - total[:-length]))
    return first, first + length


def _axis_unit(evidence: Evidence, role: str, values: Array) -> tuple[float, str]:
    return prefixed(float(np.max(np.abs(values))), model(evidence.estimate.model).units[role])


def _grid(*axes: Axes) -> None:
    for a in axes:
        a.grid(True, color="#dddddd", linewidth=0.6)
        a.tick_params(labelsize=9)
