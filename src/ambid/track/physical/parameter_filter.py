"""The Kalman filter of the tracked numbers: random walks, seen through the evidence of one block after another.

Square-root covariance, Joseph's form (Bierman 1977, ch. 5); numbers that are held enter with their uncertainty but are
not moved (Schmidt). The covariance is symmetric and positive definite by construction.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.track.evidence import Evidence

Flags = NDArray[np.bool_]


class ParameterFilter:
    """Estimate and covariance of the tracked numbers.

    `start`: (p,); `covariance`: (p, p), positive definite; `positive`: (p,), numbers that are positive and stay so;
    default none.

    `q`: (p,); `active`: (p,), which numbers evidence may move, and which may walk; `n_shortened`: steps that were
    shortened because a positive number would have lost more than half of itself.
    """

    def __init__(self, start: Array, covariance: Array, positive: Flags | None = None) -> None:
        from ambid.track.physical._kernels import absorb, far, spread

        self.q = start.copy()
        size = np.sqrt(np.diag(covariance))
        self._S = np.ascontiguousarray(size[:, None] * np.linalg.cholesky(covariance / np.outer(size, size)))
        self.active = np.ones(start.size, dtype=np.bool_)
        self._positive = np.zeros(start.size, dtype=np.bool_) if positive is None else positive
        self._absorb, self._spread, self._far = absorb, spread, far
        self.n_shortened = 0

    @property
    def covariance(self) -> Array:
        """Covariance of `q`, shape (p, p)."""
        return np.asarray(self._S @ self._S.T)

    @property
    def sd(self) -> Array:
        """Standard deviations of `q`, shape (p,)."""
        return np.asarray(np.sqrt(np.einsum("ij,ij->i", self._S, self._S)))

    def walk(self, variance: Array, time: float = 1.0) -> None:
        """Let the active numbers walk.

        `variance`: (p,), of the walks, per second; `time`: s.
        """
        self._spread(self._S, variance, self.active, time)

    def absorb(self, evidence: Evidence, noise: float = 1.0) -> float:
        """Take in a block's evidence.

        Returns squared length of the residual before, normalised: chi-squared with p degrees of freedom if the model
        and the covariance are right.
        """
        misfit, part = self._absorb(
            self.q, self._S, evidence.J, evidence.r, evidence.at, self.active, self._positive, noise
        )
        self.n_shortened += part < 1.0
        return float(misfit)

    def far(self, at: Array, J: Array, curved: Array, most: float) -> bool:
        """Return whether the estimate has left the neighbourhood of a point.

        `at`: (p,); `J`: (p, p), upper triangle of a block's evidence; `curved`: (p,), squared moves over standard
        deviations that are too much; `most`: |J (q - at)|^2 that is too much.
        """
        return bool(self._far(self.q, at, J, self._S, curved, most))

    def widen(self, place: int, sd: float) -> None:
        """Forget what is known of one number, but not the others: it may have moved by about `sd`."""
        variance = np.zeros(self.q.size)
        variance[place] = sd * sd
        self._spread(self._S, variance, np.ones_like(self.active), 1.0)

    def set(self, q: Array, covariance: Array) -> None:
        """Go on from other numbers.

        `q`: (p,); `covariance`: (p, p).
        """
        fresh = ParameterFilter(q, covariance)
        self.q, self._S = fresh.q, fresh._S

    def copy(self) -> ParameterFilter:
        """Return an independent filter in the same state."""
        other = ParameterFilter.__new__(ParameterFilter)
        other.__dict__.update(self.__dict__)
        other.q, other._S, other.active = self.q.copy(), self._S.copy(), self.active.copy()
        return other

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k not in ("_absorb", "_spread", "_far")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        from ambid.track.physical._kernels import absorb, far, spread

        self.__dict__.update(state)
        self._absorb, self._spread, self._far = absorb, spread, far
