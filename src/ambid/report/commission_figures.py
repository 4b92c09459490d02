"""What the steps of a commissioning saw, drawn: rest, pulses, lift-off, trials of the amplitude, records, margins.

Each function returns a `Picture`, which keeps the few samples that it needs and is drawn when a page asks for it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.acquisition.polarity import Pulse
from ambid.arrays import Array
from ambid.report.drawing import BAND, BOUND, MEASURED, PREDICTED, curve, grid, note, single
from ambid.report.numbers import prefixed, sized
from ambid.signals.spectra import power_spectrum
from ambid.simulation.margins import ZONES, LoopMargins

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from ambid.report.drawing import Draw

Bounds = Mapping[str, tuple[float, float]]  # trips by role, SI

UNITS = {"position": "m", "current": "A", "voltage": "V"}
_MOST = 20_000  # samples of a trace that are kept
_PULSES = 4  # beside each other
_BEGIN_S = 0.25  # of lift-off that is drawn closer
_ROW = 1.7  # inches
_LOOPS = ((PREDICTED, "-"), (MEASURED, "--"))  # colour and style of each


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """A figure that is drawn when it is asked for."""

    title: str
    caption: str
    height: float  # inches
    draw: Draw

    def figure(self) -> Figure:
        """Draw it alone."""
        return single(self.height, self.draw)


def rest_picture(seen: Mapping[str, Array], rate_hz: float) -> Picture:
    """Traces of the sensors with the output off, about their means, and the density of their noise."""
    roles = [role for role in ("position", "current") if role in seen and seen[role].size > 1]

    def draw(place: Figure | SubFigure) -> None:
        axes = place.subplots(len(roles), 2, squeeze=False, sharex="col", width_ratios=(3, 2))
        for role, (over_time, over_hz) in zip(roles, axes, strict=True):
            values = seen[role] - seen[role].mean()
            scale, unit = prefixed(float(np.max(np.abs(values))), UNITS[role])
            curve(over_time, np.arange(values.size) / rate_hz, values / scale, MEASURED, None)
            note(over_time, f"{sized(float(values.std()), UNITS[role])} rms")
            over_time.set_ylabel(f"{role} [{unit}]")
            found = power_spectrum(values, rate_hz)
            size = np.sqrt(found.density[1:])
            scale, unit = prefixed(float(size.max()), UNITS[role])
            over_hz.loglog(found.frequency_hz[1:], size / scale, color=PREDICTED, linewidth=1.0)
            over_hz.set_ylabel(f"[{unit}/√Hz]")
            grid(over_time, over_hz)
        _heads(axes, ("about the mean", "amplitude density of the noise"), ("time [s]", "frequency [Hz]"))

    caption = "Output off: the noise of the sensors alone. A line in the spectrum is pick-up: mains, or a converter."
    return Picture(title="Sensors at rest", caption=caption, height=_ROW * len(roles), draw=draw)


def pulses_picture(pulses: Sequence[Pulse]) -> Picture:
    """The first pulses and the last ones, with what the current and the position did."""
    shown = [*pulses[: _PULSES // 2], *pulses[max(_PULSES // 2, len(pulses) - _PULSES // 2) :]]

    def draw(place: Figure | SubFigure) -> None:
        axes = place.subplots(3, len(shown), squeeze=False, sharex="col", sharey="row")
        for role, row in zip(("voltage", "current", "position"), axes, strict=True):
            traces = [_about_begin(p, role) for p in shown]
            scale, unit = prefixed(max((float(np.max(np.abs(y))) for y in traces if y.size), default=0.0), UNITS[role])
            for pulse, y, a in zip(shown, traces, row, strict=True):
                a.axvspan(0.0, 1e3 * pulse.hold_s, color="#f3d9a4", zorder=0)
                a.plot(1e3 * pulse.time_s, y / scale, color=MEASURED, linewidth=1.0)
                a.set_xlim(-1e3 * pulse.hold_s, 3e3 * pulse.hold_s)
                grid(a)
            row[0].set_ylabel(f"{role} [{unit}]")
        for pulse, top, bottom in zip(shown, axes[0], axes[-1], strict=True):
            k = next(k for k, p in enumerate(pulses, 1) if p is pulse)
            top.set_title(f"pulse {k}: {sized(pulse.volts, 'V')}", fontsize=10)
            bottom.set_xlabel("time [ms]")

    caption = (
        f"{len(shown)} of {len(pulses)} pulses without feedback, each about what was before it; shaded while"
        " the voltage is ordered. They grow until the rotor leaves its stop."
    )
    return Picture(title="Polarity pulses", caption=caption, height=_ROW * 3, draw=draw)


def _about_begin(pulse: Pulse, role: str) -> Array:
    """Return a trace of a pulse about its mean before the pulse, (n_samples,), SI."""
    values: Array = getattr(pulse, role)
    before = values[pulse.time_s < 0.0]
    return values - (before.mean() if before.size else 0.0)


def trace_picture(
    title: str, caption: str, seen: Mapping[str, Array], rate_hz: float, trips: Bounds, *, from_s: float | None = None
) -> Picture:
    """Traces by role over time with the controller's trips; the beginning closer, and shaded, up to `from_s`."""
    roles = [role for role in UNITS if role in seen and seen[role].size]
    kept = {role: seen[role][-_MOST:] if from_s is None else seen[role][:_MOST] for role in roles}

    def draw(place: Figure | SubFigure) -> None:
        ratios = (3,) if from_s is None else (2, 3)
        axes = place.subplots(len(roles), len(ratios), squeeze=False, sharex="col", sharey="row", width_ratios=ratios)
        for role, row in zip(roles, axes, strict=True):
            values = kept[role]
            scale, unit = prefixed(float(np.max(np.abs(values))), UNITS[role])
            row[0].set_ylabel(f"{role} [{unit}]")
            for a in row:
                shown = values[: round(_BEGIN_S * rate_hz)] if a is not row[-1] else values
                _within(a, shown / scale, rate_hz, [end / scale for end in trips.get(role, ())])
            if from_s is not None:
                row[-1].axvspan(0.0, from_s, color="#eeeeee", zorder=0)
        for a in axes[-1]:
            a.set_xlabel("time [s]")

    return Picture(title=title, caption=caption, height=_ROW * len(roles), draw=draw)


def trials_picture(
    tried: Sequence[tuple[float, float]], use: float, last: Mapping[str, Array], rate_hz: float, trips: Bounds
) -> Picture:
    """Which part of the available range each amplitude used, and the position of the last trial within its trips."""

    def draw(place: Figure | SubFigure) -> None:
        over_size, over_time = place.subplots(1, 2, width_ratios=(2, 3))
        if tried:
            size, used = np.array(tried).T
            over_size.axhspan(75.0 * use, 120.0 * use, color=BAND, alpha=0.6, linewidth=0, label="wanted")
            over_size.plot(size, 100.0 * used, "o-", color=PREDICTED, markersize=5, linewidth=0.8, label="trial")
            over_size.set_ylim(0.0, None)
            over_size.set_xlim(0.0, None)
            over_size.legend(fontsize=8, loc="upper left", framealpha=0.85)
        over_size.set_xlabel("amplitude [V]")
        over_size.set_ylabel("used of the available range [%]")
        role = "position" if "position" in last else "current"
        values = last[role][:_MOST] if role in last else np.empty(0)
        if values.size:
            scale, unit = prefixed(float(np.max(np.abs(values))), UNITS[role])
            _within(over_time, values / scale, rate_hz, [end / scale for end in trips.get(role, ())])
            over_time.set_ylabel(f"{role} [{unit}]")
        over_time.set_title("last trial, with the controller's trips", fontsize=10)
        over_time.set_xlabel("time [s]")
        grid(over_size)

    caption = "The amplitude grows from trial to trial until it uses its part of the way to the nearest trip."
    return Picture(title="Trials of the amplitude", caption=caption, height=3.0, draw=draw)


def _within(axes: Axes, values: Array, rate_hz: float, ends: Sequence[float]) -> None:
    """Draw a trace within its trips."""
    curve(axes, np.arange(values.size) / rate_hz, values, MEASURED, None)
    for end in ends:
        if math.isfinite(end):
            axes.axhline(end, color=BOUND, linestyle="--", linewidth=1.0)
    axes.margins(x=0.0)
    grid(axes)


def margins_picture(loops: Mapping[str, LoopMargins]) -> Picture:
    """Nyquist curve and sensitivity of loops by name, with the zones of ISO 14839-3."""

    def draw(place: Figure | SubFigure) -> None:
        nyquist, over_hz = place.subplots(1, 2, width_ratios=(2, 3))
        for (colour, style), (name, loop) in zip(_LOOPS, loops.items(), strict=False):
            how: dict[str, Any] = {"color": colour, "linestyle": style, "linewidth": 1.2}
            nyquist.plot(loop.open_loop.real, loop.open_loop.imag, **how)
            over_hz.semilogx(loop.frequency_hz, 20.0 * np.log10(loop.sensitivity), label=name, **how)
        worst = max(loop.peak[0] for loop in loops.values())
        _nyquist(nyquist, worst)
        low = -20.0
        top = max(16.0, 20.0 * math.log10(worst) + 2.0)
        for most, zone in ZONES:
            level = 20.0 * math.log10(most)
            over_hz.axhline(level, color=BOUND, linestyle=":", linewidth=0.9)
            over_hz.annotate(
                f"zone {zone}", (1.0, level), xycoords=("axes fraction", "data"), xytext=(-4, -2),
                textcoords="offset points", ha="right", va="top", fontsize=8, color=BOUND,
            )  # fmt: skip
        over_hz.set_ylim(low, top)
        over_hz.set_xlabel("frequency [Hz]")
        over_hz.set_ylabel("sensitivity [dB]")
        over_hz.margins(x=0.0)
        over_hz.legend(fontsize=8, loc="lower right", framealpha=0.85)
        grid(nyquist, over_hz)

    caption = (
        "The loop opened at the controller's output. Left: the farther the curve stays from -1, the more gain and phase"
        " may change; circle: the distance of zone A. Right: the sensitivity, with the zones of ISO 14839-3."
    )
    return Picture(title="Margins of the loop", caption=caption, height=3.6, draw=draw)


def _nyquist(axes: Axes, worst: float) -> None:
    """Frame the neighbourhood of the critical point."""
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    axes.plot(np.cos(angle), np.sin(angle), color=MEASURED, linewidth=0.6, linestyle=":")
    axes.plot(-1.0 + np.cos(angle) / ZONES[0][0], np.sin(angle) / ZONES[0][0], color=BOUND, linewidth=0.9)
    axes.plot(-1.0, 0.0, "+", color=BOUND, markersize=10, markeredgewidth=1.6)
    axes.set_aspect("equal")
    axes.set_xlim(-3.0, 1.5)
    axes.set_ylim(-2.0, 2.0)
    axes.set_xlabel("real part of L")
    axes.set_ylabel("imaginary part of L")
    note(axes, f"modulus margin {1.0 / worst:.2f}")


def _heads(axes: np.ndarray, above: Sequence[str], below: Sequence[str]) -> None:
    for top, bottom, title, label in zip(axes[0], axes[-1], above, below, strict=True):
        top.set_title(title, fontsize=10)
        bottom.set_xlabel(label)
