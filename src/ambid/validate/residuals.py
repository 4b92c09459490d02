"""Residual tests: is anything left in the innovations that the past explains?

Both tests are score tests: lagged signals are added to the weighted Jacobian as further regressors of the innovations,
and the fall of their sum of squares is chi-squared with as many degrees of freedom if the model is right. Because the
regressors compete with the Jacobian, the estimated numbers are accounted for, and because only the past is used,
feedback does not disturb them: future inputs do depend on present innovations when a controller is at work (Ljung 1999,
sec. 16.6).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.estimation.likelihood import Fit, weight_of
from ambid.estimation.sensitivity import Workspace, reduce_rows, residual_blocks

P_LEAST = 1e-3  # 99.9 % bounds
_WHITE_LAGS = (1, 2, 3, 5, 8, 13)


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualTest:
    """Outcome of a residual test."""

    p: float  # probability of at least this much if the model is right
    statistic: float  # fall of the weighted sum of squares
    degrees: int  # degrees of freedom
    largest: float  # largest correlation coefficient among the tested pairs, in magnitude
    largest_lag: int  # its lag in samples

    @property
    def passed(self) -> bool:
        """Whether p is at least 0.001."""
        return self.p >= P_LEAST


def residuals_white(fit: Fit, e: Array) -> ResidualTest:
    """Test the innovations against their own past.

    `e`: (n_used, n_outputs), innovations at the fit, scaled.
    """
    white = e @ weight_of(fit.covariance).T
    lags = tuple(k for k in _WHITE_LAGS if k < len(e) // 10)
    return _score_test(fit, white, white, lags)


def residuals_uncorrelated(fit: Fit, e: Array) -> ResidualTest:
    """Test the innovations against past inputs.

    `e`: (n_used, n_outputs), innovations at the fit, scaled.
    """
    problem = fit.problem
    u = problem.u[problem.skip :: problem.stride] / problem.scales.input
    longest = max(2, len(e) // 20)
    lags = tuple(sorted({round(float(k)) for k in np.geomspace(1, min(longest, 400), 9)}))
    white = e @ weight_of(fit.covariance).T
    return _score_test(fit, white, u, lags)


def _score_test(fit: Fit, white: Array, signals: Array, lags: tuple[int, ...]) -> ResidualTest:
    """Score test of lagged `signals` as further regressors of every whitened innovation."""
    from scipy.special import chdtrc

    problem, n_y = fit.problem, white.shape[1]
    p, per_output = problem.size, len(lags) * signals.shape[1]
    lagged = _lagged(signals, lags)
    lagged = lagged / np.maximum(np.linalg.norm(lagged, axis=0), 1e-300)
    first, work, blocks = 0, Workspace(problem), list[Array]()
    for rows in residual_blocks(problem, fit.vector, weight_of(fit.covariance), work):
        m = rows.shape[0]
        wide = np.zeros((m, n_y, p + n_y * per_output + 1))
        wide[:, :, :p] = rows[:, :, :p]
        wide[:, :, -1] = rows[:, :, p]
        for o in range(n_y):
            wide[:, o, p + o * per_output : p + (o + 1) * per_output] = lagged[first : first + m]
        blocks.append(reduce_rows(wide.reshape(m * n_y, -1)))
        first += m
    R = reduce_rows(np.vstack(blocks), last=True)
    statistic, degrees = _explained(R, p, fit)
    correlation = (white.T @ lagged) / np.linalg.norm(white, axis=0)[:, None]
    place = np.unravel_index(np.argmax(np.abs(correlation)), correlation.shape)
    return ResidualTest(
        p=float(chdtrc(max(degrees, 1), statistic)),
        statistic=statistic,
        degrees=degrees,
        largest=float(np.abs(correlation[place])),
        largest_lag=lags[int(place[1]) // signals.shape[1]],
    )


def _lagged(signals: Array, lags: tuple[int, ...]) -> Array:
    """Columns of all signals at all lags, lag by lag, zero before the record."""
    out = np.zeros((signals.shape[0], len(lags) * signals.shape[1]))
    for j, lag in enumerate(lags):
        out[lag:, j * signals.shape[1] : (j + 1) * signals.shape[1]] = signals[:-lag]
    return out


def _explained(R: Array, p: int, fit: Fit) -> tuple[float, int]:
    """Sum of squares that the added columns explain beyond the Jacobian's, and their rank beyond it."""
    prior = np.zeros((fit.J_prior.shape[0], R.shape[1]))
    prior[:, :p], prior[:, -1] = fit.J_prior, fit.r_prior
    a = np.vstack([R, prior])
    norm = np.linalg.norm(a[:, :-1], axis=0)
    norm[norm == 0] = 1.0
    a[:, :-1] /= norm
    base, s, _ = np.linalg.svd(a[:, :p], full_matrices=False)
    base = base[:, s > 1e-10 * s[0]]
    rest = a[:, p:] - base @ (base.T @ a[:, p:])
    u, s, _ = np.linalg.svd(rest[:, :-1], full_matrices=False)
    u = u[:, s > 1e-6]  # lags of a slow input are nearly the same column
    inside = u.T @ rest[:, -1]
    return float(inside @ inside), int(u.shape[1])
