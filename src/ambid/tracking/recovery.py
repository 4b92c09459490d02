"""After a change: find the moved number again from the raw samples since, beside what was known before.

Each suspect alone is freed, and the one that explains the stretch best moved; if none does, all are. Innovations have
to come down to what they were. It is the off-line Gauss-Newton step on a few thousand samples: milliseconds.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.recursive.lines import Event
from ambid.tracking.evidence import Evidence, EvidenceStream, RecentSamples, Samples, linearise
from ambid.tracking.numbers import TrackedNumbers
from ambid.tracking.rpem import ParameterFilter, PhysicalRpem

_LEAST_SD = 0.3  # of a number that has moved, relative to its magnitude
_STRAY = 3.0  # moves that the detector's estimate of a move may be off by
_BLOCKS_AFTER = 3  # of settled evidence before the first search
_SHOWN = 4.0  # standard deviations by which the innovations of a block are larger than before
_FEW = 3  # suspects that are searched in full
_MISFIT = 4.0  # times the number of unknowns: what a right explanation's misfit hardly passes
_LEFT = 2.0  # times the usual variance of innovations that a right explanation may leave, as it is over few blocks
_NEAR = 30.0  # of twice the log-likelihood that a suspect may fall behind to first order to be searched as well
_ALIKE = 9.2  # by which misfits differ by chance in one of a hundred cases
_TOLD = 25.0  # by which a number has to lessen the misfit to be named where the alarm named none
_VAGUE = 0.1  # relative standard deviation above which nothing is said to have been found
_QUIET = 3.0  # standard deviations of chi-squared under which what was known before explains a stretch
_WHOLE = 1 << 40  # samples: a stretch is one block
_ITERATIONS = 6
_SETTLED = 0.05  # in standard deviations: the search has converged where the next step is shorter
_HALVINGS = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refined:
    """Numbers found from a stretch."""

    filter: ParameterFilter  # estimate and covariance, what was known before included
    stream: EvidenceStream  # the predictor at the estimate, at the end of the stretch
    evidence: Evidence  # of the stretch, linearised where the last step began
    # squared distance of the estimate from what was known before and from the stretch: chi-squared with p degrees of
    # freedom if both are right
    misfit: float
    converged: bool
    iterations: int


def refine(
    numbers: TrackedNumbers,
    before: ParameterFilter,
    samples: Samples,
    *,
    first: int = 0,
    block: int = 1,
    noise: float = 1.0,
    gain: Array | None = None,
) -> Refined | None:
    """Find the numbers that explain a stretch (`samples`, the first of which settle the predictor) from `before`, known
    without it; None where it is too short to settle, or no step leads to a predictor. `first`: its first sample's
    number; `block`: samples of one evidence; `noise`: the residual's variance; `gain` (n_states, n_outputs): near the
    one looked for.
    """
    q, near, last = before.q.copy(), gain, 0.0
    for iteration in range(1, _ITERATIONS + 1):
        at = linearise(numbers, q, near)
        for _ in range(_HALVINGS):
            if at is not None:
                break
            q = 0.5 * (q + before.q)
            at = linearise(numbers, q, near)
        if at is None:
            return None
        near = at.gain
        stream = EvidenceStream(numbers, at, _WHOLE)
        stream.restart(first)
        stream.feed(samples)
        evidence = stream.close(block)
        if evidence is None:
            return None
        updated = before.copy()
        misfit = updated.absorb(evidence, noise)
        step = float(np.max(np.abs(updated.q - q) / updated.sd))
        # steps shrink at least as fast as they have: what the next one would be needs no look
        left, last = step * min(1.0, step / last) if last else step, step
        if left < _SETTLED or iteration == _ITERATIONS:
            return Refined(
                filter=updated, stream=stream, evidence=evidence, misfit=misfit, converged=left < _SETTLED,
                iterations=iteration,
            )  # fmt: skip
        q = updated.q.copy()
    return None


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
    """Prepare the search after an alarm; `history`: recent blocks, with what was known before each; `event`: what was
    said; `onset`, `blocks`: first sample and length of its window, 0 where that does not matter.
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
    moved: tuple[str, ...]  # numbers and joint causes that were freed, the best explanation first
    together: bool  # whether all of them are the explanation; else each may be
    computing_s: float

    @property
    def text(self) -> str:
        """What may have moved, in words."""
        return (", " if self.together else " or ").join(self.moved)


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
        """Search in all samples since the onset; None where nothing explains them: the next is due at twice as many."""
        begun = time.thread_time()
        self.attempts += 1
        if self.attempts > 1:  # something in the first half does not belong to what holds now
            self.onset += (recent.last - self.onset) // 2
        self.onset = max(self.onset, recent.first)
        self.ready = recent.last + max(recent.last - self.onset, 1)
        samples = recent.since(self.onset)
        if samples is None:
            return None
        stream = EvidenceStream(rpem.numbers, rpem.stream.at, _WHOLE)
        stream.restart(self.onset)
        stream.feed(samples)
        evidence = stream.close(1)
        best = None if evidence is None else self._explanation(rpem, samples, evidence)
        if best is None:
            return None
        refined, moved, together = best
        return Recovered(refined=refined, moved=moved, together=together, computing_s=time.thread_time() - begun)

    def restart(self, sample: int, rpem: PhysicalRpem) -> None:
        """Wait for samples from `sample` on, behind a gap: those before it cannot be used together with them."""
        self.onset = sample
        self.ready = sample + rpem.stream.settling_samples + _BLOCKS_AFTER * rpem.block_samples
        self.attempts = max(self.attempts - 1, 0)

    def _explanation(
        self, rpem: PhysicalRpem, samples: Samples, evidence: Evidence
    ) -> tuple[Refined | None, tuple[str, ...], bool] | None:
        """What explains the samples since the onset, if anything does: nothing has moved, one cause has, of several
        that explain them alike any may have, or all numbers moved.
        """
        p = rpem.numbers.start.size
        before = self.before.copy().absorb(evidence, rpem.noise)  # chi-squared if nothing has moved
        if self.short and self.attempts == 1 and before < p + _QUIET * np.sqrt(2.0 * p):
            return None, (), False
        numbers = rpem.numbers
        choices = [(name,) for name in self._likeliest(rpem, evidence)]
        if self.event.kind != "change" or self.attempts > 1:  # it may have been a load after all
            choices.append(tuple(numbers.names[j] for j in numbers.places("offset", "unbalance")))
        found = self._searched(rpem, samples, choices)
        together = not found or len(found[0][1]) > 1
        if found and found[0][0].misfit < _MISFIT * p:
            alike = [freed for refined, freed in found if refined.misfit < found[0][0].misfit + _ALIKE]
            if len(alike) > 1:  # what later data will tell apart stays free until then
                together = False
                found = self._searched(rpem, samples, [tuple(dict.fromkeys(name for freed in alike for name in freed))])
        else:
            together = True
            found = self._searched(rpem, samples, [tuple(numbers.names[j] for j in numbers.places("parameter"))])
        if not found or found[0][0].misfit >= _MISFIT * p:
            return None
        if self.event.kind != "change" and before - found[0][0].misfit < _TOLD and before < _MISFIT * p:
            return None, (), False
        return *found[0], together

    def _likeliest(self, rpem: PhysicalRpem, evidence: Evidence) -> tuple[str, ...]:
        """The suspects, and what else explains the stretch about as well as the best of them to first order; of many
        those few that do best.
        """
        numbers = rpem.numbers
        rho, spread = evidence.residual(self.before.q), evidence.J @ self.before.covariance @ evidence.J.T
        jumps = numbers.places("parameter", "gain", "offset", "unbalance")
        bench = (*(numbers.names[j] for j in jumps), *numbers.joints)
        toward = evidence.J @ np.column_stack([numbers.direction(name) for name in bench])
        weighted = np.linalg.solve(rpem.noise * np.eye(rho.size) + spread, np.column_stack([rho, toward]))
        power = np.einsum("ij,ij->j", toward, weighted[:, 1:])
        gain = (toward.T @ weighted[:, 0]) ** 2 / np.where(power > 0.0, power, np.inf)
        ranked = [bench[j] for j in np.argsort(-gain) if gain[j] > gain.max() - _NEAR]
        named = self.suspects if len(self.suspects) <= _FEW else ()
        return tuple(dict.fromkeys((*named, *ranked)))[: max(_FEW, len(named) + 1)]

    def _searched(
        self, rpem: PhysicalRpem, samples: Samples, choices: Sequence[tuple[str, ...]]
    ) -> list[tuple[Refined, tuple[str, ...]]]:
        """Of several sets of numbers that may be freed, those that leave the innovations as usual, the best first."""
        numbers, found = rpem.numbers, []
        for freed in choices:
            start, toward = self.before.copy(), [numbers.direction(name) for name in freed]
            for direction in toward:
                start.active[direction != 0.0] = True
                start.widen(direction, max(_LEAST_SD, _STRAY * abs(self.size)))
            refined = refine(
                numbers, start, samples, first=self.onset, block=rpem.block_samples, noise=rpem.noise,
                gain=rpem.stream.at.gain,
            )  # fmt: skip
            if refined is None or not refined.converged:
                continue
            left = refined.evidence.rest / refined.evidence.freedom if refined.evidence.freedom else 1.0
            sd = refined.filter.sd[np.any(toward, axis=0)]
            if sd.max() <= _VAGUE and left <= _LEFT * max(rpem.noise_level, 1.0):
                found.append((refined, freed))
        return sorted(found, key=lambda item: item[0].misfit)
