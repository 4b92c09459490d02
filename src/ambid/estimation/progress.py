"""Progress of a search: the name of its present stage, and how much of the whole is over, for whoever wants to know."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol


class Tick(Protocol):
    """What is called now and then while something is worked through. It may raise KeyboardInterrupt: estimators of the
    nonlinear register then give the best model so far.
    """

    def __call__(self, stage: str, done: float | None = None, /) -> None:
        """Take note of the progress; `stage`: what is done now, in words for the user."""


def silent(stage: str, done: float | None = None, /) -> None:
    """Report no progress."""
    del stage, done


def part_of(tick: Tick | None, begin: float, end: float) -> Tick | None:
    """Return a tick, None without a whole, for the part of a search between two shares of the whole, which counts from
    0 to 1.
    """
    if tick is None:
        return None

    def of_part(stage: str, done: float | None = None, /) -> None:
        tick(stage, None if done is None else begin + (end - begin) * min(max(done, 0.0), 1.0))

    return of_part


def guessed(steps: int, usual: float) -> float:
    """Guess which share is over of a loop that ends when nothing is gained: 0 at the begin, one half after the `usual`
    number of steps, below 1 however long it takes.
    """
    return steps / (steps + usual)


def portions(tick: Tick | None, costs: Sequence[float]) -> list[Tick | None]:
    """Return a tick, as `part_of`, for each of several parts of a search that come one after the other."""
    whole, before, out = sum(costs) or 1.0, 0.0, list[Tick | None]()
    for cost in costs:
        out.append(part_of(tick, before / whole, (before + cost) / whole))
        before += cost
    return out
