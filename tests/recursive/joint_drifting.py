"""An unstable bearing whose resistance drifts while a loop holds it, step by step with exact matrices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_discrete_are

from ambid.bearing.linear import Signals
from ambid.physics.linear_model import discretise, model
from ambid.signals import multisine
from tests.bearing.benches import BEARING, Bench

RATE = 20_000.0
SENSOR, DISTURBANCE = np.array([1e-7, 2e-3]), np.array([1.0, 0.05])


@dataclass(frozen=True, kw_only=True, eq=False)
class Drifting:
    """The record, and the resistance at every sample; `bench.truth` is that of the first."""

    bench: Bench
    R: np.ndarray


def drifting_resistance(*, seconds: float, share: float, seed: int) -> Drifting:
    """Resistance rises by `share`, linearly; state feedback through a sample of delay, a multisine of 6 V rms."""
    of, n, rng = model("one-axis"), int(seconds * RATE), np.random.default_rng(seed)
    R = BEARING["R"] * (1 + share * np.arange(n) / n)
    d, _ = discretise(of.matrices(BEARING), 1 / RATE)
    held = np.block([[d.A, d.B], [np.zeros((1, 4))]])
    enter = np.array([[0.0], [0], [0], [1]])
    cost = np.diag([1 / 2e-5**2, 0, 1 / 0.5**2, 1e-4])
    P = solve_discrete_are(held, enter, cost, np.eye(1) / 6.0**2)
    gain = np.linalg.solve(np.eye(1) / 36.0 + enter.T @ P @ enter, enter.T @ P @ held)[0]
    added = multisine(n, RATE, amplitude=6.0, band=(5.0, 2000.0), seed=seed, amplitude_is="rms")
    w = DISTURBANCE * rng.standard_normal((n, 2))
    x, u, states = np.zeros(3), np.zeros(n), np.zeros((n, 3))
    for k in range(n):
        if k % 50 == 0:
            d, _ = discretise(of.matrices({**BEARING, "R": R[k]}), 1 / RATE)
            A, B, E = d.A, d.B[:, 0], d.E
        states[k], before = x, u[k - 1] if k else 0.0
        u[k] = added[k] - gain[:3] @ x - gain[3] * before
        x = A @ x + B * before + E @ w[k]
    y = states[:, [0, 2]] + SENSOR * rng.standard_normal((n, 2))
    bench = Bench(
        model=of, truth=BEARING, signals=Signals(u=u[:, None], y=y, rate_hz=RATE), sensor=SENSOR,
        disturbance=DISTURBANCE, delay=1.0, states=states,
    )  # fmt: skip
    return Drifting(bench=bench, R=R)
