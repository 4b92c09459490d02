"""Progress of a search: the name of its present stage, and how much of the whole is over, for whoever wants to know."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol


class Tick(Protocol):
    """What is called now and then while something is searched or worked through.

    It may raise KeyboardInterrupt: estimators of the nonlinear register then give the best model so far.
    """

    def __call__(self, stage: str, done: float | None = None, /) -> None:
        """Take note of the progress.

        `stage`: what is done now, in words for the user.
        """


def silent(stage: str, done: float | None = None, /) -> None:
    """Report no progress.

    `stage`: not used; `done`: not used.
    """
    del stage, done


def part_of(tick: Tick | None, begin: float, end: float) -> Tick | None:
    """Return a tick for a part of a search, which counts its own share from 0 to 1.

    `tick`: of the whole; `begin`, `end`: shares of the whole that are over where the part begins and ends. Returns none
    where there is none for the whole.
    """
    if tick is None:
        return None

    def of_part(stage: str, done: float | None = None, /) -> None:
        tick(stage, None if done is None else begin + (end - begin) * min(max(done, 0.0), 1.0))

    return of_part


def guessed(steps: int, usual: float) -> float:
    """Guess which share of a loop is over that ends when nothing is gained any more.

    `steps`: done so far; `usual`: such a loop takes about twice as many. Returns 0 at the begin, one half after the
    usual number, below 1 however long it takes.
    """
    return steps / (steps + usual)


def portions(tick: Tick | None, costs: Sequence[float]) -> list[Tick | None]:
    """Return a tick for each of several parts of a search that come one after the other.

    `tick`: of the whole. Returns as `part_of` makes them.
    """
    whole, before, out = sum(costs) or 1.0, 0.0, list[Tick | None]()
    for cost in costs:
        out.append(part_of(tick, before / whole, (before + cost) / whole))
        before += cost
    return out
