"""Histories with a fault of their records each, and sound ones, on which no alarm may be raised. Bearings are those of
`wandering`; times of records are regular, of working days, irregular, or in bursts.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ambid.ledger import History, watch
from ambid.ledger.alarm import Alarm
from ambid.ledger.history import Series
from ambid.ledger.store import Failure
from tests.ledger.simulated import BEGIN, VALUE, YEARS, wandering

DAY = 86400.0
HABITS = ("daily", "working days", "every third day", "weekly", "monthly", "irregular", "in bursts")
MISSING = 0.01  # of the records
SHUT = 14  # days of a shutdown in each year


def times(habit: str, rng: np.random.Generator, shut: bool = True) -> np.ndarray:
    """Return days of records over three years."""
    days = 365.25 * YEARS
    match habit:
        case "irregular":
            t = np.cumsum(rng.exponential(3.0, round(days / 2.0)))
        case "in bursts":
            t = (np.arange(0.0, days, 14.0)[:, None] + np.sort(rng.uniform(0.0, 0.5, 4))).ravel()
        case "working days":
            t = np.arange(days)
            t = t[(t % 7 < 5) & (rng.random(t.size) > MISSING)]
            t = t[(t % 91 < 56) | (t % 91 > 58)]  # long weekends, of five days
        case _:
            every = {"daily": 1.0, "every third day": 3.0, "weekly": 7.0, "monthly": 30.4}[habit]
            t = np.arange(0.0, days, every)
            t = (t + every * rng.uniform(-0.1, 0.1, t.size))[rng.random(t.size) > MISSING]
    if shut:
        t = t[abs(t % 365.25 - 200.0) > 0.5 * SHUT]
    return t[t <= days]


def sound(name: str, habit: str, rng: np.random.Generator, shut: bool = True) -> History:
    return wandering(name, BEGIN + DAY * times(habit, rng, shut), rng)


def part(h: History, keep: np.ndarray, at: np.ndarray | None = None) -> History:
    """Return a history of the estimates that are kept, taken `at` other times."""
    at = np.array([e.taken_at for e in h.estimates]) if at is None else at
    order = np.flatnonzero(keep)[np.argsort(at[keep], kind="stable")]
    estimates = []
    for k in order:
        e = h.estimates[k]
        estimates.append(
            type(e)(at[k], e.record, e.sha, e.rig_sha, e.job, e.model, e.version, e.status, e.verdict, e.failed)
        )
    series = {
        n: replace(s, taken_at=at[order], value=s.value[order], sd=s.sd[order], identifiable=s.identifiable[order],
                   estimate=np.arange(order.size))
        for n, s in h.series.items()
    }  # fmt: skip
    return replace(h, estimates=tuple(estimates), series=series)


def joined(a: History, b: History) -> History:
    """Return the estimates of both under the name of the first."""
    at = np.array([e.taken_at for e in (*a.estimates, *b.estimates)])
    both = {
        n: Series(name=n, unit=s.unit, role=s.role, estimate=np.arange(at.size), **{
            x: np.concatenate([getattr(s, x), getattr(b.series[n], x)])
            for x in ("taken_at", "value", "sd", "identifiable")
        })
        for n, s in a.series.items()
    }  # fmt: skip
    return part(replace(a, estimates=(*a.estimates, *b.estimates), series=both), np.ones(at.size, dtype=bool))


def ill(fault: str, name: str, rng: np.random.Generator) -> tuple[list[History], list[Failure], str, str]:
    """Return histories with a fault, what failed, and kind and bearing of the alarm that is due."""
    habit = str(rng.choice(HABITS[:5]))
    h = sound(name, habit, rng, shut=False)
    n, usual = len(h.estimates), float(np.median(np.diff([e.taken_at for e in h.estimates])))
    k, keep, t = int(rng.integers(n // 3, 2 * n // 3)), np.ones(n, dtype=bool), np.array(
        [e.taken_at for e in h.estimates])  # fmt: skip
    end = t[-1]
    match fault:
        case "gap":
            keep = (t < t[k]) | (t > t[k] + max(270 * DAY, 10 * usual) * rng.uniform(0.3, 1.0))
            return [part(h, keep)], [], "stale", name
        case "late":
            return [part(h, t < end - max(365 * DAY, 12 * usual) * rng.uniform(0.4, 1.0))], [], "stale", name
        case "unusable":
            since = end - max(270 * DAY, 9 * usual)
            bad = t > since
            estimates = tuple(
                e if not b else type(e)(e.taken_at, e.record, e.sha, e.rig_sha, e.job, e.model, e.version, "converged",
                                        "unusable", "plausible")
                for e, b in zip(h.estimates, bad, strict=True)
            )  # fmt: skip
            series = {x: replace(s, value=np.where(bad, np.nan, s.value)) for x, s in h.series.items()}
            return [replace(h, estimates=estimates, series=series)], [], "unusable", name
        case "failed":
            lost = np.arange(n - max(6, round(20 * DAY / usual)), n)
            failures = [
                Failure(bearing=name, record=f"{j}.h5", sha=f"f{name}{j}", rig_sha="", settings="{}", version="1",
                        reason="the record has a gap", failed_at=t[j] + 3600.0) for j in lost
            ]  # fmt: skip
            keep[lost] = False
            return [part(h, keep)], failures, "failed", name
        case "wrong-named":
            other = keep.copy()
            other[:], other[k], keep[k] = False, True, False
            slip = name[0] + name[2] + name[1] + name[3:]
            return [part(h, keep), replace(part(h, other), bearing=slip)], [], "name", slip
        case "stored under another":
            host = sound(f"{name} host", "daily", rng, shut=False)
            scale = {x: 1.0 + 0.05 * rng.standard_normal() for x in VALUE}
            series = {x: replace(s, value=scale[x] * s.value) for x, s in host.series.items()}
            host = replace(host, series=series)
            other = np.zeros(len(host.estimates), dtype=bool)
            usable = [j for j, e in enumerate(host.estimates) if e.verdict == "usable"]
            other[usable[len(usable) // 2]] = True
            return [joined(h, part(host, other)), part(host, ~other)], [], "name", name
        case "doubled":
            other = np.zeros(n, dtype=bool)
            other[next(j for j in range(k, n) if h.estimates[j].verdict == "usable")] = True
            moved = t + float(rng.choice([0.0, 0.4 * usual]))
            copy = part(h, other, moved)
            e = copy.estimates[0]
            e = type(e)(e.taken_at, "copy.h5", f"{e.sha}copy", e.rig_sha, e.job, e.model, e.version, e.status,
                        e.verdict, e.failed)  # fmt: skip
            return [joined(h, replace(copy, estimates=(e,)))], [], "double", name
    at = t.copy()
    at[k] = BEGIN + 36 * 365.25 * DAY
    return [part(h, keep, at)], [], "date", name


FAULTS = ("gap", "late", "unusable", "failed", "wrong-named", "stored under another", "doubled", "wrong date")


def quiet_alarms(n: int, seed: int) -> tuple[Alarm, ...]:
    """Return the alarms of a sound fleet."""
    rng = np.random.default_rng(seed)
    fleet = [sound(f"pump {k}", HABITS[k % len(HABITS)], rng) for k in range(n)]
    return watch(fleet, now=BEGIN + (365.25 * YEARS + 0.2) * DAY).alarms
