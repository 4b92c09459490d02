"""Coil from voltage and current, rotor at rest: V = R i + L i' (thesis eq. 4.1 to 4.3).

Least squares on the first-order difference equation, as the thesis does it, is biased by noise on the measured current,
because the regressor is that same current. The instrumental variable, the current simulated from the voltage alone,
removes the bias.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.sensitivity import run

_ITERATIONS = 20
_FEEDBACK = (
    "biased where a controller makes the voltage depend on the current; say open_loop=True, or use the 'coil' model"
)
_SETTLED = 1e-10  # change, relative to the current, at which the instruments have settled


@dataclass(frozen=True, slots=True, kw_only=True)
class CoilEstimate:
    """Coil as i' = b V - a i, I/V = b/(s + a)."""

    R: float  # resistance a/b in ohm and inductance 1/b in H
    L: float
    a: float  # pole in rad/s and gain in A/(V s)
    b: float
    method: Literal["least squares", "instrumental variable"]
    # what to know before using it: both methods are biased where a controller makes the voltage depend on the current
    warning: str | None = None


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
    rows, target = _regression(voltage, current)
    found = np.asarray(np.linalg.lstsq(rows, target, rcond=None)[0], dtype=np.float64)
    return replace(_coil(found, rate_hz, "least squares"), warning=None if open_loop else _FEEDBACK)


def coil_instrumental(voltage: Array, current: Array, rate_hz: float, *, open_loop: bool = False) -> CoilEstimate:
    """Estimate a coil by the refined instrumental variable (Young 2011, ch. 7); the bias of least squares is gone.

    The instrument is the current of the estimated coil under the same voltage, free of measurement noise; it and the
    data are filtered by the coil's own lag, and all is repeated until it settles. Wants a voltage that does not depend
    on the current (no feedback).

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
        As `coil_least_squares`, or if the iteration does not settle.
    """
    rows, target = _regression(voltage, current)
    found = np.linalg.lstsq(rows, target, rcond=None)[0]
    for _ in range(_ITERATIONS):
        alpha, beta, constant = found
        if not 0 < alpha < 1:
            break
        clean = _first_order(alpha, beta * voltage[:-1] + constant, current[0])
        instrument = np.stack([clean, voltage[:-1], np.ones(clean.size)], axis=1)
        smooth = [_filtered(alpha, m) for m in (instrument, rows, target[:, None])]
        size = np.linalg.norm(smooth[0], axis=0)
        gram = (smooth[0] / size).T @ (smooth[1] / size)
        before, found = found, np.linalg.solve(gram, (smooth[0] / size).T @ smooth[2][:, 0]) / size
        # what the change does to the current, not to a number that may be zero
        if np.linalg.norm((found - before) * np.linalg.norm(rows, axis=0)) < _SETTLED * np.linalg.norm(target):
            estimate = _coil(found, rate_hz, "instrumental variable")
            return replace(estimate, warning=None if open_loop else _FEEDBACK)
    raise EstimationError(
        "the instrumental variable for the coil does not settle; voltage and current are not those of a coil at rest, "
        "or too noisy. Check channels.voltage and channels.current, or use the 'coil' model"
    )


def _regression(voltage: Array, current: Array) -> tuple[Array, Array]:
    if voltage.shape != current.shape or voltage.ndim != 1 or voltage.size < 10:
        raise EstimationError(
            f"voltage has shape {voltage.shape} and current {current.shape}; the coil needs two columns of one length, "
            "at least 10 samples. Check the record"
        )
    if np.ptp(voltage) == 0 or np.ptp(current) == 0:
        raise EstimationError("voltage or current is constant; a coil shows only when both change. Excite the coil")
    return np.stack([current[:-1], voltage[:-1], np.ones(voltage.size - 1)], axis=1), current[1:]


def _first_order(alpha: float, drive: Array, first: float) -> Array:
    """x[k+1] = alpha x[k] + drive[k], from x[0] = first; returns x at the samples of `drive`."""
    return run(np.array([[alpha, 1.0]]), drive[:, None], np.array([first]))[:-1, 0]


def _filtered(alpha: float, columns: Array) -> Array:
    """Columns through the coil's own lag 1/(1 - alpha q^-1)."""
    return np.stack([_first_order(alpha, np.ascontiguousarray(c), 0.0) for c in columns.T], axis=1)


def _coil(found: Array, rate_hz: float, method: Literal["least squares", "instrumental variable"]) -> CoilEstimate:
    alpha, beta = float(found[0]), float(found[1])
    if not (0 < alpha < 1 and np.isfinite(beta) and beta != 0):
        raise EstimationError(
            f"no decaying first-order coil fits (i[k+1] = {alpha:.4g} i[k] + {beta:.4g} V[k]). "
            "Check sign, delay and sampling rate"
        )
    a = -np.log(alpha) * rate_hz
    b = beta * a / (1 - alpha)
    return CoilEstimate(R=float(a / b), L=float(1 / b), a=float(a), b=float(b), method=method)
