"""Progress of a search: the name of its present stage, and how much of the whole is over, for whoever wants to know."""

from __future__ import annotations

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
