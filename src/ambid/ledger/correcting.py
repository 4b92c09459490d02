"""Corrections of a ledger: bearings renamed, times mended, estimates removed. Each moves estimates to another bearing
or time, keeps where they were, and is undone by moving them back. What was removed lies in a bearing of its own.
"""

from __future__ import annotations

import getpass
import json
import math
import socket
import time
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

from ambid.errors import AmbidError, choices, counted, listed, nearest
from ambid.ledger.entry import ARCHIVED, OWN, REMOVED, Correction, day, tables
from ambid.ledger.history import bearing_of
from ambid.ledger.rows import assignments, bearing_numbers, chunks, copy_in, put
from ambid.settings.caller import setting

if TYPE_CHECKING:
    from sqlalchemy import Connection

_LEAST = 6  # digits of a SHA-256 that name a record
_SHOWN = 4  # records in a refusal
Place = tuple[str, float]  # bearing, and time of the record
Kind = Literal["rename", "redate", "remove"]
Before = tuple[str | None, float | None]  # those of them that a correction changed


@dataclass(frozen=True, slots=True)
class Stored:
    """An estimate as it is stored."""

    key: str
    number: int
    sha: str
    record: str
    bearing: str
    taken_at: float
    added_at: float


def corrected(
    c: Connection, ledger: str, kind: Kind, bearing: str, to: str | float, record: str | None, **about: str
) -> Correction:
    """Give a bearing, or one record of it, another name or time, or take it out of what is shown and judged."""
    if kind not in get_args(Kind):
        raise AmbidError(f"kind is {kind!r}; it is {choices(kind, get_args(Kind))} Correct it")
    if kind == "redate" and (isinstance(to, str) or not math.isfinite(to)):
        raise AmbidError(f"{setting('redate', repr(to))}: a time is a finite number, s since 1970. Give one")
    name = " ".join(str(to).split()) if kind == "rename" else REMOVED if kind == "remove" else bearing
    if not name:
        raise AmbidError(f"{setting('rename', repr(to))}: a bearing must have a name. Give one")
    if kind == "rename" and name == bearing:
        raise AmbidError(f"{setting('rename', repr(to))}: the bearing has that name already. Give another")
    own = estimates_of(c, ledger, bearing, record)
    text = f"{_counted(own)} of {bearing!r} removed"
    if kind == "rename":
        text = f"{bearing!r} became {name!r} ({_counted(own)}){_twice(own, stored(c, name))}"
    elif kind == "redate":
        text = _redated(own, bearing, float(to))
    moves = {e.key: (name, float(to) if kind == "redate" else e.taken_at) for e in own}
    return correct(c, own, moves, kind, bearing if kind == "remove" else name, text, **about)


def _twice(own: Sequence[Stored], others: Sequence[Stored]) -> str:
    """Say which records of a bearing stand under its new name too."""
    there = {e.sha for e in others}
    twice = {e.sha: e for e in own if e.sha in there}
    if not twice:
        return ""
    first = next(iter(twice.values()))
    return f"; {counted(len(twice), 'record')} stood there already, such as {first.record} of {day(first.taken_at)}"


def _redated(own: Sequence[Stored], bearing: str, taken_at: float) -> str:
    """Say what another time of a record changes; refuse several records, and the same time."""
    if len({e.sha for e in own}) > 1:
        raise AmbidError(
            f"{bearing!r} has {counted(len({e.sha for e in own}), 'record')}, and a time is that of one. Give "
            f"{setting('record', 'NAME')}"
        )
    if all(e.taken_at == taken_at for e in own):
        raise AmbidError(f"the record of {bearing!r} has that time already. Give another")
    return f"{own[0].record} of {day(own[0].taken_at)} was taken {day(taken_at)} ({_counted(own)})"


def undo(c: Connection, ledger: str, number: int, **about: str) -> Correction:
    """Put estimates where they were before a correction."""
    known = c.exec_driver_sql("SELECT id, at, bearing, text, old FROM correction ORDER BY id").all()
    row = next((row for row in known if row.id == number), None)
    if row is None:
        raise AmbidError(
            f"{setting('undo', number)}: ledger {ledger} has no such correction; it has "
            f"{listed([str(x.id) for x in known], _SHOWN) or 'none'}. Correct it"
        )
    moves = _back(c, json.loads(zlib.decompress(row.old)), row.at)
    own = [e for e in stored_by_key(c, moves) if (e.bearing, e.taken_at) != moves[e.key]]
    if not own:
        raise AmbidError(
            f"{setting('undo', number)}: of correction {number} ({row.text}) nothing is left to be undone. What was "
            "archived comes back by 'ambid ledger merge', what was replaced by 'ambid ledger restore'"
        )
    names = {moves[e.key][0] for e in own} - {REMOVED}
    bearing = names.pop() if len(names) == 1 else row.bearing
    text = f"correction {number} undone ({row.text})"
    return correct(c, own, moves, "undo", bearing, text, **about)


def _back(c: Connection, old: Mapping[str, Before | None], since: float) -> dict[str, Place]:
    """Return where estimates go back to, with those of the same records that came to them since; `old`: by key."""
    moves: dict[str, Place] = {}
    records: dict[str, dict[str, Before]] = {}  # of each bearing, those of whose estimates more may have come
    for e in stored_by_key(c, old):
        before = old[e.key]
        if e.bearing != ARCHIVED:
            moves[e.key] = (REMOVED, e.taken_at) if before is None else _put_back(e, before)
            records.setdefault(e.bearing, {}).update({} if before is None else {e.sha: before})
    for name, of in records.items():
        for e in stored(c, name) if of else ():
            if e.sha in of and e.added_at > since and e.key not in old:
                moves[e.key] = _put_back(e, of[e.sha])
    return moves


def _put_back(e: Stored, before: Before) -> Place:
    bearing, taken_at = before
    return e.bearing if bearing is None else bearing, e.taken_at if taken_at is None else taken_at


def corrections(c: Connection) -> tuple[Correction, ...]:
    """Return all corrections, in order."""
    rows = c.exec_driver_sql("SELECT id, at, who, kind, bearing, text, why FROM correction ORDER BY at, id")
    return tuple(Correction(*row) for row in rows)


def correct(
    c: Connection, own: Sequence[Stored], moves: Mapping[str, Place], kind: str, bearing: str, text: str, **about: str
) -> Correction:
    """Move estimates, `own` as they are now, to bearings and times by key, and keep where they were."""
    _assign(c, own, moves)
    place(c, own, moves)
    old = {e.key: _changed(e, moves[e.key]) for e in own}
    return note(c, kind, bearing, text, old, **about)


def _changed(e: Stored, to: Place) -> Before:
    return None if to[0] == e.bearing else e.bearing, None if to[1] == e.taken_at else e.taken_at


def place(c: Connection, own: Sequence[Stored], moves: Mapping[str, Place]) -> None:
    """Move estimates, `own` as they are now, to bearings and times by key."""
    plants = {name: bearing_of(c, name, "", own=True) for name in {e.bearing for e in own}}
    targets = bearing_numbers(c, {moves[e.key][0]: plants[e.bearing][2] for e in own})
    for name, (number, *_) in plants.items():
        some = [e for e in own if e.bearing == name]
        _move(c, number, {e.number: (targets[moves[e.key][0]], *moves[e.key][1:]) for e in some})
        target = Counter(moves[e.key][0] for e in some).most_common(1)[0][0]
        _follow(c, (number, name), (targets[target], target))


def note(
    c: Connection, kind: str, bearing: str, text: str, old: Mapping[str, Before | None], who: str = "", why: str = ""
) -> Correction:
    """Enter a correction; `old`: what each estimate had before, by key; none where it was not there."""
    from sqlalchemy import insert

    facts: Any = {"at": time.time(), "who": who or user(), "kind": kind, "bearing": bearing, "text": text, "why": why}
    packed = zlib.compress(json.dumps(old).encode())
    done: Any = c.execute(insert(tables().tables["correction"]).values(**facts, old=packed))
    return Correction(done.inserted_primary_key[0], **facts)


def user() -> str:
    """Return who is at work: account and host."""
    try:
        return f"{getpass.getuser()}@{socket.gethostname()}"
    except (KeyError, OSError):  # an account without a name
        return f"?@{socket.gethostname()}"


def _assign(c: Connection, own: Sequence[Stored], moves: Mapping[str, Place]) -> None:
    """Keep what this says of records, for estimates of them to come; a time counts where it was corrected."""
    from sqlalchemy import delete, insert

    known = assignments(c, (e.sha for e in own))
    names: dict[str, set[str]] = {}
    for sha, name in known:
        names.setdefault(sha, set()).add(name)
    for e in own:
        bearing, at = moves[e.key]
        taken_at = at if at != e.taken_at else known.get((e.sha, e.bearing), ("", None))[1]
        of = names.setdefault(e.sha, set())
        before = {name for name in of if known[e.sha, name][0] == e.bearing} | {e.bearing, bearing}
        known |= {(e.sha, name): (bearing, taken_at) for name in before}
        of |= before
    t = tables().tables["assignment"]
    for some in chunks(list(names)):
        c.execute(delete(t).where(t.c.sha.in_(some)))
    rows = [{"sha": s, "name": n, "bearing": b, "taken_at": at} for (s, n), (b, at) in known.items()]
    c.execute(insert(t), rows)


def _move(c: Connection, source: int, moves: Mapping[int, tuple[int, float]]) -> None:
    """Put estimates of a bearing, with values and events, to bearings and times by number."""
    from sqlalchemy import bindparam, delete, select, update

    t = tables().tables
    v, event, estimate = t["value"], t["event"], t["estimate"]
    for some in chunks(list(moves)):
        of = (v.c.bearing == source) & v.c.estimate.in_(some)
        rows = c.execute(select(v).where(of)).all()
        c.execute(delete(v).where(of))
        copy_in(c, v, [(moves[r[3]][0], r[1], moves[r[3]][1], *r[3:]) for r in rows])
        query = select(event.c.id, event.c.at - estimate.c.taken_at, estimate.c.id).join_from(event, estimate)
        events = c.execute(query.where(event.c.bearing == source, estimate.c.id.in_(some))).all()
        one = update(event).where(event.c.id == bindparam("number"))
        if events:
            rows_ = [{"number": n, "to": moves[e][0], "time": moves[e][1] + later} for n, later, e in events]
            c.execute(one.values(bearing=bindparam("to"), at=bindparam("time")), rows_)
    put(c, ((number, to, at) for number, (to, at) in moves.items()))


def _follow(c: Connection, source: tuple[int, str], target: tuple[int, str]) -> None:
    """Take out a bearing that is left without estimates; what else is known of it follows them."""
    from sqlalchemy import delete, func, select, update

    t = tables().tables
    left = select(func.count()).select_from(t["estimate"]).where(t["estimate"].c.bearing == source[0])
    if source[0] == target[0] or c.execute(left).scalar_one():
        return
    c.execute(update(t["event"]).where(t["event"].c.bearing == source[0]).values(bearing=target[0]))
    c.execute(delete(t["bearing"]).where(t["bearing"].c.id == source[0]))
    if not target[1].startswith(OWN):
        for name in ("failure", "silence", "correction"):
            c.execute(update(t[name]).where(t[name].c.bearing == source[1]).values(bearing=target[1]))


def estimates_of(c: Connection, ledger: str, bearing: str, record: str | None) -> list[Stored]:
    """Return the estimates of a bearing, or of one record of it, by the name of its file or digits of its SHA-256."""
    bearing_of(c, bearing, ledger)
    own = stored(c, bearing)
    if record is None:
        return own
    of = [
        e for e in own
        if record in (e.record, e.record.rpartition("/")[2])
        or (len(record) >= _LEAST and e.sha.startswith(record.lower()))
    ]  # fmt: skip
    asked = setting("record", record)
    if not of:
        names = list(dict.fromkeys(e.record for e in own))
        near = nearest(record, names)
        raise AmbidError(
            f"{asked}: {bearing!r} has no such record; it has {listed(names, _SHOWN)}.{near} Give the name, or at "
            f"least {_LEAST} digits of the SHA-256"
        )
    records = {e.sha: f"{e.sha[:12]} of {day(e.taken_at)}" for e in of}
    if len(records) > 1:
        raise AmbidError(
            f"{asked}: {counted(len(records), 'record')} of {bearing!r} have that name: "
            f"{listed(list(records.values()), _SHOWN)}. Give the digits"
        )
    return of


def stored(c: Connection, bearing: str = "", *, keys: Sequence[str] | None = None) -> list[Stored]:
    """Return the estimates of a bearing, or those of some keys, in order of time."""
    from sqlalchemy import select

    t = tables().tables
    b, e = t["bearing"].c, t["estimate"].c
    query = select(e.key, e.id, e.sha, e.record, b.name, e.taken_at, e.added_at).join_from(t["estimate"], t["bearing"])
    where = b.name == bearing if keys is None else e.key.in_(keys)
    return [Stored(*row) for row in c.execute(query.where(where).order_by(e.taken_at, e.id))]


def stored_by_key(c: Connection, keys: Iterable[str]) -> list[Stored]:
    """Return estimates by their keys; those that are not there are passed over."""
    return [e for some in chunks(list(keys)) for e in stored(c, keys=some)]


def _counted(own: Sequence[Stored]) -> str:
    return f"{counted(len(own), 'estimate')} of {counted(len({e.sha for e in own}), 'record')}"
