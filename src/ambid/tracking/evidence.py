"""From samples to evidence: the predictor runs along the stream and every block of samples leaves a triangle.

At a point `at` of the tracked numbers q weighted innovations are e + Ψ (q - at) up to second order, of unit covariance
if the model is right. QR of [Ψ e] leaves J, r: -2 log-likelihood = rest + |r + J (q - at)|² + constant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.estimation.colours import colours_of
from ambid.estimation.linear import one_thread
from ambid.estimation.predictor import assemble
from ambid.tracking.kernels import advance, fold
from ambid.tracking.numbers import TrackedNumbers, memory_of


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Samples:
    """Consecutive samples."""

    u: Array  # (n_samples, n_inputs), SI
    y: Array  # (n_samples, n_outputs), SI
    # (n_samples, 2), or None, (speed/top speed)^2 times cosine and sine of the rotor's angle, in the middle of each
    # sample
    forcing: Array | None = None

    def part(self, first: int, last: int | None = None) -> Samples:
        """Return samples `first` <= k < `last`, as views."""
        cut = slice(first, last)
        return Samples(u=self.u[cut], y=self.y[cut], forcing=None if self.forcing is None else self.forcing[cut])


class RecentSamples:
    """The last samples of a stream, in memory that does not grow. `capacity`: samples kept at least."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._parts: list[Array] = []  # of twice the capacity, filled from the front: parts of one sample are many
        self._filled = self.last = 0  # `last`: number of the sample after the newest

    @property
    def first(self) -> int:
        """Number of the oldest sample that is kept."""
        return self.last - self._filled

    def add(self, samples: Samples, last: int) -> None:
        """Keep more samples. `samples`: those that follow the ones before; `last`: number of the sample after them."""
        columns = [x for x in (samples.u, samples.y, samples.forcing) if x is not None]
        n, room, filled = samples.y.shape[0], 2 * self._capacity, self._filled
        if not self._parts:
            self._parts = [np.empty((room, x.shape[1])) for x in columns]
        keep = filled if filled + n <= room else min(filled, max(self._capacity - n, 0))
        self._filled, self.last = min(keep + n, room), last
        for part, x in zip(self._parts, columns, strict=True):
            if keep < filled:
                part[:keep] = part[filled - keep : filled]
            part[keep : self._filled] = x[-room:]

    def clear(self) -> None:
        """Forget all samples, as after a gap."""
        self._filled = 0

    def since(self, first: int) -> Samples | None:
        """Return samples from number `first` on, views that the next `add` may overwrite; None where they are not
        there.
        """
        if not self.first <= first < self.last:
            return None
        u, y, *more = (x[first - self.first : self._filled] for x in self._parts)
        return Samples(u=u, y=y, forcing=more[0] if more else None)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evidence:
    """One block's evidence. All tracked numbers are in units of their own magnitude, so that they are of order one."""

    names: tuple[str, ...]  # the tracked numbers: physical parameters, then offsets and the like
    at: Array  # (p,), where the predictor was linearised
    J: Array  # (p, p), upper triangle; J^T J is the information of the block
    r: Array  # (p,), explainable part of the weighted innovations at `at`, with unit covariance
    # squared length of what no change of q explains: chi-squared with `freedom` degrees if the model is right
    rest: float
    n_samples: int  # samples used, and outputs of each
    n_outputs: int
    first: int  # sample numbers of the stream: the block is first <= k < last
    last: int

    @property
    def freedom(self) -> int:
        """Degrees of freedom of `rest`."""
        return max(self.n_samples * self.n_outputs - self.r.size, 0)

    def residual(self, q: Array) -> Array:
        """Return r + J (q - at), shape (p,), unit covariance if `q` (p,) is the truth."""
        return np.asarray(self.r + self.J @ (q - self.at))

    def loss(self, q: Array) -> float:
        """Return the sum of squared weighted innovations at `q`, to second order around `at`."""
        left = self.residual(q)
        return float(self.rest + left @ left)


class EvidenceSum:
    """Evidence of several blocks folded into one triangle `T` (p, p + 1), [J r], at the point `at` (p,), with sums."""

    __slots__ = ("T", "_rows", "at", "blocks", "freedom", "rest")

    def __init__(self, p: int) -> None:
        self.T, self._rows = np.zeros((p, p + 1)), np.zeros((p + 1, p))
        self.clear(np.zeros(p))

    def clear(self, at: Array) -> None:
        """Begin again at a point."""
        self.T[:] = 0.0
        self.at, self.rest, self.freedom, self.blocks = at, 0.0, 0, 0

    def move(self, at: Array) -> None:
        """Go to another point."""
        self.T[:, -1] += self.T[:, :-1] @ (at - self.at)
        self.at = at

    def add(self, evidence: Evidence) -> bool:
        """Take in a block; do nothing and return False if it is not finite."""
        rows = self._rows
        rows[:-1], rows[-1] = evidence.J.T, evidence.residual(self.at)
        if not math.isfinite(rows[-1].sum()):
            return False
        fold(self.T, rows, self.at.size, 1)
        self.rest += evidence.rest
        self.freedom += evidence.freedom
        self.blocks += 1
        return True


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearisation:
    """x+ = M [x; inputs at their lags; y; 1; unbalance forcing], and dM/dq."""

    at: Array  # (p,), the point
    M: Array  # (n, n_l)
    D: Array  # (n_l, n, p), derivative of M by the tracked numbers, first by column
    C: Array  # (n_outputs, n)
    gain: Array  # (n, n_outputs), starts the next solution of the Riccati equation
    memory: float  # samples after which the predictor has forgotten all but a part 1/e of its state


def linearise(numbers: TrackedNumbers, q: Array, near: Array | None = None) -> Linearisation | None:
    """Assemble the predictor and its derivatives at `q` (p,), None where none is stable or the plant not physical;
    `near` (n, n_outputs): predictor gain of a point near this one.
    """
    problem = numbers.problem
    with one_thread():  # matrices of a few rows, and the next block waits
        assembled = assemble(problem, numbers.vector(q), near=near)
    if assembled is None:
        return None
    n, count = assembled.x0.size, problem.slices["initial"].start
    M, dM = assembled.M, assembled.dM[:, :, :count]
    if numbers.synchronous:
        force = problem.model.disturbances.index("force")
        a, b = q[count:]
        M = np.hstack([M, a * assembled.E[:, force, None], b * assembled.E[:, force, None]])
        wide = np.zeros((n, M.shape[1], count + 2))
        wide[:, :-2, :count] = dM
        wide[:, -2, :count], wide[:, -1, :count] = (
            a * assembled.dE[:, force, :count],
            b * assembled.dE[:, force, :count],
        )
        wide[:, -2, count], wide[:, -1, count + 1] = assembled.E[:, force], assembled.E[:, force]
        dM = wide
    return Linearisation(
        at=q.copy(),
        M=np.ascontiguousarray(M),
        D=np.ascontiguousarray(np.moveaxis(dM, 0, 1)),
        C=assembled.C,
        gain=assembled.gain,
        memory=memory_of(M[:, :n], colours_of(problem)),
    )


SETTLING = 10.0  # memories of the predictor until what it did not know at a restart is below the noise
_ROOM = 128  # samples whose rows are folded at once: they stay in the first-level cache


class EvidenceStream:
    """The predictor of a bench, running from `at`; `block`: samples of one evidence; `sample`: number of the next
    sample of the stream; `latest`: of the last block.
    """

    def __init__(self, numbers: TrackedNumbers, at: Linearisation, block: int) -> None:
        problem, p = numbers.problem, numbers.start.size
        n, n_u, n_y = len(problem.model.states), len(problem.model.inputs), len(problem.model.outputs)
        self.numbers, self.at, self.sample = numbers, at, 0
        self._scale = np.stack([numbers.point, np.concatenate([problem.scales.input, problem.scales.output])])
        # a lag before now belongs to delays below zero, which no predictor has: its columns are zero
        self._lags = np.array([max(problem.delay + lag, 0) for lag in problem.lags], dtype=np.int64)
        self._history = np.zeros((int(self._lags.max()) + 1, n_u))
        self._s = np.zeros((n, p + 1))  # sensitivities, and in the last column the state
        self._rows = np.zeros((p + 1, min(block, _ROOM) * n_y))
        self._triangle = np.zeros((p + 1, p + 1))
        self._counts = np.zeros(6, dtype=np.int64)
        self._counts[4] = block
        self._nothing = np.zeros((0, 2 if numbers.synchronous else 0))
        root = np.linalg.cholesky(numbers.innovation_covariance)
        self._W, self._unit = np.linalg.inv(root), root * problem.scales.output[:, None]
        self._M, self._fresh = self._stacked(at), True
        self._scratch = np.zeros(self._M.shape[1]), np.zeros((n + n_y, p + 1))
        self.latest: Evidence | None = None

    def _stacked(self, at: Linearisation) -> Array:
        """Return what gives the next state and, below it, the weighted innovations, shape (n + n_outputs, n_l)."""
        n, (n_y, _) = at.C.shape[1], self._W.shape
        first = n + self._lags.size * self.numbers.problem.u.shape[1]
        errors = np.zeros((n_y, at.M.shape[1]))
        errors[:, :n], errors[:, first : first + n_y] = -self._W @ at.C, self._W
        return np.vstack([at.M, errors])

    def relinearise(self, at: Linearisation) -> None:
        """Go on with the predictor of another point; the state moves along to first order."""
        self._s[:, -1] += self._s[:, :-1] @ (at.at - self.at.at)
        self.at, self._M = at, self._stacked(at)

    def restart(self, sample: int) -> None:
        """Begin again after a gap at number `sample`: signals before it are forgotten, a begun block is dropped."""
        self.sample, self._fresh = sample, True
        self._triangle[:] = 0.0
        self._counts[1:3] = 0

    @property
    def settling(self) -> int:
        """Samples that are still needed to settle."""
        return int(self._counts[3])

    @property
    def settling_samples(self) -> int:
        """Samples that settling takes after a restart."""
        return int(self._lags.max()) + int(np.ceil(SETTLING * self.at.memory))

    def feed(self, samples: Samples) -> tuple[int, Array, Evidence | None]:
        """Take samples until a block is complete, they are used up, or one is not finite: `n` taken, without evidence
        if it is that; `errors` (used, n_outputs), innovations, SI; `evidence` of the completed block.
        """
        u, y = samples.u, samples.y
        if self._fresh and y.shape[0]:
            self._begin(u, y)
        errors = np.empty_like(y)
        if samples.forcing is None and self._nothing.shape[0] != y.shape[0]:
            self._nothing = np.zeros((y.shape[0], self._nothing.shape[1]))
        forcing = self._nothing if samples.forcing is None else samples.forcing
        n, counts, full = 0, self._counts, True
        while full and counts[2] < counts[4]:
            n = advance(
                n, u, y, forcing, self._M, self.at.D, self._scale, self._lags, self._history, self._s, self._rows,
                counts, self._unit, errors, *self._scratch,
            )  # fmt: skip
            full = counts[1] + y.shape[1] > self._rows.shape[1]
            if full or counts[2] == counts[4]:
                self._fold()
        self.sample += n
        return n, errors[:n], self._evidence() if counts[2] == counts[4] else None

    def close(self, block: int) -> Evidence | None:
        """Return the evidence since the last block, None if there was only settling, and go on with blocks of `block`
        samples.
        """
        evidence = None
        if self._counts[2]:
            self._fold()
            evidence = self._evidence()
        self._counts[4] = block
        return evidence

    def _fold(self) -> None:
        n = int(self._counts[1])
        fold(self._triangle, self._rows, n, n)
        self._counts[1] = 0

    def _begin(self, u: Array, y: Array) -> None:
        """Start from what is measured; what is not settles."""
        model, outputs = self.numbers.problem.model, self.numbers.problem.model.outputs
        if not (np.all(np.isfinite(u[0])) and np.all(np.isfinite(y[0]))):
            return
        n_u = u.shape[1]
        self._history[:] = (u[0] - self._scale[0, :n_u]) / self._scale[1, :n_u]
        measured = (y[0] - self._scale[0, n_u:]) / self._scale[1, n_u:]
        # outputs are states in scaled units of their own: C picks and scales them
        self._s[:] = 0.0
        for j, state in enumerate(model.states):
            row = outputs.index(state) if state in outputs else -1
            self._s[j, -1] = measured[row] / self.at.C[row, j] if row >= 0 else 0.0
        self._counts[3] = self.settling_samples
        self._fresh = False

    def _evidence(self) -> Evidence:
        p, n_y = self._s.shape[1] - 1, self._W.shape[0]
        evidence = Evidence(
            names=self.numbers.names,
            at=self.at.at,
            J=self._triangle[:p, :p].copy(),
            r=self._triangle[:p, p].copy(),
            rest=float(self._triangle[p, p] ** 2),
            n_samples=int(self._counts[2]),
            n_outputs=n_y,
            first=self.sample - int(self._counts[2]),
            last=self.sample,
        )
        self._triangle[:] = 0.0
        self._counts[2] = 0
        self.latest = evidence
        return evidence
