"""Panels of a designed controller: sensitivity with its zones, compliance and force step, before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ambid.arrays import Array
from ambid.control.design import Design
from ambid.report.drawing import BOUND, MEASURED, PREDICTED, Block, head, log_axis, panel, stacked
from ambid.report.margins_figures import zone_lines
from ambid.report.numbers import prefixed, sized
from ambid.report.verification import verification_block

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LOOPS = (("before", MEASURED), ("after", PREDICTED))
_DB = (-20.0, 16.0)
_RPM = 30.0 / np.pi
_SHALLOW = 1e-4  # of the largest compliance: the lowest that is drawn


def design_figure(found: Design, title: str, width: float) -> Figure:
    """Draw both loops, a row of panels an axis."""
    blocks = [loops_block(found)]
    if found.over_speed is not None:
        blocks.append(Block(columns=[[panel(_over_speed, found, height=2.4)]]))
    if found.trials:
        blocks.append(verification_block(found.trials["before"][0], found.trials["after"][0]))
    return stacked(title, blocks, width)


def loops_block(found: Design) -> Block:
    """Return panels of both loops: sensitivity, compliance and force step."""
    axes = list(found.after.sensitivity)
    columns = [[panel(draw, found, axis, height=2.4) for axis in axes] for draw in (_sensitivity, _compliance, _step)]
    return Block(columns=columns, widths=(4.0, 3.0, 3.0), shared=False)


def _sensitivity(axes: Axes, found: Design, axis: str) -> None:
    tops = []
    for name, color in _LOOPS:
        of = found.curves[name]
        mean, high = (20.0 * np.log10(x[axis]) if axis in x else None for x in (of.sensitivity, of.highest))
        _between(axes, of.frequency_hz, mean, high, color, name)
        tops += [x.max() for x in (mean, high) if x is not None]
    zone_lines(axes)
    f = found.curves["after"].frequency_hz
    log_axis(axes.xaxis, float(f[0]), float(f[-1]))
    axes.set_ylim(_DB[0], max(_DB[1], min(max(tops) + 2.0, 40.0)))
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel("sensitivity [dB]")
    was, now = (s.sensitivity[axis] for s in (found.before, found.after))
    good = found.checks["zone"].passed
    head(
        axes,
        f"axis {axis}: {was.peak_db.value:.1f} → {now.peak_db.value:.1f} dB, zone {was.zone} → {now.zone}",
        good=good,
    )


def _over_speed(axes: Axes, found: Design) -> None:
    of = found.over_speed
    assert of is not None
    tops = {name: x[np.isfinite(x)] for name, x in of.peak.items()}
    for (name, peak), color in zip(of.peak.items(), (MEASURED, PREDICTED, BOUND), strict=False):
        shown = 20.0 * np.log10(np.where(np.isfinite(peak), peak, np.nan))
        axes.plot(
            of.speed * _RPM, shown, color=color, marker=".", linestyle="--" if name == "one law" else "-", label=name
        )
    zone_lines(axes)
    axes.set_ylim(0.0, max(_DB[1], min(20.0 * np.log10(max(x.max(initial=1.0) for x in tops.values())) + 2.0, 40.0)))
    axes.set_xlabel("speed [1/min]")
    axes.set_ylabel("peak of sensitivity [dB]")
    lost = [
        f"{name} loses plants at {np.sum(~np.isfinite(x))} speeds"
        for name, x in of.peak.items()
        if len(tops[name]) < x.size
    ]
    head(
        axes, "; ".join(["worst of some plants over the speed", *lost]), good=bool(np.isfinite(of.peak["after"]).all())
    )


def _compliance(axes: Axes, found: Design, axis: str) -> None:
    most = max(s.compliance[axis].largest for s in (found.before, found.after))
    scale, unit = prefixed(most, "m/N")
    tops = [most / scale]
    for name, color in _LOOPS:
        of = found.curves[name]
        mean, high = (x[axis] / scale if axis in x else None for x in (of.compliance, of.softest))
        _between(axes, of.frequency_hz, mean, high, color, name)
        tops += [x.max() for x in (mean, high) if x is not None]
    f = found.curves["after"].frequency_hz
    log_axis(axes.xaxis, float(f[0]), float(f[-1]))
    log_axis(axes.yaxis, _SHALLOW * max(tops), max(tops))
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel(f"compliance [{unit}]")
    was, now = (sized(s.compliance[axis].largest, "m/N") for s in (found.before, found.after))
    head(axes, f"largest {was} → {now}")


def _step(axes: Axes, found: Design, axis: str) -> None:
    steps = [(of.time_s, of.step[axis]) for of in (found.curves[name] for name, _ in _LOOPS)]
    scale, unit = prefixed(max(float(np.max(np.abs(x))) for _, x in steps), "m")
    for (t, x), (name, color) in zip(steps, _LOOPS, strict=True):
        axes.plot(1e3 * t, x / scale, color=color, label=f"{name}, on the estimate")
    axes.set_xlabel("time [ms]")
    axes.set_ylabel(f"deflection [{unit}]")
    was, now = (sized(s.figures.settling, "s") for s in (found.before, found.after))
    head(axes, f"1 N settled in {was} → {now}")


def _between(axes: Axes, f: Array, mean: Array | None, high: Array | None, color: str, name: str) -> None:
    """Draw what the estimate has, and up to where the plants around it go."""
    if mean is not None:
        axes.plot(f, mean, color=color, label=f"{name}, on the estimate")
        if high is not None:
            axes.fill_between(f, mean, high, color=color, alpha=0.25, linewidth=0.0, label=f"{name}, plants around it")
