"""PBSID-opt: the state from a long vector autoregression with inputs, which feedback does not disturb.

Solves: y(t) = sum_k Phi_k z(t-k) + d + e(t) by least squares: its regressors are all older than e(t), whatever made the
inputs. Phi holds the Markov parameters C (A - K C)^(k-1) [B - K D, K] of the predictor, so the shifted blocks of Phi
times the past are the observability matrix times the state; one singular value decomposition separates them, and
A, B, C, K follow by regression of states on states (Chiuso and Picci 2005; Chiuso 2007, Automatica 43, 1034).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from ambid.identify.subspace.compress import Factors
from ambid.identify.subspace.realisation import Realisation, kalman_gain, least_squares, radius

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prediction:
    """States of all orders and what the regressions need, in coordinates of the triangular factor.

    Attributes
    ----------
    values : ndarray, shape (n_values,)
        Singular values, in innovations' standard deviations.
    state, ahead : ndarray, shape (n_values, n_coordinates)
        Coordinates of the states at t and t + 1, unit variance, leading first.
    u : ndarray, shape (n_inputs, n_coordinates)
    y : ndarray, shape (n_outputs, n_coordinates)
    n_rows : int
    """

    values: Array
    state: Array
    ahead: Array
    u: Array
    y: Array
    n_rows: int


def predictor_columns(factors: Factors, past: int) -> list[int]:
    """Return the columns of the regression: past, u(t), y(t).

    Parameters
    ----------
    factors : Factors
    past : int
        Samples; less than the window.

    Returns
    -------
    list of int
    """
    now = factors.length - 1
    return (
        factors.columns("z", now - past, now) + factors.columns("u", now, now + 1) + factors.columns("y", now, now + 1)
    )


def predicted(factor: Array, *, past: int, future: int, feedthrough: bool, like: Factors) -> Prediction:
    """Fit the autoregression and decompose what it says of the future.

    Parameters
    ----------
    factor : ndarray, shape (n_columns, n_columns)
        Of the constant and `predictor_columns`.
    past, future : int
        Samples, future <= past.
    feedthrough : bool
        Whether u(t) acts on y(t).
    like : Factors
        For the sizes.

    Returns
    -------
    Prediction
    """
    n_u, n_y = like.n_inputs, like.n_outputs
    n_z = n_u + n_y
    r = factor[1:, 1:]
    width = n_z * past
    k = width + (n_u if feedthrough else 0)
    y = r[:, width + n_u :]
    phi = regression(r[:k, :k], y[:k])[:width].T
    error = np.linalg.qr(y[k:], mode="r") / np.sqrt(like.n_rows)  # triangular: error' error is the covariance
    size = np.maximum(np.abs(np.diag(error)), 1e-9)
    whiten = np.linalg.inv(np.triu(error, 1) + np.diag(size)).T
    blocks = np.zeros((future, n_y, width))
    for i in range(future):
        blocks[i, :, i * n_z :] = whiten @ phi[:, : width - i * n_z]
    known = blocks.reshape(future * n_y, width)
    left, values, right = np.linalg.svd(known @ r[:width, :width].T, full_matrices=False)
    n_values = int(np.sum(values > 1e-13 * values[0]))
    to_state = (left[:, :n_values].T @ known) / values[:n_values, None] * np.sqrt(like.n_rows)
    state = np.zeros((n_values, r.shape[0]))
    state[:, :width] = right[:n_values] * np.sqrt(like.n_rows)
    later = np.concatenate([np.arange(n_z, width + n_z)])
    return Prediction(
        values=values / np.sqrt(like.n_rows),
        state=state,
        ahead=to_state @ r[:, later].T,
        u=r[:, width : width + n_u].T,
        y=y.T,
        n_rows=like.n_rows,
    )


def regressed(prediction: Prediction, n: int, *, feedthrough: bool) -> Realisation:
    """Return the model of order `n`.

    Parameters
    ----------
    prediction : Prediction
    n : int
    feedthrough : bool
        Whether to estimate D; else it is zero.

    Returns
    -------
    Realisation
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


def regression(factor: Array, right: Array) -> Array:
    """Solve a triangular least-squares problem, with the shortest solution where columns depend on each other.

    Parameters
    ----------
    factor : ndarray, shape (n, n)
        Upper triangular.
    right : ndarray, shape (n, n_right)

    Returns
    -------
    ndarray, shape (n, n_right)
    """
    size = np.abs(np.diag(factor))
    if size.size and np.min(size) > 1e-11 * np.max(size):
        return np.asarray(solve_triangular(factor, right))
    return least_squares(factor, right)
