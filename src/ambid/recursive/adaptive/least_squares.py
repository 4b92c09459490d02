"""Recursive least squares for y = φᵀθ + e in U-D factors, with what is forgotten chosen by the user.

Minimises the sum of squared errors over past samples, older ones with less weight, and the distance from the start.
Every sample costs O(p²) and nothing is inverted (Bierman 1977, ch. V; Ljung & Söderström 1983, sec. 6.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.recursive.adaptive._recursion import (
    VAGUE,
    Factored,
    count,
    covariance_of,
    forgetting_factor,
    numbers,
    positive,
    product,
)

Forgetting = Literal["none", "exponential", "directional"]

_NOISE_MEMORIES = 10  # memory of the noise variance, in memories of the estimate
_SETTLES = 0.25  # of the memory of the noise variance, after which it is good enough to be the unit of the covariance
_LOOKS = 32  # most samples between two looks at the limit


class RecursiveLeastSquares(Factored):
    """Recursive least squares, a `RecursiveEstimator`.

    What is forgotten:

    - ``"none"``: nothing. The estimate is that of batch least squares with the same prior. With `walk`, it is the
      Kalman filter of coefficients that walk at random.
    - ``"exponential"``: a sample k samples ago weighs factor**k. Where the regressor lacks a direction, P grows there
      (wind-up) until the mean of P_ii over its prior is `limit`; forgetting is then slowed for all directions so far
      that it stays there: coefficients that are still excited are tracked more slowly meanwhile.
    - ``"directional"``: only the part of the information that the present regressor meets is forgotten: without
      excitation nothing is (Cao & Schwartz 2000, Automatica 36, 1725). Under the same `limit`.

    The covariance is that of the estimate's error for coefficients that do not move, e white and independent of past
    regressors: σ²C with the error's own recursion C = (I - Kφᵀ) C (I - Kφᵀ)ᵀ + K Kᵀ. With forgetting it is less than
    σ²P, by 1 + factor in the stationary state. The lag behind moving coefficients is not in it, except with `walk`,
    where C = P.

    Where something is forgotten, every sample counts with the σ² of its own time, once σ² is known (after a memory): a
    calm makes no coefficient surer.

    σ² is tracked on errors e over 1 + φᵀCφ, each with the weight of what it says of the estimate: silence does not
    lower it. Biased like all least squares where e is coloured and correlated with the regressor, as under feedback
    or for noisy regressors: then take `RecursiveInstrumentalVariables`.

    Numbers: factors U and D > 0 are updated without subtraction of D, so that P stays positive definite whatever is
    rounded; forgetting divides D and damps old rounding errors; the limit bounds P from above, the data from below.
    With `walk` nothing bounds P from above: unseen coefficients walk on, by n `walk` in n samples, and P says so.

    Parameters
    ----------
    names : sequence of str, or int
        Names of the p coefficients, or p.
    start : array_like, shape (p,), optional
        Estimate to begin with; zero if not given.
    prior : array_like, shape (), (p,) or (p, p), optional
        Covariance of the start's error **over the variance of e** (P₀), in the coefficients' units. If not given,
        nothing is known of the coefficients, whatever the units of the signals: the start has no weight.
    forgetting : {"none", "exponential", "directional"}, optional
        Exponential if not given but `factor` or `memory` is.
    factor : float, optional
        Of forgetting, 0 < factor < 1.
    memory : float, optional
        The same as a time constant in samples, 1 / (1 - factor).
    limit : float
        Of forgetting: largest mean of P_ii over its prior; over 1e9 times the best P_ii so far where no prior is given.
        Without effect where nothing is forgotten, so also with `walk`.
    reset_every : int, optional
        P and C are set back to the prior after so many samples, the estimate kept.
    walk : array_like, shape () or (p,), optional
        Variance of one sample's step of each coefficient over the variance of e.
    noise_sd : float, optional
        Standard deviation of e, where known; else it is tracked.
    noise_start : float
        Taken for it until the data have shown it.
    noise_memory : float, optional
        Memory of the tracked variance, samples; ten times that of the estimate if not given.

    Attributes
    ----------
    covariance : ndarray, shape (p, p)
        Of the estimate's error, see above.
    P : ndarray, shape (p, p)
        The matrix of the recursion.

    Raises
    ------
    EstimationError
        If a setting is out of its range, or two of them exclude each other.
    """

    def __init__(
        self,
        names: Sequence[str] | int,
        *,
        start: ArrayLike | None = None,
        prior: ArrayLike | None = None,
        forgetting: Forgetting | None = None,
        factor: float | None = None,
        memory: float | None = None,
        limit: float = 100.0,
        reset_every: int | None = None,
        walk: ArrayLike | None = None,
        noise_sd: float | None = None,
        noise_start: float = 1.0,
        noise_memory: float | None = None,
    ) -> None:
        kept, kind = _factor(forgetting, factor, memory), forgetting
        if kept < 1.0 and walk is not None:
            raise EstimationError("walk and forgetting are two models of one thing. Give one of them")
        directional = kind == "directional"
        self._kernel = "kalman" if directional or walk is not None else "least_squares"
        super().__init__(names, start, noise_sd, noise_start)
        s, p, at = self._s, len(self._names), self._at
        s[at.KIND] = at.DIRECTIONAL if directional else at.LEAST_SQUARES if walk is None else at.WALK
        s[at.FACTOR] = s[at.FACTOR_NOW] = kept
        s[at.MEMORY] = 1.0 / (1.0 - kept) if kept < 1.0 else np.inf
        s[at.EVERY] = max(1.0, min(_LOOKS, np.floor(s[at.MEMORY] / 2)))
        s[at.LIMIT], s[at.VAGUE] = positive("limit", limit), float(prior is None)
        s[at.RESET_EVERY] = 0 if reset_every is None else count("reset_every", reset_every)
        s[at.TYPICAL], s[at.NOW] = 0.1 * p, 1.0
        settle = _NOISE_MEMORIES * s[at.MEMORY] if noise_memory is None else positive("noise_memory", noise_memory)
        s[at.NOISE_RATE] = 1.0 / settle
        s[at.SETTLED] = np.inf if noise_sd is not None else min(s[at.MEMORY], _SETTLES * settle)
        steps = numbers("walk", 0.0 if walk is None else walk, p)
        if (steps < 0).any():
            raise EstimationError(f"walk is {walk!r}; variances are not negative")
        s[at.HEAD + p + 4 * (p + p * p) :][:p] = steps
        self._set_prior(covariance_of("prior", VAGUE if prior is None else prior, p))
        self._begin()

    @property
    def P(self) -> Array:
        """A copy of the matrix of the recursion, shape (p, p): covariance over σ² without forgetting."""
        return product(*self._factors(0))

    @property
    def covariance(self) -> Array:
        """A copy of the covariance of the estimate's error, shape (p, p)."""
        s, at = self._s, self._at
        unit = float(s[at.UNIT] or self.noise_variance)
        if s[at.KIND] == at.DIRECTIONAL:
            return unit * product(*self._factors(1))
        if s[at.FACTOR] == 1.0:
            return self.noise_variance * self.P
        E, W = self._factors(1)
        half = (np.sqrt(E)[:, None] * W) @ self.P
        return np.asarray(unit * (half.T @ half))

    def reset(self, prior: ArrayLike | None = None) -> None:
        """Say that the coefficients may have moved: P and C become the prior, the estimate stays.

        Parameters
        ----------
        prior : array_like, shape (), (p,) or (p, p), optional
            Over the variance of e; the one given at the start if none.

        Raises
        ------
        EstimationError
            If it is not positive definite.
        """
        if prior is not None:
            kept = self._s[self._at_start()].copy()
            self._set_prior(covariance_of("prior", prior, len(self._names)))
            self._begin()
            self._s[self._at_start()] = kept
        else:
            self._begin()

    def _set_prior(self, prior: Array) -> None:
        """Keep P₀ and what its companion begins with: C, or the information of squared weights."""
        p = len(self._names)
        scale = np.sqrt(np.diag(prior))
        inverse = np.linalg.inv(prior / np.outer(scale, scale)) / np.outer(scale, scale)
        self._set_factors(2, prior)
        self._set_factors(3, prior if self._s[self._at.KIND] == self._at.DIRECTIONAL else (inverse + inverse.T) / 2)
        if not self._s[self._at.USED]:
            self._s[self._at.HEAD + 2 * p + 4 * (p + p * p) :][:p] = np.diag(prior)

    def _at_start(self) -> slice:
        p = len(self._names)
        first = self._at.HEAD + p + 2 * (p + p * p)
        return slice(first, first + 2 * (p + p * p))

    def _begin(self) -> None:
        s, at, start = self._s, self._at, self._at_start()
        s[at.HEAD + len(self._names) : start.start] = s[start]
        if s[at.UNIT]:
            s[at.UNIT] = max(s[at.UNIT], self.noise_variance)
            s[at.NOW] = at.noise_of_now(s)


def _factor(forgetting: Forgetting | None, factor: float | None, memory: float | None) -> float:
    if forgetting not in (None, "none", "exponential", "directional"):
        raise EstimationError(f"forgetting is {forgetting!r}; it is none, exponential or directional")
    kept = forgetting_factor(factor, memory)
    if kept < 1.0 and forgetting == "none":
        raise EstimationError("forgetting is none; leave factor and memory out")
    if kept == 1.0 and forgetting in ("exponential", "directional"):
        raise EstimationError(f"forgetting is {forgetting}; say how fast, by factor or memory")
    return kept
