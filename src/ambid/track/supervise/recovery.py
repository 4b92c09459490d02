"""After a change: find the moved number anew from the raw samples since, beside what was known before.

Each suspect alone is given its freedom back; the one that explains the stretch best is the one that moved. Where none
does, all physical parameters are freed. The search is the off-line Gauss-Newton step on a few thousand samples at most,
so that it takes milliseconds.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from ambid.track.lines import Event
from ambid.track.physical.parameter_filter import ParameterFilter
from ambid.track.physical.rpem import PhysicalRpem
from ambid.track.physical.signals import RecentSamples
from ambid.track.physical.window import Refined, refine

_LEAST_SD = 0.3  # of a number that has moved, relative to its magnitude
_STRAY = 3.0  # moves that the detector's estimate of a move may be off by
_MISFIT = 4.0  # times the number of unknowns: what a right explanation's misfit hardly passes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recovered:
    """Numbers found anew.

    Attributes
    ----------
    refined : Refined
    moved : tuple of str
        Numbers that were freed.
    computing_s : float
    """

    refined: Refined
    moved: tuple[str, ...]
    computing_s: float


@dataclass(slots=True, kw_only=True, eq=False)
class Recovery:
    """A change that is being worked on.

    Attributes
    ----------
    event : Event
        What was said of it when it was found.
    suspects : tuple of str
        Numbers each of which may have moved, the likeliest first.
    size : float
        How far the likeliest has moved, in units of its magnitude, as far as is known.
    onset : int
        First sample after the change.
    before : ParameterFilter
        What was known before it.
    ready : int
        Sample from which on a search makes sense.
    attempts : int
    """

    event: Event
    suspects: tuple[str, ...]
    size: float
    onset: int
    before: ParameterFilter
    ready: int
    attempts: int = 0

    def attempt(self, rpem: PhysicalRpem, recent: RecentSamples) -> Recovered | None:
        """Search in all samples since the onset.

        Parameters
        ----------
        rpem : PhysicalRpem
        recent : RecentSamples

        Returns
        -------
        Recovered or None
            None where nothing explains them; the next attempt is due when twice as many are there.
        """
        begun = time.perf_counter()
        self.attempts += 1
        first = max(self.onset, recent.first)
        limit = _MISFIT * rpem.numbers.start.size
        best = self._best(rpem, recent, first, [(name,) for name in self.suspects])
        if best is None or best[0].misfit >= limit:
            numbers = rpem.numbers
            every = tuple(numbers.names[j] for j in numbers.places("parameter"))
            best = self._best(rpem, recent, first, [every])
        self.ready = recent.last + max(recent.last - first, 1)
        if best is None or best[0].misfit >= limit:
            return None
        return Recovered(refined=best[0], moved=best[1], computing_s=time.perf_counter() - begun)

    def _best(
        self, rpem: PhysicalRpem, recent: RecentSamples, first: int, choices: Sequence[tuple[str, ...]]
    ) -> tuple[Refined, tuple[str, ...]] | None:
        """Of several sets of numbers that may be freed, the one that explains the stretch best."""
        found = [(self._search(rpem, recent, first, freed), freed) for freed in choices]
        return min(
            ((refined, freed) for refined, freed in found if refined is not None),
            key=lambda pair: pair[0].misfit,
            default=None,
        )

    def _search(self, rpem: PhysicalRpem, recent: RecentSamples, first: int, freed: tuple[str, ...]) -> Refined | None:
        samples = recent.since(first)
        if samples is None:
            return None
        begin = self.before.copy()
        for name in freed:
            place = rpem.numbers.names.index(name)
            begin.active[place] = True
            begin.widen(place, max(_LEAST_SD, _STRAY * abs(self.size)))
        found = refine(
            rpem.numbers,
            begin,
            samples,
            first=first,
            block=rpem.block_samples,
            noise=rpem.noise,
            gain=rpem.stream.at.gain,
        )
        return found if found is not None and found.converged else None
