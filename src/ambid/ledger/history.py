"""What is known of one bearing over time: estimates, the numbers in them, events, changes of the rig."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice, pairwise, zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import AmbidError, EstimationError, counted, nearest
from ambid.estimation.result import Reason, Result
from ambid.ledger import schema
from ambid.ledger.entry import Note

if TYPE_CHECKING:
    from sqlalchemy import Connection

SCHEMA = "ambid.history/1"
_ORDER = ("m", "k_x", "k_i", "R", "L")
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
    """

    bearing: str
    plant: str
    ledger: str
    estimates: tuple[KnownEstimate, ...]
    series: Mapping[str, Series]
    events: tuple[Note, ...] = ()

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
            known = list(self.series)
            raise EstimationError(
                f"the history has no parameter {name!r}; it has {', '.join(known)}.{nearest(name, known)} "
                "Check the name"
            )
        return self.series[name]


def history_of(c: Connection, bearing: str, shown: str) -> History:
    """Read the history of a bearing; `shown`: name of the ledger."""
    from sqlalchemy import case, func, select

    t = schema.tables().tables
    b, e, v, n = (t[name].c for name in ("bearing", "estimate", "value", "event"))
    known = c.execute(select(b.id, b.name, b.plant).where(b.name == bearing)).first()
    if known is None:
        names = [row.name for row in c.execute(select(b.name).order_by(b.name))]
        raise AmbidError(
            f"ledger {shown} has no bearing {bearing!r}.{nearest(bearing, names)} 'ambid history --ledger {shown}' "
            "lists them"
        )
    asked = [getattr(e, name) for name in KnownEstimate.__slots__]
    rows = _rows(c, select(*asked, e.id).where(e.bearing == known.id).order_by(e.taken_at, e.id))
    estimates = tuple(KnownEstimate(*row[:-1]) for row in rows)
    of = v.bearing == known.id
    heads = _rows(
        c, select(v.name, func.count(), func.max(v.unit), func.max(v.role)).where(of).group_by(v.name).order_by(v.name)
    )
    shown_value = case((v.identifiable, v.value))  # else none: less to fetch than the word beside it
    numbers = _rows(c, select(v.estimate, shown_value, v.sd).where(of).order_by(v.name, v.taken_at, v.estimate))
    events = _rows(c, select(n.at, n.kind, n.text, n.parameter).where(n.bearing == known.id).order_by(n.at))
    notes = [Note(at=at, kind=kind, text=text, parameter=parameter) for at, kind, text, parameter in events]
    notes += _rig_changes(c, estimates)
    return History(
        bearing=known.name, plant=known.plant, ledger=shown, estimates=estimates,
        series=_series(heads, numbers, [row[-1] for row in rows], estimates),
        events=tuple(sorted(notes, key=lambda x: x.at)),
    )  # fmt: skip


def _rows(c: Connection, asked: Any) -> list[tuple[Any, ...]]:
    """Return rows as the driver has them: a history is thousands."""
    return list(c.execute(asked).cursor.fetchall())


def _series(
    heads: list[tuple[Any, ...]], rows: list[tuple[Any, ...]], ids: list[int], estimates: tuple[KnownEstimate, ...]
) -> dict[str, Series]:
    """Divide rows in order of name and time into series; `heads`: name, number of rows, unit and role of each."""
    table = np.array(rows, dtype=float).reshape(-1, 3)
    usable = np.array([x.verdict != "unusable" for x in estimates], dtype=bool)
    times = np.array([x.taken_at for x in estimates])
    order = np.argsort(ids)
    of = order[np.searchsorted(np.array(ids)[order], table[:, 0])]
    seen = ~np.isnan(table[:, 1])
    at = times[of]
    table[~(seen & usable[of]), 1:] = np.nan
    ends = np.cumsum([0, *(head[1] for head in heads)])
    found = {
        name: Series(
            name=name, unit=unit, role=role, taken_at=at[a:z], value=table[a:z, 1], sd=table[a:z, 2],
            identifiable=seen[a:z], estimate=of[a:z],
        )
        for (name, _, unit, role), (a, z) in zip(heads, pairwise(ends), strict=True)
    }  # fmt: skip
    return dict(sorted(found.items(), key=_place))


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
    t = schema.tables().tables["rig"].c
    used = {estimates[k - j].rig_sha for k in at for j in (0, 1)}
    lines = {
        row.sha: zlib.decompress(row.text).decode().splitlines()
        for row in c.execute(select(t.sha, t.text).where(t.sha.in_(used)))
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
    shown = "; ".join(
        f"{' '.join(a.split()) or 'nothing'} became {' '.join(b.split()) or 'nothing'}"
        for a, b in islice(zip_longest(gone, come, fillvalue=""), _SHOWN)
    )
    rest = max(len(gone), len(come)) - _SHOWN
    return shown + (f"; and {counted(rest, 'more line')}" if rest > 0 else "")
