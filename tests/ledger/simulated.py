"""Bearings over three years with faults that are known, and what alarms make of them.

Coils warm, magnets age or crack, position sensors and controllers are exchanged; a tenth of the estimates is unusable,
one in a hundred usable ones is five standard deviations off, and resistances follow the seasons.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.ledger import History, Series, watch
from ambid.ledger.alarm import KINDS
from ambid.ledger.entry import Note
from ambid.ledger.history import KnownEstimate
from ambid.ledger.trends import MONTH_S

BEGIN, YEARS, EVERY_S = 1767225600.0, 3.0, 3 * 86400.0
SD = {"m": 0.002, "k_x": 0.005, "k_i": 0.003, "R": 0.001, "L": 0.003}
VALUE = {"m": 0.3, "k_x": -6700.0, "k_i": 20.0, "R": 6.0, "L": 0.08}
FAULTS = {  # powers of what changes, cause in the alarm
    "hot coil": ({"R": 1}, "the coil warms or corrodes"),
    "ageing magnet": ({"k_x": 2, "k_i": 1}, "the magnet ages: bias flux"),
    "cracked magnet": ({"k_x": 2, "k_i": 1}, "the magnet's bias flux stepped: cracked or demagnetised"),
    "exchanged sensor": (
        {"m": -2, "k_x": -2, "k_i": -1},
        "the position sensor's gain stepped: exchanged or damaged",
    ),
    "new controller": ({}, ""),
    "": ({}, ""),
}
SHARES = (("hot coil", 0.04), ("ageing magnet", 0.04), ("cracked magnet", 0.02), ("exchanged sensor", 0.02),
          ("new controller", 0.02))  # fmt: skip


@dataclass(frozen=True)
class Bearing:
    """A bearing as it is, and as its estimates show it."""

    fault: str
    truth: dict[str, np.ndarray]  # by parameter, at the records
    history: History


def bearing(name: str, fault: str, rng: np.random.Generator, every_s: float = EVERY_S) -> Bearing:
    t = BEGIN + np.arange(0.0, YEARS * 12 * MONTH_S, every_s)
    n, at = t.size, BEGIN + rng.uniform(0.25, 0.7) * YEARS * 12 * MONTH_S
    if fault in ("hot coil", "ageing magnet"):
        sign, rate = (1, rng.uniform(0.008, 0.02)) if fault == "hot coil" else (-1, rng.uniform(0.006, 0.015))
        factor = 1.0 + sign * rate * np.maximum(t - at, 0.0) / MONTH_S
    else:
        size = {"cracked magnet": -rng.uniform(0.07, 0.15), "exchanged sensor": rng.uniform(0.07, 0.15)}.get(fault, 0.0)
        factor = 1.0 + size * (t >= at)
    usable = rng.random(n) > 0.1
    good, scatter = rng.uniform(0.5, 2.0), rng.uniform(1.0, 2.0)
    season = 0.02 * np.sin(2 * np.pi * (t - BEGIN) / (12 * MONTH_S) + rng.uniform(0, 2 * np.pi))
    series, truths = {}, {}
    for parameter, share in SD.items():
        truth = VALUE[parameter] * factor ** FAULTS[fault][0].get(parameter, 0)
        truth = truth * (1.0 + season if parameter == "R" else 1.0)
        truths[parameter] = truth
        sd = np.abs(VALUE[parameter]) * share * good * rng.uniform(0.7, 1.4, n)
        value = truth + scatter * sd * rng.standard_normal(n) + 5.0 * sd * (rng.random(n) < 0.01)
        seen = rng.random(n) > (0.05 if parameter == "k_x" else 0.0)
        value = np.where(seen & usable, value, np.nan)  # as a history reads the nonsense of unusable estimates
        series[parameter] = Series(
            name=parameter, unit="", taken_at=t, value=value, sd=np.where(np.isfinite(value), sd, np.nan),
            identifiable=seen, estimate=np.arange(n), role="free",
        )  # fmt: skip
    estimates = tuple(
        KnownEstimate(x, "", "", "", "identify", "one-axis", "0", "converged", "usable" if u else "unusable", "")
        for x, u in zip(t, usable, strict=True)
    )
    note = Note(at=float(t[np.searchsorted(t, at)]), kind="rig", text="controller.version 1 became 2", parameter="")
    events = (note,) if fault in ("new controller", "exchanged sensor") else ()
    history = History(bearing=name, plant="", ledger="", estimates=estimates, series=series, events=events)
    return Bearing(fault, truths, history)


def wandering(name: str, t: np.ndarray, rng: np.random.Generator) -> History:
    """Return a sound bearing: noise, of half of them wander that follows itself by 0.9, seasons of R, outliers,
    estimates that are not usable, or with caution; numbers of its own.
    """
    n, wander = t.size, float(rng.random() < 0.5)
    usable = rng.random(n) > rng.choice([0.0, 0.02, 0.1])
    season = 0.02 * np.sin(2 * np.pi * (t - BEGIN) / (12 * MONTH_S) + rng.uniform(0, 2 * np.pi))
    series = {}
    for parameter, share in SD.items():
        sd = share * rng.uniform(0.5, 2.0) * rng.uniform(0.7, 1.4, n)
        e, slow = rng.standard_normal(n), rng.standard_normal(n)
        slow[1:] *= np.sqrt(1.0 - 0.9**2)
        for k in range(1, n):
            slow[k] += 0.9 * slow[k - 1]
        relative = rng.uniform(1.0, 2.0) * sd * e + wander * share * slow + 5.0 * sd * (rng.random(n) < 0.01)
        level = VALUE[parameter] * (1.0 + 0.05 * rng.standard_normal())
        truth = level * (1.0 + season if parameter == "R" else np.ones(n))
        value = np.where(usable & (rng.random(n) > 0.05 * (parameter == "k_x")), truth * (1.0 + relative), np.nan)
        series[parameter] = Series(
            name=parameter, unit="", taken_at=t, value=value, sd=abs(level) * np.where(np.isfinite(value), sd, np.nan),
            identifiable=np.isfinite(value) | ~usable, estimate=np.arange(n), role="free",
        )  # fmt: skip
    words = np.where(usable, np.where(rng.random(n) < 0.05, "caution", "usable"), "unusable")
    estimates = tuple(
        KnownEstimate(float(x), f"{k}.h5", f"{name} {k}", name, "identify", "one-axis", "1", "converged", str(w), "")
        for k, (x, w) in enumerate(zip(t, words, strict=True))
    )
    return History(bearing=name, plant=name, ledger="", estimates=estimates, series=series)


@dataclass
class Score:
    """What became of a fleet."""

    due: int = 0
    found: int = 0
    false: int = 0
    cause: int = 0
    dated: int = 0
    wrong: tuple[str, ...] = ()


def judge(fleet: list[Bearing]) -> Score:
    end = max(b.history.estimates[-1].taken_at for b in fleet)
    score, watched = Score(), watch((b.history for b in fleet), now=end)
    records = [a for a in watched.alarms if a.kind in KINDS]  # nothing is wrong with them
    score.false, score.wrong = len(records), tuple(f"false: {a}" for a in records)
    for b in fleet:
        _, cause = FAULTS[b.fault]
        t = b.history.estimates
        for parameter in SD:
            change = b.truth[parameter] / np.median(b.truth[parameter][:5]) - 1.0
            for rule in (r for r in watched.rules if r.parameter == parameter):
                reach = change / rule.change  # 1: at the limit
                alarms = [
                    a for a in watched.alarms
                    if (a.bearing, a.parameter, a.rule) == (b.history.bearing, parameter, str(rule))
                ]  # fmt: skip
                if reach.max() < 0.9:
                    score.false += len(alarms)
                    score.wrong += tuple(f"false: {b.fault} {a}" for a in alarms)
                elif np.sum(reach > 1.15) > 20:
                    score.due += 1
                    if not alarms:
                        score.wrong += (f"missed: {b.fault} {b.history.bearing} {rule}",)
                        continue
                    score.found += 1
                    score.false += len(alarms) - 1
                    divided = int(np.argmin(np.cumsum(np.where(reach >= 1.0, 1, -1)))) + 1
                    first, crossed = alarms[0], t[divided].taken_at
                    right = cause in first.cause and "not clear" not in first.cause
                    dated = first.at_from <= crossed <= first.at_to
                    score.cause, score.dated = score.cause + right, score.dated + dated
                    if not (right and dated):
                        off = (first.at - crossed) / 86400
                        wide = (first.at_to - first.at_from) / 86400
                        score.wrong += (
                            f"{b.fault} {rule}: {first.kind}, {off:.0f} days off of {wide:.0f}; {first.cause}",
                        )
    return score


def fleet(n: int, seed: int) -> list[Bearing]:
    rng = np.random.default_rng(seed)
    faults = [fault for fault, share in SHARES for _ in range(max(1, round(share * n)))]
    return [bearing(f"B{k}", fault, rng) for k, fault in enumerate(faults + [""] * (n - len(faults)))]
