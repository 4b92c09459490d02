"""What is known of one bearing over time: estimates, the numbers in them, events, changes of the rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import AmbidError, EstimationError, nearest
from ambid.estimation.result import Reason, Result
from ambid.ledger import schema
from ambid.ledger.entry import Note

if TYPE_CHECKING:
    from sqlalchemy import Connection

SCHEMA = "ambid.history/1"


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


@dataclass(frozen=True, slots=True, kw_only=True)
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
        text = f"the latest estimate ({last.record or 'a record'}) is {last.verdict}: {last.failed or last.status}"
        never = all(e.verdict == "unusable" for e in self.estimates)
        return (Reason(check="latest", text=f"{text}. Look at it, or take another record", grave=never),)

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
    from sqlalchemy import select

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
    rows = c.execute(select(e.id, *asked).where(e.bearing == known.id).order_by(e.taken_at, e.id)).all()
    estimates = tuple(KnownEstimate(**dict(zip(KnownEstimate.__slots__, row[1:], strict=True))) for row in rows)
    place = {row[0]: k for k, row in enumerate(rows)}
    lines = c.execute(
        select(v.name, v.taken_at, v.estimate, v.value, v.sd, v.identifiable, v.unit, v.role)
        .where(v.bearing == known.id).order_by(v.name, v.taken_at, v.estimate)
    ).all()  # fmt: skip
    events = c.execute(select(n.at, n.kind, n.text, n.parameter).where(n.bearing == known.id).order_by(n.at)).all()
    notes = [Note(at=x.at, kind=x.kind, text=x.text, parameter=x.parameter) for x in events]
    notes += _rig_changes(estimates)
    return History(
        bearing=known.name, plant=known.plant, ledger=shown, estimates=estimates,
        series=_series(lines, place, estimates), events=tuple(sorted(notes, key=lambda x: x.at)),
    )  # fmt: skip


def _series(lines: Any, place: Mapping[int, int], estimates: tuple[KnownEstimate, ...]) -> dict[str, Series]:
    """Divide rows in order of name and time into series."""
    if not lines:
        return {}
    names, taken_at, number, value, sd, seen, units, roles = zip(*lines, strict=True)
    ends = [0, *(k for k in range(1, len(names)) if names[k] != names[k - 1]), len(names)]
    usable = np.array([x.verdict != "unusable" for x in estimates])
    of = np.array([place[x] for x in number])
    shown = np.array(seen, dtype=bool)
    kept = shown & usable[of]
    at, x, s = (np.array(column, dtype=float) for column in (taken_at, value, sd))
    found = {}
    for a, z in pairwise(ends):
        cut = slice(a, z)
        found[names[a]] = Series(
            name=names[a], unit=units[z - 1], role=roles[z - 1], taken_at=at[cut], identifiable=shown[cut],
            value=np.where(kept[cut], x[cut], np.nan), sd=np.where(kept[cut], s[cut], np.nan), estimate=of[cut],
        )  # fmt: skip
    return found


def _rig_changes(estimates: tuple[KnownEstimate, ...]) -> list[Note]:
    return [
        Note(at=new.taken_at, kind="rig", text=f"the rig changed ({old.rig_sha[:8]} to {new.rig_sha[:8]})")
        for old, new in pairwise(estimates)
        if old.rig_sha != new.rig_sha
    ]
