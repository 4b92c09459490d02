"""Panels of a closed loop: sensitivity with the zones of ISO 14839-3, measured and predicted, and compliance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from ambid.arrays import Array
from ambid.control.margins import Margins
from ambid.control.room import Vibration
from ambid.report.drawing import BOUND, MEASURED, PREDICTED, Block, head, log_axis, panel, stacked
from ambid.report.numbers import prefixed, sized
from ambid.simulation.margins import ZONES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DB = (-12.0, 16.0)


def margins_figure(found: Margins, title: str, width: float) -> Figure:
    """Draw sensitivity and compliance, a row an axis."""
    axes = list(found.sensitivity)
    block = Block(
        columns=[
            [panel(sensitivity_panel, found, axis, height=2.2) for axis in axes],
            [panel(_compliance, found, axis, height=2.2) for axis in axes],
        ],
        widths=(3.0, 2.0),
    )
    blocks, curves = [block], found.curves
    if curves.stiffness:
        dynamic = [
            panel(_signed, curves.frequency_hz, values, name, unit, height=2.2)
            for values, name, unit in (
                (curves.stiffness, "dynamic stiffness", "N/m"), (curves.damping, "dynamic damping", "N s/m")
            )
        ]  # fmt: skip
        blocks.append(Block(columns=[[x] for x in dynamic], widths=(1.0, 1.0), shared=False))
    if found.vibration is not None:
        blocks.append(Block(columns=[[panel(_vibration, found.vibration, height=2.2)]], shared=False))
    return stacked(title, blocks, width)


def zone_lines(axes: Axes) -> None:
    """Draw the borders of the zones of ISO 14839-3 over sensitivities in dB."""
    for k, (most, zone) in enumerate(ZONES):  # names side by side: the borders are nearer than a line of text
        level = 20.0 * math.log10(most)
        axes.axhline(level, color=BOUND, linestyle=":", linewidth=0.9)
        axes.annotate(
            f"zone {zone}", (1.0, level), xycoords=("axes fraction", "data"), xytext=(-4 - 42 * k, -2),
            textcoords="offset points", ha="right", va="top", fontsize=8, color=BOUND,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.3},
        )  # fmt: skip


def sensitivity_panel(axes: Axes, found: Margins, axis: str) -> None:
    """Draw the sensitivity of an axis, predicted and measured, within the zones."""
    curves, s = found.curves, found.sensitivity[axis]
    measured = curves.measured.get(axis)
    if measured is not None:
        size = 20.0 * np.log10(np.maximum(measured.ratio, 1e-12))
        axes.plot(measured.frequency_hz, size, ".", color=MEASURED, markersize=3, alpha=0.6, label="measured")
    predicted = 20.0 * np.log10(np.abs(curves.sensitivity[axis]))
    axes.plot(curves.frequency_hz, predicted, color=PREDICTED, label="plant and controller")
    zone_lines(axes)
    log_axis(axes.xaxis, float(curves.frequency_hz[0]), float(curves.frequency_hz[-1]))
    axes.set_ylim(_DB[0], max(_DB[1], s.peak_db.value + 2.0))
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel("sensitivity [dB]")
    good = found.checks["zone"].passed or s.zone in "AB"
    head(axes, f"axis {axis}: {s.peak_db.value:.2f} dB at {s.frequency_hz:.3g} Hz, zone {s.zone}", good=good)


def _compliance(axes: Axes, found: Margins, axis: str) -> None:
    size, of = found.curves.compliance[axis], found.compliance[axis]
    scale, unit = prefixed(of.largest, "m/N")
    axes.plot(found.curves.frequency_hz, size / scale, color=PREDICTED)
    f = found.curves.frequency_hz
    log_axis(axes.xaxis, float(f[0]), float(f[-1]))
    log_axis(axes.yaxis, max(float(size.min()), 1e-5 * of.largest) / scale, of.largest / scale)
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel(f"compliance [{unit}]")
    head(axes, f"least stiffness {sized(1.0 / of.largest, 'N/m')} at {of.frequency_hz:.3g} Hz")


def _signed(axes: Axes, frequency_hz: Array, values: Mapping[str, Array], name: str, unit: str) -> None:
    """Draw quantities of either sign by axis, in the logarithm beyond their smallest size over the frequencies."""
    size = np.abs(np.concatenate(list(values.values())))
    least = float(np.quantile(size, 0.1))
    scale, unit = prefixed(least, unit)
    for axis, x in values.items():
        axes.plot(frequency_hz, x / scale, label=axis if len(values) > 1 else None)
    axes.set_yscale("symlog", linthresh=least / scale, linscale=2.0)
    axes.axhline(0.0, color=BOUND, linewidth=0.6)
    log_axis(axes.xaxis, float(frequency_hz[0]), float(frequency_hz[-1]))
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel(f"{name} [{unit}]")


def _vibration(axes: Axes, found: Vibration) -> None:
    """Draw the vibration over the speed, and the clearance where it is near."""
    top = max(float(x.max()) for x in found.amplitude.values())
    scale, unit = prefixed(top, "m")
    for role, x in found.amplitude.items():
        axes.plot(60.0 * found.frequency_hz, x / scale, label=role.replace("_", " "))
    if found.clearance is not None and found.clearance < 3.0 * top:
        axes.axhline(found.clearance / scale, color=BOUND, linestyle="--", label="clearance")
    axes.set_ylim(0.0, None)
    axes.margins(x=0.0)
    axes.set_xlabel("speed [1/min]")
    axes.set_ylabel(f"vibration [{unit}]")
    clear = "no clearance is given" if found.clearance is None else f"clearance {sized(found.clearance, 'm')}"
    head(axes, f"unbalance{' and run-out' if found.runout else ''} of the rig; {clear}")
