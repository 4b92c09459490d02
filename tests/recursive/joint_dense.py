"""Textbook joint filters with dense matrices: what the compiled ones are held against.

Written from the equations alone: full covariance, Joseph form, all 2 n + 1 points, matrix exponentials, Jacobians by
complex step. Parameters m, R, L are carried as logarithms of their ratio to the start, others over their size.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from ambid.recursive.joint import JointStart
from tests.estimation.reference import continuous

LOGS = ("m", "R", "L")
STEP = 1e-30


class Dense:
    """Augmented state [q, o, x] in SI but for q."""

    def __init__(self, start: JointStart, offset: np.ndarray, wide: np.ndarray, *, unscented: bool):
        self.start, self.unscented, p = start, unscented, len(start.free)
        self.size = np.array([start.values[k] for k in start.free])
        logs = np.array([k in LOGS for k in start.free])
        self.z = np.concatenate([np.where(logs, 0.0, 1.0), np.zeros(offset.size + wide.size)])
        self.P = np.diag(np.concatenate([np.zeros(p), offset**2, wide**2]))
        self.P[:p, :p] = start.covariance / np.outer(self.size, self.size)
        self.s, self.p, self.logs = p + offset.size, p, logs
        self.R = np.array([start.sensor_sd[r] ** 2 for r in start.model.outputs])
        self.Q = np.diag([start.disturbance_sd[r] ** 2 for r in start.model.disturbances])
        self.C = continuous(start.model.name, {**start.values})[3].real

    def theta(self, z: np.ndarray) -> dict[str, complex]:
        q = np.where(self.logs, np.exp(z[: self.p]), z[: self.p]) * self.size
        return {**self.start.values, **dict(zip(self.start.free, q, strict=True))}

    def moved(self, z: np.ndarray, now: np.ndarray, late: np.ndarray) -> np.ndarray:
        """The next augmented state without noise, complex where `z` is."""
        a, b, e, _ = continuous(self.start.model.name, self.theta(z))
        n, n_u, n_d = a.shape[0], b.shape[1], e.shape[1]
        block = np.zeros((n + n_u + n_d,) * 2, dtype=complex)
        block[:n] = np.hstack([a, b, e])
        part = self.start.delay % 1.0
        v = np.concatenate([z[self.s :], late, z[self.p : self.s]])
        v = expm(block * part / self.start.rate_hz) @ v
        v[n : n + n_u] = now
        v = expm(block * (1 - part) / self.start.rate_hz) @ v
        return np.concatenate([z[: self.s], v[:n]])

    def noise(self) -> np.ndarray:
        n_z, zero = self.z.size, np.zeros(1)
        e = np.array([
            self.moved(np.concatenate([self.z[: self.p], d, np.zeros(n_z - self.s)]), zero, zero).real[self.s :]
            for d in np.eye(self.s - self.p)
        ]).T  # fmt: skip
        full = np.zeros((n_z, n_z))
        full[self.s :, self.s :] = e @ self.Q @ e.T
        return full

    def measure(self, y: np.ndarray) -> np.ndarray:
        H = np.hstack([np.zeros((y.size, self.s)), self.C])
        error, seen = y - H @ self.z, np.isfinite(y)
        H, R = H[seen], np.diag(self.R[seen])
        K = np.linalg.solve(H @ self.P @ H.T + R, H @ self.P).T
        self.z = self.z + K @ error[seen]
        left = np.eye(self.z.size) - K @ H
        self.P = left @ self.P @ left.T + K @ R @ K.T
        return error

    def step(self, now: np.ndarray, late: np.ndarray) -> None:
        noise, n = self.noise(), self.z.size
        if not self.unscented:
            z = self.z.astype(complex)
            J = np.array([self.moved(z + 1j * STEP * d, now, late).imag / STEP for d in np.eye(n)]).T
            self.z, self.P = self.moved(z, now, late).real, J @ self.P @ J.T + noise
            return
        turned = np.r_[self.s : n, self.p : self.s, : self.p]  # the root is upper triangular in [x, o, q]
        factor = np.zeros((n, n))
        upper = np.linalg.cholesky(self.P[np.ix_(turned, turned)][::-1, ::-1])[::-1, ::-1]
        factor[np.ix_(turned, turned)] = np.sqrt(n) * upper
        points = np.array([self.z, *(self.z + factor.T), *(self.z - factor.T)])
        weights = np.full(2 * n + 1, 0.5 / n)
        weights[0] = 0.0
        ends = np.array([self.moved(p, now, late).real for p in points])
        self.z = weights @ ends
        weights[0] = 2.0
        self.P = (weights * (ends - self.z).T) @ (ends - self.z) + noise

    def run(self, u: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Errors; the first samples fill the memory of inputs, as in the filters under test."""
        whole = int(self.start.delay)
        errors = np.full(y.shape, np.nan)
        for k in range(whole + 1, len(y)):
            errors[k] = self.measure(y[k])
            self.step(u[k - whole], u[k - whole - 1])
        return errors

    @property
    def estimate(self) -> np.ndarray:
        theta = self.theta(self.z)
        return np.concatenate([[theta[k] for k in self.start.free], self.z[self.p : self.s]])

    @property
    def covariance(self) -> np.ndarray:
        theta = self.theta(self.z)
        unit = np.where(self.logs, [theta[k] for k in self.start.free], self.size)
        unit = np.concatenate([unit, np.ones(self.s - self.p)])
        return unit[:, None] * self.P[: self.s, : self.s] * unit
