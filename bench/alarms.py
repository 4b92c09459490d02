"""Alarms about records: histories with a fault each, and sound ones, on which none may be raised.

``PYTHONPATH=. python bench/alarms.py [faults|sound|all] [BEARINGS] [SEED...]``; what is simulated stands in
tests/ledger/faults.py. Figures are printed; none is asserted.
"""

from __future__ import annotations

import sys
import time
from collections import Counter

import numpy as np

from ambid.ledger import watch
from ambid.ledger.alarm import Alarm
from tests.ledger.faults import DAY, FAULTS, HABITS, ill, sound
from tests.ledger.simulated import BEGIN, YEARS


def faults(n: int, seed: int) -> None:
    now = BEGIN + 365.25 * YEARS * DAY
    for fault in FAULTS:
        found, others = 0, Counter[str]()
        for k in range(n):
            histories, failures, kind, name = ill(fault, f"pump {k:02d}", np.random.default_rng([seed, k]))
            alarms = watch(histories, failures=failures, now=now).alarms
            hit = [a for a in alarms if (a.kind, a.bearing) == (kind, name)]
            found += bool(hit)
            others.update(line(a) for a in alarms if a.kind != kind and a.bearing == f"pump {k:02d}")
        print(f"seed {seed}, {fault}: {found} of {n} told; other alarms beside: {dict(others)}", flush=True)


def quiet(n: int, seed: int) -> None:
    rng, begin = np.random.default_rng(seed), time.perf_counter()
    habits = [HABITS[k % len(HABITS)] for k in range(n)]
    fleet = [sound(f"pump {k}", habit, rng) for k, habit in enumerate(habits)]
    made = time.perf_counter()
    watched = watch(fleet, now=BEGIN + (365.25 * YEARS + 0.2) * DAY)
    of = {h.bearing: habit for h, habit in zip(fleet, habits, strict=True)}
    trends = Counter((t.parameter, t.kind) for t in watched.trends if t.kind != "none")
    print(
        f"seed {seed}: {len(watched.alarms)} false alarms in {n * YEARS:.0f} bearing-years; {sum(trends.values())} of "
        f"{len(watched.trends)} parameters with a trend {dict(trends)}; "
        f"{1e3 * (time.perf_counter() - made) / n:.0f} ms a bearing (made in {made - begin:.0f} s)", flush=True,
    )  # fmt: skip
    for a in watched.alarms:
        print("   ", of.get(a.bearing), line(a), flush=True)


def line(a: Alarm) -> str:
    return f"{a.bearing} {a.parameter} {a.rule}: {a.cause}"


def main(what: str, n: int, seeds: list[int]) -> None:
    for seed in seeds:
        if what in ("faults", "all"):
            faults(n or 40, seed)
        if what in ("sound", "all"):
            quiet(n or 1000, seed)


if __name__ == "__main__":
    words = sys.argv[1:]
    main(words[0] if words else "all", int(words[1]) if words[1:] else 0, [int(x) for x in words[2:]] or [11])
