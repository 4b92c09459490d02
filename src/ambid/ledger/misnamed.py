"""Records that stand under another bearing's name: where one is missing, and its numbers are those of that bearing."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.ledger.alarm import Alarm
from ambid.ledger.entry import day
from ambid.ledger.history import History
from ambid.ledger.missing import Numbers, alarm_of, numbers_of, pauses, plausible
from ambid.ledger.rules import RecordRule

_FEW = 3  # estimates of a bearing that may be a slip of the pen
_MANY = 6  # of one whose habits are known
_SLOT = 0.5, 1.5  # usual times from the nearest record, between which one is due
_BESIDE = 5  # values before and after, from which a level is taken
_NEAR, _FAR, _OFF = 5.0, 8.0, 6.0  # standard deviations within which numbers agree, at most, and beyond which not
_ENOUGH = 3  # numbers that agree, where the names are not alike
_SURE = 4  # numbers that are strange, where the rig is another one


@dataclass(slots=True)
class _Habits:
    """A history, and what is usual of it."""

    h: History
    t: Array
    usual_s: float
    numbers: dict[int, Numbers]  # by estimate

    def distances(self, own: Numbers, at: float) -> list[float]:
        """Return how far numbers lie from the levels around a time, in standard deviations."""
        place, found = int(np.searchsorted(self.t, at)), []
        around = range(max(0, place - _BESIDE), min(self.t.size, place + _BESIDE))
        for name, (value, sd) in own.items():
            near = [self.numbers[k][name] for k in around if name in self.numbers.get(k, {})]
            if len(near) >= _FEW:
                level = float(np.median([y for y, _ in near]))
                spread = 1.4826 * float(np.median([abs(y - level) for y, _ in near]))
                found.append(abs(value - level) / max(math.hypot(sd, float(np.median([s for _, s in near]))), spread))
        return found


def misnamed(histories: Sequence[History], now: float) -> Iterator[Alarm]:
    """Yield records that seem to be another bearing's."""
    every = [_Habits(h, np.array([e.taken_at for e in h.estimates]), _usual(h), numbers_of(h)) for h in histories]
    hosts = [x for x in every if x.t.size >= _MANY and math.isfinite(x.usual_s)]
    if not hosts:
        return
    for x in every:
        small = x.t.size <= _FEW
        for k, strange in dict.fromkeys(range(x.t.size), _SURE).items() if small else _strange(x.h).items():
            e = x.h.estimates[k]
            if not plausible(e, now):
                continue
            fits = [(w, host) for host in hosts if host is not x and (w := _fit(x, k, host, strange)) is not None]
            if fits:
                host = min(fits, key=lambda fit: fit[0])[1].h
                text = (
                    f"{e.record or 'the record'} of {day(e.taken_at)} seems to be of {host.bearing!r}: it has none "
                    "then, and the numbers are its"
                )
                yield alarm_of(x.h.bearing, "name", e.taken_at, e.taken_at, text)


def _usual(h: History) -> float:
    usual = pauses(np.array([e.taken_at for e in h.estimates]), RecordRule()).usual_s
    return math.nan if usual is None else usual


def _strange(h: History) -> dict[int, int]:
    """Return the estimates of which two numbers at least lie far from those around them, and how many; those with
    another rig than the ones before and after are strange too.
    """
    count = np.zeros(len(h.estimates), dtype=int)
    for s in h.measured.values():
        there = np.flatnonzero(np.isfinite(s.value) & np.isfinite(s.sd))
        if there.size > 2 * _BESIDE:
            y = s.value[there]
            around = np.lib.stride_tricks.sliding_window_view(np.pad(y, _BESIDE, mode="reflect"), 2 * _BESIDE + 1)
            left = np.abs(y - np.median(around, axis=1))
            count[s.estimate[there[left > _OFF * np.maximum(s.sd[there], 1.4826 * np.median(left))]]] += 1
    rigs = [e.rig_sha for e in h.estimates]
    odd = {k: 2 for k in range(1, len(rigs) - 1) if rigs[k] not in (rigs[k - 1], rigs[k + 1])}
    return odd | {int(k): int(count[k]) for k in np.flatnonzero(count > 1)}


def _fit(x: _Habits, k: int, host: _Habits, strange: int) -> float | None:
    """Return how far the numbers of an estimate lie from a host's, None where it does not belong there; `strange`: how
    many of them are strange where it stands.
    """
    e = x.h.estimates[k]
    place = int(np.searchsorted(host.t, e.taken_at))
    nearest = min((abs(e.taken_at - host.t[j]) for j in (place - 1, place) if 0 <= j < host.t.size), default=math.inf)
    like = x.t.size <= _FEW and _alike(x.h.bearing, host.h.bearing)
    if not _SLOT[0] <= nearest / host.usual_s <= (math.inf if like else _SLOT[1]):
        return None
    same_rig = e.rig_sha == host.h.estimates[min(place, host.t.size - 1)].rig_sha
    if not same_rig and strange < _SURE:
        return None
    far = host.distances(x.numbers.get(k, {}), e.taken_at)
    if not far and like and same_rig:  # nothing usable in it
        return -math.inf
    if max(far, default=math.inf) > _FAR or (not like and sum(z < _NEAR for z in far) < _ENOUGH):
        return None
    return -math.inf if like else max(far)


def _alike(a: str, b: str) -> bool:
    """Whether two names differ by one slip, and not in a number: in a letter, two that changed places, or blanks."""
    if [c for c in a if c.isdigit()] != [c for c in b if c.isdigit()] or min(len(a), len(b)) < _FEW:
        return False
    a, b = ("".join(c for c in x.casefold() if c.isalnum()) for x in (a, b))
    while a and b and a[0] == b[0]:
        a, b = a[1:], b[1:]
    while a and b and a[-1] == b[-1]:
        a, b = a[:-1], b[:-1]
    return max(len(a), len(b)) <= 1 or (len(a) == 2 and a == b[::-1])
