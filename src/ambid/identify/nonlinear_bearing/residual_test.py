"""Residual test of the extended Kalman predictor: is anything left in the innovations that their past explains?

A score test as for the linear model (`ambid.validate.residuals`; Ljung 1999, sec. 16.6): lagged innovations are put
beside the sensitivities as regressors of the innovations; future inputs, which hang on present innovations under
feedback, are not used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.identify.nonlinear_bearing.likelihood import BearingFit, run

Array = NDArray[np.float64]

_LAGS = (1, 2, 3, 5, 8, 13)


@dataclass(frozen=True, slots=True, kw_only=True)
class WhitenessTest:
    """Outcome for one record.

    Attributes
    ----------
    p : float
        Probability of at least this much if the model is right.
    largest : float
        Largest correlation of an innovation with an earlier one, in magnitude.
    innovation_sd : (float, float)
        Root mean square innovations of position in m and current in A; NaN for what is not measured.
    """

    p: float
    largest: float
    innovation_sd: tuple[float, float]


def whiteness(fit: BearingFit, r: int) -> WhitenessTest:
    """Test the innovations of one record against their own past.

    Parameters
    ----------
    fit : BearingFit
        Not failed.
    r : int
        Which record.

    Returns
    -------
    WhitenessTest
    """
    from scipy.stats import chi2

    found = run(fit.problem, fit.vector, r, slopes=True)
    assert found is not None
    outputs = (1,) if fit.problem.records[r].held else (0, 1)
    n, first = found.e.shape[0], fit.problem.skip
    white = found.e[:, outputs] / np.sqrt(found.s[:, outputs])
    white = np.nan_to_num(white)
    jacobian = found.rows.reshape(n, 4, -1)[:, [2 * c for c in outputs], :-1]
    last = max(_LAGS)
    lagged = np.hstack([white[first + last - k : n - k] for k in _LAGS])
    target, slopes = white[first + last :], jacobian[first + last :]
    n_l, n_o = lagged.shape[1], len(outputs)
    rows = np.zeros((target.size, slopes.shape[2] + n_l * n_o + 1))
    for c in range(n_o):
        part = rows[c::n_o]
        part[:, : slopes.shape[2]] = slopes[:, c]
        part[:, slopes.shape[2] + c * n_l : slopes.shape[2] + (c + 1) * n_l] = lagged
        part[:, -1] = target[:, c]
    # the rows of R that belong to the lagged innovations: what they explain beyond the sensitivities
    R: Array = np.asarray(np.linalg.qr(rows, mode="r"))
    statistic = float(np.sum(R[slopes.shape[2] : -1, -1] ** 2))
    spread = np.std(target, axis=0)
    correlation = np.abs(lagged.T @ target) / target.shape[0] / np.outer(np.tile(spread, len(_LAGS)), spread)
    rms = [float(np.sqrt(np.nanmean(found.e[first:, c] ** 2))) if c in outputs else float("nan") for c in (0, 1)]
    return WhitenessTest(
        p=float(chi2.sf(statistic, n_l * n_o)), largest=float(correlation.max()), innovation_sd=(rms[0], rms[1])
    )
