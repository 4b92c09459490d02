"""Simulated NARMAX systems with known coefficients."""

from __future__ import annotations

import numpy as np

from ambid.blackbox.data import IOData
from ambid.nonlinear.fit import NonlinearFit

TRUTH = {"y(t-1)": 0.5, "y(t-2)": -0.3, "u(t-1)*y(t-1)": 0.4, "u(t-2)": 0.9, "u(t-1)^2": 0.2, "e(t-1)": 0.6}


def record(u: np.ndarray, y: np.ndarray, *, open_loop: bool = True) -> IOData:
    u, y = u.reshape(len(u), -1), y.reshape(len(y), -1)
    inputs = tuple(f"u{k + 1}" for k in range(u.shape[1]))
    outputs = tuple(f"y{k + 1}" for k in range(y.shape[1]))
    units = {**dict.fromkeys(inputs, "V"), **dict.fromkeys(outputs, "m")}
    return IOData(u=u, y=y, dt=0.01, inputs=inputs, outputs=outputs, units=units, open_loop=open_loop)


def polynomial(n: int, seed: int, *, c: float = 0.6, noise: float = 0.1) -> IOData:
    """The system of `TRUTH`."""
    rng = np.random.default_rng(seed)
    u, y, e = rng.uniform(-1, 1, n), np.zeros(n), noise * rng.standard_normal(n)
    for t in range(2, n):
        y[t] = 0.5 * y[t - 1] - 0.3 * y[t - 2] + 0.4 * y[t - 1] * u[t - 1] + 0.9 * u[t - 2] + 0.2 * u[t - 1] ** 2
        y[t] += e[t] + c * e[t - 1]
    return record(u, y)


def coefficients(fit: NonlinearFit) -> dict[str, tuple[float, float]]:
    """Value and standard deviation by term."""
    assert fit.model is not None
    assert fit.sd is not None
    return {n: (float(v), float(s)) for n, v, s in zip(fit.model.names, fit.model.theta, fit.sd, strict=True)}
