"""The Kalman filter of the tracked numbers: random walks, seen through the evidence of one block after another.

Square-root covariance, Joseph's form (Bierman 1977, ch. 5); numbers that are held enter with their uncertainty but are
not moved (Schmidt). The covariance is symmetric and positive definite by construction.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.track.evidence import Evidence

Array = NDArray[np.float64]


class ParameterFilter:
    """Estimate and covariance of the tracked numbers.

    Parameters
    ----------
    start : ndarray, shape (p,)
    covariance : ndarray, shape (p, p)
        Positive definite.

    Attributes
    ----------
    q : ndarray, shape (p,)
    active : ndarray of bool, shape (p,)
        Which numbers evidence may move, and which may walk.
    """

    def __init__(self, start: Array, covariance: Array) -> None:
        from ambid.track.physical._kernels import absorb, spread

        self.q = start.copy()
        size = np.sqrt(np.diag(covariance))
        self._S = np.ascontiguousarray(size[:, None] * np.linalg.cholesky(covariance / np.outer(size, size)))
        self.active = np.ones(start.size, dtype=np.bool_)
        self._absorb, self._spread = absorb, spread

    @property
    def covariance(self) -> Array:
        """Covariance of `q`, shape (p, p)."""
        return np.asarray(self._S @ self._S.T)

    @property
    def sd(self) -> Array:
        """Standard deviations of `q`, shape (p,)."""
        return np.asarray(np.sqrt(np.einsum("ij,ij->i", self._S, self._S)))

    def walk(self, step: Array) -> None:
        """Let the active numbers walk.

        Parameters
        ----------
        step : ndarray, shape (p,)
            Standard deviations of the steps.
        """
        self._spread(self._S, np.where(self.active, step, 0.0))

    def absorb(self, evidence: Evidence, noise: float = 1.0) -> float:
        """Take in a block's evidence.

        Parameters
        ----------
        evidence : Evidence
        noise : float
            Variance of its residual: above 1 where the model explains the record only in part.

        Returns
        -------
        float
            Squared length of the residual before, normalised: chi-squared with p degrees of freedom if the model and
            the covariance are right.
        """
        rho = evidence.residual(self.q)
        return float(self._absorb(self.q, self._S, evidence.J, rho, self.active, noise))

    def widen(self, place: int, sd: float) -> None:
        """Forget what is known of one number, but not the others: it may have moved by about `sd`.

        Parameters
        ----------
        place : int
        sd : float
        """
        step = np.zeros(self.q.size)
        step[place] = sd
        self._spread(self._S, step)

    def set(self, q: Array, covariance: Array) -> None:
        """Go on from other numbers.

        Parameters
        ----------
        q : ndarray, shape (p,)
        covariance : ndarray, shape (p, p)
        """
        fresh = ParameterFilter(q, covariance)
        self.q, self._S = fresh.q, fresh._S

    def copy(self) -> ParameterFilter:
        """Return an independent filter in the same state.

        Returns
        -------
        ParameterFilter
        """
        other = ParameterFilter.__new__(ParameterFilter)
        other.q, other._S, other.active = self.q.copy(), self._S.copy(), self.active.copy()
        other._absorb, other._spread = self._absorb, self._spread
        return other
