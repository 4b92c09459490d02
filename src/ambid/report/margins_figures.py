"""Panels of a closed loop: sensitivity with the zones of ISO 14839-3, measured and predicted, and compliance."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from ambid.control.margins import Margins
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
            [panel(_sensitivity, found, axis, height=2.2) for axis in axes],
            [panel(_compliance, found, axis, height=2.2) for axis in axes],
        ],
        widths=(3.0, 2.0),
        by_row=True,
    )
    return stacked(title, [block], width)


def zone_lines(axes: Axes) -> None:
    """Draw the borders of the zones of ISO 14839-3 over sensitivities in dB."""
    for most, zone in ZONES:
        level = 20.0 * math.log10(most)
        axes.axhline(level, color=BOUND, linestyle=":", linewidth=0.9)
        axes.annotate(
            f"zone {zone}", (1.0, level), xycoords=("axes fraction", "data"), xytext=(-4, -2),
            textcoords="offset points", ha="right", va="top", fontsize=8, color=BOUND,
        )  # fmt: skip


def _sensitivity(axes: Axes, found: Margins, axis: str) -> None:
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
