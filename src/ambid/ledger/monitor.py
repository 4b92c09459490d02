"""Bearings watched over time: which alarms stand, since when and why, and who has taken note. Of parameters only usable
estimates and identifiable values count; what is missing is an alarm too.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.arrays import Array
from ambid.errors import AmbidError, counted, nearest
from ambid.estimation.result import Reason, Result
from ambid.ledger.alarm import Alarm, Silence
from ambid.ledger.causes import cause_of
from ambid.ledger.history import History, Series
from ambid.ledger.misnamed import misnamed
from ambid.ledger.missing import missing, never, of_one_bearing, pauses, plausible
from ambid.ledger.rules import BUILT_IN, RecordRule, Rule
from ambid.ledger.trends import (
    FEW,
    WINDOW,
    Trend,
    Values,
    comparable,
    date_of,
    first_level,
    level_of,
    trend_of,
    values_of,
)

if TYPE_CHECKING:
    from ambid.ledger.store import Failure

SCHEMA = "ambid.alarms/1"
_BACK = 0.8  # of the limit, below which an alarm is cleared
_MORE = 0.5  # limits by which a change has to grow for an alarm to return that somebody has taken note of


@dataclass(frozen=True, slots=True, kw_only=True)
class Now:
    """What is to be said of a bearing at the time of watching; times are those of records, s since 1970."""

    bearing: str
    verdict: str  # of its latest estimate; "" where there is none
    latest: float | None  # estimate
    success: float | None  # the latest usable one
    heard: float | None  # the latest estimate, or failure where there never was one
    overdue_s: float  # after that, from when the next one is overdue
    failures: int  # records without an estimate


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Watched(Result):
    """Bearings watched over time.

    Attributes
    ----------
    ledger : str
        Where their histories are from.
    at : float
        When, s since 1970.
    bearings : tuple of str
        That were watched.
    rules : tuple of Rule
    records : tuple of RecordRule
        What was expected of their records.
    alarms : tuple of Alarm
        Open ones first, then those that stand, by date.
    trends : tuple of Trend
        One for each parameter that was measured often enough.
    states : tuple of Now
        One for each bearing.
    """

    ledger: str
    at: float = math.nan
    bearings: tuple[str, ...]
    rules: tuple[Rule, ...]
    records: tuple[RecordRule, ...] = ()
    alarms: tuple[Alarm, ...]
    trends: tuple[Trend, ...]
    states: tuple[Now, ...] = ()

    @property
    def standing(self) -> tuple[Alarm, ...]:
        """Alarms that are not cleared."""
        return tuple(a for a in self.alarms if a.cleared is None)

    @property
    def open(self) -> tuple[Alarm, ...]:
        """Alarms that stand and that nobody has acknowledged or silenced."""
        return tuple(a for a in self.alarms if a.open)

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """The alarms that are open."""
        n = len(self.open)
        if not n:
            return ()
        where = sorted({a.bearing for a in self.open})
        text = f"{counted(n, 'alarm')} stand{'s' if n == 1 else ''} on {counted(len(where), 'bearing')}: "
        return (Reason(check="alarms", text=text + ", ".join(where[:5]) + (" …" if len(where) > 5 else "")),)


def watch(
    histories: Iterable[History],
    rules: Sequence[Rule | RecordRule] = BUILT_IN,
    *,
    failures: Iterable[Failure] = (),
    silences: Sequence[Silence] = (),
    now: float | None = None,
) -> Watched:
    """Watch bearings over time.

    Parameters
    ----------
    histories : iterable of History
    rules : sequence of Rule or RecordRule, optional
    failures : iterable of Failure, optional
        Records of these bearings that gave no estimate.
    silences : sequence of Silence, optional
        Alarms that were acknowledged or silenced.
    now : float, optional
        s since 1970; default: the time of the clock.

    Returns
    -------
    Watched

    Raises
    ------
    AmbidError
        If no bearing has a parameter that a rule names, or none has the name that a rule gives.

    Examples
    --------
    >>> from ambid.ledger import open_ledger, watch
    >>> with open_ledger("works.db", write=False) as ledger:  # doctest: +SKIP
    ...     watched = watch(ledger.history(b.name) for b in ledger.bearings())
    """
    now = time.time() if now is None else now
    own_rules = [r for r in rules if isinstance(r, Rule)]
    records = {r.bearing: r for r in rules if isinstance(r, RecordRule)}
    failed: dict[str, list[Failure]] = {}
    for f in failures:
        failed.setdefault(f.bearing, []).append(f)
    bearings, states, names = list[History](), list[Now](), set[str]()
    alarms, trends = list[Alarm](), list[Trend]()
    for h in histories:
        bearings.append(h)
        names |= set(h.measured)
        watched = list[Series]()
        for s in h.measured.values():
            own = [rule for rule in own_rules if rule.of(s.name)]
            watched += [s] * bool(own)
            alarms += [a for rule in own for a in _alarms(h, s, rule, silences, now)]
            trends += trend_of(h, s, own)
        rule, own_failed = records.get(h.bearing, records.get("")), failed.pop(h.bearing, [])
        sound = [e for e in h.estimates if plausible(e, now)]
        found = pauses(np.array([e.taken_at for e in sound]), rule or RecordRule())
        if rule is not None:
            alarms += missing(h, rule, found, watched, own_failed, now)
        success = [e.taken_at for e in sound if e.verdict != "unusable"]
        latest = sound[-1].taken_at if sound else None
        states.append(Now(
            bearing=h.bearing, verdict=h.estimates[-1].verdict, latest=latest, heard=latest, overdue_s=found.overdue_s,
            success=success[-1] if success else None, failures=len(own_failed),
        ))  # fmt: skip
    for name, of in sorted(failed.items()):  # records of these never gave an estimate
        rule, at = records.get(name, records.get("")), np.array(sorted(f.failed_at for f in of))
        last, overdue_s = float(at[-1]), pauses(at, rule or RecordRule()).overdue_s
        states.append(Now(
            bearing=name, verdict="", latest=None, success=None, heard=last, overdue_s=overdue_s, failures=len(of),
        ))  # fmt: skip
        if rule is not None:
            alarms += never(name, rule, of, last, overdue_s, now)
    if records:
        alarms += misnamed(bearings, now)
        alarms = list(of_one_bearing(alarms, bearings))
    if rules is not BUILT_IN and bearings:
        _named(own_rules, names, records, [x.bearing for x in states])
    alarms = [a if a.kind in ("drift", "step") else _noted(a, silences, now) for a in alarms]
    return Watched(
        used=tuple(bearings), ledger=bearings[0].ledger if bearings else "", at=now,
        bearings=tuple(x.bearing for x in states), rules=tuple(own_rules), records=tuple(records.values()),
        alarms=tuple(sorted(alarms, key=lambda a: (not a.open, a.cleared is not None, a.raised, a.bearing))),
        trends=tuple(trends), states=tuple(states),
    )  # fmt: skip


def _named(rules: Sequence[Rule], names: set[str], records: Iterable[str], bearings: Sequence[str]) -> None:
    """Refuse rules about what is not there."""
    for rule in rules:
        if not any(rule.of(name) for name in names):
            parameters = sorted(names | {name.rpartition(".")[2] for name in names})
            near = nearest(rule.parameter, parameters)
            raise AmbidError(f"alarm {rule}: no bearing has a parameter {rule.parameter!r}.{near} Correct it")
    for name in records:
        if name and len(bearings) > 1 and name not in bearings:
            raise AmbidError(f"rule of records: there is no bearing {name!r}.{nearest(name, bearings)} Correct it")


def _noted(alarm: Alarm, silences: Sequence[Silence], now: float) -> Alarm:
    """Return an alarm with the latest word on it."""
    if alarm.cleared is not None:
        return alarm
    said = [x for x in silences if x.of(alarm, now)]
    return replace(alarm, noted=max(said, key=lambda x: x.at)) if said else alarm


def _changes(v: Values) -> tuple[Array, Array, int]:
    """Return relative changes of the level since the first values, their spreads, and the index of the first."""
    first = v.first
    base, base_sd = first_level(v)
    later = v[slice(first, None)]
    level = np.array([level_of(later[slice(0, k)]) for k in range(FEW, min(WINDOW, later.t.size + 1))]).reshape(-1, 2)
    if later.t.size >= WINDOW:
        y, sd = (np.lib.stride_tricks.sliding_window_view(x, WINDOW) for x in (later.y, later.sd))
        whole = np.column_stack([np.median(y, axis=1), 1.2533 * np.sqrt(np.mean(sd**2, axis=1) / WINDOW)])
        level = np.concatenate([level, whole])
    return (
        level[:, 0] / base - 1.0, np.hypot(level[:, 1], level[:, 0] / base * base_sd) / abs(base), first + FEW - 1,
    )  # fmt: skip


def _alarms(h: History, s: Series, rule: Rule, silences: Sequence[Silence], now: float) -> Iterable[Alarm]:
    """Yield the alarms of a rule, as the estimates came."""
    from scipy.special import ndtri

    v = values_of(h, s, rule.since)
    if not comparable(v):
        return
    change, sd, first = _changes(v)
    base, _ = first_level(v)
    sd = sd / v.scatter * v.then()[first:]
    beyond = math.copysign(1.0, rule.change) * change / abs(rule.change)  # 1: at the limit
    spread, q = sd / abs(rule.change), float(ndtri(rule.confidence))
    up, down = beyond - 1.0 > q * spread, _BACK - beyond > q * spread
    at = 0
    while (raised := _twice(up, at)) is not None:
        cleared = _twice(down, raised)
        end = up.size if cleared is None else cleared
        part = v[slice(0, first + end)]
        kind, when, begin, to = date_of(part, rule)
        notes = [e for e in h.events if e.kind == "rig" and begin <= e.at <= to] if kind == "step" else []
        cause = cause_of(h, s.name, rule, kind, when, float(part.t[-1]))
        alarm = Alarm(
            bearing=h.bearing, parameter=s.name, rule=str(rule), raised=float(v.t[first + raised]),
            cleared=None if cleared is None else float(v.t[first + cleared]), change=float(change[end - 1]),
            change_sd=float(sd[end - 1]), limit=base * (1.0 + rule.change), kind=kind, at=when, at_from=begin, at_to=to,
            cause=f"the rig was changed then ({notes[0].text}); {cause}" if notes else cause,
        )  # fmt: skip
        if cleared is None:
            own = [x for x in silences if x.of(alarm, now)]
            then = [max(int(np.searchsorted(v.t[first:], x.at, side="right")) - 1, 0) for x in own]
            more = max(_MORE, q * float(spread[-1]))
            yield _noted(alarm, [x for x, k in zip(own, then, strict=True) if beyond[-1] - beyond[k] < more], now)
            return
        yield alarm
        at = cleared


def _twice(which: Any, begin: int) -> int | None:
    """Return from `begin` the first index that holds and whose predecessor holds."""
    places = np.flatnonzero(which[begin + 1 :] & which[begin:-1])
    return None if not places.size else begin + 1 + int(places[0])
