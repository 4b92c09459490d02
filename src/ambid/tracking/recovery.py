"""After a change: find the moved number again from the raw samples since, beside what was known before.

Each suspect alone is given its freedom back; the one that explains the stretch best is the one that moved. Where none
does, all physical parameters are freed. An explanation has to bring the innovations down to what they were. The search
is the off-line Gauss-Newton step on a few thousand samples at most, so that it takes milliseconds.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambid.recursive.lines import Event
from ambid.tracking.evidence import Evidence, RecentSamples
from ambid.tracking.rpem import ParameterFilter, PhysicalRpem
from ambid.tracking.window import Refined, evidence_of, refine

_LEAST_SD = 0.3  # of a number that has moved, relative to its magnitude
_STRAY = 3.0  # moves that the detector's estimate of a move may be off by
_BLOCKS_AFTER = 3  # of settled evidence before the first search
_SHOWN = 4.0  # standard deviations by which the innovations of a block are larger than before
_FEW = 3  # suspects that are searched in full
_MISFIT = 4.0  # times the number of unknowns: what a right explanation's misfit hardly passes
_LEFT = 2.0  # times the usual variance of innovations that a right explanation may leave, as it is over few blocks
_TOLD = 25.0  # by which a number has to lessen the misfit to be named where the alarm named none
_VAGUE = 0.1  # relative standard deviation above which nothing is said to have been found
_QUIET = 3.0  # standard deviations of chi-squared under which what was known before explains a stretch


def begin(
    rpem: PhysicalRpem,
    history: Sequence[tuple[Evidence, ParameterFilter]],
    event: Event,
    *,
    onset: int,
    suspects: tuple[str, ...],
    size: float = 0.0,
    blocks: int = 0,
) -> Recovery:
    """Prepare the search after an alarm.

    `history`: recent blocks, each with what was known before it; `event`: what was said of the change; `onset`: first
    sample of the window in which it was found; `blocks`: length of that window; 0 where it does not matter.
    """
    before = next((f for e, f in reversed(history) if e.first <= onset), history[0][1])
    # the change lies somewhere in the block in which it shows first: what comes after it is clean
    clean = min(_first_shown(rpem, history, onset, before) + rpem.block_samples, rpem.stream.sample)
    return Recovery(
        event=event,
        suspects=suspects,
        size=size,
        onset=clean,
        short=0 < blocks <= _BLOCKS_AFTER,
        before=before.copy(),
        ready=clean + rpem.stream.settling_samples + _BLOCKS_AFTER * rpem.block_samples,
    )


def _first_shown(
    rpem: PhysicalRpem, history: Sequence[tuple[Evidence, ParameterFilter]], onset: int, before: ParameterFilter
) -> int:
    """First sample of the first block since `onset` whose innovations are larger than before; else `onset`."""
    for evidence, _ in history:
        n = evidence.n_samples * evidence.n_outputs
        if evidence.first >= onset and evidence.loss(before.q) / rpem.noise > n + _SHOWN * np.sqrt(2.0 * n):
            return evidence.first
    return onset


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recovered:
    """Numbers found again."""

    refined: Refined | None  # none where nothing has moved
    moved: tuple[str, ...]  # numbers that were freed
    computing_s: float


@dataclass(slots=True, kw_only=True, eq=False)
class Recovery:
    """A change that is being worked on."""

    event: Event  # what was said of it when it was found
    suspects: tuple[str, ...]  # numbers each of which may have moved, the likeliest first
    size: float  # how far the likeliest has moved, in units of its magnitude, as far as is known
    onset: int  # first sample after the change
    short: bool  # the alarm came from so few blocks that as many after the change have to show it too
    before: ParameterFilter  # what was known before it
    ready: int  # sample from which on a search makes sense
    attempts: int = 0

    def attempt(self, rpem: PhysicalRpem, recent: RecentSamples) -> Recovered | None:
        """Search in all samples since the onset.

        Returns none where nothing explains them; the next attempt is due when twice as many are there.
        """
        begun = time.thread_time()
        self.attempts += 1
        if self.attempts > 1:  # something in the first half does not belong to what holds now
            self.onset += (recent.last - self.onset) // 2
        self.onset = max(self.onset, recent.first)
        self.ready = recent.last + max(recent.last - self.onset, 1)
        best: tuple[Refined | None, tuple[str, ...]] | None = None
        samples = recent.since(self.onset)
        evidence = None if samples is None else evidence_of(rpem.numbers, rpem.stream.at, samples, first=self.onset)
        if evidence is not None:
            best = self._explanation(rpem, recent, evidence)
        if best is None:
            return None
        return Recovered(refined=best[0], moved=best[1], computing_s=time.thread_time() - begun)

    def restart(self, sample: int, rpem: PhysicalRpem) -> None:
        """Wait for samples behind a gap: those before it cannot be used together with them.

        `sample`: first one behind the gap.
        """
        self.onset = sample
        self.ready = sample + rpem.stream.settling_samples + _BLOCKS_AFTER * rpem.block_samples
        self.attempts = max(self.attempts - 1, 0)

    def _explanation(
        self, rpem: PhysicalRpem, recent: RecentSamples, evidence: Evidence
    ) -> tuple[Refined | None, tuple[str, ...]] | None:
        """What explains the samples since the onset, if anything does: nothing has moved, one number has, or all."""
        p = rpem.numbers.start.size
        before = self._unmoved(rpem, evidence)
        if self.short and self.attempts == 1 and before < p + _QUIET * np.sqrt(2.0 * p):
            return None, ()
        numbers = rpem.numbers
        choices = [(name,) for name in self._likeliest(rpem, evidence)]
        if self.event.kind != "change" or self.attempts > 1:  # it may have been a load after all
            choices.append(tuple(numbers.names[j] for j in numbers.places("offset", "unbalance")))
        best = self._best(rpem, recent, choices)
        if best is None or best[0].misfit >= _MISFIT * p:
            every = tuple(numbers.names[j] for j in numbers.places("parameter"))
            best = self._best(rpem, recent, [every])
        if best is None or best[0].misfit >= _MISFIT * p:
            return None
        if self.event.kind != "change" and before - best[0].misfit < _TOLD and before < _MISFIT * p:
            return None, ()
        return best

    def _unmoved(self, rpem: PhysicalRpem, evidence: Evidence) -> float:
        """Misfit of what was known before: chi-squared with p degrees of freedom if nothing has moved."""
        return self.before.copy().absorb(evidence, rpem.noise)

    def _likeliest(self, rpem: PhysicalRpem, evidence: Evidence) -> tuple[str, ...]:
        """Of many suspects those few that explain the stretch best to first order."""
        if len(self.suspects) <= _FEW:
            return self.suspects
        rho, spread = evidence.residual(self.before.q), evidence.J @ self.before.covariance @ evidence.J.T
        places = [rpem.numbers.names.index(name) for name in self.suspects]
        toward = evidence.J[:, places]
        weighted = np.linalg.solve(rpem.noise * np.eye(rho.size) + spread, np.column_stack([rho, toward]))
        power = np.einsum("ij,ij->j", toward, weighted[:, 1:])
        gain = (toward.T @ weighted[:, 0]) ** 2 / np.where(power > 0.0, power, np.inf)
        return tuple(self.suspects[j] for j in np.argsort(-gain)[:_FEW])

    def _best(
        self, rpem: PhysicalRpem, recent: RecentSamples, choices: Sequence[tuple[str, ...]]
    ) -> tuple[Refined, tuple[str, ...]] | None:
        """Of several sets of numbers that may be freed, the one that explains the stretch best."""
        found = [(self._search(rpem, recent, freed), freed) for freed in choices]
        return min(
            ((refined, freed) for refined, freed in found if refined is not None),
            key=lambda pair: pair[0].misfit,
            default=None,
        )

    def _search(self, rpem: PhysicalRpem, recent: RecentSamples, freed: tuple[str, ...]) -> Refined | None:
        samples = recent.since(self.onset)
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
            first=self.onset,
            block=rpem.block_samples,
            noise=rpem.noise,
            gain=rpem.stream.at.gain,
        )
        if found is None or not found.converged:
            return None
        left = found.evidence.rest / found.evidence.freedom if found.evidence.freedom else 1.0
        vague = max(found.filter.sd[rpem.numbers.names.index(name)] for name in freed) > _VAGUE
        return None if vague or left > _LEFT * max(rpem.noise_level, 1.0) else found
