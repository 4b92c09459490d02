"""Figures of the acceptance report: sensitivity, orbits, bearings, run-ups (Bode, polar, waterfall), whirl, modes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.arrays import Complex
from ambid.control.acceptance import Acceptance, Part, Run
from ambid.report.drawing import BOUND, GREEN, MEASURED, ORANGE, PREDICTED, Block, head, panel
from ambid.report.margins import sensitivity_panel, signed_panel
from ambid.report.numbers import prefixed
from ambid.report.rotor_drawing import balance_block, orbit_blocks, shapes_block
from ambid.rotor.passage import changes_speed, positions_of, record_waterfall

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ambid.record import Record
    from ambid.signals.orders import Waterfall

_RPM = 30.0 / math.pi
_CASCADE = 40  # spectra of a waterfall
_COLUMNS = 300  # points of each
_TALL = 6.0  # how many steps of speed the largest amplitude is high
_ORDERS = 3.0  # of the highest speed, up to which a waterfall is drawn
_MARKS = 6  # speeds that are named in a polar plot
_FORCE = (
    "Force of the magnet on the rotor by a displacement that its magnet and sensors see alike, through controller, "
    "coil and the magnet's own k_x: real part, and imaginary part over the angular frequency."
)
_SHAPES = "Where a sensor and its magnet stand on different sides of a node, the loop moves that mode the other way."
_ORBITS = "Above what turns with the rotor, below the rest, the excitation among it, beside the clearance."
_BODE_SAYS = (
    "What turns with the rotor, from blocks of whole turns, run-out of the sensors included, which moves critical "
    "speeds; their spreads hold that where the machine as identified stands beside, else noise alone."
)
_FALLS = "Amplitude spectra over the speed; each line stands at the height of its speed."
_WHIRL = (
    "Where the loop of plant and controller as identified resonates at each speed; beside it the critical speeds that "
    "run-ups show, and modes that noise shows in records at one speed."
)


Drawing = tuple[str, str, Callable[[], list[Block]]]
"""Title, caption, and what draws it."""


def figures(a: Acceptance, used: Sequence[Record]) -> dict[Part, list[Drawing]]:
    """Return the figures of each part; `used`: its records, for what needs them."""
    drawn: dict[Part, list[Drawing]] = {
        "sensitivity": [("Sensitivity", "", partial(_sensitivity, a))] if a.margins else [],
        "bearings": [("Stiffness and damping of the bearings", _FORCE, partial(_stiffness, a))] if a.stiffness else [],
    }
    e = a.estimate
    if e.modes:
        planes = {place: e.numbers[place] for place in e.plant.places}
        drawn["collocation"] = [("Bending modes along the shaft", _SHAPES, lambda: [shapes_block(planes, e.modes)])]
    if e.synchronous:
        drawn["vibration"] = [("Orbits", _ORBITS, partial(orbit_blocks, e))]
        if (block := balance_block(e.synchronous)) is not None:
            drawn["unbalance"] = [("Unbalance and its correction", "", lambda: [block])]
    runs: list[Drawing] = []
    if a.runs:
        runs = [("Bode plots of the run-ups", _BODE_SAYS, partial(_bodes, a)), ("Polar plots", "", partial(_polars, a))]
        if used:
            runs.append(("Waterfalls", _FALLS, partial(_falls, a, used)))
    if a.whirl is not None:
        runs.append(("Campbell diagram", _WHIRL, lambda: [Block(columns=[[panel(_whirl, a, height=3.6)]])]))
    return {**drawn, "critical": runs}


def _sensitivity(a: Acceptance) -> list[Block]:
    """A block for each record: the sensitivity of its axes, two beside each other."""
    blocks = []
    for name, m in a.margins.items():
        panels = [panel(sensitivity_panel, m, axis, height=2.2) for axis in m.sensitivity]
        columns = [panels[0::2], panels[1::2]] if len(panels) > 1 else [panels]
        blocks.append(Block(columns=columns, title=f"sensitivity in {name}"))
    return blocks


def _stiffness(a: Acceptance) -> list[Block]:
    sides = [[panel(_dynamic, a, what, height=2.6)] for what in ("stiffness", "damping")]
    return [Block(columns=sides, title="bearings: force on the rotor by its displacement", shared=False)]


def _dynamic(axes: Axes, a: Acceptance, what: str) -> None:
    """Stiffness or damping of the bearings over frequency, of either sign."""
    assert a.stiffness is not None
    f, curves, unit = a.stiffness.frequency_hz, dict(a.stiffness.real), "N/m"
    if what == "damping":
        curves, unit = {axis: x / (2.0 * np.pi * f) for axis, x in a.stiffness.imaginary.items()}, "N s/m"
    signed_panel(axes, f, curves, what, unit)
    top = a.speeds[1] / (2.0 * np.pi)
    if f[0] < top < f[-1]:
        axes.axvline(top, color="#777777", linestyle=":", linewidth=0.9, label="maximum speed")
    head(axes, f"{what} of the bearings")


def _bodes(a: Acceptance) -> list[Block]:
    blocks = []
    for run in a.runs:
        sides = _planes(a, run).values()
        columns = [[panel(_bode, a, run, roles, what, height=h) for what, h in _BODE] for roles in sides]
        blocks.append(Block(columns=columns, title=run.record))
    return blocks


def _polars(a: Acceptance) -> list[Block]:
    blocks = []
    for run in a.runs:
        columns = [[panel(_polar, run, roles, name, height=3.6)] for name, roles in _planes(a, run).items()]
        blocks.append(Block(columns=columns, title=run.record, shared=False))
    return blocks


def _falls(a: Acceptance, used: Sequence[Record]) -> list[Block]:
    """The waterfall of plane x of each radial bearing."""
    plant, blocks = a.estimate.plant, []
    top = _ORDERS * max(float(run.speed.max()) for run in a.runs) / (2.0 * np.pi)
    for record in (r for r in used if changes_speed(r)):
        fall, every = record_waterfall(record, plant, spectra=_CASCADE, highest_hz=top), positions_of(record, plant)
        roles = [roles[0] for roles in _planes(a, a.runs[0]).values()]
        sides = [[panel(_waterfall, fall, every.index(role), role, height=4.2)] for role in roles]
        title = str(record.provenance.get("file") or "record")
        blocks.append(Block(columns=sides, title=title, shared=False))
    return blocks


_BODE = (("amplitude", 2.2), ("phase", 1.5))


def _planes(a: Acceptance, run: Run) -> Mapping[str, tuple[str, ...]]:
    """Return the positions of the first sensors of each radial bearing."""
    named = {b.name: tuple(f"{axis}_position" for axis in b.axes) for b in a.estimate.plant.bearings if not b.axial}
    return {name: roles for name, roles in named.items() if set(roles) <= set(run.amplitude)}


def _bode(axes: Axes, a: Acceptance, run: Run, roles: Sequence[str], what: str) -> None:
    """Amplitude or phase of what turns with the rotor over its speed."""
    x = run.speed * _RPM
    if what == "amplitude":
        scale, unit = prefixed(max(float(np.abs(run.amplitude[role]).max()) for role in roles), "m")
        for role in roles:
            axes.plot(x, np.abs(run.amplitude[role]) / scale, label=role.rsplit("_", 1)[0])
        axes.set_ylabel(f"amplitude [{unit}]")
        axes.set_ylim(0.0, None)
        head(axes, " and ".join(role.rsplit("_", 1)[0] for role in roles))
    else:
        for role in roles:
            axes.plot(x, np.degrees(np.unwrap(np.angle(run.amplitude[role]))))
        axes.set_ylabel("phase [°]")
    low, top = (s * _RPM for s in a.speeds)
    axes.axvspan(low, top, color=GREEN, alpha=0.12, linewidth=0, label="continuous operation" if low < top else None)
    axes.axvline(top, color=GREEN, linewidth=0.9, linestyle=":", label=None if low < top else "maximum speed")
    axes.set_xlabel("speed [1/min]")


def _polar(axes: Axes, run: Run, roles: Sequence[str], name: str) -> None:
    """The vectors of what turns with the rotor, from speed to speed."""
    scale, unit = prefixed(max(float(np.abs(run.amplitude[role]).max()) for role in roles), "m")
    for role in roles:
        z = run.amplitude[role] / scale
        axes.plot(z.real, z.imag, label=role.rsplit("_", 1)[0], linewidth=1.4)
        steps = np.linspace(0, z.size - 1, _MARKS).round().astype(int)
        axes.plot(z[steps].real, z[steps].imag, "o", color=MEASURED, markersize=3, linestyle="none")
        if role == roles[0]:
            for k in _apart(z, steps):
                axes.annotate(
                    f"{run.speed[k] * _RPM:.0f}", (z[k].real, z[k].imag), xytext=(4, 3), textcoords="offset points",
                    fontsize=7,
                )  # fmt: skip
    axes.axhline(0.0, color=MEASURED, linewidth=0.5)
    axes.axvline(0.0, color=MEASURED, linewidth=0.5)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"in phase with the mark [{unit}]")
    axes.set_ylabel(f"90° ahead [{unit}]")
    head(axes, f"bearing {name}; speeds in 1/min")


def _apart(z: Complex, steps: Any) -> list[int]:
    """Return those of some places whose names do not lie on each other."""
    named = list[int]()
    for k in (int(step) for step in steps):
        if all(abs(z[k] - z[m]) > 0.12 * np.abs(z).max() for m in named):
            named.append(k)
    return named


def _waterfall(axes: Axes, fall: Waterfall, k: int, role: str) -> None:
    """Spectra over the speed, each a line at the height of its speed."""
    order = np.argsort(fall.speed)
    size, f = fall.amplitude[order][:, :, k], fall.frequency_hz
    step = max(1, f.size // _COLUMNS)
    n = f.size // step
    size = size[:, : n * step].reshape(order.size, n, step).max(axis=2)  # no line falls between columns
    f = f[: n * step].reshape(n, step).mean(axis=1)
    speed = fall.speed[order] * _RPM
    scale = _TALL * float(speed[-1] - speed[0]) / order.size / max(float(size.max()), 1e-15)
    for row, at in zip(size, speed, strict=True):
        axes.plot(f, at + scale * row, color=PREDICTED, linewidth=0.6)
    for m, style in ((1, "-"), (2, "--")):
        axes.plot(
            m * speed / 60.0, speed, color=BOUND, linewidth=0.8, linestyle=style, label=f"{m}x of the speed"
        )  # fmt: skip
    axes.set_xlim(0.0, float(f[-1]))
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel("speed [1/min]")
    top, unit = prefixed(float(size.max()), "m")
    head(axes, f"{role.replace('_', ' ')}: largest amplitude {float(size.max()) / top:.3g} {unit}")


def _whirl(axes: Axes, a: Acceptance) -> None:
    """Where the identified loop resonates over the speed, and where the run-ups do."""
    assert a.whirl is not None
    speed = a.whirl.speed * _RPM
    for frequencies, color, label in (
        (a.whirl.forward, PREDICTED, "loop as identified, forward"), (a.whirl.backward, ORANGE, "backward")
    ):  # fmt: skip
        x = np.concatenate([np.full(w.size, s) for s, w in zip(speed, frequencies, strict=True)])
        y = np.concatenate(frequencies) / (2.0 * np.pi)
        axes.plot(x, y, ".", color=color, label=label, linestyle="none", markersize=4)
    axes.plot(speed, speed / 60.0, color=MEASURED, linewidth=0.9, label="speed itself (1x)")
    at = [x for x in a.of("critical") if x.what.startswith("critical speed") and x.value is not None]
    if at:
        w = np.array([float(x.value or 0.0) for x in at])
        axes.plot(
            w * _RPM, w / (2.0 * np.pi), "o", color=BOUND, markersize=6, linestyle="none", label="measured in run-ups"
        )  # fmt: skip
    if a.points:
        x, y = (np.array(v) for v in zip(*((abs(p.speed), p.frequency.value) for p in a.points), strict=True))
        axes.plot(
            x * _RPM, y / (2.0 * np.pi), "s", color=GREEN, markersize=4, linestyle="none", label="shown by noise"
        )  # fmt: skip
    axes.set_xlim(-0.01 * float(speed[-1]), float(speed[-1]))
    axes.set_ylim(0.0, float(speed[-1]) / 60.0 * 1.1)
    axes.set_xlabel("speed [1/min]")
    axes.set_ylabel("frequency [Hz]")
    head(axes, "whirl in the closed loop (Campbell diagram)")
