"""Exact discretisation under a zero-order hold, with exact derivatives.

The input is held over a sample and may reach the plant a fraction of a sample late: over one period the plant
sees first the previous value, then the present one (Astrom and Wittenmark, Computer-Controlled Systems, ch. 2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.physics.linear_model import StateSpace


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DiscreteSpace:
    """Matrices of x[k+1] = A x[k] + B u[k-d] + B_late u[k-d-1] + E d[k], y[k] = C x[k]."""

    A: Array  # (n_states, n_states)
    B: Array  # (n_states, n_inputs), `B_late` is zero where the delay is a whole number of samples
    B_late: Array
    E: Array  # (n_states, n_disturbances), disturbances held over a sample
    C: Array  # (n_outputs, n_states)


def zero_order_hold(A: Array, B: Array, period_s: float) -> tuple[Array, Array]:
    """Discretise x' = A x + B u exactly, u held over a sample.

    exp([[A, B], [0, 0]] T) holds both (Van Loan 1978).

    `A`: (n_states, n_states), complex for a complex step; `B`: (n_states, n_inputs); `period_s`: sampling period in s.
    Returns `A_d`: (n_states, n_states); `B_d`: (n_states, n_inputs).
    """
    from scipy.linalg import expm

    n, n_u = B.shape
    block = np.zeros((n + n_u, n + n_u), dtype=np.result_type(A, B))
    block[:n, :n], block[:n, n:] = A, B
    full = np.asarray(expm(block * period_s))
    return full[:n, :n], full[:n, n:]


def discretise(
    space: StateSpace, period_s: float, *, fraction: float | None = None, derivatives: Sequence[StateSpace] = ()
) -> tuple[DiscreteSpace, tuple[DiscreteSpace, ...]]:
    """Discretise exactly, together with the derivatives along given directions.

    exp([[A, B, E], [0, 0, 0]] T) holds A_d, B_d and E_d (Van Loan 1978); the derivative along (dA, dB, dE) is the
    upper right block of exp([[M, dM], [0, M]] T) (Mathias 1996).

    `space`: continuous-time matrices; `period_s`: sampling period in s; `derivatives`: directions (dA, dB, dE); dC is
    passed on. Returns `discrete`: the discrete matrices; `directional`: their derivatives, one for each direction;
    where `fraction` is given, one more: along the fraction itself.
    """
    from scipy.linalg import expm

    n, nu = space.B.shape
    size = n + nu + space.E.shape[1]
    kind = np.result_type(space.A, space.B, space.E)
    stack = np.zeros((max(1, len(derivatives)), 2 * size, 2 * size), dtype=kind)
    edges = (slice(0, n), slice(n, n + nu), slice(n + nu, size))
    for name, columns in zip("ABE", edges, strict=True):
        stack[:, :n, columns] = getattr(space, name)
        if derivatives:
            stack[:, :n, columns.start + size : columns.stop + size] = [getattr(d, name) for d in derivatives]
    stack[:, size : size + n, size:] = stack[:, :n, :size]
    stack *= period_s
    full = expm(stack)
    late = full if fraction is None else expm(stack * (1.0 - fraction))

    def split(now: Array, partial: Array, c: Array) -> DiscreteSpace:
        b = partial[:n, n : n + nu]
        return DiscreteSpace(A=now[:n, :n], B=b, B_late=now[:n, n : n + nu] - b, E=now[:n, n + nu :], C=c)

    discrete = split(full[0, :size, :size], late[0, :size, :size], space.C)
    directional = [split(full[j, :size, size:], late[j, :size, size:], d.C) for j, d in enumerate(derivatives)]
    if fraction is not None:
        slope = -period_s * late[0, :n, :n] @ space.B
        zero = np.zeros_like
        directional.append(
            DiscreteSpace(A=zero(discrete.A), B=slope, B_late=-slope, E=zero(discrete.E), C=zero(space.C))
        )
    return discrete, tuple(directional)
