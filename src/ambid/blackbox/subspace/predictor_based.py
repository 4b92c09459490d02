"""PBSID-opt: the state from a long vector autoregression with inputs, which feedback does not disturb.

Solves: y(t) = sum_k Phi_k z(t-k) + d + e(t) by least squares: its regressors are all older than e(t), whatever made the
inputs. Phi holds the Markov parameters C (A - K C)^(k-1) [B - K D, K] of the predictor, so the shifted blocks of Phi
times the past are the observability matrix times the state; one singular value decomposition separates them, and
A, B, C, K follow by regression of states on states (Chiuso and Picci 2005; Chiuso 2007, Automatica 43, 1034).

Band-limited inputs leave directions of Phi unseen, and shifting brings them into view. So Phi has a prior that fades
with the lag, Phi_k ~ N(0, size decay^k), its two numbers by the marginal likelihood (Pillonetto, Chen, Chiuso,
De Nicolao and Ljung 2022, ch. 4): where the data speak it does not count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from ambid.arrays import Array
from ambid.blackbox.subspace.compress import Factors
from ambid.blackbox.subspace.realisation import Realisation, kalman_gain, least_squares, radius

_LEAST_NOISE = 1e-9  # innovations' deviation beside outputs of unit deviation: less is rounding
_DECAYS = (0.6, 0.75, 0.85, 0.92, 0.96, 0.98, 1.0)  # of the prior's variance, per sample of lag
_SIZES = 10.0 ** np.arange(-3.0, 21.0, 0.5)  # of the prior's variance, whitened outputs on scaled channels


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prior:
    """What is believed of an autoregression before the data: coefficients of lag k are N(0, size decay^k)."""

    decay: float
    size: Array  # (n_outputs,), for whitened outputs
    whiten: Array  # (n_outputs, n_outputs), y @ whiten has innovations of unit covariance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prediction:
    """States of all orders and what the regressions need, in coordinates of the triangular factor."""

    values: Array  # (n_values,), singular values, in innovations' standard deviations
    state: Array  # (n_values, n_coordinates), coordinates of the states at t and t + 1, unit variance, leading first
    ahead: Array
    u: Array  # (n_inputs, n_coordinates)
    y: Array  # (n_outputs, n_coordinates)
    n_rows: int


def predictor_columns(factors: Factors, past: int) -> list[int]:
    """Return the columns of the regression: past, u(t), y(t).

    `past`: samples; less than the window.
    """
    now = factors.length - 1
    return (
        factors.columns("z", now - past, now) + factors.columns("u", now, now + 1) + factors.columns("y", now, now + 1)
    )


def prior(factor: Array, *, past: int, feedthrough: bool, like: Factors) -> Prior:
    """Return the prior of the autoregression that makes the data most likely.

    `factor`: (n_columns, n_columns), of the constant and `predictor_columns`; `past`: samples; `like`: for the sizes.
    """
    rows, y, lags = _regression(factor, past, feedthrough, like)
    k = rows.shape[1]
    # upper triangular, error' error is the covariance of the innovations
    error = np.linalg.qr(y[k:], mode="r") / np.sqrt(max(like.n_rows - k, 1))
    size = np.maximum(np.abs(np.diag(error)), _LEAST_NOISE)
    sign = np.where(np.diag(error) < 0, -1.0, 1.0)
    whiten = np.linalg.inv(np.triu(error, 1) + np.diag(sign * size))
    y = y[:k] @ whiten
    best = np.inf
    for decay in _DECAYS:
        fade = decay ** (0.5 * lags)
        left, s, _ = np.linalg.svd(rows * fade)
        c = left.T @ y
        grown = 1.0 + _SIZES[:, None] * s**2  # (sizes, k)
        cost = np.sum(np.log(grown), axis=1)[:, None] + (1.0 / grown) @ c**2  # (sizes, outputs)
        total = float(np.sum(np.min(cost, axis=0)))
        if total < best:
            best, found = total, (decay, _SIZES[np.argmin(cost, axis=0)])
    return Prior(decay=found[0], size=found[1], whiten=np.asarray(whiten))


def predicted(factor: Array, *, past: int, future: int, feedthrough: bool, like: Factors, given: Prior) -> Prediction:
    """Fit the autoregression and decompose what it says of the future.

    `factor`: (n_columns, n_columns), of the constant and `predictor_columns`; `past`, `future`: samples, future <=
    past; `feedthrough`: whether u(t) acts on y(t); `like`: for the sizes; `given`: of the autoregression.
    """
    n_u, n_y = like.n_inputs, like.n_outputs
    n_z, width = n_u + n_y, (n_u + n_y) * past
    r = factor[1:, 1:]
    rows, y, lags = _regression(factor, past, feedthrough, like)
    phi = _with_prior(rows, y[: rows.shape[1]] @ given.whiten, lags, given)[:width].T  # in innovations' deviations
    blocks = np.zeros((future, n_y, width))
    for i in range(future):
        blocks[i, :, i * n_z :] = phi[:, : width - i * n_z]
    known = blocks.reshape(future * n_y, width)
    left, values, right = np.linalg.svd(known @ r[:width, :width].T, full_matrices=False)
    n_values = int(np.sum(values > 1e-13 * values[0]))
    unit = np.sqrt(like.n_rows)
    state = np.zeros((n_values, r.shape[0]))
    state[:, :width] = right[:n_values] * unit
    to_state = (left[:, :n_values].T @ known) * (unit / values[:n_values, None])
    return Prediction(
        values=values[:n_values] / unit,
        state=state,
        ahead=to_state @ r[:, n_z : width + n_z].T,
        u=r[:, width : width + n_u].T,
        y=r[:, width + n_u :].T,
        n_rows=like.n_rows,
    )


def regressed(prediction: Prediction, n: int, *, feedthrough: bool) -> Realisation:
    """Return the model of order `n`.

    `feedthrough`: whether to estimate D; else it is zero.
    """
    p = prediction
    x, ahead, n_u = p.state[:n], p.ahead[:n], p.u.shape[0]
    known = np.vstack([x, p.u]) if feedthrough else x
    CD = least_squares(known.T, p.y.T).T
    C = CD[:, :n]
    D = CD[:, n:] if feedthrough else np.zeros((p.y.shape[0], n_u))
    e = p.y - CD @ known
    ABK = least_squares(np.vstack([x, p.u, e]).T, ahead.T).T
    A, B, K = ABK[:, :n], ABK[:, n : n + n_u], ABK[:, n + n_u :]
    w = ahead - A @ x - B @ p.u
    Q, S, R = w @ w.T / p.n_rows, w @ e.T / p.n_rows, e @ e.T / p.n_rows
    innovation, stable = R, True
    if radius(A - K @ C) >= 1.0:
        K, innovation, stable = kalman_gain(A, C, Q, S, R)
    return Realisation(A=A, B=B, C=C, D=D, K=K, innovation=innovation, Q=Q, S=S, R=R, stable_predictor=stable)


def _regression(factor: Array, past: int, feedthrough: bool, like: Factors) -> tuple[Array, Array, Array]:
    """Return the triangular rows of the regressors, the coordinates of y(t), and the lag of every regressor."""
    n_u, n_z = like.n_inputs, like.n_inputs + like.n_outputs
    width = n_z * past
    k = width + (n_u if feedthrough else 0)
    lags = np.concatenate([np.repeat(np.arange(past, 0, -1.0), n_z), np.zeros(k - width)])
    return factor[1 : 1 + k, 1 : 1 + k], factor[1:, 1 + width + n_u :], lags


def _with_prior(rows: Array, right: Array, lags: Array, given: Prior) -> Array:
    """Solve for whitened coefficients, the prior as further rows: orthogonal, and once for outputs of one size."""
    out = np.empty((rows.shape[1], right.shape[1]))
    for size in np.unique(given.size):
        chosen = given.size == size
        deviation = np.sqrt(size) * given.decay ** (0.5 * lags)
        scaled = np.vstack([rows * deviation, np.eye(lags.size)])
        target = np.vstack([right[:, chosen], np.zeros((lags.size, int(chosen.sum())))])
        both = np.asarray(np.linalg.qr(np.hstack([scaled, target]), mode="r"))
        n = lags.size
        out[:, chosen] = deviation[:, None] * solve_triangular(both[:n, :n], both[:n, n:])
    return out
