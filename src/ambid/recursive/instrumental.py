"""Recursive instrumental variables for y = φᵀθ + v: v may be coloured and in the regressor, not in the instruments ζ.

Solves Σ λ^(t-k) ζ (y - φᵀθ) = 0, with more instruments than coefficients in the least squares sense of two-stage
least squares. The rows [ζᵀ φᵀ y] are rotated into a triangle, so nothing is squared and no unsymmetric P, which can
pass through infinity, is carried (Söderström & Stoica 1983, ch. 4 and 8).
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.recursive.estimator import count, forgetting_factor, numbers, positive
from ambid.recursive.regression import ENOUGH, VAGUE, Recursion, coefficient_names
from ambid.recursive.square_root import root_of

_NOISE_MEMORIES = 10
_LOOKS = 32


class RecursiveInstrumentalVariables(Recursion):
    """Recursive instrumental variables, a `RecursiveEstimator` whose inputs are [φ, ζ].

    Consistent where ζ is uncorrelated with v and correlated with φ: with an external reference of a loop, past
    inputs in open loop. Instruments that say little of the regressor give a large covariance.

    The covariance is that of the estimate's error for coefficients that do not move, A N Aᵀ with
    θ̂ = A Σ λ^(t-k) ζ y and N the covariance of Σ λ^(t-k) ζ v: the long-run covariance of ζ v (Bartlett's weights over
    `correlation` samples; Newey & West 1987), tracked with ten times the memory of the estimate, times the sum of
    squared weights. So v may be coloured. The lag behind moving coefficients is not in it. While instruments are
    silent the information is forgotten until the mean of the variances over their prior is `limit`.

    Parameters
    ----------
    names : sequence of str, or int
        Names of the p coefficients, or p.
    n_instruments : int, optional
        m, p or more; p if not given.
    start : array_like, shape (p,), optional
        Estimate to begin with; zero if not given.
    prior : array_like, shape () or (p,), optional
        Variances of the start's error over the variance of v, in the coefficients' units. If not given, nothing is
        known of the coefficients, whatever the units of the signals: the start has no weight.
    instrument_size : array_like, shape () or (m,), optional
        Usual size of the instruments: a prior that is given counts like one sample of that size; 1 if not given.
    factor : float, optional
        Of forgetting, 0 < factor < 1; nothing is forgotten if neither it nor `memory` is given.
    memory : float, optional
        The same as a time constant in samples, 1 / (1 - factor).
    limit : float
        Of the wind-up, see above; over 1e9 times the best variances so far where no prior is given.
    correlation : int
        Samples; several times the time over which v is correlated. 1 for white v.
    noise_start : float
        Standard deviation of v until the data have shown it.

    Attributes
    ----------
    names : tuple of str
    estimate : ndarray, shape (p,)
    covariance : ndarray, shape (p, p)
    n_used, n_rejected : int
    n_singular : int
        Samples after which the instruments did not determine the coefficients, and the estimate stayed.
    noise_variance : float
        Of v.

    Raises
    ------
    EstimationError
        If a setting is out of its range.
    """

    _kernel = "instrumental"

    def __init__(
        self,
        names: Sequence[str] | int,
        *,
        n_instruments: int | None = None,
        start: ArrayLike | None = None,
        prior: ArrayLike | None = None,
        instrument_size: ArrayLike | None = None,
        factor: float | None = None,
        memory: float | None = None,
        limit: float = 100.0,
        correlation: int = 20,
        noise_start: float = 1.0,
    ) -> None:
        found = coefficient_names(names)
        p = len(found)
        m = p if n_instruments is None else int(n_instruments)
        if m < p:
            raise EstimationError(f"{m} instruments do not determine {p} coefficients. Give {p} or more")
        lags = count("correlation", correlation)
        size = p + m * (m + p + 1) + p * p + m * m + lags * m + m + p + m + m * (p + 1) + m + 3 * p + 1
        super().__init__(found, p + m, size, start, None, noise_start)
        s, at = self._s, self._at
        s[at.INSTRUMENTS], s[at.LAGS] = m, lags
        s[at.FACTOR] = s[at.FACTOR_NOW] = forgetting_factor(factor, memory)
        s[at.MEMORY] = 1.0 / (1.0 - s[at.FACTOR]) if s[at.FACTOR] < 1 else np.inf
        s[at.EVERY] = max(1.0, min(_LOOKS, np.floor(s[at.MEMORY] / 2)))
        s[at.LIMIT] = positive("limit", limit)
        s[at.NOISE_RATE] = 1.0 / (_NOISE_MEMORIES * s[at.MEMORY])
        s[at.PRIOR_LEFT] = 1.0
        s[at.VAGUE] = float(prior is None)
        if instrument_size is None:
            instrument_size = 1.0 / np.sqrt(VAGUE) if prior is None else 1.0
        self._begin(numbers("prior", VAGUE if prior is None else prior, p), instrument_size)

    def _begin(self, prior: Array, instrument_size: ArrayLike) -> None:
        """Enter the prior as samples whose instruments are the coefficients' own directions."""
        p, m = prior.size, self._m
        size = numbers("instrument_size", instrument_size, m)
        if (prior <= 0).any() or (size <= 0).any():
            raise EstimationError("prior and instrument_size must be positive")
        part = self._parts()
        part["prior"][...] = prior
        part["size"][...] = size
        T = np.diag(1 / np.sqrt(prior))
        part["T"][...] = T
        part["R"][:, :m] = np.diag(size)
        part["R"][:p, m:-1] = T
        part["R"][:p, -1] = T @ part["estimate"]

    @property
    def _m(self) -> int:
        return int(self._s[self._at.INSTRUMENTS])

    def _parts(self) -> dict[str, Array]:
        """Views of the state by name."""
        p, m, lags = len(self._names), self._m, int(self._s[self._at.LAGS])
        shapes: dict[str, tuple[int, ...]] = {
            "estimate": (p,),
            "R": (m, m + p + 1),
            "T": (p, p),
            "omega": (m, m),
            "ring": (lags, m),
            "total": (m,),
            "prior": (p,),
            "size": (m,),
        }
        found, first = {}, self._at.HEAD
        for name, shape in shapes.items():
            n = int(np.prod(shape))
            found[name] = self._s[first : first + n].reshape(shape)
            first += n
        return found

    def _kernels(self) -> ModuleType:
        from ambid.recursive import instrumental_kernels

        return instrumental_kernels

    @property
    def n_singular(self) -> int:
        """Samples after which the estimate stayed because the instruments did not determine it."""
        return int(self._s[self._at.SINGULAR])

    def scale_instruments(self, first: int, factor: float) -> None:
        """Count what the first instruments have told as if they had been larger; the estimate stays.

        Parameters
        ----------
        first : int
            How many.
        factor : float
            By which they are larger.
        """
        part, by = self._parts(), np.ones(self._m)
        by[:first] = factor
        part["R"][:, : self._m] *= by
        part["omega"][...] *= np.outer(by, by)
        for name in ("ring", "total", "size"):
            part[name][...] *= by

    @property
    def covariance(self) -> Array:
        """A copy of the covariance of the estimate's error, shape (p, p)."""
        from scipy.linalg import solve_triangular

        part, s, m, at = self._parts(), self._s, self._m, self._at
        N = np.diag(s[at.PRIOR_LEFT] * self.noise_variance * part["size"] ** 2)
        if s[at.NOISE_WEIGHT] >= ENOUGH:
            N = N + part["omega"] * (s[at.SUM_OF_SQUARES] / s[at.NOISE_WEIGHT])
        half = solve_triangular(part["R"][:, :m], _root(N), trans="T")
        Q, T = np.linalg.qr(part["R"][:, m:-1])  # no singular value is cut: what the data do not see is vague
        B = solve_triangular(T, Q.T @ half)
        return np.asarray(B @ B.T)


def _root(N: Array) -> Array:
    """Return a square root of N; what rounding made of its smallest eigenvalues does not count."""
    scale = np.sqrt(np.diag(N))
    return np.asarray(scale[:, None] * root_of(N / np.outer(scale, scale), floor=float(np.finfo(float).eps)))
