"""Modes of vibration as tables for the terminal."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from ambid.arrays import Array
from ambid.estimation.modes import EstimatedNumber, Modal, Mode
from ambid.report.numbers import quantity, sized
from ambid.report.text import (
    WIDTH,
    Paint,
    check_lines,
    columns,
    joined,
    other_warnings,
    plain,
    timing_lines,
    title_line,
    warning_lines,
)
from ambid.settings.caller import setting

_OUTPUTS = 8  # whose shape a terminal shows
_FIELDS = {"frequency": "frequency_hz", "damping": "damping"}
_ALIKE = 0.8  # assurance from which two shapes are called alike


def modal_text(modal: Modal, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write modes that were found without a response: what from, the table, checks."""
    record = modal.record
    name, samples = str(record.get("file") or "record"), int(str(record.get("samples", 0)))
    rate = float(str(record.get("rate_hz", 1.0)))
    head = [title_line(name, "operational modes", samples, rate, modal.status, paint)]
    head += textwrap.wrap(f"of {', '.join(modal.outputs)}; {modal.method}", width)
    warnings = warning_lines(other_warnings(modal.checks, modal.warnings), width=width, paint=paint)
    body = modal_body(modal, width=width, paint=paint)
    return joined([head, [body], warnings, timing_lines(modal.timing_s, width=width, paint=paint)])


def modal_body(modal: Modal, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write modes, their shapes and their checks."""
    low, high = modal.band_hz
    first = f"modes between {sized(low, 'Hz')} and {sized(high, 'Hz')}: {len(modal.modes)}"
    return joined(
        [
            [paint(first, "strong"), *mode_lines(modal.modes)],
            shape_lines(modal.modes, modal.outputs, width),
            [] if modal.mac is None else mac_lines(modal.mac, modal.modes, modal.against),
            check_lines(modal.checks, width=width, paint=paint, above=True),
        ]
    )


def mode_lines(modes: Sequence[Mode]) -> list[str]:
    """Write frequency and damping of each mode, one a line."""
    if not modes:
        return []
    rows: list[tuple[str, ...]] = [("", "frequency", "damping", "")]
    for k, m in enumerate(modes, 1):
        hidden = [name for name in ("frequency", "damping") if not getattr(m, _FIELDS[name]).identifiable]
        said = f"{' and '.join(hidden)} not identifiable" if hidden else ""
        rows.append((str(k), _number(m.frequency_hz, "Hz"), _number(m.damping, "%", 100.0), said))
    return columns(rows, right=(0,))


def _number(x: EstimatedNumber, unit: str, scale: float = 1.0) -> str:
    return quantity(scale * x.value, scale * x.sd, unit).text


def shape_lines(modes: Sequence[Mode], outputs: Sequence[str], width: int) -> list[str]:
    """Write the shape of each mode over the outputs, largest 1; a part that is a quarter of a period late with j."""
    names = [o for o in outputs if modes and o in modes[0].shape][:_OUTPUTS]
    if len(names) < 2:
        return []
    rows: list[tuple[str, ...]] = [("shape", *(str(k) for k in range(1, len(modes) + 1)))]
    rows += [(name, *(_cell(m.complex_shape[name]) for m in modes)) for name in names]
    right = tuple(range(1, len(modes) + 1))
    most = max((width - max(map(len, names)) - 2) // (2 + max(len(c) for row in rows for c in row[1:])), 1)
    lines = list[str]()
    for begin in range(0, len(modes), most):
        part = [(row[0], *row[1 + begin : 1 + begin + most]) for row in rows]
        lines += columns(part, right=right[: len(part[0]) - 1])
    rest = len(outputs) - len(names)
    return [*lines, *([f"… and {rest} outputs more; {setting('json')} has them all"] if rest > 0 else [])]


def _cell(x: complex) -> str:
    late = f"{x.imag:+.2f}j" if abs(x.imag) > 0.1 else ""
    return f"{x.real:.2f}{late}"


def mode_table(modes: Sequence[Mode]) -> dict[str, list[object]]:
    """Return modes as columns, one row each."""
    table: dict[str, list[object]] = {"mode": list(range(1, len(modes) + 1))}
    for name in ("frequency_hz", "damping"):
        numbers = [getattr(m, name) for m in modes]
        table |= {name: [x.value for x in numbers], f"{name} sd": [x.sd for x in numbers]}
        table |= {f"{name} low": [x.ci95[0] for x in numbers], f"{name} high": [x.ci95[1] for x in numbers]}
    table["identifiable"] = [m.identifiable for m in modes]
    return table | {f"shape {o}": [m.complex_shape[o] for m in modes] for o in (modes[0].shape if modes else ())}


def mac_lines(assurance: Array, rows: Sequence[Mode], across: Sequence[Mode]) -> list[str]:
    """Write the modal assurance criterion of modes with others, by frequency; * from 0.8 on: alike."""
    if not (rows and across):
        return ["the estimate has no mode in this band"] if rows else []
    head = ("MAC", *(f"{m.frequency_hz.value:.4g} Hz" for m in across))
    body = [
        (f"{m.frequency_hz.value:.4g} Hz", *(f"{x:.2f}{'*' if x >= _ALIKE else ' '}" for x in values))
        for m, values in zip(rows, assurance, strict=True)
    ]
    return columns([head, *body], right=tuple(range(1, len(head))))
