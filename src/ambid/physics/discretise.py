"""Exact discretisation under a zero-order hold, with exact derivatives.

The input is held over a sample and may reach the plant a fraction of a sample late: over one period the plant
sees first the previous value, then the present one (Astrom and Wittenmark, Computer-Controlled Systems, ch. 2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    n, n_u = B.shape
    block = np.zeros((n + n_u, n + n_u), dtype=np.result_type(A, B))
    block[:n, :n], block[:n, n:] = A, B
    full = _exponential(block * period_s, n)
    return full[:n, :n], full[:n, n:]


def discretise(
    space: StateSpace, period_s: float, *, fraction: float | None = None, derivatives: Sequence[StateSpace] = ()
) -> tuple[DiscreteSpace, tuple[DiscreteSpace, ...]]:
    """Discretise exactly, together with the derivatives along given directions.

    exp([[A, B, E], [0, 0, 0]] T) holds A_d, B_d and E_d (Van Loan 1978); the derivative along (dA, dB, dE) is the
    upper right block of exp([[M, dM], [0, M]] T) (Mathias 1996).

    `space`: continuous-time matrices; `period_s`: sampling period in s; `derivatives`: directions (dA, dB, dE); dC is
    passed on. Without directions matrices may be stacked, (..., rows, columns). Returns `discrete`: the discrete
    matrices; `directional`: their derivatives, one for each direction; where `fraction` is given, one more: along the
    fraction itself.
    """
    n, nu = space.B.shape[-2:]
    size = n + nu + space.E.shape[-1]
    kind = np.result_type(space.A, space.B, space.E)
    several, width = ((len(derivatives),), 2 * size) if derivatives else (space.A.shape[:-2], size)
    stack = np.zeros((*several, width, width), dtype=kind)
    edges = (slice(0, n), slice(n, n + nu), slice(n + nu, size))
    for name, columns in zip("ABE", edges, strict=True):
        stack[..., :n, columns] = getattr(space, name)
        if derivatives:
            stack[:, :n, columns.start + size : columns.stop + size] = [getattr(d, name) for d in derivatives]
    if derivatives:
        stack[:, size : size + n, size:] = stack[:, :n, :size]
    stack *= period_s
    full = _exponential(stack, n)
    late = full if fraction is None else _exponential(stack * (1.0 - fraction), n)

    def split(now: Array, partial: Array, c: Array) -> DiscreteSpace:
        b = partial[..., :n, n : n + nu]
        return DiscreteSpace(
            A=now[..., :n, :n], B=b, B_late=now[..., :n, n : n + nu] - b, E=now[..., :n, n + nu : size], C=c
        )

    first, first_late = (full[0], late[0]) if derivatives else (full, late)
    discrete = split(first, first_late, space.C)
    directional = [split(full[j, :size, size:], late[j, :size, size:], d.C) for j, d in enumerate(derivatives)]
    if fraction is not None:
        slope = -period_s * first_late[..., :n, :n] @ space.B
        zero = np.zeros_like
        directional.append(
            DiscreteSpace(A=zero(discrete.A), B=slope, B_late=-slope, E=zero(discrete.E), C=zero(space.C))
        )
    return discrete, tuple(directional)


_PADE = (17297280.0, 8648640.0, 1995840.0, 277200.0, 25200.0, 1512.0, 56.0, 1.0)  # of order 7
_REACH = 0.95  # norm up to which it is right to rounding (Higham 2005)


def _exponential(a: NDArray[Any], n: int) -> NDArray[Any]:
    """Exponential of one or several matrices by scaling and squaring (Higham 2005).

    Scaled by their first `n` rows and columns, which the others only follow: large inputs cost no digits.
    `a`: (..., size, size).
    """
    norms = np.sum(np.abs(a[..., :n, :n]), axis=-2)
    norm = float(np.max(norms, initial=0.0, where=np.isfinite(norms)))
    squarings = max(0, int(np.ceil(np.log2(norm / _REACH)))) if norm > 0.0 else 0
    a = a / 2.0**squarings
    square = a @ a
    fourth = square @ square
    even = (np.eye(a.shape[-1]), square, fourth, square @ fourth)
    odd = a @ sum(c * power for c, power in zip(_PADE[1::2], even, strict=True))
    rest = sum(c * power for c, power in zip(_PADE[::2], even, strict=True))
    more = np.linalg.solve(rest - odd, 2.0 * odd)  # what is beyond the identity: digits of slow modes stand there
    for _ in range(squarings):
        more = 2.0 * more + more @ more
    return np.asarray(more + np.eye(a.shape[-1]))
