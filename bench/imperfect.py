"""One-axis records with imperfections, from a simulator of their own, and what `ambid.identify` makes of them.

The physics here use nothing of ambid: m x'' = f - c x' and V = R i + d(flux)/dt, with f = k_i i - k_x x or a magnet's
coenergy, by fourth-order Runge-Kutta steps within each sample, under a controller that is computed once a sample.
Alone: ``python bench/imperfect.py [--bench a,b] [--only sound,hum] [--seeds 3] [--json FILE]``.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

Array = NDArray[np.float64]
PHYSICAL = ("m", "k_x", "k_i", "R", "L")
UNITS = {"m": "kg", "k_x": "N/m", "k_i": "N/A", "R": "ohm", "L": "H", "c": "N s/m"}
GRAVITY = 9.81


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """A bench: its linear numbers about the operating point, its loop, excitation and noise (SI)."""

    m: float
    k_x: float
    k_i: float
    R: float
    L: float
    gap: float
    rate: float
    seconds: float
    band: tuple[float, float]
    volts: float  # rms of the excitation
    noise: tuple[float, float]  # m, A rms
    force: float  # N / sqrt(Hz), one-sided
    ripple: float  # V / sqrt(Hz), one-sided, of the amplifier
    spin: float  # Hz, of a rotor out of balance
    tight: tuple[float, float] | None = None  # m, V: what the controller weighs alike; None: no feedback
    single: bool = False  # one magnet above the mass; position is the gap
    bias: float = 0.0  # A, of the single magnet
    substeps: int = 5


BENCHES = {
    "a": Bench(
        m=4.0, k_x=-1.3e5, k_i=56.0, R=1.6, L=26e-3, gap=500e-6, rate=20e3, seconds=2.0, band=(2.0, 2000.0), volts=6.0,
        noise=(1e-7, 1e-3), force=0.02, ripple=5e-4, spin=87.0, tight=(1e-4, 10.0),
    ),
    "b": Bench(
        m=0.1, k_x=-8.7e4, k_i=20.0, R=4.0, L=5e-3, gap=400e-6, rate=10e3, seconds=2.0, band=(2.0, 1500.0), volts=2.0,
        noise=(1e-7, 1e-3), force=0.003, ripple=5e-4, spin=187.0, tight=(1e-4, 5.0),
    ),
    "c": Bench(
        m=0.06, k_x=-117.72, k_i=-1.1772, R=4.2, L=0.1, gap=10e-3, rate=1e3, seconds=6.0, band=(0.3, 100.0), volts=0.3,
        noise=(2e-6, 5e-4), force=1e-4, ripple=5e-4, spin=11.0, tight=(1e-3, 3.0), single=True, bias=1.0, substeps=10,
    ),
    "d": Bench(
        m=0.1, k_x=587.0, k_i=-310.0, R=1.25, L=59.6e-3, gap=1e-3, rate=10e3, seconds=2.0, band=(1.0, 2000.0),
        volts=1.0, noise=(1e-6, 2e-4), force=0.002, ripple=2e-4, spin=87.0,
    ),
}  # fmt: skip


class Physics(NamedTuple):
    """What the differential equations need; a rate of 0 means that the part is not there."""

    law: int  # 0 linear, 1 pair in differential drive, 2 one magnet
    m: float
    k_x: float
    k_i: float
    R: float
    L: float  # of the linear law; leakage of the others
    strength: float = 0.0  # N m^2 / A^2
    gap: float = 1.0
    bias: float = 0.0
    spring: float = 0.0  # N/m, beside the pair
    load: float = 0.0  # N, weight
    r_drift: float = 0.0  # 1/s
    eddy: float = 0.0  # rad/s
    position_pole: float = 0.0  # rad/s
    current_pole: float = 0.0  # rad/s
    mode: float = 0.0  # rad/s
    mode_share: float = 0.0  # of 1/m
    play: float = 0.0  # share of the hysteretic current
    play_width: float = 1.0  # A
    play_slope: float = 0.0  # of the hysteretic current by current, taken off


@njit(cache=True)  # type: ignore[untyped-decorator]
def _slope(p: Physics, s: Array, t: float, volts: float, force: float, out: Array) -> None:
    """Write ds/dt; s: position, speed, current, current behind the eddies, mode, its speed, hysteresis, sensors."""
    x, v, i = s[0] + s[4], s[1] + s[5], s[2]
    acting = s[3] if p.eddy > 0 else i
    if p.play > 0:
        acting += p.play * (s[6] - p.play_slope * i)
    if p.law == 0:
        f, inductance, emf = p.k_i * acting - p.k_x * x, p.L, p.k_i
    elif p.law == 1:
        side = 1.0 if p.k_i > 0 else -1.0
        near, far = p.gap - side * x, p.gap + side * x
        up, down = (p.bias + acting) / near, (p.bias - acting) / far
        f = side * 0.5 * p.strength * (up * up - down * down) - p.spring * x
        inductance = p.L + p.strength * (1 / near + 1 / far)
        emf = side * p.strength * ((p.bias + i) / near**2 + (p.bias - i) / far**2)
    else:
        f = p.load - 0.5 * p.strength * (acting / x) ** 2
        inductance, emf = p.L + p.strength / x, -p.strength * i / x**2
    f += force
    rate = (volts - p.R * (1 + p.r_drift * t) * i - emf * v) / inductance
    out[0], out[1], out[2] = s[1], f / p.m, rate
    out[3] = p.eddy * (i - s[3])
    out[4] = s[5]
    out[5] = p.mode_share * (f - p.load) / p.m - 0.02 * p.mode * s[5] - p.mode**2 * s[4]
    out[6] = rate - abs(rate) * s[6] / p.play_width if p.play > 0 else 0.0
    out[7] = p.position_pole * (x - s[7])
    out[8] = p.current_pole * (i - s[8])


@njit(cache=True)  # type: ignore[untyped-decorator]
def _run(
    p: Physics, start: Array, law: tuple[Array, Array, Array, Array], rest: Array, r: Array, force: Array, volts: Array,
    added: Array, taint: Array, step: float, limit: float, late: int, rate: float, substeps: int,
) -> tuple[Array, Array]:  # fmt: skip
    """Return what is logged and what is true, (n, 3) each: voltage, current, position."""
    n, h = r.size, 1.0 / rate / substeps
    A, B, K, G = law
    s, seen = start.copy(), np.zeros(3)
    k1, k2, k3, k4 = np.zeros(9), np.zeros(9), np.zeros(9), np.zeros(9)
    logged, true = np.empty((n, 3)), np.empty((n, 3))
    before, applied, j = s[0], rest[0], 0
    for k in range(n):
        x = s[7] if p.position_pole > 0 else s[0] + s[4]
        i = s[8] if p.current_pole > 0 else s[2]
        y_x = (before if late else x) + added[k, 1] + taint[0] * (applied - rest[0]) + taint[1] * (i - rest[1])
        y_i = i + added[k, 0]
        before = x
        if step > 0:
            y_i = step * np.round(y_i / step)
        u = r[k] - (K[0] * seen[0] + K[1] * seen[1] + K[2] * seen[2])
        e0, e1 = y_x - rest[2] - seen[0], y_i - rest[1] - seen[2]
        seen = A @ seen + B * u + G[:, 0] * e0 + G[:, 1] * e1
        logged[k] = u + rest[0], y_i, y_x
        applied = min(max(u, -limit), limit) + rest[0]
        true[k] = applied, s[2], s[0] + s[4]
        for _ in range(substeps):
            t, w, f = j * h, applied + volts[j], force[j]
            _slope(p, s, t, w, f, k1)
            _slope(p, s + 0.5 * h * k1, t + 0.5 * h, w, f, k2)
            _slope(p, s + 0.5 * h * k2, t + 0.5 * h, w, f, k3)
            _slope(p, s + h * k3, t + h, w, f, k4)
            s = s + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            j += 1
    return logged, true


def multisine(n: int, rate: float, band: tuple[float, float], rng: np.random.Generator) -> Array:
    """Random phases, power falling as 1/f, unit rms, one period long."""
    f = np.fft.rfftfreq(n, 1 / rate)
    inside = (f >= band[0]) & (f <= band[1])
    lines = np.zeros(f.size, complex)
    lines[inside] = np.exp(2j * np.pi * rng.random(inside.sum())) / np.sqrt(f[inside])
    u: Array = np.fft.irfft(lines, n)
    return u / u.std()


def controller(b: Bench) -> tuple[Array, Array, Array, Array]:
    """Return A, B of the linear bench over a sample, the feedback and the observer's gain."""
    big = np.zeros((5, 5))
    big[:3, :3] = [[0, 1, 0], [-b.k_x / b.m, 0, b.k_i / b.m], [0, -b.k_i / b.L, -b.R / b.L]]
    big[1, 3], big[2, 4] = 1 / b.m, 1 / b.L
    e = expm(big / b.rate)
    A, E, B = e[:3, :3].copy(), e[:3, 3:], e[:3, 4].copy()
    if b.tight is None:
        return A, B, np.zeros(3), np.zeros((3, 2))
    P = solve_discrete_are(A, B[:, None], np.diag([b.tight[0] ** -2, 0.0, 1e-6]), np.array([[b.tight[1] ** -2]]))
    K = (B @ P @ A) / (b.tight[1] ** -2 + B @ P @ B)
    C, R = np.eye(3)[[0, 2]], np.diag(np.square(b.noise))
    Q = E @ np.diag([(20 * b.force) ** 2, (20 * b.ripple) ** 2]) @ E.T * b.rate / 2
    S = solve_discrete_are(A.T, C.T, Q, R)
    return A, B, K, np.ascontiguousarray(A @ S @ C.T @ np.linalg.inv(C @ S @ C.T + R))


@dataclass(slots=True, kw_only=True)
class Setup:
    """One run as it will be simulated; an imperfection changes it."""

    bench: Bench
    rng: np.random.Generator  # of the imperfection
    seed: int
    physics: Physics
    r: Array  # V, excitation
    force: Array  # N, (n * substeps,)
    volts: Array  # V, (n * substeps,)
    added: Array  # A and m, (n, 2), what sensors add
    rms: Array  # V, A, m: of the sound run
    taint: Array = field(default_factory=lambda: np.zeros(2))  # m/V, m/A
    step: float = 0.0  # A, of the current's converter
    limit: float = math.inf  # V
    late: int = 0
    after: Callable[[Array], Array] = lambda logged: logged
    every: int = 1
    said_rate: float = 1.0
    rig: Mapping[str, str] = field(default_factory=dict)  # lines beside the usual ones, by table
    truth: dict[str, float] = field(default_factory=dict)  # factors on the truth

    def fine(self) -> Array:
        """Times of the substeps, s."""
        return np.arange(self.force.size) / (self.bench.rate * self.bench.substeps)

    def times(self) -> Array:
        """Times of the samples, s."""
        return np.arange(self.r.size) / self.bench.rate

    def newton(self) -> float:
        """Force of the sound run, N rms."""
        return abs(self.bench.k_i) * float(self.rms[1])

    def run(self) -> tuple[Array, Array]:
        """Return the logged and the true signals."""
        b, p = self.bench, self.physics
        rest = np.array([b.R * b.bias, b.bias, b.gap if b.single else 0.0])
        start = np.array([rest[2], 0.0, b.bias, b.bias, 0.0, 0.0, 0.0, rest[2], b.bias])
        return _run(
            p, start, controller(b), rest, self.r, self.force, self.volts, self.added, self.taint, self.step,
            self.limit, self.late, b.rate, b.substeps,
        )  # fmt: skip


def physics(b: Bench, curved: bool = False) -> Physics:
    """Return the linear bench, or the magnets that have its numbers at rest."""
    if b.single:
        strength = -b.k_i * b.gap**2 / b.bias
        load = 0.5 * strength * (b.bias / b.gap) ** 2
        return Physics(2, b.m, b.k_x, b.k_i, b.R, b.L - strength / b.gap, strength, b.gap, b.bias, load=load)
    if not curved:
        return Physics(0, b.m, b.k_x, b.k_i, b.R, b.L)
    air = 0.92 * b.L  # of it; the rest leaks
    strength, bias = 0.5 * air * b.gap, abs(b.k_i) * b.gap / air
    spring = b.k_x + 2 * strength * bias**2 / b.gap**3
    return Physics(1, b.m, b.k_x, b.k_i, b.R, b.L - air, strength, b.gap, bias, spring)


def setup(b: Bench, seed: int, index: int) -> Setup:
    """Return a sound run, its size measured."""
    rng = np.random.default_rng([seed, index])
    n = round(b.seconds * b.rate)
    white = math.sqrt(b.rate * b.substeps / 2)
    s = Setup(
        bench=b,
        rng=np.random.default_rng([seed, index, 1]),
        seed=seed,
        physics=physics(b),
        r=b.volts * multisine(n, b.rate, b.band, rng),
        force=b.force * white * rng.standard_normal(n * b.substeps),
        volts=b.ripple * white * rng.standard_normal(n * b.substeps),
        added=rng.standard_normal((n, 2)) * [b.noise[1], b.noise[0]],
        rms=np.ones(3),
    )
    return replace(s, rms=s.run()[1].std(0))


# --- imperfections: each changes a run by a size ------------------------------------------------------------------


def sound(s: Setup, size: float) -> None:
    """Nothing is wrong."""


def _walk(s: Setup, corner_hz: float) -> Array:
    """Unit rms, white below the corner, falling as 1/f above it."""
    from scipy.signal import lfilter

    pole = math.exp(-2 * math.pi * corner_hz / (s.bench.rate * s.bench.substeps))
    w: Array = lfilter([1.0], [1.0, -pole], s.rng.standard_normal(s.force.size))
    return (w - w.mean()) / w.std()


def slow_force(s: Setup, size: float) -> None:
    s.force += size * s.newton() * _walk(s, s.bench.spin / 10)


def walking_force(s: Setup, size: float) -> None:
    s.force += size * s.newton() * _walk(s, 1e-3)


def force_ramp(s: Setup, size: float) -> None:
    s.force += size * s.newton() * s.fine() / s.bench.seconds


def base_motion(s: Setup, size: float) -> None:
    s.force += math.sqrt(2) * size * s.newton() * np.sin(2 * np.pi * 13.0 * s.fine() + s.rng.uniform(0, 6.28))


def unbalance(s: Setup, size: float) -> None:
    s.force += math.sqrt(2) * size * s.newton() * np.sin(2 * np.pi * s.bench.spin * s.fine() + s.rng.uniform(0, 6.28))


def hum(s: Setup, size: float) -> None:
    s.added[:, 0] += math.sqrt(2) * size * s.rms[1] * np.sin(2 * np.pi * 50.0 * s.times() + s.rng.uniform(0, 6.28))


def pwm_alias(s: Setup, size: float) -> None:
    tone = 0.9863 * s.bench.rate  # of the current's ripple; sampled, at 0.0137 of the rate
    s.added[:, 0] += math.sqrt(2) * size * s.rms[1] * np.sin(2 * np.pi * tone * s.times() + s.rng.uniform(0, 6.28))


def r_drift(s: Setup, size: float) -> None:
    s.physics = s.physics._replace(r_drift=size / s.bench.seconds)
    s.truth["R"] = 1 + size / 2


def voltage_ramp(s: Setup, size: float) -> None:
    s.volts += size * s.rms[0] * s.fine() / s.bench.seconds


def curvature(s: Setup, size: float) -> None:
    s.physics = physics(s.bench, curved=True)
    s.r *= size * s.bench.gap / (math.sqrt(2) * s.rms[2])  # size: amplitude over gap


def eddy_pole(s: Setup, size: float) -> None:
    s.physics = s.physics._replace(eddy=2 * math.pi * size * s.bench.rate)


def sensor_pole(s: Setup, size: float) -> None:
    s.physics = s.physics._replace(position_pole=2 * math.pi * size * s.bench.rate)


def current_sensor_pole(s: Setup, size: float) -> None:
    s.physics = s.physics._replace(current_pole=2 * math.pi * size * s.bench.rate)


def sensor_lag(s: Setup, size: float) -> None:
    s.late = round(size)


def limiter(s: Setup, size: float) -> None:
    s.limit = size * s.rms[0]


def flexible_mode(s: Setup, size: float) -> None:
    b = s.bench
    A, B, K, _ = controller(b)
    loop = np.log(np.linalg.eigvals(A - np.outer(B, K)).astype(complex)) * b.rate
    w = float(np.abs(loop).max()) if b.tight else math.sqrt(b.k_i**2 / (b.L * b.m))
    s.physics = s.physics._replace(mode=3 * w, mode_share=size)


def quantisation(s: Setup, size: float) -> None:
    s.step = size * s.rms[1]


def voltage_cross_talk(s: Setup, size: float) -> None:
    s.taint[0] = size * s.rms[2] / s.rms[0]


def current_cross_talk(s: Setup, size: float) -> None:
    s.taint[1] = size * s.rms[2] / s.rms[1]


def hysteresis(s: Setup, size: float) -> None:
    width = 0.5 * s.rms[1]
    s.physics = s.physics._replace(play=size, play_width=width)
    for _ in range(2):  # the force's mean slope by current stays k_i
        i = s.run()[1][:, 1]
        z = _played(i, width)
        s.physics = s.physics._replace(play_slope=float(np.cov(z, i)[0, 1] / i.var()))


@njit(cache=True)  # type: ignore[untyped-decorator]
def _played(i: Array, width: float) -> Array:
    """Return the hysteretic current of a current, at the samples."""
    z = np.zeros(i.size)
    for k in range(1, i.size):
        d = i[k] - i[k - 1]
        sign = 1.0 if d > 0 else -1.0
        z[k] = sign * width + (z[k - 1] - sign * width) * math.exp(-abs(d) / width)
    return z


def spikes(s: Setup, size: float) -> None:
    n = s.r.size
    at = s.rng.choice(n, max(10, n // 2000), replace=False)
    jumps = size * s.rms[1:] * s.rng.choice([-1.0, 1.0], (at.size, 2))

    def after(logged: Array) -> Array:
        logged[at, 1:] += jumps
        return logged

    s.after = after


def stuck(s: Setup, size: float) -> None:
    n = s.r.size
    first, length = int(s.rng.integers(n // 4, n // 2)), round(size * n)

    def after(logged: Array) -> Array:
        logged[first : first + length, 2] = logged[first, 2]
        return logged

    s.after = after


def belonging(s: Setup, size: float) -> None:
    other = setup(s.bench, s.seed + round(1000 * size), 0).run()[0][:, 2]
    s.after = lambda logged: np.column_stack([logged[:, :2], other])


def gain_1pct(s: Setup, size: float) -> None:
    s.after = lambda logged: logged * [1 + size, 1.0, 1.0]
    s.rig = {"channels.voltage": f"gain_sd = {size}"}


def rate_1pct(s: Setup, size: float) -> None:
    s.said_rate = 1 + size
    s.rig = {"record": f"rate_sd = {size}"}


def sampling(s: Setup, size: float) -> None:
    s.every = round(size)


class Imperfection(NamedTuple):
    """What is done, how much, and the names under which its cause is right."""

    apply: Callable[[Setup, float], None]
    size: float
    causes: tuple[str, ...]  # none: nothing can be seen, or nothing is wrong


_LINE = ("line", "lines")
IMPERFECTIONS = {
    "sound": Imperfection(sound, 0.0, ()),
    "slow_force": Imperfection(slow_force, 0.3, ("slow_force",)),
    "walking_force": Imperfection(walking_force, 0.3, ("slow_force",)),
    "force_ramp": Imperfection(force_ramp, 1.0, ("slow_force", "force_ramp")),
    "base_motion": Imperfection(base_motion, 0.3, (*_LINE, "base_motion")),
    "unbalance": Imperfection(unbalance, 0.3, (*_LINE, "unbalance")),
    "hum": Imperfection(hum, 0.03, (*_LINE, "hum")),
    "pwm_alias": Imperfection(pwm_alias, 0.03, (*_LINE, "pwm_alias")),
    "r_drift": Imperfection(r_drift, 0.05, ("r_drift",)),
    "voltage_ramp": Imperfection(voltage_ramp, 0.2, ("slow_voltage", "voltage_ramp")),
    "curvature": Imperfection(curvature, 0.06, ("curvature",)),
    "eddy_pole": Imperfection(eddy_pole, 0.1, ("eddy_pole",)),
    "sensor_pole": Imperfection(sensor_pole, 0.15, ("sensor_pole", "position_pole")),
    "current_sensor_pole": Imperfection(current_sensor_pole, 0.15, ("current_sensor_pole", "current_pole")),
    "sensor_lag": Imperfection(sensor_lag, 1.0, ("sensor_lag", "in_time")),
    "limiter": Imperfection(limiter, 2.0, ("limiter", "within_limits")),
    "flexible_mode": Imperfection(flexible_mode, 0.2, ("flexible_mode",)),
    "quantisation": Imperfection(quantisation, 0.5, ("quantisation",)),
    "voltage_cross_talk": Imperfection(voltage_cross_talk, 0.03, ("cross_talk",)),
    "current_cross_talk": Imperfection(current_cross_talk, 0.1, ("cross_talk",)),
    "hysteresis": Imperfection(hysteresis, 0.1, ("hysteresis",)),
    "spikes": Imperfection(spikes, 3.0, ("spikes", "signals_sound")),
    "stuck": Imperfection(stuck, 0.05, ("stuck", "signals_sound", "within_limits")),
    "gain_1pct": Imperfection(gain_1pct, 0.01, ()),
    "rate_1pct": Imperfection(rate_1pct, 0.01, ()),
    "belonging": Imperfection(belonging, 1.0, ("belonging",)),
    "sampling": Imperfection(sampling, 20.0, ("sampling",)),
}

IMPOSSIBLE = {("d", "eddy_pole")}  # an open loop whose force lags gives out energy, and does not stay


def records(
    bench: str, imperfection: str, seed: int, size: float | None = None
) -> tuple[dict[str, Array], float, dict[str, float], str]:
    """Return columns, rate as it is said, the true linear numbers at the mean operating point, and the rig's text."""
    b, wrong = BENCHES[bench], IMPERFECTIONS[imperfection]
    s = setup(b, seed, list(BENCHES).index(bench))
    wrong.apply(s, wrong.size if size is None else size)
    logged, true = s.run()
    if not np.isfinite(logged).all() or np.abs(true[:, 2] - b.gap * b.single).max() > 0.9 * b.gap:
        raise RuntimeError(f"bench {bench} with {imperfection}: the loop does not hold it")
    truth = linear(s.physics, b, true.mean(0))
    truth = {name: value * s.truth.get(name, 1.0) for name, value in truth.items()}
    logged = s.after(logged)[:: s.every]
    columns = dict(zip(("voltage", "current", "position"), np.ascontiguousarray(logged.T), strict=True))
    return columns, b.rate * s.said_rate / s.every, truth, rig_text(bench, b, s.rig)


def linear(p: Physics, b: Bench, mean: Array) -> dict[str, float]:
    """Return the numbers of the law's tangent at a mean voltage, current and position."""
    truth = {name: getattr(b, name) for name in PHYSICAL}
    _, i, x = mean
    if p.law == 2:
        return truth | {"k_i": -p.strength * i / x**2, "k_x": -p.strength * i**2 / x**3, "L": p.L + p.strength / x}
    if p.law == 1:
        side = math.copysign(1.0, p.k_i)
        up, down, near, far = p.bias + i, p.bias - i, p.gap - side * x, p.gap + side * x
        return truth | {
            "k_i": side * p.strength * (up / near**2 + down / far**2),
            "k_x": p.spring - p.strength * (up**2 / near**3 + down**2 / far**3),
            "L": p.L + p.strength * (1 / near + 1 / far),
        }
    return truth


def rig_text(name: str, b: Bench, more: Mapping[str, str]) -> str:
    """Return a rig that knows nothing, but the ball's mass; with the lines of `more` in their tables."""
    known = {"c": 0.0} | ({"m": b.m} if b.single else {})
    text = ['schema = "ambid.rig/1"', f'name = "imperfect {name}"', 'model = "one-axis"']
    for channel in ("voltage", "current", "position"):
        text += [f"[channels.{channel}]", f'column = "{channel}"', more.get(f"channels.{channel}", "")]
    text += ["[record]", more["record"]] if "record" in more else []
    text.append("[parameters]")
    for parameter, unit in UNITS.items():
        fixed = f', role = "fixed", value = {known[parameter]!r}' if parameter in known else ""
        text.append(f'{parameter} = {{ unit = "{unit}"{fixed} }}')
    return "\n".join(text) + "\n"


# --- the judge -----------------------------------------------------------------------------------------------------

# checks that name no cause
_GENERAL = {
    "residuals_white", "residuals_uncorrelated", "uncertainty_consistent", "estimates_agree", "identifiable",
    "plausible", "long_enough", "converged", "status", "delay_shown", "innovations_consistent", "refused",
}  # fmt: skip


def judged(bench: str, imperfection: str, seed: int, folder: Path) -> dict[str, Any]:
    """Return one row: what ambid says of a record, and how far it is from the truth."""
    import ambid

    columns, rate, truth, text = records(bench, imperfection, seed)
    row: dict[str, Any] = {"bench": bench, "imperfection": imperfection, "seed": seed}
    began = time.perf_counter()
    try:
        found = identified(columns, rate, text, folder)
    except ambid.AmbidError as refusal:
        why = str(refusal)
        return row | {
            "verdict": "refused", "reasons": [{"check": "refused", "text": why}], "parameters": {},
            "extended": [], "seconds": time.perf_counter() - began,
        }  # fmt: skip
    row["seconds"] = time.perf_counter() - began
    said = found.verdict
    row |= {"verdict": said.word, "reasons": [_plain(r) for r in said.reasons]}
    row["extended"] = [str(e) for e in getattr(found, "extended", None) or ()]
    numbers = {}
    for name in PHYSICAL:
        p = found[name]
        sd = getattr(p, "sd_calibrated", None) or p.sd
        if p.role == "fixed" or sd is None:
            continue
        z = (p.value - truth[name]) / sd if sd > 0 else math.copysign(1e3, p.value - truth[name])
        ci = getattr(p, "ci95_calibrated", None) or p.ci95
        numbers[name] = {
            "value": p.value, "truth": truth[name], "sd": sd, "z": z, "identifiable": bool(p.identifiable),
            "covered": ci is not None and bool(ci[0] <= truth[name] <= ci[1]),
        }  # fmt: skip
    return row | {"parameters": numbers}


def identified(columns: Mapping[str, Array], rate: float, text: str, folder: Path) -> Any:
    """Identify a record; without what the rig says of calibration where ambid does not know that yet."""
    import ambid

    units = {"voltage": "V", "current": "A", "position": "m"}
    rig = folder / "rig.toml"
    rig.write_text(text)
    try:
        return ambid.identify(dict(columns), rig, rate_hz=rate, units=units)
    except ambid.AmbidError as refusal:
        if "gain_sd" not in str(refusal) and "rate_sd" not in str(refusal):
            raise
    rig.write_text("\n".join(line for line in text.splitlines() if "_sd = " not in line))
    return ambid.identify(dict(columns), rig, rate_hz=rate, units=units)


def _plain(reason: Any) -> dict[str, Any]:
    """Return a reason's check, cause and alternatives."""
    more = {key: getattr(reason, key, None) for key in ("cause", "alternatives", "grave")}
    return {"check": reason.check} | {key: value for key, value in more.items() if value}


def cause(row: Mapping[str, Any]) -> str:
    """Say whether the first reason names the true cause: right, wrong, general (no cause is named) or silent."""
    true = IMPERFECTIONS[row["imperfection"]].causes
    reasons = row["reasons"]
    if not reasons:
        extended = row["extended"]
        return "silent" if not extended else "right" if any(t in e for t in true for e in extended) else "wrong"
    first = reasons[0]
    named = [first["check"], first.get("cause"), *map(str, first.get("alternatives", ()))]
    if any(name in true for name in named if name):
        return "right"
    return "general" if not first.get("cause") and first["check"] in _GENERAL else "wrong"


def worst(row: Mapping[str, Any]) -> tuple[float, str]:
    """Return the largest |z| of the numbers that are called identified, and whose."""
    z = [(abs(p["z"]), name) for name, p in row["parameters"].items() if p["identifiable"]]
    return max(z, default=(math.nan, "-"))


def line(row: Mapping[str, Any]) -> str:
    """Return a row as text."""
    z, name = worst(row)
    said = [r["check"] + (f"={r['cause']}" if "cause" in r else "") for r in row["reasons"]]
    said += [f"+{e}" for e in row["extended"]]
    head = f"{row['bench']} {row['imperfection']:20} {row['seed']:3d} {row['verdict']:9} {cause(row):8}"
    return f"{head} {z:8.1f} {name:4} {row['seconds']:6.2f}  {', '.join(said)}"


def summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the shares that matter."""
    wrong = [r for r in rows if IMPERFECTIONS[r["imperfection"]].causes]
    told = [cause(r) for r in wrong]
    bad = [t for t, r in zip(told, wrong, strict=True) if t != "silent" or worst(r)[0] > 4]
    stated = [p for r in rows for p in r["parameters"].values() if p["identifiable"]]
    healthy = [r for r in rows if r["imperfection"] == "sound"]
    covered = {
        name: [r["parameters"][name]["covered"] for r in healthy if name in r["parameters"]] for name in PHYSICAL
    }

    def share(some: Sequence[bool]) -> float | None:
        return sum(some) / len(some) if some else None

    return {
        "cases": len(rows),
        "usable_beyond_4_sd": sum(r["verdict"] == "usable" and worst(r)[0] > 4 for r in rows),
        "intervals_within_4_sd": share([abs(p["z"]) <= 4 for p in stated]),
        "cause_right": share([t == "right" for t in told]),
        "cause_right_of_harmful": share([t == "right" for t in bad]),
        "cause_wrong_alone": share([t == "wrong" for t in told]),
        "cause_general": share([t == "general" for t in told]),
        "silent": share([t == "silent" for t in told]),
        "sound_usable": share([r["verdict"] == "usable" for r in healthy]),
        "sound_coverage": {name: share(c) for name, c in covered.items() if c},
    }


def main() -> None:
    """Run what is asked for, print a row each and the summary."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bench", default=",".join(BENCHES))
    parser.add_argument("--only", default=",".join(IMPERFECTIONS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    rows = []
    print("bench, imperfection, seed, verdict, cause, worst |z|, of, seconds, checks")
    with tempfile.TemporaryDirectory() as folder:
        for imperfection in asked.only.split(","):
            for bench in asked.bench.split(","):
                if (bench, imperfection) in IMPOSSIBLE:
                    continue
                for seed in range(1, asked.seeds + 1):
                    rows.append(judged(bench, imperfection, seed, Path(folder)))
                    print(line(rows[-1]), flush=True)
    told = summary(rows)
    for name, value in told.items():
        print(f"{name:24} {value}")
    if asked.json:
        asked.json.write_text(json.dumps({"summary": told, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
