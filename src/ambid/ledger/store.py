"""The ledger itself, SQLite or PostgreSQL: opened, written, asked, and written to Parquet. One batch is one
transaction, of which a kill or a full disk leaves nothing; two may write at once, and an estimate that both have counts
once.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ambid.errors import AmbidError, counted, needs
from ambid.estimation.result import Reason, Result
from ambid.ledger import entry
from ambid.settings.caller import setting

if TYPE_CHECKING:
    from sqlalchemy import Connection

import json
import math
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Self

from ambid.ledger.entry import Entry, key_of

if TYPE_CHECKING:
    from sqlalchemy import Connection, Engine

    from ambid.ledger.history import History

PATIENCE_S = 120.0  # for which a writer waits for another
_TRY_S = 0.5  # of it, in which the program hears nothing
_MANY = 5_000  # keys in one question
_MAPPED = 1 << 30  # bytes of a file that are read without a copy


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """A record that gave no estimate, and why."""

    bearing: str
    record: str  # name of its file
    sha: str
    rig_sha: str
    settings: str
    version: str
    reason: str
    failed_at: float = 0.0  # s since 1970, UTC; 0: now

    @property
    def key(self) -> str:
        """As that of an `Entry`."""
        return key_of(self.sha, self.rig_sha, self.settings, self.version)


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownBearing:
    """A bearing of a ledger: its name, rig, number of estimates, time of the first and last, s since 1970, UTC."""

    name: str
    plant: str
    estimates: int
    first: float
    last: float


class Ledger:
    """A ledger that is open; `open_ledger` opens one. Use it in a ``with`` statement.

    Parameters
    ----------
    engine : sqlalchemy.Engine
    shown : str
        Its name in messages, without a password.
    """

    def __init__(self, engine: Engine, shown: str) -> None:
        """Hold the engine."""
        self._engine, self.shown = engine, shown

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close it."""
        self._engine.dispose()

    def add(self, entries: Iterable[Entry]) -> frozenset[str]:
        """Store estimates, all or none; one that is there already stays as it is.

        Parameters
        ----------
        entries : iterable of Entry

        Returns
        -------
        frozenset of str
            Keys of those that were new.

        Raises
        ------
        AmbidError
            If the ledger cannot be written.
        """
        batch = {e.key: e for e in sorted(entries, key=lambda e: e.key)}  # in one order: two writers never wait in turn
        if not batch:
            return frozenset()
        from sqlalchemy import delete

        t = entry.tables().tables
        with self._writing() as c:
            bearings, now = self._bearings(c, batch.values()), time.time()
            rigs = {e.rig_sha: {"sha": e.rig_sha, "name": e.rig_name, "text": _packed(e.rig)} for e in batch.values()}
            self._insert(c, t["rig"], [rigs[sha] for sha in sorted(rigs)])
            first = self._numbers(c, len(batch))
            new = dict(zip(first, batch.values(), strict=True))
            rows = [
                {
                    "id": number, "bearing": bearings[e.bearing], "key": key, "added_at": now,
                    "failed": ",".join(e.failed),
                    **{x: getattr(e, x) for x in _PLAIN},
                }
                for (key, e), number in zip(batch.items(), first, strict=True)
            ]  # fmt: skip
            self._insert(c, t["estimate"], rows)
            there = self._there(c, batch)
            new = {number: e for number, e in new.items() if there[e.key] == number}
            self._copy(c, t["value"], [row for n, e in new.items() for row in _values(n, bearings[e.bearing], e)])
            self._insert(
                c, t["document"], [_document(n, e) for n, e in new.items() if e.document or e.covariance_names]
            )
            self._insert(
                c, t["event"],
                [
                    {"bearing": bearings[e.bearing], "estimate": n, **{x: getattr(v, x) for x in v.__slots__}}
                    for n, e in new.items() for v in e.events
                ],
            )  # fmt: skip
            for keys in _chunks(list(batch)):
                c.execute(delete(t["failure"]).where(t["failure"].c.key.in_(keys)))
        return frozenset(e.key for e in new.values())

    def fail(self, failures: Iterable[Failure]) -> None:
        """Store what failed, and why; a later estimate of the same key takes it out again.

        Parameters
        ----------
        failures : iterable of Failure
        """
        now = time.time()
        rows = {
            f.key: {"key": f.key, **{x: getattr(f, x) for x in f.__slots__}, "failed_at": f.failed_at or now}
            for f in sorted(failures, key=lambda f: f.key)
        }
        from sqlalchemy import delete

        t = entry.tables().tables["failure"]
        with self._writing() as c:
            for keys in _chunks(list(rows)):
                c.execute(delete(t).where(t.c.key.in_(keys)))
            self._insert(c, t, list(rows.values()))

    def documents(self, keys: Iterable[str]) -> Mapping[str, tuple[str, str, str, str]]:
        """Return status, verdict, failed checks and JSON of estimates that are there, by key.

        Parameters
        ----------
        keys : iterable of str

        Returns
        -------
        Mapping of str to tuple of str
            The JSON is empty where none was stored.
        """
        from sqlalchemy import select

        t = entry.tables().tables
        e, d = t["estimate"].c, t["document"].c
        query = select(e.key, e.status, e.verdict, e.failed, d.json).join_from(
            t["estimate"], t["document"], isouter=True
        )
        with self._reading() as c:
            return {
                row.key: (row.status, row.verdict, row.failed, zlib.decompress(row.json).decode() if row.json else "")
                for some in _chunks(list(keys))
                for row in c.execute(query.where(e.key.in_(some)))
            }

    def failures(self) -> Mapping[str, Failure]:
        """Return by key what failed and has no estimate since.

        Returns
        -------
        Mapping of str to Failure
        """
        from sqlalchemy import select

        t = entry.tables().tables["failure"]
        with self._reading() as c:
            return {row.key: Failure(**{x: row[x] for x in row if x != "key"}) for row in _mappings(c, select(t))}

    def bearings(self) -> tuple[KnownBearing, ...]:
        """Return the bearings of the ledger, by name.

        Returns
        -------
        tuple of KnownBearing
        """
        from sqlalchemy import func, select

        t = entry.tables().tables
        b, e = t["bearing"].c, t["estimate"].c
        query = (
            select(
                b.name, b.plant, func.count(e.id).label("estimates"), func.min(e.taken_at).label("first"),
                func.max(e.taken_at).label("last"),
            )
            .join_from(t["bearing"], t["estimate"]).group_by(b.id, b.name, b.plant).order_by(b.name)
        )  # fmt: skip
        with self._reading() as c:
            return tuple(KnownBearing(**row) for row in _mappings(c, query))

    def history(self, bearing: str) -> History:
        """Return what is known of one bearing over time.

        Parameters
        ----------
        bearing : str
            Its name.

        Returns
        -------
        History

        Raises
        ------
        AmbidError
            If the ledger has no bearing of that name.
        """
        from ambid.ledger.history import history_of

        with self._reading() as c:
            return history_of(c, bearing, self.shown)

    def export(self, folder: str | Path) -> tuple[str, ...]:
        """Write the tables as Parquet files, for DuckDB or pandas; needs the extra ``ambid[formats]``.

        Parameters
        ----------
        folder : str or Path
            Made where there is none; a table that is there is replaced only where this wrote it.

        Returns
        -------
        tuple of str
            Names of the files.

        Raises
        ------
        AmbidError
            If pyarrow is not installed, or the folder cannot be written.
        """
        from ambid.ledger.store import export

        with self._reading() as c:
            return export(c, Path(folder))

    # --- inside -----------------------------------------------------------------------------------------------------

    @contextmanager
    def _writing(self) -> Iterator[Connection]:
        with _told(self.shown), self._engine.begin() as c:
            yield c

    @contextmanager
    def _reading(self) -> Iterator[Connection]:
        one = {"isolation_level": "REPEATABLE READ"} if self._postgres else {}  # all questions see the same rows
        with _told(self.shown), self._engine.connect().execution_options(reads=True, **one) as c:
            try:
                yield c
            except Exception:
                if self._postgres:
                    c.invalidate()  # given back to the pool, a lost connection would be told with a traceback
                raise

    @property
    def _postgres(self) -> bool:
        return self._engine.dialect.name == "postgresql"

    def _insert(self, c: Connection, table: Any, rows: Sequence[Mapping[str, Any]]) -> None:
        """Insert rows, but those that are there."""
        if self._postgres:
            from sqlalchemy.dialects.postgresql import insert
        else:
            from sqlalchemy.dialects.sqlite import insert  # type: ignore[assignment]
        if rows:
            c.execute(insert(table).on_conflict_do_nothing(), [dict(row) for row in rows])

    def _copy(self, c: Connection, table: Any, rows: Sequence[tuple[Any, ...]]) -> None:
        """Insert rows of all columns, in their order, of which none is there; by COPY where there is one."""
        if self._postgres:
            names = ", ".join(column.name for column in table.columns)
            driver: Any = c.connection.driver_connection
            with driver.cursor() as cursor, cursor.copy(f"COPY {table.name} ({names}) FROM STDIN") as copy:
                for row in rows:
                    copy.write_row(row)
        elif rows:
            marks = ", ".join("?" * len(table.columns))
            c.exec_driver_sql(f"INSERT INTO {table.name} VALUES ({marks})", list(rows))

    def _numbers(self, c: Connection, n: int) -> Sequence[int]:
        """Return numbers for n new estimates, which no other writer gets."""
        if self._postgres:
            query = "SELECT nextval('estimate_id') FROM generate_series(1, %s)"
            return [row[0] for row in c.exec_driver_sql(query, (n,))]
        last = c.exec_driver_sql("SELECT coalesce(max(id), 0) FROM estimate").scalar_one()
        return range(last + 1, last + 1 + n)

    def _bearings(self, c: Connection, entries: Iterable[Entry]) -> dict[str, int]:
        """Return the numbers of bearings by name; one that is new is entered."""
        from sqlalchemy import select

        t = entry.tables().tables["bearing"]
        plants = {e.bearing: e.rig_name for e in entries}
        self._insert(c, t, [{"name": name, "plant": plants[name]} for name in sorted(plants)])
        return {
            row.name: row.id
            for names in _chunks(list(plants))
            for row in c.execute(select(t.c.name, t.c.id).where(t.c.name.in_(names)))
        }

    def _there(self, c: Connection, keys: Iterable[str]) -> dict[str, int]:
        """Return the numbers of estimates that are there, by key."""
        from sqlalchemy import select

        t = entry.tables().tables["estimate"]
        return {
            row.key: row.id
            for some in _chunks(list(keys))
            for row in c.execute(select(t.c.key, t.c.id).where(t.c.key.in_(some)))
        }


_PLAIN = (
    "taken_at", "sha", "rig_sha", "settings", "version", "job", "record", "status", "verdict", "model",
)  # fmt: skip


def _values(number: int, bearing: int, e: Entry) -> Iterator[tuple[Any, ...]]:
    for p in e.parameters:
        value, sd = (x if math.isfinite(x) else None for x in (p.value, p.sd))
        seen = bool(p.identifiable) and None not in (value, sd)
        yield bearing, p.name, e.taken_at, number, value, sd, seen, p.unit, p.role


def _document(number: int, e: Entry) -> dict[str, Any]:
    matrix = [] if e.covariance is None else e.covariance.tolist()
    covariance = json.dumps({"names": list(e.covariance_names), "matrix": matrix})
    return {"estimate": number, "json": _packed(e.document), "covariance": _packed(covariance)}


def _packed(text: str) -> bytes:
    return zlib.compress(text.encode())


def _chunks(items: Sequence[str]) -> Iterator[Sequence[str]]:
    return (items[k : k + _MANY] for k in range(0, len(items), _MANY))


def _mappings(c: Connection, query: Any) -> Sequence[Any]:
    return c.execute(query).mappings().all()


# --- opening --------------------------------------------------------------------------------------------------------


def open_ledger(where: str | Path, *, write: bool = True) -> Ledger:
    """Open a ledger; for writing it is made where there is none, and brought to this version where it is older.

    Parameters
    ----------
    where : str or Path
        File of SQLite, or URL of PostgreSQL, ``postgresql://user@host/name``.
    write : bool, optional
        False: nothing is written, and a ledger that is not there is refused.

    Returns
    -------
    Ledger

    Raises
    ------
    AmbidError
        If it cannot be opened, is no ledger, or one of a newer version; it is then left as it was.
    """
    with needs("SQLAlchemy", "a ledger", "fleet"):
        import sqlalchemy  # noqa: F401
    text = str(where)
    engine, name = _server(text) if "://" in text else _file(Path(text), write=write)
    ledger = Ledger(engine, name)
    try:
        with _told(name):
            _make_ready(engine, name, write=write)
    except BaseException:
        ledger.close()
        raise
    return ledger


def _server(url: str) -> tuple[Engine, str]:
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


def _file(path: Path, *, write: bool) -> tuple[Engine, str]:
    """Return the engine of a file of SQLite, and its name; refuse what is none, untouched."""
    from sqlalchemy import create_engine, event
    from sqlalchemy.pool import StaticPool

    name = str(path)
    new = not path.exists() or path.stat().st_size == 0
    if path.is_dir() or (path.exists() and not path.is_file()):
        raise AmbidError(f"ledger {path} is no file. Name one, such as fleet.db")
    if new and not write:
        raise AmbidError(f"ledger {path} {'is empty' if path.exists() else 'does not exist'}. Check the path")
    if new and not path.resolve().parent.is_dir():
        raise AmbidError(f"ledger {path}: there is no folder {path.parent}. Make it first, or correct the path")
    if not new:
        _check_file(path)

    def connect() -> Any:
        connection = _connected(path, "rwc", _TRY_S) if write else _read_only(path, _TRY_S, "rw")  # leaves no log
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute(f"PRAGMA mmap_size = {_MAPPED}")  # estimates of one bearing lie on as many pages
        if write:
            connection.execute("PRAGMA journal_mode = WAL")
        return connection

    engine = create_engine("sqlite://", creator=connect, poolclass=StaticPool)

    @event.listens_for(engine, "begin")
    def begin(c: Connection) -> None:
        _patiently(lambda: c.exec_driver_sql("BEGIN" if c.get_execution_options().get("reads") else "BEGIN IMMEDIATE"))

    return engine, name


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


def _check_file(path: Path) -> None:
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


def _make_ready(engine: Engine, ledger: str, *, write: bool) -> None:
    """Make the tables where there are none; bring them to this version; refuse what is of another kind or newer."""
    from sqlalchemy import insert, inspect, select, update

    whole = entry.tables()
    meta = whole.tables["meta"]
    connection = engine.begin() if write else engine.connect().execution_options(reads=True)
    with connection as c:
        if write and engine.dialect.name == "postgresql":
            c.exec_driver_sql("SELECT pg_advisory_xact_lock(7281001)")  # one writer at a time makes tables
        there = set(inspect(c).get_table_names()) & set(whole.tables)
        if not there and not write:
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
            raise AmbidError(
                f"ledger {ledger} is of version {version}, and is read as {entry.VERSION}. Write to it once, which "
                "brings it to that version"
            )
        for step in range(version, entry.VERSION):
            for statement in entry.STEPS[step]:
                c.exec_driver_sql(statement.format(**entry.KINDS[engine.dialect.name]))
        if version < entry.VERSION:
            c.execute(update(meta).where(meta.c.name == "version").values(value=str(entry.VERSION)))


@contextmanager
def _told(ledger: str) -> Iterator[None]:
    """Put what the database says into one line."""
    import sqlite3

    from sqlalchemy.exc import DBAPIError

    drivers = [DBAPIError, sqlite3.Error, *(m.Error for m in [sys.modules.get("psycopg")] if m is not None)]
    try:
        yield
    except tuple(drivers) as failure:
        reason = str(getattr(failure, "orig", None) or failure).strip().splitlines()[0]
        if "locked" in reason:
            reason = f"another program has been writing to it for {PATIENCE_S:.0f} s"
        raise AmbidError(
            f"ledger {ledger}: {reason}. Nothing of this was stored; check disk, rights and server"
        ) from None


_TABLES = ("bearing", "rig", "estimate", "value", "event", "failure")
_TIMES = ("taken_at", "added_at", "at", "failed_at")
_ROWS = 50_000  # at once
_MADE = b"ambid.ledger"


def export(c: Connection, folder: Path) -> tuple[str, ...]:
    """Write the tables; times as timestamps of UTC, names of bearings beside their numbers; documents are left out."""
    with needs("pyarrow", "Parquet", "formats"):
        import pyarrow.parquet as parquet
    try:
        folder.mkdir(exist_ok=True)
        files = [folder / f"{name}.parquet" for name in _TABLES]
        for path in files:
            if path.exists() and _MADE not in (parquet.read_schema(path).metadata or {}):
                raise AmbidError(f"{setting('export', path)} exists, and is not of a ledger. Choose another folder")
        for name, path in zip(_TABLES, files, strict=True):
            _write(c, name, path)
    except (OSError, ValueError) as failure:
        words = getattr(failure, "strerror", None) or failure
        raise AmbidError(f"{setting('export', folder)} cannot be written: {words}. Give another folder") from None
    return tuple(path.name for path in files)


def _write(c: Connection, name: str, path: Path) -> None:
    """Write a table, some rows at a time, under another name until it is whole."""
    import pyarrow as pa
    import pyarrow.parquet as parquet
    from sqlalchemy import select

    table = entry.tables().tables[name]
    kinds = [pa.field(x.name, _kind(pa, name, x)) for x in table.columns]
    whole = pa.schema(kinds, metadata={_MADE: entry.SCHEMA.encode()})
    partial = path.with_name(f".{path.name}")
    try:
        with parquet.ParquetWriter(partial, whole) as writer:
            records = c.execute(select(table)).mappings()
            for rows in records.partitions(_ROWS):
                writer.write_table(pa.Table.from_pylist([_row(row) for row in rows], schema=whole))
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


SCHEMA = "ambid.fleet/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetRow:
    """One record of a fleet."""

    record: str
    bearing: str
    rig: str
    taken_at: float | None  # s since 1970, UTC
    state: Literal["done", "failed", "known"]  # "known": its result was in the ledger before
    status: str = ""  # of the search
    verdict: str = ""
    checks: tuple[str, ...] = ()  # that speak against the result
    reason: str = ""  # why there is none
    seconds: float = 0.0
    # value and standard deviation by name, SI; None where the record does not show it
    values: Mapping[str, tuple[float | None, float | None]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class FleetRun(Result):
    """A job on many records.

    Attributes
    ----------
    job : str
        Its name.
    settings : str
        What was asked for beside records and rigs, JSON.
    ledger : str or None
        Where estimates were stored.
    workers : int
        Processes at work.
    seconds : float
        Of the whole, s.
    records : int
        That were to be done.
    units : Mapping of str to str
        Of the values, by name.
    rows : tuple of FleetRow
        One for each record that was come to, in their order.
    """

    job: str
    settings: str
    ledger: str | None
    workers: int
    seconds: float
    records: int
    units: Mapping[str, str]
    rows: tuple[FleetRow, ...]

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of records by state: done, failed, known, left."""
        states = Counter(row.state for row in self.rows)
        return {s: states[s] for s in ("done", "failed", "known")} | {"left": self.records - len(self.rows)}

    @property
    def failures(self) -> Mapping[str, tuple[str, ...]]:
        """Records by the reason why there is no result of them, the commonest first."""
        failures: dict[str, list[str]] = {}
        for row in self.rows:
            if row.state == "failed":
                name = row.record.rpartition("/")[2]
                reason = row.reason.replace(row.record, "…").replace(name, "…")
                failures.setdefault(reason, []).append(row.record)
        return {reason: tuple(r) for reason, r in sorted(failures.items(), key=lambda x: -len(x[1]))}

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """What stands against the run as a whole: failures, results in doubt, records that it did not come to."""
        reasons, n = [], self.counts
        if n["failed"]:
            text = f"{n['failed']} of {counted(self.records, 'record')} failed"
            reasons.append(
                Reason(check="failures", text=f"{text}; the reasons are below", grave=not n["done"] + n["known"])
            )
        doubtful = {word: sum(r.verdict == word for r in self.rows) for word in ("unusable", "caution")}
        for word, m in doubtful.items():
            if m:
                reasons.append(
                    Reason(check="verdicts", text=f"{counted(m, 'result')} {'is' if m == 1 else 'are'} {word}")
                )
        if n["left"]:
            text = f"{counted(n['left'], 'record')} left: run again to go on"
            reasons.append(Reason(check="interrupted", text=text))
        return tuple(reasons)
