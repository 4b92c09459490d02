"""From noise levels to the predictor: Kalman gain, innovation covariance and their exact derivatives.

Solves the filter Riccati equation by Newton steps from a gain nearby, from the stable subspace of the symplectic matrix
or from SciPy's solution, and differentiates it implicitly: with F = A - K C, dP = F dP F^T + dA P F^T + F P dA^T + dQ +
K dR K^T (a Lyapunov equation, because the gain is stationary in P).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array

_STEP = 1e-7  # of a Newton step, relative: convergence is quadratic, which leaves an error of about 1e-14


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


def predictor_gains(A: Array, C: Array, Q: Array, R: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the predictor gains of several plants at once, and for which of them the quick way leads to one.

    `A`, `Q`: (n_plants, n_states, n_states); `C`, `R`: as for `predictor_gain`, of all of them. Returns (n_plants,
    n_states, n_outputs).
    """
    P = _stable_subspace(A, C, Q, R)
    if P is None:
        return np.zeros((*A.shape[:-1], C.shape[0])), np.zeros(A.shape[0], dtype=bool)
    K = _gain_of(A, C, P, R)
    started = np.abs(np.linalg.eigvals(A - K @ C)).max(axis=-1) < 1.0
    for _ in range(8):
        before, P = P, solve_lyapunov(A - K @ C, Q + K @ R @ _turned(K))
        K = _gain_of(A, C, P, R)
        settled = np.abs(P - before).max(axis=(1, 2)) <= _STEP * np.abs(P).max(axis=(1, 2))
        if np.all(settled | ~started):
            break
    return K, started & settled


def _turned(a: NDArray[Any]) -> NDArray[Any]:
    """Transpose of one or several stacked matrices."""
    return np.swapaxes(a, -1, -2)


def _stable_subspace(A: Array, C: Array, Q: Array, R: Array) -> Array | None:
    """P from the eigenvectors of the symplectic matrix (Vaughan 1970): quick, and rough where poles crowd.

    Of one plant, or of several stacked; None where that is impossible for one of them.
    """
    n = A.shape[-1]
    try:
        back = _turned(np.linalg.inv(A))
        left = back @ C.T @ np.linalg.solve(R, C)
        values, vectors = np.linalg.eig(
            np.concatenate([np.concatenate([back, left], -1), np.concatenate([Q @ back, A + Q @ left], -1)], -2)
        )
        chosen = np.take_along_axis(vectors, np.argsort(np.abs(values))[..., None, n:], -1)
        P = np.real(_turned(np.linalg.solve(_turned(chosen[..., :n, :]), _turned(chosen[..., n:, :]))))
    except np.linalg.LinAlgError:
        return None
    return 0.5 * (P + _turned(P)) if np.all(np.isfinite(P)) else None


def _newton(A: Array, C: Array, Q: Array, R: Array, K: Array, before: Array | None = None) -> Array | None:
    """Iterate Newton-Kleinman from a stabilising gain; None where it does not settle in a few steps."""
    for _ in range(8):
        P = solve_lyapunov(A - K @ C, Q + K @ R @ K.T)
        if before is not None and np.abs(P - before).max() <= _STEP * np.abs(P).max():
            return P
        K, before = _gain_of(A, C, P, R), P
    return None


def _gain_of(A: Array, C: Array, P: Array, R: Array) -> Array:
    """Predictor gain A P C^T (C P C^T + R)^-1."""
    seen = C @ P
    return np.asarray(_turned(np.linalg.solve(seen @ C.T + R, seen @ _turned(A))), dtype=np.float64)


def solve_lyapunov(F: Array, Q: Array) -> Array:
    """Solve P = F P F^T + Q for one or several symmetric right-hand sides, or for several plants with one each.

    `F`: (n, n), stable, or (n_plants, n, n); `Q`: symmetric right-hand sides. Returns symmetric solutions.
    """
    n = F.shape[-1]
    kronecker = (F[..., :, None, :, None] * F[..., None, :, None, :]).reshape(*F.shape[:-2], n * n, n * n)
    right = Q.reshape(-1, n * n).T if F.ndim == 2 else Q.reshape(-1, n * n, 1)
    P = _turned(np.linalg.solve(np.eye(n * n) - kronecker, right)).reshape(Q.shape)
    return np.asarray(0.5 * (P + _turned(P)), dtype=np.float64)


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
