"""Simulated records with a known truth for the instrumental variable methods."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter, ss2tf

from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit


def io_data(u, y, *, reference=None, dt=1.0, open_loop=False) -> IOData:
    """Columns named u0, u1 ..., y0 ..., r0 ..."""
    u, y = (np.reshape(a, (len(a), -1)) for a in (u, y))
    r = np.empty((len(u), 0)) if reference is None else np.reshape(reference, (len(u), -1))
    names = [tuple(f"{x}{k}" for k in range(a.shape[1])) for x, a in (("u", u), ("y", y), ("r", r))]
    return IOData(
        u=u, y=y, dt=dt, inputs=names[0], outputs=names[1], units=dict.fromkeys(names[0] + names[1] + names[2], "1"),
        open_loop=open_loop, reference=r, references=names[2],
    )  # fmt: skip


def zoh(A, B, dt):
    n, m = B.shape
    E = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * dt)
    return E[:n, :n], E[:n, n:]


def second_order(stiffness: float, damping: float, gain: float, dt: float):
    """gain/(s^2 + damping s + stiffness), sampled: state matrices."""
    return zoh(np.array([[0, 1.0], [-stiffness, -damping]]), np.array([[0], [gain]]), dt)


def in_loop(rng, A, B, dt, *, n, noise, colour=True, kp, kd, reference=None) -> IOData:
    """Position control u = r - kp y - kd (y - y before) of a second-order plant; noise on the measured position."""
    e = noise * rng.standard_normal(n)
    v = lfilter([1, 0.5], [1, -0.7], e) if colour else e
    r = rng.standard_normal(n) if reference is None else reference
    num, den = ss2tf(A, B, np.array([[1.0, 0.0]]), np.zeros((1, 1)))
    control = [kp + kd, -kd]
    closed = np.r_[den, 0.0] + np.convolve(num[0], control)
    y = lfilter(num[0], closed, r) + lfilter(den, closed, v)
    u = r - lfilter(control, 1.0, y)
    return io_data(u + 1.0, y + 0.3, reference=r, dt=dt)


def monte_carlo(
    make: Callable[[np.random.Generator], IOData],
    estimate: Callable[[IOData], BlackBoxFit],
    truth: np.ndarray,
    places: list[int],
    runs: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the coefficients at `places`, and the same over the standard deviations given, (runs, n)."""
    errors, scores = [], []
    for seed in range(runs):
        fit = estimate(make(np.random.default_rng(seed)))
        error = fit.model.theta[places] - truth
        errors.append(error)
        scores.append(error / fit.sd[places])
    return np.array(errors), np.array(scores)
