"""Signals of the causes that score tests look for: what each, of size one, adds to a force, a voltage or a sensor."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.estimation.likelihood import run

WAVES = 8  # half waves over the record of a force or voltage that walks
_DAMPING = (0.005, 0.03)  # with which it is looked for
_REACH = 0.9  # quantile of a voltage beyond which an amplifier may limit
_PLAY = 0.1  # of the current's range: width of a hysteresis

Column = tuple[tuple[str, Array], ...]
"""Where signals of one size enter, force, voltage, position or current, and their courses, SI: at each sample, of a
force or a voltage the mean up to the next. None may hold more than what is known before the sample that it shows in.
"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Course:
    """Signals over the samples that are looked at, deviations from the operating point in SI."""

    t: Array  # from -1 to 1
    x: Array
    v: Array
    i: Array
    u: Array
    before: Array  # rate of the current before each sample, A/s
    u_before: Array  # voltage before each sample: that after it may be fed back from the sample itself
    theta: Mapping[str, float]
    i0: float
    rate_hz: float


def groups_of(s: Course, mode: float, *, thorough: bool) -> Iterator[tuple[str, tuple[Column, ...]]]:
    """Yield the causes with their signals; a size is that of the first. `mode`: its frequency, Hz."""
    eddy = _rate(s.before, s.rate_hz)  # of the flux, where it shunts the coil; of the force alone
    yield "eddy_pole", ((("force", -s.theta["k_i"] * _rate(s.i, s.rate_hz)),), (("voltage", s.theta["L"] * eddy),))
    yield "sensor_lag", ((("position", -s.v),),)
    yield "current_sensor_pole", ((("current", -s.before),),)
    yield "cross_talk", ((("position", s.i),), (("position", s.u_before),))
    yield "cross_talk", ((("current", s.x),), (("current", s.u_before),))
    yield "r_drift", ((("voltage", _between(-s.t * (s.i0 + s.i))),),)
    yield "dead_time", ((("voltage", -_between(np.sign(s.i0 + s.i))),),)
    yield "friction", ((("force", -_between(np.sign(s.v))),),)
    step = np.append(0.0, s.u_before - s.u)
    yield "amplifier_lag", tuple((("voltage", np.append(np.zeros(k), step[1:-k])),) for k in (1, 2))
    for channel in ("force", "voltage", "current"):
        yield f"slow_{channel}", tuple(((channel, wave),) for wave in half_waves(s.t, WAVES))
    for degree in (3, 4):  # of the co-energy W: force dW/dx and flux dW/di bend evenly, or oddly
        yield "curvature", tuple(_curvature(s, degree))
    if not thorough:
        return
    yield "limiter", tuple((("voltage", -end),) for signal in (s.u, s.u - s.u_before) for end in _ends(signal))
    slack = _play(s.i, _PLAY * float(np.ptp(s.i))) - s.i
    flux = -s.theta["L"] * _rate(slack, s.rate_hz)
    yield "hysteresis", ((("force", s.theta["k_i"] * _between(slack)),), (("voltage", flux),))
    for damping in _DAMPING:
        yield "flexible_mode", tuple((("position", q),) for q in _oscillation(s, mode, damping))


def _ends(signal: Array) -> tuple[Array, Array]:
    """Return by how much a signal is beyond its outer tenths, above and below."""
    low, high = np.quantile(signal, (1.0 - _REACH, _REACH))
    return np.maximum(signal - high, 0.0), np.minimum(signal - low, 0.0)


def half_waves(t: Array, count: int) -> list[Array]:
    """Return t, t² and half waves over the record, 3 to `count` of them, slow ones first: waves have no slope at the
    ends, so that those of a walk fall with their number's fourth power only beside the two others.
    """
    return [t, t * t, *(np.cos(0.5 * np.pi * k * (t + 1.0)) for k in range(3, count + 1))]


def _curvature(s: Course, degree: int) -> Iterator[Column]:
    """Yield force and voltage of the terms x^a i^b of the co-energy, a + b = degree, over the sizes of the motion."""
    size_x, size_i = max(float(s.x.std()), 1e-300), max(float(s.i.std()), 1e-300)
    x, i = [np.ones_like(s.x)], [np.ones_like(s.i)]
    for _ in range(degree):
        x.append(x[-1] * (s.x / size_x))
        i.append(i[-1] * (s.i / size_i))
    for a in range(degree + 1):
        b = degree - a
        force, flux = a / size_x * x[max(a - 1, 0)] * i[b], b / size_i * x[a] * i[max(b - 1, 0)]
        yield ("force", _between(force)), ("voltage", -_rate(flux, s.rate_hz))


def _rate(signal: Array, rate_hz: float) -> Array:
    """The mean rate from each sample to the next."""
    return np.append(np.diff(signal), 0.0) * rate_hz


def _play(x: Array, width: float) -> Array:
    """Return what follows x through a slack of a width."""
    out, at = np.empty_like(x), float(x[0])
    for k, value in enumerate(x.tolist()):
        at = min(max(at, value - 0.5 * width), value + 0.5 * width)
        out[k] = at
    return out


def _oscillation(s: Course, f: float, damping: float) -> tuple[Array, Array]:
    """Return position and velocity, over the frequency, of an oscillator of frequency `f` that the magnet drives."""
    period, omega = 1.0 / s.rate_hz, 2.0 * np.pi * f
    wave = np.exp((-damping + 1j) * omega * period)
    state = run(np.array([[wave.real, -wave.imag, 0.0], [wave.imag, wave.real, 1.0]]), s.i[:, None], np.zeros(2))[:-1]
    return state[:, 0], state[:, 1]


def _between(signal: Array) -> Array:
    """The mean from each sample to the next, as a disturbance that is held acts."""
    return np.append(0.5 * (signal[1:] + signal[:-1]), signal[-1])
