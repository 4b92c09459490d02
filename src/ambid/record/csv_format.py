"""Records as CSV (contracts.md): ``#`` comments, one header row of ``name [unit]``, then numbers.

The columns are separated by commas; semicolons or tabs are read too where the header row holds no comma, and the
history then says so. Numbers have a decimal point. Rows in messages are lines of the file, counted from 1.
"""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from ambid.arrays import Array
from ambid.errors import RecordError, UnitError
from ambid.record._csv_text import Header, data_rows, find_header, read_plain, read_values
from ambid.record.files import file_bytes, gunzipped, sha256_of, utf8_text
from ambid.record.record import Channel, Record, Step
from ambid.record.sampling import MIN_SAMPLES, GapPolicy, Table, check_gap_policy, sample_uniformly, usual_rate
from ambid.units import UNKNOWN, Unit, nearest_unit, parse_unit

_TIME_NAMES = ("time", "t")
_REFUSED_IN_NAMES = set(',;\t\n[]"#')


def read_csv(path: str | Path, *, rate_hz: float | None = None, gaps: GapPolicy = "error") -> Record:
    """Read a record from a CSV file, gzipped or not.

    `path`: ends in ``.gz`` if it is gzipped; `rate_hz`: sampling rate in Hz, for a file without a column ``time [s]``.
    Returns all columns but time, in SI units. A column whose unit is missing or unknown has the unit ``"?"``.
    """
    check_gap_policy(gaps)
    content = _content(Path(path), gaps)
    sampled = sample_uniformly(content.table, rate_hz, gaps)
    return _record(content, sampled.values, sampled.rate_hz, sampled.start_s, sampled.steps)


def read_csv_rows(path: str | Path, *, rate_hz: float | None = None) -> tuple[Record, Array | None]:
    """Read the rows as they stand, whatever is missing and however time runs (`ambid.record.rows`).

    `path`: ends in ``.gz`` if it is gzipped; `rate_hz`: sampling rate in Hz, for a file without a column ``time [s]``.
    Returns `record`: naN where a value is missing; the rate is that of the usual interval; `time_s`: (n_rows,), or
    None, the time column, s; None if there is none.
    """
    content = _content(Path(path), "cut")
    rate, start_s = usual_rate(content.table, rate_hz)
    time = content.table.time
    record = _record(content, content.table.values, rate, start_s, ())
    return record, None if time is None else content.table.values[:, time].copy()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Content:
    """A file taken apart: its numbers, its header, and where they come from."""

    table: Table
    header: Header
    provenance: dict[str, str]


def _content(path: Path, gaps: GapPolicy) -> _Content:
    """Read the header and the numbers, time in s."""
    data = file_bytes(path)
    provenance = {"file": path.name, "sha256": sha256_of(data)}
    if path.suffix.lower() == ".gz":
        data = gunzipped(data, path)
        if not data:
            raise RecordError(f"record {path} is empty inside its gzip wrapping. Export or copy it again")
    elif data[:2] == b"\x1f\x8b":
        raise RecordError(f"record {path} is gzipped although its name does not say so. Rename it to {path.name}.gz")
    plain = read_plain(data, path)
    if plain is None:
        lines = utf8_text(data, path).split("\n")
        del data
        header = find_header(lines, path)
        values = read_values(data_rows(lines, header.row, path, MIN_SAMPLES), header, path, gaps)
    else:
        header, values = plain
    if header.comments:
        provenance["comment"] = "\n".join(header.comments)
    time, time_unit = _time_column(header, path)
    if time is not None and time_unit is not None:
        values[:, time] = time_unit.to_si(values[:, time])
    table = Table(where=str(path), names=header.names, values=values, first_row=header.row + 1, time=time)
    return _Content(table=table, header=header, provenance=provenance)


def _record(content: _Content, values: Array, rate_hz: float, start_s: float, steps: tuple[Step, ...]) -> Record:
    """Make the record of all columns but time."""
    header, table = content.header, content.table
    settings: dict[str, object] = {"format": "csv", "rows": table.values.shape[0]}
    if header.delimiter != ",":
        settings["delimiter"] = header.delimiter
    channels = tuple(
        column_channel(name, unit_text, values[:, j])
        for j, (name, unit_text) in enumerate(zip(header.names, header.unit_texts, strict=True))
        if j != table.time
    )
    if not channels:
        raise RecordError(f"{table.where} has a time column and nothing else; a record needs a channel. Add a column")
    return Record(
        rate_hz=rate_hz,
        start_s=start_s,
        channels=channels,
        history=(Step(name="read", settings=MappingProxyType(settings)), *steps),
        provenance=MappingProxyType(content.provenance),
    )


def column_channel(name: str, unit_text: str | None, raw: Array) -> Channel:
    """Make a channel in SI units from a column in file units.

    `name`: column name; `unit_text`: unit as the file gives it; missing or unknown units give the unit ``"?"``; `raw`:
    (n_samples,), values in that unit. Returns in SI units, or as it stands in the file where the unit is not known.
    """
    try:
        unit = parse_unit(unit_text or "")
    except UnitError:
        return Channel(name=name, unit=UNKNOWN, values=raw, source_unit=unit_text or UNKNOWN)
    return Channel(name=name, unit=unit.si, values=unit.to_si(raw), source_unit=unit.symbol)


def _time_column(header: Header, path: Path) -> tuple[int | None, Unit | None]:
    """Find the time column and its unit."""
    for j, (name, text) in enumerate(zip(header.names, header.unit_texts, strict=True)):
        if name.lower() not in _TIME_NAMES:
            continue
        if text is None:
            raise RecordError(f"{path}, row {header.row}: column {name!r} has no unit. Write '{name} [s]' (or ms, us)")
        try:
            unit = parse_unit(text)
        except UnitError:
            raise RecordError(
                f"{path}, row {header.row}: column {name!r} is in [{text}], which is no known unit"
                f" (nearest: {nearest_unit(text)}). Time must be in [s], [ms] or [us]"
            ) from None
        if unit.si != "s":
            raise RecordError(
                f"{path}, row {header.row}: column {name!r} is in [{text}]; time must be in [s], [ms] or [us]"
            )
        return j, unit
    return None, None


def write_csv(record: Record, path: str | Path, *, comments: Sequence[str] = ()) -> None:
    """Write a record as CSV in SI units; every value is read back to the last bit.

    `record`: what to write; its history and provenance are not kept (HDF5 keeps them); `path`: ends in ``.gz`` to be
    gzipped; `comments`: lines that go before the header row, each after ``#``.
    """
    path = Path(path)
    lines = head_lines(record, comments)
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
    except OSError as failure:
        raise RecordError(f"{path} cannot be written: {failure.strerror or failure}. Check the folder") from None


def head_lines(record: Record, comments: Sequence[str] = ()) -> list[str]:
    """Return what stands above the numbers.

    `record`: its values are not looked at; `comments`: lines that go before the header row, each after ``#``. Returns
    the last one is the header row.
    """
    for c in record.channels:
        if _REFUSED_IN_NAMES & set(c.name) or c.name.lower() in _TIME_NAMES:
            raise RecordError(f"channel {c.name!r} cannot be a CSV column: its name would be misread. Rename it")
    units = [c.source_unit if c.unit == UNKNOWN else c.unit for c in record.channels]
    names = [c.name if u == UNKNOWN else f"{c.name} [{u}]" for c, u in zip(record.channels, units, strict=True)]
    return [*(f"# {line}" for text in comments for line in text.splitlines()), ",".join(["time [s]", *names])]
