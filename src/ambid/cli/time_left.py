"""How long a job will still take, from the share of it that is over."""

from __future__ import annotations

from math import exp
from typing import NamedTuple

_MEMORY = 0.3  # of the time so far: what came before counts little in the pace
_SETTLES_S = 1.5  # in which what is shown follows what is expected
_LEAST_S = 0.3  # of work before anything is said
_HELD = 0.5  # of what was expected at the last word is left while no other comes


class _Word(NamedTuple):
    """The last that was said: when, and how long the rest takes at the pace until then."""

    at: float
    rest: float

    def expected(self, now: float) -> float:
        return max(self.rest - (now - self.at), _HELD * self.rest)


class TimeLeft:
    """Time left of a job, told from shares that come in unevenly and at a pace that changes.

    The pace is that of the recent past, which grows with the time taken: a job's stages differ, and the last one says
    more of the next than the first. Between two words time runs down, at most to half of what was expected; when a word
    changes what is expected, what is shown follows in a second or two instead of jumping.
    """

    def __init__(self, now: float) -> None:
        """Begin.

        `now`: on any clock that runs evenly.
        """
        self._begin = now
        self._last: tuple[float, float] | None = None  # when, share
        self._time = self._gain = 0.0
        self._word: _Word | None = None
        self._shown: tuple[float, _Word, float] | None = None  # when, by which word, how far from what it says

    @property
    def share(self) -> float | None:
        """Share that is over, 0 to 1; None before the first word."""
        return None if self._last is None else self._last[1]

    def take(self, share: float, now: float) -> None:
        """Take a word on how much is over.

        `share`: 0 to 1; one below an earlier one changes nothing.
        """
        share = min(max(share, 0.0), 1.0)
        if self._last is None:
            self._last = now, share
            return
        since, before = now - self._last[0], self._last[1]
        if share <= before or since <= 0:
            return  # time runs on until something has been done in it
        memory = exp(-since / max(_MEMORY * (now - self._begin), 1e-9))
        self._time, self._gain = memory * self._time + since, memory * self._gain + share - before
        self._last = now, share
        self._word = _Word(at=now, rest=(1.0 - share) * self._time / self._gain)

    def left(self, now: float) -> float | None:
        """Return how long it still takes.

        Returns none as long as too little has been done to tell.
        """
        word = self._word
        if word is None or now - self._begin < _LEAST_S:
            return None
        expected, apart = word.expected(now), 0.0
        if self._shown is not None:
            at, before, was = self._shown
            apart = was * exp(-(now - at) / _SETTLES_S) + before.expected(now) - expected
        self._shown = now, word, apart
        return max(expected + apart, 0.0)


def in_words(seconds: float) -> str:
    """Say how long something still takes.

    Returns such as ``"about 12 s left"``; minutes from 100 s on.
    """
    if seconds < 1.0:
        return "nearly done"
    return f"about {seconds:.0f} s left" if seconds < 100.0 else f"about {seconds / 60.0:.0f} min left"
