"""Records of a structure with known modes: a held sweep or noise moves it, accelerometers see it."""

from __future__ import annotations

import numpy as np
from scipy.signal import cont2discrete, lfilter

from ambid.blackbox.data import IOData

RATE = 1000.0
RIGID = ((12.0, 0.25),)  # suspension: no mode of vibration, but there


def sweep(seconds, high=495.0):
    """A linear sweep from 0 Hz that does not repeat."""
    t = np.arange(int(seconds * RATE)) / RATE
    return np.sin(np.pi * high / seconds * t**2)


def structure(
    modes, u, rng, *, n_outputs=6, noise=0.05, hum=0.0, quadratic=0.0, shapes=None, inputs=None, delay=0, rigid=RIGID
):
    """Accelerations under a held force u + quadratic u², with coloured noise and lines of the mains."""
    n, total = u.size, [*modes, *rigid]
    t = np.arange(n) / RATE
    shapes = rng.standard_normal((n_outputs, len(total))) if shapes is None else shapes
    inputs = rng.uniform(0.5, 1.5, len(total)) if inputs is None else inputs
    force = np.concatenate([np.zeros(delay), u + quadratic * u**2])[:n]
    y = np.zeros((n, n_outputs))
    for (frequency, damping), shape, gain in zip(total, shapes.T, inputs, strict=True):
        w = 2 * np.pi * frequency
        plant = np.array([[0, 1], [-(w**2), -2 * damping * w]]), np.array([[0], [gain]])
        Ad, Bd, *_ = cont2discrete((*plant, np.eye(2), np.zeros((2, 1))), 1 / RATE)
        denominator = np.poly(Ad)
        numerators = [np.poly(Ad - Bd @ row[None]) - denominator for row in np.eye(2)]
        q, v = (lfilter(x, denominator, force) for x in numerators)
        y += np.outer(gain * force - w**2 * q - 2 * damping * w * v, shape)
    size = y.std()
    y += noise * size * lfilter([0.44], [1, -0.9], rng.standard_normal(y.shape), axis=0)
    for line in (50.0, 150.02):
        y += hum * size * np.sin(2 * np.pi * line * t[:, None] + rng.uniform(0, 6, n_outputs))
    return y, shapes


def io(y, u=None):
    """What an estimator takes."""
    names = tuple(f"a{j}" for j in range(y.shape[1]))
    inputs = () if u is None else ("current",)
    units = {"current": "A", **dict.fromkeys(names, "m/s^2")}
    return IOData(
        u=np.empty((y.shape[0], 0)) if u is None else u[:, None],
        y=y, dt=1 / RATE, inputs=inputs, outputs=names, units=units, open_loop=True,
    )  # fmt: skip
