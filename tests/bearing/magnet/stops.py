"""A ball under one magnet between stops from which it bounces: equations of its own, f = -i²/2 dL/dx, by default
k/2 (i/x)² (thesis 1.9).
"""

import math
from collections.abc import Callable

import numpy as np

from ambid.bearing.magnet_problem import BearingRecord

K, LEAK, MASS, RESISTANCE, RATE, STEPS = 3.9e-6, 3e-3, 0.05, 3.0, 5000.0, 4
GAP = 0.2e-3  # at position 0
STOPS = (0.8e-3, 2.8e-3)
NOISE = [1e-6, 1e-3, 3e-3, 0.01, 0.01, 0.01]  # in the order of `LEVELS`: rms of one sample
TRUTH = {"k": K, "s": GAP, "L_leak": LEAK, "m": MASS, "R": RESISTANCE, "g": 9.81, "c": 0.0, "a": 500.0, "sigma": 0.0,
         "L_rise": 0.0, "i_knee": 1.0, "i0": 0.0, "k_asym": 0.0, "i0_asym": 0.0, "x_offset": 0.0, "i_offset": 0.0,
         "v_offset": 0.0, "v_drop": 0.0, "i_drop": 0.02, "tau": 1.0}  # fmt: skip


Coil = Callable[[float], tuple[float, float]]


def hyperbolic(x: float) -> tuple[float, float]:
    """Inductance beyond the leakage at a distance from the magnet, and how fast it falls there, H and H/m."""
    return K / x, K / (x * x)


def exponential(x: float) -> tuple[float, float]:
    """Another law with the same force and stiffness at 2 mm."""
    falls = K / 2e-3**2 * math.exp(2.0 - x / 1e-3)
    return falls * 1e-3, falls


def _rates(coil: Coil, x: float, v: float, i: float, volts: float, force: float) -> tuple[float, float, float]:
    L, falls = coil(x)
    return v, 9.81 + (force - falls * i * i / 2.0) / MASS, (volts - RESISTANCE * i + falls * i * v) / (L + LEAK)


def _carrying(coil: Coil, x: float) -> float:
    """The current that carries the ball."""
    return math.sqrt(2.0 * MASS * 9.81 / coil(x)[1])


def ball_between_stops(
    setpoint: np.ndarray, seed: int, *, bounce: float = 0.2, volts: float = 2.0, name: str = "ball.csv",
    beside: np.ndarray | None = None, coil: Coil = hyperbolic,
) -> BearingRecord:  # fmt: skip
    """A levitated ball whose set point may lie beyond a stop; voltage held over a sample, no delay. `beside`: voltage
    and force that nobody logs, (n, 2).
    """
    rng, n, h = np.random.default_rng(seed), setpoint.size, 1.0 / RATE / STEPS
    kick = np.repeat(rng.choice([-volts, volts], n // 7 + 1), 7)[:n]
    noise = rng.standard_normal((n, 4)) * NOISE[:4]
    noise[:, [3, 2]] += 0.0 if beside is None else beside
    y, u = np.zeros((n, 2)), np.zeros(n)
    x, v, before, slow = float(setpoint[0]) + GAP, 0.0, 0.0, 0.0
    i = _carrying(coil, x)
    for k in range(n):
        y[k] = x - GAP + noise[k, 0], i + noise[k, 1]
        e = y[k, 0] - setpoint[k]
        slow += 0.5 * ((e - before) * RATE * (k > 0) - slow)
        before = e
        wanted = _carrying(coil, setpoint[k] + GAP) + 2250.0 * e + 16.0 * slow
        u[k] = RESISTANCE * wanted + 3.0 * (wanted - y[k, 1]) + kick[k]
        at = u[k] + noise[k, 3], noise[k, 2]
        for _ in range(STEPS):
            a = _rates(coil, x, v, i, *at)
            b = _rates(coil, x + h / 2 * a[0], v + h / 2 * a[1], i + h / 2 * a[2], *at)
            c = _rates(coil, x + h / 2 * b[0], v + h / 2 * b[1], i + h / 2 * b[2], *at)
            d = _rates(coil, x + h * c[0], v + h * c[1], i + h * c[2], *at)
            x, v, i = (s + h / 6 * (p + 2 * q + 2 * r + t) for s, p, q, r, t in zip((x, v, i), a, b, c, d, strict=True))
            low, high = STOPS[0] + GAP, STOPS[1] + GAP
            if not low <= x <= high:
                v = -bounce * v if (v < 0.0) == (x < low) else v
                x = min(max(x, low), high)
    return BearingRecord(name=name, rate_hz=RATE, u=u, loose=np.zeros(n), y=y, valid=np.ones((n, 2), dtype=bool))


def lying(seed: int, n: int = 3000, name: str = "ball.csv") -> BearingRecord:
    """It rests on the far stop for about 30 % of the record."""
    rng = np.random.default_rng(seed)
    setpoint = np.repeat(rng.uniform(1.3e-3, 2.4e-3, 6), n // 6)
    setpoint[2 * n // 5 : 7 * n // 10] = 3.0e-3
    smooth = np.convolve(np.concatenate([np.full(150, setpoint[0]), setpoint]), np.ones(151) / 151, "valid")
    return ball_between_stops(smooth, seed, name=name)
