"""From samples to evidence: the predictor runs along the stream and every block of samples leaves a triangle."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.track.evidence import Evidence
from ambid.track.physical.linearisation import Linearisation
from ambid.track.physical.numbers import TrackedNumbers
from ambid.track.physical.signals import Samples

SETTLING = 10.0  # memories of the predictor until what it did not know at a restart is below the noise
_ROOM = 128  # samples whose rows are folded at once: they stay in the first-level cache


class EvidenceStream:
    """The predictor of a bench, running.

    `at`: where the predictor starts; `block`: samples of one evidence.

    `sample`: number of the next sample of the stream; `latest`: of the last block.
    """

    def __init__(self, numbers: TrackedNumbers, at: Linearisation, block: int) -> None:
        from ambid.track.physical._kernels import advance

        problem, p = numbers.problem, numbers.start.size
        n, n_u, n_y = len(problem.model.states), len(problem.model.inputs), len(problem.model.outputs)
        self.numbers, self.at, self.sample = numbers, at, 0
        self._advance: Callable[..., int] = advance
        self._scale = np.stack([numbers.point, np.concatenate([problem.scales.input, problem.scales.output])])
        # a lag before now belongs to delays below zero, which no predictor has: its columns are zero
        self._lags = np.array([max(problem.delay + lag, 0) for lag in problem.lags], dtype=np.int64)
        self._history = np.zeros((int(self._lags.max()) + 1, n_u))
        self._x, self._s = np.zeros(n), np.zeros((n, p))
        self._rows = np.zeros((p + 1, min(block, _ROOM) * n_y))
        self._triangle = np.zeros((p + 1, p + 1))
        self._counts = np.zeros(6, dtype=np.int64)
        self._counts[4] = block
        self._nothing = np.zeros((0, 2 if numbers.synchronous else 0))
        self._W = np.ascontiguousarray(np.linalg.inv(np.linalg.cholesky(numbers.innovation_covariance)))
        self._fresh = True
        self.latest: Evidence | None = None

    def relinearise(self, at: Linearisation) -> None:
        """Go on with the predictor of another point; the state moves along to first order."""
        self._x += self._s @ (at.at - self.at.at)
        self.at = at

    def restart(self, sample: int) -> None:
        """Begin anew after a gap: signals before it are forgotten, and a part of the block that was begun is
        dropped.

        `sample`: number of the next sample.
        """
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
        """Take samples until a block is complete, they are used up, or one is not finite.

        Returns `used`: samples taken; fewer than given, without evidence, where the next one is not finite; `errors`:
        (used, n_outputs), innovations in scaled output units; `evidence`: of the block that these samples complete.
        """
        u, y = samples.u, samples.y
        if self._fresh and y.shape[0]:
            self._begin(u, y)
        errors = np.empty_like(y)
        forcing = self._nothing_like(y.shape[0]) if samples.forcing is None else samples.forcing
        used = self._advance(
            u, y, forcing, self.at.M, self.at.D, self.at.C, self._W, self._scale, self._lags, self._history,
            self._x, self._s, self._rows, self._triangle, self._counts, errors,
        )  # fmt: skip
        self.sample += used
        return used, errors[:used], self._evidence() if self._counts[2] == self._counts[4] else None

    def close(self, block: int) -> Evidence | None:
        """Return the evidence of the samples since the last block, and go on with blocks of another length.

        `block`: samples of the blocks to come. Returns none where nothing but settling has happened.
        """
        from ambid.track.physical._kernels import fold

        found = None
        if self._counts[2]:
            fold(self._triangle, self._rows, int(self._counts[1]))
            self._counts[1] = 0
            found = self._evidence()
        self._counts[4] = block
        return found

    def _nothing_like(self, n: int) -> Array:
        if self._nothing.shape[0] != n:
            self._nothing = np.zeros((n, self._nothing.shape[1]))
        return self._nothing

    def _begin(self, u: Array, y: Array) -> None:
        """Start from what is measured; what is not settles."""
        model, outputs = self.numbers.problem.model, self.numbers.problem.model.outputs
        if not (np.all(np.isfinite(u[0])) and np.all(np.isfinite(y[0]))):
            return
        n_u = u.shape[1]
        self._history[:] = (u[0] - self._scale[0, :n_u]) / self._scale[1, :n_u]
        measured = (y[0] - self._scale[0, n_u:]) / self._scale[1, n_u:]
        # outputs are states in scaled units of their own: C picks and scales them
        for j, state in enumerate(model.states):
            row = outputs.index(state) if state in outputs else -1
            self._x[j] = measured[row] / self.at.C[row, j] if row >= 0 else 0.0
        self._s[:] = 0.0
        self._counts[3] = self.settling_samples
        self._fresh = False

    def _evidence(self) -> Evidence:
        p, n_y = self._s.shape[1], self._W.shape[0]
        found = Evidence(
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
        self.latest = found
        return found

    def copy(self) -> EvidenceStream:
        """Return an independent stream in the same state."""
        other = copy.copy(self)
        for name in ("_history", "_x", "_s", "_rows", "_triangle", "_counts", "_scale"):
            setattr(other, name, getattr(self, name).copy())
        return other

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k != "_advance"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        from ambid.track.physical._kernels import advance

        self.__dict__.update(state)
        self._advance = advance
