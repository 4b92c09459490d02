"""Recursive regressions through an hour without excitation: do their covariances wind up, does anything run away?"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ambid.recursive.estimator import RecursiveEstimator
from ambid.recursive.polynomial import RecursivePolynomial
from ambid.recursive.regression import RecursiveLeastSquares
from table import Table
from tracking_benches import RATE, Array, TrackBench, preset_bench
from tracking_quiet import HOURS, smallest_eigenvalue

MEMORY = RATE  # samples: a second
ORDERS = {"na": 2, "nb": 2, "nc": 2, "nk": 2}
GROUP = "Tracking: regressions through an hour without excitation"
COLUMNS = (
    "estimator", "signals", "samples", "covariance definite", "largest sd", "smallest sd", "largest move", "samples/s",
)  # fmt: skip
SIGNALS = ("a quiet rotor", "zero")


@dataclass(slots=True, kw_only=True)
class Rested:
    """What an hour did to one estimator."""

    samples: int = 0
    looks: int = 0
    definite: int = 0
    growth: float = 0.0
    shrinking: float = np.inf
    moved_sd: float = 0.0
    seconds: float = 0.0


def estimators() -> dict[str, Callable[[], RecursiveEstimator]]:
    """Each with a memory of a second; they model the current from voltage and current before."""
    return {
        "RLS(4), exponential forgetting": lambda: RecursiveLeastSquares(4, memory=MEMORY),
        "recursive ARMAX": lambda: RecursivePolynomial("armax", ORDERS, forgetting=1.0 - 1.0 / MEMORY),
    }


def rest_tables() -> Iterator[Table]:
    """One table: each estimator is excited for two seconds, then left alone."""
    bench, rows, data = preset_bench(), [], {}
    for name, make in estimators().items():
        for signals in SIGNALS:
            found = _rested(bench, make(), signals)
            rows.append(_row(name, signals, found))
            print("; ".join(rows[-1]), flush=True)
            data[f"{name}; {signals}"] = asdict(found)
    before = (
        f"Two seconds of the excited unstable bearing, then {HOURS:g} h of a quiet one or of zeros, looked at once a"
        " second: sd and moves in units of the sd at the end of excitation. The regression is of the current on current"
        " and voltage before. A quiet rotor under feedback informs it little, and differently, so that forgetting alone"
        " would let its covariance grow without end; the bias under feedback is part of the move."
    )
    yield Table(group=GROUP, columns=COLUMNS, rows=tuple(rows), before=before, data=data)


def _rested(bench: TrackBench, made: RecursiveEstimator, signals: str) -> Rested:
    feed, found = _feed(made), Rested()
    for _, part in bench.stream("steady", 1, 2.0, 0.0):
        feed(part.u[:, 0], part.y[:, 1])
    sd, start = np.sqrt(np.diag(made.covariance)), made.estimate
    for _, part in bench.stream("quiet", 2, HOURS * 3600, 0.0):
        u, y = part.u[:, 0], part.y[:, 1]
        if signals == "zero":
            u, y = np.zeros_like(u), np.zeros_like(y)
        before = time.process_time()
        feed(u, y)
        found.seconds += time.process_time() - before
        found.samples += y.size
        found.looks += 1
        covariance = made.covariance
        now = np.sqrt(np.diag(covariance))
        found.definite += smallest_eigenvalue(covariance) > 0.0
        found.growth = max(found.growth, float(np.max(now / sd)))
        found.shrinking = min(found.shrinking, float(np.min(now / sd)))
        found.moved_sd = max(found.moved_sd, float(np.max(np.abs(made.estimate - start) / sd)))
    return found


def _feed(made: Any) -> Callable[[Array, Array], object]:
    """A polynomial takes signals; a regression takes regressors, made here: two of the current, two of the voltage."""
    if not isinstance(made, RecursiveLeastSquares):
        return lambda u, y: made.update(u, y)
    last: list[Array] = [np.zeros(3), np.zeros(3)]

    def feed(u: Array, y: Array) -> object:
        u, y = np.concatenate([last[0], u]), np.concatenate([last[1], y])
        last[:] = [u[-3:], y[-3:]]
        return made.update(np.column_stack([y[2:-1], y[1:-2], u[1:-2], u[:-3]]), y[3:])

    return feed


def _row(name: str, signals: str, found: Rested) -> tuple[str, ...]:
    return (
        name,
        signals,
        f"{found.samples:.3g}",
        f"{found.definite} of {found.looks}",
        f"{found.growth:.3g}",
        f"{found.shrinking:.2g}",
        f"{found.moved_sd:.3g}",
        f"{found.samples / found.seconds / 1e6:.3g} million",
    )
