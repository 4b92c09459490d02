"""Bearings watched over time: which alarms stand, since when and why. Only usable estimates and identifiable values
count.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ambid.arrays import Array
from ambid.errors import AmbidError, counted, nearest
from ambid.estimation.result import Reason, Result
from ambid.ledger.causes import cause_of
from ambid.ledger.history import History, Series
from ambid.ledger.rules import BUILT_IN, Rule
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

SCHEMA = "ambid.alarms/1"
_BACK = 0.8  # of the limit, below which an alarm is cleared


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarm:
    """An alarm that a rule raised.

    Attributes
    ----------
    bearing, parameter, rule : str
    raised : float
        Record that raised it, s since 1970.
    cleared : float or None
        Record that cleared it; None while it stands.
    change, change_sd : float
        Relative, at the end or before it was cleared.
    limit : float
        What the rule makes of the first level, SI.
    kind : str
        "drift" or "step".
    at, at_from, at_to : float
        When the step was, or a drift crossed the limit, and the 95 % interval, s since 1970.
    cause : str
        What the changes of all parameters together speak for, or that they leave it open.
    """

    bearing: str
    parameter: str
    rule: str
    raised: float
    cleared: float | None
    change: float
    change_sd: float
    limit: float
    kind: Literal["drift", "step"]
    at: float
    at_from: float
    at_to: float
    cause: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Watched(Result):
    """Bearings watched over time.

    Attributes
    ----------
    ledger : str
        Where their histories are from.
    bearings : tuple of str
        That were watched.
    rules : tuple of Rule
    alarms : tuple of Alarm
        Standing ones first, by date.
    trends : tuple of Trend
        One for each parameter that was measured often enough.
    """

    ledger: str
    bearings: tuple[str, ...]
    rules: tuple[Rule, ...]
    alarms: tuple[Alarm, ...]
    trends: tuple[Trend, ...]

    @property
    def standing(self) -> tuple[Alarm, ...]:
        """Alarms that are not cleared."""
        return tuple(a for a in self.alarms if a.cleared is None)

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """The alarms that stand."""
        n = len(self.standing)
        if not n:
            return ()
        where = sorted({a.bearing for a in self.standing})
        text = f"{counted(n, 'alarm')} stand{'s' if n == 1 else ''} on {counted(len(where), 'bearing')}: "
        return (Reason(check="alarms", text=text + ", ".join(where[:5]) + (" …" if len(where) > 5 else "")),)


def watch(histories: Iterable[History], rules: Sequence[Rule] = BUILT_IN) -> Watched:
    """Watch bearings over time.

    Parameters
    ----------
    histories : iterable of History
    rules : sequence of Rule, optional

    Returns
    -------
    Watched

    Raises
    ------
    AmbidError
        If no bearing has a parameter that a rule names.

    Examples
    --------
    >>> from ambid.ledger import open_ledger, watch
    >>> with open_ledger("works.db", write=False) as ledger:  # doctest: +SKIP
    ...     watched = watch(ledger.history(b.name) for b in ledger.bearings())
    """
    bearings, names = list[History](), set[str]()
    alarms, trends = list[Alarm](), list[Trend]()
    for h in histories:
        bearings.append(h)
        names |= set(h.measured)
        for s in h.measured.values():
            own = [rule for rule in rules if rule.of(s.name)]
            raised = [a for rule in own for a in _alarms(h, s, rule)]
            alarms += raised
            trends += trend_of(h, s, own)
    for rule in rules if rules is not BUILT_IN and bearings else ():
        if not any(rule.of(name) for name in names):
            parameters = sorted(names | {name.rpartition(".")[2] for name in names})
            near = nearest(rule.parameter, parameters)
            raise AmbidError(f"alarm {rule}: no bearing has a parameter {rule.parameter!r}.{near} Correct it")
    ordered = sorted(alarms, key=lambda a: (a.cleared is not None, a.raised, a.bearing))
    return Watched(
        used=tuple(bearings), ledger=bearings[0].ledger if bearings else "",
        bearings=tuple(h.bearing for h in bearings),
        rules=tuple(rules), alarms=tuple(ordered), trends=tuple(trends),
    )  # fmt: skip


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


def _alarms(h: History, s: Series, rule: Rule) -> Iterable[Alarm]:
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
        yield Alarm(
            bearing=h.bearing, parameter=s.name, rule=str(rule), raised=float(v.t[first + raised]),
            cleared=None if cleared is None else float(v.t[first + cleared]), change=float(change[end - 1]),
            change_sd=float(sd[end - 1]), limit=base * (1.0 + rule.change), kind=kind, at=when, at_from=begin, at_to=to,
            cause=f"the rig was changed then ({notes[0].text}); {cause}" if notes else cause,
        )  # fmt: skip
        if cleared is None:
            return
        at = cleared


def _twice(which: Any, begin: int) -> int | None:
    """Return from `begin` the first index that holds and whose predecessor holds."""
    places = np.flatnonzero(which[begin + 1 :] & which[begin:-1])
    return None if not places.size else begin + 1 + int(places[0])
