"""What is missing or wrong in a bearing's records: none come, none is usable, none shows a parameter, impossible dates,
records stored twice or under another name. One rule of what is overdue, for alarms and for the state of a bearing.
"""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ambid.arrays import Array
from ambid.errors import counted, listed
from ambid.ledger.alarm import Alarm, RecordKind
from ambid.ledger.entry import day
from ambid.ledger.history import History, KnownEstimate, Series
from ambid.ledger.rules import DAY_S, RecordRule

if TYPE_CHECKING:
    from ambid.ledger.store import Failure

_UNKNOWN_S = 92.0 * DAY_S  # what is overdue where fewer than three estimates, or less than a week, do not say
_YOUNG = 30  # pauses, of which that is less certain by half
_LONGEST_S = 182.0 * DAY_S  # however irregular a bearing is
_WEEK_S = 7.0 * DAY_S  # works that rest on two of its days are known after one
_LATEST = 100  # pauses of which the usual one is learnt
_BEYOND = 4.0  # how far beyond the longest but one of them, in what separates it from the median
_CHANCE = 1e-7  # of as many records in succession that are not usable as is usual, from which that is told
_LEAST = 3  # of them
_USUALLY = 0.1, 0.02  # share of records that are not usable, and that fail, before any is known
_WEIGHT = 10  # records' worth of that belief
_SAME = 0.1  # standard deviations between numbers of a record and its copy
_EARLIEST = 631152000.0  # 1990: a clock that was not set says 1970 or 1980
_SHOWN = 3  # records that are named
_PARTS = 40  # of a pause, in which the other bearings are looked at
_ELSE = 0.1  # of their usual rate, below which they stand still
_ENOUGH = 20  # records of theirs that show that rate
_SHUT_S = 35.0 * DAY_S  # from which a shutdown is told
Numbers = dict[str, tuple[float, float]]  # value and standard deviation by parameter


def span(seconds: float) -> str:
    """Write a time in days, or in hours where it is short."""
    return counted(round(seconds / DAY_S), "day") if seconds > 2 * DAY_S else counted(round(seconds / 3600.0), "hour")


@dataclass(frozen=True, slots=True)
class Pauses:
    """When estimates of a bearing came, and from when the next one is overdue."""

    usual_s: float | None  # time between two; None where it is not known
    overdue_s: float  # after the last one, from which the next is overdue
    long: tuple[tuple[float, float, float], ...]  # pauses that were longer: last before, overdue then, next


def pauses(taken: Array, rule: RecordRule) -> Pauses:
    """Return how estimates follow each other, each pause judged by those before it; `taken`: s since 1970, ascending.

    Overdue is what is later than four and a half usual times, and than what an irregular bearing has shown: the
    longest but one of its last 100 pauses, and four times as far again from their median, more of a short history.
    A pause that was told counts as one at the limit, so that a new habit is learnt.
    """
    order, latest, long = list[float](), deque[float](), list[tuple[float, float, float]]()
    for begin, pause in zip(taken[:-1].tolist(), np.diff(taken).tolist(), strict=True):
        if pause <= 0.0:
            continue
        limit = _overdue(order, rule, begin - taken[0])
        if pause > limit:
            long.append((begin, begin + limit, begin + pause))
        insort(order, min(pause, limit) if len(order) > 1 else pause)
        latest.append(min(pause, limit) if len(order) > 2 else pause)
        if len(latest) > _LATEST:
            del order[bisect_left(order, latest.popleft())]
    usual = rule.every_s or (float(np.median(order)) if len(order) > 1 else None)
    return Pauses(usual, _overdue(order, rule, float(np.ptp(taken)) if taken.size else 0.0), tuple(long))


def _overdue(order: Sequence[float], rule: RecordRule, known_s: float) -> float:
    """Return after how long the next record is overdue; `order`: pauses before, ascending, over a time `known_s`."""
    n = len(order)
    if rule.every_s is not None:
        return rule.late * rule.every_s
    if n < 2 or known_s < _WEEK_S:
        return _UNKNOWN_S
    median = 0.5 * (order[n // 2] + order[(n - 1) // 2])
    high = order[n - 1 - (n > _WEIGHT)]
    irregular = min(high + _BEYOND * (1.0 + _YOUNG / n) * (high - median), _LONGEST_S)
    return max(rule.late * median, irregular, DAY_S)


def plausible(e: KnownEstimate, now: float) -> bool:
    """Whether a record can have been taken then."""
    return _EARLIEST < e.taken_at < now + DAY_S


def missing(
    h: History, rule: RecordRule, found: Pauses, series: Sequence[Series], failures: Sequence[Failure], now: float
) -> Iterator[Alarm]:
    """Yield alarms about the records of one bearing; `found`: pauses of the plausible ones, `series`: parameters that
    rules watch.
    """
    good = [e for e in h.estimates if plausible(e, now)]
    odd = [e for e in h.estimates if not plausible(e, now)]
    if odd:
        which = listed([f"{e.record or 'a record'} of {day(e.taken_at)}" for e in odd], _SHOWN)
        end = good[-1].taken_at if good else now
        yield alarm_of(h.bearing, "date", odd[0].taken_at, end, f"taken at an impossible time: {which}")
    if good and now - good[-1].taken_at > found.overdue_s:
        last = good[-1].taken_at
        text = f"no estimate for {span(now - last)}{_usual(found)}"
        yield alarm_of(h.bearing, "stale", last, now, text, raised=last + found.overdue_s)
    for begin, due, end in found.long:
        text = f"no estimate for {span(end - begin)}{_usual(found)}"
        yield alarm_of(h.bearing, "stale", begin, end, text, raised=due, cleared=end)
    yield from unusable(h.bearing, rule, good, failures, now)
    for s in series:
        yield from _unseen(h, s, rule, now)
    yield from _double(h, good)


def _usual(found: Pauses) -> str:
    return f", usually one every {span(found.usual_s)}" if found.usual_s is not None else ""


def alarm_of(
    bearing: str, kind: RecordKind, at: float, to: float, text: str, *, parameter: str = "",
    raised: float | None = None, cleared: float | None = None,
) -> Alarm:  # fmt: skip
    """Return an alarm about records, by default raised by the first of them."""
    return Alarm(
        bearing=bearing, parameter=parameter, rule=kind, raised=at if raised is None else raised, cleared=cleared,
        kind=kind, at=at, at_from=min(at, to), at_to=max(at, to), cause=text,
    )  # fmt: skip


def _runs(bad: Sequence[bool], usually: float, rule: RecordRule) -> Iterator[tuple[int, int, int | None]]:
    """Yield runs that are longer than chance makes them: the first, the one at which that was so, the one after it."""
    begin, before, seen = None, usually * _WEIGHT, float(_WEIGHT)
    reached = None
    for k, ill in enumerate([*bad, False]):
        end = k == len(bad)
        if ill and not end:
            begin = k if begin is None else begin
            share = min(before / seen, 0.5)
            least = rule.unusable or max(_LEAST, math.ceil(math.log(_CHANCE) / math.log(share)))
            if reached is None and k - begin + 1 >= least:
                reached = k
            continue
        if begin is not None:
            if reached is not None:
                yield begin, reached, None if end else k
            else:
                before, seen = before + k - begin, seen + k - begin
        begin, reached, seen = None, None, seen + 1.0


def unusable(
    bearing: str, rule: RecordRule, good: Sequence[KnownEstimate], failures: Sequence[Failure], now: float
) -> Iterator[Alarm]:
    """Yield where records came, and none was usable."""
    what: list[tuple[float, str, str]] = [
        *((e.taken_at, "unusable" if e.verdict == "unusable" else "", e.failed or e.status) for e in good),
        *((f.failed_at, "failed", f.reason) for f in failures),
    ]
    what.sort(key=lambda x: x[0])
    failed = [word == "failed" for _, word, _ in what]
    runs: list[tuple[RecordKind, tuple[int, int, int | None]]] = []
    if all(failed) and len(failed) >= _LEAST:
        runs = [("failed", (0, _LEAST - 1, None))]
    else:
        runs += [("failed", run) for run in _runs(failed, _USUALLY[1], rule)]
        ill = _runs([bool(word) for _, word, _ in what], _USUALLY[0], rule)
        runs += [("unusable", run) for run in ill if not all(failed[run[0] : run[2]])]
    for kind, (first, reached, after) in runs:
        run = what[first:after]
        reason, n = Counter(why for _, _, why in run).most_common(1)[0]
        did = "failed" if kind == "failed" else "gave nothing usable"
        text = f"{counted(len(run), 'record')} in succession {did}, {n} of them by {reason.replace(',', ', ')}"
        end = None if after is None else what[after][0]
        yield alarm_of(
            bearing, kind, run[0][0], now if end is None else end, text, raised=what[reached][0], cleared=end,
        )  # fmt: skip


def never(
    bearing: str, rule: RecordRule, failures: Sequence[Failure], at: float, overdue_s: float, now: float
) -> Iterator[Alarm]:
    """Yield alarms about a bearing that has given no estimate yet: its records fail, or none has come for long; `at`:
    when the last one failed, `overdue_s`: after which the next is overdue.
    """
    yield from unusable(bearing, rule, (), failures, now)
    if now - at > overdue_s:
        reason = max(failures, key=lambda f: f.failed_at).reason
        text = f"never an estimate, and no record for {span(now - at)}; the last one failed: {reason}"
        yield alarm_of(bearing, "stale", at, now, text, raised=at + overdue_s)


def _unseen(h: History, s: Series, rule: RecordRule, now: float) -> Iterator[Alarm]:
    """Yield where usable estimates came, and none showed a parameter."""
    seen = set(s.estimate[np.isfinite(s.value)].tolist())
    if not seen:
        return
    first_seen = min(seen)
    e = [
        (x.taken_at, k not in seen)
        for k, x in enumerate(h.estimates)
        if x.verdict != "unusable" and k >= first_seen and plausible(x, now)
    ]
    for first, reached, after in _runs([not_seen for _, not_seen in e], _USUALLY[0], rule):
        run = e[first:after]
        to = now if after is None else e[after][0]
        yield alarm_of(
            h.bearing, "unseen", run[0][0], to, f"{counted(len(run), 'usable estimate')} in succession did not show it",
            parameter=s.name, raised=e[reached][0], cleared=None if after is None else to,
        )  # fmt: skip


def numbers_of(h: History) -> dict[int, Numbers]:
    """Return what each estimate of a history shows, by its place."""
    numbers: dict[int, Numbers] = {}
    for name, s in h.measured.items():
        for k, value, sd in zip(s.estimate.tolist(), s.value.tolist(), s.sd.tolist(), strict=True):
            if math.isfinite(value):
                numbers.setdefault(k, {})[name] = value, sd
    return numbers


def _double(h: History, good: Sequence[KnownEstimate]) -> Iterator[Alarm]:
    """Yield estimates of one record, or of its copy, that both count: of one SHA-256, of the same numbers to the last
    digit, or of one time and numbers that are nearly the same.
    """
    place, numbers = {id(e): k for k, e in enumerate(h.estimates)}, numbers_of(h)
    before: dict[object, tuple[KnownEstimate, Numbers]] = {}
    for e in good:
        own = numbers.get(place[id(e)], {})
        keys: list[object] = [(e.job, e.taken_at)]
        keys += [(e.job, e.sha)] if e.sha else []
        keys += [(e.job, *own.items())] if len(own) > 1 else []
        for other, its in (before[key] for key in keys if key in before):
            if e.taken_at == other.taken_at:  # of one SHA-256 the latest estimate counts
                near = [abs(x - its[name][0]) < _SAME * sd for name, (x, sd) in own.items() if name in its]
                if (e.sha and e.sha == other.sha) or len(near) < 2 or not all(near):
                    continue
            first, second = (f"{x.record or 'a record'} of {day(x.taken_at)}" for x in (other, e))
            text = f"one record stored twice: {first} and {second}"
            yield alarm_of(h.bearing, "double", e.taken_at, other.taken_at, text)
            break
        for key in keys:
            before.setdefault(key, (e, own))


def of_one_bearing(alarms: Iterable[Alarm], histories: Sequence[History]) -> Iterator[Alarm]:
    """Yield alarms; a pause that is none without the time in which the whole works stood still is no alarm, and of one
    that lasts it is said.
    """
    every = np.sort([e.taken_at for h in histories for e in h.estimates])
    for a in alarms:
        hole = _still(a, every) if a.kind == "stale" and len(histories) > _LEAST - 1 else 0.0
        if a.kind != "stale" or a.at_to - a.at_from - hole > a.raised - a.at_from:
            yield a
        elif a.cleared is None:
            yield replace(a, cause=f"{a.cause}; nor did the other bearings give any: does anything reach the ledger?")
        elif hole > _SHUT_S:
            yield replace(a, cause=f"{a.cause}; nor did the other bearings give any")


def _still(a: Alarm, every: Array) -> float:
    """Return the longest time within a pause in which all bearings gave less than a tenth of what they had, s. The
    records at its ends are its own.
    """
    length = a.at_to - a.at_from
    edges = np.linspace(a.at_from, a.at_to, _PARTS + 1)
    before = float(np.diff(np.searchsorted(every, (a.at_from - length, a.at_from)))[0]) / _PARTS
    if before * _PARTS < _ENOUGH:
        return 0.0
    counts = np.diff([*np.searchsorted(every, edges[:-1], side="right"), np.searchsorted(every, a.at_to)])
    busy = np.flatnonzero(counts >= max(_ELSE * before, 1.0 if before > 1.0 else 0.5))
    return float(np.max(np.diff([-1, *busy, _PARTS])) - 1) * length / _PARTS
