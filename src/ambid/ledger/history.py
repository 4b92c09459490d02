"""What is known of one bearing over time: estimates, the numbers in them, events, changes of the rig."""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from itertools import chain, islice, pairwise, starmap, zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import AmbidError, EstimationError, choices, counted, nearest
from ambid.estimation.result import Reason, Result
from ambid.ledger.entry import OWN, Correction, Note, tables
from ambid.settings.caller import command

if TYPE_CHECKING:
    from sqlalchemy import Connection

SCHEMA = "ambid.history/1"
_HEADS = """
    WITH RECURSIVE
        own(id) AS (SELECT CAST(? AS integer)),
        head(name) AS (
            SELECT ''
            UNION ALL
            SELECT (SELECT min(v.name) FROM value AS v WHERE v.bearing = own.id AND v.name > head.name)
            FROM head, own WHERE head.name IS NOT NULL
        )
    SELECT
        name,
        (SELECT v.unit FROM value AS v WHERE v.bearing = own.id AND v.name = head.name
         ORDER BY v.taken_at, v.estimate LIMIT 1),
        (SELECT v.role FROM value AS v WHERE v.bearing = own.id AND v.name = head.name AND v.role <> 'fixed'
         ORDER BY v.taken_at DESC, v.estimate DESC LIMIT 1)
    FROM head, own WHERE name <> ''"""  # from name to name by the key, without reading what lies between
_ORDER = ("m", "k_x", "k_i", "R", "L")
_NONE = float("inf")  # for a number that is not there; none that is there is infinite
_SHOWN = 3  # lines of a rig that changed


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Series:
    """One number of a bearing over time; what no record showed, or no usable estimate holds, is NaN.

    Attributes
    ----------
    name, unit : str
        SI.
    taken_at : ndarray, shape (n,)
        Of the records, s since 1970, UTC, ascending.
    value, sd : ndarray, shape (n,), SI
        NaN where the number is not identifiable, or the estimate is not to be used.
    identifiable : ndarray of bool, shape (n,)
        Whether the record showed it.
    estimate : ndarray of int, shape (n,)
        Which of the history's `estimates` it is of.
    role : str
        "fixed" where it was given and never estimated.
    """

    name: str
    unit: str
    taken_at: Array
    value: Array
    sd: Array
    identifiable: NDArray[np.bool_]
    estimate: NDArray[np.int64]
    role: str


@dataclass(slots=True)  # not frozen: a history makes thousands, in a third of the time
class KnownEstimate:
    """One estimate of a history."""

    taken_at: float  # s since 1970, UTC
    record: str
    sha: str
    rig_sha: str
    job: str
    model: str
    version: str
    status: str
    verdict: str  # "usable", "caution" or "unusable"
    failed: str  # names of the checks that speak against it, with commas
    superseded: bool = False  # by one of the same record and job that counts; only where all were asked for


_COLUMNS = KnownEstimate.__slots__[:-1]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class History(Result):
    """A bearing over time.

    Attributes
    ----------
    bearing, plant : str
        Its name, and that of its rig.
    ledger : str
        Where it comes from.
    estimates : tuple of KnownEstimate
        In order of the records' time.
    series : Mapping[str, Series]
        By parameter.
    events : tuple of Note
        What happened, changes of the rig (kind ``rig``) included, in order of time.
    left_out : int
        Estimates of records of which another one of the same job counts: by a newer version, or later.
    corrections : tuple of Correction
        What was corrected, in order.
    """

    bearing: str
    plant: str
    ledger: str
    estimates: tuple[KnownEstimate, ...]
    series: Mapping[str, Series]
    events: tuple[Note, ...] = ()
    left_out: int = 0
    corrections: tuple[Correction, ...] = ()

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """What stands against the latest estimate."""
        last = self.estimates[-1]
        if last.verdict == "usable":
            return ()
        word = {"caution": "to be used with caution", "unusable": "not to be used"}[last.verdict]
        why = last.failed.replace(",", ", ") or last.status
        text = f"the latest estimate ({last.record or 'a record'}) is {word}: {why}"
        never = all(e.verdict == "unusable" for e in self.estimates)
        return (Reason(check="latest", text=f"{text}. Look at it, or take another record", grave=never),)

    @property
    def measured(self) -> dict[str, Series]:
        """The series that were estimated: fixed numbers are left out."""
        return {name: s for name, s in self.series.items() if s.role != "fixed"}

    def __getitem__(self, name: str) -> Series:
        if name not in self.series:
            raise EstimationError(
                f"the history has no parameter {name!r}; it has {choices(name, self.series)} Check the name"
            )
        return self.series[name]


def history_of(c: Connection, bearing: str, ledger: str, *, every: bool = False) -> History:
    """Read the history of a bearing: of each record and job the estimate that counts, or `every` one.

    `ledger`: name of the ledger.
    """
    of, name, plant = bearing_of(c, bearing, ledger)
    heads, events, corrections, rows = _rows(
        c,
        (_HEADS, of),
        ("SELECT at, kind, text, parameter, estimate FROM event WHERE bearing = ? ORDER BY at", of),
        ("SELECT id, at, who, kind, bearing, text, why FROM correction WHERE bearing = ? ORDER BY at, id", name),
        (f"SELECT {', '.join(_COLUMNS)}, id FROM estimate WHERE bearing = ? ORDER BY taken_at, id", of),
    )
    estimates, ids = tuple(starmap(KnownEstimate, (row[:-1] for row in rows))), [row[-1] for row in rows]
    series, left_out = _series(c, of, heads, ids, estimates), set[int]()
    if len({(e.sha, e.job) for e in estimates}) < len(estimates):
        left_out = superseded(c, of)
        if every:
            for number, e in zip(ids, estimates, strict=True):
                e.superseded = number in left_out
        else:
            counts = np.array([number not in left_out for number in ids], dtype=bool)
            estimates = tuple(e for e, counted_ in zip(estimates, counts, strict=True) if counted_)
            series = {key: _of_those_that_count(s, counts) for key, s in series.items()}
            events = [row for row in events if row[-1] not in left_out]
    notes = [Note(at=at, kind=kind, text=text, parameter=parameter) for at, kind, text, parameter, _ in events]
    notes += _rig_changes(c, estimates)
    return History(
        bearing=name, plant=plant, ledger=ledger, estimates=estimates, series=series,
        events=tuple(sorted(notes, key=lambda x: x.at)), left_out=0 if every else len(left_out),
        corrections=tuple(starmap(Correction, corrections)),
    )  # fmt: skip


def bearing_of(c: Connection, bearing: str, ledger: str, *, own: bool = False) -> tuple[int, str, str]:
    """Return number, name and rig's name of a bearing; refuse one that is not there, or but for `own` the ledger's."""
    (known,) = _rows(c, ("SELECT id, name, plant FROM bearing WHERE name = ?", bearing))
    if known and (own or not bearing.startswith(OWN)):
        return known[0]
    names = [name for rows in _rows(c, ("SELECT name FROM bearing ORDER BY name",)) for (name,) in rows]
    near = nearest(bearing, [name for name in names if not name.startswith(OWN)])
    listing = command("history", ledger=ledger)
    raise AmbidError(f"ledger {ledger} has no bearing {bearing!r}.{near} '{listing}' lists them")


def superseded(c: Connection, bearing: int | None = None) -> set[int]:
    """Return the estimates, of a bearing or of all, that do not count: of one record and job that of the newest version
    of ambid does, and of several by that version the latest.
    """
    where, values = ("", ()) if bearing is None else ("WHERE bearing = ?", (bearing,))
    groups: dict[tuple[object, ...], list[tuple[tuple[Any, ...], float, int]]] = {}
    query = f"""
        SELECT e.id, e.bearing, e.sha, e.job, e.version, e.added_at FROM estimate AS e JOIN (
            SELECT bearing, sha, job FROM estimate {where} GROUP BY bearing, sha, job HAVING count(*) > 1
        ) AS d ON d.bearing = e.bearing AND d.sha = e.sha AND d.job = e.job"""
    for rows in _rows(c, (query, *values)):
        for number, of, sha, job, version, added_at in rows:
            groups.setdefault((of, sha, job), []).append((_age(version), added_at, number))
    return {number for group in groups.values() for _, _, number in sorted(group)[:-1]}


def _age(version: str) -> tuple[tuple[int, ...], bool, str]:
    """Return what puts versions in order: 1.10 is newer than 1.9, and 1.0 than 1.0rc1."""
    numbers, rest = re.match(r"([0-9.]*)(.*)", version, re.DOTALL).groups()  # type: ignore[union-attr]
    return tuple(int(x) for x in numbers.split(".") if x), not re.match(r"\W?(a|b|rc|dev)", rest), rest


def _of_those_that_count(s: Series, counts: NDArray[np.bool_]) -> Series:
    """Return a series without the estimates that do not count; `counts`: of all estimates, which do."""
    own, place = counts[s.estimate], np.cumsum(counts) - 1
    parts = {x: getattr(s, x)[own] for x in ("taken_at", "value", "sd", "identifiable")}
    return replace(s, estimate=place[s.estimate[own]], **parts)


def _rows(c: Connection, *questions: tuple[Any, ...]) -> Iterator[list[tuple[Any, ...]]]:
    """Yield the rows of each question as the driver has them: SQLAlchemy would take as long again for a history.

    A server hears all questions at once: it answers the next while the rows of one are made into objects.
    """
    if c.dialect.name == "sqlite":
        yield from (list(c.exec_driver_sql(query, tuple(values)).cursor.fetchall()) for query, *values in questions)
        return
    driver: Any = c.connection.driver_connection
    with driver.pipeline() if len(questions) > 1 else nullcontext():
        cursors = [driver.cursor(binary=True).execute(query.replace("?", "%s"), values) for query, *values in questions]
        yield from (cursor.fetchall() for cursor in cursors)


def _series(
    c: Connection, of: int, heads: list[tuple[Any, ...]], ids: list[int], estimates: tuple[KnownEstimate, ...]
) -> dict[str, Series]:
    """Read the series of a bearing; `heads`: name, unit and role of each."""
    usable = np.array([x.verdict != "unusable" for x in estimates], dtype=bool)
    times, all_of_them = np.array([x.taken_at for x in estimates]), np.arange(len(ids))
    rest, series = "FROM value WHERE bearing = ? AND name = ?", {}
    numbers = f"SELECT coalesce(CASE WHEN identifiable THEN value END, ?), coalesce(sd, ?) {rest}"
    ordered = f"{numbers} ORDER BY taken_at, estimate"
    for (name, unit, role), rows in zip(
        heads, _rows(c, *((ordered, _NONE, _NONE, of, name) for name, *_ in heads)), strict=True
    ):
        table = np.fromiter(chain.from_iterable(rows), float, 2 * len(rows)).reshape(-1, 2)
        place = all_of_them
        if len(rows) < len(ids):
            there = {x for rows in _rows(c, (f"SELECT estimate {rest}", of, name)) for (x,) in rows}
            place = np.array([k for k, x in enumerate(ids) if x in there])
        seen = (table != _NONE).all(axis=1)
        table[~(seen & usable[place])] = np.nan
        series[name] = Series(
            name=name, unit=unit, role=role or "fixed", taken_at=times[place], value=table[:, 0],
            sd=table[:, 1], identifiable=seen, estimate=place,
        )  # fmt: skip
    return dict(sorted(series.items(), key=_place))


def _place(item: tuple[str, Series]) -> tuple[str, int, str]:
    """Order a model's parameters as the models do, axis by axis."""
    axis, _, own = item[0].rpartition(".")
    return axis, _ORDER.index(own) if own in _ORDER else len(_ORDER), own


def _rig_changes(c: Connection, estimates: tuple[KnownEstimate, ...]) -> list[Note]:
    """Return where the rig is another one than before, and in what."""
    from sqlalchemy import select

    at = [k for k, (old, new) in enumerate(pairwise(estimates), 1) if old.rig_sha != new.rig_sha]
    if not at:
        return []
    t = tables().tables["rig"].c
    digests = {estimates[k - j].rig_sha for k in at for j in (0, 1)}
    lines = {
        row.sha: zlib.decompress(row.text).decode().splitlines()
        for row in c.execute(select(t.sha, t.text).where(t.sha.in_(digests)))
    }
    return [
        Note(
            at=estimates[k].taken_at, kind="rig",
            text=_difference(lines[estimates[k - 1].rig_sha], lines[estimates[k].rig_sha]),
        )
        for k in at
    ]  # fmt: skip


def _difference(old: list[str], new: list[str]) -> str:
    """Say in what two rigs differ."""
    gone = [x for x in old if x and x not in new]
    come = [x for x in new if x and x not in old]
    if not gone and not come:
        return "a calibration table changed"
    changes = "; ".join(
        f"{' '.join(a.split()) or 'nothing'} became {' '.join(b.split()) or 'nothing'}"
        for a, b in islice(zip_longest(gone, come, fillvalue=""), _SHOWN)
    )
    rest = max(len(gone), len(come)) - _SHOWN
    return changes + (f"; and {counted(rest, 'more line')}" if rest > 0 else "")
