"""Signals of the causes that score tests look for: what each, of size one, adds to a force, a voltage or a sensor, and
what is said of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.estimation.kernels import play
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
    channels: tuple[str, ...]  # that the model has


Groups = Iterator[tuple[str, tuple[Column, ...]]]


def groups_of(s: Course, mode: float, *, thorough: bool) -> Groups:
    """Yield the causes with their signals in channels of the model; a size is that of the first. `mode`: its frequency,
    Hz.
    """
    for name, columns in _groups_of(s, mode, thorough=thorough):
        shown = (tuple(part for part in column if part[0] in s.channels and np.any(part[1])) for column in columns)
        if kept := tuple(filter(None, shown)):
            yield name, kept


def _groups_of(s: Course, mode: float, *, thorough: bool) -> Groups:
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
        yield f"slow_{channel}", tuple(((channel, wave),) for wave in _half_waves(s.t))
    for degree in (3, 4):  # of the co-energy W: force dW/dx and flux dW/di bend evenly, or oddly
        yield "curvature", tuple(_curvature(s, degree))
    if not thorough:
        return
    yield "limiter", tuple((("voltage", -end),) for signal in (s.u, s.u - s.u_before) for end in _ends(signal))
    slack = play(s.i, _PLAY * float(np.ptp(s.i))) - s.i
    flux = -s.theta["L"] * _rate(slack, s.rate_hz)
    yield "hysteresis", ((("force", s.theta["k_i"] * _between(slack)),), (("voltage", flux),))
    for damping in _DAMPING:
        yield "flexible_mode", tuple((("position", q),) for q in _oscillation(s, mode, damping))


def _ends(signal: Array) -> tuple[Array, Array]:
    """Return by how much a signal is beyond its outer tenths, above and below."""
    low, high = np.quantile(signal, (1.0 - _REACH, _REACH))
    return np.maximum(signal - high, 0.0), np.minimum(signal - low, 0.0)


def _half_waves(t: Array) -> list[Array]:
    """Return t, t² and half waves over the record, 3 to `WAVES` of them, slow ones first: waves have no slope at the
    ends, so that those of a walk fall with their number's fourth power only beside the two others.
    """
    return [t, t * t, *(np.cos(0.5 * np.pi * k * (t + 1.0)) for k in range(3, WAVES + 1))]


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


def _oscillation(s: Course, f: float, damping: float) -> tuple[Array, Array]:
    """Return position and velocity, over the frequency, of an oscillator of frequency `f` that the magnet drives."""
    period, omega = 1.0 / s.rate_hz, 2.0 * np.pi * f
    wave = np.exp((-damping + 1j) * omega * period)
    state = run(np.array([[wave.real, -wave.imag, 0.0], [wave.imag, wave.real, 1.0]]), s.i[:, None], np.zeros(2))[:-1]
    return state[:, 0], state[:, 1]


def _between(signal: Array) -> Array:
    """The mean from each sample to the next, as a disturbance that is held acts."""
    return np.append(0.5 * (signal[1:] + signal[:-1]), signal[-1])


SAME_AS = {
    "sensor_lag": ("sensor_pole",), "current_sensor_pole": ("current_lag",), "coloured_force": ("line",),
    "coloured_voltage": ("line",), "coloured_position": ("line",), "coloured_current": ("line",),
    "amplifier_lag": ("limiter", "current_sensor_pole"),
    "cross_talk": ("sensor_lag", "current_lag"), "current_lag": ("current_sensor_pole",),
}  # fmt: skip
"""What the first order of a score does not distinguish."""
TEXT = {
    "eddy_pole": "force or flux lags behind the current by {size:.3g} s: eddy currents. Excite more slowly, or "
    "identify with the nonlinear magnet and its eddy pole",
    "input_delay": "the voltage acts {size:.3g} s later than said. Leave channels.voltage.delay open, or give it",
    "sensor_lag": "the position is logged {size:.3g} s late: a filter of its sensor. Log without it, or say the delay",
    "current_sensor_pole": "the current is logged {size:.3g} s late: a filter of its sensor. Log without it",
    "current_lag": "the current is logged {size:.3g} s later than the position: a converter that samples in turn, or a "
    "filter of its sensor. Sample both at one instant",
    "cross_talk": "the {channel} holds a part of voltage or current: cross-talk, or it is logged a sample after the "
    "voltage that answers it. Check cables, grounds, and that all channels are of one instant",
    "r_drift": "the resistance drifts by {size:.3g} ohm from the middle to the end of the record, or of the busiest "
    "100,000 samples of a longer one: the coil warms up. Record shorter, or after it is warm",
    "dead_time": "the coil gets {size:.3g} V less than logged, against the direction of its current: dead time or the "
    "drop of a diode. Compensate it, or log the coil's voltage",
    "friction": "a force of {size:.3g} N acts against the motion, whatever its speed: dry friction. Free the rotor",
    "coloured_force": "a force around {size:.4g} Hz changes in amplitude and phase: unbalance of changing speed, flow "
    "or motion of the base. Remove its source, or excite beside it",
    "coloured_voltage": "the voltage around {size:.4g} Hz changes in amplitude and phase. Check the amplifier's supply",
    "coloured_position": "the position's sensor has noise around {size:.4g} Hz that changes in amplitude and phase: "
    "light, or an aliased tone. Filter before sampling",
    "coloured_current": "the current's sensor has noise around {size:.4g} Hz that changes in amplitude and phase: an "
    "aliased tone of the amplifier. Filter before sampling, or lock the sampling to it",
    "slow_position": "the position's sensor drifts. Measure its zero before and after, or record shorter",
    "slow_force": "a force beyond the model walks or is coloured: load, friction or a drifting sensor. Record "
    "longer, or excite above it",
    "slow_current": "the current's sensor drifts. Measure its zero before and after, or record shorter",
    "amplifier_lag": "the coil's voltage follows the logged one late, as through a filter: an amplifier of small "
    "bandwidth. Log the coil's voltage, or excite more slowly",
    "fixed_value": "the fixed {channel} fits better {where} where it is: it is wrong, or a gain or the rate is. Check "
    "it, or free it",
    "rate": "the sampling rate is said {size:+.2%} too high. Check it, and fixed values",
    "sampling": "the voltage changes between samples, so that its log does not say what the coil got. Log every sample "
    "of the controller",
    "slow_voltage": "the voltage walks slowly or is coloured. Check the supply and the sensor's zero",
    "curvature": "force or flux bends over this motion or current. Excite less, or identify the nonlinear magnet",
    "law": "force or flux bends otherwise over this motion than the magnet's law says. Record over less of the gap, or "
    "give the law's missing part",
    "limiter": "the amplifier does not follow the logged voltage at its ends. Log the coil's voltage, or excite less",
    "hysteresis": "force or flux follows the current with a slack: hysteresis. Excite more, or demagnetise",
    "flexible_mode": "the position holds a further mode. Excite below it, or use model rotor",
    "line": "a line at {size:.4g} Hz stands in the {channel}: unbalance, motion of the base, hum or an aliased tone. "
    "Remove its source, or log what causes it",
}
