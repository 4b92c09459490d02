"""The acceptance report: items of the standards as tables, a part each with its limits and figures."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.control.acceptance import PARTS, Acceptance, Item, Part
from ambid.control.limits import LIMITS
from ambid.estimation.result import RecordEntry
from ambid.report.document import Checks, Document, Fitting, Lines, Section, Warnings, grid, timing_section
from ambid.report.document import Part as PartOfPage
from ambid.report.drawing import Block, head, log_axis, panel, single, stacked
from ambid.report.estimate import rig_sections
from ambid.report.margins import sensitivity_panel
from ambid.report.numbers import prefixed, quantity, sized
from ambid.report.rotor_drawing import balance_block, orbit_blocks, shapes_block
from ambid.report.text import Cell, names_words, other_warnings, pure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_RPM = 30.0 / math.pi
_OUTCOMES: dict[str, tuple[str, str]] = {
    "passed": ("within the limit", "good"), "doubt": ("in doubt", "doubt"), "failed": ("not within the limit", "bad"),
    "reported": ("reported", ""), "missing": ("these records cannot show it", "doubt"),
}  # fmt: skip
_OF_PART: dict[Part, tuple[str, ...]] = {
    "sensitivity": ("sensitivity", "sensitivity C"), "vibration": ("displacement",),
    "critical": ("amplification", "separation"), "unbalance": ("unbalance", "vibration", "scaled"),
}  # fmt: skip
_KINDS = {"rest": "at rest", "speed": "at speed", "run-up": "run-up or coast-down"}
_NONE = "–"


def acceptance_document(a: Acceptance, _: Any) -> Document:
    """Describe the acceptance of a machine."""
    records = [RecordEntry.of(r) for r in a.records]
    name = str(a.rig.get("name") or _NONE)
    low, top = (x * _RPM for x in a.speeds)
    speeds = f"{low:.6g} to {top:.6g} 1/min" if low < top else f"{top:.6g} 1/min"
    parts = [_part(a, k, part) for k, part in enumerate(PARTS, 1)]
    blocks = {part: draw(a) for part, draw in _FIGURES.items()}

    def drawings() -> list[Section]:
        return [
            Section(title=f"{PARTS[part]}: figures", figure=partial(single, block))
            for part, of_part in blocks.items() for block in of_part
        ]  # fmt: skip

    return Document(
        title=f"{names_words([r.name for r in records])}, acceptance of a rotor on {len(a.estimate.plant.axes)} axes",
        headline=f"Acceptance: {name}",
        subtitle=f"ISO 14839-2, ISO 14839-3, API 617 (9th edition); continuous operation at {speeds}",
        sections=[
            *parts, _conditions(a),
            Section(title="Checks", parts=[Checks(checks=a.checks, above=True)]),
            Section(parts=[Warnings(warnings=other_warnings(a.checks, a.warnings))]), timing_section(a.timing_s),
        ],
        figure=lambda width: stacked(f"acceptance: {name}", [b for x in blocks.values() for b in x], width),
        frame=lambda: ("item", _columns(a)),
        drawings=drawings, appendix=lambda: rig_sections(a.rig),
        provenance=[(r.name, f"SHA-256 {r.sha256 or _NONE}") for r in records],
        history=[f"{r.name}: {step}" for r in records for step in r.history],
    )  # fmt: skip


def _columns(a: Acceptance) -> dict[str, list[object]]:
    names = ("part", "value", "sd", "unit", "limit", "outcome", "words")
    return {"item": [x.what for x in a.items], **{n: [getattr(x, n) for x in a.items] for n in names}}


def _part(a: Acceptance, k: int, part: Part) -> Section:
    """One part: its items, then the limits with their sources."""
    rows: list[tuple[Cell, ...]] = [("", "measured", "limit", "outcome", "")]
    items = a.of(part)
    for x in items:
        limit = "" if x.limit is None else _sized(x.limit, x.unit) + ("" if x.confirmed else " (unconfirmed)")
        rows.append((x.what, _measured(x), limit, _OUTCOMES[x.outcome], (x.words, "")))
    said = Lines(lines=[f"{x.what}: {x.words}" for x in items if x.words], indent=2)
    narrow: tuple[PartOfPage, ...] = (grid([row[:-1] for row in rows]), said)
    limits = [f"Limit: {LIMITS[n].figure}. {LIMITS[n].source}." for n in _OF_PART.get(part, ())]
    title = f"{k}. {PARTS[part]}"
    return Section(
        heading=[(title, "strong")],
        title=title,
        parts=[Fitting(wide=[grid(rows)], narrow=lambda _: narrow), Lines(lines=limits, style="dim")],
    )


def _measured(x: Item) -> str:
    if x.value is None:
        return _NONE
    if not x.sd:
        return _sized(x.value, x.unit)
    return f"{pure(1e6 * x.value, 1e6 * x.sd)} g mm" if x.unit == "kg m" else quantity(x.value, x.sd, x.unit).text


def _sized(value: float, unit: str) -> str:
    return f"{1e6 * value:.4g} g mm" if unit == "kg m" else sized(value, unit, 4)


def _conditions(a: Acceptance) -> Section:
    """The records, clearances, calibrations: the conditions of the test."""
    rows: list[tuple[Cell, ...]] = [("record", "what", "speed", "length", "taken", "SHA-256")]
    for r in a.records:
        e, speed = RecordEntry.of(r), float(str(r["speed"])) * _RPM
        turning = f"up to {speed:.5g} 1/min" if r["kind"] == "run-up" else f"{speed:.6g} 1/min" if speed else _NONE
        taken = str(r.get("started") or _NONE)
        length = f"{e.seconds:.4g} s at {e.rate_hz:g} Hz"
        rows.append((e.name, _KINDS[str(r["kind"])], turning, length, taken, (e.sha256[:16] or _NONE, "")))
    calibration: list[tuple[Cell, ...]] = [("channel", "calibration")]
    calibration += [(role, (said, "")) for role, said in a.calibration.items()]
    clear = "not given" if a.clearance is None else sized(a.clearance, "m")
    return Section(
        heading=[("9. Conditions of the test", "strong")], title="9. Conditions of the test",
        parts=[grid(rows), Lines(lines=[f"radial clearance in the touch-down bearings: {clear}"]), grid(calibration)],
    )  # fmt: skip


# --- figures --------------------------------------------------------------------------------------------------------


def _sensitivity(a: Acceptance) -> list[Block]:
    """A block for each record: the sensitivity of its axes, two beside each other."""
    blocks = []
    for name, m in a.margins.items():
        panels = [panel(sensitivity_panel, m, axis, height=2.2) for axis in m.sensitivity]
        columns = [panels[0::2], panels[1::2]] if len(panels) > 1 else [panels]
        blocks.append(Block(columns=columns, title=f"sensitivity in {name}"))
    return blocks


def _stiffness(a: Acceptance) -> list[Block]:
    if a.stiffness is None:
        return []
    sides = [[panel(_dynamic, a, what, height=2.6)] for what in ("stiffness", "damping")]
    return [Block(columns=sides, title="bearings: force on the rotor by its displacement", shared=False)]


def _dynamic(axes: Axes, a: Acceptance, what: str) -> None:
    """Stiffness or damping of the bearings over frequency, of either sign."""
    assert a.stiffness is not None
    f = a.stiffness.frequency_hz
    if what == "stiffness":
        curves, name, unit = dict(a.stiffness.real), "stiffness", "N/m"
    else:
        curves = {axis: x / (2.0 * np.pi * f) for axis, x in a.stiffness.imaginary.items()}
        name, unit = "damping", "N s/m"
    size = np.abs(np.concatenate(list(curves.values())))
    scale, unit = prefixed(float(np.quantile(size, 0.3)), unit)
    for axis, x in curves.items():
        axes.plot(f, x / scale, label=axis)
    axes.set_yscale("symlog", linthresh=float(np.quantile(size, 0.3)) / scale)
    log_axis(axes.xaxis, float(f[0]), float(f[-1]))
    top = a.speeds[1] / (2.0 * np.pi)
    if f[0] < top < f[-1]:
        axes.axvline(top, color="#777777", linestyle=":", linewidth=0.9, label="maximum speed")
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel(f"{name} [{unit}]")
    head(axes, f"{name} of the bearings")


def _modes(a: Acceptance) -> list[Block]:
    e = a.estimate
    return [shapes_block({p: e.numbers[p] for p in e.plant.places}, e.modes)] if e.modes else []


def _balance(a: Acceptance) -> list[Block]:
    block = balance_block(a.estimate.synchronous) if a.estimate.synchronous else None
    return [] if block is None else [block]


_FIGURES: dict[Part, Callable[[Acceptance], list[Block]]] = {
    "sensitivity": _sensitivity, "vibration": lambda a: orbit_blocks(a.estimate), "bearings": _stiffness,
    "unbalance": _balance, "collocation": _modes,
}  # fmt: skip
