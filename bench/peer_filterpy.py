"""filterpy: Kalman filters sample by sample, linear, and extended or unscented for states and parameters at once.

Run: PYTHON peer_filterpy.py, see peer_child.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, KalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

import peer_child

_ORDER = 5  # of the series of the matrix exponential: exact to rounding at 20 kHz
_STEP = 1e-30  # of derivatives by complex step


def fit(structure: str, orders: dict[str, Any], mode: str, u: np.ndarray, y: np.ndarray) -> dict[str, Any]:
    """`structure` is kalman, ekf or ukf; what the orders are, the makers say."""
    del mode
    if structure == "kalman":
        return _kalman(orders, y)
    return {"ekf": _ekf, "ukf": _ukf}[structure](Bearing(orders), u, y)


def _kalman(orders: dict[str, Any], y: np.ndarray) -> dict[str, Any]:
    """A, C, Q, R, P0; y is (n_samples,) or (n_samples, n_outputs)."""
    A, C, Q, R, P0 = (np.array(orders[k], dtype=np.float64) for k in ("A", "C", "Q", "R", "P0"))
    made = KalmanFilter(dim_x=A.shape[0], dim_z=C.shape[0])
    made.F, made.H, made.Q, made.R, made.P = A, C, Q, R, P0
    error = 0.0
    truth = np.array(orders.get("truth", []))
    for k, value in enumerate(y):
        if k:
            made.predict()
        made.update(np.atleast_1d(value))
        if truth.size:
            error += (float(made.x[0, 0]) - truth[k]) ** 2
    found = {"estimate": made.x[:, 0]}
    return {**found, "rms": np.array([np.sqrt(error / truth.size)])} if truth.size else found


class Bearing:
    """x = position, velocity, current; m, k_x, k_i, R, L over their start values; offsets of force and voltage.

    Orders: dt, values, sensor (position, current), disturbance (force, voltage), spread (of the start), wide (of the
    states), offset.
    """

    def __init__(self, orders: dict[str, Any]) -> None:
        self.dt, self.values = float(orders["dt"]), np.array(orders["values"])
        self.R = np.diag(np.array(orders["sensor"]) ** 2)
        sd = [*orders["wide"], *[orders["spread"]] * 5, *orders["offset"]]
        self.P0, self.z0 = np.diag(np.array(sd) ** 2), np.r_[np.zeros(3), np.ones(5), np.zeros(2)]
        _, gain = self.step(self.z0)
        self.Q = np.zeros((10, 10))
        noise = gain[:, [1, 0]] * np.array(orders["disturbance"])
        self.Q[:3, :3] = noise @ noise.T + 1e-12 * np.diag(np.diag(noise @ noise.T))
        self.H = np.zeros((2, 10))
        self.H[0, 0] = self.H[1, 2] = 1.0

    def step(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Discrete A (..., 3, 3), and what voltage and force do over a sample (..., 3, 2), for z (..., 10)."""
        m, k_x, k_i, R, L = np.moveaxis(z[..., 3:8] * self.values, -1, 0)
        big = np.zeros((*z.shape[:-1], 5, 5), dtype=z.dtype)
        big[..., 0, 1] = 1.0
        big[..., 1, 0], big[..., 1, 2], big[..., 1, 4] = -k_x / m, k_i / m, 1.0 / m
        big[..., 2, 1], big[..., 2, 2], big[..., 2, 3] = -k_i / L, -R / L, 1.0 / L
        big *= self.dt
        term = total = big
        for k in range(2, _ORDER + 1):
            term = term @ big / k
            total = total + term
        return total[..., :3, :3] + np.eye(3), total[..., :3, 3:]

    def move(self, z: np.ndarray, u: float) -> np.ndarray:
        """One sample on, for z (..., 10); the offset of the voltage is added to u, that of the force is a force."""
        A, gain = self.step(z)
        held = np.stack([u + z[..., 9], z[..., 8]], axis=-1)
        state = np.einsum("...ij,...j->...i", A, z[..., :3]) + np.einsum("...ij,...j->...i", gain, held)
        return np.concatenate([state, z[..., 3:]], axis=-1)

    def jacobian(self, z: np.ndarray, u: float) -> np.ndarray:
        points = z + 1j * _STEP * np.eye(10)
        return self.move(points, u).imag.T / _STEP


class _Extended(ExtendedKalmanFilter):  # type: ignore[misc]
    def __init__(self, bearing: Bearing) -> None:
        super().__init__(dim_x=10, dim_z=2)
        self.bearing = bearing
        self.x, self.P, self.Q, self.R = bearing.z0.copy(), bearing.P0.copy(), bearing.Q, bearing.R

    def predict_x(self, u: float = 0.0) -> None:
        self.F = self.bearing.jacobian(self.x, u)
        self.x = self.bearing.move(self.x, u)


def _ekf(bearing: Bearing, u: np.ndarray, y: np.ndarray) -> dict[str, Any]:
    made = _Extended(bearing)
    for k in range(len(y)):
        if k:
            made.predict_x(u[k - 1])
            made.P = made.F @ made.P @ made.F.T + made.Q
        made.update(y[k], lambda _: bearing.H, lambda z: bearing.H @ z)
    return _told(bearing, made)


def _ukf(bearing: Bearing, u: np.ndarray, y: np.ndarray) -> dict[str, Any]:
    points = MerweScaledSigmaPoints(10, alpha=1.0, beta=2.0, kappa=0.0)
    made = UnscentedKalmanFilter(
        10, 2, bearing.dt, lambda z: bearing.H @ z, lambda z, _, volts: bearing.move(z, volts), points
    )
    made.x, made.P, made.Q, made.R = bearing.z0.copy(), bearing.P0.copy(), bearing.Q, bearing.R
    for k in range(len(y)):
        if k:
            made.predict(volts=u[k - 1])
        else:
            made.sigmas_f = points.sigma_points(made.x, made.P)
        made.update(y[k])
    return _told(bearing, made)


def _told(bearing: Bearing, made: Any) -> dict[str, Any]:
    return {
        "estimate": made.x[3:8] * bearing.values,
        "sd": np.sqrt(np.diag(made.P)[3:8]) * np.abs(bearing.values),
    }


if __name__ == "__main__":
    peer_child.serve(fit)
