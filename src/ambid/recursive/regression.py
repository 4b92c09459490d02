"""Recursions for y = φᵀθ + e over the square-root core: least squares with forgetting (Bierman 1977, ch. V; Ljung &
Söderström 1983, sec. 6.2), LMS, NLMS, and ARX models estimated by any of these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.recursive.estimator import (
    Copied,
    RecursiveEstimator,
    as_blocks,
    covariance_of,
    factors_of,
    forgetting_factor,
    kernels,
    numbers,
    positive,
    prior_of,
    root_of_factors,
)

VAGUE = 1e22  # variance of a coefficient of which nothing is known, whatever its unit
ENOUGH = 0.5  # samples' worth of noise, before which its variance is not known
_SMALLEST_VARIANCE = 1e-200  # exact data; a variance of 0 would not be positive definite
_NOISE_MEMORIES = 10  # memory of the noise variance, in memories of the estimate
_SETTLES = 0.25  # of the memory of the noise variance, after which it is good enough to be the unit of the covariance
_NOISE_RATE = 1e-4  # of forgetting of the noise variance, a sample, for recursions along the gradient
_LOOKS = 32  # most samples between two looks at the limit
_FAR = 1e12  # variance of the start's error in units of step or of 1 / small, which have the signals' units
_FLOAT = np.dtype(np.float64)


class _Recursion(Copied):
    """State and interface of a recursion with P and a companion of it in factors; its compiled loop is the only thing
    that differs.
    """

    def __init__(self, names: Sequence[str] | int, start: ArrayLike | None, noise_sd: float | None) -> None:
        self._names = coefficient_names(names)
        p = len(self._names)
        self._shape, self._s = (p,), np.zeros(self._at.HEAD + 6 * p + 2 * p * p)
        self._s[self._at.SIZE] = p
        self._known_noise = None if noise_sd is None else positive("noise_sd", noise_sd) ** 2
        self._s[self._at.HEAD :][:p] = numbers("start", 0.0 if start is None else start, p)
        self._one = (np.zeros((1, p)), np.zeros(1))

    @property
    def _at(self) -> Any:
        """The compiled loops, which also know where the numbers lie."""
        return kernels("regression")

    def _factors(self, which: int) -> Array:
        """Return a view of the factors (p, p) of P (0) or of its companion (1)."""
        p = len(self._names)
        first = self._at.HEAD + p + which * p * p
        return self._s[first : first + p * p].reshape(p, p)

    @property
    def names(self) -> tuple[str, ...]:
        """The coefficients."""
        return self._names

    @property
    def estimate(self) -> Array:
        """A copy, shape (p,)."""
        return self._s[self._at.HEAD :][: len(self._names)].copy()

    @property
    def n_used(self) -> int:
        """Samples that were used."""
        return int(self._s[self._at.USED])

    @property
    def n_rejected(self) -> int:
        """Samples that were not, for a number that is not finite or leads beyond 1e200."""
        return int(self._s[self._at.REJECTED])

    @property
    def noise_variance(self) -> float:
        """Variance of e, in squared units of the output; 1 until half a degree of freedom has shown it."""
        if self._known_noise is not None:
            return self._known_noise
        if self._s[self._at.NOISE_WEIGHT] < ENOUGH:
            return 1.0
        return max(float(self._s[self._at.NOISE_SUM] / self._s[self._at.NOISE_WEIGHT]), _SMALLEST_VARIANCE)

    def update(self, phi: ArrayLike, y: ArrayLike) -> Array:
        """Take in a regressor (p,) and output, or a block (n_samples, p) and (n_samples,) or (n_samples, 1); return y -
        φᵀθ with the θ from before each sample, NaN where it was rejected.
        """
        if isinstance(y, float) and type(phi) is np.ndarray and phi.shape == self._shape and phi.dtype is _FLOAT:
            row, value = self._one
            row[0] = phi
            value[0] = y
            error = np.empty(1)
            self._run(row, value, error)
            return error.reshape(())
        rows, values, shape = as_blocks("regression", phi, y, self._shape[0])
        out = np.empty(values.size)
        self._run(rows, values[:, 0], out)
        return out.reshape(shape)

    def _run(self, rows: Array, y: Array, out: Array) -> None:
        kernels("regression").regress(self._s, rows, y, out)


class RecursiveLeastSquares(_Recursion):
    """Recursive least squares, a `RecursiveEstimator`: O(p²) a sample, nothing inverted.

    Without `factor` or `memory` nothing is forgotten: the estimate is that of batch least squares with the same
    prior. Else a sample k samples ago weighs factor**k. Where the regressor lacks a direction, P grows there (wind-up)
    until the mean of P_ii over its prior is `limit`; forgetting is then slowed for all directions so far that it stays
    there: coefficients that are still excited are tracked more slowly meanwhile.

    The covariance is that of the estimate's error for coefficients that do not move, e white and independent of past
    regressors: σ²C, C = (I - Kφᵀ) C (I - Kφᵀ)ᵀ + K Kᵀ; with forgetting less than σ²P, by 1 + factor in the stationary
    state. The lag behind moving coefficients is not in it. Where something is forgotten, every sample counts with the
    σ² of its own time, once known (after a memory): a calm makes no coefficient surer.

    σ² is tracked on errors e over 1 + φᵀCφ, each with the weight of what it says of the estimate: silence does not
    lower it. Biased like all least squares where e is coloured and correlated with the regressor, as under feedback or
    for noisy regressors: then take `RecursivePolynomial`. Factors U and D > 0 keep P positive definite
    whatever is rounded; the limit bounds P from above, the data from below.

    Parameters
    ----------
    names : sequence of str, or int
        Names of the p coefficients, or p.
    start : array_like, shape (p,), optional
        Estimate to begin with; zero if not given.
    prior : array_like, shape (), (p,) or (p, p), optional
        Covariance of the start's error **over the variance of e** (P₀), in the coefficients' units. If not given,
        nothing is known of the coefficients, whatever the units of the signals: the start has no weight.
    factor, memory : float, optional
        Of forgetting, 0 < factor < 1; the same as a time constant in samples, 1 / (1 - factor).
    limit : float
        Of forgetting: largest mean of P_ii over its prior; over 1e9 times the best P_ii so far where no prior is given.
        Without effect where nothing is forgotten.
    noise_sd : float, optional
        Standard deviation of e, where known; else it is tracked.

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
        factor: float | None = None,
        memory: float | None = None,
        limit: float = 100.0,
        noise_sd: float | None = None,
    ) -> None:
        super().__init__(names, start, noise_sd)
        s, p, at = self._s, len(self._names), self._at
        s[at.KIND] = at.LEAST_SQUARES
        s[at.FACTOR] = s[at.FACTOR_NOW] = forgetting_factor(factor, memory)
        s[at.MEMORY] = 1.0 / (1.0 - s[at.FACTOR]) if s[at.FACTOR] < 1.0 else np.inf
        s[at.EVERY] = max(1.0, min(_LOOKS, np.floor(s[at.MEMORY] / 2)))
        s[at.LIMIT] = positive("limit", limit)
        s[at.NOISE_RATE] = 1.0 / (_NOISE_MEMORIES * s[at.MEMORY])
        s[at.VAGUE] = float(prior is None)
        s[at.TYPICAL], s[at.NOW] = 0.1 * p, 1.0
        settle = _SETTLES * _NOISE_MEMORIES * s[at.MEMORY]
        s[at.SETTLED] = np.inf if noise_sd is not None else min(s[at.MEMORY], settle)
        prior = prior_of(VAGUE if prior is None else prior, p)
        scale = np.sqrt(np.diag(prior))
        inverse = np.linalg.inv(prior / np.outer(scale, scale)) / np.outer(scale, scale)
        self._factors(0)[:] = factors_of(prior)
        self._factors(1)[:] = factors_of((inverse + inverse.T) / 2)  # information of squared weights
        s[at.HEAD + p + 2 * p * p :][:p] = np.diag(prior)

    @property
    def P(self) -> Array:
        """A copy of the matrix of the recursion, shape (p, p): covariance over σ² without forgetting."""
        return covariance_of(self._factors(0))

    @property
    def covariance(self) -> Array:
        """A copy of the covariance of the estimate's error, shape (p, p)."""
        s, at = self._s, self._at
        unit = float(s[at.UNIT] or self.noise_variance)
        if s[at.FACTOR] == 1.0:
            return self.noise_variance * self.P
        half = root_of_factors(self._factors(1)).T @ self.P
        return np.asarray(unit * (half.T @ half))


class _Gradient(_Recursion):
    """A recursion along the regressor, with the covariance of its error; `far` is the prior where none is given."""

    def __init__(
        self,
        names: Sequence[str] | int,
        start: ArrayLike | None,
        prior: ArrayLike | None,
        noise_sd: float | None,
        far: float,
        **head: float,
    ) -> None:
        super().__init__(names, start, noise_sd)
        for name, value in {"FACTOR_NOW": 1.0, "NOISE_RATE": _NOISE_RATE, **head}.items():
            self._s[getattr(self._at, name)] = value
        self._factors(1)[:] = factors_of(prior_of(far if prior is None else prior, len(self._names)))

    @property
    def covariance(self) -> Array:
        """A copy of the covariance of the estimate's error, shape (p, p)."""
        return self.noise_variance * covariance_of(self._factors(1))


class Lms(_Gradient):
    """Least mean squares, a `RecursiveEstimator`: θ += step φ e; robust, but slow where regressors are correlated
    (Widrow & Stearns 1985, ch. 6; Haykin 2002, ch. 5 and 6).

    A sample with step φᵀφ > 1 is used with the step 1 / φᵀφ, beyond which a single step overshoots; `n_limited` counts
    them. The covariance is σ²C, C = (I - Kφᵀ) C (I - Kφᵀ)ᵀ + K Kᵀ with K = step φ, exact given the regressors, for
    coefficients that do not move and white e independent of past regressors: from the prior down to the misadjustment,
    about step σ²/2 for small steps. The lag behind moving coefficients is not in it. Biased like least squares where e
    is coloured and correlated with the regressor, as under feedback.

    Parameters
    ----------
    names : sequence of str, or int
        Names of the p coefficients, or p.
    step : float
        In units of 1 over the square of the regressor; well below 2 / E φᵀφ.
    start : array_like, shape (p,), optional
    prior : array_like, shape (), (p,) or (p, p), optional
        Covariance of the start's error over the variance of e; 1e12 step if not given.
    noise_sd : float, optional
        Standard deviation of e, where known; else it is tracked.

    Attributes
    ----------
    covariance : ndarray, shape (p, p)
        Of the estimate's error, see above.
    n_limited : int
        Samples whose step was limited.

    Raises
    ------
    EstimationError
        If a setting is out of its range.
    """

    def __init__(
        self,
        names: Sequence[str] | int,
        *,
        step: float,
        start: ArrayLike | None = None,
        prior: ArrayLike | None = None,
        noise_sd: float | None = None,
    ) -> None:
        far = _FAR * positive("step", step)
        super().__init__(names, start, prior, noise_sd, far, KIND=self._at.LMS, STEP=step)

    @property
    def n_limited(self) -> int:
        """Samples whose step was limited."""
        return int(self._s[self._at.LIMITED])


class Nlms(_Gradient):
    """Normalised least mean squares, a `RecursiveEstimator`: θ += step φ e / (small + φᵀφ).

    The covariance is as in `Lms`, with this gain. Biased like least squares where e is coloured and correlated with
    the regressor, as under feedback.

    Parameters
    ----------
    names : sequence of str, or int
        Names of the p coefficients, or p.
    step : float
        0 < step < 2; 1 meets each sample's output in full.
    small : float
        Regularisation, in squared units of the regressor: regressors below its root move little.
    start : array_like, shape (p,), optional
    prior : array_like, shape (), (p,) or (p, p), optional
        Covariance of the start's error over the variance of e; 1e12 / small if not given.
    noise_sd : float, optional
        Standard deviation of e, where known; else it is tracked.

    Attributes
    ----------
    covariance : ndarray, shape (p, p)
        Of the estimate's error, see `Lms`.

    Raises
    ------
    EstimationError
        If a setting is out of its range.
    """

    def __init__(
        self,
        names: Sequence[str] | int,
        *,
        step: float,
        small: float,
        start: ArrayLike | None = None,
        prior: ArrayLike | None = None,
        noise_sd: float | None = None,
    ) -> None:
        far = _FAR / positive("small", small)
        if not 0 < step < 2:
            raise EstimationError(f"step is {step!r}; normalised LMS converges for 0 < step < 2")
        super().__init__(names, start, prior, noise_sd, far, KIND=self._at.NLMS, STEP=step, SMALL=small)


class RecursiveArx(Copied):
    """A recursion on regressors, fed with signals: a `RecursiveEstimator` of A(q) y = B(q) u + constant + v, φ(t) =
    [-y(t-1) ... -y(t-na), u(t-nk) ... u(t-nk-nb+1), 1] (Ljung 1999, eq. 4.7).

    Biased where v is coloured, and under feedback with noise that is not white: see `RecursivePolynomial`.

    Parameters
    ----------
    na : int
        Past outputs.
    nb, nk : int or sequence of int
        Coefficients and delay of each input; a single delay is for all.
    offset : bool
        Whether a constant is estimated.
    estimator : callable
        Makes the recursion from the names of the coefficients, as ``RecursiveLeastSquares`` does.

    Attributes
    ----------
    names : tuple of str
        ``a1``, ...; ``b1``, ... by their lag (``b1.0`` for the first of several inputs); ``offset``.
    estimate : ndarray, shape (p,)
    covariance : ndarray, shape (p, p)
    n_used, n_rejected : int

    Raises
    ------
    EstimationError
        If an order is negative.
    """

    def __init__(
        self,
        na: int,
        nb: int | Sequence[int],
        nk: int | Sequence[int] = 1,
        *,
        offset: bool = False,
        estimator: Callable[[tuple[str, ...]], RecursiveEstimator],
    ) -> None:
        orders = [nb] if isinstance(nb, int) else list(nb)
        delays = [nk] * len(orders) if isinstance(nk, int) else list(nk)
        columns, names = columns_of(na, orders, delays, offset=offset)
        self._table = np.array(columns, dtype=np.int64).reshape(-1, 3)
        self._past = np.full((max(1, int(self._table[:, 1].max())), 1 + len(orders)), np.nan)
        self._n_inputs, self._estimator = len(orders), estimator(tuple(names))

    @property
    def names(self) -> tuple[str, ...]:
        """The coefficients."""
        return self._estimator.names

    @property
    def estimate(self) -> Array:
        """A copy, shape (p,)."""
        return self._estimator.estimate

    @property
    def covariance(self) -> Array:
        """A copy, shape (p, p)."""
        return self._estimator.covariance

    @property
    def n_used(self) -> int:
        """Samples that were used."""
        return self._estimator.n_used

    @property
    def n_rejected(self) -> int:
        """Samples that were not: not finite, or in need of past signals that are unknown."""
        return self._estimator.n_rejected

    def update(self, u: ArrayLike, y: ArrayLike) -> Array:
        """Take in one sample or a block.

        Parameters
        ----------
        u : array_like, shape (n_inputs,), or (n_samples, n_inputs) for a block
            A number, or (n_samples,), where there is one input.
        y : array_like, shape (), or (n_samples,) or (n_samples, 1) for a block

        Returns
        -------
        ndarray, shape of `y`
            Errors of prediction one sample ahead; NaN where the sample was rejected.

        Raises
        ------
        EstimationError
            If the shapes do not fit.
        """
        if isinstance(y, float) and isinstance(u, float) and self._n_inputs == 1:  # quickly
            x, shape = np.array([[y, u]]), ()
        else:
            inputs, outputs, shape = as_blocks("ARX", u, y, self._n_inputs)
            x = np.hstack([outputs, inputs])
        rows = np.empty((x.shape[0], self._table.shape[0]))
        kernels("regression").tapped(self._past, self._table, x, rows)
        return self._estimator.update(rows, x[:, 0]).reshape(shape)


def columns_of(
    na: int, nb: Sequence[int], nk: Sequence[int], *, offset: bool
) -> tuple[list[tuple[int, int, int]], list[str]]:
    """Return columns (channel, lag, sign) and their names; channel 0 is the output, then come the inputs, -1 is 1."""
    if na < 0 or len(nb) != len(nk) or any(n < 0 for n in (*nb, *nk)) or na + sum(nb) == 0:
        raise EstimationError(
            f"na={na}, nb={list(nb)}, nk={list(nk)}: orders must be at least 0, and not all 0. Correct them"
        )
    columns, names = [(0, lag, -1) for lag in range(1, na + 1)], [f"a{lag}" for lag in range(1, na + 1)]
    for i, (order, delay) in enumerate(zip(nb, nk, strict=True), start=1):
        for lag in range(delay, delay + order):
            columns.append((i, lag, 1))
            names.append(f"b{lag}" if len(nb) == 1 else f"b{lag}.{i - 1}")
    if offset:
        columns.append((-1, 0, 1))
        names.append("offset")
    return columns, names


def coefficient_names(names: Sequence[str] | int) -> tuple[str, ...]:
    """Return the names of the coefficients, ``theta1``, ... where only their number is given."""
    found = tuple(f"theta{i + 1}" for i in range(names)) if isinstance(names, int) else tuple(names)
    if not found or len(set(found)) < len(found):
        raise EstimationError(f"names is {names!r}; give at least one coefficient, each name once")
    return found
