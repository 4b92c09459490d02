"""Panels of a rotor: its side view with bearing and sensor planes, mode shapes along it, and its Campbell diagram."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.arrays import Array
from ambid.estimation.modes import Mode
from ambid.estimation.result import NORMAL_95
from ambid.physics.shaft import FreeRotor, Shaft
from ambid.physics.whirl import Campbell
from ambid.report.document import Lines, Section, grid
from ambid.report.drawing import BOUND, CYCLE, GREEN, MEASURED, ORANGE, PREDICTED, SKY, Block, Panel, head, panel
from ambid.report.numbers import prefixed, quantity, sized
from ambid.report.text import pure
from ambid.rotor.estimate import RotorEstimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_STEEL, _DISC = "#d9dde2", "#b9c2cc"

_WIDEST = 0.45  # of the length: what a disc given by its mass alone is drawn like, at most

_FORWARD, _BACKWARD = PREDICTED, ORANGE

_EXPECTED = 3  # modes of a drawing that are looked at beyond those identified

_PLANAR = 0.02  # of a circular orbit, under which a whirl has no direction


def shapes_block(planes: Mapping[str, float], modes: Sequence[Mode] = (), *, shaft: Shaft | None = None) -> Block:
    """Draw a rotor from the side, and below it each mode: identified at the planes, with a drawing along the shaft.

    `planes`: of bearings and sensors by the names of the model (``A.z``, ``A.z_sensor``), m from the datum; the shapes
    of `modes` have the same names and modal mass 1 kg. With a drawing, modes that it expects below the highest
    identified one are shown, too; without identified ones its first three.
    """
    drawn = None if shaft is None else expected_rotor(modes, shaft, list(planes.values()))
    partners = partners_of(modes, drawn)
    pairs: list[tuple[Mode | None, int | None]] = list(zip(modes, partners, strict=True))
    if drawn is not None:
        top = max((k for k in partners if k is not None), default=_EXPECTED - 1)
        pairs += [(None, k) for k in range(top + 1) if k not in partners]
        pairs.sort(key=lambda pair: _hertz(drawn, pair[1]) if pair[0] is None else pair[0].frequency_hz.value)
    ends = _ends(planes, shaft)
    rows = [panel(_side, planes, shaft, drawn, ends, height=1.7)]
    rows += [panel(_shape, mode, k, planes, drawn, ends, modes, height=1.35) for mode, k in pairs]
    return Block(columns=[rows])


def expected_rotor(modes: Sequence[Mode], shaft: Shaft, planes: Sequence[float] = ()) -> FreeRotor:
    """Return the rotor of a drawing with as many bending modes as identified ones are looked for among."""
    return shaft.free_rotor(len(modes) + _EXPECTED, planes=planes)


def partners_of(modes: Sequence[Mode], drawn: FreeRotor | None) -> list[int | None]:
    """Return which bending mode of a drawing, from 0, each identified mode is: the nearest in frequency, in order.

    None where there is no drawing, or it has no mode left.
    """
    from scipy.optimize import linear_sum_assignment

    partners: list[int | None] = [None] * len(modes)
    if drawn is None or not modes:
        return partners
    own = np.log([mode.frequency_hz.value for mode in modes])
    apart = np.abs(own[:, None] - np.log(drawn.omega[2:] / (2 * np.pi)))
    for row, k in zip(*linear_sum_assignment(apart), strict=True):
        partners[row] = int(k)
    return partners


def campbell_panel(
    identified: Campbell | None = None,
    *,
    drawn: Campbell | None = None,
    sd: Array | None = None,
    speeds: Sequence[float] = (),
) -> Panel:
    """Draw whirl frequencies over speed: identified lines, with 95 % bands from `sd`; those of a drawing dashed, grey
    where both are drawn.

    `sd`: standard deviations of the identified frequencies in rad/s, (n_speeds, n_lines); `speeds`: at which records
    were taken, rad/s. Where a line meets the speed itself (1x), a critical
    speed is marked.
    """
    return panel(_campbell, identified, drawn, sd, speeds, height=4.2)


def _hertz(drawn: FreeRotor, k: int | None) -> float:
    """Natural frequency of a bending mode of a drawing, from 0."""
    return math.inf if k is None else float(drawn.omega[k + 2]) / (2 * math.pi)


def _ends(planes: Mapping[str, float], shaft: Shaft | None) -> tuple[float, float]:
    """Left and right end of what is drawn, m."""
    low, high = min(planes.values()), max(planes.values())
    room = 0.08 * (high - low) or 0.1
    if shaft is None:
        return low - room, high + room
    return min(low - room, shaft.z), max(high + room, shaft.z + shaft.length)


def _side(
    axes: Axes, planes: Mapping[str, float], shaft: Shaft | None, drawn: FreeRotor | None, ends: tuple[float, float]
) -> None:
    """The rotor from the side, in millimetres, with its planes and centre of gravity."""
    widest = _body(axes, shaft) if shaft is not None else 0.06 * (ends[1] - ends[0])
    half = 0.5 * widest
    if shaft is None:
        axes.plot([1e3 * x for x in ends], [0, 0], color=MEASURED, linewidth=3, solid_capstyle="round")
    for name, z in planes.items():
        bearing = name.endswith(".z")
        color, mark = (BOUND, "s") if bearing else (GREEN, "v")
        label = "bearing plane" if bearing else "sensor plane"
        reach = 1e3 * half * 1.25
        axes.vlines(1e3 * z, -reach, reach, color=color, linewidth=0.9, linestyle="-" if bearing else ":", zorder=3)
        axes.plot(1e3 * z, reach, mark, color=color, markersize=6, label=label, linestyle="none", zorder=4)
        if bearing:
            axes.text(
                1e3 * z, 1e3 * half * 1.45, name.removesuffix(".z"), ha="center", va="bottom", fontsize=8, color=color
            )
    if drawn is not None:
        axes.plot(
            1e3 * drawn.z_cg, 0, "o", color="black", markersize=5, markerfacecolor="white", linestyle="none",
            label="centre of gravity (drawing)", zorder=5,
        )  # fmt: skip
    axes.axhline(0, color=MEASURED, linewidth=0.6, linestyle="-.", zorder=2)
    axes.set_xlim(*(1e3 * x for x in ends))
    axes.set_ylim(-1e3 * half * 1.3, 1e3 * half * 1.95)
    if shaft is None:
        axes.set_yticks([])
    else:
        axes.set_ylabel("radius [mm]")
    axes.grid(visible=False)
    total = "" if shaft is None or drawn is None else f", {drawn.mass[0]:.3g} kg, {1e3 * shaft.length:.0f} mm long"
    head(axes, f"rotor from the side{total}")


def _body(axes: Axes, shaft: Shaft) -> float:
    """Draw steps and discs, bores left white; return the largest diameter drawn, m."""
    from matplotlib.patches import Rectangle

    def ring(z: float, width: float, outer: float, inner: float, color: str, order: float) -> None:
        for low, high in ((inner / 2, outer / 2), (-outer / 2, -inner / 2)):
            corner, size = (1e3 * z, 1e3 * low), (1e3 * width, 1e3 * (high - low))
            axes.add_patch(Rectangle(corner, *size, facecolor=color, edgecolor=MEASURED, linewidth=0.5, zorder=order))

    z, widest = shaft.z, max(step.diameter for step in shaft.steps)
    for step in shaft.steps:
        ring(z, step.length, step.diameter, step.bore, _STEEL, 1.0)
        z += step.length
    for disc in shaft.discs:  # a ring of the same mass and polar moment, as a drawing gives neither size
        ends = shaft.z + np.cumsum([step.length for step in shaft.steps])
        inner = shaft.steps[min(int(np.searchsorted(ends, disc.z)), len(shaft.steps) - 1)].diameter
        outer = math.sqrt(max(8 * disc.Ip / disc.m - inner**2, 0.0)) if disc.m else 0.0
        outer = min(max(outer, 1.5 * inner), _WIDEST * shaft.length)
        volume = disc.m / shaft.material.rho
        width = min(4 * volume / (math.pi * max(outer**2 - inner**2, 1e-12)), 0.2 * shaft.length)
        ring(disc.z - width / 2, width, outer, inner, _DISC, 0.9)
        widest = max(widest, outer)
    return widest


def _shape(
    axes: Axes,
    mode: Mode | None,
    k: int | None,
    planes: Mapping[str, float],
    drawn: FreeRotor | None,
    ends: tuple[float, float],
    modes: Sequence[Mode],
) -> None:
    """One mode along the shaft, identified, from the drawing (its mode `k`), or both; the drawing takes its sign."""
    words = ["not identified"]
    at = [name for name in planes if mode is not None and name in mode.shape]
    z = np.array([planes[name] for name in at])
    value = np.array([mode.shape[name].value for name in at]) if mode is not None else np.zeros(0)
    if mode is not None:
        number = 1 + next(i for i, x in enumerate(modes) if x is mode)
        f, damping = mode.frequency_hz, mode.damping
        words = [f"mode {number}: {f.value:.5g} Hz ± {NORMAL_95 * f.sd:.2g}, damping {100 * damping.value:.3g} %"]
        sd = np.array([mode.shape[name].sd for name in at])
        axes.errorbar(
            1e3 * z, value, NORMAL_95 * sd, fmt="o", color=PREDICTED, markersize=4.5, elinewidth=1.0, capsize=2.5,
            label="identified, 95 %", zorder=4,
        )  # fmt: skip
    if drawn is not None and k is not None:
        along = np.linspace(drawn.z[0], drawn.z[-1], 301)
        line = drawn.deflection(along)[:, k + 2]
        side = float(value @ drawn.deflection(z)[:, k + 2]) if z.size else 1.0
        axes.plot(
            1e3 * along, math.copysign(1.0, side) * line, color=MEASURED, linestyle="--", label="from the drawing"
        )
        words.append(f"drawing {_hertz(drawn, k):.5g} Hz")
    for name, plane in planes.items():
        axes.axvline(1e3 * plane, color=BOUND if name.endswith(".z") else GREEN, linewidth=0.7, linestyle=":", zorder=1)
    axes.axhline(0, color=MEASURED, linewidth=0.6)
    axes.set_xlim(*(1e3 * x for x in ends))
    axes.set_ylabel("shape [kg$^{-1/2}$]")
    axes.set_xlabel("along the shaft, from the datum [mm]")
    head(axes, "; ".join(words))


def _campbell(
    axes: Axes, identified: Campbell | None, drawn: Campbell | None, sd: Array | None, speeds: Sequence[float]
) -> None:
    """Frequencies in Hz over speed in 1/min."""
    diagrams = [x for x in (identified, drawn) if x is not None]
    most = max(float(x.speed[-1]) for x in diagrams)
    if identified is not None:
        _lines(axes, identified, sd, {})
    if drawn is not None:
        apart = {"color": MEASURED, "label": "from the drawing", "linewidth": 1.0} if identified is not None else {}
        _lines(axes, drawn, None, {"linestyle": "--", **apart})
    criticals = []  # where lines meet the speed, forward ones alone, which unbalance excites, in 1/min
    for c in diagrams[0].critical_speeds():
        forward = c.direction > -_PLANAR
        axes.plot(
            c.speed * 30 / np.pi, c.speed / (2 * np.pi), "o", markersize=6, markeredgecolor=BOUND, linestyle="none",
            markerfacecolor=BOUND if forward else "white", zorder=5,
            label="critical speed" if forward else "backward whirl at 1x",
        )  # fmt: skip
        if forward:
            criticals.append(f"{c.speed * 30 / np.pi:.0f}")
    at = np.array([0.0, most])
    axes.plot(at * 30 / np.pi, at / (2 * np.pi), color=MEASURED, linewidth=0.9, label="speed itself (1x)")
    for speed in speeds:
        axes.axvline(speed * 30 / np.pi, color=GREEN, linewidth=0.9, linestyle=":", label="speed of a record")
    axes.set_xlim(0, most * 30 / np.pi)
    axes.set_ylim(0, None)
    axes.set_xlabel("speed [1/min]")
    axes.set_ylabel("frequency of whirl [Hz]")
    many = "speed" if len(criticals) == 1 else "speeds"
    remark = f"critical {many} {', '.join(criticals)} 1/min" if criticals else "no critical speed up to here"
    head(axes, f"{remark}, without bearings")


def _lines(axes: Axes, which: Campbell, sd: Array | None, style: Mapping[str, Any]) -> None:
    """The lines of one diagram with bands, in the colour of their direction over the upper half of the speeds."""
    x, f = which.speed * 30 / np.pi, which.frequency / (2 * np.pi)
    for k in range(f.shape[1]):
        finite = np.isfinite(f[:, k])
        if not finite.any():
            continue
        way = float(np.mean(which.direction[finite, k][-max(1, int(finite.sum()) // 2) :]))
        color, label = (_FORWARD, "forward") if way > _PLANAR else (_BACKWARD, "backward")
        color, label = (SKY, "in a plane") if abs(way) <= _PLANAR else (color, label)
        axes.plot(x, f[:, k], **{"color": color, "label": label, "linewidth": 1.6, **style})
        if sd is not None:
            half = NORMAL_95 * sd[:, k] / (2 * np.pi)
            axes.fill_between(x, f[:, k] - half, f[:, k] + half, color=color, alpha=0.25, linewidth=0)


_RPM = 30.0 / np.pi

_CIRCLE_95 = 2.4477468306808166  # radius that holds 95 % of a round normal distribution, in standard deviations

_UNSEEN = "✗ not identifiable"


# --- text -----------------------------------------------------------------------------------------------------------


def synchronous_sections(estimate: RotorEstimate) -> list[Section]:
    """Return unbalance, runout and correction masses; nothing of a rotor that stood still."""
    s = estimate.synchronous
    if not s:
        return []
    vibration = vibration_rows(s)
    note = "" if s["hint"] else "1 g mm is 1e-6 kg m."
    hint = Lines(lines=[s["hint"]] if s["hint"] else [])
    motion = Section(parts=[grid(vibration)] if vibration else [])
    return [Section(title="Unbalance and runout", parts=[grid(unbalance_rows(s)), hint], note=note), motion]


def unbalance_rows(s: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a table of what turns with the rotor; 1 g mm is 1e-6 kg m."""
    whole, one = s["unbalance"]["static"], s["unbalance"].get("one_plane")
    identifiable = all(p["identifiable"] for p in s["unbalance"]["planes"].values())
    rows: list[tuple[str, ...]] = [("turns with the rotor", "value ± sd", "phase ± sd", "")]
    rows += [
        _row(f"unbalance, {_plane(name)}", p, f"at {sized(p['z'], 'm', 5)}", 1e6, "g mm")
        for name, p in s["unbalance"]["planes"].items()
    ]
    if identifiable:
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
    vibration = s.get("balancing", {}).get("vibration", [])
    if not vibration:
        return []
    speed = {r["record"]: r["speed"] * _RPM for r in s["records"]}
    rows: list[tuple[str, ...]] = [("synchronous motion", "now", "corrected", "at most (95 %)")]
    for x in vibration:
        label = f"{x['sensor']} at {speed[x['record']]:.5g} rpm"
        rows.append((label, *(sized(x[q], "m") for q in ("before", "after", "at_most"))))
    return rows


def _row(what: str, x: Mapping[str, Any], text: str, scale: float, unit: str) -> tuple[str, ...]:
    if not x["identifiable"]:
        return f"  {what}", f"{scale * x['value']:.3g} {unit}".rstrip(), "", _UNSEEN
    size = f"{pure(scale * x['value'], scale * x['sd'])} {unit}".rstrip()
    certain = x["phase_sd"] < 1.0
    degrees = float(np.degrees(x["phase"]) % 360.0), float(np.degrees(x["phase_sd"]))
    return f"  {what}", size, f"{pure(*degrees)} deg" if certain else "any", text


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
    blocks = []
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
            blocks.append(Block(columns=sides, title=f"{said}: orbits at {r['speed'] * _RPM:.6g} rpm", shared=False))
    return blocks


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
    turns = []
    for axis in axes:
        x = r["response"][f"{axis}_position"]
        waves = zip(r["orders"], x["amplitude"], x["phase"], x["sd"], strict=True)
        turns.append(sum((a * np.cos(k * angle + p) for k, a, p, sd in waves if a > 3.0 * sd), np.zeros(angle.size)))
    return turns[0], turns[1]


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
    remark = f"rest up to {sized(rest, 'm')}"
    good = True
    if clearance:
        axes.plot(clearance / scale * np.cos(angle), clearance / scale * np.sin(angle), color=BOUND, label="clearance")
        share = (rest + orbit["major"]) / clearance
        remark, good = f"{remark}; together {share:.0%} of the clearance", share < 1.0
    _round(axes, unit)
    head(axes, f"bearing {name}: {remark}", good=good)


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
    vibration = s["balancing"]["vibration"]
    speed = {r["record"]: r["speed"] * _RPM for r in s["records"]}
    many = len({x["record"] for x in vibration}) > 1
    scale, unit = prefixed(max(max(x["before"], x["at_most"]) for x in vibration), "m")
    at = np.arange(len(vibration))
    axes.bar(at - 0.2, [x["before"] / scale for x in vibration], 0.36, color=ORANGE, label="now")
    after = np.array([x["after"] / scale for x in vibration])
    bound = np.array([x["at_most"] / scale for x in vibration])
    axes.bar(at + 0.2, after, 0.36, color=GREEN, label="corrected")
    axes.errorbar(
        at + 0.2, after, [np.zeros(at.size), bound - after], fmt="none", ecolor="black", capsize=3, elinewidth=1.0,
        label="at most, 95 %",
    )  # fmt: skip
    names = [x["sensor"].removesuffix("_position") + (f"\n{speed[x['record']]:.0f}" if many else "") for x in vibration]
    axes.set_xticks(at, names)
    axes.set_ylabel(f"amplitude [{unit}]")
    head(axes, "synchronous motion at the sensors, runout taken off")
