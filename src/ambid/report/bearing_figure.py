"""Figures of a nonlinear bearing: its curves with bands, where the records were, and every record beside its model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.bearing.magnet.problem import BearingRecord
from ambid.bearing.magnet.result import Curve, Curves, NonlinearBearingEstimate
from ambid.report._drawing import BOUND, MEASURED, NORMAL_99, PREDICTED, curve, grid, note
from ambid.report.numbers import prefixed
from ambid.validate.nonlinear_bearing import replay

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


_LEVELS = 3  # currents or positions for which a curve is drawn
_POINTS = 121
_BEYOND = 0.1  # part of the usual range by which curves go beyond it
_CLOUD = 1500  # points of a record in the map
_ROW = 1.5  # height of a record, inches


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BearingTrace:
    """One record beside what the model says of it."""

    name: str
    held: bool  # whether the rotor was held, so that its position is not predicted
    time_s: Array  # (n_used,), s
    # (n_used, 2), position in m and current in A: measured, predicted from all samples before, and the standard
    # deviation that the predictor expects of the difference; NaN for what is not predicted
    measured: Array
    predicted: Array
    sd: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BearingEvidence:
    """What the figures of a nonlinear bearing show."""

    estimate: NonlinearBearingEstimate
    traces: tuple[BearingTrace, ...]  # one for each of its records


def bearing_evidence(
    estimate: NonlinearBearingEstimate, records: Sequence[tuple[BearingRecord, float]]
) -> BearingEvidence:
    """Run the records of an estimate through it again."""
    traces = []
    for name, (record, start_s) in zip(estimate.noise, records, strict=True):
        run = replay(estimate, record, noise_of=name)
        traces.append(
            BearingTrace(
                name=name,
                held=record.held,
                time_s=start_s + (run.first + np.arange(run.measured.shape[0])) / record.rate_hz,
                measured=run.measured,
                predicted=run.predicted,
                sd=run.sd,
            )
        )
    return BearingEvidence(estimate=estimate, traces=tuple(traces))


def bearing_overview(evidence: BearingEvidence) -> Figure:
    """Draw all figures on one page.

    Returns curves; where the records were; every record with its one-step errors.
    """
    from matplotlib.figure import Figure

    drawings = _drawings(evidence)
    heights = [height for height, _ in drawings.values()]
    page = Figure(figsize=(11.0, sum(heights) + 0.5), layout="constrained")
    page.suptitle(f"{_title(evidence)}: {evidence.estimate.law}", fontsize=13)
    parts: Any = page.subfigures(len(drawings), 1, height_ratios=heights)
    for part, (_, draw) in zip(parts, drawings.values(), strict=True):
        draw(part, evidence)
    return page


def bearing_figures(evidence: BearingEvidence) -> dict[str, Figure]:
    """Draw the figures one by one, as a report shows them.

    Returns ``curves``, ``map`` and ``records``.
    """
    from matplotlib.figure import Figure

    found = {}
    for name, (height, draw) in _drawings(evidence).items():
        found[name] = Figure(figsize=(11.0, height + 0.2), layout="constrained")
        draw(found[name], evidence)
    return found


def _drawings(evidence: BearingEvidence) -> dict[str, tuple[float, Any]]:
    records = 0.7 + _ROW * len(evidence.traces)
    return {"curves": (3.6, _curves), "map": (3.6, _map), "records": (records, _records)}


def _title(evidence: BearingEvidence) -> str:
    names = list(evidence.estimate.noise)
    return names[0] if len(names) == 1 else f"{len(names)} records"


def _wide(limits: tuple[float, float]) -> Array:
    low, high = limits
    beyond = _BEYOND * (high - low)
    return np.linspace(low - beyond, high + beyond, _POINTS)


def _curves(figure: Figure | SubFigure, evidence: BearingEvidence) -> None:
    """k_i, k_x and L over the position at some currents."""
    e = evidence.estimate
    x, levels = _wide(e.usual["position"]), np.linspace(*e.usual["current"], _LEVELS)
    scale, unit = prefixed(float(np.max(np.abs(x))), "m")
    axes = figure.subplots(1, 3)
    found = [e.curves(x, level) for level in levels.tolist()]
    for a, name, meaning in zip(
        axes, ("k_i", "k_x", "L"), ("force per current", "stiffness", "inductance"), strict=True
    ):
        size, shown = _unit_of(found, name)
        for k, (level, at) in enumerate(zip(levels, found, strict=True)):
            inside = at.coil_inside if name == "L" else at.inside
            _banded(a, x / scale, getattr(at, name), inside, size, f"C{k}", f"at {level:.3g} A")
        a.set_xlabel(f"position [{unit}]")
        a.set_ylabel(f"{name} [{shown}]")
        a.set_title(f"{meaning} {name}", fontsize=10)
        grid(a)
    axes[0].legend(loc="best", fontsize=8, framealpha=0.85)
    figure.suptitle("curves with 95 % bands; dotted where the free rotor did not come (L: no record)", fontsize=10)


def _unit_of(found: Sequence[Curves], name: str) -> tuple[float, str]:
    largest = max(float(np.max(np.abs(getattr(at, name).value))) for at in found)
    return prefixed(largest, getattr(found[0], name).unit)


def _banded(axes: Axes, x: Array, c: Curve, inside: NDArray[np.bool_], scale: float, color: str, label: str) -> None:
    axes.fill_between(x, c.low / scale, c.high / scale, color=color, alpha=0.25, linewidth=0)
    axes.plot(x, c.value / scale, ":", color=color, linewidth=1.2)
    axes.plot(x, np.where(inside, c.value / scale, np.nan), "-", color=color, linewidth=1.6, label=label)


def _map(figure: Figure | SubFigure, evidence: BearingEvidence) -> None:
    """Where the records were, and L over the current."""
    e = evidence.estimate
    where, over = figure.subplots(1, 2, width_ratios=(3, 2))
    scale, unit = prefixed(float(np.max(np.abs(e.coil_hull[:, 0]))), "m")
    for k, t in enumerate(evidence.traces):
        every = max(1, t.measured.shape[0] // _CLOUD)
        used = t.measured[np.isfinite(t.predicted[:, 1])][::every]
        x, i = used[:, 0] / scale, used[:, 1]
        where.plot(x, i, "." if not t.held else "|", color=f"C{k % 10}", markersize=2.5, alpha=0.5)
        where.plot([], [], "o" if not t.held else "|", color=f"C{k % 10}", markersize=5, label=t.name)
    for hull, width in ((e.hull, 1.2), (e.coil_hull, 0.6)):
        corners = np.vstack([hull, hull[:1]])
        where.plot(corners[:, 0] / scale, corners[:, 1], "-", color=MEASURED, linewidth=width)
    _balance(where, e, scale)
    where.set_xlabel(f"position [{unit}]")
    where.set_ylabel("current [A]")
    where.set_title("where the records were; hulls of the free rotor and of all", fontsize=10)
    where.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=7, framealpha=0.85)
    low, high = e.coil_hull[:, 1].min(), e.coil_hull[:, 1].max()
    currents, levels = np.linspace(low, high, _POINTS), np.linspace(*e.usual["position"], _LEVELS)
    found = [e.curves(np.full(_POINTS, x), currents) for x in levels.tolist()]
    size, shown = _unit_of(found, "L")
    for k, (x, at) in enumerate(zip(levels, found, strict=True)):
        _banded(over, currents, at.L, at.coil_inside, size, f"C{k}", f"at {x / scale:.3g} {unit}")
    over.set_xlabel("current [A]")
    over.set_ylabel(f"L [{shown}]")
    over.set_title("inductance over the current", fontsize=10)
    over.legend(loc="best", fontsize=8, framealpha=0.85)
    grid(where, over)


def _balance(axes: Axes, e: NonlinearBearingEstimate, scale: float) -> None:
    """The line on which one magnet carries the weight: where a rotor at rest has to be, whatever the dynamics say."""
    weight = e.values["m"] * e.values["g"]
    if e.law.pair or weight == 0.0:
        return
    x, i = np.meshgrid(_wide(e.usual["position"])[::4], np.linspace(*e.range["current"], 60))
    force = e.curves(x.ravel(), i.ravel()).force.value.reshape(x.shape)
    axes.contour(x / scale, i, force + weight, levels=[0.0], colors="black", linewidths=1.4, linestyles="--")
    axes.plot([], [], "--", color="black", linewidth=1.4, label="carries the weight")


def _records(figure: Figure | SubFigure, evidence: BearingEvidence) -> None:
    """Each record: position and current, measured and predicted, and what the predictor missed."""
    traces = evidence.traces
    axes = figure.subplots(len(traces), 4, squeeze=False, sharex="row", width_ratios=(3, 3, 2, 2))
    for row, t in zip(axes, traces, strict=True):
        for c, unit in enumerate(("m", "A")):
            whole, missed = row[c], row[2 + c]
            if c == 0 and t.held:
                x, shown = prefixed(abs(float(t.measured[:, 0].mean())), "m")
                held = f"held at {float(t.measured[:, 0].mean()) / x:.4g} {shown}"
                whole.text(0.5, 0.5, held, ha="center", va="center", fontsize=9, transform=whole.transAxes)
                whole.axis("off")
                missed.axis("off")
                continue
            _outputs(whole, t, c, unit)
            _missed(missed, t, c)
        row[0].set_title(t.name, fontsize=9, loc="left")
        grid(*[a for a in row if a.axison])
        for a in row:
            a.tick_params(labelsize=7)
            a.set_axisbelow(True)
            a.locator_params(axis="x", nbins=5)
    for a, title in zip(
        axes[0], ("position", "current", "errors of position / sd", "errors of current / sd"), strict=True
    ):
        a.set_title(title, fontsize=9, loc="right" if a is axes[0][0] else "center")
    for a in axes[-1]:
        a.set_xlabel("time [s]", fontsize=8)
    figure.suptitle(
        "measured (grey), predicted one step ahead (blue), and what the predictor missed (99 % bounds)", fontsize=10
    )


def _outputs(axes: Axes, t: BearingTrace, c: int, unit: str) -> None:
    scale, shown = prefixed(float(np.max(np.abs(t.measured[:, c]))), unit)
    curve(axes, t.time_s, t.measured[:, c] / scale, MEASURED, None)
    curve(axes, t.time_s, t.predicted[:, c] / scale, PREDICTED, None)
    axes.set_ylabel(f"[{shown}]", fontsize=8)


def _missed(axes: Axes, t: BearingTrace, c: int) -> None:
    e = (t.measured[:, c] - t.predicted[:, c]) / t.sd[:, c]
    curve(axes, t.time_s, e, MEASURED, None)
    for side in (-NORMAL_99, NORMAL_99):
        axes.axhline(side, color=BOUND, linewidth=0.8, linestyle="--")
    reach = max(1.3 * NORMAL_99, float(np.nanquantile(np.abs(e), 0.999)))
    axes.set_ylim(-1.15 * reach, 1.15 * reach)
    note(axes, f"{100 * float(np.mean(np.abs(e[np.isfinite(e)]) > NORMAL_99)):.2g} % outside")
