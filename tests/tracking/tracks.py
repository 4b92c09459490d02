"""Synthetic tracks with known truth: a change of k_i with its decisions, a stretch without excitation, a gap."""

from __future__ import annotations

import numpy as np

from ambid.recursive.lines import Event, Latency, Track, TrackedValue, TrackHeader, TrackLine, TrackSummary
from ambid.tracking.lines_file import Tally

UNITS = {"m": "kg", "k_x": "N/m", "k_i": "N/A", "R": "ohm", "L": "H"}
VALUES = {"m": 4.0, "k_x": -129.01e3, "k_i": 55.734, "R": 1.6, "L": 26.0769e-3}
RELATIVE_SD = {"m": 0.004, "k_x": 0.01, "k_i": 0.004, "R": 0.003, "L": 0.002}


def header(*, every_s: float = 0.01, limit: float = 1.5, names: tuple[str, ...] = tuple(UNITS)) -> TrackHeader:
    return TrackHeader(
        rate_hz=20_000.0,
        limit=limit,
        method="rpem",
        model="one-axis",
        units={n: UNITS[n] for n in names},
        every_s=every_s,
        start={n: TrackedValue(value=VALUES[n], sd=abs(VALUES[n]) * RELATIVE_SD[n]) for n in names},
        record={"file": "loop.csv", "sha256": "0" * 64, "samples": 1_200_000},
    )


def truth_at(name: str, t: float, change_s: float = 20.0, seconds: float = 60.0) -> float:
    """R drifts up by 20 %, k_i falls by 15 % at the change."""
    if name == "R":
        return VALUES[name] * (1 + 0.2 * t / seconds)
    return VALUES[name] * (0.85 if name == "k_i" and t >= change_s else 1.0)


def track_of(
    *, seconds: float = 60.0, every_s: float = 0.1, seed: int = 1, names: tuple[str, ...] = tuple(UNITS)
) -> Track:
    """Follow the truth with a lag of two intervals; k_i changes at a third, stale from 60 to 75 %, a gap at 80 %."""
    head = header(every_s=every_s, names=names)
    rng = np.random.default_rng(seed)
    n = round(seconds / every_s)
    change_s = seconds / 3
    events = {
        round(change_s / every_s) + 1: (_change(change_s),),
        round(change_s / every_s) + 3: (_accepted(change_s + 3 * every_s),),
        round(0.6 * n): (Event(kind="frozen", t=0.6 * seconds, why="no information in the last 0.5 s"),),
        round(0.75 * n): (Event(kind="thawed", t=0.75 * seconds, why="information is back"),),
        round(0.8 * n): (Event(kind="rejected", t=0.8 * seconds, why="14 samples are missing", samples=14),),
    }
    tally, lines = Tally(head), []
    noise = {name: _smooth(rng, n) for name in names}
    for k in range(1, n + 1):
        t = k * every_s
        stale = 0.6 * n <= k < 0.75 * n
        changed = 0 <= t - change_s < 3 * every_s
        parameters = {}
        for name in names:
            sd = abs(VALUES[name]) * RELATIVE_SD[name]
            follow = truth_at(name, max(t - 2 * every_s, 0.0), change_s + every_s, seconds)
            old = lines[-1].parameters[name].value if stale and lines else follow + 0.7 * sd * noise[name][k - 1]
            parameters[name] = TrackedValue(value=float(old), sd=sd, stale=stale)
        line = TrackLine(
            t=t,
            parameters=parameters,
            error=float(1 + 0.03 * rng.standard_normal() + (1.6 if changed else 0.0)),
            state="frozen" if stale else "changed" if changed else "tracking",
            events=events.get(k, ()),
        )
        lines.append(line)
        tally.add(line)
    found = tally.summary(computing_s=seconds / 50)
    summary = TrackSummary(
        samples=found.samples, seconds_of_record=found.seconds_of_record, computing_s=found.computing_s,
        updates=found.updates, rejected_samples=found.rejected_samples, changes=found.changes, counts=found.counts,
        latency=Latency(median=4.1e-4, p99=9e-4, largest=2.1e-3, overruns=0, late=3),
    )  # fmt: skip
    return Track(header=head, lines=tuple(lines), totals=summary)


def truth_of(seconds: float = 60.0, rate_hz: float = 100.0) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    return {name: (t, np.array([truth_at(name, x, seconds / 3, seconds) for x in t])) for name in UNITS}


def _change(t: float) -> Event:
    return Event(
        kind="change",
        t=t,
        why="k_i fell by 15 % (36 sd) from here on; no other parameter explains it",
        parameter="k_i",
        values={"from": 55.73, "to": 47.4, "sd": 0.23},
    )


def _accepted(t: float) -> Event:
    return Event(kind="accepted", t=t, why="predicts the next 0.1 s better: error 1.01 instead of 2.6", parameter="k_i")


def _smooth(rng: np.random.Generator, n: int) -> np.ndarray:
    e = rng.standard_normal(n)
    out = np.empty(n)
    state = rng.standard_normal()
    for k in range(n):
        state = 0.98 * state + 0.2 * e[k]
        out[k] = state
    return out
