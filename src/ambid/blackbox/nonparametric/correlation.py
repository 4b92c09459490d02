"""Correlation analysis: impulse response from the cross-correlation of prewhitened signals (Ljung 1999, sec. 6.1).

Both signals pass the filter that makes the input white; then R_yu(k) / R_uu(0) is the impulse response at lag k.
Simple, quick, and with a band that tells what no response at all would give; negative lags show feedback.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correlation:
    """Impulse responses by correlation, one input at a time."""

    lags: NDArray[np.int64]  # (n_lags,), samples, negative ones first
    time_s: Array  # (n_lags,), s
    values: Array  # (n_lags, n_outputs, n_inputs), output unit per input unit
    band: Array  # (n_outputs, n_inputs), 99 % of the values lie within it where there is no response
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: Mapping[str, str]
    order: int  # of the whitening filter
    warnings: tuple[str, ...]


def correlation_analysis(data: IOData, n_lags: int, *, order: int = 10) -> Correlation:
    """Estimate impulse responses by correlation.

    Parameters
    ----------
    data : IOData
        Inputs that do not go together.
    n_lags : int
        Lags on either side.
    order : int
        Of the autoregression that whitens each input; 0: none.

    Returns
    -------
    Correlation
        Warns where inputs are correlated, or negative lags stand out (feedback).

    Raises
    ------
    EstimationError
        If the record is too short, or has no input.
    """
    from scipy.signal import lfilter
    from scipy.stats import norm

    if not data.n_inputs:
        raise EstimationError("correlation analysis: no input is named. Give --input")
    n = data.n_samples - order
    if n_lags < 1 or order < 0 or n < 4 * n_lags + 4 * order + 20:
        raise EstimationError(
            f"correlation analysis: {data.n_samples} samples for {n_lags} lags and order {order}; at least "
            f"{4 * n_lags + 5 * order + 20} are needed. Record longer, or lower both"
        )
    values = np.empty((2 * n_lags + 1, data.n_outputs, data.n_inputs))
    band, warnings = np.empty((data.n_outputs, data.n_inputs)), list[str]()
    for i, name in enumerate(data.inputs):
        u = data.u[:, i] - data.u[:, i].mean()
        if not np.any(u):
            raise EstimationError(f"input {name!r} is constant; nothing can be learned from it. Excite it")
        whitening = _whitening(u, order)
        white = lfilter(whitening, 1.0, u)[order:]
        for o in range(data.n_outputs):
            y = lfilter(whitening, 1.0, data.y[:, o] - data.y[:, o].mean())[order:]
            values[:, o, i] = _cross(y, white, n_lags) / float(white @ white)
            band[o, i] = norm.isf(0.005) * y.std() / (white.std() * np.sqrt(n))
            outside = int(np.sum(np.abs(values[:n_lags, o, i]) > band[o, i]))
            if outside > _allowed(n_lags):
                warnings.append(
                    f"{outside} of {n_lags} negative lags from {name!r} to {data.outputs[o]!r} stand out: feedback was "
                    "at work, and these responses are biased. Use impulse_response"
                )
    if data.n_inputs > 1:
        together = np.abs(np.corrcoef(data.u.T) - np.eye(data.n_inputs)).max()
        if together > 4 / np.sqrt(n):
            warnings.append(
                f"inputs are correlated (up to {together:.2f}): one at a time is biased. Use impulse_response"
            )
    lags = np.arange(-n_lags, n_lags + 1)
    return Correlation(
        lags=lags,
        time_s=np.asarray(lags * data.dt, dtype=np.float64),
        values=values,
        band=band,
        inputs=data.inputs,
        outputs=data.outputs,
        units=data.units,
        order=order,
        warnings=tuple(warnings),
    )


def _whitening(u: Array, order: int) -> Array:
    """Coefficients of the autoregression of u, 1 first, by QR."""
    if not order:
        return np.ones(1)
    rows = np.column_stack([u[order - k : u.size - k] for k in range(order + 1)])
    found = np.linalg.lstsq(rows[:, 1:], rows[:, 0], rcond=1e-10)[0]  # a periodic input leaves directions open
    return np.concatenate([[1.0], -found])


def _cross(y: Array, u: Array, n_lags: int) -> Array:
    """Sums of y[t] u[t - k] for k = -n_lags to n_lags."""
    from scipy.fft import irfft, next_fast_len, rfft

    size = next_fast_len(y.size + n_lags)
    whole = irfft(rfft(y, size) * np.conj(rfft(u, size)), size)
    return np.concatenate([whole[-n_lags:], whole[: n_lags + 1]])


def _allowed(n: int) -> int:
    """How many of n values may lie outside a 99 % band by chance (one in a thousand records has more)."""
    from scipy.stats import binom

    return int(binom.isf(1e-3, n, 0.01))
