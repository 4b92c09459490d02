"""Simulated polynomial systems with known coefficients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from ambid.blackbox import polynomial
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit

SETTLED = 300  # samples before the record


@dataclass(frozen=True, kw_only=True)
class System:
    """A y = (B/F) u + (C/D) e with one input (none for a time series) and the orders that hold it."""

    structure: str
    orders: dict[str, int]
    A: tuple[float, ...] = (1.0,)
    B: tuple[float, ...] = ()
    C: tuple[float, ...] = (1.0,)
    D: tuple[float, ...] = (1.0,)
    F: tuple[float, ...] = (1.0,)
    sd: float = 0.5

    @property
    def truth(self) -> np.ndarray:
        """All coefficients in the order of the model."""
        B, F = (self.B, self.F) if self.B else ((), ())
        return np.concatenate([self.A, B, self.C, self.D, F])

    def data(
        self, seed: int, n: int, *, sign: float = 1.0, offset: float = 0.0, excitation: int | None = None
    ) -> IOData:
        rng = np.random.default_rng(seed)
        e = sign * self.sd * rng.standard_normal(n + SETTLED)
        y = lfilter(self.C, np.convolve(self.A, self.D), e)
        u = np.empty((n + SETTLED, 0))
        if self.B:
            u = (rng if excitation is None else np.random.default_rng(excitation)).standard_normal((n + SETTLED, 1))
            y = y + lfilter(self.B, np.convolve(self.A, self.F), u[:, 0])
        return record(u[SETTLED:], y[SETTLED:, None] + offset, open_loop=True)

    def fit(self, data: IOData, **options: object) -> BlackBoxFit:
        return getattr(polynomial, self.structure)(data, self.orders, **options)


A = (1.0, -1.5, 0.7)
B = (0.0, 1.0, 0.5)
C = (1.0, 0.5, 0.3)
D = (1.0, -0.6, 0.3)

SYSTEMS = {
    s.structure: s
    for s in (
        System(structure="fir", orders={"nb": 3, "nk": 1}, B=(0.0, 1.0, 0.5, -0.3)),
        System(structure="arx", orders={"na": 2, "nb": 2, "nk": 1}, A=A, B=B),
        System(structure="armax", orders={"na": 2, "nb": 2, "nc": 2, "nk": 1}, A=A, B=B, C=C),
        System(structure="arma", orders={"na": 2, "nc": 1}, A=(1.0, -1.2, 0.5), C=(1.0, 0.5)),
        System(structure="ararx", orders={"na": 2, "nb": 2, "nd": 1, "nk": 1}, A=A, B=B, D=(1.0, 0.6)),
        System(
            structure="ararmax", orders={"na": 2, "nb": 2, "nc": 1, "nd": 1, "nk": 1}, A=A, B=B, C=(1, 0.5), D=(1, -0.5)
        ),
        System(structure="oe", orders={"nb": 2, "nf": 2, "nk": 1}, B=B, F=A),
        System(structure="bj", orders={"nb": 2, "nc": 1, "nd": 2, "nf": 2, "nk": 1}, B=B, C=(1, 0.6), D=D, F=A),
    )
}


def record(u: np.ndarray, y: np.ndarray, *, open_loop: bool = False) -> IOData:
    """Columns of inputs and outputs as data, sampled at 1 kHz."""
    inputs = tuple(f"u{k}" for k in range(u.shape[1]))
    outputs = tuple(f"y{k}" for k in range(y.shape[1]))
    units = dict.fromkeys((*inputs, *outputs), "1")
    return IOData(u=u, y=y, dt=1e-3, inputs=inputs, outputs=outputs, units=units, open_loop=open_loop)


def two_outputs(n: int = 2000, seed: int = 4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two inputs, two outputs with F of order 1 each, and correlated white noise of the returned covariance."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n + SETTLED, 2))
    mix = np.array([[0.3, 0.2], [0.0, 0.1]])
    e = rng.standard_normal((n + SETTLED, 2)) @ mix
    y = np.empty_like(e)
    y[:, 0] = lfilter([0, 1.0], [1, -0.8], u[:, 0]) + lfilter([0, 0, 0.7], [1, 0.4], u[:, 1]) + e[:, 0]
    y[:, 1] = lfilter([0, 0.3], [1, -0.5], u[:, 0]) + lfilter([0, 0, -0.5], [1, -0.9], u[:, 1]) + e[:, 1]
    return u[SETTLED:], y[SETTLED:], mix.T @ mix


def unstable_loop(n: int, seed: int, sd: float = 0.1) -> tuple[IOData, np.ndarray, np.ndarray]:
    """ARMAX with a pole at 1.1, held by proportional feedback u = r - y; returns data, A and C."""
    rng = np.random.default_rng(seed)
    a, c = np.poly([1.1, 0.5]), np.array([1, -0.6, 0.2])
    e, r = sd * rng.standard_normal(n), rng.standard_normal(n)
    closed = np.add(a, [0.0, 0.5, 0.0])
    y = lfilter([0.0, 0.5], closed, r) + lfilter(c, closed, e)
    return record((r - y)[:, None], y[:, None]), a, c
