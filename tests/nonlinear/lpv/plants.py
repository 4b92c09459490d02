"""LPV plants with known coefficients, for the tests of the estimator."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ambid.blackbox.data import IOData

Array = NDArray[np.float64]


def damped(p):
    """Coefficients a1, a2, b1, b2 of a plant whose resonance and gain move with p; stable for p from 0 to 1."""
    return np.array([-1.4 + 0.3 * p, 0.6 - 0.1 * p + 0.1 * p**2]), np.array([0.5 + 0.5 * p, 0.2 - 0.2 * p])


def levitated(p):
    """Coefficients of a plant like a levitated rotor: a pole outside the unit circle that moves from 1.15 to 1.25."""
    return np.array([-(1.15 + 0.1 * p) - 0.6, (1.15 + 0.1 * p) * 0.6]), np.array([0.10 + 0.04 * p, 0.08 + 0.04 * p])


def record(
    seed: int,
    n: int = 1500,
    *,
    plant: Callable = damped,
    form: str = "output",
    gains: tuple[float, float] = (0.0, 0.0),
    noise: float = 0.1,
    ar: tuple[float, float] = (-0.8, 0.2),
    at: float | None = None,
    x0: float = 0.0,
) -> IOData:
    """A record with inputs u and p; feedback u = -gains[0] y(t-1) - gains[1] y(t-2) + excitation."""
    rng = np.random.default_rng(seed)
    t = np.arange(n)
    p = 0.5 + 0.45 * np.sin(2 * np.pi * t / 400 + rng.uniform(0, 6.0)) if at is None else np.full(n, at)
    u, e = rng.standard_normal(n), noise * rng.standard_normal(n)
    a, b = plant(p)
    x, v, y = np.full(n, x0), np.zeros(n), np.full(n, x0)
    for k in range(2, n):
        v[k] = -ar[0] * v[k - 1] - ar[1] * v[k - 2] + e[k]
        u[k] -= gains[0] * y[k - 1] + gains[1] * y[k - 2]
        z = x if form == "output" else y
        x[k] = -a[0, k] * z[k - 1] - a[1, k] * z[k - 2] + b[0, k] * u[k - 1] + b[1, k] * u[k - 2]
        y[k] = x[k] + v[k]
    return IOData(
        u=np.column_stack([u, p]),
        y=y[:, None],
        dt=0.01,
        inputs=("u", "p"),
        outputs=("y",),
        units={"u": "V", "p": "m", "y": "m"},
        open_loop=gains == (0.0, 0.0),
    )


def truth(p: float, plant: Callable = damped, dt: float = 0.01) -> tuple[Array, Array, Array, float]:
    """a, b, poles in rad/s (as `Frozen` orders them) and gain at one p."""
    a, b = plant(p)
    s = np.log(np.roots(np.concatenate([[1.0], a])).astype(complex)) / dt
    return a, b, s[np.lexsort((-s.imag, -s.real))], float(b.sum() / (1 + a.sum()))
