"""The acceptance report: items of the standards as tables, a part each with its limits and figures."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from ambid.control.acceptance import PARTS, Acceptance, Item, Part
from ambid.control.limits import LIMITS
from ambid.estimation.result import RecordEntry
from ambid.report.acceptance_figures import figures
from ambid.report.document import (
    Checks,
    Column,
    Document,
    Fitting,
    Lines,
    Section,
    Table,
    Warnings,
    grid,
    timing_section,
)
from ambid.report.document import Part as PartOfPage
from ambid.report.drawing import Block, stacked
from ambid.report.estimate import rig_sections
from ambid.report.numbers import quantity, sized
from ambid.report.text import Cell, names_words, other_warnings, pure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_RPM = 30.0 / math.pi
_OUTCOMES: dict[str, tuple[str, str]] = {
    "passed": ("within the limit", "good"), "doubt": ("in doubt", "doubt"), "failed": ("not within the limit", "bad"),
    "reported": ("reported", ""), "missing": ("these records cannot show it", "doubt"),
}  # fmt: skip
_OF_PART: dict[Part, tuple[str, ...]] = {
    "sensitivity": ("sensitivity", "sensitivity C"), "vibration": ("displacement",),
    "critical": ("amplification", "separation"), "unbalance": ("unbalance", "vibration", "scaled"),
}  # fmt: skip
_KINDS = {"rest": "at rest", "speed": "at speed", "run-up": "run-up or coast-down", "stops": "along the stops"}
_OWN = {"kg m": (1e6, "g mm"), "rad/s": (_RPM, "1/min")}  # units that people read
_NONE = "–"


def acceptance_document(a: Acceptance, used: Any) -> Document:
    """Describe the acceptance of a machine."""
    records = [RecordEntry.of(r) for r in a.records]
    name = str(a.rig.get("name") or _NONE)
    low, top = (x * _RPM for x in a.speeds)
    speeds = f"{low:.6g} to {top:.6g} 1/min" if low < top else f"{top:.6g} 1/min"
    drawn = figures(a, used or ())
    sections = list[Section]()
    for k, part in enumerate(PARTS, 1):
        own, of_part = drawn.get(part, []), _part(a, k, part)
        if len(own) == 1:
            _, caption, draw = own[0]
            sections.append(replace(of_part, figure=partial(_draw, draw), note=caption))
            continue
        sections.append(of_part)
        sections += [
            Section(title=f"{k}. {title}", caption=caption, terminal=False, figure=partial(_draw, draw))
            for title, caption, draw in own
        ]  # fmt: skip
    return Document(
        title=f"{names_words([r.name for r in records])}, acceptance of a rotor on {len(a.estimate.plant.axes)} axes",
        headline=f"Acceptance: {name}",
        subtitle=f"ISO 14839-2, ISO 14839-3, API 617 (9th edition); continuous operation at {speeds}",
        sections=[
            *sections, _conditions(a),
            Section(title="Checks", parts=[Checks(checks=a.checks, above=True)]),
            Section(parts=[Warnings(warnings=other_warnings(a.checks, a.warnings))]), timing_section(a.timing_s),
        ],
        figure=lambda width: stacked(
            f"acceptance: {name}", [b for x in drawn.values() for *_, draw in x for b in draw()], width
        ),
        frame=lambda: ("item", _columns(a)), drawings=tuple, appendix=lambda: rig_sections(a.rig),
        provenance=[(r.name, f"SHA-256 {r.sha256 or _NONE}") for r in records],
        history=[f"{r.name}: {step}" for r in records for step in r.history],
    )  # fmt: skip


def _draw(draw: Callable[[], list[Block]], width: float) -> Figure:
    return stacked("", draw(), width)


def _columns(a: Acceptance) -> dict[str, list[object]]:
    names = ("part", "value", "sd", "unit", "limit", "outcome", "words")
    return {"item": [x.what for x in a.items], **{n: [getattr(x, n) for x in a.items] for n in names}}


def _part(a: Acceptance, k: int, part: Part) -> Section:
    """One part: its items, then the limits with their sources."""
    items = a.of(part)
    columns = [
        Column(cell=lambda x: x.what), Column(label="outcome", cell=lambda x: _OUTCOMES[x.outcome]),
        Column(label="measured", cell=_measured, sparse=True), Column(label="limit", cell=_limit, sparse=True),
        Column(cell=lambda x: (x.words, ""), sparse=True),
    ]  # fmt: skip
    said = Lines(lines=[f"{x.what}: {x.words}" for x in items if x.words], indent=2)
    narrow: tuple[PartOfPage, ...] = (Table(columns=columns[:-1], rows=items), said)
    title = f"{k}. {PARTS[part]}"
    wide = [Table(columns=columns, rows=items)]
    limits = [f"Limit: {LIMITS[n].figure}. {LIMITS[n].source}." for n in _OF_PART.get(part, ())]
    return Section(
        heading=[(title, "strong")], title=title,
        parts=[Fitting(wide=wide, narrow=lambda _: narrow), Lines(lines=limits, style="dim")],
    )  # fmt: skip


def _limit(x: Item) -> str:
    return "" if x.limit is None else _sized(x.limit, x.unit) + ("" if x.confirmed else " (unconfirmed)")


def _measured(x: Item) -> str:
    if x.value is None:
        return _NONE
    if not x.sd:
        return _sized(x.value, x.unit)
    scale, unit = _OWN.get(x.unit, (0.0, ""))
    return f"{pure(scale * x.value, scale * x.sd)} {unit}" if scale else quantity(x.value, x.sd, x.unit).text


def _sized(value: float, unit: str) -> str:
    scale, own = _OWN.get(unit, (0.0, ""))
    return f"{scale * value:{'.0f' if abs(scale * value) >= 1e4 else '.4g'}} {own}" if scale else sized(value, unit, 4)


def _conditions(a: Acceptance) -> Section:
    """The records, clearances, calibrations: the conditions of the test."""
    rows: list[tuple[Cell, ...]] = [("record", "what", "speed", "length", "taken", "SHA-256")]
    for r in a.records:
        e, speed = RecordEntry.of(r), float(str(r["speed"])) * _RPM
        turning = f"up to {speed:.5g} 1/min" if r["kind"] == "run-up" else f"{speed:.6g} 1/min" if speed else _NONE
        taken = str(r.get("started") or _NONE)
        length = f"{e.seconds:.4g} s at {e.rate_hz:g} Hz"
        rows.append((e.name, _KINDS[str(r["kind"])], turning, length, taken, (e.sha256[:16] or _NONE, "")))
    calibration: list[tuple[Cell, ...]] = [("calibration", "channels")]
    calibration += [(said, (roles, "")) for roles, said in a.calibration.items()]
    clear = "not given" if a.clearance is None else sized(a.clearance, "m")
    return Section(
        heading=[("9. Conditions of the test", "strong")], title="9. Conditions of the test",
        parts=[grid(rows), Lines(lines=[f"radial clearance in the touch-down bearings: {clear}"]), grid(calibration)],
    )  # fmt: skip
