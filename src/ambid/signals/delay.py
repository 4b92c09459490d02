"""Pure delay between an input and an output, from the first significant lag of a high-order ARX model.

Solved by one QR factorisation. A high-order ARX model needs no noise model and stays consistent under feedback as long
as the loop holds a delay (Ljung 1999, sec. 13.4), where correlation of input and output does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import erf, sqrt

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.signals._regression import fit_arx

_SIGNIFICANT = 4.0  # standard deviations
_RELATIVE = 0.2  # of the largest coefficient: under it a lag is the foot of a fraction of a sample, or model error


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Delay:
    """Pure delay of an output behind an input.

    Attributes
    ----------
    samples : int or None
        Delay in samples; None if no lag is significant.
    confidence : float
        Probability, 0 to 1, that the first significant lag lies above the threshold and all earlier ones under it,
        given the coefficients and their standard deviations; it does not know of model error.
    lags : ndarray of int, shape (n_lags,)
        Candidate delays in samples.
    coefficients : ndarray, shape (n_lags,), output unit per input unit
        Weight of the input in the one-step predictor for each candidate.
    z : ndarray, shape (n_lags,), dimensionless
        Coefficients over their standard deviations.
    threshold : float
        Size that a coefficient has to exceed, output unit per input unit.
    """

    samples: int | None
    confidence: float
    lags: np.ndarray
    coefficients: Array
    z: Array
    threshold: float

    def __str__(self) -> str:
        if self.samples is None:
            return f"delay not found among {self.lags[0]} to {self.lags[-1]} samples: no lag is significant"
        at = self.samples - int(self.lags[0])
        return f"delay {self.samples} samples (z = {self.z[at]:.3g}, confidence {self.confidence:.3f})"


def find_delay(u: Array, y: Array, *, max_delay: int = 10, order: int = 20, feedthrough: bool = False) -> Delay:
    """Find the pure delay of `y` behind `u` in whole samples.

    Fits y(t) = Σ a_k y(t-k) + Σ b_k u(t-k) + constant and takes the first lag whose b_k is both significant (4
    standard deviations) and at least a fifth of the largest. A sampled plant that the input drives through a hold
    answers one sample later by itself, so a delay of d samples shows first at lag d + 1.

    Limits: the output has to answer within a few samples of the delay, as the coil current answers the voltage; a
    position behind a mass answers with the second or third power of time and shows no clear first lag. A fraction of a
    sample is rounded down. Under feedback the loop must hold a delay, which lag 0 would break: it is left out unless
    `feedthrough`. The delay that maximises the grey-box likelihood is the final word; this is where its search starts.

    Parameters
    ----------
    u : ndarray, shape (n_samples,)
        Input, e.g. voltage in V.
    y : ndarray, shape (n_samples,)
        Output, e.g. current in A.
    max_delay : int
        Largest candidate in samples.
    order : int
        Lags of the output, and lags of the input beyond `max_delay`.
    feedthrough : bool
        The output may answer in the same sample (an input that is measured rather than held): lag 0 then is a delay of
        0.

    Returns
    -------
    Delay
        The delay with the statistic of each lag.

    Raises
    ------
    EstimationError
        If lengths differ, a signal is constant or not finite, the settings are out of range, or the record is too
        short.
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
                f"the {label} of the delay search is constant; it shows no delay. Use an excited record"
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
