"""Order reduction of a law: balanced truncation of its stable part; integrals and growing modes are kept apart.

With the gramians P = A P A' + B B' and Q = A'Q A + C'C of the stable part, states are ordered by the Hankel singular
values σ, and the response changes by no more than 2 Σ σ of those left out (Moore 1981; Al-Saggaf and Franklin 1987).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ambid.arrays import Array
from ambid.errors import ModelError
from ambid.physics.law import StateLaw

_STABLE = 1e-6  # distance from the unit circle of a mode that is balanced


def reduced(law: StateLaw, order: int, largest: Array, command: float = 1.0) -> tuple[StateLaw, float]:
    """Return a law of lower order, and the largest change of its response, from `largest` to `command`.

    `largest`: of each signal it sees, in whose sizes errors count; ModelError where the kept modes alone are more.
    """
    from scipy.linalg import schur, solve_discrete_lyapunov, solve_sylvester, svd

    inside = 1.0 - _STABLE
    T, Z, n = schur(law.A, sort=lambda re, im: np.hypot(re, im) < inside)
    kept = law.order - n
    if order >= law.order:
        return law, 0.0
    if order < kept:
        raise ModelError(
            f"the law has {kept} integrals and growing modes, which cannot be left out; its order cannot become {order}"
        )
    S = np.eye(law.order)
    S[:n, n:] = solve_sylvester(T[:n, :n], -T[n:, n:], -T[:n, n:])  # T S = S diag: no coupling of the two parts
    to = Z @ S
    back = np.linalg.inv(to)
    A, B, G, C = back @ law.A @ to, back @ law.B, back @ law.windup, law.C @ to
    inputs = np.hstack([B[:n] * largest, G[:n] * command])
    P = solve_discrete_lyapunov(A[:n, :n], inputs @ inputs.T)
    Q = solve_discrete_lyapunov(A[:n, :n].T, C[:, :n].T @ C[:, :n] / command**2)
    left, right = _root(P), _root(Q)
    U, sigma, V = svd(right.T @ left)
    r = order - kept
    size = np.sqrt(np.maximum(sigma[:r], 1e-300))
    down, up = (U[:, :r] / size).T @ right.T, left @ V[:r].T / size
    rows, columns = np.zeros((order, law.order)), np.zeros((law.order, order))
    rows[:r, :n], columns[:n, :r] = down, up
    rows[r:, n:] = columns[n:, r:] = np.eye(kept)
    small = replace(law, A=rows @ A @ columns, B=rows @ B, C=C @ columns, G=rows @ G)
    return small, 2.0 * float(np.sum(sigma[r:]))


def _root(P: Array) -> Array:
    """Return L with P = L L', also where P is singular."""
    values, vectors = np.linalg.eigh((P + P.T) / 2.0)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
