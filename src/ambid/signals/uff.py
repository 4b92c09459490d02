"""Universal files (UFF, UNV): frequency responses and coherence of dataset 58, ASCII and binary.

Its records by columns: SDRC, Universal File Datasets Summary. Units are those of the axis labels; without a label, of
the quantity where dataset 164 says SI.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ambid.arrays import Array, Complex
from ambid.errors import RecordError, UnitError
from ambid.units import UNKNOWN, parse_unit


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Function:
    """One response of a file, from one input to one output."""

    output: str
    input: str
    frequency_hz: Array
    values: Complex  # SI where the units are known
    units: tuple[str, str] = (UNKNOWN, UNKNOWN)  # of output and input, as the file has them
    sd: Array | None = None  # of the complex number
    coherence: Array | None = None


_NUMBER = re.compile(rb"[+-]?(?:\d+\.?\d*|\.\d+)(?:[EeDd][+-]?\d+)?")
_DIRECTIONS = {0: "", 1: "X", 2: "Y", 3: "Z", 4: "RX", 5: "RY", 6: "RZ"}
_QUANTITIES = {8: "m", 9: "N", 11: "m/s", 12: "m/s^2", 13: "N", 15: "Pa"}  # SI units of specific data types
_FRF, _COHERENCE = (4, 5), 6  # function types; 5 is transmissibility


def read_uff(path: Path, data: bytes, told: Mapping[str, str]) -> tuple[list[Function], int]:
    """Return the responses of datasets 58, with the coherence of each, and how many other functions there are."""
    found: list[Function] = []
    coherence: dict[tuple[str, str], Array] = {}
    left, system = 0, 0
    for number, body, binary in _datasets(path, data):
        if number == 164:
            system = int(body[0][:10])
        if number != 58:
            continue
        kind, function = _function(path, body, binary, len(found) + left + 1, system, told)
        if kind == _COHERENCE:
            coherence[function.output, function.input] = function.values.real
        elif kind in _FRF:
            found.append(function)
        else:
            left += 1
    return [replace(f, coherence=coherence.get((f.output, f.input))) for f in found], left


def _datasets(path: Path, data: bytes) -> Iterator[tuple[int, list[bytes], tuple[str, bytes] | None]]:
    """Yield number, lines and, of a binary one, byte order with the bytes behind its first lines."""
    at, seen = 0, 0
    while True:
        begin = re.compile(rb"^ {4}-1[ \t]*\r?\n", re.M).search(data, at)
        if begin is None:
            break
        end_of_head = data.find(b"\n", begin.end())
        head = data[begin.end() : end_of_head].decode("latin-1")
        if head.strip() == "-1":  # an end too many: this one may be a beginning
            at = begin.end()
            continue
        seen += 1
        try:
            number, binary = int(head[:6]), head[6:7].lower() == "b"
            order, form, n_lines, size = (
                (int(head[a:b]) for a, b in ((7, 13), (13, 19), (19, 31), (31, 43))) if binary else (0,) * 4
            )
        except ValueError:
            raise RecordError(
                f"{path}: dataset {seen} begins with {head[:40]!r}, not with its number. It is damaged"
            ) from None
        if binary:
            if order not in (1, 2) or form != 2:
                raise RecordError(f"{path}: dataset {seen} is binary in a form that is not IEEE. Export it as ASCII")
            cut = end_of_head + 1
            for _ in range(n_lines):
                cut = data.find(b"\n", cut) + 1
                if cut == 0:
                    raise RecordError(f"{path}: dataset {seen} ends within its head: it is cut off. Copy it again")
            lines = data[end_of_head + 1 : cut].splitlines()
            # writers announce wrong sizes of complex values: the end that follows decides
            sizes = [size, *_sizes(lines)]
            ends = [k for k in sizes if re.match(rb"[\r\n]*[ ]*-1\s", data[cut + k : cut + k + 12] + b"\n")]
            if not ends:
                raise RecordError(
                    f"{path}: dataset {seen} is cut off or damaged: no end after its {size} bytes. Copy it again"
                )
            block = data[cut : cut + ends[0]]
            at = data.find(b"-1", cut + ends[0]) + 2
            yield number, lines, ("<" if order == 1 else ">", block)
            continue
        end = re.compile(rb"^ {4}-1[ \t]*\r?$", re.M).search(data, end_of_head + 1)
        if end is None:
            raise RecordError(f"{path}: dataset {seen} has no end (a line -1): it is cut off. Copy it again")
        yield number, data[end_of_head + 1 : end.start()].splitlines(), None
        at = end.end()
    if not seen:
        raise RecordError(
            f"{path} is no universal file: no line holds -1 alone. Copy it again, or name its real format"
        )


def _sizes(lines: Sequence[bytes]) -> list[int]:
    """Return the bytes that a binary function needs by its head; abscissas are in single precision, or as the rest."""
    try:
        form, n, even = (int(lines[6][a : a + 10]) for a in (0, 10, 20))
    except (ValueError, IndexError):
        return []
    value = {2: 4, 4: 8, 5: 8, 6: 16}.get(form, 0)
    return [n * value] if even else [n * (value + 4), n * (value + (8 if form in (4, 6) else 4))]


def _function(
    path: Path, body: Sequence[bytes], binary: tuple[str, bytes] | None, count: int, system: int,
    told: Mapping[str, str],
) -> tuple[int, Function]:  # fmt: skip
    """Read a function of dataset 58: records 6 to 12."""
    where = f"{path}: function {count}"
    lines = [x.decode("latin-1").ljust(80) for x in body[:11]]
    if len(lines) < 11:
        raise RecordError(f"{where} has {len(lines)} of 11 lines of its head: it is cut off. Copy it again")
    try:
        kind = int(lines[5][:5])
        dofs = [_dof(lines[5][a : a + 24]) for a in (31, 56)]
        form, n, even = (int(lines[6][a : a + 10]) for a in (0, 10, 20))
        first, step = (float(lines[6][a : a + 13].replace("D", "E")) for a in (30, 43))
        axes = [(int(line[:10]), line[47:67].strip()) for line in lines[7:10]]
    except ValueError:
        raise RecordError(f"{where}: its head is damaged (records 6 to 10 of dataset 58). Export it again") from None
    if form not in (2, 4, 5, 6) or n < 1 or even not in (0, 1):
        raise RecordError(f"{where}: data type {form} or {n} values are none of dataset 58. It is damaged")
    if kind in _FRF and form not in (5, 6):
        raise RecordError(f"{where} is real; a frequency response has a phase. Export it complex")
    x, values = _values(where, body[11:], binary, form, n, bool(even))
    frequency = np.asarray(first + step * np.arange(n) if x is None else x, dtype=np.float64)
    over = axes[0][1] or "Hz"
    if kind in _FRF and (axes[0][0] not in (0, 18) or over not in ("Hz", "kHz", "rad/s", "NONE")):
        raise RecordError(f"{where} is over [{over}], not over frequency. Export the frequency response")
    scale = {"kHz": 1e3, "rad/s": 1 / (2 * np.pi)}.get(over, 1.0)
    factor, units = 1.0, [UNKNOWN, UNKNOWN]
    for k, (quantity, text) in enumerate(axes[1:]):
        if text and text != "NONE" and kind in _FRF:
            if system > 1 and told.get("units") != "labels":
                raise RecordError(
                    f"{where} is labelled [{text}], and dataset 164 says units of system {system}, not SI. Say that "
                    "the labels hold: --layout units=labels; or export in SI"
                )
            try:
                unit = parse_unit(text)
            except UnitError:
                continue
            if text != "g":
                units[k], factor = unit.symbol, factor * (unit.scale if k == 0 else 1 / unit.scale)
        elif system == 1 and quantity in _QUANTITIES:
            units[k] = _QUANTITIES[quantity]
    return kind, Function(
        output=dofs[0] or "output", input=dofs[1] or "input", frequency_hz=scale * frequency,
        values=factor * values, units=(units[0], units[1]),
    )  # fmt: skip


def _dof(text: str) -> str:
    """Return the name of a degree of freedom: entity, node and direction, such as ``12-Z``."""
    entity, node, direction = text[:10].strip(), int(text[10:20]), int(text[20:24])
    sign = "-" if direction < 0 else ""
    point = f"{node}{sign}{_DIRECTIONS[abs(direction)]}" if abs(direction) in _DIRECTIONS else f"{node}:{direction}"
    named = "" if entity in ("", "NONE") else entity
    return named if named and node == 0 and direction == 0 else f"{named} {point}".strip()


def _values(
    where: str, body: Sequence[bytes], binary: tuple[str, bytes] | None, form: int, n: int, even: bool
) -> tuple[Array | None, Complex]:
    """Return abscissas where they are given, and the values."""
    pair = 2 if form in (5, 6) else 1
    width = pair if even else pair + 1
    if binary is None:
        text = b"\n".join(body)
        numbers = _NUMBER.findall(text)
        if _NUMBER.sub(b"", text).strip():
            bad = _NUMBER.sub(b"", text).split()[0].decode("latin-1")
            raise RecordError(f"{where}: {bad[:20]!r} among its values is not a number. It is damaged: export it again")
        flat = np.array([float(x.replace(b"D", b"E").replace(b"d", b"e")) for x in numbers])
    else:
        order, block = binary
        size = 8 if form in (4, 6) else 4
        if not even and size == 8 and len(block) == n * (4 + 8 * pair):  # abscissas in single precision
            mixed = np.frombuffer(block, np.dtype([("x", f"{order}f4"), ("y", f"{order}f8", (pair,))]))
            flat = np.column_stack([mixed["x"], mixed["y"]]).astype(np.float64).ravel()
        else:
            flat = np.frombuffer(block[: len(block) // size * size], f"{order}f{size}").astype(np.float64)
    if flat.size != n * width:
        raise RecordError(
            f"{where} has {flat.size} of {n * width} numbers that its head announces: it is cut off. Copy it again"
        )
    rows = flat.reshape(n, width)
    values = np.asarray(rows[:, -2] + 1j * rows[:, -1] if pair == 2 else rows[:, -1], dtype=np.complex128)
    return None if even else rows[:, 0], values
