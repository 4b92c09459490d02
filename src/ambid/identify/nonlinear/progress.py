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

        Parameters
        ----------
        stage : str
            What is done now, in words for the user.
        done : float or None, optional
            Share of the whole search (not of the stage) that is over, 0 to 1; None where nothing is known of it. It
            never falls. Where iterations may end early it is the share of those allowed, or a better guess.
        """


def silent(stage: str, done: float | None = None, /) -> None:
    """Report no progress.

    Parameters
    ----------
    stage : str
        Not used.
    done : float or None, optional
        Not used.
    """
    del stage, done


def part_of(tick: Tick | None, begin: float, end: float) -> Tick | None:
    """Return a tick for a part of a search, which counts its own share from 0 to 1.

    Parameters
    ----------
    tick : Tick or None
        Of the whole.
    begin, end : float
        Shares of the whole that are over where the part begins and ends.

    Returns
    -------
    Tick or None
        None where there is none for the whole.
    """
    if tick is None:
        return None

    def of_part(stage: str, done: float | None = None, /) -> None:
        tick(stage, None if done is None else begin + (end - begin) * min(max(done, 0.0), 1.0))

    return of_part


def guessed(steps: int, usual: float) -> float:
    """Guess which share of a loop is over that ends when nothing is gained any more.

    Parameters
    ----------
    steps : int
        Done so far.
    usual : float
        Such a loop takes about twice as many.

    Returns
    -------
    float
        0 at the begin, one half after the usual number, below 1 however long it takes.
    """
    return steps / (steps + usual)


def portions(tick: Tick | None, costs: Sequence[float]) -> list[Tick | None]:
    """Return a tick for each of several parts of a search that come one after the other.

    Parameters
    ----------
    tick : Tick or None
        Of the whole.
    costs : sequence of float
        What the parts are expected to take, in any unit; 0 for one that is left out.

    Returns
    -------
    list of Tick or None
        As `part_of` makes them.
    """
    whole, before, out = sum(costs) or 1.0, 0.0, list[Tick | None]()
    for cost in costs:
        out.append(part_of(tick, before / whole, (before + cost) / whole))
        before += cost
    return out
