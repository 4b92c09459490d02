"""Rows of a ledger, put in and asked for in numbers, in SQLite and PostgreSQL alike."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from ambid.ledger import entry

if TYPE_CHECKING:
    from sqlalchemy import Connection

_T = TypeVar("_T")
MANY = 5_000  # keys in one question


def chunks(items: Sequence[_T]) -> Iterator[Sequence[_T]]:
    """Yield as many at a time as one question may name."""
    return (items[k : k + MANY] for k in range(0, len(items), MANY))


def on_server(c: Connection) -> bool:
    """Whether that is PostgreSQL."""
    return c.dialect.name == "postgresql"


def insert_new(c: Connection, table: Any, rows: Sequence[Mapping[str, Any]]) -> None:
    """Insert rows, but those that are there."""
    if on_server(c):
        from sqlalchemy.dialects.postgresql import insert
    else:
        from sqlalchemy.dialects.sqlite import insert  # type: ignore[assignment]
    if rows:
        c.execute(insert(table).on_conflict_do_nothing(), [dict(row) for row in rows])


def copy_in(c: Connection, table: Any, rows: Sequence[tuple[Any, ...]]) -> None:
    """Insert rows of all columns, in their order, of which none is there; by COPY where there is one."""
    if on_server(c):
        names = ", ".join(column.name for column in table.columns)
        driver: Any = c.connection.driver_connection
        with driver.cursor() as cursor, cursor.copy(f"COPY {table.name} ({names}) FROM STDIN") as copy:
            for row in rows:
                copy.write_row(row)
    elif rows:
        marks = ", ".join("?" * len(table.columns))
        c.exec_driver_sql(f"INSERT INTO {table.name} VALUES ({marks})", list(rows))


def estimate_numbers(c: Connection, n: int) -> Sequence[int]:
    """Return numbers for n new estimates, which no other writer gets."""
    if on_server(c):
        query = "SELECT nextval('estimate_id') FROM generate_series(1, %s)"
        return [row[0] for row in c.exec_driver_sql(query, (n,))]
    last = c.exec_driver_sql("SELECT coalesce(max(id), 0) FROM estimate").scalar_one()
    return range(last + 1, last + 1 + n)


def bearing_numbers(c: Connection, plants: Mapping[str, str]) -> dict[str, int]:
    """Return the numbers of bearings by name; one that is new is entered. `plants`: name of the rig of each."""
    from sqlalchemy import select

    t = entry.tables().tables["bearing"]
    insert_new(c, t, [{"name": name, "plant": plants[name]} for name in sorted(plants)])
    return {
        row.name: row.id
        for names in chunks(list(plants))
        for row in c.execute(select(t.c.name, t.c.id).where(t.c.name.in_(names)))
    }


def put(c: Connection, places: Iterable[tuple[int, int, float]]) -> None:
    """Put rows of estimates to bearings and times: numbers of estimate and bearing, time."""
    from sqlalchemy import bindparam, update

    t = entry.tables().tables["estimate"]
    one = update(t).where(t.c.id == bindparam("number"))
    rows = [{"number": number, "to": to, "time": at} for number, to, at in places]
    if rows:
        c.execute(one.values(bearing=bindparam("to"), taken_at=bindparam("time")), rows)


def assignments(c: Connection, shas: Iterable[str]) -> dict[tuple[str, str], tuple[str, float | None]]:
    """Return what corrections said of records: bearing, and time if any, by SHA-256 and name under which each came."""
    from sqlalchemy import select

    t = entry.tables().tables["assignment"]
    return {
        (row.sha, row.name): (row.bearing, row.taken_at)
        for some in chunks(list(set(shas)))
        for row in c.execute(select(t).where(t.c.sha.in_(some)))
    }
