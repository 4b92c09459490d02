"""The tables of a ledger as Parquet files, for other programs."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ambid.errors import AmbidError, needs
from ambid.ledger import entry
from ambid.ledger.entry import OWN
from ambid.ledger.history import superseded
from ambid.settings.caller import setting

if TYPE_CHECKING:
    from sqlalchemy import Connection

_TABLES = ("bearing", "rig", "estimate", "value", "event", "failure")
_TIMES = ("taken_at", "added_at", "at", "failed_at")
_ROWS = 50_000  # at once
_MADE = b"ambid.ledger"


def export(c: Connection, folder: Path, *, every: bool = False) -> tuple[str, ...]:
    """Write the tables; times as timestamps of UTC, names of bearings beside their numbers; documents are left out.

    What was removed is left out, and but for `every` what is superseded.
    """
    with needs("pyarrow", "Parquet", "formats"):
        import pyarrow.parquet as parquet
    try:
        folder.mkdir(exist_ok=True)
        files = [folder / f"{name}.parquet" for name in _TABLES]
        for path in files:
            if path.exists() and _MADE not in (parquet.read_schema(path).metadata or {}):
                raise AmbidError(f"{setting('export', path)} exists, and is not of a ledger. Choose another folder")
        own = {number for number, name in c.exec_driver_sql("SELECT id, name FROM bearing") if name.startswith(OWN)}
        left_out = set() if every else superseded(c)
        for name, path in zip(_TABLES, files, strict=True):
            _write(c, name, path, own, left_out)
    except (OSError, ValueError) as failure:
        words = getattr(failure, "strerror", None) or failure
        raise AmbidError(f"{setting('export', folder)} cannot be written: {words}. Give another folder") from None
    return tuple(path.name for path in files)


def _write(c: Connection, name: str, path: Path, own: set[int], left_out: set[int]) -> None:
    """Write a table, some rows at a time, under another name until it is whole.

    `own`, `left_out`: bearings and estimates that are passed over.
    """
    import pyarrow as pa
    import pyarrow.parquet as parquet
    from sqlalchemy import select

    table = entry.tables().tables[name]
    kinds = [pa.field(x.name, _kind(pa, name, x)) for x in table.columns]
    whole = pa.schema(kinds, metadata={_MADE: entry.SCHEMA.encode()})
    of_bearing, of_estimate = ("id" if name == x else x for x in ("bearing", "estimate"))
    partial = path.with_name(f".{path.name}")
    try:
        with parquet.ParquetWriter(partial, whole) as writer:
            records = c.execute(select(table)).mappings()
            for rows in records.partitions(_ROWS):
                some = [_row(r) for r in rows if r.get(of_bearing) not in own and r.get(of_estimate) not in left_out]
                writer.write_table(pa.Table.from_pylist(some, schema=whole))
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _kind(pa: Any, table: str, column: Any) -> Any:
    """Return the type of a column."""
    if column.name in _TIMES:
        return pa.timestamp("us", tz="UTC")
    if (table, column.name) == ("rig", "text"):
        return pa.string()
    python = column.type.python_type
    return {int: pa.int64(), float: pa.float64(), bool: pa.bool_(), str: pa.string()}[python]


def _row(row: Any) -> dict[str, Any]:
    values = dict(row)
    for name in _TIMES:
        if name in values:
            values[name] = round(1e6 * values[name])
    if isinstance(values.get("text"), bytes):
        values["text"] = zlib.decompress(values["text"]).decode()
    return values
