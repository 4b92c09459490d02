"""The ledger itself, SQLite or PostgreSQL: opened, written and asked. One batch is one
transaction, of which a kill or a full disk leaves nothing; two may write at once, and an estimate that both have counts
once.
"""

from __future__ import annotations

import json
import math
import time
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

from ambid.errors import AmbidError, counted, needs
from ambid.estimation.result import Reason, Result
from ambid.ledger import checking, copying, correcting, entry
from ambid.ledger.copying import Keep
from ambid.ledger.correcting import Kind, Stored
from ambid.ledger.entry import Correction, Entry, key_of
from ambid.ledger.opening import (
    OlderLedgerError,
    check_file,
    copied_engine,
    file_engine,
    in_one_line,
    make_ready,
    server_engine,
)
from ambid.ledger.rows import assignments, bearing_numbers, chunks, copy_in, estimate_numbers, insert_new

if TYPE_CHECKING:
    from sqlalchemy import Connection, Engine

    from ambid.ledger.history import History


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


_MOVING = 7281002  # lock of a server, held by who corrects a ledger, shared by who writes
_LEASES = 7281003  # by who takes leases: rows of two statements are locked in no certain order


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
            batch, now = _as_corrected(c, batch), time.time()
            bearings = bearing_numbers(c, {e.bearing: e.rig_name for e in batch.values()})
            rigs = {e.rig_sha: {"sha": e.rig_sha, "name": e.rig_name, "text": _packed(e.rig)} for e in batch.values()}
            insert_new(c, t["rig"], [rigs[sha] for sha in sorted(rigs)])
            new = dict(zip(estimate_numbers(c, len(batch)), batch.values(), strict=True))
            rows = [
                {
                    "id": number, "bearing": bearings[e.bearing], "added_at": now, "failed": ",".join(e.failed),
                    **{x: getattr(e, x) for x in _PLAIN},
                }
                for number, e in new.items()
            ]  # fmt: skip
            insert_new(c, t["estimate"], rows)
            new = {e.number: new[e.number] for e in correcting.stored_by_key(c, batch) if e.number in new}
            copy_in(c, t["value"], [row for n, e in new.items() for row in _values(n, bearings[e.bearing], e)])
            insert_new(c, t["document"], [_document(n, e) for n, e in new.items() if e.document or e.covariance_names])
            insert_new(
                c, t["event"],
                [
                    {"bearing": bearings[e.bearing], "estimate": n, **{x: getattr(v, x) for x in v.__slots__}}
                    for n, e in new.items() for v in e.events
                ],
            )  # fmt: skip
            for keys in chunks(list(batch)):
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
            for keys in chunks(list(rows)):
                c.execute(delete(t).where(t.c.key.in_(keys)))
            insert_new(c, t, list(rows.values()))

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
                for some in chunks(list(keys))
                for row in c.execute(query.where(e.key.in_(some)))
            }

    def failures(self, keys: Iterable[str] | None = None) -> Mapping[str, Failure]:
        """Return by key what failed and has no estimate since.

        Parameters
        ----------
        keys : iterable of str, optional
            Only these.

        Returns
        -------
        Mapping of str to Failure
        """
        from sqlalchemy import select

        t = entry.tables().tables["failure"]
        queries = [select(t)] if keys is None else [select(t).where(t.c.key.in_(some)) for some in chunks([*keys])]
        with self._reading() as c:
            rows = [row for query in queries for row in _mappings(c, query)]
        return {row.key: Failure(**{x: row[x] for x in row if x != "key"}) for row in rows}

    def bearings(self) -> tuple[KnownBearing, ...]:
        """Return the bearings of the ledger, by name, with the number of estimates that count.

        Returns
        -------
        tuple of KnownBearing
        """
        from sqlalchemy import func, select

        t = entry.tables().tables
        b, e = t["bearing"].c, t["estimate"].c
        query = (
            select(
                b.name, b.plant, func.count(func.distinct(e.sha + e.job)).label("estimates"),
                func.min(e.taken_at).label("first"), func.max(e.taken_at).label("last"),
            )
            .where(b.name.not_like(f"{entry.OWN}%"))
            .join_from(t["bearing"], t["estimate"]).group_by(b.id, b.name, b.plant).order_by(b.name)
        )  # fmt: skip
        with self._reading() as c:
            return tuple(KnownBearing(**row) for row in _mappings(c, query))

    def history(self, bearing: str, *, every: bool = False) -> History:
        """Return what is known of one bearing over time.

        Parameters
        ----------
        bearing : str
            Its name.
        every : bool, optional
            Also estimates that another one of the same record and job supersedes.

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
            return history_of(c, bearing, self.shown, every=every)

    def correct(
        self, kind: Kind, bearing: str, to: str | float = "", *, record: str | None = None, who: str = "", why: str = ""
    ) -> Correction:
        """Correct a bearing, or one record of it; later estimates of the same records follow. `undo` takes it back.

        Parameters
        ----------
        kind : {"rename", "redate", "remove"}
            Another name: where there is a bearing of it, that gets the estimates too. When the record was taken: all
            estimates of it go there. Out of all histories.
        bearing : str
        to : str or float, optional
            The name; or the time, s since 1970, UTC.
        record : str, optional
            Only this record: name of its file, or digits of its SHA-256.
        who, why : str, optional
            Who corrects, default the account, and for what reason.

        Returns
        -------
        Correction

        Raises
        ------
        AmbidError
            If there is no such kind, bearing or record, it is not clear which, or the time is not finite.
        """
        with self._writing(alone=True) as c:
            return correcting.corrected(c, self.shown, kind, bearing, to, record, who=who, why=why)

    def undo(self, number: int, *, who: str = "", why: str = "") -> Correction:
        """Put estimates where they were before a correction; that is one too, and can be undone.

        Parameters
        ----------
        number : int
            Of the correction.
        who, why : str, optional
            Who corrects, default the account, and for what reason.

        Returns
        -------
        Correction

        Raises
        ------
        AmbidError
            If there is no such correction, or all is as before it already.
        """
        with self._writing(alone=True) as c:
            return correcting.undo(c, self.shown, number, who=who, why=why)

    def merge(self, other: str | Path, *, who: str = "", why: str = "") -> Correction:
        """Add what another ledger has and this one lacks, corrections and failures included. `undo` removes it.

        Parameters
        ----------
        other : str or Path
            File or URL; it stays as it is.
        who, why : str, optional
            Who does this, default the account, and for what reason.

        Returns
        -------
        Correction

        Raises
        ------
        AmbidError
            If the other one is no ledger.
        """
        with self._sound(other) as source, source._reading() as c0, self._writing(alone=True) as c:
            return copying.merge(c0, c, source.shown, who=who, why=why)

    def backup(self, path: str | Path) -> int:
        """Write all that is here into a file of SQLite; one that is there is replaced once the new one is whole.

        Parameters
        ----------
        path : str or Path

        Returns
        -------
        int
            Number of estimates.

        Raises
        ------
        AmbidError
            If the file cannot be written.
        """
        if _place(path) == self._identity:
            raise AmbidError(f"{path} is the ledger itself. Give another file")
        with self._reading() as c0, _new_file(Path(path)) as new:
            with new._writing() as c:
                count = len(copying.copy(c0, c))
            new._pragma("PRAGMA journal_mode = DELETE")  # one file alone, also for those who read it
        return count

    def restore(self, backup: str | Path, *, who: str = "", why: str = "") -> Correction:
        """Put what a backup, or another ledger, holds in place of all that is here.

        Parameters
        ----------
        backup : str or Path
            File or URL; it stays as it is.
        who, why : str, optional
            Who does this, default the account, and for what reason.

        Returns
        -------
        Correction

        Raises
        ------
        AmbidError
            If the backup is no ledger, or is damaged: all stays as it was.
        """
        with self._sound(backup) as source, source._reading() as c0, self._writing(alone=True) as c:
            return copying.restore(c0, c, source.shown, who=who, why=why)

    def retain(
        self, archive: str | Path, *, before: float, keep: Keep = "month", who: str = "", why: str = ""
    ) -> Correction:
        """Move what was taken before a time into an archive; `merge` of the archive brings it back.

        It is first there, then gone here. Of each estimate a row stays, so that a fleet does not do it again.

        Parameters
        ----------
        archive : str or Path
            Ledger, made where there is none.
        before : float
            S since 1970, UTC.
        keep : str, optional
            One usable estimate of each bearing, job and ``"day"``, ``"week"``, ``"month"`` or ``"year"`` stays;
            ``"none"``: none.
        who, why : str, optional
            Who does this, default the account, and for what reason.

        Returns
        -------
        Correction

        Raises
        ------
        AmbidError
            If one of the two cannot be written.
        """
        with open_ledger(archive) as other:
            self._refuse_itself(other)
            with self._reading() as c0, other._writing(alone=True) as c:
                keys = copying.to_move(c0, before, keep)
                copying.copy(c0, c, keys)
            rule = f"from before {entry.day(before)}" + ("" if keep == "none" else f", but for one a {keep},")
            with self._writing(alone=True) as c:
                done = copying.hollow(c, keys, other.shown, rule, who=who, why=why)
        if not self._postgres:
            with suppress(AmbidError):  # where somebody reads
                self._pragma("VACUUM")  # gives the room back
        return done

    def check(self) -> tuple[str, ...]:
        """Return what is wrong with the ledger, a line each; nothing where it is whole.

        Returns
        -------
        tuple of str
        """
        with self._reading() as c:
            return checking.faults(c)

    def corrections(self) -> tuple[Correction, ...]:
        """Return all corrections, in order.

        Returns
        -------
        tuple of Correction
        """
        with self._reading() as c:
            return correcting.corrections(c)

    def stored(self, keys: Iterable[str]) -> Mapping[str, Stored]:
        """Return where estimates are, by key; those that are not there are passed over.

        Parameters
        ----------
        keys : iterable of str

        Returns
        -------
        Mapping of str to Stored
        """
        with self._reading() as c:
            return {e.key: e for e in correcting.stored_by_key(c, keys)}

    # --- inside -----------------------------------------------------------------------------------------------------

    @contextmanager
    def _writing(self, *, alone: bool = False) -> Iterator[Connection]:
        """Yield a transaction that others may write beside; `alone`: that moves what they add to, and so waits."""
        with in_one_line(self.shown), self._engine.begin() as c:
            if self._postgres:
                c.exec_driver_sql(f"SELECT pg_advisory_xact_lock{'' if alone else '_shared'}({_MOVING})")
            yield c

    @contextmanager
    def _leasing(self) -> Iterator[tuple[Connection, float]]:
        """Yield a transaction beside which no other takes leases, and the time, s since 1970: the server's where there
        is one.
        """
        with self._writing() as c:
            if not self._postgres:
                yield c, time.time()
                return
            c.exec_driver_sql(f"SELECT pg_advisory_xact_lock({_LEASES})")
            yield c, c.exec_driver_sql("SELECT extract(epoch FROM clock_timestamp())::float8").scalar_one()

    @contextmanager
    def _reading(self) -> Iterator[Connection]:
        one = {"isolation_level": "REPEATABLE READ"} if self._postgres else {}  # all questions see the same rows
        with in_one_line(self.shown), self._engine.connect().execution_options(reads=True, **one) as c:
            try:
                yield c
            except Exception:
                if self._postgres:
                    c.invalidate()  # given back to the pool, a lost connection would be told with a traceback
                raise

    def _pragma(self, statement: str) -> None:
        """Execute what SQLite takes outside of a transaction."""
        with in_one_line(self.shown), closing(self._engine.raw_connection()) as raw:
            raw.cursor().execute(statement).fetchall()

    @contextmanager
    def _sound(self, where: str | Path) -> Iterator[Ledger]:
        """Open another ledger to copy from; refuse one that is damaged."""
        with open_ledger(where, write=False) as source:
            self._refuse_itself(source)
            wrong = source.check()
            if wrong:
                raise AmbidError(f"{source.shown} is damaged: {wrong[0]}. Restore another backup of it")
            yield source

    def _refuse_itself(self, other: Ledger) -> None:
        if self._identity == other._identity:
            raise AmbidError(f"{other.shown} is the ledger itself. Give another")

    @property
    def _identity(self) -> str:
        """What no other ledger has: of a file its place, of a database its name and the start of its server."""
        query = "SELECT current_database() || pg_postmaster_start_time()" if self._postgres else "PRAGMA database_list"
        with self._reading() as c:
            row = c.exec_driver_sql(query).all()[0]
            return str(row[0]) if self._postgres else _place(row[2])

    @property
    def _postgres(self) -> bool:
        return self._engine.dialect.name == "postgresql"


def _place(path: str | Path) -> str:
    """Name a file by where it lies on the disk, whatever its links are called; "" where there is none."""
    try:
        at = Path(path).stat()
    except OSError:
        return ""
    return f"{at.st_dev} {at.st_ino}"


def _as_corrected(c: Connection, entries: Mapping[str, Entry]) -> dict[str, Entry]:
    """Return entries by key, with bearing and time as corrections of their records said."""
    known = assignments(c, (e.sha for e in entries.values()))
    done = dict(entries)
    for key, e in entries.items() if known else ():
        bearing, taken_at = known.get((e.sha, e.bearing), (e.bearing, None))
        later = 0.0 if taken_at is None else taken_at - e.taken_at
        events = tuple(replace(v, at=v.at + later) for v in e.events)
        done[key] = replace(e, bearing=bearing, taken_at=e.taken_at + later, events=events)
    return done


_PLAIN = (
    "key", "taken_at", "sha", "rig_sha", "settings", "version", "job", "record", "status", "verdict", "model",
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


def _mappings(c: Connection, query: Any) -> Sequence[Any]:
    return c.execute(query).mappings().all()


# --- opening --------------------------------------------------------------------------------------------------------


def open_ledger(where: str | Path, *, write: bool = True, make: bool = True) -> Ledger:
    """Open a ledger; for writing it is made where there is none, and brought to this version where it is older.

    Parameters
    ----------
    where : str or Path
        File of SQLite, or URL of PostgreSQL, ``postgresql://user@host/name``.
    write : bool, optional
        False: nothing is written, and a ledger that is not there is refused; a file of an older version is read as a
        copy that is brought to this one.
    make : bool, optional
        False: a ledger that is not there is refused, also for writing.

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
    engine, name = server_engine(text) if "://" in text else file_engine(Path(text), write=write, make=write and make)
    ledger = Ledger(engine, name)
    try:
        with in_one_line(name):
            try:
                make_ready(engine, name, write=write, make=write and make)
            except OlderLedgerError:
                if "://" in text:
                    raise
                ledger.close()
                ledger = Ledger(copied_engine(Path(text)), name)
                make_ready(ledger._engine, name, write=True, make=False)
                with ledger._engine.connect() as c:
                    c.exec_driver_sql("PRAGMA query_only = ON")  # what is written would be gone with the copy
    except BaseException:
        ledger.close()
        raise
    return ledger


@contextmanager
def _new_file(path: Path) -> Iterator[Ledger]:
    """Open a new ledger that is put in place of a file once it is whole."""
    if not path.resolve().parent.is_dir():
        raise AmbidError(
            f"{path} cannot be written: there is no folder {path.parent}. Make it first, or correct the path"
        )
    if path.exists():
        try:
            check_file(path)
        except (AmbidError, OSError):
            raise AmbidError(f"{path} exists, and is not a ledger of ambid. Give another file") from None
    log = Path(f"{path}-wal")
    if log.exists() and log.stat().st_size:
        raise AmbidError(f"{path} is a ledger that a program has open. Give another file")
    partial = path.with_name(f"{path.name}.partial")
    files = [partial, *(Path(f"{partial}{ending}") for ending in ("-wal", "-shm", "-journal"))]
    try:
        for file in files:
            file.unlink(missing_ok=True)  # of one that was killed
        with open_ledger(partial) as ledger:
            yield ledger
        partial.replace(path)
    except OSError as failure:
        raise AmbidError(f"{path} cannot be written: {failure.strerror or failure}. Give another file") from None
    finally:
        for file in files:
            file.unlink(missing_ok=True)


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
