"""What turns with a rotor, as text and panels: unbalance, runout, correction masses, orbits against the clearance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.arrays import Array
from ambid.report.drawing import BOUND, CYCLE, GREEN, MEASURED, ORANGE, PREDICTED, Block, Panel, head, panel
from ambid.report.numbers import prefixed, quantity, sized
from ambid.report.text import columns, pure, wrapped
from ambid.rotor.estimate import RotorEstimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_RPM = 30.0 / np.pi
_CIRCLE_95 = 2.4477468306808166  # radius that holds 95 % of a round normal distribution, in standard deviations
_UNSEEN = "✗ not identifiable"


# --- text -----------------------------------------------------------------------------------------------------------


def synchronous_lines(estimate: RotorEstimate, width: int) -> list[str]:
    """Return unbalance, runout and correction masses as text; nothing of a rotor that stood still."""
    s = estimate.synchronous
    if not s:
        return []
    lines = columns(unbalance_rows(s))
    if s["hint"]:
        lines += wrapped([s["hint"]], width)
    vibration = vibration_rows(s)
    return [*lines, "", *columns(vibration)] if vibration else lines


def unbalance_rows(s: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a table of what turns with the rotor; 1 g mm is 1e-6 kg m."""
    whole, one = s["unbalance"]["static"], s["unbalance"].get("one_plane")
    known = all(p["identifiable"] for p in s["unbalance"]["planes"].values())
    rows: list[tuple[str, ...]] = [("turns with the rotor", "value ± sd", "phase ± sd", "")]
    rows += [
        _row(f"unbalance, {_plane(name)}", p, f"at {sized(p['z'], 'm', 5)}", 1e6, "g mm")
        for name, p in s["unbalance"]["planes"].items()
    ]
    if known:
        rows.append(_row("unbalance, static", {**whole, "identifiable": True}, _grade(whole), 1e6, "g mm"))
        if one and one["fits"]:
            rows.append(("  all in one plane", quantity(one["z"], one["sd"], "m").text, "", ""))
    rows += [_row(f"{name} beyond", m, "kg^(1/2) mm", 1e3, "") for name, m in s["unbalance"]["modes"].items()]
    rows += [_row(f"runout, {_plane(place)}", r, "", 1e6, "um") for place, r in s["runout"].items()]
    if "balancing" in s:
        rows += [
            _row(f"to add, {_plane(name)}", {**c, "identifiable": True}, "", 1e6, "g mm")
            for name, c in s["balancing"]["correction"].items()
        ]
    return rows


def vibration_rows(s: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a table of the synchronous vibration before and after the correction; empty where none is proposed."""
    found = s.get("balancing", {}).get("vibration", [])
    if not found:
        return []
    speed = {r["record"]: r["speed"] * _RPM for r in s["records"]}
    rows: list[tuple[str, ...]] = [("synchronous motion", "now", "corrected", "at most (95 %)")]
    for x in found:
        of = f"{x['sensor']} at {speed[x['record']]:.5g} rpm"
        rows.append((of, *(sized(x[q], "m") for q in ("before", "after", "at_most"))))
    return rows


def _row(what: str, x: Mapping[str, Any], said: str, scale: float, unit: str) -> tuple[str, ...]:
    if not x["identifiable"]:
        return f"  {what}", f"{scale * x['value']:.3g} {unit}".rstrip(), "", _UNSEEN
    size = f"{pure(scale * x['value'], scale * x['sd'])} {unit}".rstrip()
    certain = x["phase_sd"] < 1.0
    degrees = float(np.degrees(x["phase"]) % 360.0), float(np.degrees(x["phase_sd"]))
    return f"  {what}", size, f"{pure(*degrees)} deg" if certain else "any", said


def _grade(whole: Mapping[str, Any]) -> str:
    """Return the balance quality grade of ISO 21940-11: e W in mm/s."""
    return f"grade G {whole['grade_mm_s']:.3g}"


def _plane(name: str) -> str:
    """Return a plane in words: that of a bearing or of its sensors, or one of the rig's."""
    first, _, last = name.partition(".")
    return f"bearing {first}" if last == "z" else f"sensors of {first}" if last.startswith("z_sensor") else first


# --- figures --------------------------------------------------------------------------------------------------------


def orbit_blocks(estimate: RotorEstimate) -> list[Block]:
    """Return a block for each record at speed: orbits of the bearings, synchronous alone and all against clearance."""
    found = []
    for r in estimate.synchronous.get("records", []):
        sides = [
            [
                panel(_synchronous_orbit, r, name, estimate, height=3.4),
                panel(_whole_orbit, r, name, estimate, height=3.4),
            ]
            for name in r["orbits"]
        ]
        said = estimate.records[r["record"]].get("file") or "record"
        if sides:
            found.append(Block(columns=sides, title=f"{said}: orbits at {r['speed'] * _RPM:.6g} rpm", shared=False))
    return found


def balance_block(s: Mapping[str, Any]) -> Block | None:
    """Return unbalance and correction by plane, and the synchronous motion before and after it; None: none is seen."""
    if not any(p["identifiable"] for p in s["unbalance"]["planes"].values()):
        return None
    sides: list[list[Panel]] = [[panel(_unbalance, s, height=3.6)]]
    if s.get("balancing", {}).get("vibration"):
        sides.append([panel(_vibration, s, height=3.6)])
    return Block(columns=sides, title="unbalance and its correction", shared=False)


def _turns(r: Mapping[str, Any], axes: Sequence[str]) -> tuple[Array, Array]:
    """Return the synchronous orbit of a bearing over one turn, x and y in m."""
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    found = []
    for axis in axes:
        x = r["response"][f"{axis}_position"]
        waves = zip(r["orders"], x["amplitude"], x["phase"], x["sd"], strict=True)
        found.append(sum((a * np.cos(k * angle + p) for k, a, p, sd in waves if a > 3.0 * sd), np.zeros(angle.size)))
    return found[0], found[1]


def _bearing_axes(estimate: RotorEstimate, name: str) -> tuple[str, ...]:
    return next(b.axes for b in estimate.plant.bearings if b.name == name)


def _synchronous_orbit(axes: Axes, r: Mapping[str, Any], name: str, estimate: RotorEstimate) -> None:
    """The synchronous orbit alone, with the point of angle zero and its direction."""
    x, y = _turns(r, _bearing_axes(estimate, name))
    orbit = r["orbits"][name]
    scale, unit = prefixed(max(float(np.max(np.hypot(x, y))), 1e-12), "m")
    axes.plot(x / scale, y / scale, color=PREDICTED, linewidth=1.6, label="synchronous")
    axes.plot(x[0] / scale, y[0] / scale, "o", color=BOUND, markersize=6, label="at angle zero", linestyle="none")
    axes.annotate(
        "", xy=(x[30] / scale, y[30] / scale), xytext=(x[24] / scale, y[24] / scale),
        arrowprops={"arrowstyle": "-|>", "color": PREDICTED, "linewidth": 1.4},
    )  # fmt: skip
    _round(axes, unit)
    turn = "forward" if orbit["forward"] else "backward"
    size = " × ".join(sized(2.0 * orbit[q], "m") for q in ("major", "minor"))
    head(axes, f"bearing {name}: synchronous, {size}, {turn}")


def _whole_orbit(axes: Axes, r: Mapping[str, Any], name: str, estimate: RotorEstimate) -> None:
    """What does not turn with the rotor, as samples, beside the synchronous orbit and the clearance."""
    x, y = _turns(r, _bearing_axes(estimate, name))
    orbit = r["orbits"][name]
    clearance, rest = orbit["clearance"], orbit["non_synchronous"]
    scale, unit = prefixed(max(rest, clearance or 0.0, float(np.max(np.hypot(x, y))), 1e-12), "m")
    own = np.array(orbit["samples"]) / scale
    axes.plot(*own, ".", color=MEASURED, markersize=2.5, alpha=0.6, label="non-synchronous", linestyle="none")
    axes.plot(x / scale, y / scale, color=PREDICTED, linewidth=1.6, label="synchronous")
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    said = f"rest up to {sized(rest, 'm')}"
    good = True
    if clearance:
        axes.plot(clearance / scale * np.cos(angle), clearance / scale * np.sin(angle), color=BOUND, label="clearance")
        share = (rest + orbit["major"]) / clearance
        said, good = f"{said}; together {share:.0%} of the clearance", share < 1.0
    _round(axes, unit)
    head(axes, f"bearing {name}: {said}", good=good)


def _round(axes: Axes, unit: str) -> None:
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"x [{unit}]")
    axes.set_ylabel(f"y [{unit}]")


def _unbalance(axes: Axes, s: Mapping[str, Any]) -> None:
    """Unbalance by plane as arrows in the rotor's own frame, at angle zero x to the right; corrections opposite."""
    planes = s["unbalance"]["planes"]
    unseen = [name for name, p in planes.items() if not p["identifiable"]]
    for k, (name, p) in enumerate(planes.items()):
        color, value = CYCLE[k % len(CYCLE)], 1e6 * p["value"] * np.exp(1j * p["phase"])
        if name in unseen:
            continue
        axes.annotate(
            "", xy=(value.real, value.imag), xytext=(0, 0),
            arrowprops={"arrowstyle": "-|>", "color": color, "linewidth": 1.8, "shrinkA": 0, "shrinkB": 0},
        )  # fmt: skip
        axes.plot([0, value.real], [0, value.imag], color=color, label=f"unbalance, {_plane(name)}")
        turn = np.linspace(0.0, 2.0 * np.pi, 61)
        spread = _CIRCLE_95 * (1e6 * p["sd"] * np.cos(turn) + 1j * abs(value) * p["phase_sd"] * np.sin(turn))
        region = value + spread * np.exp(1j * p["phase"])
        axes.plot(region.real, region.imag, color=color, linewidth=0.8)
        c = s.get("balancing", {}).get("correction", {}).get(name)
        if c is not None:
            at = 1e6 * c["value"] * np.exp(1j * c["phase"])
            axes.plot(
                at.real, at.imag, "o", color=color, markersize=8, markerfacecolor="white", linestyle="none",
                label=f"to add, {_plane(name)}",
            )  # fmt: skip
    axes.axhline(0, color=MEASURED, linewidth=0.5)
    axes.axvline(0, color=MEASURED, linewidth=0.5)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("to the mark of angle zero [g mm]")
    axes.set_ylabel("90° on from x to y [g mm]")
    whole = s["unbalance"]["static"]
    if unseen:
        head(axes, f"not identifiable: {', '.join(_plane(name) for name in unseen)}", good=False)
    else:
        head(axes, f"unbalance {1e6 * whole['value']:.4g} g mm, {_grade(whole)}; 95 % regions")


def _vibration(axes: Axes, s: Mapping[str, Any]) -> None:
    """The synchronous motion at each sensor before and after the correction, with its 95 % bound."""
    found = s["balancing"]["vibration"]
    speed = {r["record"]: r["speed"] * _RPM for r in s["records"]}
    many = len({x["record"] for x in found}) > 1
    scale, unit = prefixed(max(max(x["before"], x["at_most"]) for x in found), "m")
    at = np.arange(len(found))
    axes.bar(at - 0.2, [x["before"] / scale for x in found], 0.36, color=ORANGE, label="now")
    after = np.array([x["after"] / scale for x in found])
    bound = np.array([x["at_most"] / scale for x in found])
    axes.bar(at + 0.2, after, 0.36, color=GREEN, label="corrected")
    axes.errorbar(
        at + 0.2, after, [np.zeros(at.size), bound - after], fmt="none", ecolor="black", capsize=3, elinewidth=1.0,
        label="at most, 95 %",
    )  # fmt: skip
    names = [x["sensor"].removesuffix("_position") + (f"\n{speed[x['record']]:.0f}" if many else "") for x in found]
    axes.set_xticks(at, names)
    axes.set_ylabel(f"amplitude [{unit}]")
    head(axes, "synchronous motion at the sensors, runout taken off")
