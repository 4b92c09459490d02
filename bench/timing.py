"""Timing of two ways to do one job, side by side, and what one line of the table holds."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """Median and minimum of several repeats, in the unit of the line."""

    median: float
    minimum: float
    repeats: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Timing:
        return cls(median=statistics.median(values), minimum=min(values), repeats=len(values))


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """One line of the table: a job, what ambid takes for it, and what a straightforward implementation takes.

    `beside` says what that implementation is; `notes` are numbers that belong to the line but not into its columns.
    """

    group: str
    job: str
    unit: str
    ambid: Timing
    beside: str | None = None
    other: Timing | None = None
    notes: dict[str, object] = field(default_factory=dict)

    def ratios(self) -> dict[str, float] | None:
        if self.other is None:
            return None
        return {
            "of_medians": self.other.median / self.ambid.median,
            "of_minima": self.other.minimum / self.ambid.minimum,
        }

    def as_json(self) -> dict[str, object]:
        return {**asdict(self), "ratio": self.ratios()}

    @classmethod
    def from_json(cls, found: Mapping[str, Any]) -> Line:
        values = {k: v for k, v in found.items() if k != "ratio"}
        times = {k: Timing(**values[k]) for k in ("ambid", "other") if values[k] is not None}
        return cls(**{**values, **times})


def seconds(call: Callable[[], object]) -> float:
    before = time.perf_counter()
    call()
    return time.perf_counter() - before


def alternate(rounds: int, *jobs: tuple[Callable[[], object], int]) -> list[Timing]:
    """Time several jobs in turn, A B A B, each given with how often it runs in one round; all run once before.

    In turn, because a machine that gets slower or busier then does so for all of them.
    """
    for call, _ in jobs:
        call()
    taken: list[list[float]] = [[] for _ in jobs]
    for _ in range(rounds):
        for (call, times), values in zip(jobs, taken, strict=True):
            values.extend(seconds(call) for _ in range(times))
    return [Timing.of(values) for values in taken]


def quantity(value: float, unit: str) -> str:
    """Write a time or a size with three digits and a fitting prefix."""
    if unit == "B":
        return f"{value / 1e6:.0f} MB"
    for factor, name in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")):
        if value >= factor:
            return f"{value / factor:.3g} {name}"
    return f"{value / 1e-9:.3g} ns"


def shown(timing: Timing, unit: str) -> str:
    """Write the median, and the minimum where there are repeats."""
    middle = quantity(timing.median, unit)
    return middle if timing.repeats == 1 else f"{middle} ({quantity(timing.minimum, unit)})"
