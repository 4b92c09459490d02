"""Panels of a designed experiment: lines, one period of what moves beside its limits, what records will show."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ambid.control.experiment import Experiment
from ambid.report.drawing import BOUND, CYCLE, MEASURED, ORANGE, Block, curve, head, log_axis, panel, stacked
from ambid.report.numbers import prefixed
from ambid.simulation.rotor_bench import kind_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def experiment_figure(found: Experiment, title: str, width: float) -> Figure:
    """Draw a design."""
    limited = [name for name, x in found.signals.items() if x.low is not None or x.high is not None]
    most = {kind_of(name): name for name in sorted(limited, key=lambda name: found.signals[name].drawn)}
    shown_of_kind = [name for name in limited if name in most.values()]  # of many axes that which uses most
    waves = [panel(_excitation, found)] + [panel(_wave, found, name) for name in shown_of_kind]
    shown = [
        panel(_lines, found, height=2.4),
        panel(_by_length, found, height=2.6),
        panel(_by_level, found, height=2.6),
    ]
    return stacked(title, [Block(columns=[waves, shown], widths=(3.0, 2.0), shared=False)], width)


def _excitation(axes: Axes, found: Experiment) -> None:
    t = np.arange(found.period) / found.rate_hz
    for (name, wave), color in zip(found.excitation.items(), CYCLE, strict=False):
        curve(axes, t, wave, color, name if len(found.excitation) > 1 else None)
    head(axes, f"one period of the excitation of {_inputs(found)}")
    axes.set_ylabel("[V]")


def _wave(axes: Axes, found: Experiment, name: str) -> None:
    of, wave = found.signals[name], found.shown.waves[name]
    ends = [e for e in (of.low, of.high) if e is not None]
    scale, unit = prefixed(max(of.peak, *(abs(e) for e in ends)), of.unit)
    curve(axes, np.arange(wave.size) / found.rate_hz, wave / scale, MEASURED, None)
    for end in ends:
        axes.axhline(end / scale, color=BOUND, linestyle=":", label="limit")
        inside = end - np.copysign(of.reserve, end)
        axes.axhline(inside / scale, color=ORANGE, linestyle=":", linewidth=0.9, label="limit less noise")
    axes.set_ylabel(f"{name} [{unit}]")
    axes.set_xlabel("time [s]")
    head(axes, f"{name}: {100 * max(of.steady, of.from_rest):.0f} % of the limits, drawn plants {100 * of.drawn:.0f} %",
         good=of.drawn <= 1.001)  # fmt: skip


def _inputs(found: Experiment) -> str:
    names = list(found.excitation)
    return names[0] if len(names) == 1 else f"{len(names)} inputs"


def _lines(axes: Axes, found: Experiment) -> None:
    for size, color in zip(found.amplitude.values(), CYCLE, strict=False):
        f, own = found.frequency_hz[size > 0.0], size[size > 0.0]
        axes.vlines(f, 1e-3 * own.max(), own, color=color, linewidth=0.8)
        axes.plot(f, own, ".", color=color, markersize=3)
    head(axes, f"{found.frequency_hz.size} lines of {_inputs(found)}")
    largest = max(float(size.max()) for size in found.amplitude.values())
    least = min(float(size[size > 0.0].min()) for size in found.amplitude.values())
    log_axis(axes.xaxis, float(found.frequency_hz[0]), float(found.frequency_hz[-1]))
    log_axis(axes.yaxis, max(0.5 * least, 1e-3 * largest), largest)
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel("amplitude [V]")


def _by_length(axes: Axes, found: Experiment) -> None:
    for (name, sd), color in zip(found.shown.by_length.items(), CYCLE * 2, strict=False):
        axes.plot(found.shown.seconds, 100.0 * sd, color=color, label=name)
    axes.axhline(100.0 * found.target, color=BOUND, linestyle=":")
    axes.axvline(found.seconds, color=MEASURED, linewidth=0.8)
    log_axis(axes.xaxis, float(found.shown.seconds[0]), float(found.shown.seconds[-1]))
    axes.set_yscale("log")
    axes.set_xlabel("length of the record [s]")
    axes.set_ylabel("relative sd [%]")
    head(axes, f"expected over length, aim {100 * found.target:.3g} %")


def _by_level(axes: Axes, found: Experiment) -> None:
    for (name, sd), color in zip(found.shown.by_level.items(), CYCLE * 2, strict=False):
        axes.plot(100.0 * found.shown.levels, 100.0 * sd, color=color, label=name)
    axes.axhline(100.0 * found.target, color=BOUND, linestyle=":")
    axes.set_yscale("log")
    axes.set_xlabel("amplitude [% of the design's]")
    axes.set_ylabel("relative sd [%]")
    head(axes, f"expected over level, record of {found.seconds:.3g} s")
