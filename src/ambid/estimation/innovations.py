"""From noise levels to the predictor: Kalman gain, innovation covariance and their exact derivatives.

Solves the filter Riccati equation by Newton steps from a gain nearby, from the stable subspace of the symplectic matrix
or from SciPy's solution, and differentiates it implicitly: with F = A - K C, dP = F dP F^T + dA P F^T + F P dA^T + dQ +
K dR K^T (a Lyapunov equation, because the gain is stationary in P).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Innovations:
    """Stationary Kalman predictor."""

    K: Array  # (n_states, n_outputs), predictor gain, x[k+1|k] = A x[k|k-1] + ... + K e[k].
    P: Array  # (n_states, n_states), covariance of the prediction error of the state
    S: Array  # (n_outputs, n_outputs), covariance of the innovation


def predictor_gain(A: Array, C: Array, Q: Array, R: Array, *, near: Array | None = None) -> Innovations:
    """Solve P = A P A^T - A P C^T (C P C^T + R)^-1 C P A^T + Q and return the predictor gain.

    `A`: (n_states, n_states); `C`: (n_outputs, n_states); `Q`: (n_states, n_states), process noise covariance; `R`:
    (n_outputs, n_outputs), measurement noise covariance, positive definite; `near`: (n_states, n_outputs). Returns K, P
    and S; A - K C is stable.
    """
    K = near if near is not None and stable(A - near @ C) else None
    P = None if K is None else _newton(A, C, Q, R, K)
    if P is None:
        rough = _stable_subspace(A, C, Q, R)
        K = None if rough is None else _gain_of(A, C, rough, R)
        P = None if K is None or not stable(A - K @ C) else _newton(A, C, Q, R, K, rough)
    if P is None:
        from scipy.linalg import solve_discrete_are

        with np.errstate(invalid="ignore", over="ignore"):
            P = solve_discrete_are(A.T, C.T, Q, R)
        # the general solver's accuracy suffers where poles crowd at one; Newton takes it to rounding
        P = _newton(A, C, Q, R, _gain_of(A, C, P, R))
        if P is None:
            raise np.linalg.LinAlgError("the Riccati equation has no stabilising solution")
    S = C @ P @ C.T + R
    return Innovations(K=_gain_of(A, C, P, R), P=P, S=S)


def _stable_subspace(A: Array, C: Array, Q: Array, R: Array) -> Array | None:
    """P from the eigenvectors of the symplectic matrix (Vaughan 1970): quick, and rough where poles crowd."""
    n = A.shape[0]
    try:
        back = np.linalg.inv(A).T
        left = back @ C.T @ np.linalg.solve(R, C)
        values, vectors = np.linalg.eig(np.vstack([np.hstack([back, left]), np.hstack([Q @ back, A + Q @ left])]))
        chosen = vectors[:, np.argsort(np.abs(values))[n:]]
        P = np.real(np.linalg.solve(chosen[:n].T, chosen[n:].T).T)
    except np.linalg.LinAlgError:
        return None
    return 0.5 * (P + P.T) if np.all(np.isfinite(P)) else None


def _newton(A: Array, C: Array, Q: Array, R: Array, K: Array, before: Array | None = None) -> Array | None:
    """Iterate Newton-Kleinman from a stabilising gain; None where it does not settle in a few steps."""
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

    `F`: (n, n), stable; `Q`: symmetric right-hand sides. Returns symmetric solutions.
    """
    n = F.shape[0]
    kronecker = (F[:, None, :, None] * F[None, :, None, :]).reshape(n * n, n * n)
    P = np.linalg.solve(np.eye(n * n) - kronecker, Q.reshape(-1, n * n).T).T.reshape(Q.shape)
    return np.asarray(0.5 * (P + np.swapaxes(P, -1, -2)), dtype=np.float64)


def gain_derivatives(A: Array, C: Array, at: Innovations, dA: Array, dQ: Array, dR: Array) -> Array:
    """Differentiate the predictor gain exactly along p directions.

    `A`: (n_states, n_states); `C`: (n_outputs, n_states), independent of the parameters; `at`: solution at the point;
    `dA`, `dQ`: (p, n_states, n_states); `dR`: (p, n_outputs, n_outputs). Returns (p, n_states, n_outputs), dK = (dA P
    C^T + F dP C^T - K dR) S^-1.
    """
    F = A - at.K @ C
    cross = dA @ at.P @ F.T
    dP = solve_lyapunov(F, cross + np.swapaxes(cross, 1, 2) + dQ + at.K @ dR @ at.K.T)
    right = dA @ at.P @ C.T + F @ dP @ C.T - at.K @ dR
    return np.swapaxes(np.linalg.solve(at.S, np.swapaxes(right, 1, 2)), 1, 2)


def stable(F: Array) -> bool:
    """Return whether all eigenvalues of `F` lie inside the unit circle.

    `F`: (n, n). Returns true where the spectral radius is below one.
    """
    return bool(np.abs(np.linalg.eigvals(F)).max() < 1.0)


def stack(matrices: Sequence[Array], shape: tuple[int, ...]) -> Array:
    """Stack matrices along a new first axis, keeping the shape where there is none.

    Returns (p, *shape).
    """
    return np.array(matrices) if matrices else np.zeros((0, *shape))
