"""From noise levels to the predictor: Kalman gain, innovation covariance and their exact derivatives.

Solves the filter Riccati equation with SciPy and differentiates it implicitly: with F = A - K C,
dP = F dP F^T + dA P F^T + F P dA^T + dQ + K dR K^T (a Lyapunov equation, because the gain is stationary in P).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Innovations:
    """Stationary Kalman predictor.

    Attributes
    ----------
    K : ndarray, shape (n_states, n_outputs)
        Predictor gain, x[k+1|k] = A x[k|k-1] + ... + K e[k].
    P : ndarray, shape (n_states, n_states)
        Covariance of the prediction error of the state.
    S : ndarray, shape (n_outputs, n_outputs)
        Covariance of the innovation.
    """

    K: Array
    P: Array
    S: Array


def predictor_gain(A: Array, C: Array, Q: Array, R: Array, *, near: Array | None = None) -> Innovations:
    """Solve P = A P A^T - A P C^T (C P C^T + R)^-1 C P A^T + Q and return the predictor gain.

    Parameters
    ----------
    A : ndarray, shape (n_states, n_states)
    C : ndarray, shape (n_outputs, n_states)
    Q : ndarray, shape (n_states, n_states)
        Process noise covariance.
    R : ndarray, shape (n_outputs, n_outputs)
        Measurement noise covariance, positive definite.
    near : ndarray, shape (n_states, n_outputs), optional
        A gain near the solution: where it stabilises A - K C, Newton's method from there replaces the general solver.

    Returns
    -------
    Innovations
        K, P and S; A - K C is stable.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the equation has no stabilising solution.
    """
    K = near if near is not None and stable(A - near @ C) else None
    P = None if K is None else _newton(A, C, Q, R, K)
    if P is None:
        from scipy.linalg import solve_discrete_are

        P = solve_discrete_are(A.T, C.T, Q, R)
        # the general solver's accuracy suffers where poles crowd at one; Newton takes it to rounding
        P = _newton(A, C, Q, R, _gain_of(A, C, P, R))
        if P is None:
            raise np.linalg.LinAlgError("the Riccati equation has no stabilising solution")
    S = C @ P @ C.T + R
    return Innovations(K=_gain_of(A, C, P, R), P=P, S=S)


def _newton(A: Array, C: Array, Q: Array, R: Array, K: Array) -> Array | None:
    """Iterate Newton-Kleinman from a stabilising gain; None where it does not settle in a few steps."""
    before = None
    for _ in range(8):
        P = solve_lyapunov(A - K @ C, Q + K @ R @ K.T)
        # quadratic convergence: a step of 1e-7 leaves an error of about 1e-14
        if before is not None and np.abs(P - before).max() <= 1e-7 * np.abs(P).max():
            return P
        K, before = _gain_of(A, C, P, R), P
    return None


def _gain_of(A: Array, C: Array, P: Array, R: Array) -> Array:
    """Predictor gain A P C^T (C P C^T + R)^-1."""
    seen = C @ P
    return np.asarray(np.linalg.solve(seen @ C.T + R, seen @ A.T).T, dtype=np.float64)


def solve_lyapunov(F: Array, Q: Array) -> Array:
    """Solve P = F P F^T + Q for one or several symmetric right-hand sides.

    Parameters
    ----------
    F : ndarray, shape (n, n)
        Stable.
    Q : ndarray, shape (n, n) or (p, n, n)
        Symmetric right-hand sides.

    Returns
    -------
    ndarray, shape of `Q`
        Symmetric solutions.
    """
    n = F.shape[0]
    kronecker = (F[:, None, :, None] * F[None, :, None, :]).reshape(n * n, n * n)
    P = np.linalg.solve(np.eye(n * n) - kronecker, Q.reshape(-1, n * n).T).T.reshape(Q.shape)
    return np.asarray(0.5 * (P + np.swapaxes(P, -1, -2)), dtype=np.float64)


def gain_derivatives(A: Array, C: Array, at: Innovations, dA: Array, dQ: Array, dR: Array) -> Array:
    """Differentiate the predictor gain exactly along p directions.

    Parameters
    ----------
    A : ndarray, shape (n_states, n_states)
    C : ndarray, shape (n_outputs, n_states)
        Independent of the parameters.
    at : Innovations
        Solution at the point.
    dA, dQ : ndarray, shape (p, n_states, n_states)
    dR : ndarray, shape (p, n_outputs, n_outputs)

    Returns
    -------
    ndarray, shape (p, n_states, n_outputs)
        dK = (dA P C^T + F dP C^T - K dR) S^-1.
    """
    F = A - at.K @ C
    cross = dA @ at.P @ F.T
    dP = solve_lyapunov(F, cross + np.swapaxes(cross, 1, 2) + dQ + at.K @ dR @ at.K.T)
    right = dA @ at.P @ C.T + F @ dP @ C.T - at.K @ dR
    return np.swapaxes(np.linalg.solve(at.S, np.swapaxes(right, 1, 2)), 1, 2)


def stable(F: Array) -> bool:
    """Return whether all eigenvalues of `F` lie inside the unit circle.

    Parameters
    ----------
    F : ndarray, shape (n, n)

    Returns
    -------
    bool
        True where the spectral radius is below one.
    """
    return bool(np.abs(np.linalg.eigvals(F)).max() < 1.0)


def stack(matrices: Sequence[Array], shape: tuple[int, ...]) -> Array:
    """Stack matrices along a new first axis, keeping the shape where there is none.

    Parameters
    ----------
    matrices : Sequence of ndarray, each of shape `shape`
    shape : tuple of int

    Returns
    -------
    ndarray, shape (p, *shape)
    """
    return np.array(matrices) if matrices else np.zeros((0, *shape))
