"""Pure delay between input and output: the first significant lag of a high-order ARX model by one QR factorisation. It
needs no noise model and is consistent under feedback whose loop holds a delay (Ljung 1999, sec. 13.4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import erf, sqrt

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError, counted

_ROWS = 2048  # at once: some hundred columns of them stay in the cache
_NARROW = 16  # columns up to which NumPy's QR serves as well; SciPy's update takes a tenth of a second to load
_PANEL = 32  # columns that LAPACK eliminates together


def lagged_triangle(columns: Sequence[tuple[Array, int]], first: int) -> Array:
    """Return R (n_columns, n_columns) of the QR factorisation of [x(t - lag) of every column] for t >= first, at least
    the largest lag; zero rows at the end where rows are fewer. A column is a signal (n_samples,) and its lag.
    """
    n, width = columns[0][0].size, len(columns)
    R = np.zeros((width, width), order="F")
    if width <= _NARROW:
        for start in range(first, n, _ROWS):
            rows = np.column_stack([x[start - lag : min(start + _ROWS, n) - lag] for x, lag in columns])
            R = np.asarray(np.linalg.qr(np.vstack([R, rows]), mode="r"))
        R[n - first :] = 0.0  # but for rounding, where there are fewer rows than columns
        return R
    from scipy.linalg.lapack import dtpqrt

    for start in range(first, n, _ROWS):
        stop = min(start + _ROWS, n)
        block = np.empty((stop - start, width), order="F")
        for k, (x, lag) in enumerate(columns):
            block[:, k] = x[start - lag : stop - lag]
        R, _, _, _ = dtpqrt(0, min(_PANEL, width), R, block, overwrite_a=1, overwrite_b=1)
    R[n - first :] = 0.0
    return np.triu(R)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Regression:
    """A least-squares fit: coefficients and their sd, shape (n_columns,), residual variance and the number of rows."""

    coefficients: Array
    sd: Array
    variance: float
    n_rows: int


def fit_arx(y: Array, inputs: Sequence[Array], na: int, lags: Sequence[int]) -> Regression:
    """Fit y(t) = -a·y(t-1…t-na) + b·u(t-lags) + constant by QR; columns in this order, coefficients of +y (-a)."""
    reach = max([na, *lags])
    n_columns, n_rows = na + len(lags) * len(inputs) + 1, y.size - reach
    if n_rows <= 2 * n_columns:
        raise EstimationError(
            f"{y.size} samples are too few for a regression on {n_columns} lagged values; it needs more than "
            f"{2 * n_columns + reach}. Use a longer record, or a lower order"
        )
    signals = [y, *inputs]
    sizes = [float(np.linalg.norm(x)) or 1.0 for x in signals]
    past_y, *past = (x / size for x, size in zip(signals, sizes, strict=True))
    columns = [(past_y, lag) for lag in range(1, na + 1)] + [(u, lag) for u in past for lag in lags]
    norms = np.repeat([*sizes, np.sqrt(n_rows)], [na, *(len(lags) for _ in inputs), 1])
    r = lagged_triangle([*columns, (np.full(y.size, 1.0 / norms[-1]), 0), (y, 0)], reach)
    triangle, rhs = r[:n_columns, :n_columns], r[:n_columns, n_columns]
    # A noise-free record makes lagged columns dependent: the smallest norm among all solutions predicts as well.
    u, s, vt = np.linalg.svd(triangle)
    independent = s > s[0] * 1e-12
    inverse = (vt[independent].T / s[independent]) @ u[:, independent].T
    variance = float(r[n_columns, n_columns] ** 2) / (n_rows - int(independent.sum()))
    sd = np.sqrt(variance * np.sum(inverse**2, axis=1)) / norms
    return Regression(coefficients=inverse @ rhs / norms, sd=sd, variance=variance, n_rows=n_rows)


_SIGNIFICANT = 4.0  # standard deviations
_RELATIVE = 0.2  # of the largest coefficient: under it a lag is the foot of a fraction of a sample, or model error


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Delay:
    """Pure delay of an output behind an input."""

    samples: int | None  # delay in samples; None if no lag is significant
    # probability, 0 to 1, that the first significant lag lies above the threshold and all earlier ones under it,
    # given the coefficients and their standard deviations; it does not know of model error
    confidence: float
    lags: np.ndarray  # (n_lags,): Candidate delays in samples
    # (n_lags,), output unit per input unit: Weight of the input in the one-step predictor for each candidate
    coefficients: Array
    z: Array  # (n_lags,), dimensionless: Coefficients over their standard deviations
    threshold: float  # size that a coefficient has to exceed, output unit per input unit

    def __str__(self) -> str:
        if self.samples is None:
            return f"delay not found among {self.lags[0]} to {self.lags[-1]} samples: no lag is significant"
        at = self.samples - int(self.lags[0])
        return f"delay {counted(self.samples, 'sample')} (z = {self.z[at]:.3g}, confidence {self.confidence:.3f})"


def find_delay(u: Array, y: Array, *, max_delay: int = 10, order: int = 20, feedthrough: bool = False) -> Delay:
    """Find the pure delay of `y` behind `u` in whole samples.

    Fits y(t) = Σ a_k y(t-k) + Σ b_k u(t-k) + constant and takes the first lag whose b_k is both significant (4 standard
    deviations) and at least a fifth of the largest. A sampled plant that the input drives through a hold answers one
    sample later by itself, so a delay of d samples shows first at lag d + 1.

    Limits: the output has to answer within a few samples of the delay, as the coil current answers the voltage; a
    position behind a mass answers with the second or third power of time and shows no clear first lag. A fraction of a
    sample is rounded down. Under feedback the loop must hold a delay, which lag 0 would break: it is left out unless
    `feedthrough`. The delay that maximises the grey-box likelihood is the final word; this is where its search starts.

    Parameters
    ----------
    u, y : ndarray, shape (n_samples,)
        Input and output, e.g. voltage in V and current in A.
    max_delay : int
        Largest candidate in samples.
    order : int
        Lags of the output, and lags of the input beyond `max_delay`.
    feedthrough : bool
        The output may answer in the same sample (an input measured rather than held): lag 0 then is a delay of 0.

    Returns
    -------
    Delay
        With the statistic of each lag.

    Raises
    ------
    EstimationError
        If lengths differ, a signal is constant or not finite, a setting is out of range, or the record is too short.
    """
    u, y = np.asarray(u, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if u.ndim != 1 or u.shape != y.shape:
        raise EstimationError(
            f"input has shape {u.shape} and output {y.shape}; both must be (n_samples,). Pass one column each"
        )
    if max_delay < 0 or order < 1:
        raise EstimationError(
            f"delay search got max_delay {max_delay} and order {order}; they must be at least 0 and 1. Give others"
        )
    for label, x in (("input", u), ("output", y)):
        if not np.isfinite(x).all():
            raise EstimationError(f"the {label} of the delay search is not finite everywhere. Repair or cut it first")
        if np.ptp(x) == 0.0:
            raise EstimationError(
                f"the {label} of the delay search is constant and reveals no delay. Use an excited record"
            )
    first_lag = 0 if feedthrough else 1
    scaled_u, scaled_y = (u - u.mean()) / u.std(), (y - y.mean()) / y.std()
    lags = range(first_lag, first_lag + max_delay + 1 + order)
    fit = fit_arx(scaled_y, (scaled_u,), order, lags)
    searched = slice(order, order + max_delay + 1)
    floor = np.finfo(np.float64).eps  # a noise-free record has no standard deviation left
    b, sd = fit.coefficients[searched], np.maximum(fit.sd[searched], floor)
    largest = float(np.max(np.abs(fit.coefficients[order:-1])))
    threshold = np.maximum(_SIGNIFICANT * sd, _RELATIVE * largest)
    above = np.flatnonzero(np.abs(b) > threshold)
    gain = float(y.std() / u.std())
    return Delay(
        samples=int(above[0]) if above.size else None,
        confidence=_confidence(b, sd, _RELATIVE * largest, int(above[0])) if above.size else 0.0,
        lags=np.arange(max_delay + 1),
        coefficients=b * gain,
        z=b / sd,
        threshold=float(np.max(threshold)) * gain,
    )


def _confidence(b: Array, sd: Array, threshold: float, first: int) -> float:
    """Probability that |b| exceeds the threshold at `first` and at no earlier lag, for Gaussian coefficients."""

    def above(k: int) -> float:
        def upper(z: float) -> float:
            return 0.5 * (1.0 - erf(z / sqrt(2.0)))

        return upper((threshold - b[k]) / sd[k]) + upper((threshold + b[k]) / sd[k])

    probability = above(first)
    for k in range(first):
        probability *= 1.0 - above(k)
    return float(np.clip(probability, 0.0, 1.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class PersistentExcitation:
    """Persistent excitation of a signal."""

    order: int  # largest order, up to `asked`, at which the signal is persistently exciting; 0 for a constant signal
    asked: int  # order looked at
    # singular values of the Hankel matrix of order `asked`, of the signal scaled to mean 0 and rms 1 and divided by
    # the square root of the number of rows: both are 1 for white noise
    smallest: float
    largest: float

    @property
    def condition(self) -> float:
        """Ratio of the largest to the smallest singular value; inf if the smallest is 0."""
        return self.largest / self.smallest if self.smallest > 0 else float("inf")

    def __str__(self) -> str:
        least = "at least " if self.order == self.asked else ""
        values = f"singular values {self.smallest:.3g} to {self.largest:.3g}"
        return f"persistently exciting of order {least}{self.order} ({values})"


def persistent_excitation(u: Array, order: int, *, tolerance: float = 1e-9) -> PersistentExcitation:
    """Measure the order of persistent excitation of a signal.

    It is of order n if the Hankel matrix of its samples with n columns has full column rank (Ljung 1999, def. 13.2).
    The mean is removed, because an identification that estimates an offset has no use of it: a sum of k sines has order
    2k.

    Parameters
    ----------
    u : ndarray, shape (n_samples,), any unit
    order : int
        Largest order to look at, at least 1; the record needs twice as many samples.
    tolerance : float
        Ratio of smallest to largest singular value under which the rank counts as lost. The default is for round-off; a
        noise level in parts of the signal's rms tells what can be seen above that noise.

    Returns
    -------
    PersistentExcitation
        The order and the singular values.

    Raises
    ------
    EstimationError
        If the order does not fit the record or a sample is not finite.
    """
    u = np.asarray(u, dtype=np.float64)
    if order < 1 or u.ndim != 1 or u.size < 2 * order:
        raise EstimationError(
            f"persistent excitation of order {order} from samples of shape {u.shape}; the order must be at least 1 and "
            "the samples (n_samples,) at least twice as many. Use a lower order or a longer record"
        )
    if not np.isfinite(u).all():
        raise EstimationError("persistent excitation of a signal that is not finite everywhere. Repair or cut it first")
    centred = u - u.mean()
    rms = float(np.sqrt(np.mean(centred**2)))
    if rms <= 1e-14 * float(np.max(np.abs(u), initial=0.0)):
        return PersistentExcitation(order=0, asked=order, smallest=0.0, largest=0.0)
    rows = u.size - order + 1
    matrix = np.lib.stride_tricks.sliding_window_view(centred, order) / (rms * np.sqrt(rows))  # a Hankel matrix
    # Each column has its own mean over its own samples: only their removal takes the constant out exactly.
    matrix -= matrix.mean(axis=0)
    # The leading n columns of the triangle are those of the Hankel matrix of order n: one QR serves all orders.
    triangle: Array = np.asarray(np.linalg.qr(matrix, mode="r"))
    values = np.linalg.svd(triangle, compute_uv=False)
    return PersistentExcitation(
        order=_full_rank(triangle, order, tolerance), asked=order, smallest=float(values[-1]), largest=float(values[0])
    )


def _full_rank(triangle: Array, order: int, tolerance: float) -> int:
    """Largest n whose leading n columns have full rank, by bisection: a lost rank does not come back."""

    def full(n: int) -> bool:
        values = np.linalg.svd(triangle[:n, :n], compute_uv=False)
        return bool(values[-1] > tolerance * values[0])

    low, high = 1, order
    if full(order):
        return order
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if full(middle) else (low, middle)
    return low
