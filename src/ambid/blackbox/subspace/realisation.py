"""What a subspace step returns before it gets units, and the Kalman gain from residual covariances (thesis 1.1-1.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_discrete_are, solve_triangular

from ambid.arrays import Array

_FLOORS = (1e-18, 1e-14, 1e-10, 1e-6)  # noise added to outputs of unit variance until the Riccati equation has a root

_DEPENDENT = 1e-11  # diagonal beside its largest below which columns count as dependent


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Realisation:
    """x+ = A x + B u + w, y = C x + D u + v with cov [w; v] = [Q S; S' R], and its innovations form; scaled
    channels.
    """

    A: Array  # (n, n)
    B: Array  # (n, n_inputs)
    C: Array  # (n_outputs, n)
    D: Array  # (n_outputs, n_inputs)
    K: Array  # (n, n_outputs)
    innovation: Array  # (n_outputs, n_outputs), covariance of the innovations
    Q: Array
    S: Array
    R: Array  # (n_outputs, n_outputs)
    stable_predictor: bool = True  # false where no gain was found that makes A - K C stable


def kalman_gain(A: Array, C: Array, Q: Array, S: Array, R: Array) -> tuple[Array, Array, bool]:
    """Return the gain K = (A P C' + S)(C P C' + R)^-1 of the stationary predictor, P from its Riccati equation.

    `A`: (n, n); `C`: (n_outputs, n); `Q`: (n, n); `S`: (n, n_outputs); `R`: (n_outputs, n_outputs). Returns `K`: (n,
    n_outputs); `innovation`: (n_outputs, n_outputs), C P C' + R; `found`: whether A - K C is stable; if not, K is the
    least-squares gain S R^-1.
    """
    eye = np.eye(C.shape[0])
    for floor in _FLOORS:
        noise = 0.5 * (R + R.T) + floor * eye
        try:
            P = solve_discrete_are(A.T, C.T, 0.5 * (Q + Q.T), noise, s=S)
        except (np.linalg.LinAlgError, ValueError):
            continue
        innovation = C @ P @ C.T + noise
        K = np.linalg.solve(innovation, (A @ P @ C.T + S).T).T
        if np.all(np.isfinite(K)) and radius(A - K @ C) < 1.0:
            return K, 0.5 * (innovation + innovation.T), True
    noise = 0.5 * (R + R.T) + _FLOORS[-1] * eye
    return np.asarray(np.linalg.solve(noise, S.T).T), noise, False


def radius(A: Array) -> float:
    """Return the largest magnitude of the eigenvalues.

    `A`: (n, n).
    """
    return float(np.max(np.abs(np.linalg.eigvals(A)), initial=0.0))


def least_squares(rows: Array, right: Array) -> Array:
    """Solve min |rows x - right| through an orthogonal factor; deficient columns get the shortest solution.

    `rows`: (n_rows, n_unknowns); `right`: (n_rows, n_right). Returns (n_unknowns, n_right).
    """
    n = rows.shape[1]
    if rows.shape[0] >= n > 0:
        factor = np.asarray(np.linalg.qr(np.hstack([rows, right]), mode="r"))
        size = np.abs(np.diag(factor[:n, :n]))
        if np.min(size) > _DEPENDENT * np.max(size):
            return np.asarray(solve_triangular(factor[:n, :n], factor[:n, n:], check_finite=False))
    return np.asarray(np.linalg.lstsq(rows, right, rcond=_DEPENDENT / 10)[0])


def observability(A: Array, C: Array, length: int) -> Array:
    """Return [C; C A; ...; C A^(length-1)].

    `A`: (n, n); `C`: (n_outputs, n). Returns (length * n_outputs, n).
    """
    blocks = [C]
    for _ in range(length - 1):
        blocks.append(blocks[-1] @ A)
    return np.vstack(blocks)
