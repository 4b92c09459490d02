"""Plants with known truth, and a model whose predictions are known exactly."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ambid.blackbox.data import IOData
from ambid.nonlinear.fit import NonlinearFit

Array = NDArray[np.float64]


def io(u: Array, y: Array, *, open_loop: bool = True, file: str = "made.csv") -> IOData:
    return IOData(
        u=u[:, None],
        y=y[:, None],
        dt=0.01,
        inputs=("u",),
        outputs=("y",),
        units={"u": "V", "y": "m"},
        open_loop=open_loop,
        record={"samples": u.size, "rate_hz": 100.0, "sha256": "0" * 64, "file": file},
    )


def squared(
    n: int, seed: int, *, c: float = 0.3, noise: float = 0.05, spread: float = 0.0, size: float = 1.0
) -> IOData:
    """y(t) = 0.6 y(t-1) + 0.9 u(t-1) + c u(t-1)^2 + e(t); sd of e: noise (1 + spread |u(t-1)|)."""
    rng = np.random.default_rng(seed)
    u, e = size * rng.uniform(-1, 1, n), noise * rng.standard_normal(n)
    y = np.zeros(n)
    for t in range(1, n):
        v = u[t - 1]
        y[t] = 0.6 * y[t - 1] + 0.9 * v + c * v**2 + e[t] * (1 + spread * abs(v))
    return io(u, y)


def levitated(n: int, seed: int) -> IOData:
    """An unstable plant, y(t) = 1.2 y(t-1) + 0.05 y(t-1)^2 + u(t-1) + e(t), held by u = -0.9 y + r."""
    rng = np.random.default_rng(seed)
    r, e = 0.3 * rng.standard_normal(n), 0.05 * rng.standard_normal(n)
    u, y = np.zeros(n), np.zeros(n)
    for t in range(n):
        if t:
            y[t] = 1.2 * y[t - 1] + 0.05 * y[t - 1] ** 2 + u[t - 1] + e[t]
        u[t] = -0.9 * y[t] + r[t]
    return io(u, y, open_loop=False)


def output_error(n: int, seed: int, *, open_loop: bool = True) -> IOData:
    """x(t) = 0.8 x(t-1) + 0.5 u(t-1) + 0.2 u(t-1)^2, y = x + e."""
    rng = np.random.default_rng(seed)
    u, x = rng.uniform(-1, 1, n), np.zeros(n)
    for t in range(1, n):
        x[t] = 0.8 * x[t - 1] + 0.5 * u[t - 1] + 0.2 * u[t - 1] ** 2
    return io(u, x + 0.1 * rng.standard_normal(n), open_loop=open_loop)


@dataclass(frozen=True)
class Static:
    """Predicts gain * u of the sample before, and nothing of the first two samples."""

    gain: float = 1.0
    diverges_at: int | None = None
    edge: float = 1.0
    dt: float = 0.01
    kind: str = "static"
    n_inputs: int = 1
    n_outputs: int = 1
    lag: int = 2
    names: tuple[str, ...] = ("gain",)
    theta: Array = field(default_factory=lambda: np.ones(1))

    def predict(self, u: Array, y: Array) -> Array:
        out = np.full(y.shape, np.nan)
        out[2:] = self.gain * u[1:-1]
        return out

    def jacobian(self, u: Array, y: Array) -> Array:
        out = np.zeros((*y.shape, 1))
        out[2:, :, 0] = u[1:-1]
        return out

    def simulate(self, u: Array, y: Array) -> Array:
        out = np.vstack([y[:2], self.gain * u[1:-1]])
        if self.diverges_at is not None:
            out[self.diverges_at :] = np.nan
        return out

    def novelty(self, u: Array, y: Array) -> Array:
        out = np.abs(u[:, 0]) / self.edge
        out[:2] = np.nan
        return out

    def as_json(self) -> dict[str, Any]:
        return {}

    @classmethod
    def from_json(cls, found: dict[str, Any]) -> Self:
        return cls(**found)


def static_fit(model: Static, *records: IOData, **changes: Any) -> NonlinearFit:
    """A fit of that model, as an estimator would hand it over."""
    values: dict[str, Any] = {
        "structure": "narmax",
        "settings": {},
        "model": model,
        "covariance": None,
        "n_estimated": 1,
        "noise_covariance": np.array([[0.04]]),
        "inputs": ("u",),
        "outputs": ("y",),
        "units": {"u": "V", "y": "m"},
        "dt": 0.01,
        "records": tuple(dict(x.record) for x in records),
    }
    return NonlinearFit(**{**values, **changes})
