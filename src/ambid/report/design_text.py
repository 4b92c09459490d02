"""The design of a controller as tables for the terminal: both loops, the worst plant, the new [loop]."""

from __future__ import annotations

import numpy as np

from ambid.control.design import FIGURES, Design
from ambid.report.margins_text import opening_cells
from ambid.report.numbers import sized
from ambid.report.text import (
    WIDTH,
    Paint,
    columns,
    ending,
    joined,
    plain,
    record_line,
    wrapped,
)
from ambid.report.verification import verification_lines
from ambid.simulation.margins import STANDARD, zone_of

_NONE = "–"
NAMES = {
    "peak": "peak of sensitivity", "compliance": "compliance, largest", "noise": "noise in the command",
    "settling": "force step settled", "pole": "slowest pole",
}  # fmt: skip


def design_text(found: Design, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write a design, below its verdict."""
    head = record_line(found, f"controller for model {found.model}", paint)
    return joined(
        [
            [head, *wrapped([_goals(found)], width, "  ")],
            _figures(found, paint),
            _speeds(found, paint),
            _margins(found, paint),
            _simulated(found, width, paint),
            _plants(found, width, paint),
            _loop(found, paint),
            *ending(found, width=width, paint=paint),
        ]
    )


def said(name: str, x: float) -> str:
    """Write a figure."""
    if not np.isfinite(x):
        return _NONE
    if name == "peak":
        return f"{20.0 * np.log10(x):.2f} dB ({zone_of(x)})"
    return sized(x, {**FIGURES, "pole": "1/s"}[name])


def _goals(found: Design) -> str:
    limits = ", ".join(f"{name} up to {said(name, x).partition(' (')[0]}" for name, x in found.goals.limits.items())
    return f"method {found.method}; small: {' and '.join(found.goals.minimise)}; limits on all plants: {limits}"


def _figures(found: Design, paint: Paint) -> list[str]:
    rows: list[tuple[str, ...]] = [("", "before", "after", "worst before", "worst after")]
    for name, words in NAMES.items():
        of = [getattr(x, name) for s in (found.before, found.after) for x in (s.figures, s.worst)]
        rows.append((words, *(said(name, of[k]) for k in (0, 2, 1, 3))))
    if len(found.after.sensitivity) > 1:
        both = (said("peak", s.singular) for s in (found.before, found.after))
        rows.append(("largest singular value", *both, "", ""))
    n = found.plants["verification"]
    held = [f"{int(str(n)) - s.unstable} of {n}" for s in (found.before, found.after)]
    rows.append(("plants that are held", "", "", *held))
    head = paint(f"both loops: on the estimate, and the worst of {n} plants around it", "strong")
    return [head, *columns(rows), f"in brackets: zones of {STANDARD}; check their limits against its text"]


def _speeds(found: Design, paint: Paint) -> list[str]:
    of = found.over_speed
    if of is None:
        return []
    rows = [("rpm", *of.peak), *((f"{w * 30.0 / np.pi:.0f}", *(said("peak", x[k]) for x in of.peak.values()))
                                 for k, w in enumerate(of.speed))]  # fmt: skip
    return [paint("highest peak over the speed, of some plants that judge", "strong"), *columns(rows)]


def _margins(found: Design, paint: Paint) -> list[str]:
    rows: list[tuple[str, ...]] = [("axis", "opened at", "loop", "gain", "phase", "delay", "disk margin")]
    for axis in found.after.margins:
        for place in ("position", "command"):
            for words, s in (("before", found.before), ("after", found.after)):
                rows.append(
                    (
                        axis,
                        place.replace("command", "input"),
                        words,
                        *opening_cells(getattr(s.margins[axis], place))[:4],
                    )
                )
    return [paint("margins on the estimate, one loop opened", "strong"), *columns(rows)]


def _simulated(found: Design, width: int, paint: Paint) -> list[str]:
    if not found.trials:
        return []
    return verification_lines((found.trials["before"], found.trials["after"]), width=width, paint=paint)


def _plants(found: Design, width: int, paint: Paint) -> list[str]:
    worst, of = found.worst_plant, found.plants
    assumed = of["assumed"]
    assert isinstance(assumed, list | tuple)
    peak = f"{worst.peak_db:.2f} dB, zone {worst.zone}" if np.isfinite(worst.peak_db) else "not held"
    again = f", {of['rejected']} drawn again" if of["rejected"] else ""
    lines = [
        f"tuned over {of['tuning']} plants, judged by {of['verification']} others{again}; the worst, draw "
        f"{worst.number}: {peak}, with {worst.words}",
        *(str(x) for x in assumed),
    ]
    return [paint("plants", "strong"), *wrapped(lines, width, "  ")]


def _loop(found: Design, paint: Paint) -> list[str]:
    loops = found.before.loop, found.after.loop
    if found.after.loop["kind"] != "pid":
        A = found.after.loop["A"]
        assert isinstance(A, list | tuple)
        return [paint("the new [loop]", "strong"), f"a state-space law of order {len(A)}"]
    rows: list[tuple[str, ...]] = [("", "before", "after", "")]
    units = {"kp": "V/m", "ki": "V/(m s)", "kd": "V s/m", "kc": "V/A", "derivative_cutoff_hz": "Hz"}
    for name, unit in units.items():
        rows.append((name, *(_NONE if of.get(name) is None else f"{float(str(of[name])):.5g}" for of in loops), unit))
    return [paint("the new [loop]", "strong"), *columns(rows)]
