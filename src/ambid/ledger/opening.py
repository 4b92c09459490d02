"""How a ledger is opened: the engine of a server or of a file, the tables made or brought to this version, and what a
database says put into one line.
"""

from __future__ import annotations

import re
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ambid.errors import AmbidError, needs
from ambid.ledger import entry

if TYPE_CHECKING:
    from sqlalchemy import Connection, Engine

PATIENCE_S = 120.0  # for which a writer waits for another
_TRY_S = 0.5  # of it, in which the program hears nothing
_MAPPED = 1 << 30  # bytes of a file that are read without a copy


class OlderLedgerError(AmbidError):
    """A ledger to be read is of an older version."""


def server_engine(url: str) -> tuple[Engine, str]:
    """Return the engine of a server, and its URL without the password."""
    from sqlalchemy import create_engine
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import ArgumentError

    try:
        address = make_url(url)
    except (ArgumentError, ValueError):
        raise AmbidError("the URL of the ledger cannot be read. Write postgresql://user@host/name") from None
    if address.get_backend_name() != "postgresql":
        raise AmbidError(
            f"ledger {address.render_as_string()} is of {address.get_backend_name()!r}; it must be a file of SQLite or "
            "a URL postgresql://user@host/name. Correct it"
        )
    with needs("psycopg", "PostgreSQL", "postgres"):
        import psycopg  # noqa: F401
    return create_engine(address.set(drivername="postgresql+psycopg")), address.render_as_string()


def file_engine(path: Path, *, write: bool, make: bool) -> tuple[Engine, str]:
    """Return the engine of a file of SQLite, and its name; refuse what is none, untouched."""
    name = str(path)
    new = not path.exists() or path.stat().st_size == 0
    if path.is_dir() or (path.exists() and not path.is_file()):
        raise AmbidError(f"ledger {path} is no file. Name one, such as fleet.db")
    if new and not make:
        raise AmbidError(f"ledger {path} {'is empty' if path.exists() else 'does not exist'}. Check the path")
    if new and not path.resolve().parent.is_dir():
        raise AmbidError(f"ledger {path}: there is no folder {path.parent}. Make it first, or correct the path")
    if not new:
        check_file(path)

    def connect() -> Any:
        connection = _connected(path, "rwc", _TRY_S) if write else _read_only(path, _TRY_S, "rw")  # leaves no log
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute(f"PRAGMA mmap_size = {_MAPPED}")  # estimates of one bearing lie on as many pages
        if write:
            connection.execute("PRAGMA journal_mode = WAL")
        return connection

    return _engine_of(connect), name


def copied_engine(path: Path) -> Engine:
    """Return the engine of a copy of a file of SQLite, which is gone when it is closed."""
    import sqlite3

    def connect() -> Any:
        copy = sqlite3.connect("", isolation_level=None, check_same_thread=False)
        with closing(_read_only(path, PATIENCE_S)) as original:
            original.backup(copy)
        return copy

    return _engine_of(connect)


def _engine_of(connect: Callable[[], Any]) -> Engine:
    from sqlalchemy import create_engine, event
    from sqlalchemy.pool import StaticPool

    engine = create_engine("sqlite://", creator=connect, poolclass=StaticPool)

    @event.listens_for(engine, "begin")
    def begin(c: Connection) -> None:
        _patiently(lambda: c.exec_driver_sql("BEGIN" if c.get_execution_options().get("reads") else "BEGIN IMMEDIATE"))

    return engine


def _patiently(do: Callable[[], object]) -> None:
    """Do what another writer may hold up, again and again, so that Ctrl-C is heard between."""
    from sqlalchemy.exc import OperationalError

    end = time.monotonic() + PATIENCE_S
    while True:
        try:
            do()
            return
        except OperationalError as failure:
            if "locked" not in str(failure.orig) or time.monotonic() > end:
                raise


def check_file(path: Path) -> None:
    """Refuse a file that is no database, or that of another program, without touching it."""
    import sqlite3

    refusal = f"{path} is not a ledger of ambid. Give another file"
    with path.open("rb") as file:
        if file.read(16) != b"SQLite format 3\0":
            raise AmbidError(refusal)
    try:
        connection = _read_only(path, PATIENCE_S)
        try:
            if connection.execute("SELECT count(*) FROM sqlite_master").fetchone() == (0,):
                return  # another writer is about to make the tables
            row = connection.execute("SELECT value FROM meta WHERE name = 'schema'").fetchone()
        finally:
            connection.close()
    except sqlite3.DatabaseError:
        row = None
    if row != (entry.SCHEMA,):
        raise AmbidError(refusal)


def _read_only(path: Path, patience_s: float, mode: str = "ro") -> Any:
    """Open a file for reading, also in a folder that may not be written to, where SQLite cannot index its log."""
    import sqlite3

    connection = _connected(path, mode, patience_s)
    connection.execute("PRAGMA query_only = ON")
    try:
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except sqlite3.OperationalError:
        connection.close()
        log = path.with_name(f"{path.name}-wal")
        if log.exists() and log.stat().st_size:
            raise AmbidError(
                f"ledger {path}: a writer has left {log.name}, and its folder may not be written to. Open it once "
                "from an account that may"
            ) from None
        return _connected(path, "ro&immutable=1", patience_s)
    return connection


def _connected(path: Path, mode: str, patience_s: float) -> Any:
    import sqlite3

    return sqlite3.connect(
        f"{path.resolve().as_uri()}?mode={mode}", uri=True, timeout=patience_s, isolation_level=None,
        check_same_thread=False,
    )  # fmt: skip


def make_ready(engine: Engine, ledger: str, *, write: bool, make: bool) -> None:
    """Make the tables where there are none; bring them to this version; refuse what is of another kind or newer."""
    from sqlalchemy import insert, inspect, select, update

    whole = entry.tables()
    meta = whole.tables["meta"]
    connection = engine.begin() if write else engine.connect().execution_options(reads=True)
    with connection as c:
        if write and engine.dialect.name == "postgresql":
            c.exec_driver_sql("SELECT pg_advisory_xact_lock(7281001)")  # one writer at a time makes tables
        there = set(inspect(c).get_table_names()) & set(whole.tables)
        if not there and not make:
            raise AmbidError(f"ledger {ledger} holds no ledger yet. Check the URL")
        if not there:
            whole.create_all(c)
            facts = {"schema": entry.SCHEMA, "version": str(entry.VERSION)}
            c.execute(insert(meta), [{"name": n, "value": v} for n, v in facts.items()])
            return
        if "meta" not in there:
            raise AmbidError(f"{ledger} is not a ledger of ambid: it has other tables of the same names. Give another")
        facts = {row.name: row.value for row in c.execute(select(meta.c.name, meta.c.value))}
        if facts.get("schema") != entry.SCHEMA:
            raise AmbidError(f"{ledger} is not a ledger of ambid. Give another")
        said = facts.get("version")
        if re.fullmatch("[1-9][0-9]{0,8}", str(said), re.ASCII) is None:
            what = "does not say its version" if said is None else f"says that its version is {said!r:.40}"
            raise AmbidError(
                f"ledger {ledger} {what}; it must be a number from 1 to {entry.VERSION}. Restore it from a backup"
            )
        version = int(str(said))
        if version > entry.VERSION:
            raise AmbidError(
                f"ledger {ledger} is of version {version}; this ambid reads {entry.VERSION}. Install a newer one"
            )
        if version < entry.VERSION and not write:
            raise OlderLedgerError(
                f"ledger {ledger} is of version {version}, and is read as {entry.VERSION}. "
                f"'ambid ledger check {ledger}' brings it to that version"
            )
        for step in range(version, entry.VERSION):
            for statement in entry.STEPS[step]:
                c.exec_driver_sql(statement.format(**entry.KINDS[engine.dialect.name]))
        if version < entry.VERSION:
            c.execute(update(meta).where(meta.c.name == "version").values(value=str(entry.VERSION)))


@contextmanager
def in_one_line(ledger: str) -> Iterator[None]:
    """Put what the database says into one line."""
    import sqlite3

    from sqlalchemy.exc import DBAPIError

    drivers = [DBAPIError, sqlite3.Error, *(m.Error for m in [sys.modules.get("psycopg")] if m is not None)]
    try:
        yield
    except zlib.error as failure:
        raise AmbidError(
            f"ledger {ledger} is damaged: {failure}. 'ambid ledger check' tells where; restore a backup"
        ) from None
    except tuple(drivers) as failure:
        reason = str(getattr(failure, "orig", None) or failure).strip().splitlines()[0]
        if "locked" in reason:
            reason = f"another program has been writing to it for {PATIENCE_S:.0f} s"
        raise AmbidError(
            f"ledger {ledger}: {reason}. Nothing of this was stored; check disk, rights and server"
        ) from None
