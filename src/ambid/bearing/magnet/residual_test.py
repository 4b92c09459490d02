"""Residual test of the extended Kalman predictor: is anything left in the innovations that their past explains?

Score tests as for the linear model (`ambid.validate.residuals`; Ljung 1999, sec. 16.6): lagged innovations, and lagged
voltages, are put beside the sensitivities as regressors of the innovations. A lag between current and force (an eddy
pole) leaves the innovations white, as the levels of the noise grow over it, but not independent of past voltages.
Future inputs, which hang on present innovations under feedback, are not used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.bearing.magnet.likelihood import BearingFit, run

_LAGS = (1, 2, 3, 5, 8, 13)
_INPUT_LAGS = (1, 2, 3, 4, 6, 9, 14, 21)


@dataclass(frozen=True, slots=True, kw_only=True)
class WhitenessTest:
    """Outcome for one record."""

    # probability of at least this much if the model is right, by both tests together: twice the smaller of them
    p: float
    p_own: float  # against past innovations, and against past voltages
    p_input: float
    largest: float  # largest correlation of an innovation with an earlier one, in magnitude
    # root mean square innovations of position in m and current in A; NaN for what is not measured
    innovation_sd: tuple[float, float]


def whiteness(fit: BearingFit, r: int) -> WhitenessTest:
    """Test the innovations of one record against their own past.

    `fit`: not failed; `r`: which record.
    """
    found = run(fit.problem, fit.vector, r, slopes=True)
    assert found is not None
    outputs = (1,) if fit.problem.records[r].held else (0, 1)
    n, first = found.e.shape[0], fit.problem.skip
    white = found.e[:, outputs] / np.sqrt(found.s[:, outputs])
    white = np.nan_to_num(white)
    jacobian = found.rows.reshape(n, 4, -1)[:, [2 * c for c in outputs], :-1]
    begin = first + max(*_LAGS, *_INPUT_LAGS)
    lagged = np.hstack([white[begin - k : n - k] for k in _LAGS])
    u = fit.problem.records[r].u
    inputs = np.column_stack([u[begin - k : n - k] for k in _INPUT_LAGS])
    target, slopes = white[begin:], jacobian[begin:]
    own, by_input = _explained(target, slopes, lagged), _explained(target, slopes, inputs)
    spread = np.std(target, axis=0)
    correlation = np.abs(lagged.T @ target) / target.shape[0] / np.outer(np.tile(spread, len(_LAGS)), spread)
    rms = [float(np.sqrt(np.nanmean(found.e[first:, c] ** 2))) if c in outputs else float("nan") for c in (0, 1)]
    return WhitenessTest(
        p=min(1.0, 2.0 * min(own, by_input)), p_own=own, p_input=by_input, largest=float(correlation.max()),
        innovation_sd=(rms[0], rms[1]),
    )  # fmt: skip


def _explained(target: Array, slopes: Array, regressors: Array) -> float:
    """Probability of what the regressors explain of the innovations (n, n_outputs) beyond the sensitivities."""
    from scipy.stats import chi2

    n_o, n_s = target.shape[1], slopes.shape[2]
    scaled = regressors - regressors.mean(axis=0)
    spread = np.sqrt(np.mean(scaled**2, axis=0))
    scaled = scaled[:, spread > 0.0] / spread[spread > 0.0]
    n_l = scaled.shape[1]
    if n_l == 0:
        return 1.0
    rows = np.zeros((target.size, n_s + n_l * n_o + 1))
    for c in range(n_o):
        part = rows[c::n_o]
        part[:, :n_s] = slopes[:, c]
        part[:, n_s + c * n_l : n_s + (c + 1) * n_l] = scaled
        part[:, -1] = target[:, c]
    # the rows of R that belong to the regressors: what they explain beyond the sensitivities
    R: Array = np.asarray(np.linalg.qr(rows, mode="r"))
    return float(chi2.sf(float(np.sum(R[n_s:-1, -1] ** 2)), n_l * n_o))
