"""Recursions for y = φᵀθ + e: least squares with a choice of forgetting, LMS and NLMS, instrumental variables.

Least squares minimises the sum of squared errors over past samples, older ones with less weight, and the distance from
the start; every sample costs O(p²) and nothing is inverted (Bierman 1977, ch. V; Ljung & Söderström 1983, sec. 6.2).
LMS steps along the regressor, θ(t) = θ(t-1) + μ(t) φ(t) e(t): robust, but slow where regressors are correlated (Widrow
& Stearns 1985, ch. 6; Haykin 2002, ch. 5 and 6). Both stand on the square-root core.

With instruments ζ, e may be coloured and in the regressor: Σ λ^(t-k) ζ (y - φᵀθ) = 0 is solved, with more instruments
than coefficients in the sense of two-stage least squares. The rows [ζᵀ φᵀ y] are rotated into a triangle, so nothing is
squared and no unsymmetric P, which can pass through infinity, is carried (Söderström & Stoica 1983, ch. 4 and 8).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.recursive.estimator import Copied, as_blocks, count, forgetting_factor, kernels, numbers, positive, prior_of
from ambid.recursive.square_root import covariance_of, factors_of, root_of, root_of_factors

Forgetting = Literal["none", "exponential", "directional"]

VAGUE = 1e22  # variance of a coefficient of which nothing is known, whatever its unit
ENOUGH = 0.5  # samples' worth of noise, before which its variance is not known
_SMALLEST_VARIANCE = 1e-200  # exact data; a variance of 0 would not be positive definite
_NOISE_MEMORIES = 10  # memory of the noise variance, in memories of the estimate
_SETTLES = 0.25  # of the memory of the noise variance, after which it is good enough to be the unit of the covariance
_NOISE_RATE = 1e-4  # of forgetting of the noise variance, a sample, for recursions along the gradient
_LOOKS = 32  # most samples between two looks at the limit
_FAR = 1e12  # variance of the start's error in units of step or of 1 / small, which have the signals' units
_FLOAT = np.dtype(np.float64)


class Recursion(Copied):
    """State and interface of a recursion; its compiled loop is the only thing that differs."""

    def __init__(
        self, names: tuple[str, ...], width: int, size: int, start: ArrayLike | None, noise_sd: float | None
    ) -> None:
        p = len(names)
        self._names, self._shape = names, (width,)
        self._s = np.zeros(self._at.HEAD + size)
        self._s[self._at.SIZE] = p
        self._known_noise = None if noise_sd is None else positive("noise_sd", noise_sd) ** 2
        self._s[self._at.HEAD :][:p] = numbers("start", 0.0 if start is None else start, p)
        self._one = (np.zeros((1, width)), np.zeros(1))

    @property
    def _at(self) -> Any:
        """The compiled loops, which also know where the numbers lie."""
        return kernels("regression")

    def _forget(self, factor: float | None, memory: float | None, limit: float) -> None:
        """Set how fast old samples lose their weight, and how far."""
        s, at = self._s, self._at
        s[at.FACTOR] = s[at.FACTOR_NOW] = forgetting_factor(factor, memory)
        s[at.MEMORY] = 1.0 / (1.0 - s[at.FACTOR]) if s[at.FACTOR] < 1.0 else np.inf
        s[at.EVERY] = max(1.0, min(_LOOKS, np.floor(s[at.MEMORY] / 2)))
        s[at.LIMIT] = positive("limit", limit)
        s[at.NOISE_RATE] = 1.0 / (_NOISE_MEMORIES * s[at.MEMORY])

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
        """Take in one sample or a block.

        `phi`: (p,), or (n_samples, p) for a block, regressors; `y`: (), or (n_samples,) or (n_samples, 1) for a block.
        Returns y - φᵀθ with the θ from before each sample; NaN where the sample was rejected.
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


class _Factored(Recursion):
    """A recursion with P and a companion of it in factors."""

    def __init__(self, names: Sequence[str] | int, start: ArrayLike | None, noise_sd: float | None) -> None:
        found = coefficient_names(names)
        p = len(found)
        super().__init__(found, p, 6 * p + 4 * p * p, start, noise_sd)

    def _factors(self, which: int) -> Array:
        """Return a view of the factors (p, p) of P (0), of its companion (1), or of both at the start (2, 3)."""
        p = len(self._names)
        first = self._at.HEAD + p + which * p * p
        return self._s[first : first + p * p].reshape(p, p)

    def _rest(self) -> Array:
        """Return a view of the rows prior and scratch, shape (5, p)."""
        p = len(self._names)
        return self._s[self._at.HEAD + p + 4 * p * p :].reshape(5, p)


class RecursiveLeastSquares(_Factored):
    """Recursive least squares, a `RecursiveEstimator`.

    What is forgotten:

    - ``"none"``: nothing. The estimate is that of batch least squares with the same prior.
    - ``"exponential"``: a sample k samples ago weighs factor**k. Where the regressor lacks a direction, P grows there
      (wind-up) until the mean of P_ii over its prior is `limit`; forgetting is then slowed for all directions so far
      that it stays there: coefficients that are still excited are tracked more slowly meanwhile.
    - ``"directional"``: only the part of the information that the present regressor meets is forgotten: without
      excitation nothing is (Cao & Schwartz 2000, Automatica 36, 1725). Under the same `limit`.

    The covariance is that of the estimate's error for coefficients that do not move, e white and independent of past
    regressors: σ²C with the error's own recursion C = (I - Kφᵀ) C (I - Kφᵀ)ᵀ + K Kᵀ. With forgetting it is less than
    σ²P, by 1 + factor in the stationary state. The lag behind moving coefficients is not in it.

    Where something is forgotten, every sample counts with the σ² of its own time, once σ² is known (after a memory): a
    calm makes no coefficient surer.

    σ² is tracked on errors e over 1 + φᵀCφ, each with the weight of what it says of the estimate: silence does not
    lower it. Biased like all least squares where e is coloured and correlated with the regressor, as under feedback
    or for noisy regressors: then take `RecursiveInstrumentalVariables`.

    Numbers: factors U and D > 0 are updated without subtraction of D, so that P stays positive definite whatever is
    rounded; forgetting divides D and damps old rounding errors; the limit bounds P from above, the data from below.

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
        Without effect where nothing is forgotten.
    reset_every : int, optional
        P and C are set back to the prior after so many samples, the estimate kept.
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
        forgetting: Forgetting | None = None,
        factor: float | None = None,
        memory: float | None = None,
        limit: float = 100.0,
        reset_every: int | None = None,
        noise_sd: float | None = None,
    ) -> None:
        forgets = factor is not None or memory is not None
        if forgetting not in (None, "none", "exponential", "directional"):
            raise EstimationError(f"forgetting is {forgetting!r}; it is none, exponential or directional")
        if forgets and forgetting == "none":
            raise EstimationError("forgetting is none; omit factor and memory")
        if not forgets and forgetting in ("exponential", "directional"):
            raise EstimationError(f"forgetting is {forgetting}; it needs a factor or a memory. Give one")
        super().__init__(names, start, noise_sd)
        s, p, at = self._s, len(self._names), self._at
        s[at.KIND] = at.DIRECTIONAL if forgetting == "directional" else at.LEAST_SQUARES
        self._forget(factor, memory, limit)
        s[at.VAGUE] = float(prior is None)
        s[at.RESET_EVERY] = 0 if reset_every is None else count("reset_every", reset_every)
        s[at.TYPICAL], s[at.NOW] = 0.1 * p, 1.0
        settle = _SETTLES * _NOISE_MEMORIES * s[at.MEMORY]
        s[at.SETTLED] = np.inf if noise_sd is not None else min(s[at.MEMORY], settle)
        prior = prior_of("prior", VAGUE if prior is None else prior, p)
        scale = np.sqrt(np.diag(prior))
        inverse = np.linalg.inv(prior / np.outer(scale, scale)) / np.outer(scale, scale)
        # the companion begins as the covariance of the error, or as the information of squared weights
        directional = s[at.KIND] == at.DIRECTIONAL
        self._factors(2)[:] = factors_of(prior)
        self._factors(3)[:] = factors_of(prior if directional else (inverse + inverse.T) / 2)
        self._rest()[0] = np.diag(prior)
        self.reset()

    @property
    def P(self) -> Array:
        """A copy of the matrix of the recursion, shape (p, p): covariance over σ² without forgetting."""
        return covariance_of(self._factors(0))

    @property
    def covariance(self) -> Array:
        """A copy of the covariance of the estimate's error, shape (p, p)."""
        s, at = self._s, self._at
        unit = float(s[at.UNIT] or self.noise_variance)
        if s[at.KIND] == at.DIRECTIONAL:
            return unit * covariance_of(self._factors(1))
        if s[at.FACTOR] == 1.0:
            return self.noise_variance * self.P
        half = root_of_factors(self._factors(1)).T @ self.P
        return np.asarray(unit * (half.T @ half))

    def reset(self) -> None:
        """Say that the coefficients may have moved: P and C become the prior, the estimate stays."""
        s, at = self._s, self._at
        self._factors(0)[:], self._factors(1)[:] = self._factors(2), self._factors(3)
        if s[at.UNIT]:
            s[at.UNIT] = max(s[at.UNIT], self.noise_variance)
            s[at.NOW] = at.noise_of_now(s)


class _Gradient(_Factored):
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
        self._factors(1)[:] = factors_of(prior_of("prior", far if prior is None else prior, len(self._names)))

    @property
    def covariance(self) -> Array:
        """A copy of the covariance of the estimate's error, shape (p, p)."""
        return self.noise_variance * covariance_of(self._factors(1))


class Lms(_Gradient):
    """Least mean squares, a `RecursiveEstimator`: θ += step φ e.

    A sample with step φᵀφ > 1 is used with the step 1 / φᵀφ, beyond which a single step overshoots; `n_limited` counts
    them. The covariance is σ²C, C = (I - Kφᵀ) C (I - Kφᵀ)ᵀ + K Kᵀ with K = step φ, the exact covariance of the error
    given the regressors, for coefficients that do not move and white e independent of past regressors: from the
    prior down to the misadjustment, about step σ²/2 for small steps. The lag behind moving coefficients is not in it.
    Biased like least squares where e is coloured and correlated with the regressor, as under feedback.

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
    ) -> None:
        found = coefficient_names(names)
        p = len(found)
        m = p if n_instruments is None else int(n_instruments)
        if m < p:
            raise EstimationError(f"{m} instruments do not determine {p} coefficients. Give {p} or more")
        lags = count("correlation", correlation)
        size = p + m * (m + p + 1) + p * p + m * m + lags * m + m + p + m + m * (p + 1) + 2 * (m + p) + 1
        super().__init__(found, p + m, size, start, None)
        s, at = self._s, self._at
        s[at.INSTRUMENTS], s[at.LAGS] = m, lags
        self._forget(factor, memory, limit)
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

    def _run(self, rows: Array, y: Array, out: Array) -> None:
        kernels("regression").instrumental(self._s, rows, y, out)

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


def coefficient_names(names: Sequence[str] | int) -> tuple[str, ...]:
    """Return the names of the coefficients, ``theta1``, ... where only their number is given."""
    found = tuple(f"theta{i + 1}" for i in range(names)) if isinstance(names, int) else tuple(names)
    if not found or len(set(found)) < len(found):
        raise EstimationError(f"names is {names!r}; give at least one coefficient, each name once")
    return found


def _root(N: Array) -> Array:
    """Return a square root of N; what rounding made of its smallest eigenvalues does not count."""
    scale = np.sqrt(np.diag(N))
    return np.asarray(scale[:, None] * root_of(N / np.outer(scale, scale), floor=float(np.finfo(float).eps)))
