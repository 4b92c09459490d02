"""Records for frozen_cases.py, made without ambid: one axis in open and closed loop, a curved magnet, plain equations.

They are the same to the last digit wherever NumPy's random numbers are: no linear algebra library takes part.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

Signals = dict[str, np.ndarray]

THESIS = {"m": 0.1, "k_x": 587.22, "k_i": -310.08, "R": 1.25, "L": 59.6e-3}
BEARING = {"m": 4.0, "k_x": -129.0e3, "k_i": 55.7, "R": 1.6, "L": 26.1e-3}
BEARING_LOOP = {"kp": 90.7e3, "ki": 647e3, "kd": 359.0, "kc": 20.8, "hz": 1500.0}
BALL = {"m": 0.060, "k_x": -117.72, "k_i": -1.2392, "R": 4.2, "L": 0.1170}
BALL_LOOP = {"kp": -4869.0, "ki": -4250.0, "kd": -94.66, "kc": 22.95, "hz": 400.0}


def multisine(n: int, rate: float, band: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    """Return a multisine of rms 1 with random phases."""
    f = np.fft.rfftfreq(n, 1 / rate)
    lines = (f >= band[0]) & (f <= band[1])
    spectrum = np.where(lines, np.exp(2j * np.pi * rng.random(f.size)) / np.sqrt(np.maximum(f, 1.0)), 0.0)
    u = np.fft.irfft(spectrum, n)
    return u / u.std()


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a b, summed in this order whatever the machine."""
    return np.array([[sum(x * y for x, y in zip(row, column, strict=True)) for column in b.T] for row in a])


def sampled(p: dict[str, float], rate: float) -> list[list[float]]:
    """Return rows of the plant's response over a sample to position, velocity, current, voltage and force, held."""
    a = np.zeros((5, 5))
    a[0, 1] = 1.0
    a[1, [0, 2, 4]] = -p["k_x"] / p["m"], p["k_i"] / p["m"], 1 / p["m"]
    a[2, [1, 2, 3]] = -p["k_i"] / p["L"], -p["R"] / p["L"], 1 / p["L"]
    a /= rate * 1024
    e = term = np.eye(5)
    for k in range(1, 12):
        term = product(term, a) / k
        e = e + term
    for _ in range(10):
        e = product(e, e)
    return e[:3].tolist()


def curved(gap: float) -> Callable[..., list[float]]:
    """Return the step of a ball under a magnet of inductance 0.104 + k/z, about a gap where it rests."""
    m, ohm, leak, weight = 0.060, 4.2, 0.104, 0.060 * 9.81
    k = 2 * weight * (0.010 / 0.95) ** 2
    rest = gap * math.sqrt(2 * weight / k)

    def slope(x: float, v: float, i: float, volt: float, force: float) -> tuple[float, float, float]:
        z, j = gap + x, rest + i
        pull = -k * j * j / (2 * z * z)
        return v, (pull + weight + force) / m, (volt + ohm * rest - ohm * j + k * j * v / (z * z)) / (leak + k / z)

    def step(x: list[float], volt: float, force: float, dt: float) -> list[float]:
        for _ in range(4):
            h = dt / 4
            a = slope(*x, volt, force)
            b = slope(*(p + h / 2 * q for p, q in zip(x, a, strict=True)), volt, force)
            c = slope(*(p + h / 2 * q for p, q in zip(x, b, strict=True)), volt, force)
            d = slope(*(p + h * q for p, q in zip(x, c, strict=True)), volt, force)
            x = [p + h / 6 * (q + 2 * r + 2 * s + t) for p, q, r, s, t in zip(x, a, b, c, d, strict=True)]
        return x

    step.rest = (gap, rest, ohm * rest)  # type: ignore[attr-defined]
    return step


def axis(
    plant: dict[str, float] | Callable[..., list[float]], n: int, rate: float, volts: float,
    band: tuple[float, float], seed: int, *, loop: dict[str, float] | None = None, delay: int = 0,
    noise: Sequence[float] = (0.0, 0.0, 0.0, 0.0), snr_db: float | None = None, periods: int = 1,
    rest: Sequence[float] = (0.0, 0.0, 0.0), after: tuple[int, dict[str, float]] | None = None,
) -> Signals:  # fmt: skip
    """Return a record of one axis; `noise` are rms of position, current, force and voltage, `after` a changed plant."""
    rng = np.random.default_rng(seed)
    r = np.tile(volts * multisine(n // periods, rate, band, rng), periods)
    w = rng.standard_normal((n, 4)) * noise
    c = loop or {"kp": 0.0, "ki": 0.0, "kd": 0.0, "kc": 0.0, "hz": 1.0}
    tau = 1 / (2 * math.pi * c["hz"])
    rows = None if callable(plant) else sampled(plant, rate)
    x, integral, rate_part, last, waiting = [0.0, 0.0, 0.0], 0.0, 0.0, 0.0, [0.0] * delay
    y, u = np.empty((n, 2)), np.empty(n)
    for k in range(n):
        if after and k == after[0]:
            rows = sampled(after[1], rate)
        seen, amp = x[0] + w[k, 0], x[2] + w[k, 1]
        rate_part = (tau * rate_part - c["kd"] * (seen - last)) / (tau + 1 / rate)
        out = -c["kp"] * seen + integral + rate_part - c["kc"] * amp + r[k]
        integral, last = integral - c["ki"] / rate * seen, seen
        y[k], u[k] = (seen, amp), out
        waiting.append(out)
        volt, force = waiting.pop(0) + w[k, 3], w[k, 2]
        if rows is None:
            x = plant(x, volt, force, 1 / rate)
        else:
            x = [a * x[0] + b * x[1] + d * x[2] + e * volt + f * force for a, b, d, e, f in rows]
    if snr_db is not None:
        y += rng.standard_normal((n, 2)) * y.std(0) * 10 ** (-snr_db / 20)
    gap, current, voltage = getattr(plant, "rest", rest)
    signals = {"time [s]": np.arange(n) / rate, "voltage [V]": u + voltage, "current [A]": y[:, 1] + current}
    return signals | {"position [m]": y[:, 0] + gap} | ({"excitation [V]": r} if loop else {})


def line(n: int, seed: int, kind: str) -> Signals:
    """Return a record of a difference equation with input u and output y: armax, loop, bent or scheduled by p."""
    rng = np.random.default_rng(seed)
    r, e, y, u = rng.standard_normal(n), 0.1 * rng.standard_normal(n), [0.0] * n, [0.0] * n
    p = np.sin(2 * np.pi * np.arange(n) / 150)
    for t in range(n):
        y1, y2, u1, u2 = (s[t - d] if t >= d else 0.0 for s in (y, u) for d in (1, 2))
        if kind == "bent":
            y[t] = 0.6 * y1 - 0.1 * y2 + 0.9 * u2 + 0.3 * u1 * u1 + 0.2 * e[t]
        elif kind == "scheduled":
            y[t] = (1.2 + 0.2 * p[t]) * y1 - 0.5 * y2 + (1.0 - 0.3 * p[t]) * u1 + e[t]
        else:
            y[t] = 1.5 * y1 - 0.7 * y2 + u1 + 0.5 * u2 + e[t] + 0.6 * (e[t - 1] if t else 0.0)
        u[t] = r[t] - (0.25 * y[t] if kind == "loop" else 0.0)
    extra = {"loop": {"r [V]": r}, "scheduled": {"p [1]": p}}.get(kind, {})
    return {"time [s]": np.arange(n) / 100, "u [V]": np.array(u), "y [A]": np.array(y)} | extra


def written(signals: Signals) -> str:
    """Return a record as CSV."""
    rows = zip(*(s.tolist() for s in signals.values()), strict=True)
    return "\n".join([",".join(signals), *(",".join(f"{v:.10g}" for v in row) for row in rows)]) + "\n"


_open = partial(axis, THESIS, 3000, 1e4, 2.0, (5.0, 2000.0))
_loop = partial(axis, BEARING, rate=2e4, volts=6.0, band=(10.0, 2000.0), loop=BEARING_LOOP, delay=1)
_ball = partial(axis, rate=2e3, volts=1.0, band=(0.5, 200.0), loop=BALL_LOOP, delay=1, noise=(2e-6, 1e-3, 2e-3, 0.02))
QUIET, LOUD = (1e-7, 2e-3, 1.0, 0.05), (5e-7, 1e-2, 3.0, 0.2)
RECORDS: dict[str, Callable[[], Signals]] = {
    "open.csv": partial(_open, 1, snr_db=40.0),
    "open2.csv": partial(_open, 2, snr_db=40.0),
    "noisy.csv": partial(_open, 3, snr_db=15.0, delay=2),
    "loop.csv": partial(_loop, n=4000, seed=4, noise=QUIET),
    "loop2.csv": partial(_loop, n=3000, seed=5, noise=QUIET),
    "loud.csv": partial(_loop, n=4000, seed=6, noise=LOUD),
    "periodic.csv": partial(_loop, n=12000, seed=7, noise=QUIET, periods=6),
    "change.csv": partial(_loop, n=24000, seed=8, noise=QUIET, after=(16000, BEARING | {"k_i": 0.85 * BEARING["k_i"]})),
    "ball.csv": partial(_ball, BALL, 4000, seed=9, rest=(0.010, 0.95, 3.99)),
    "ball2.csv": partial(_ball, BALL, 2000, seed=10, rest=(0.010, 0.95, 3.99)),
    "gap8.csv": lambda: _ball(curved(0.008), 1200, seed=11),
    "gap10.csv": lambda: _ball(curved(0.010), 1200, seed=12),
    "gap12.csv": lambda: _ball(curved(0.012), 1200, seed=13),
    "line.csv": partial(line, 800, 14, "armax"),
    "line2.csv": partial(line, 500, 15, "armax"),
    "fed.csv": partial(line, 1000, 16, "loop"),
    "bent.csv": partial(line, 400, 17, "bent"),
    "bent2.csv": partial(line, 300, 18, "bent"),
    "scheduled.csv": partial(line, 600, 19, "scheduled"),
    "scheduled2.csv": partial(line, 400, 20, "scheduled"),
}
