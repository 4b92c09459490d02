"""What two loops did on the nonlinear simulator, beside each other: a table for the terminal, and panels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ambid.control.verification import KINDS, Case, Verification
from ambid.report.drawing import BOUND, MEASURED, PREDICTED, Block, head, panel
from ambid.report.numbers import prefixed, sized
from ambid.report.text import Paint, columns, plain, wrapped

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_NONE = "–"
_RPM = 30.0 / np.pi
_DRAWN = (*KINDS[:4], "run-up")
_MEANING = (
    "limits, quantisation and delay act; lift-off: time to rest, overshoot; force step, impact: largest deflection, "
    "time to rest; noise: rms of position and command; else the largest deflection"
)
_REST = 1.6  # settling times that are drawn
_BEYOND = 3.0  # of a panel's other curve and of the stops: what is farther is cut off

Pair = tuple[Sequence[Verification], Sequence[Verification]]
"""Both loops, before and after, on the same plants: the estimate first."""


def verification_lines(loops: Pair, *, width: int, paint: Paint = plain) -> list[str]:
    """Write the worst case of each kind, on the estimate and over the other plants, and what is assumed."""
    many = len(loops[0]) > 1
    parts = [[v[:1] for v in loops], *([[v[1:] for v in loops]] if many else [])]
    rows = [("", "before", "after", *(("worst before", "worst after") if many else ()))]
    for kind in KINDS:
        cells = [_cell(_worst(found, kind)) for part in parts for found in part]
        if any(cell != _NONE for cell in cells):
            rows.append((kind, *cells))
    title = "nonlinear simulation: on the estimate"
    title += f", and the worst of {len(loops[0]) - 1} other plants" if many else ""
    sizes = [
        f"{kind} of {sized(c.size, c.unit)}" for kind in KINDS[1:3] for c in loops[0][0].of_kind(kind)[:1] if c.size
    ]
    told = [*([", ".join(sizes)] if sizes else []), *loops[0][0].assumed]
    return [paint(title, "strong"), *columns(rows), *wrapped([_MEANING, *told], width, "  ")]


def _worst(found: Sequence[Verification], kind: str) -> Case | None:
    """Return the case that failed, else the one that moved most."""
    cases = [case for v in found for case in v.of_kind(kind)]

    def far(case: Case) -> tuple[bool, float]:
        return not case.passed, math.inf if case.peak is None else case.peak

    return max(cases, key=far, default=None)


def _cell(case: Case | None) -> str:
    if case is None:
        return _NONE
    if case.peak is None:
        return "breaks off"
    if case.contact:
        return "touches a stop"
    at = "never" if case.settling_s is None else sized(case.settling_s, "s")
    if case.kind == "lift-off":
        return at if case.settling_s is None or not case.size else f"{at}, {100.0 * case.peak / abs(case.size):.0f} %"
    if case.rms is not None:
        return f"{sized(case.rms[0], 'm')}, {sized(case.rms[2], case.unit)}"
    return f"{sized(case.peak, 'm')}, {at}" if case.kind in ("force step", "impact") else sized(case.peak, "m")


def verification_block(before: Verification, after: Verification) -> Block:
    """Draw how the rotor moves in both loops on one plant: a panel a kind, of the axis that moves most."""
    shown = [kind for kind in _DRAWN if _worst([after], kind) is not None]
    panels = [panel(_moved, before, after, kind, height=2.2) for kind in shown]
    return Block(
        columns=[panels[k::2] for k in range(min(2, len(panels)))], shared=False,
        title=f"nonlinear simulation of {after.plant}",
    )  # fmt: skip


def _moved(axes: Axes, before: Verification, after: Verification, kind: str) -> None:
    case = _worst([after], kind)
    assert case is not None
    beside = next((x for x in before.of_kind(kind) if x.name == case.name), None)
    pairs = [(beside, "before", MEASURED), (case, "after", PREDICTED)]
    curves = [(x.trace, name, color) for x, name, color in pairs if x is not None and x.trace is not None]
    if not curves:
        head(axes, f"{case.name}: breaks off", good=False)
        return
    largest = max(float(np.abs(trace.position).max()) for trace, _, _ in curves)
    scale, unit = prefixed(largest, "m")
    turning = curves[-1][0].over == "speed"
    span = max(float(trace.at[-1]) for trace, _, _ in curves)
    rests = [x.settling_s for x in (beside, case) if x is not None and x.settling_s]
    if rests and not turning and len(rests) == len(curves):
        span = min(span, _REST * max(rests))
    time, second = (_RPM, "1/min") if turning else _of_time(span)
    for trace, name, color in curves:
        axes.plot(trace.at * time, trace.position / scale, color=color, label=name)
    if after.clearance is not None and after.clearance < _BEYOND * largest:
        for end in (after.clearance,) if turning else (-after.clearance, after.clearance):
            axes.axhline(end / scale, color=BOUND, linestyle=":", linewidth=0.9, label="stop")
    axes.set_xlim(0.0, 1.02 * span * time)
    axes.set_xlabel(f"{'speed' if turning else 'time'} [{second}]")
    axes.set_ylabel(f"{'largest deflection' if turning else 'position'} [{unit}]")
    head(axes, f"{case.name}: {_cell(beside)} → {_cell(case)}", good=case.passed)


def _of_time(span: float) -> tuple[float, str]:
    scale, unit = prefixed(span, "s")
    return 1.0 / scale, unit
