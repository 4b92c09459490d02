"""Derivatives of a state space's predictions by its matrices."""

from __future__ import annotations

import numpy as np

from ambid.blackbox.model import StateSpaceModel
from ambid.blackbox.prediction import Sensitivities
from tests.blackbox.subspace.systems import DT


def some(seed: int = 0, n: int = 3, n_u: int = 2, n_y: int = 2) -> StateSpaceModel:
    rng = np.random.default_rng(seed)
    F = 0.8 * np.linalg.qr(rng.standard_normal((n, n)))[0]
    B, C, D, K = (rng.standard_normal(s) for s in ((n, n_u), (n_y, n), (n_y, n_u), (n, n_y)))
    return StateSpaceModel(A=F + K @ C, B=B, C=C, D=D, K=K, dt=DT)


def predictions(theta: np.ndarray, like: StateSpaceModel, x0: np.ndarray, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Predictions of an innovations form, complex coefficients allowed."""
    parts, at = [], 0
    for name in "ABCDK":
        shape = getattr(like, name).shape
        parts.append(theta[at : at + shape[0] * shape[1]].reshape(shape))
        at += shape[0] * shape[1]
    A, B, C, D, K = parts
    x, out = x0.astype(theta.dtype), []
    for k in range(len(y)):
        out.append(C @ x + D @ u[k])
        x = A @ x + B @ u[k] + K @ (y[k] - out[-1])
    return np.array(out)


def test_sensitivities_equal_the_complex_step_across_blocks() -> None:
    m, rng = some(), np.random.default_rng(1)
    u, y, x0 = rng.standard_normal((40, 2)), rng.standard_normal((40, 2)), rng.standard_normal(3)
    x, states = x0, []
    for k in range(40):
        states.append(x)
        x = m.A @ x + m.B @ u[k] + m.K @ (y[k] - m.C @ x - m.D @ u[k])
    signals = np.hstack([states, u, y - np.array(states) @ m.C.T - u @ m.D.T])
    along = Sensitivities(m, np.eye(m.theta.size))
    found = np.concatenate([along.block(signals[:15]), along.block(signals[15:])], axis=1)
    for j in range(m.theta.size):
        theta = m.theta.astype(complex)
        theta[j] += 1e-30j
        wanted = predictions(theta, m, x0, u, y).imag.T / 1e-30
        np.testing.assert_allclose(found[:, :, j], wanted, rtol=1e-9, atol=1e-11 * np.abs(wanted).max())
