"""LMS and normalised LMS for y = φᵀθ + e: steps along the regressor, with the exact covariance of what they leave.

θ(t) = θ(t-1) + μ(t) φ(t) e(t). Robust and without memory of a covariance, but slow where regressors are correlated
(Widrow & Stearns 1985, ch. 6; Haykin 2002, ch. 5 and 6).
"""

from __future__ import annotations

from collections.abc import Sequence

from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.recursive.adaptive._recursion import Factored, covariance_of, positive, product

_FAR = 1e12  # variance of the start's error in units of step or of 1 / small, which have the signals' units


class _Gradient(Factored):
    """A recursion along the regressor, with the covariance of its error."""

    _kernel = "gradient"

    def __init__(
        self,
        names: Sequence[str] | int,
        start: ArrayLike | None,
        prior: ArrayLike,
        noise_sd: float | None,
        noise_start: float,
        noise_memory: float,
    ) -> None:
        super().__init__(names, start, noise_sd, noise_start)
        self._s[self._at.NOISE_RATE] = 1.0 / positive("noise_memory", noise_memory)
        self._set_factors(1, covariance_of("prior", prior, len(self._names)))

    @property
    def covariance(self) -> Array:
        """A copy of the covariance of the estimate's error, shape (p, p)."""
        return self.noise_variance * product(*self._factors(1))


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
    noise_start : float
        Taken for it until the data have shown it.
    noise_memory : float
        Memory of the tracked variance, samples.

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
        noise_start: float = 1.0,
        noise_memory: float = 10_000.0,
    ) -> None:
        far = _FAR * positive("step", step)
        super().__init__(names, start, far if prior is None else prior, noise_sd, noise_start, noise_memory)
        self._s[self._at.KIND], self._s[self._at.STEP] = self._at.LMS, step

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
    noise_start : float
        Taken for it until the data have shown it.
    noise_memory : float
        Memory of the tracked variance, samples.

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
        noise_start: float = 1.0,
        noise_memory: float = 10_000.0,
    ) -> None:
        far = _FAR / positive("small", small)
        super().__init__(names, start, far if prior is None else prior, noise_sd, noise_start, noise_memory)
        if not 0 < step < 2:
            raise EstimationError(f"step is {step!r}; normalised LMS converges for 0 < step < 2")
        self._s[self._at.KIND], self._s[self._at.STEP] = self._at.NLMS, step
        self._s[self._at.SMALL] = small
