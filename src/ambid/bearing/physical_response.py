"""Frequency response of a physical model as the sampled record shows it, with exact derivatives by its parameters.

Discrete: the model behind a zero-order hold and a delay of any real number of samples (`ambid.physics.discretise`);
continuous: C (jw - A)^-1 B exp(-jw delay).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.physics.discretise import DiscreteSpace, discretise
from ambid.physics.linear_model import LinearModel

Complex = NDArray[np.complex128]


def physical_response(
    model: LinearModel,
    theta: Mapping[str, float],
    omega: Array,
    *,
    dt: float | None,
    delay_s: float = 0.0,
    along: Sequence[str] = (),
    with_delay: bool = False,
) -> tuple[Complex, Complex]:
    """Return G of a model at physical parameters, and its derivatives.

    `theta`: every parameter, SI; `omega`: (n_frequencies,), rad/s; `dt`: sampling interval in s of the held input; None
    for continuous time; `delay_s`: delay of the inputs, s; `along`: parameters by which derivatives are wanted;
    `with_delay`: whether the derivative by the delay (per second) comes last. Returns `response`: (n_frequencies,
    n_outputs, n_inputs), complex; `derivative`: (n_frequencies, n_outputs, n_inputs, n_along), complex, one more along
    the last axis with `with_delay`.
    """
    space = model.matrices(theta)
    slopes = [model.derivative(theta, name) for name in along]
    if dt is None:
        lag = np.exp(-1j * omega * delay_s)[:, None, None]
        inner = _Resolvent(space.A, space.C, np.asarray(1j * omega, dtype=np.complex128))
        found = inner.response(np.broadcast_to(space.B, (omega.size, *space.B.shape))) * lag
        rows = [inner.slope(space.B, d.A, np.broadcast_to(d.B, (omega.size, *d.B.shape)), d.C) * lag for d in slopes]
        if with_delay:
            rows.append(-1j * omega[:, None, None] * found)
        return found, _stacked(rows, found)
    whole = int(np.floor(delay_s / dt + 1e-9))
    fraction = max(0.0, delay_s / dt - whole)
    discrete, directions = discretise(space, dt, fraction=fraction, derivatives=slopes)
    z = np.exp(1j * omega * dt)
    late, lag = (1 / z)[:, None, None], (z**-whole)[:, None, None]

    def entered(d: DiscreteSpace) -> Complex:
        return np.asarray(d.B + d.B_late * late)

    inner, b = _Resolvent(discrete.A, discrete.C, z), entered(discrete)
    rows = [inner.slope(b, d.A, entered(d), d.C) * lag for d in directions]
    wanted = rows if with_delay else rows[: len(slopes)]
    if with_delay:
        wanted[-1] = wanted[-1] / dt
    found = inner.response(b) * lag
    return found, _stacked(wanted, found)


class _Resolvent:
    """C (p I - A)^-1 at points p, ready for many right-hand sides."""

    def __init__(self, A: Array, C: Array, points: Complex) -> None:
        self._inverse = np.linalg.inv(points[:, None, None] * np.eye(A.shape[0]) - A)
        self._c = C

    def response(self, b: Complex | Array) -> Complex:
        return np.asarray(self._c @ self._inverse @ b)

    def slope(self, b: Complex | Array, d_a: Array, d_b: Complex | Array, d_c: Array) -> Complex:
        state = self._inverse @ b
        return np.asarray(d_c @ state + self._c @ self._inverse @ (d_a @ state + d_b))


def _stacked(rows: list[Complex], found: Complex) -> Complex:
    return np.stack(rows, axis=-1) if rows else np.empty((*found.shape, 0), dtype=np.complex128)
