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
from ambid.estimation.linear import column_sizes
from ambid.estimation.sensitivity import Products, Workspace, products

P_LEAST = 1e-3  # 99.9 % bounds
_WHITE_LAGS = (1, 2, 3, 5, 8, 13)
_BLIND = 1e-12  # eigenvalue, over the largest, of directions that neither record nor priors see
_SAME = 1e-6  # length left of a column below which it counts as held by the others: lags of a slow input nearly are


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


def residual_tests(fit: Fit, e: Array) -> tuple[ResidualTest, ResidualTest]:
    """Test the innovations against their own past, and against past inputs.

    `e`: (n_used, n_outputs), innovations at the fit, scaled.
    """
    problem, weight = fit.problem, weight_of(fit.covariance)
    white, n = e @ weight.T, len(e)
    u = problem.u[problem.skip :: problem.stride] / problem.scales.input
    longest = max(2, n // 20)
    own = tuple(k for k in _WHITE_LAGS if k < n // 10)
    inputs = tuple(sorted({round(float(k)) for k in np.geomspace(1, min(longest, 400), 9)}))
    lagged = np.hstack([_lagged(white, own), _lagged(u, inputs)])
    lagged = lagged / np.maximum(np.linalg.norm(lagged, axis=0), 1e-300)
    work = fit.work if fit.work is not None else Workspace(problem)
    found = products(problem, fit.vector, weight, work.of(problem), lagged)
    if found is None:
        raise ValueError("the fit has no predictor; it has failed")
    first = len(own) * white.shape[1]
    return (
        _score_test(fit, found, white, lagged, own, slice(0, first)),
        _score_test(fit, found, white, lagged, inputs, slice(first, None)),
    )


def _score_test(
    fit: Fit, found: Products, white: Array, lagged: Array, lags: tuple[int, ...], which: slice
) -> ResidualTest:
    """Score test of some lagged columns as further regressors of every whitened innovation."""
    from scipy.special import chdtrc

    columns = lagged[:, which]
    statistic, degrees = _explained(fit, found, columns.T @ columns, which)
    correlation = (white.T @ columns) / np.linalg.norm(white, axis=0)[:, None]
    place = np.unravel_index(np.argmax(np.abs(correlation)), correlation.shape)
    return ResidualTest(
        p=float(chdtrc(max(degrees, 1), statistic)),
        statistic=statistic,
        degrees=degrees,
        largest=float(np.abs(correlation[place])),
        largest_lag=lags[int(place[1]) // (columns.shape[1] // len(lags))],
    )


def _lagged(signals: Array, lags: tuple[int, ...]) -> Array:
    """Columns of all signals at all lags, lag by lag, zero before the record."""
    out = np.zeros((signals.shape[0], len(lags) * signals.shape[1]))
    for j, lag in enumerate(lags):
        out[lag:, j * signals.shape[1] : (j + 1) * signals.shape[1]] = signals[:-lag]
    return out


def _explained(fit: Fit, found: Products, inner: Array, which: slice) -> tuple[float, int]:
    """Sum of squares that columns for every output explain beyond the Jacobian, and their rank beyond it.

    What the Jacobian and the priors explain is taken off by the Schur complement of their products, which lose no
    digits because the Jacobian is nearly orthonormal there.
    """
    p, (n_y, _, _) = fit.problem.size, found.cross.shape
    prior = fit.J_prior @ found.turn
    own = found.rows[:p, :p] + prior.T @ prior
    pull = found.rows[:p, p] + prior.T @ fit.r_prior
    cross = np.hstack([found.cross[o, :p, which] for o in range(n_y)])
    size = column_sizes(np.sqrt(np.diag(own))[None, :])
    values, vectors = np.linalg.eigh(own / np.outer(size, size))
    seen = values > _BLIND * values[-1]
    factor = (vectors[:, seen] / np.sqrt(values[seen])).T @ (np.column_stack([cross, pull]) / size[:, None])
    rest = np.kron(np.eye(n_y), inner) - factor[:, :-1].T @ factor[:, :-1]
    left = np.concatenate([found.cross[o, p, which] for o in range(n_y)]) - factor[:, :-1].T @ factor[:, -1]
    values, vectors = np.linalg.eigh(rest)
    kept = values > _SAME**2
    inside = (vectors[:, kept].T @ left) / np.sqrt(values[kept])
    return float(inside @ inside), int(np.count_nonzero(kept))
