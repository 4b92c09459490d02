"""Horizons from an autoregression, and the order from the innovations that every number of states leaves.

The past is as long as the vector autoregression with inputs that Akaike's criterion likes best (Bauer 2005; Chiuso
2007); the order is the one with the smallest N log det(innovation covariance) + d(n) log N, d(n) = n (2 n_y + n_u)
numbers of a canonical form with n states.
"""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.subspace.compress import Factors, triangular

_NOISE_FREE = 1e-18  # variance beside outputs of unit variance that counts as rounding


def autoregression_criterion(factors: Factors, factor: Array) -> Array:
    """Return Akaike's criterion of autoregressions with inputs of 0, 1, 2 ... lags.

    `factor`: (n_columns, n_columns), of all groups. Returns (window,), N log det(residual covariance) + 2 (numbers
    estimated).
    """
    now, n_y, n_z = factors.length - 1, factors.n_outputs, factors.n_inputs + factors.n_outputs
    newest_first = [c for k in range(now - 1, -1, -1) for c in factors.columns("z", k, k + 1)]
    columns = [0, *newest_first, *factors.columns("y", now, now + 1)]
    y = triangular(factor[:, columns])[1:, -n_y:]
    left = np.array([_log_det(y[k * n_z :], factors.n_rows) for k in range(now + 1)])
    return np.asarray(factors.n_rows * left + 2.0 * n_y * n_z * np.arange(now + 1))


def state_criterion(states: Array, y: Array, n_inputs: int, n_rows: int) -> Array:
    """Return Bayes' criterion of 0, 1, 2 ... leading states as predictors of y(t).

    `states`: (n_states, n_coordinates), leading first; `y`: (n_outputs, n_coordinates or more), the first coordinates
    are those of the states. Returns (n_states + 1,).
    """
    basis = np.linalg.qr(states.T)[0]
    by_state = y[:, : basis.shape[0]] @ basis
    full = triangular(y.T)
    covariance = full.T @ full
    parts = np.einsum("ik,jk->kij", by_state, by_state)
    # what is left, from the end: sums of squares, never a difference that rounding makes negative
    rest = y.copy()
    rest[:, : basis.shape[0]] -= by_state @ basis.T
    last = rest @ rest.T
    left = np.concatenate([last + np.cumsum(parts[::-1], axis=0)[::-1], last[None]])
    left[0] = covariance
    n_y = y.shape[0]
    log_det = np.array([_log_det_of(v / n_rows) for v in left])
    n = np.arange(log_det.size)
    return np.asarray(n_rows * log_det + n * (2 * n_y + n_inputs) * np.log(n_rows))


def _log_det(rows: Array, n_rows: int) -> float:
    return _log_det_of(rows.T @ rows / n_rows)


def _log_det_of(covariance: Array) -> float:
    return float(np.linalg.slogdet(covariance + _NOISE_FREE * np.eye(covariance.shape[0]))[1])
