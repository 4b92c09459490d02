"""Records with known radial basis functions in them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.blackbox.data import IOData
from ambid.nonlinear.rbf import RbfFunction

Array = NDArray[np.float64]


def data(u: Array, y: Array, *, open_loop: bool = True) -> IOData:
    u, y = u.reshape(len(y), -1), y.reshape(len(y), -1)
    names = tuple(f"u{k}" for k in range(u.shape[1])), tuple(f"y{k}" for k in range(y.shape[1]))
    units = dict.fromkeys((*names[0], *names[1]), "V")
    return IOData(u=u, y=y, dt=0.01, inputs=names[0], outputs=names[1], units=units, open_loop=open_loop)


def network(
    p: int = 1, m: int = 1, *, ny: int = 1, nu: int = 1, nk: int = 1, neurons: int = 3,
    linear: bool = True, metric: Array | None = None,
) -> RbfFunction:  # fmt: skip
    nu = nu if m else 0
    M = np.eye(p * ny + m * nu) if metric is None else metric
    return RbfFunction(p=p, m=m, ny=ny, nu=nu, nk=nk, linear=linear, neurons=neurons, metric=M)


CENTRES = np.array([[-1.0, 0.8], [1.2, 1.0], [0.2, -1.2]])
WIDTHS = np.array([0.7, 0.6, 0.9])
WEIGHTS = np.array([1.0, -0.8, 0.6])


def bumps(y: Array, u: Array) -> Array:
    """0.5 y + 0.3 u + 0.2 and three bumps."""
    x = np.stack([y, u], axis=-1)
    q = np.sum((x[..., None, :] - CENTRES) ** 2, axis=-1) / WIDTHS**2
    out: Array = 0.5 * y + 0.3 * u + 0.2 + np.exp(-q / 2) @ WEIGHTS
    return out


def bumpy(n: int, seed: int, noise: float) -> tuple[IOData, Array]:
    """A first-order system that is a radial basis network, with white equation errors; and its noise-free steps."""
    rng = np.random.default_rng(seed)
    u, y, clean = rng.uniform(-2.5, 2.5, n), np.zeros(n), np.zeros(n)
    for t in range(1, n):
        clean[t] = bumps(y[t - 1], u[t - 1])
        y[t] = clean[t] + noise * rng.standard_normal()
    return data(u, y), clean
