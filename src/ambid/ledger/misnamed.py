"""Records that stand under a slip of another bearing's name, which lacks one then and whose numbers are as near."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from ambid.ledger.alarm import Alarm
from ambid.ledger.entry import day
from ambid.ledger.history import History
from ambid.ledger.missing import Numbers, alarm_of, numbers_of, pauses, plausible
from ambid.ledger.rules import RecordRule

_FEW = 3  # estimates of a bearing that may be a slip of the pen
_MANY = 6  # of one whose habits are known
_SLOT = 0.5  # usual times from the nearest record, from which one is due
_BESIDE = 5  # values before and after, from which a level is taken
_FAR = 8.0  # standard deviations within which numbers agree


def misnamed(histories: Sequence[History], now: float) -> Iterator[Alarm]:
    """Yield records whose bearing's name is one slip away from that of another one, to which they seem to belong."""
    hosts = [h for h in histories if len(h.estimates) >= _MANY]
    for h in histories:
        alike = [x for x in hosts if _alike(h.bearing, x.bearing)] if len(h.estimates) <= _FEW else []
        numbers = numbers_of(h) if alike else {}
        for k, e in enumerate(h.estimates) if alike else ():
            own = numbers.get(k, {})
            host = next((x for x in alike if plausible(e, now) and _lacks(x, e.taken_at, e.rig_sha, own)), None)
            if host is not None:
                text = (
                    f"{e.record or 'the record'} of {day(e.taken_at)} seems to be of {host.bearing!r}: it has none "
                    "then, and the numbers are its"
                )
                yield alarm_of(h.bearing, "name", e.taken_at, e.taken_at, text)


def _lacks(host: History, at: float, rig_sha: str, own: Numbers) -> bool:
    """Whether a record of that time would fill a gap of a host: its numbers agree, or it has none, and the rig does."""
    t = np.array([e.taken_at for e in host.estimates])
    usual = pauses(t, RecordRule()).usual_s
    place = int(np.searchsorted(t, at))
    around = range(max(0, place - _BESIDE), min(t.size, place + _BESIDE))
    if usual is None or np.min(np.abs(t - at)) < _SLOT * usual:
        return False
    alike = host.estimates[min(place, t.size - 1)].rig_sha == rig_sha
    there = numbers_of(host)
    for name, (value, sd) in own.items():
        near = [there[k][name] for k in around if name in there.get(k, {})]
        if len(near) >= _FEW:
            level = float(np.median([y for y, _ in near]))
            spread = 1.4826 * float(np.median([abs(y - level) for y, _ in near]))
            if abs(value - level) > _FAR * max(math.hypot(sd, float(np.median([s for _, s in near]))), spread):
                return False
            alike = True
    return alike


def _alike(a: str, b: str) -> bool:
    """Whether two names differ by one slip, and not in a number: in a letter, two that changed places, or blanks."""
    if a == b or [c for c in a if c.isdigit()] != [c for c in b if c.isdigit()] or min(len(a), len(b)) < _FEW:
        return False
    a, b = ("".join(c for c in x.casefold() if c.isalnum()) for x in (a, b))
    while a and b and a[0] == b[0]:
        a, b = a[1:], b[1:]
    while a and b and a[-1] == b[-1]:
        a, b = a[:-1], b[:-1]
    return max(len(a), len(b)) <= 1 or (len(a) == 2 and a == b[::-1])
