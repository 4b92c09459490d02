"""One-axis records with imperfections, from a simulator of their own, and what `ambid.identify` makes of them.

The physics use nothing of ambid: m x'' = f and V = R i + d(flux)/dt, with f = k_i i - k_x x or by a magnet's coenergy,
in fourth-order Runge-Kutta steps within each sample, under a controller that acts once a sample. Signals are sampled
just before the voltage steps, which is then held. The truth are the numbers of the law's tangent at the mean point.

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
from scipy.signal import lfilter

Array = NDArray[np.float64]
PHYSICAL = ("m", "k_x", "k_i", "R", "L")
TURN = 2 * math.pi


class Bench(NamedTuple):
    """A bench: its linear numbers at rest, its loop, excitation and noise (SI)."""

    m: float
    k_x: float
    k_i: float
    R: float
    L: float
    gap: float
    rate: float
    seconds: float
    band: tuple[float, float]  # Hz
    volts: float  # rms of the excitation
    noise: tuple[float, float]  # A, m rms
    force: float  # N / sqrt(Hz), one-sided
    ripple: float  # V / sqrt(Hz), one-sided, of the amplifier
    spin: float  # Hz, of a rotor out of balance
    tight: tuple[float, float] | None = None  # m, V: what the controller weighs alike; None: no feedback
    bias: float = 0.0  # A, of one magnet that carries the weight; position is then its gap
    substeps: int = 10


BENCHES = {
    "a": Bench(4.0, -1.3e5, 56.0, 1.6, 26e-3, 500e-6, 20e3, 2.0, (2.0, 2000.0), 1.5, (1e-3, 1e-7), 0.02, 5e-4, 87.0,
               tight=(1e-4, 10.0)),
    "b": Bench(0.1, -8.7e4, 20.0, 4.0, 5e-3, 400e-6, 10e3, 2.0, (2.0, 1500.0), 0.6, (1e-3, 1e-7), 0.003, 5e-4, 187.0,
               tight=(1e-4, 5.0)),
    "c": Bench(0.06, -117.72, -1.1772, 4.2, 0.1, 10e-3, 1e3, 6.0, (0.3, 100.0), 0.3, (5e-4, 2e-6), 1e-4, 5e-4, 11.0,
               tight=(1e-3, 3.0), bias=1.0),
    "d": Bench(0.1, 587.0, -310.0, 1.25, 59.6e-3, 1e-3, 10e3, 2.0, (5.0, 2000.0), 1.0, (2e-4, 1e-6), 0.002, 2e-4, 87.0),
}  # fmt: skip


class Physics(NamedTuple):
    """What the differential equations need; where a number is 0, its part is not there."""

    law: int  # 0 linear, 1 pair in differential drive, 2 one magnet
    m: float
    k_x: float
    k_i: float
    R: float
    leak: float  # H, of flux that makes no force
    air: float  # H, of flux that does, at rest
    gap: float
    bias: float
    spring: float  # N/m, beside the pair
    r_drift: float = 0.0  # 1/s
    eddy: float = 0.0  # rad/s: the force lags the current
    shunt: float = 0.0  # ohm: eddy currents beside the flux of the air gap, which lose what they should
    play: float = 0.0  # share of the hysteretic current
    width: float = 1.0  # A, of its loops
    slope: float = 0.0  # of the hysteretic current, taken off
    position_pole: float = 0.0  # rad/s
    current_pole: float = 0.0  # rad/s
    mode: float = 0.0  # rad/s
    share: float = 0.0  # of the mode, of 1/m


@njit(cache=True)
def _slope(p: Physics, s: Array, t: float, volts: float, force: float, out: Array) -> None:
    """Write ds/dt; s: position, speed, current, lagged current or flux, mode, its speed, hysteresis, two sensors."""
    x, v, i = s[0] + s[4], s[1] + s[5], s[2]
    out[3], out[6] = 0.0, 0.0
    strength = p.air * p.gap  # of one magnet; of each of a pair half
    drop = volts - p.R * (1 + p.r_drift * t) * i
    if p.shunt > 0 or p.play > 0:  # the flux is a state, and i = magnetising + hysteretic + eddy current
        flux = s[3]
        if p.law == 2:
            magnetising, per, moving = flux * x / strength, x / strength, flux * v / strength
            f = -0.5 * flux**2 / strength
        else:
            magnetising, per, moving = (flux - p.k_i * x) / p.air, 1 / p.air, -p.k_i * v / p.air
            f = p.k_i * magnetising - p.k_x * x
        if p.shunt > 0:
            out[3] = p.shunt * (i - magnetising)
        else:
            rise = drop - p.leak * moving
            z = 1 - math.copysign(1.0, rise) * s[6] / p.width
            out[3] = rise / (1 + p.leak * (per + p.play * (z - p.slope) / p.air))
            out[6] = z * out[3] / p.air
        rate = (drop - out[3]) / p.leak
    else:
        acting = s[3] if p.eddy > 0 else i
        if p.law == 0:
            f, inductance, emf = p.k_i * acting - p.k_x * x, p.leak + p.air, p.k_i
        elif p.law == 1:
            side, half = math.copysign(1.0, p.k_i), 0.5 * strength
            near, far = p.gap - side * x, p.gap + side * x
            f = 0.5 * side * half * (((p.bias + acting) / near) ** 2 - ((p.bias - acting) / far) ** 2) - p.spring * x
            inductance = p.leak + half * (1 / near + 1 / far)
            emf = side * half * ((p.bias + i) / near**2 + (p.bias - i) / far**2)
        else:
            f, inductance, emf = -0.5 * strength * (acting / x) ** 2, p.leak + strength / x, -strength * i / x**2
        rate = (drop - emf * v) / inductance
        out[3] = p.eddy * (i - s[3])
    if p.law == 2:
        f += 0.5 * strength * (p.bias / p.gap) ** 2  # weight
    pull = (f + force) / p.m
    out[0], out[1], out[2], out[4] = s[1], pull, rate, s[5]
    out[5] = p.share * pull - 0.04 * p.mode * s[5] - p.mode**2 * s[4]
    out[7], out[8] = p.position_pole * (x - s[7]), p.current_pole * (i - s[8])


@njit(cache=True)
def _run(
    p: Physics, start: Array, law: tuple[Array, Array, Array, Array], rest: Array, r: Array, force: Array, volts: Array,
    added: Array, step: float, limit: float, late: int, h: float,
) -> tuple[Array, Array]:  # fmt: skip
    """Return what is logged and what is true, (n, 3) each: voltage, current, position."""
    A, B, K, G = law
    s, seen, substeps = start.copy(), np.zeros(3), force.size // r.size
    k1, k2, k3, k4 = np.zeros(9), np.zeros(9), np.zeros(9), np.zeros(9)
    logged, true = np.empty((r.size, 3)), np.empty((r.size, 3))
    before, j = s[0], 0
    for k in range(r.size):
        x = s[7] if p.position_pole > 0 else s[0] + s[4]
        y_x = (before if late else x) + added[k, 1]
        y_i = (s[8] if p.current_pole > 0 else s[2]) + added[k, 0]
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
    lines[inside] = np.exp(1j * TURN * rng.random(inside.sum())) / np.sqrt(f[inside])
    u = np.fft.irfft(lines, n)
    return np.asarray(u / u.std())


def controller(b: Bench) -> tuple[Array, Array, Array, Array]:
    """Return A, B of the linear bench over a sample, the feedback's and the observer's gain."""
    big = np.zeros((5, 5))
    big[:3, :3] = [[0.0, 1.0, 0.0], [-b.k_x / b.m, 0.0, b.k_i / b.m], [0.0, -b.k_i / b.L, -b.R / b.L]]
    big[1, 3], big[2, 4] = 1 / b.m, 1 / b.L
    e = expm(big / b.rate)
    A, E, B = e[:3, :3].copy(), e[:3, 3:], e[:3, 4].copy()
    if b.tight is None:
        return A, B, np.zeros(3), np.zeros((3, 2))
    cost = b.tight[1] ** -2
    P = solve_discrete_are(A, B[:, None], np.diag([b.tight[0] ** -2, 0.0, 1e-6]), np.array([[cost]]))
    C, R = np.eye(3)[[0, 2]], np.diag(np.square(b.noise[::-1]))
    Q = E @ np.diag([(20 * b.force) ** 2, (20 * b.ripple) ** 2]) @ E.T * b.rate / 2
    S = solve_discrete_are(A.T, C.T, Q, R)
    return A, B, B @ P @ A / (cost + B @ P @ B), np.ascontiguousarray(A @ S @ C.T @ np.linalg.inv(C @ S @ C.T + R))


def magnet(b: Bench, law: int) -> Physics:
    """Return the physics with the bench's numbers at rest: linear, a pair, or one magnet."""
    if law == 2:
        air, bias, spring = -b.k_i * b.gap / b.bias, b.bias, 0.0
    else:
        air = 0.92 * b.L
        bias = abs(b.k_i) * b.gap / air
        spring = b.k_x + air * (bias / b.gap) ** 2
    return Physics(law, b.m, b.k_x, b.k_i, b.R, b.L - air, air, b.gap, bias, spring)


def tangent(p: Physics, i: float, x: float) -> dict[str, float]:
    """Return k_i, k_x and L of a magnet's law at a current and a position."""
    strength = p.air * p.gap
    if p.law == 2:
        return {"k_i": -strength * i / x**2, "k_x": -strength * i**2 / x**3, "L": p.leak + strength / x}
    if p.law == 0:
        return {}
    side, half = math.copysign(1.0, p.k_i), 0.5 * strength
    up, down, near, far = p.bias + i, p.bias - i, p.gap - side * x, p.gap + side * x
    return {
        "k_i": side * half * (up / near**2 + down / far**2),
        "k_x": p.spring - half * (up**2 / near**3 + down**2 / far**3),
        "L": p.leak + half * (1 / near + 1 / far),
    }


@dataclass(slots=True, kw_only=True)
class Setup:
    """One run as it will be simulated; an imperfection changes it."""

    bench: Bench
    seed: int
    rng: np.random.Generator  # of the imperfection
    physics: Physics
    r: Array  # V, excitation
    force: Array  # N, (n * substeps,)
    volts: Array  # V, (n * substeps,), of the amplifier's noise
    added: Array  # A and m, (n, 2): what sensors add
    rms: Array = field(default_factory=lambda: np.ones(3))  # V, A, m: of the sound run
    first: float = 0.0  # m, position at first from rest, so that the mean of an open loop is at rest
    step: float = 0.0  # A, of the current's converter
    limit: float = math.inf  # V
    late: int = 0  # samples
    after: Callable[[Array], Array] = lambda logged: logged
    every: int = 1
    said: float = 1.0  # rate, over the true one
    rig: Mapping[str, str] = field(default_factory=dict)  # lines beside the usual ones, by table
    factor: float = 1.0  # on the true R

    def alter(self, **numbers: float) -> None:
        self.physics = self.physics._replace(**numbers)  # type: ignore[arg-type]

    def push(self, force: Array) -> None:
        """Add a force, in parts of the magnet's rms."""
        self.force += force * abs(self.bench.k_i) * self.rms[1]

    def hum(self, current: Array) -> None:
        """Add to the current's sensor, in parts of its rms."""
        self.added[:, 0] += current * self.rms[1]

    def ramp(self) -> Array:
        return np.linspace(0.0, 1.0, self.force.size)

    def tone(self, hz: float, n: int) -> Array:
        """Return n samples of a line of unit rms, spread over the record."""
        phase = TURN * hz * self.bench.seconds / n * np.arange(n) + self.rng.uniform(0, TURN)
        return np.asarray(math.sqrt(2) * np.sin(phase))

    def slow(self, corner_hz: float) -> Array:
        """Return noise of unit rms, white below the corner and falling as 1/f above it."""
        pole = math.exp(-TURN * corner_hz * self.bench.seconds / self.force.size)
        w: Array = lfilter([1.0], [1.0, -pole], self.rng.standard_normal(self.force.size))
        return np.asarray((w - w.mean()) / w.std())

    def run(self) -> tuple[Array, Array]:
        b, p = self.bench, self.physics
        i, x = (b.bias, b.gap) if b.bias else (0.0, 0.0)
        flux = p.air * i + (p.law == 0) * p.k_i * self.first
        at, kept = x + self.first, flux if p.shunt > 0 or p.play > 0 else i
        start, rest = np.array([at, 0.0, i, kept, 0.0, 0.0, 0.0, at, i]), np.array([b.R * i, i, x])
        return _run(
            p, start, controller(b), rest, self.r, self.force, self.volts, self.added, self.step, self.limit,
            self.late, b.seconds / self.force.size,
        )  # fmt: skip


def setup(b: Bench, seed: int) -> Setup:
    """Return a sound run, its size measured."""
    index = list(BENCHES.values()).index(b)
    rng, n = np.random.default_rng([seed, index]), round(b.seconds * b.rate)
    white = math.sqrt(b.rate * b.substeps / 2)
    s = Setup(
        bench=b, seed=seed, rng=np.random.default_rng([seed, index, 1]), physics=magnet(b, 2 if b.bias else 0),
        r=b.volts * multisine(n, b.rate, b.band, rng),
        force=b.force * white * rng.standard_normal(n * b.substeps),
        volts=b.ripple * white * rng.standard_normal(n * b.substeps),
        added=rng.standard_normal((n, 2)) * b.noise,
    )  # fmt: skip
    true = s.run()[1]
    return replace(s, rms=true.std(0), first=0.0 if b.tight else -float(true[:, 2].mean()))


# --- imperfections that take more than a line -------------------------------------------------------------------------


def sound(s: Setup, size: float) -> None:
    """Nothing is wrong."""


def r_drift(s: Setup, size: float) -> None:
    s.alter(r_drift=size / s.bench.seconds)
    s.factor = 1 + size / 2


def curvature(s: Setup, size: float) -> None:
    """A magnet's law, moved by `size` gaps."""
    s.physics = magnet(s.bench, s.physics.law or 1)
    larger = size * s.bench.gap / (math.sqrt(2) * s.rms[2])
    s.r *= larger
    s.first *= larger


def flexible_mode(s: Setup, size: float) -> None:
    """A mode at three times the fastest rate of the loop, at magnet and sensor alike."""
    A, B, K, _ = controller(s.bench)
    rates = np.log(np.linalg.eigvals(A - np.outer(B, K)).astype(complex)) * s.bench.rate
    s.alter(mode=3 * float(np.abs(rates).max()), share=size)


def hysteresis(s: Setup, size: float) -> None:
    """Elastic-plastic loops of current by flux whose mean slope is none, so that the linear numbers stay the truth."""
    p, (_, true) = s.physics, s.run()
    flux = true[:, 1] * p.gap / true[:, 2] if p.law == 2 else true[:, 1] + p.k_i * true[:, 2] / p.air  # as a current
    width, z = 0.5 * float(flux.std()), np.zeros(flux.size)
    for k, d in enumerate(np.diff(flux)):
        end = math.copysign(width, d)
        z[k + 1] = end + (z[k] - end) * math.exp(-abs(d) / width)
    s.alter(play=size, width=width, slope=float(np.cov(z, flux)[0, 1] / flux.var()))


def cross_talk(s: Setup, column: int, size: float) -> None:
    """The logged position takes up voltage, as it is before it steps, or current."""
    share, late = size * s.rms[2] / s.rms[column], 1 - column
    s.after = lambda logged: logged + np.outer(share * np.roll(logged[:, column], late), [0.0, 0.0, 1.0])


def spikes(s: Setup, size: float) -> None:
    """One sample of current and position in a thousand."""
    jumps = np.zeros((s.r.size, 3))
    at = s.rng.choice(s.r.size, s.r.size // 1000, replace=False)
    jumps[at, 1:] = size * s.rms[1:] * s.rng.choice([-1.0, 1.0], (at.size, 2))
    s.after = lambda logged: logged + jumps


def stuck(s: Setup, size: float) -> None:
    """The logged position stands still for a part of the record."""
    first = int(s.rng.integers(s.r.size // 4, s.r.size // 2))
    held = np.arange(s.r.size)
    held[first : first + round(size * s.r.size)] = first
    s.after = lambda logged: np.column_stack([logged[:, :2], logged[held, 2]])


def belonging(s: Setup, size: float) -> None:
    """The position is of another run."""
    other = setup(s.bench, s.seed + round(size)).run()[0][:, 2]
    s.after = lambda logged: np.column_stack([logged[:, :2], other])


def gain(s: Setup, size: float) -> None:
    """The voltage is logged too large, by what its calibration leaves open."""
    s.after, s.rig = lambda logged: logged * [1 + size, 1.0, 1.0], {"channels.voltage": f"gain_sd = {size}"}


def rate(s: Setup, size: float) -> None:
    """The rate is said too large, by what is known of it."""
    s.said, s.rig = 1 + size, {"record": f"rate_sd = {size}"}


class Imperfection(NamedTuple):
    """What is done, how much, and the names under which its cause is right (none: nothing can be seen)."""

    apply: Callable[[Setup, float], object]
    size: float
    causes: tuple[str, ...] = ()


_LINE = ("line", "lines")
IMPERFECTIONS = {
    "sound": Imperfection(sound, 0.0),
    # as parts of the rms of the magnet's force, of the current, of the voltage
    "slow_force": Imperfection(lambda s, z: s.push(z * s.slow(s.bench.spin / 10)), 0.5, ("slow_force",)),
    "walking_force": Imperfection(lambda s, z: s.push(z * s.slow(1e-3)), 0.5, ("slow_force", "walking_force")),
    "force_ramp": Imperfection(lambda s, z: s.push(z * s.ramp()), 1.0, ("slow_force", "force_ramp")),
    "base_motion": Imperfection(lambda s, z: s.push(z * s.tone(13.0, s.force.size)), 0.5, (*_LINE, "base_motion")),
    "unbalance": Imperfection(lambda s, z: s.push(z * s.tone(s.bench.spin, s.force.size)), 0.5, (*_LINE, "unbalance")),
    "hum": Imperfection(lambda s, z: s.hum(z * s.tone(50.0, s.r.size)), 0.1, (*_LINE, "hum")),
    "pwm_alias": Imperfection(
        lambda s, z: s.hum(z * s.tone(0.9863 * s.bench.rate, s.r.size)), 0.1, (*_LINE, "pwm_alias")),
    "voltage_ramp": Imperfection(
        lambda s, z: s.volts.__iadd__(z * s.rms[0] * s.ramp()), 0.2, ("slow_voltage", "voltage_ramp")),
    "r_drift": Imperfection(r_drift, 0.05, ("r_drift",)),
    "curvature": Imperfection(curvature, 0.06, ("curvature",)),
    # poles and lags, by the rate
    "eddy_pole": Imperfection(lambda s, z: s.alter(eddy=TURN * z * s.bench.rate), 0.1, ("eddy_pole",)),
    "eddy_flux": Imperfection(
        lambda s, z: s.alter(shunt=TURN * z * s.bench.rate * s.physics.air), 0.1, ("eddy_pole",)),
    "sensor_pole": Imperfection(
        lambda s, z: s.alter(position_pole=TURN * z * s.bench.rate), 0.15, ("sensor_pole", "sensor_lag", "in_time")),
    "current_sensor_pole": Imperfection(
        lambda s, z: s.alter(current_pole=TURN * z * s.bench.rate),
        0.15, ("current_sensor_pole", "current_lag", "in_time")),
    "sensor_lag": Imperfection(lambda s, z: setattr(s, "late", round(z)), 1.0, ("sensor_lag", "in_time")),
    "limiter": Imperfection(lambda s, z: setattr(s, "limit", z * s.rms[0]), 2.0, ("limiter", "within_limits")),
    "flexible_mode": Imperfection(flexible_mode, 0.2, ("flexible_mode",)),
    "quantisation": Imperfection(lambda s, z: setattr(s, "step", z * s.rms[1]), 0.5, ("quantisation",)),
    "voltage_cross_talk": Imperfection(lambda s, z: cross_talk(s, 0, z), 0.03, ("cross_talk",)),
    "current_cross_talk": Imperfection(lambda s, z: cross_talk(s, 1, z), 0.03, ("cross_talk",)),
    "hysteresis": Imperfection(hysteresis, 0.1, ("hysteresis",)),
    "spikes": Imperfection(spikes, 3.0, ("spikes", "outliers", "signals_sound")),
    "stuck": Imperfection(stuck, 0.05, ("stuck", "signals_sound")),
    "gain_1pct": Imperfection(gain, 0.01),
    "rate_1pct": Imperfection(rate, 0.01),
    "belonging": Imperfection(belonging, 1000.0, ("belonging",)),
    "sampling": Imperfection(lambda s, z: setattr(s, "every", round(z)), 20.0, ("sampling",)),
}  # fmt: skip
IMPOSSIBLE = {("d", "eddy_pole")}  # an open loop whose force alone lags gains energy, and does not stay


def records(
    bench: str, imperfection: str, seed: int, size: float | None = None
) -> tuple[dict[str, Array], float, dict[str, float], str]:
    """Return columns, the rate as it is said, the true linear numbers, and the rig's text."""
    b, wrong = BENCHES[bench], IMPERFECTIONS[imperfection]
    s = setup(b, seed)
    wrong.apply(s, wrong.size if size is None else size)
    logged, true = s.run()
    if not np.abs(true[:, 2] - (b.gap if b.bias else 0.0)).max() < 0.9 * b.gap:
        raise RuntimeError(f"bench {bench} with {imperfection}, seed {seed}: the rotor touches")
    _, i, x = true.mean(0)
    truth = {name: float(getattr(b, name)) for name in PHYSICAL} | tangent(s.physics, i, x) | {"R": b.R * s.factor}
    logged = s.after(logged)[:: s.every]
    columns = dict(zip(("voltage", "current", "position"), np.ascontiguousarray(logged.T), strict=True))
    return columns, b.rate * s.said / s.every, truth, rig_text(bench, b, s.rig)


def rig_text(name: str, b: Bench, more: Mapping[str, str]) -> str:
    """Return a rig that knows nothing but the ball's mass, with the lines of `more` in their tables."""
    text = ['schema = "ambid.rig/1"', f'name = "imperfect {name}"', 'model = "one-axis"']
    for channel in ("voltage", "current", "position"):
        text += [f"[channels.{channel}]", f'column = "{channel}"', more.get(f"channels.{channel}", "")]
    text += ["[record]", more["record"]] if "record" in more else []
    mass = f', role = "fixed", value = {b.m!r}' if b.bias else ""
    text += ["[parameters]", f'm = {{ unit = "kg"{mass} }}', 'c = { unit = "N s/m", role = "fixed", value = 0.0 }']
    text += [f'{n} = {{ unit = "{u}" }}' for n, u in (("k_x", "N/m"), ("k_i", "N/A"), ("R", "ohm"), ("L", "H"))]
    return "\n".join(text) + "\n"


# --- the judge --------------------------------------------------------------------------------------------------------

_GENERAL = {
    "residuals_white", "residuals_uncorrelated", "uncertainty_consistent", "estimates_agree", "identifiable",
    "plausible", "long_enough", "converged", "status", "delay_shown", "innovations_consistent", "refused",
    "fixed_agree",
}  # fmt: skip
"""Checks that name no cause."""
_WORDS = {"lags behind": "in_time", "eddy currents": "eddy_pole", "is unrelated": "belonging", "too slow": "sampling"}
"""What a refusal's words name."""


def judged(bench: str, imperfection: str, seed: int, folder: Path) -> dict[str, Any]:
    """Return one row: what ambid says of a record, and how far that is from the truth."""
    import ambid

    columns, rate_hz, truth, text = records(bench, imperfection, seed)
    rig, units = folder / "rig.toml", {"voltage": "V", "current": "A", "position": "m"}
    rig.write_text(text)
    row: dict[str, Any] = {"bench": bench, "imperfection": imperfection, "seed": seed, "extended": [], "parameters": {}}
    began = time.perf_counter()
    try:
        found = ambid.identify(columns, rig, rate_hz=rate_hz, units=units)
    except ambid.AmbidError as refusal:
        reasons = [{"check": "refused", "text": str(refusal)}]
        return row | {"verdict": "refused", "reasons": reasons, "seconds": time.perf_counter() - began}
    row["seconds"] = time.perf_counter() - began
    for name in PHYSICAL:
        p = found[name]
        sd, ci = getattr(p, "sd_calibrated", None) or p.sd, getattr(p, "ci95_calibrated", None) or p.ci95
        if p.role != "fixed" and sd:
            row["parameters"][name] = {
                "value": p.value, "truth": truth[name], "sd": sd, "z": (p.value - truth[name]) / sd,
                "identifiable": bool(p.identifiable), "covered": bool(ci and ci[0] <= truth[name] <= ci[1]),
            }  # fmt: skip
    row["extended"] = [e.split(" (")[0] for e in found.extended]
    told = ("check", "cause", "alternatives", "grave")
    reasons = [{key: value for key in told if (value := getattr(r, key, None))} for r in found.verdict.reasons]
    return row | {"verdict": found.verdict.word, "reasons": reasons}


def named(row: Mapping[str, Any], first: bool = False) -> str:
    """Say whether the strongest cause is the true one: right, wrong (alone), general (none is named), or silent.

    It is that of the first reason which names one; with `first`, of the first reason alone.
    """
    true, reasons = IMPERFECTIONS[row["imperfection"]].causes, row["reasons"]
    if not reasons and not row["extended"]:
        return "silent"
    reasons = reasons or [{"check": "extended", "alternatives": row["extended"]}]
    for reason in reasons[:1] if first else reasons:
        words = [name for word, name in _WORDS.items() if word in reason.get("text", "")]
        said = [reason["check"], reason.get("cause"), *map(str, reason.get("alternatives", ())), *words]
        if any(t in said for t in true):
            return "right"
        if words or "cause" in reason or reason["check"] not in _GENERAL:
            return "wrong"
    return "general"


def worst(row: Mapping[str, Any]) -> tuple[float, str]:
    """Return the largest |z| of the numbers that are called identified, and whose."""
    return max(((abs(p["z"]), n) for n, p in row["parameters"].items() if p["identifiable"]), default=(0.0, "-"))


def told(row: Mapping[str, Any]) -> str:
    """Return a row as text."""
    z, name = worst(row)
    said = [r["check"] + (f"={r['cause']}" if "cause" in r else "") for r in row["reasons"]]
    head = f"{row['bench']} {row['imperfection']:20} {row['seed']:3d} {row['verdict']:9} {named(row):8}"
    return f"{head} {z:8.1f} {name:4} {row['seconds']:6.2f}  {', '.join([*said, *(f'+{e}' for e in row['extended'])])}"


def summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    """Return the shares that matter."""

    def share(some: Sequence[bool]) -> float | None:
        return round(sum(some) / len(some), 4) if some else None

    wrong = [r for r in rows if IMPERFECTIONS[r["imperfection"]].causes]
    stated = [p for r in rows for p in r["parameters"].values() if p["identifiable"]]
    healthy = [r for r in rows if r["imperfection"] == "sound"]
    all_of = {name: [r["parameters"][name]["covered"] for r in healthy if name in r["parameters"]] for name in PHYSICAL}
    return {
        "cases": len(rows),
        "usable beyond 4 sd": sum(r["verdict"] == "usable" and worst(r)[0] > 4 for r in rows),
        "stated intervals within 4 sd": share([abs(p["z"]) <= 4 for p in stated]),
        "cause right": share([named(r) == "right" for r in wrong]),
        "cause right, of those that say or do harm": share(
            [named(r) == "right" for r in wrong if named(r) != "silent" or worst(r)[0] > 4]
        ),
        "cause right, as the first reason": share([named(r, first=True) == "right" for r in wrong]),
        "cause wrong alone": share([named(r) == "wrong" for r in wrong]),
        "no cause named": share([named(r) == "general" for r in wrong]),
        "silent": share([named(r) == "silent" for r in wrong]),
        "sound usable": share([r["verdict"] == "usable" for r in healthy]),
        **{f"sound coverage of {name}": share(covered) for name, covered in all_of.items()},
    }


def main() -> None:
    """Judge what is asked for: a row each, and the summary."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bench", default=",".join(BENCHES))
    parser.add_argument("--only", default=",".join(IMPERFECTIONS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    asked, rows = parser.parse_args(), list[dict[str, Any]]()
    print("bench, imperfection, seed, verdict, cause, worst |z|, of, seconds, checks")
    with tempfile.TemporaryDirectory() as folder:
        for imperfection in asked.only.split(","):
            for bench in (name for name in asked.bench.split(",") if (name, imperfection) not in IMPOSSIBLE):
                for seed in range(1, asked.seeds + 1):
                    rows.append(judged(bench, imperfection, seed, Path(folder)))
                    print(told(rows[-1]), flush=True)
    shares = summary(rows)
    print("\n".join(f"{name:42} {value}" for name, value in shares.items()))
    if asked.json:
        asked.json.write_text(json.dumps({"summary": shares, "rows": rows}, indent=1, default=float))


if __name__ == "__main__":
    main()
