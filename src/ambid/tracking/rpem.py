"""Recursive prediction error estimation of physical parameters (Ljung and Söderström 1983, ch. 3; Ljung 1999, ch. 11).

A Kalman filter of the tracked numbers takes in each block's evidence: square-root covariance, Joseph's form (Bierman
1977, ch. 5); held numbers enter with their uncertainty, unmoved (Schmidt). The predictor is assembled again where
second-order terms matter. It is as consistent in closed loop as the off-line estimator, and with unlimited memory ends
where that does. Walk variances w_j are found by maximum likelihood: the score over a window is half the difference of
sum(lambda_j^2) and sum(N_jj) of the disturbance smoother (Koopman and Shephard 1992), whose ratio to a power below one
moves w_j.
"""

from __future__ import annotations

import copy
import math
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError, counted
from ambid.estimation.estimate import Estimate
from ambid.recursive.estimator import as_blocks, covariance_of, factors_of
from ambid.recursive.square_root_kernels import deviations, walk, widen
from ambid.tracking.evidence import Evidence, EvidenceStream, EvidenceSum, Samples, linearise
from ambid.tracking.kernels import absorb, filter_ring, smooth_ring
from ambid.tracking.numbers import TrackedNumbers, tracked_numbers

Flags = NDArray[np.bool_]


class ParameterFilter:
    """Estimate `q` (p,) and covariance of the tracked numbers, from `start` and a positive definite one; `positive`:
    which stay so, default none, by steps that take at most half; `active`: which evidence may move, and which may walk.
    """

    def __init__(self, start: Array, covariance: Array, positive: Flags | None = None) -> None:
        self.q, self._F = start.copy(), factors_of(covariance)
        self._scratch = np.zeros((start.size + 2, start.size))
        self.active = np.ones(start.size, dtype=np.bool_)
        self._positive = np.zeros(start.size, dtype=np.bool_) if positive is None else positive

    @property
    def covariance(self) -> Array:
        """Covariance of `q`, shape (p, p)."""
        return covariance_of(self._F)

    @property
    def sd(self) -> Array:
        """Standard deviations of `q`, shape (p,)."""
        sd = np.empty(self.q.size)
        deviations(self._F, sd)
        return sd

    def walk(self, variance: Array, time: float = 1.0) -> None:
        """Let the active numbers walk. `variance`: (p,), of the walks, per second; `time`: s."""
        walk(self._F, np.where(self.active, time * variance, 0.0), self._scratch[0])

    def absorb(self, evidence: Evidence, noise: float = 1.0) -> float:
        """Take in a block's evidence; return the residual's squared length before, chi-squared with p degrees of
        freedom if model and covariance are right.
        """
        misfit, _ = absorb(
            self.q, self._F, evidence.J, evidence.r, evidence.at, self.active, self._positive, noise, self._scratch
        )
        return float(misfit)

    def far(self, at: Array, J: Array, curved: Array, most: float) -> bool:
        """Return whether the estimate has left the neighbourhood of `at`; `J`: triangle of a block's evidence; too much
        are `curved` (p,), squared moves over standard deviations, and `most`, |J (q - at)|^2.
        """
        move = self.q - at
        length = J @ move
        return bool(length @ length > most or (move * move > curved * self.sd).any())

    def widen(self, direction: Array, sd: float) -> None:
        """Forget what is known along a `direction` (p,), but not across it: the numbers may have moved by about `sd`
        times it.
        """
        self._scratch[0] = direction
        widen(self._F, self._scratch[0], sd * sd)

    def set(self, q: Array, covariance: Array) -> None:
        """Go on from other numbers. `q`: (p,); `covariance`: (p, p)."""
        fresh = ParameterFilter(q, covariance)
        self.q, self._F = fresh.q, fresh._F

    def copy(self) -> ParameterFilter:
        """Return an independent filter in the same state."""
        other = ParameterFilter.__new__(ParameterFilter)
        other.__dict__.update(self.__dict__)
        other.q, other._F, other.active = self.q.copy(), self._F.copy(), self.active.copy()
        return other


CHUNK_S = 0.05  # evidence is merged to this length: the fastest drift that is told from a jump
_WINDOW = 400  # chunks
_FEWEST = 20  # chunks before the first adaptation
_FIRST = 6  # chunks before one of a number that is suspected to drift
_EVERY = 5  # chunks between looks at the recent past
_SELDOM = 20  # chunks between looks at the whole window
_SURE = 6.0  # ratio in the recent past that chance seldom makes; what follows from a false one is a wider interval
_LIKELY, _FOUND = 2.5, 1.2  # ratios from which a suspected number walks faster, until it has its most likely rate
_RECENT = (20, 60)  # chunks that alone may show that something has begun to drift
_POWER = 0.5
_SLOWER, _FASTER = 0.5, 10.0  # factors by which one adaptation may change a variance
_ROUNDS = 10  # of raising a variance at one look
_WITHIN = 6.0  # what may walk within a chunk, as squares of its innovations: more would be taken for other numbers
_NOTICED = 3.0  # factor of a variance from which the recent past is filtered anew
_RAMPS = np.array([5, 10, 14, 20])  # chunks since which something may drift steadily
# statistics from which it may be so: chance passes each as often, in 3e-4 of the cases for each chunk of the window
_BEGUN = np.array([10.1, 8.8, 8.2, 7.6])
# of a parameter alone, two standard deviations where half a second may have passed: until more is shown it is far off
_ALONE = np.array([10.1, 4.0, 4.0, 4.0])
_ALIKE = 9.2  # by which statistics of drifts differ by chance in one of a hundred cases
_ROUNDED = 1e-9  # of a ramp's information: what is left of it beside the other numbers is not known better
_BETWEEN = 0.07  # of a statistic, that is lost where a drift began in the middle between two windows


class DriftRates:
    """Variances per second of the walks, from `start` (p,) within `floor` and `ceiling` (p,): equal ones are not
    adapted. `block_s`: length of the evidence to come, s; `adapts`: whether they are found from the data; `walks`:
    whether any variance is, or may become, positive; `suspected` (p,): which seem to have begun to walk, to be set.
    """

    def __init__(self, start: Array, floor: Array, ceiling: Array, block_s: float) -> None:
        p = start.size
        self.variance, self._start, self._floor, self._ceiling = start.copy(), start, floor, ceiling
        self.adapts = bool(np.any(ceiling > floor))
        self.walks = self.adapts or bool(np.any(start > 0.0))
        self._per_chunk = max(1, round(CHUNK_S / block_s))
        self._chunk_s = self._per_chunk * block_s
        room = _WINDOW if self.adapts else 0
        self._J, self._r, self._at = np.zeros((room, p, p)), np.zeros((room, p)), np.zeros((room, p))
        self._q, self._P = np.zeros((room, p)), np.zeros((room, p, p))
        self._H, self._g = np.zeros((room, p, p)), np.zeros((room, p))
        self._none = np.zeros((3, 0, p))
        self._scratch = np.zeros((room, p, p + 2)), np.zeros((p, p))
        self._chunk = EvidenceSum(p)
        self._count = self._next = self._since = self._looks = 0
        self.suspected = np.zeros(p, dtype=np.bool_)

    def add(self, evidence: Evidence, before: ParameterFilter) -> None:
        """Take in a block. `before`: the numbers as they were known before this block."""
        if not self.adapts:
            return
        chunk = self._chunk
        if not chunk.blocks:
            self._q[self._next], self._P[self._next] = before.q, before.covariance
            chunk.clear(evidence.at)
        chunk.add(evidence)
        if chunk.blocks < self._per_chunk:
            return
        J, r = chunk.T[:, :-1], chunk.T[:, -1]
        self._J[self._next], self._r[self._next], self._at[self._next] = J, r, chunk.at
        self._H[self._next], self._g[self._next] = J.T @ J, J.T @ (r - J @ chunk.at)
        chunk.blocks = 0
        self._next = (self._next + 1) % _WINDOW
        self._count = min(self._count + 1, _WINDOW)
        self._since += 1

    def adapt(self, present: ParameterFilter, noise: float) -> None:
        """Look at the window when due; where something walks faster than thought, filter its end again with the
        residual's variance `noise`.
        """
        if self._chunk.blocks:
            return
        suspected = self.suspected & present.active & (self._ceiling > self._floor)
        self.suspected[:] = False
        due = self._since >= _EVERY
        if self._count < (_FIRST if self._looks else _FEWEST) or not (due or suspected.any()):
            return
        active, before = present.active, self.variance
        if due and self._count >= _FEWEST:
            if self._looks % (_SELDOM // _EVERY) == 0:
                self._raise(self._ratio(self._count, active, noise))
            self._looks += 1
        for length in _RECENT:
            until = np.where(suspected, _LIKELY, _SURE)
            for _ in range(_ROUNDS):
                recent = self._ratio(min(length, self._count), active, noise)
                until[suspected & (recent > _LIKELY)] = _FOUND
                if not np.any(recent > until):
                    break
                self._raise(np.where(recent > until, recent, 1.0))
        if due:  # what has only seemed to walk soon stands still again
            self._since = 0
            self._raise(np.where(self.risen > 0.0, np.minimum(recent, 1.0), 1.0))
        seen = np.square(self._J[(self._next - 1) % _WINDOW]).sum(axis=0) @ self.risen * self._chunk_s
        if np.any(self.variance > _NOTICED * before) and seen < _WITHIN:
            # filter the recent past again: with the rates as they were, what moved was taken for chance
            _, _, q, P = self._run(min(max(_RECENT), self._count), active, noise)
            if np.all(np.isfinite(q)) and np.all(np.diag(P) > 0.0):
                present.set(np.where(active, q, present.q), P)

    def look(self, toward: Array, alone: int, noise: float) -> Array | None:
        """Look, where a chunk is complete, else None, for ramps of the causes `toward` (n_causes, p), the first of them
        `alone` parameters, in windows up to now; return those that show, and that explain their window about as well
        as the likeliest: by how much the numbers are off, where they are, with what variance, (3, n, p), as of
        `ramps`; `noise`: the residual's variance.
        """
        windows = int(np.searchsorted(_RAMPS, self._count, side="right"))
        if not (windows and self.adapts):
            return self._none
        if self._chunk.blocks:
            return None
        try:
            T, ends = self.ramps(_RAMPS[:windows], toward, noise)
        except np.linalg.LinAlgError:  # numbers of which so little was known that the data's information is lost
            return self._none
        best = T.max(axis=1, keepdims=True)  # a window that holds a jump says nothing of those that do not
        least = np.where(np.arange(len(toward)) < alone, _ALONE[:windows, None], _BEGUN[:windows, None])
        likely = np.maximum(least, (1.0 - _BETWEEN) * best - _ALIKE) < T
        return np.asarray(ends[:, likely])

    def ramps(self, lengths: NDArray[np.int64], toward: Array, noise: float) -> tuple[Array, Array]:
        """Return statistics (n_lengths, n_causes) of ramps w d, w from 0 to 1 over the last `lengths` chunks, along
        `toward` (n_causes, p), beside numbers known up to P before them; and of each by how much an estimate that knows
        of no ramp is off until the next look, where the numbers are then, and the variance of that, (3, n_lengths,
        n_causes, p).

        The score of a ramp is d^T g_w - (H_w d)^T S g, of variance d^T H_ww d - (H_w d)^T S H_w d, S = (P^-1 + H)^-1;
        g_w, H_w, H_ww are weighted by w and its square.
        """
        age = np.arange(lengths[-1])
        last, at, n = (self._next - 1 - age) % _WINDOW, lengths - 1, lengths[:, None].astype(float)
        first, moments = last[at], (age + 0.5) ** np.arange(3)[:, None] / noise
        H, H1, H2 = np.cumsum(moments[:, :, None, None] * self._H[last], axis=1)[:, at]
        g, g1 = np.cumsum(moments[:2, :, None] * self._g[last], axis=1)[:, at]
        Hw, Hww, q = H - H1 / n[..., None], H - (2.0 * H1 - H2 / n[..., None]) / n[..., None], self._q[first]
        P = self._P[first] + 0.5 * n[..., None] * np.diag(self._chunk_s * self.variance)
        S, gw = np.linalg.solve(np.eye(q.shape[1]) + P @ H, P), g - g1 / n + (Hw @ q[..., None])[..., 0]
        slopes, moved = toward @ Hw, (S @ (g[..., None] + H @ q[..., None]))[..., 0][:, None]
        drawn = slopes @ S
        score = gw @ toward.T - (slopes * moved).sum(axis=2)
        alone = ((toward @ Hww) * toward).sum(axis=2)
        power = np.maximum(alone - (drawn * slopes).sum(axis=2), _ROUNDED * alone + 1e-30)[..., None]
        size, on = -score[..., None] / power, (n[..., None] + 1.0) / n[..., None] * toward
        left = moved + size * drawn  # of what was known before: a drift that is no ramp since then shows in it
        spread = np.diagonal(S, axis1=1, axis2=2)[:, None] + (on - drawn) ** 2 / power + left**2
        ends = np.array([np.abs(size * (on - drawn)), q[:, None] - left + size * on, spread])
        return score**2 / power[..., 0], ends

    @property
    def risen(self) -> Array:
        """By how much numbers walk faster than was thought at the start."""
        return np.maximum(self.variance - self._start, 0.0)

    def restart(self) -> None:
        """Forget the window: a jump in it would pass for drift."""
        self._count = self._next = self._since = self._chunk.blocks = 0
        self.suspected[:] = False

    def _raise(self, ratio: Array) -> None:
        factor = np.clip(ratio**_POWER, _SLOWER, _FASTER)
        self.variance = np.clip(self.variance * factor, self._floor, self._ceiling)

    def _ratio(self, count: int, active: NDArray[np.bool_], noise: float) -> Array:
        """Sum of lambda_j^2 over sum of N_jj in the last `count` chunks: above 1 where number j walks faster."""
        squares, powers, _, _ = self._run(count, active, noise)
        informed = active & (powers > 0.0)
        return np.where(informed, squares / np.where(informed, powers, 1.0), 1.0)

    def _run(self, count: int, active: NDArray[np.bool_], noise: float) -> tuple[Array, Array, Array, Array]:
        step = np.sqrt(np.where(active, self.variance, 0.0) * self._chunk_s)
        first = (self._next - count) % _WINDOW
        q, P, (K, N) = self._q[first].copy(), self._P[first].copy(), self._scratch
        sums = np.empty((4, q.size))
        filter_ring(self._J, self._r, self._at, count, first, q, P, step, noise, K)
        smooth_ring(self._J, count, first, K, sums, N)
        return sums[0], sums[1], q, P


Memory = float | Literal["auto", "all"]

BLOCK_S = 0.005  # of one evidence
_ROWS_PER_NUMBER = 4  # innovations of one evidence for each tracked number, at least: the noise shows in what is left
_START_MEMORY = 2.0  # times the length of the start's record: memory at the beginning, where it is found from the data
_LONGEST_S, _SHORTEST_S = 60.0, 0.02
# square of a move, over the standard deviation, at which second-order terms matter
_CURVED = {"parameter": 0.05, "gain": 0.05, "noise": 0.5, "offset": np.inf, "unbalance": np.inf}
_APPROACH = (1.0, 0.5, 0.25, 0.125)  # parts of the way tried where there is no predictor at its end
_STALE = 0.01  # part of the innovations' variance that a predictor behind the estimate may add
_NOISE_S = 2.0  # time constant with which the noise level is followed
_TRANSIENT = 2.0  # times the usual noise in one block: more than chance makes, which is why it says something else
_LOWEST_NOISE = 0.25  # of the level at identification: less is not believed
_OFFSET_RATE = 1e-4  # information per second of an offset, in its own units, of which nothing is known before


class PhysicalRpem:
    """Recursive estimator of a bench's physical parameters, started from an off-line estimate. `memory`: time constant
    of forgetting, s; "auto": found for each number by maximum likelihood; "all": all data count alike. `block`: samples
    of one evidence, by default 5 ms and enough innovations to tell noise from numbers. `noise_level`: variance of
    innovations over that at identification, by what no number explains; `n_linearised`: times the predictor was
    assembled again; `n_unreached`: times there was none at the estimate, and the nearest found on the way is used.
    """

    def __init__(self, start: Estimate | TrackedNumbers, *, memory: Memory = "auto", block: int | None = None) -> None:
        self.numbers = numbers = start if isinstance(start, TrackedNumbers) else tracked_numbers(start)
        at = linearise(numbers, numbers.start)
        if at is None:
            raise EstimationError("the start estimate gives no stable predictor. Identify the bench again")
        self.n_used = self.n_rejected = 0
        fewest = -(-_ROWS_PER_NUMBER * numbers.start.size // len(numbers.problem.model.outputs))
        size = max(round(BLOCK_S * numbers.rate_hz), fewest) if block is None else block
        if size < 1:
            raise EstimationError(f"a block has {counted(size, 'sample')}; it needs at least 1. Give a larger block")
        self.block_samples, self.block_s = size, size / numbers.rate_hz
        self.filter = ParameterFilter(numbers.start, numbers.covariance, numbers.positive)
        self.filter.active[numbers.places("gain")] = False
        self.stream = EvidenceStream(numbers, at, size)
        self.drift = _rates(numbers, memory, self.block_s)
        self.n_linearised = self.n_unreached = 0
        self.noise_level = 1.0
        self._curved = np.array([_CURVED[kind] for kind in numbers.kinds])
        self._joints = [numbers.direction(cause) for cause in numbers.joints]
        free = (numbers.names[j] for j in numbers.places("parameter", "gain", "offset", "unbalance"))
        self._causes = np.array([*(numbers.direction(name) for name in free), *self._joints])
        self._part = -float(np.expm1(-self.block_s / _NOISE_S))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the physical parameters."""
        return tuple(self.numbers.names[j] for j in self.numbers.places("parameter"))

    @property
    def estimate(self) -> Array:
        """Physical parameters, SI, shape (n_parameters,)."""
        return np.asarray((self.filter.q * self.numbers.magnitude)[self.numbers.places("parameter")])

    @property
    def covariance(self) -> Array:
        """Their covariance, SI, shape (n_parameters, n_parameters)."""
        own, size = self.numbers.places("parameter"), self.numbers.magnitude
        return np.asarray((self.filter.covariance * np.outer(size, size))[np.ix_(own, own)])

    def copy(self) -> Self:
        """Return an independent estimator in the same state."""
        return copy.deepcopy(self, {id(self.numbers): self.numbers})

    def update(self, inputs: ArrayLike, outputs: ArrayLike, forcing: ArrayLike = ()) -> Array:
        """Take in one sample or a block, SI; return innovations, NaN for a rejected sample. `forcing` (2,) or
        (n_samples, 2), for a tracked unbalance: (speed/top speed)^2 times cosine and sine of the angle.
        """
        problem = self.numbers.problem
        u, y, shape = as_blocks("tracking", inputs, outputs, problem.u.shape[1], problem.y.shape[1])
        turning = as_blocks("unbalance", forcing, outputs, 2, y.shape[1])[0] if self.numbers.synchronous else None
        samples = Samples(u=u, y=y, forcing=turning)
        k, n = 0, y.shape[0]
        errors = np.full(samples.y.shape, np.nan)
        while k < n:
            n_taken, innovations, evidence = self.stream.feed(samples.part(k) if k else samples)
            errors[k : k + n_taken] = innovations
            k += n_taken
            self.n_used += n_taken
            if evidence is not None:
                self.take(evidence)
            elif k < n:
                self.n_rejected += 1
                k += 1
                self.stream.restart(self.stream.sample + 1)
        return errors.reshape(shape)

    def take(self, evidence: Evidence) -> None:
        """Take in the evidence of a block."""
        self.predict()
        self.absorb(evidence)

    def absorb(self, evidence: Evidence) -> None:
        """Take in the evidence of a block over which the numbers have already walked."""
        self.drift.add(evidence, self.filter)
        self.filter.absorb(evidence, self.noise_of(evidence))
        self.drift.adapt(self.filter, self.noise)
        self.follow_noise(evidence)
        self.refresh()

    def begun(self) -> Array | None:
        """Return drifts that may have begun, as of `DriftRates.look`."""
        return self.drift.look(self._causes, len(self.names), self.noise)

    def predict(self) -> None:
        """Let the numbers walk over one block; what a joint cause moves together, where two of them have begun to."""
        if not self.drift.walks:
            return
        self.filter.walk(self.drift.variance, self.block_s)
        risen = np.where(self.filter.active, self.drift.risen, 0.0)
        for direction in self._joints if risen.any() else ():
            if np.count_nonzero(direction) < 2:  # such as where the others start at zero
                continue
            common = np.sort(risen[direction != 0.0] / direction[direction != 0.0] ** 2)[-2]
            if common > 0.0:
                self.filter.widen(np.where(self.filter.active, direction, 0.0), math.sqrt(common * self.block_s))

    def refresh(self) -> None:
        """Assemble the predictor again where second-order terms matter, or its innovations are noticeably larger."""
        latest = self.stream.latest
        if latest is not None:
            most = _STALE * self.noise_level * latest.n_samples
            far = self.filter.far(self.stream.at.at, latest.J, self._curved, most)
            if far and not self.move_to(self.filter.q):
                self.filter.q = self.stream.at.at.copy()  # numbers without a predictor are none of a bench

    def noise_of(self, evidence: Evidence) -> float:
        """Return the variance with which a block's residual is taken: the usual, or so much larger as is left
        unexplained: a transient that the model does not know must not move the numbers.
        """
        own = evidence.rest / evidence.freedom if evidence.freedom else 0.0
        usual = max(self.noise_level, _LOWEST_NOISE)
        return self.numbers.overdispersion * (own if own > _TRANSIENT * usual else usual)

    def follow_noise(self, evidence: Evidence) -> None:
        """Follow the noise level by the part of a block's innovations that no number explains."""
        if evidence.freedom:
            self.noise_level += self._part * (evidence.rest / evidence.freedom - self.noise_level)

    @property
    def noise(self) -> float:
        """Variance of the evidence's residual: above 1 where the model does not fully fit the record."""
        return self.numbers.overdispersion * max(self.noise_level, _LOWEST_NOISE)

    def move_to(self, q: Array) -> bool:
        """Linearise at other numbers; False where there is no predictor: it comes as near as it can."""
        near = self.stream.at
        for part in _APPROACH:
            at = linearise(self.numbers, near.at + part * (q - near.at), near.gain)
            if at is not None:
                self.stream.relinearise(at)
                self.n_linearised += 1
                break
        self.n_unreached += at is None or part < 1.0
        return at is not None and part == 1.0


def _rates(numbers: TrackedNumbers, memory: Memory, block_s: float) -> DriftRates:
    """Walk variances per second, 1/(information rate x memory^2), by the information on a number if the others are
    known: where only ratios are known well, walks as wide as each alone would loosen them.
    """
    size = np.sqrt(np.diag(numbers.covariance))
    information = 1.0 / np.diag(np.linalg.inv(numbers.covariance / np.outer(size, size))) * size**2
    one_second = information * numbers.information_s
    one_second[numbers.places("offset", "unbalance")] = _OFFSET_RATE
    one_second[numbers.places("gain")] = 0.0
    if memory == "all":
        return DriftRates(np.zeros_like(one_second), np.zeros_like(one_second), np.zeros_like(one_second), block_s)
    if memory != "auto":
        if not memory > 0.0:
            raise EstimationError(f"the memory is {memory} s; it must be positive. Give seconds, 'auto' or 'all'")
        constant = one_second / memory**2
        return DriftRates(constant, constant, constant, block_s)
    first = min(max(_START_MEMORY * numbers.information_s, _SHORTEST_S), _LONGEST_S)
    begin, slowest, fastest = (one_second / s**2 for s in (first, _LONGEST_S, _SHORTEST_S))
    if numbers.problem.noise == "gain":
        # entries of a gain that follow every transient leave the region of good predictors
        own = numbers.places("noise")
        begin[own] = fastest[own] = slowest[own]
    return DriftRates(begin, slowest, fastest, block_s)
