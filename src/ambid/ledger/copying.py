"""A ledger copied into another, SQLite and PostgreSQL alike: merged, backed up, restored, and what is old moved into an
archive. A copy is one transaction of the ledger that is written; an estimate that is there stays as it is.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Literal

from ambid.errors import counted
from ambid.ledger import correcting
from ambid.ledger.entry import ARCHIVED, OWN, Correction, tables
from ambid.ledger.history import superseded
from ambid.ledger.rows import assignments, bearing_numbers, chunks, copy_in, estimate_numbers, insert_new, put

if TYPE_CHECKING:
    from sqlalchemy import Connection

Keep = Literal["none", "day", "week", "month", "year"]
_PERIODS: Mapping[str, str] = {"day": "%Y-%m-%d", "week": "%G-%V", "month": "%Y-%m", "year": "%Y"}
_PARTS = 200  # documents at once


def merge(source: Connection, c: Connection, name: str, **about: str) -> Correction:
    """Add what another ledger of this name has and this one lacks, as one correction."""
    new = copy(source, c)
    text = f"{counted(len(new), 'estimate')} of {name} added"
    return correcting.note(c, "merge", "", text, dict.fromkeys(new), **about)


def restore(source: Connection, c: Connection, name: str, **about: str) -> Correction:
    """Put what another ledger of this name holds in place of all."""
    from sqlalchemy import delete

    for table in reversed(tables().sorted_tables):
        if table.name not in ("meta", "claim"):  # that of programs which run now
            c.execute(delete(table))
    text = f"all replaced by {counted(len(copy(source, c)), 'estimate')} of {name}"
    return correcting.note(c, "restore", "", text, {}, **about)


def to_move(c: Connection, before: float, keep: Keep) -> list[str]:
    """Return the estimates from before a time, by key, but for one of each bearing, job and period: the first that is
    usable, else the first.
    """
    from sqlalchemy import select

    t = tables().tables
    b, e = t["bearing"].c, t["estimate"].c
    query = select(e.key, e.id, b.name, e.job, e.taken_at, e.verdict).join_from(t["estimate"], t["bearing"])
    rows = c.execute(query.where(e.taken_at < before, b.name != ARCHIVED).order_by(e.taken_at, e.id)).all()
    stay: dict[tuple[str, str, str], Any] = {}
    left_out = superseded(c) if keep != "none" else set()
    for row in rows if keep != "none" else ():
        if row.id not in left_out and not row.name.startswith(OWN):
            period = datetime.fromtimestamp(row.taken_at, UTC).strftime(_PERIODS[keep])
            first = stay.setdefault((row.name, row.job, period), row)
            if first.verdict != "usable" and row.verdict == "usable":
                stay[row.name, row.job, period] = row
    staying = {row.id for row in stay.values()}
    return [row.key for row in rows if row.id not in staying]


def hollow(c: Connection, keys: Collection[str], archive: str, rule: str, **about: str) -> Correction:
    """Take out values, events and documents of estimates that an archive holds; of each its row stays."""
    from sqlalchemy import delete

    t = tables().tables
    own = [e for e in correcting.stored_by_key(c, keys) if e.bearing != ARCHIVED]
    for some in chunks([e.number for e in own]):
        c.execute(delete(t["document"]).where(t["document"].c.estimate.in_(some)))
    numbers = bearing_numbers(c, {e.bearing: "" for e in own})
    for name in numbers:
        for some in chunks([e.number for e in own if e.bearing == name]):
            for table in (t["value"], t["event"]):
                c.execute(delete(table).where(table.c.bearing == numbers[name], table.c.estimate.in_(some)))
    correcting.place(c, own, {e.key: (ARCHIVED, e.taken_at) for e in own})
    return correcting.note(c, "retain", "", f"{counted(len(own), 'estimate')} {rule} moved to {archive}", {}, **about)


def copy(source: Connection, c: Connection, only: Collection[str] | None = None) -> list[str]:
    """Copy into a ledger what another one has and it lacks, or `only` estimates of these keys; return their keys."""
    from sqlalchemy import delete, select

    t = tables().tables
    for name in ("rig", "assignment") if only is None else ("rig",):
        insert_new(c, t[name], [dict(row) for row in source.execute(select(t[name])).mappings()])
    for name in ("failure", "silence", "correction") if only is None else ():
        columns = [x for x in t[name].c if x.name != "id"]
        there = {tuple(row) for row in c.execute(select(*columns))}
        query = select(*columns).order_by(*t[name].primary_key)
        rows = [row for row in source.execute(query) if tuple(row) not in there]
        insert_new(c, t[name], [dict(row._mapping) for row in rows])
    wanted = None if only is None else frozenset(only)
    bearings = source.execute(select(t["bearing"]).order_by(t["bearing"].c.name)).all()
    new = [key for bearing in bearings for key in _copy_bearing(source, c, bearing, wanted)]
    c.execute(delete(t["failure"]).where(t["failure"].c.key.in_(select(t["estimate"].c.key))))
    return new


def _copy_bearing(source: Connection, c: Connection, bearing: Any, only: frozenset[str] | None) -> list[str]:
    """Copy the estimates of one bearing that are not there, and fill those of which only the row is."""
    from sqlalchemy import select

    t = tables().tables
    query = select(t["estimate"]).where(t["estimate"].c.bearing == bearing.id).order_by(t["estimate"].c.id)
    rows = [row for row in source.execute(query) if only is None or row.key in only]
    there = {e.key: e for e in correcting.stored_by_key(c, [row.key for row in rows])}
    hollow_too = bearing.name != ARCHIVED
    rows = [r for r in rows if r.key not in there or (hollow_too and there[r.key].bearing == ARCHIVED)]
    if not rows:
        return []
    known = assignments(c, (row.sha for row in rows))
    places = {row.id: known.get((row.sha, bearing.name), (bearing.name, None)) for row in rows}
    targets = bearing_numbers(c, {name: bearing.plant for name, _ in places.values()})
    fresh = [row for row in rows if row.key not in there]
    numbers = dict(zip((row.id for row in fresh), estimate_numbers(c, len(fresh)), strict=True))
    numbers |= {row.id: there[row.key].number for row in rows if row.key in there}
    to = {row.id: targets[places[row.id][0]] for row in rows}
    at = {row.id: places[row.id][1] if places[row.id][1] is not None else row.taken_at for row in rows}
    copy_in(c, t["estimate"], [(numbers[row.id], to[row.id], at[row.id], *row[3:]) for row in fresh])
    put(c, ((numbers[r.id], to[r.id], at[r.id]) for r in rows if r.key in there))
    values = source.execute(select(t["value"]).where(t["value"].c.bearing == bearing.id))
    copy_in(c, t["value"], [(to[r[3]], r[1], at[r[3]], numbers[r[3]], *r[4:]) for r in values if r[3] in to])
    later = {row.id: at[row.id] - row.taken_at for row in rows}
    events = source.execute(select(t["event"]).where(t["event"].c.bearing == bearing.id).order_by(t["event"].c.id))
    insert_new(
        c, t["event"],
        [
            {
                "bearing": to[e.estimate], "at": e.at + later[e.estimate], "estimate": numbers[e.estimate],
                "kind": e.kind, "parameter": e.parameter, "text": e.text,
            }
            for e in events if e.estimate in to
        ],
    )  # fmt: skip
    ids = list(to)
    for k in range(0, len(ids), _PARTS):
        documents = source.execute(select(t["document"]).where(t["document"].c.estimate.in_(ids[k : k + _PARTS])))
        copy_in(c, t["document"], [(numbers[d.estimate], d.json, d.covariance) for d in documents])
    return [row.key for row in rows]
