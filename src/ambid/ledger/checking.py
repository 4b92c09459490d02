"""Whether a ledger is whole: the database's own check, and that what belongs together agrees."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from ambid.errors import counted, listed
from ambid.ledger.entry import key_of, tables

if TYPE_CHECKING:
    from sqlalchemy import Connection

_MOST = 5  # of a kind that are named
_FAULTS: Mapping[str, str] = {
    "values under another bearing or time than their estimate": """
        SELECT DISTINCT e.id FROM value AS v JOIN estimate AS e ON e.id = v.estimate
        WHERE v.bearing <> e.bearing OR v.taken_at <> e.taken_at""",
    "values without their estimate": """
        SELECT DISTINCT v.estimate FROM value AS v LEFT JOIN estimate AS e ON e.id = v.estimate WHERE e.id IS NULL""",
    "events under another bearing than their estimate": """
        SELECT DISTINCT e.id FROM event AS v JOIN estimate AS e ON e.id = v.estimate WHERE v.bearing <> e.bearing""",
    "no text of their rig": """
        SELECT e.id FROM estimate AS e LEFT JOIN rig AS r ON r.sha = e.rig_sha WHERE r.sha IS NULL""",
    "no bearing": """
        SELECT e.id FROM estimate AS e LEFT JOIN bearing AS b ON b.id = e.bearing WHERE b.id IS NULL""",
    "another place than a correction said": """
        SELECT e.id FROM estimate AS e JOIN bearing AS b ON b.id = e.bearing
        JOIN assignment AS a ON a.sha = e.sha AND a.name = b.name WHERE a.bearing <> b.name""",
}
_READ = ("SELECT id, key, sha, rig_sha, settings, version FROM estimate", "SELECT * FROM document")


def faults(c: Connection) -> tuple[str, ...]:
    """Return what is wrong with a ledger, a line each."""
    from sqlalchemy.exc import DBAPIError

    try:
        return tuple(_faults(c))
    except DBAPIError as failure:
        return (f"it cannot be read: {str(failure.orig).strip().splitlines()[0]}",)


def _faults(c: Connection) -> Iterator[str]:
    from sqlalchemy import inspect

    known = inspect(c)
    names = set(known.get_table_names())
    for table in tables().sorted_tables:
        columns = {x["name"] for x in known.get_columns(table.name)} if table.name in names else set()
        lacks = [x.name for x in table.c if x.name not in columns]
        if lacks:
            what = f"columns {', '.join(lacks)}" if columns else "all of it"
            yield f"table {table.name!r} is damaged: it lacks {what}"
            return
    if c.dialect.name == "sqlite":
        words = [str(row[0]) for row in c.exec_driver_sql("PRAGMA integrity_check(5)")]
        yield from (f"SQLite: {text}" for text in words if text != "ok")
    for what, query in _FAULTS.items():
        yield from _told([row[0] for row in c.exec_driver_sql(query)], what)
    keys = c.exec_driver_sql(_READ[0])
    yield from _told([row[0] for row in keys if row[1] != key_of(*row[2:])], "another key than their record and rig")
    documents = c.execution_options(yield_per=100).exec_driver_sql(_READ[1])
    yield from _told([row[0] for row in documents if not all(map(_sound, row[1:]))], "a document that cannot be read")


def _told(estimates: list[int], what: str) -> Iterator[str]:
    if estimates:
        yield f"{counted(len(estimates), 'estimate')} with {what}: number {listed([*map(str, estimates)], _MOST)}"


def _sound(packed: bytes) -> bool:
    try:
        text = zlib.decompress(packed)
        return not text or json.loads(text) is not None
    except (zlib.error, ValueError, TypeError):  # SQLite takes text for bytes
        return False
