"""Coil from voltage and current, rotor at rest, as the thesis does it: V = R i + L i' (thesis eq. 4.1 to 4.3).

Least squares is biased by noise on the current, its own regressor; the 'coil' model of `ambid identify` is not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError


@dataclass(frozen=True, slots=True, kw_only=True)
class CoilEstimate:
    """Coil as i' = b V - a i, I/V = b/(s + a)."""

    R: float  # resistance a/b in ohm and inductance 1/b in H
    L: float
    a: float  # pole in rad/s and gain in A/(V s)
    b: float
    warning: str | None = None  # biased where a controller makes the voltage depend on the current


def coil_least_squares(voltage: Array, current: Array, rate_hz: float, *, open_loop: bool = False) -> CoilEstimate:
    """Estimate a coil by least squares (thesis eq. 4.1 to 4.3); biased by noise on the current.

    i[k+1] = alpha i[k] + beta V[k] + constant, alpha = exp(-a T), beta = b (1 - alpha)/a under a zero-order hold.

    Parameters
    ----------
    voltage, current : ndarray, shape (n_samples,), V and A
    rate_hz : float
    open_loop : bool
        The record is known to be taken without feedback; otherwise the result carries a warning.

    Returns
    -------
    CoilEstimate

    Raises
    ------
    EstimationError
        If the lengths differ, the signals hold no information, or no decaying first-order coil fits.
    """
    if voltage.shape != current.shape or voltage.ndim != 1 or voltage.size < 10:
        raise EstimationError(
            f"voltage has shape {voltage.shape} and current {current.shape}; the coil needs two columns of one length, "
            "at least 10 samples. Check the record"
        )
    if np.ptp(voltage) == 0 or np.ptp(current) == 0:
        raise EstimationError("voltage or current is constant; a coil shows only when both change. Excite the coil")
    rows = np.stack([current[:-1], voltage[:-1], np.ones(voltage.size - 1)], axis=1)
    alpha, beta, _ = (float(x) for x in np.linalg.lstsq(rows, current[1:], rcond=None)[0])
    if not (0 < alpha < 1 and np.isfinite(beta) and beta != 0):
        raise EstimationError(
            f"no decaying first-order coil fits (i[k+1] = {alpha:.4g} i[k] + {beta:.4g} V[k]). "
            "Check sign, delay and sampling rate"
        )
    a = float(-np.log(alpha) * rate_hz)
    b = beta * a / (1 - alpha)
    feedback = (
        "biased where a controller makes the voltage depend on the current; say open_loop=True, or use the 'coil' model"
    )
    return CoilEstimate(R=a / b, L=1 / b, a=a, b=b, warning=None if open_loop else feedback)
