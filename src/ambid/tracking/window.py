"""Moving-window Gauss-Newton estimation of the physical parameters, warm-started from the last estimate.

The tracked numbers that explain a stretch of raw samples best are found by iterating: linearise, run the predictor
over the stretch, take its evidence in beside what is known from before. Used alone it forgets sharply; the supervisor
uses it to find a parameter again after a jump, where the recursion's first-order step would be too long.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.estimate import Estimate
from ambid.tracking.evidence import Evidence, EvidenceStream, Linearisation, RecentSamples, Samples, checked, linearise
from ambid.tracking.numbers import TrackedNumbers
from ambid.tracking.rpem import ParameterFilter, PhysicalEstimator

_WHOLE = 1 << 40  # samples: a stretch is one block
_ITERATIONS = 6
_SETTLED = 0.05  # in standard deviations: the search has converged where the next step is shorter
_HALVINGS = 4
_WIDER = 30.0  # how much wider than the start's the standard deviations are that a window begins with


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
    """Find the numbers that explain a stretch, given what is known from before it.

    `before`: what is known without the stretch; the search starts there; `samples`: the stretch; its first part settles
    the predictor; `first`: number of its first sample in the stream; `block`: samples of one evidence of the stream
    that is given back; `noise`: variance of the evidence's residual; `gain`: (n_states, n_outputs), a predictor gain
    near the one looked for. Returns none where the stretch is too short to settle, or no step leads to a predictor.
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
        found = before.copy()
        misfit = found.absorb(evidence, noise)
        step = float(np.max(np.abs(found.q - q) / found.sd))
        # steps shrink at least as fast as they have: what the next one would be needs no look
        left, last = step * min(1.0, step / last) if last else step, step
        if left < _SETTLED or iteration == _ITERATIONS:
            return Refined(
                filter=found,
                stream=stream,
                evidence=evidence,
                misfit=misfit,
                converged=left < _SETTLED,
                iterations=iteration,
            )
        q = found.q.copy()
    return None


def evidence_of(numbers: TrackedNumbers, at: Linearisation, samples: Samples, *, first: int = 0) -> Evidence | None:
    """Return the evidence of a stretch as a whole.

    `samples`: its first part settles the predictor; `first`: number of its first sample in the stream. Returns none
    where the stretch is too short to settle.
    """
    stream = EvidenceStream(numbers, at, _WHOLE)
    stream.restart(first)
    stream.feed(samples)
    return stream.close(1)


class MovingWindow(PhysicalEstimator):
    """Estimator of the physical parameters from the last samples alone.

    Parameters
    ----------
    start : Estimate or TrackedNumbers
    window : int
        Samples of the window.
    every : int, optional
        Samples between estimates; by default a tenth of the window.

    Attributes
    ----------
    numbers : TrackedNumbers
    n_used, n_rejected : int
    n_failed : int
        Windows from which nothing was found: the estimate before is kept.

    Raises
    ------
    EstimationError
        If the window is too short for the numbers and for the predictor to settle.
    """

    def __init__(self, start: Estimate | TrackedNumbers, *, window: int, every: int | None = None) -> None:
        super().__init__(start)
        numbers = self.numbers
        fewest = self.stream.settling_samples + 10 * numbers.start.size
        if window < fewest:
            raise EstimationError(f"the window has {window} samples; it needs at least {fewest}. Give a longer window")
        self.window = window
        self.every = max(1, window // 10) if every is None else every
        wide = numbers.covariance.copy()
        own = numbers.places("parameter", "noise")
        wide[np.ix_(own, own)] *= _WIDER**2
        self._begin = ParameterFilter(numbers.start, wide, numbers.positive)
        self._begin.active[numbers.places("gain")] = False
        self.stream = EvidenceStream(numbers, self.stream.at, _WHOLE)
        self._recent, self._since, self.n_failed = RecentSamples(window), 0, 0

    def update(self, inputs: ArrayLike, outputs: ArrayLike) -> Array:
        """Take in one sample or a block.

        Parameters
        ----------
        inputs : array_like, shape (n_inputs,) or (n_samples, n_inputs), SI
        outputs : array_like, shape (n_outputs,) or (n_samples, n_outputs), SI

        Returns
        -------
        ndarray, shape of `outputs`, SI
            Innovations of the predictor at the estimate so far; NaN for a rejected sample.

        Raises
        ------
        EstimationError
            If the shapes do not fit.
        """
        samples = checked(self.numbers, inputs, outputs, None)
        errors = np.full(samples.y.shape, np.nan)
        n, k = samples.y.shape[0], 0
        while k < n:
            stop = min(n, k + self.every - self._since)
            used, found, _ = self.stream.feed(samples.part(k, stop))
            errors[k : k + used] = found
            self._recent.add(samples.part(k, k + used), self.stream.sample)
            k, self._since, self.n_used = k + used, self._since + used, self.n_used + used
            if self._since >= self.every:
                self._since = 0
                self._solve()
            elif k < stop:
                self.n_rejected += 1
                k += 1
                self._recent.clear()
                self.stream.restart(self.stream.sample + 1)
        return errors.reshape(np.shape(outputs))

    def _solve(self) -> None:
        first = self.stream.sample - self.window
        samples = self._recent.since(first)
        if samples is None:
            return
        begin = self._begin.copy()
        begin.q = self.filter.q.copy()  # a warm start; what is known of it is as wide as at the beginning
        found = refine(
            self.numbers,
            begin,
            samples,
            first=first,
            block=_WHOLE,
            noise=self.numbers.overdispersion,
            gain=self.stream.at.gain,
        )
        if found is None or not found.converged:
            self.n_failed += 1
            return
        self.filter, self.stream = found.filter, found.stream
