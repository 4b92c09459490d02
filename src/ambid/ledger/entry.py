"""What a ledger keeps of one estimate, the key by which the same one is known again, and the tables for it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any

from ambid.arrays import Array
from ambid.errors import AmbidError
from ambid.estimation.estimate import EstimatedParameter, plain_json
from ambid.estimation.modes import EstimatedNumber
from ambid.recursive.lines import Track, is_vague
from ambid.rig import Rig, rig_text
from ambid.settings.caller import setting

installed = cache(version_of)  # which reads a file of its own each time
SCHEMA = "ambid.ledger/1"
VERSION = 2
STEPS: Mapping[int, tuple[str, ...]] = {
    1: (
        """CREATE TABLE correction (
            id {serial} NOT NULL PRIMARY KEY, at {double} NOT NULL, who TEXT NOT NULL, kind TEXT NOT NULL,
            bearing TEXT NOT NULL, text TEXT NOT NULL, why TEXT NOT NULL, old {blob} NOT NULL)""",
        "CREATE INDEX correction_of ON correction (bearing, at)",
        """CREATE TABLE assignment (
            sha TEXT NOT NULL, name TEXT NOT NULL, bearing TEXT NOT NULL, taken_at {double},
            PRIMARY KEY (sha, name))""",
        """CREATE TABLE claim (
            key TEXT NOT NULL PRIMARY KEY, record TEXT NOT NULL, owner TEXT NOT NULL, begun_at {double} NOT NULL,
            heartbeat_at {double} NOT NULL, tries INTEGER NOT NULL)""",
        """CREATE TABLE silence (
            id {serial} NOT NULL PRIMARY KEY, at {double} NOT NULL, kind TEXT NOT NULL, bearing TEXT NOT NULL,
            rule TEXT NOT NULL, parameter TEXT NOT NULL, since {double}, until {double}, who TEXT NOT NULL,
            why TEXT NOT NULL)""",
        "CREATE INDEX silence_of ON silence (bearing, at)",
    )
}
"""Statements that bring a ledger of a version to the next one, as SQL of then: today's tables may differ."""
KINDS: Mapping[str, Mapping[str, str]] = {
    "sqlite": {"serial": "INTEGER", "double": "DOUBLE", "blob": "BLOB"},
    "postgresql": {"serial": "SERIAL", "double": "DOUBLE PRECISION", "blob": "BYTEA"},
}
"""What the kinds of `STEPS` are called, by engine."""


_YEARS = 1900, 3000  # from, and before, which records are taken
OWN = " "  # first letter of bearings of the ledger's own, which no name of a user's begins with
REMOVED = f"{OWN}removed"
ARCHIVED = f"{OWN}archived"  # whose values, events and documents are in another ledger


@dataclass(frozen=True, slots=True)
class Correction:
    """A change of what a ledger holds; what was there before is kept, and put back by its number.

    Attributes
    ----------
    number : int
    at : float
        When it was made, s since 1970, UTC.
    who : str
    kind : str
        "rename", "redate", "remove", "undo", "merge", "restore" or "retain".
    bearing : str
        Empty where it is of the whole ledger.
    text : str
        What changed.
    why : str
    """

    number: int
    at: float
    who: str
    kind: str
    bearing: str
    text: str
    why: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Note:
    """Something that happened to a bearing."""

    at: float  # s since 1970, UTC
    kind: str  # as the events of a track, or the user's own word
    text: str
    parameter: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Entry:
    """One estimate as a ledger keeps it; plain values, so that processes can hand it on.

    Attributes
    ----------
    bearing : str
        Name of the bearing, or of the machine where the rig is a rotor's.
    taken_at : float
        When the record was taken, s since 1970, UTC.
    sha, rig_sha : str
        SHA-256 of record and rig, `sha_of` and `rig_sha_of`.
    settings : str
        What was asked for beside them, `settings_text`.
    version : str
        Of ambid.
    job : str
        The verb.
    record : str
        Name of the record's file.
    status, verdict, model : str
        As the result has them.
    failed : tuple of str
        Names of the checks that speak against it.
    parameters : tuple of EstimatedParameter
    covariance_names : tuple of str
        Order of `covariance`.
    covariance : ndarray, shape (n, n), SI, or None
    document : str
        The result's JSON; empty: not kept.
    rig_name, rig : str
        Name and text of the rig.
    events : tuple of Note
    """

    bearing: str
    taken_at: float
    sha: str
    rig_sha: str
    settings: str
    version: str
    job: str
    record: str = ""
    status: str
    verdict: str
    model: str
    failed: tuple[str, ...] = ()
    parameters: tuple[EstimatedParameter, ...]
    covariance_names: tuple[str, ...] = ()
    covariance: Array | None = None
    document: str = ""
    rig_name: str = ""
    rig: str = ""
    events: tuple[Note, ...] = ()

    @property
    def key(self) -> str:
        """What is the same for the same record, rig, settings and version, and for no other."""
        return key_of(self.sha, self.rig_sha, self.settings, self.version)


def entry_of(
    result: Any,
    *,
    bearing: str,
    sha: str,
    rig: Rig,
    settings: str,
    job: str = "identify",
    taken_at: float | None = None,
    document: str = "",
) -> Entry:
    """Return what a ledger keeps of a result.

    Parameters
    ----------
    result : Result
        Estimate, track, margins or fit.
    bearing : str
        Its name; of a rotor the machine's.
    sha : str
        SHA-256 of the record, `sha_of`.
    rig : Rig
        Through which it was read.
    settings : str
        As `settings_text` writes them.
    job : str, optional
        The verb.
    taken_at : float, optional
        When the record was taken, s since 1970, UTC; default: what the record says itself.
    document : str, optional
        The result's JSON.

    Returns
    -------
    Entry
        Of a track its last values, and its changes as events.

    Raises
    ------
    AmbidError
        If the bearing has no name, or nothing says when the record was taken.
    """
    name = " ".join(bearing.split())
    if not name:
        raise AmbidError(f"the bearing has no name. Give {setting('bearing', 'NAME')}, or a name in the rig")
    track = isinstance(result, Track)
    of = result.header if track else result
    about: Any = getattr(of, "record", None) or (getattr(of, "records", None) or ({},))[0]
    about = about if isinstance(about, Mapping) else {"file": about}
    began = _time_of(about) if taken_at is None else taken_at
    changes = result.totals.changes if track else ()
    model = getattr(of, "model", None)
    return Entry(
        bearing=name, taken_at=began, sha=sha, rig_sha=rig_sha_of(rig), settings=settings, version=installed("ambid"),
        job=job, record=str(about.get("file") or ""), status=getattr(result, "status", "converged"),
        verdict=result.verdict.word, model=model if isinstance(model, str) else str(getattr(of, "structure", "")),
        failed=tuple(dict.fromkeys(r.check for r in result.verdict.reasons)),
        parameters=_tracked(result) if track else _parameters(result),
        covariance_names=getattr(result, "covariance_names", ()), covariance=getattr(result, "covariance", None),
        document=document, rig_name=rig.name, rig=_rig_text(rig),
        events=tuple(Note(at=began + e.t, kind=e.kind, text=e.why, parameter=e.parameter or "") for e in changes),
    )  # fmt: skip


def _time_of(about: Mapping[str, object]) -> float:
    """Return when a record says that it was taken."""
    if not about.get("started"):
        raise AmbidError(
            f"{about.get('file') or 'the record'} does not say when it was taken, and the ledger has to know. Give "
            f"{setting('taken_at', 'TIME')}, or {setting('taken_at', 'file')} for the time of its file"
        )
    return moment(str(about["started"]), "the record's time")


def _parameters(result: Any) -> tuple[EstimatedParameter, ...]:
    """Return the numbers of a result: parameters, bending modes, the sensitivity's peak by axis, also as measured."""
    numbers = [*getattr(result, "parameters", ()), *getattr(result, "mode_parameters", ())]
    for axis, s in (getattr(result, "sensitivity", None) or {}).items():
        entry = plain_json(s)
        peaks, top = {"sensitivity": entry["peak_db"]}, entry["measured_peak_db"]
        if top is not None:
            of_record = EstimatedNumber.of(top, entry.get("measured_sd_db") or 0.0, size=1.0)
            peaks["sensitivity_measured"] = plain_json(of_record)
        for name, peak in peaks.items():
            ends = dict(peak, ci95=tuple(peak["ci95"]))
            numbers.append(EstimatedParameter(name=f"{axis}.{name}", unit="dB", role="free", **ends))
    return tuple(numbers)


def _tracked(track: Track) -> tuple[EstimatedParameter, ...]:
    """Return the last values of a track; one that was frozen for want of information is not identifiable."""
    last = track.lines[-1].parameters if track.lines else {}
    return tuple(
        EstimatedParameter(
            name=name, unit=x.unit, value=x.value, sd=x.sd, ci95=x.ci95, role="free",
            identifiable=not v.stale and not is_vague(v),
        )
        for name, v in last.items() for x in (track[name],)
    )  # fmt: skip


def key_of(sha: str, rig_sha: str, settings: str, version: str | None = None) -> str:
    """Return what is the same for the same record, rig, settings and version (default: this one), 64 digits."""
    parts = [sha, rig_sha, settings, installed("ambid") if version is None else version]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def sha_of(*records: Path) -> str:
    """Return the SHA-256 of a record's file as it lies there; of several that of theirs, in their order."""
    digests = list[str]()
    for path in records:
        try:
            with path.open("rb") as file:
                digests.append(hashlib.file_digest(file, "sha256").hexdigest())
        except OSError as failure:
            raise AmbidError(f"record {path} cannot be read: {failure.strerror or failure}. Check the path") from None
    return digests[0] if len(digests) == 1 else hashlib.sha256(" ".join(digests).encode()).hexdigest()


def rig_sha_of(rig: Rig) -> str:
    """Return the SHA-256 of what a rig says, its calibration tables included; comments and layout do not count."""
    tables = [c.calibration.sha256 for c in rig.channels if c.calibration is not None]
    return hashlib.sha256("\n".join([_rig_text(rig), *tables]).encode()).hexdigest()


def _rig_text(rig: Rig) -> str:
    return rig_text(rig, Path.cwd() if rig.source is None else rig.source.resolve().parent)


def settings_text(job: str, **settings: object) -> str:
    """Return a job and its options, named as the job's function has them; what was not given does not count.

    A file among them stands there as its `sha_of`.
    """
    options = {name: x for name, x in settings.items() if x is not None and x is not False and x not in ((), [], {})}
    return json.dumps({"job": job, **options}, sort_keys=True, default=str, separators=(",", ":"))


def moment(text: str, name: str = "taken_at") -> float:
    """Read a date, or a date and time, as ISO 8601 has it; without an offset it is UTC. Returns s since 1970, UTC."""
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        time = datetime.min
    if not _YEARS[0] <= time.year < _YEARS[1]:
        raise AmbidError(
            f"{setting(name)} is {text!r:.40}; it must be a date and time such as 2026-03-01T14:30 (UTC, or with an "
            f"offset), from {_YEARS[0]} to {_YEARS[1] - 1}. Correct it"
        )
    return (time if time.tzinfo is not None else time.replace(tzinfo=UTC)).timestamp()


def day(at: float) -> str:
    """Write a time, s since 1970, as a date and time of UTC, to the minute; of one beyond the calendar its year."""
    try:
        return datetime.fromtimestamp(at, UTC).strftime("%Y-%m-%d %H:%M")
    except (ValueError, OverflowError, OSError):
        return f"the year {1970 + at / (365.25 * 86400.0):.0f}"


@cache
def tables() -> Any:
    """Return the tables for SQLite and PostgreSQL, as attributes of their metadata's ``tables`` by name."""
    import sqlalchemy as sa
    from sqlalchemy import Boolean, Column, Double, ForeignKey, Index, Integer, LargeBinary, Table, Text

    whole = sa.MetaData()
    long = sa.BigInteger().with_variant(Integer(), "sqlite")  # where that is the row's own number

    def column(name: str, kind: Any = Text, *more: Any, nullable: bool = False, **how: Any) -> Any:
        return Column(name, kind, *more, nullable=nullable, **how)

    sa.Sequence("estimate_id", metadata=whole)  # PostgreSQL's; SQLite has one writer at a time
    Table("meta", whole, column("name", primary_key=True), column("value"))
    Table(
        "bearing", whole, column("id", Integer, primary_key=True), column("name", unique=True), column("plant"),
    )  # fmt: skip
    Table("rig", whole, column("sha", primary_key=True), column("name"), column("text", LargeBinary))
    Table(
        "estimate", whole,
        column("id", long, primary_key=True, autoincrement=False),
        column("bearing", Integer, ForeignKey("bearing.id")), column("taken_at", Double),
        *(column(name) for name in ("sha", "rig_sha", "settings", "version")),
        column("key", unique=True),
        *(column(name) for name in ("job", "record", "status", "verdict", "model", "failed")),
        column("added_at", Double),
        # a history reads these; in the index they lie together, in the table each row in a page of its own
        Index(
            "estimate_of", "bearing", "taken_at", "id",
            postgresql_include=[
                "record", "sha", "rig_sha", "job", "model", "version", "status", "verdict", "failed"
            ],
        ),
    )  # fmt: skip
    Table(
        "value", whole,
        column("bearing", Integer), column("name"), column("taken_at", Double),
        column("estimate", long, ForeignKey("estimate.id")),
        column("value", Double, nullable=True), column("sd", Double, nullable=True),
        column("identifiable", Boolean), column("unit"), column("role"),
        # in the order in which a history reads it, so that one lies together
        sa.PrimaryKeyConstraint(
            "bearing", "name", "taken_at", "estimate",
            postgresql_include=["value", "sd", "identifiable", "unit", "role"],
        ),
        sqlite_with_rowid=False,
    )  # fmt: skip
    Table(
        "event", whole, column("id", Integer, primary_key=True), column("bearing", Integer, ForeignKey("bearing.id")),
        column("at", Double), *(column(name) for name in ("kind", "parameter", "text")),
        column("estimate", long, ForeignKey("estimate.id"), nullable=True), Index("event_of", "bearing", "at"),
    )  # fmt: skip
    Table(
        "document", whole, column("estimate", long, ForeignKey("estimate.id"), primary_key=True, autoincrement=False),
        column("json", LargeBinary), column("covariance", LargeBinary),
    )  # fmt: skip
    Table(
        "failure", whole, column("key", primary_key=True),
        *(column(name) for name in ("bearing", "record", "sha", "rig_sha", "settings", "version", "reason")),
        column("failed_at", Double),
    )  # fmt: skip
    Table(  # `old`: JSON, zlib: bearing and time of each estimate before, by key
        "correction", whole, column("id", Integer, primary_key=True), column("at", Double),
        *(column(name) for name in ("who", "kind", "bearing", "text", "why")), column("old", LargeBinary),
        Index("correction_of", "bearing", "at"),
    )  # fmt: skip
    Table(  # what a correction said of a record: stored under `name` it is of `bearing`, and of that time, if any
        "assignment", whole, column("sha", primary_key=True), column("name", primary_key=True), column("bearing"),
        column("taken_at", Double, nullable=True),
    )  # fmt: skip
    Table(  # records that a fleet has at work; `key`: as that of the estimate to come
        "claim", whole, column("key", primary_key=True), column("record"), column("owner"),
        column("begun_at", Double), column("heartbeat_at", Double), column("tries", Integer),
    )  # fmt: skip
    Table(  # alarms acknowledged or silenced; `since`: when the alarm was raised, none: any of this rule
        "silence", whole, column("id", Integer, primary_key=True), column("at", Double),
        *(column(name) for name in ("kind", "bearing", "rule", "parameter")),
        column("since", Double, nullable=True), column("until", Double, nullable=True), column("who"), column("why"),
        Index("silence_of", "bearing", "at"),
    )  # fmt: skip
    return whole
