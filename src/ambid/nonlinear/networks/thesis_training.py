"""The thesis's own training of the network of fig. 5.9: one-step errors of its states, from weights of zero.

J = sum |x(k+1) - A x(k) - B u(k) - c|^2 with measured (or reconstructed) states; v <- v - eta dJ/dv (eqs 5.1, 5.2) for
some iterations, beside Gauss-Newton, which is there after one. Noise on the states biases what both converge to.
"""

from __future__ import annotations

from time import perf_counter

import numpy as np

from ambid.arrays import Array
from ambid.estimation.linear import triangle_of
from ambid.nonlinear.fit import LearningCurve


def trained_one_step(
    states: list[Array], inputs: list[Array], iterations: int
) -> tuple[Array, Array, tuple[LearningCurve, LearningCurve]]:
    """Train [A | B | c] by steepest descent and by Gauss-Newton.

    `states`: (n_samples, n), scaled, of each record; `inputs`: (n_samples, n_inputs + 1), scaled, last column 1.
    Returns `descended, solved`: (n, n + n_inputs + 1), scaled; `curves`: of the descent, then of Gauss-Newton.
    """
    began = perf_counter()
    size = np.maximum(np.concatenate(states).std(axis=0), 1e-300)
    rows = [np.hstack([x[:-1] / size, u[:-1], x[1:] / size]) for x, u in zip(states, inputs, strict=True)]
    n, d = states[0].shape[1], states[0].shape[1] + inputs[0].shape[1]
    N = sum(r.shape[0] for r in rows)
    R = triangle_of(rows)
    known, target = R[:, :d], R[:, d:]
    prepared = perf_counter() - began

    def rms(v: Array) -> float:
        return float(np.sqrt(np.sum((target - known @ v) ** 2) / (N * n)))

    curvature = float(np.linalg.svd(known, compute_uv=False)[0] ** 2)
    v = np.zeros((d, n))
    seconds, errors = [prepared], [rms(v)]
    for _ in range(iterations):
        v = v + known.T @ (target - known @ v) / curvature
        seconds.append(perf_counter() - began)
        errors.append(rms(v))
    descent = LearningCurve(
        method="steepest descent (thesis eq. 5.2), one-step errors of the states",
        seconds=np.array(seconds),
        training=np.array(errors),
    )
    again = perf_counter()
    w: Array = np.asarray(np.linalg.lstsq(known, target, rcond=1e-13)[0], dtype=np.float64)
    newton = LearningCurve(
        method="Gauss-Newton, one-step errors of the states",
        seconds=np.array([prepared, prepared + perf_counter() - again]),
        training=np.array([errors[0], rms(w)]),
    )
    back = np.concatenate([1.0 / size, np.ones(d - n)])
    return (v * back[:, None] * size).T, (w * back[:, None] * size).T, (descent, newton)
