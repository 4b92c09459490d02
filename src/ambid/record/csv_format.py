"""Records as CSV (contracts.md): ``#`` comments, one header row of ``name [unit]``, then numbers, separated by commas;
by semicolons or tabs where the header has no comma (told in the history). Rows in messages are lines, from 1.
"""

from __future__ import annotations

import gzip
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.errors import RecordError
from ambid.record.clock import TIME_NAMES, Clock, clock_of, dates, rises, timed
from ambid.record.csv_dialect import decoded, named_numbers, recognised, refuse_width
from ambid.record.record import Record, file_bytes, gunzipped, readable, sha256_of
from ambid.record.sampling import (
    MIN_SAMPLES,
    GapPolicy,
    Rows,
    Table,
    check_gap_policy,
    record_of_rows,
    uniform_record,
)
from ambid.record.words import is_time, label_of
from ambid.settings.caller import setting
from ambid.units import UNKNOWN

_REFUSED_IN_NAMES = set(',;\t\n[]"#')


def read_csv(
    path: str | Path,
    *,
    rate_hz: float | None = None,
    gaps: GapPolicy = "error",
    layout: Mapping[str, str] = MappingProxyType({}),
) -> Record:
    """Read a record, all columns but time in SI, from a CSV file, gzipped if it ends in ``.gz``; a missing or unknown
    unit is ``"?"``. `rate_hz`: for a file without a column ``time [s]``.
    """
    check_gap_policy(gaps)
    table, rate = _table(Path(path), gaps, layout, rate_hz)
    return uniform_record(table, rate, gaps)


def read_csv_rows(
    path: str | Path, *, rate_hz: float | None = None, layout: Mapping[str, str] = MappingProxyType({})
) -> Rows:
    """Read the rows as they stand, whatever is missing and however time runs (`ambid.record.sampling.Rows`); as
    `read_csv`.
    """
    return record_of_rows(*_table(Path(path), "cut", layout, rate_hz))


def _table(path: Path, gaps: GapPolicy, layout: Mapping[str, str], rate_hz: float | None) -> tuple[Table, float | None]:
    """Read the header and the numbers, time in s; and the rate, where it is given or stands above the numbers."""
    data = file_bytes(path)
    provenance = {"file": path.name, "sha256": sha256_of(data)}
    if path.suffix.lower() == ".gz":
        data = gunzipped(data, path)
        if not data:
            raise RecordError(f"record {path} is empty inside its gzip wrapping. Export or copy it again")
    elif data[:2] == b"\x1f\x8b":
        raise RecordError(f"record {path} is gzipped although its name does not say so. Rename it to {path.name}.gz")
    plain = None if layout else read_plain(data, path)
    if plain is not None:
        return table_of(path, *plain, provenance, {}, rate_hz)
    text, encoding = decoded(data, path, layout)
    lines = text.split("\n")
    del data, text
    told = {"encoding": encoding} if encoding != "utf-8" else {}
    return table_of_lines(lines, path, gaps, layout, rate_hz, provenance, told)


def table_of_lines(
    lines: list[str], path: Path, gaps: GapPolicy, layout: Mapping[str, str], rate_hz: float | None,
    provenance: dict[str, str], told: Mapping[str, object],
) -> tuple[Table, float | None]:  # fmt: skip
    """Read a text, line by line; `told`: what its reading has told so far, for the history."""
    upright = _upright(lines)
    lines = _labelled(upright, path)
    inserted = lines is not upright
    dialect = recognised(lines, path, layout)
    beside: Mapping[str, tuple[float, str | None]] = {}
    texts: Mapping[str, Sequence[str]] = {}
    if dialect is None:
        header = find_header(lines, path)
    else:
        names, units = _names_and_units(dialect.cells, dialect.row, path, dialect.units)
        header = Header(
            row=dialect.row, delimiter=dialect.delimiter, names=names, comments=dialect.comments, unit_texts=units
        )
        lines, told, beside, texts = dialect.lines, {**dialect.settings, **told}, dialect.beside, dialect.texts
    body, header = data_rows(lines, header.row, path, MIN_SAMPLES), replace(header, inserted=inserted)
    values = read_values(body, header, path, gaps)
    if (long := pivoted(header.names, header.unit_texts, values, texts)) is not None:
        names, units, values = long
        header, told = replace(header, names=names, unit_texts=units), {**told, "long": True}
    return table_of(path, header, values, provenance, {**told, **({"layout": dict(layout)} if layout else {})}, rate_hz,
                    beside, texts)  # fmt: skip


def _upright(lines: list[str]) -> list[str]:
    """Return a text of columns where each line is a channel: a name, and then more numbers than there are lines."""
    few = [x for x in lines if x.strip() and not x.startswith("#")] if len(lines) < _FEW_CHANNELS else []
    mark = next((d for d in ("\t", ";", ",") if few and all(d in x for x in few)), None)
    cells = [x.split(mark) for x in few] if mark else []
    if len(cells) < 2 or len({len(x) for x in cells}) > 1 or len(cells[0]) < max(MIN_SAMPLES + 1, 2 * len(cells)):
        return lines
    if any(np.isfinite(_number(x[0])) or not np.isfinite(_number(x[1].replace(",", "."))) for x in cells):
        return lines
    return [(mark or ",").join(row) for row in zip(*cells, strict=True)]


def _labelled(lines: list[str], path: Path) -> list[str]:
    """Return a text whose cells name themselves, ``u:1.2,i:0.3`` as sketches print for a plotter, with a header row."""
    begin = next((k for k, x in enumerate(lines[:_FEW_CHANNELS]) if _SELF_NAMED.fullmatch(x)), len(lines))
    if not all(map(_SELF_NAMED.fullmatch, lines[begin : begin + MIN_SAMPLES])) or begin + MIN_SAMPLES > len(lines):
        return lines
    found = [[*_PAIR.finditer(x)] if _SELF_NAMED.fullmatch(x) else [] for x in lines[begin:]]
    while found and not lines[begin + len(found) - 1].strip():
        found.pop()
    names = [x["name"] for x in found[0]]
    for k, pairs in enumerate(found, begin + 1):
        if [x["name"] for x in pairs] != names:
            raise RecordError(
                f"{path}, row {k}: its cells are not {', '.join(f'{x}:…' for x in names)}, as those of row {begin + 1} "
                "are. Correct the row, or remove it if it was cut off"
            )
    return [*lines[:begin], ",".join(names), *(",".join(x["number"] for x in pairs) for pairs in found)]


def table_of(
    path: Path, header: Header, values: Array, provenance: dict[str, str], told: Mapping[str, object],
    rate_hz: float | None, beside: Mapping[str, tuple[float, str | None]] = MappingProxyType({}),
    texts: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> tuple[Table, float | None]:  # fmt: skip
    """Find time among the columns."""
    comments = [*header.comments, *notes_of(path, provenance["sha256"])]
    if comments:
        provenance["comment"] = "\n".join(comments)
    layout, place = told.get("layout"), f"{path}, row {header.row}"
    layout = layout if isinstance(layout, Mapping) else {}
    beside = {**named_numbers(header.comments), **beside}
    names, units = header.names, header.unit_texts
    clock = clock_of(names, units, list(values.T), where=str(path), rate_hz=rate_hz, beside=beside, layout=layout)
    settings: dict[str, object] = {"format": "csv", "rows": values.shape[0]}
    settings |= {"delimiter": header.delimiter} if header.delimiter != "," else {}
    settings |= told
    if clock.column is not None:
        name, unit = names[clock.column], units[clock.column]
        values[:, clock.column], said = timed(values[:, clock.column], name, unit, clock.why, place, layout, rate_hz)
        settings |= said
    elif clock.rate_hz is not None:
        settings["time"], rate_hz = clock.why, clock.rate_hz
    elif rate_hz is None and (stamps := next(((k, x) for k, t in texts.items() if (x := dates(t)) is not None), None)):
        names, units, values = (stamps[0], *names), ("s", *units), np.column_stack([stamps[1], values])
        clock, settings["time"] = Clock(column=0), f"{stamps[0]!r}, because it holds dates"
    table = Table(
        where=str(path), names=names, unit_texts=units, values=values, first_row=header.first_row,
        time=clock.column, provenance=provenance, settings=settings,
    )  # fmt: skip
    return table, rate_hz


def pivoted(
    names: Sequence[str], units: Sequence[str | None], values: Array, texts: Mapping[str, Sequence[str]]
) -> tuple[tuple[str, ...], tuple[str | None, ...], Array] | None:
    """Turn a long table, rows of time, name and value, into one of columns; None where it is none."""
    if values.shape[1] != 2 or not texts:
        return None
    key = next((k for k, x in texts.items() if 1 < len(set(x)) < 33 and len(x) % len(set(x)) == 0), None)
    if key is None:
        return None
    labels = np.array(texts[key])
    own = {label: values[labels == label] for label in dict.fromkeys(texts[key])}
    first = next(iter(own.values()))
    for at in (0, 1):
        if rises(first[:, at]) and all(
            x.shape == first.shape and np.array_equal(x[:, at], first[:, at]) for x in own.values()
        ):
            unit = {label: x[np.flatnonzero(labels == label)[0]] for label in own for k, x in texts.items() if k != key}
            parts = [label_of(label) for label in own]
            found = [u or unit.get(label) or None for label, (_, u) in zip(own, parts, strict=True)]
            return (
                (names[at], *(name for name, _ in parts)), (units[at], *found),
                np.column_stack([first[:, at], *(x[:, 1 - at] for x in own.values())]),
            )  # fmt: skip
    return None


def write_csv(record: Record, path: str | Path, *, comments: Sequence[str] = ()) -> None:
    """Write a record as CSV in SI, every value read back to the last bit, gzipped if it ends in ``.gz``. History and
    provenance are not kept (HDF5 keeps them); `comments` go into a file beside it (`notes_path`), so that any program
    opens the table.
    """
    path = Path(path)
    lines = head_lines(record)
    for c in record.channels:
        if not np.isfinite(c.values).all():
            k = int(np.argmax(~np.isfinite(c.values)))
            raise RecordError(f"channel {c.name!r}, sample {k} is not finite; CSV holds numbers only. Treat gaps first")
    columns = [record.time_s.tolist(), *(c.values.tolist() for c in record.channels)]
    lines.extend(",".join(map(repr, row)) for row in zip(*columns, strict=True))
    data = ("\n".join(lines) + "\n").encode()
    if path.suffix.lower() == ".gz":
        data = gzip.compress(data, compresslevel=6, mtime=0)  # no date inside: equal records give equal files
    try:
        path.write_bytes(data)
        if comments:
            notes_path(path).write_text(notes_text(path.name, data, comments), encoding="utf-8")
    except OSError as failure:
        raise RecordError(f"{path} cannot be written: {failure.strerror or failure}. Check the folder") from None


def notes_path(path: Path) -> Path:
    """Return the file beside a CSV file that tells of it, named as CSV on the Web (W3C 2015, sec. 5.3) does."""
    return path.with_name(f"{path.name}-metadata.json")


def notes_text(name: str, data: bytes, comments: Sequence[str]) -> str:
    """Return what stands in it: the comments, and the SHA-256 of the file that they belong to."""
    lines = [line for text in comments for line in text.splitlines()]
    notes = {"@context": "http://www.w3.org/ns/csvw", "url": name, "sha256": sha256_of(data), "rdfs:comment": lines}
    return json.dumps(notes, indent=1) + "\n"


def notes_of(path: Path, digest: str) -> tuple[str, ...]:
    """Return the comments beside a CSV file of this SHA-256; none where there are none, or of another file."""
    notes = notes_in(notes_path(path))
    return tuple(map(str, notes["rdfs:comment"])) if notes.get("sha256") == digest else ()


def notes_in(path: Path) -> Mapping[str, Any]:
    """Return what `notes_text` wrote into a file; nothing where it is another one."""
    try:
        with readable(path) as file:
            notes = json.loads(file.read(_LONGEST_NOTES).decode())
    except (RecordError, ValueError, RecursionError):
        return {}
    whole = isinstance(notes, dict) and "sha256" in notes and isinstance(notes.get("rdfs:comment"), list)
    return notes if whole else {}


def head_lines(record: Record) -> list[str]:
    """Return what stands above the numbers: the header row."""
    for c in record.channels:
        if _REFUSED_IN_NAMES & set(c.name) or c.name.lower() in TIME_NAMES:
            raise RecordError(f"channel {c.name!r} cannot be a CSV column: its name would be misread. Rename it")
    units = [c.source_unit if c.unit == UNKNOWN else c.unit for c in record.channels]
    names = [c.name if u == UNKNOWN else f"{c.name} [{u}]" for c, u in zip(record.channels, units, strict=True)]
    return [",".join(["time [s]", *names])]


_HEADER_CELL = re.compile(r"(?P<name>.*?)\s*\[(?P<unit>[^\[\]]*)\]")
_NAMED, _NUMBER = r"[^\W\d][^:=,;\t]*?", r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_PAIR = re.compile(rf"(?P<name>{_NAMED})\s*[:=]\s*(?P<number>{_NUMBER})")
_SELF_NAMED = re.compile(rf"\s*(?:{_NAMED}\s*[:=]\s*{_NUMBER}(?:[\s,;]+|$)){{2,}}")
_BLOCK = 20_000  # rows that are read at once
_FEW_CHANNELS = 64  # lines of which each may be a channel
_LONG = 1 << 23  # bytes from which compiled reading saves more than loading it takes
_LONGEST_NOTES = 1 << 20  # bytes
_HEAD = 1 << 16  # bytes in which the header of a plain file ends


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """The header row: its line number, the delimiter it shows, and the columns it names."""

    row: int
    delimiter: str
    names: tuple[str, ...]
    unit_texts: tuple[str | None, ...]
    comments: tuple[str, ...]
    inserted: bool = False  # it does not stand in the file

    @property
    def first_row(self) -> int:
        """Line of the file in which the numbers begin."""
        return self.row + (not self.inserted)


def find_header(lines: Sequence[str], path: Path) -> Header:
    """Find the header row and take it apart."""
    row = next((k for k, text in enumerate(lines, start=1) if text.strip() and not text.startswith("#")), None)
    if row is None:
        raise RecordError(f"{path} has no header row. Write one row of 'name [unit]', then the numbers")
    line = lines[row - 1]
    comments = [text.lstrip("#").strip() for text in lines[: row - 1] if text.startswith("#")]
    outside = re.sub(r"\[[^\[\]]*\]", "[]", line)
    marks = [d for d in (",", ";", "\t") if d in outside]
    if len(marks) > 1:
        raise RecordError(
            f"{path}, row {row}: the header holds both {marks[0]!r} and {marks[1]!r}; one delimiter only. Use commas"
        )
    if not marks and outside.count("[]") > 1:
        raise RecordError(f"{path}, row {row}: the columns are not separated by commas. Write 'time [s],voltage [V],…'")
    delimiter = marks[0] if marks else ","
    cells = [cell.strip().strip('"').strip() for cell in line.split(delimiter)]
    if all(np.isfinite(_number(cell)) for cell in cells):
        raise RecordError(
            f"{path}, row {row}: numbers instead of the header row. Write one row of 'name [unit]' before them"
        )
    names, units = _names_and_units(cells, row, path)
    return Header(row=row, delimiter=delimiter, names=names, unit_texts=units, comments=tuple(comments))


def _names_and_units(
    cells: Sequence[str], row: int, path: Path, below: Sequence[str | None] | None = None
) -> tuple[tuple[str, ...], tuple[str | None, ...]]:
    """Take the cells of a header row apart; `below`: units that another row gives. Names that occur again are numbered
    where they are of time, or differ in the units of that row.
    """
    refuse_width(len(cells), row, path)
    names, units = list[str](), list[str | None]()
    labels = [_HEADER_CELL.fullmatch(cell) for cell in cells]
    numbered = any(x and x["unit"].isdigit() and x["unit"] != "1" for x in labels)  # Y[0], Y[1]: places in an array
    for j, (cell, match) in enumerate(zip(cells, labels, strict=True)):
        match = None if numbered and match and match["unit"].isdigit() else match
        name, unit = (match["name"].strip(), match["unit"].strip()) if match else (cell, None)
        unit = below[j] if below is not None and below[j] is not None else unit
        if not name:
            raise RecordError(
                f"{path}, row {row}: column {j + 1} has no name. Write 'name [unit]', or remove the delimiter"
            )
        if name in names:
            if not is_time(name) and (below is None or unit == units[names.index(name)]):
                raise RecordError(f"{path}, row {row}: column {name!r} occurs twice; names must differ. Rename one")
            name = next(x for k in range(2, len(cells) + 2) if (x := f"{name} {k}") not in names)
        names.append(name)
        units.append(unit)
    return tuple(names), tuple(units)


def read_plain(data: bytes, path: Path) -> tuple[Header, Array] | None:
    """Read a long file without any fault; None for a short one, and for one that needs a closer look."""
    head = data[:_HEAD] if len(data) >= _LONG else b""
    if not head.isascii() or b"\r" in head or b"\0" in head:
        return None
    lines = head.decode().split("\n")[:-1]
    try:
        if recognised(lines, path, {}) is not None:
            return None
        header = find_header(lines, path)
    except RecordError:
        return None
    at = sum(len(line) + 1 for line in lines[: header.row])
    data = data if data.endswith(b"\n") else data + b"\n"
    values = np.empty((data.count(b"\n", at), len(header.names)))

    from ambid.record.csv_kernels import powers_of_ten, read_rows

    text = np.frombuffer(data, dtype=np.uint8)
    end = read_rows(text, at, ord(header.delimiter), powers_of_ten(), values)
    return (header, values) if end == len(data) else None


def data_rows(lines: list[str], header_row: int, path: Path, at_least: int) -> list[str]:
    """Return the rows of numbers, without empty lines at the end."""
    end = len(lines)
    while end > header_row and not lines[end - 1].strip():
        end -= 1
    body = lines[header_row:end]
    if not body:
        raise RecordError(f"{path} has a header row and no data. Record at least {at_least} rows")
    if len(body) < at_least:
        rows = "row" if len(body) == 1 else "rows"
        raise RecordError(f"{path} has {len(body)} {rows} of data; at least {at_least} are needed. Record for longer")
    return body


def read_values(body: list[str], header: Header, path: Path, gaps: GapPolicy) -> Array:
    """Turn the rows into numbers, shape (n_rows, n_columns): by blocks, and cell by cell where a block is not sound."""
    values = np.empty((len(body), len(header.names)))
    for start in range(0, len(body), _BLOCK):
        block = body[start : start + _BLOCK]
        numbers = _sound_block(block, header)
        if numbers is None:
            numbers = _cell_by_cell(block, header, header.first_row + start, path, gaps)
        values[start : start + len(block)] = numbers
    return values


def _sound_block(block: list[str], header: Header) -> Array | None:
    """Return the numbers of rows without any fault; None if there is one."""
    if "" in block:  # np.loadtxt would skip an empty line without a word
        return None
    try:
        numbers = np.loadtxt(block, delimiter=header.delimiter, comments=None, ndmin=2)
    except ValueError:
        return None
    return numbers if numbers.shape[1] == len(header.names) and np.isfinite(numbers).all() else None


def _cell_by_cell(block: list[str], header: Header, first_row: int, path: Path, gaps: GapPolicy) -> Array:
    """Read row by row; name the first bad cell, or mark bad cells NaN where the policy treats gaps."""
    values = np.empty((len(block), len(header.names)))
    for k, line in enumerate(block):
        cells = line.split(header.delimiter)
        if len(cells) != len(header.names):
            fault = _ragged(line, len(cells), len(header.names), header.delimiter)
            raise RecordError(f"{path}, row {first_row + k}: {fault}")
        for j, cell in enumerate(cells):
            number = _number(cell)
            if not np.isfinite(number):
                fault = _faulty_cell(cell.strip(), gaps)
                if fault:
                    raise RecordError(f"{path}, row {first_row + k}, column {header.names[j]!r}: {fault}")
                number = np.nan
            values[k, j] = number
    return values


def _faulty_cell(text: str, gaps: GapPolicy) -> str:
    """Say what is wrong with a cell that holds no finite number; nothing if it is a gap that the policy treats."""
    if re.fullmatch(r"[+-]?\d+,\d+([eE][+-]?\d+)?", text):
        return f"{text!r} has a decimal comma; numbers need a decimal point. Export again with a point"
    if gaps != "error":
        return ""
    what = f"{text!r} is not a finite number" if text else "the value is missing"
    return (
        f"{what}; every cell must be one. Correct it, or give {setting('gaps', 'interpolate')} or "
        f"{setting('gaps', 'cut')}"
    )


def _ragged(line: str, got: int, wanted: int, delimiter: str) -> str:
    """Say what is wrong with a row that has too many or too few cells."""
    if not line.strip():
        return "the line is empty; each line must be a row of data. Remove it"
    if line.lstrip().startswith("#"):
        return "a comment stands among the data; comments go before the header row. Move it"
    other = [d for d in (",", ";", "\t") if d != delimiter and d in line]
    if other and got == 1:
        return f"the data are separated by {other[0]!r} but the header by {delimiter!r}. Use commas in both"
    hint = "; if the numbers have decimal commas, export them with a point" if delimiter == "," and got > wanted else ""
    cells = "cell" if got == 1 else "cells"
    return (
        f"{got} {cells} where the header names {wanted} columns{hint}. Correct the row, or remove it if it was cut off"
    )


def _number(cell: str) -> float:
    """Return the number in a cell, NaN if it holds none."""
    try:
        return float("nan") if "_" in cell else float(cell)
    except ValueError:
        return float("nan")
