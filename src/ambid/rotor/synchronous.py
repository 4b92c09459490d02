"""Synchronous analysis: how a rotor turned in a record (angle from x to y), and the response x(t) = Re Σ_k a_k exp(j k
angle(t)), by least squares on the whole used record with every line of a periodic excitation: nothing leaks between.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError
from ambid.physics.rotor_model import RotorModel
from ambid.record import Record, Step
from ambid.rotor.spectra import Excitation, find_excitation

Source = Literal["angle", "tacho", "speed", "lines", "rig"]
DRIFT_LIMIT = 2e-3
"""Range of the speed in a record, over its mean, above which an estimate at one speed is doubtful."""
_HARMONICS = 5
_TOP = 0.45  # of the rate, up to which harmonics are looked for
_NEAR = 0.05  # of a speed that is roughly known, within which its line is searched
_STANDS_OUT = 60.0  # power of a line over the median of its surroundings from which it is the speed
_FORWARD = 4.0  # power of the forward whirl over the backward one, of a line that nobody announced
_STEPS = 6  # of Gauss-Newton on the phase
_BINS = 48  # lines of the whole record on either side that show the noise
_REGULAR = 0.5  # logarithm of the time between pulses over that before and after
_STEADY = 1.5  # the longest time between pulses over the shortest, up to which the speed is one
_SMOOTH = 0.15  # rad rms by which pulses may miss a smooth phase


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rotation:
    """How a rotor turned in a record."""

    angle: Array  # (n_samples,), rad, not wrapped
    speed: float  # mean, rad/s
    drift: float  # range of the speed over its mean, slowly varying part
    source: Source

    @property
    def marked(self) -> bool:
        """Whether angle zero is a mark on the rotor, so that phases of several records compare."""
        return self.source in ("angle", "tacho")


@dataclass(frozen=True, kw_only=True, eq=False)
class SynchronousResponse:
    """Amplitudes at harmonics of the speed, and what else is in the record. A harmonic less than half a line of the
    whole record away from one of the excitation cannot be told from it: the line is left to the harmonic and `together`
    says so.
    """

    roles: tuple[str, ...]
    rotation: Rotation  # of the whole record
    orders: tuple[int, ...]
    amplitude: Complex  # (n_orders, n_roles)
    together: tuple[bool, ...]  # by order, whether an excited line falls on the harmonic
    inflation: Array  # (n_orders,), of the variance, by what lies close
    left: Array  # (n_samples, n_roles), used samples without synchronous part
    periods: int  # of the excitation in the used samples; 1: there is none
    rate_hz: float

    @property
    def speed(self) -> float:
        """Mean speed, rad/s."""
        return self.rotation.speed

    def bins(self, order: int) -> NDArray[np.intp]:
        """Return the lines of the whole used record around a harmonic that hold noise alone."""
        n = self.left.shape[0]
        at = order * abs(self.speed) * n / (2.0 * np.pi * self.rate_hz)
        lines = np.arange(max(1, round(at) - _BINS), min((n - 1) // 2, round(at) + _BINS) + 1)
        keep = np.abs(lines - at) >= 1.0
        return np.asarray(lines[keep & (lines % self.periods != 0)] if self.periods > 1 else lines[keep])

    @cached_property
    def _spectra(self) -> Complex:
        return np.asarray(2.0 / self.left.shape[0] * np.fft.rfft(self.left, axis=0))

    def noise(self, order: int = 1) -> tuple[Array, Complex]:
        """Return frequencies in Hz and amplitudes (n_bins, n_roles) of the noise around a harmonic."""
        bins = self.bins(order)
        return np.asarray(bins * (self.rate_hz / self.left.shape[0])), np.asarray(self._spectra[bins])

    def sd(self, order: int = 1) -> Array:
        """Return the standard deviation of real and imaginary part of an amplitude, (n_roles,)."""
        _, noise = self.noise(order)
        power = np.mean(np.abs(noise) ** 2, axis=0) * self.inflation[self.orders.index(order)]
        return np.asarray(np.sqrt(0.5 * power))

    def of(self, role: str, order: int = 1) -> complex:
        """Return the amplitude of a role at a harmonic."""
        return complex(self.amplitude[self.orders.index(order), self.roles.index(role)])


# --- speed ----------------------------------------------------------------------------------------------------------


def rotation_of(record: Record, model: RotorModel, excitation: Excitation | None = None) -> Rotation | None:
    """Return how the rotor turned in a record, None where it stood still: its angle if logged, pulses once a
    revolution, else the line near the logged or given speed, or anywhere if the model has a polar moment of inertia.
    """
    n, rate = record.n_samples, record.rate_hz
    if (logged := logged_angle(record)) is not None:
        angle, source = logged
        if source == "speed" and not abs(angle[-1]) > 2.0 * np.pi:
            return None
        near = _by_lines(record, model, excitation, angle, _NEAR) if source == "speed" else None
        return near or _checked(angle, rate, source)
    if model.speed:
        first = np.linspace(0.0, model.speed * (n - 1) / rate, n)
        return _by_lines(record, model, excitation, first, _NEAR) or _checked(first, rate, "rig")
    if model.polar and {0, 1} <= set(model.planes):
        return _by_lines(record, model, excitation, np.zeros(n), None)
    return None


def logged_angle(record: Record) -> tuple[Array, Source] | None:
    """Return the angle of a rotor in rad, not wrapped, by its own channel, pulses once a revolution, or the integral of
    its speed, and which; None without.
    """
    if "angle" in record:
        return np.unwrap(record["angle"].values), "angle"
    if "tacho" in record:
        return angle_of_pulses(record["tacho"].values, record.rate_hz), "tacho"
    if "speed" not in record:
        return None
    w = record["speed"].values
    return np.concatenate([[0.0], np.cumsum(0.5 * (w[1:] + w[:-1]))]) / record.rate_hz, "speed"


def _checked(angle: NDArray[np.floating[Any]], rate: float, source: Source) -> Rotation | None:
    """Return the rotation of an angle; None where less than a turn is in it."""
    turned = float(angle[-1] - angle[0])
    if abs(turned) < 2.0 * np.pi:
        return None
    speed = turned * rate / (angle.size - 1)
    t = np.linspace(-1.0, 1.0, angle.size)
    thin = slice(None, None, max(1, angle.size // 2000))
    slope = np.polyder(np.polyfit(t[thin], angle[thin], 3))  # the slow part: single samples are quantised
    local = np.polyval(slope, np.linspace(-1.0, 1.0, 33))
    return Rotation(
        angle=np.asarray(angle, dtype=np.float64),
        speed=speed,
        drift=float(np.ptp(local) / abs(np.mean(local))),
        source=source,
    )


def angle_of_pulses(x: Array, rate: float) -> Array:
    """Return the angle from pulses once a revolution: zero at every rising edge, smooth between them."""
    low, high = (float(q) for q in np.quantile(x, [0.001, 0.999]))
    if not np.ptp(x) > 0.0:
        raise EstimationError("channel 'tacho' is constant; it holds a pulse in every revolution. Check its column")
    low, high = (float(x.min()), float(x.max())) if high - low < 0.5 * np.ptp(x) else (low, high)
    middle, room = 0.5 * (low + high), 0.1 * (high - low)
    state = np.where(x > middle + room, 1, np.where(x < middle - room, -1, 0))
    known = np.flatnonzero(state)
    up = np.flatnonzero(np.diff(state[known]) > 0) + 1
    edges = []
    for k in up:  # between the last sample that is low and the first that is high, where the middle is crossed
        a, b = known[k - 1], known[k]
        edges.append(float(np.interp(middle, x[a : b + 1], np.arange(a, b + 1))) if b > a + 1 or room else float(b))
    if len(edges) < 3:
        raise EstimationError(
            f"channel 'tacho' has {len(edges)} pulses; a speed needs 3, one in every revolution. Check its column, or "
            "give the speed in the rig"
        )
    at, turns = np.array(edges), 2.0 * np.pi * np.arange(len(edges))
    gaps = np.diff(at)
    around = np.sqrt(gaps[:-2] * gaps[2:]) if gaps.size > 2 else gaps[:1]  # the speed may change
    if np.any(np.abs(np.log(gaps[1:-1] / around)) > _REGULAR) or (gaps.size < 3 and np.ptp(gaps) > 0.5 * gaps.max()):
        raise EstimationError(
            f"pulses of channel 'tacho' are {gaps.min() / rate:.4g} s to {gaps.max() / rate:.4g} s apart, as if some "
            "were missing or double. Give one clean pulse in every revolution"
        )
    place = np.arange(x.size, dtype=np.float64)
    before, after = np.minimum(place - at[0], 0.0) / gaps[0], np.maximum(place - at[-1], 0.0) / gaps[-1]
    beyond = 2.0 * np.pi * (before + after)
    if gaps.max() > _STEADY * gaps.min():  # a run-up or a coast-down
        from scipy.interpolate import PchipInterpolator

        return np.asarray(PchipInterpolator(at, turns)(np.clip(place, at[0], at[-1])) + beyond)
    half = 0.5 * (x.size - 1)
    smooth = np.polynomial.Polynomial.fit(at / half - 1.0, turns, min(3, len(edges) - 2), domain=[-1.0, 1.0])
    missed = turns - smooth(at / half - 1.0)
    if np.sqrt(np.mean(missed**2)) < _SMOOTH:
        return np.asarray(smooth(place / half - 1.0))
    return np.asarray(np.interp(place, at, turns) + beyond)


def _by_lines(
    record: Record, model: RotorModel, excitation: Excitation | None, first: Array, near: float | None
) -> Rotation | None:
    """Return the rotation that a synchronous line of the positions shows beside a first angle, None without a line.

    Coarsely by spectra, then by Gauss-Newton on frequency and its drift: with a exp(j angle) also b t exp(j angle) and
    c t² exp(j angle) are fitted; b/a and c/a are the phase that the angle lacks.
    """
    rate, lines_used, periods = record.rate_hz, _used(record, excitation), 1 if excitation is None else excitation.count
    y = np.column_stack([record[r].values[lines_used] for r in model.outputs if "_position" in r])
    y = y - y.mean(axis=0)
    start = _line_beside(y, model, first[lines_used], rate, periods, near)
    if start is None:
        return None
    t = np.linspace(-1.0, 1.0, y.shape[0])
    begun = first[lines_used] + (start * y.shape[0] / (2.0 * rate)) * t
    ramps = np.arange(-1.5, 1.51, 0.25) * np.pi  # lines of the whole record
    powers = [_power(y, begun + ramp * t, periods) for ramp in ramps]
    ramp, bend = float(ramps[int(np.argmax(powers))]), 0.0
    for _ in range(_STEPS):
        angle = begun + ramp * t + bend * t**2
        turn = np.exp(1j * angle)
        a = _amplitudes(y, [turn, t * turn, t**2 * turn], _coincident(angle, (1,), periods), periods)[0]
        power = float(np.sum(np.abs(a[0]) ** 2))
        b, c = (float(np.sum(np.imag(np.conj(a[0]) * x)) / power) for x in a[1:])
        share = min(1.0, 1.0 / max(abs(b), abs(c), 1e-300))
        ramp, bend = ramp + share * b, bend + share * c
        if max(abs(b), abs(c)) < 1e-6:
            break
    late = 2.0 * (np.arange(record.n_samples) - lines_used.start) / (y.shape[0] - 1) - 1.0
    slope = start * y.shape[0] / (2.0 * rate) + ramp
    return _checked(first + slope * (late + 1.0) + bend * late**2, rate, "lines")


def _line_beside(
    y: Array, model: RotorModel, first: Array, rate: float, periods: int, near: float | None
) -> float | None:
    """Return the speed, less a first angle's, of the line that stands out, rad/s; None without. Off the excitation's
    lines what differs between periods shows it, on them the one larger than the others.
    """
    n = y.shape[0]
    hint = float(first[-1] - first[0]) * rate / (n - 1)
    varied = y * np.exp(-1j * (first - hint * np.arange(n) / rate))[:, None] if near and np.ptp(first) else y
    F = np.fft.fft(varied, axis=0)[: n // 2]
    power = np.sum(np.abs(F) ** 2 / np.median(np.abs(F), axis=0) ** 2, axis=1)
    spacing = 2.0 * np.pi * rate / n
    low, high = (
        (4.0, _TOP * n) if near is None else (abs(hint) * (1 - near) / spacing, abs(hint) * (1 + near) / spacing)
    )
    lines = np.arange(max(2, int(low)), min(int(high) + 2, n // 2))
    on = (lines % periods == 0) & (periods > 1)
    for kind in (~on, on):
        these = lines[kind]
        if these.size < 8:
            continue
        around = np.array([np.median(power[these[max(0, k - 40) : k + 41]]) for k in range(these.size)])
        ratio = power[these] / around
        k = int(np.argmax(ratio))
        if ratio[k] > _STANDS_OUT and (near is not None or _forward(F[these[k]], model)):
            return float(these[k] * spacing * (np.sign(hint) or 1.0) - hint)
    return None


def _forward(a: Complex, model: RotorModel) -> bool:
    """Whether the positions whirl forward: x(t) = cos, y(t) = sin."""
    plane = np.array([model.placed[j][1] for j, _ in model.sensors])
    x, y = a[plane == 0], a[plane == 1]
    if x.size != y.size:
        return False
    return bool(np.sum(np.abs(x + 1j * y) ** 2) > _FORWARD * np.sum(np.abs(x - 1j * y) ** 2))


def _power(y: Array, angle: Array, periods: int) -> float:
    """Return the power that one synchronous component explains, summed over channels in units of their own."""
    a, own, _ = _amplitudes(y, [np.exp(1j * angle)], _coincident(angle, (1,), periods), periods)
    return float(np.sum(np.abs(a[0]) ** 2 / np.var(y, axis=0))) * float(own[0])


# --- least squares --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class Separated:
    """A record with its synchronous part apart."""

    record: Record  # without it
    excitation: Excitation | None
    response: SynchronousResponse | None  # None: the rotor stands still

    @property
    def speed(self) -> float:
        """Mean speed, rad/s."""
        return 0.0 if self.response is None else self.response.speed

    def warnings(self, name: str, speed: float) -> list[str]:
        """Return what is doubtful of the rotation; `speed`: speed that the rig says, rad/s."""
        if self.response is None:
            return []
        turned, warnings = self.response.rotation, []
        if turned.drift > DRIFT_LIMIT:
            warnings.append(
                f"{name}: the speed changes by {turned.drift:.2%}, more than {DRIFT_LIMIT:.1%}; numbers at one speed "
                "are doubtful. Hold the speed, or use a shorter part"
            )
        if turned.source == "rig":
            warnings.append(f"{name}: no synchronous line near the given speed, which is taken as it is")
        elif speed and abs(self.speed / speed - 1.0) > 10.0 * DRIFT_LIMIT:
            warnings.append(
                f"{name}: the speed is {30 / np.pi * self.speed:.5g} rpm, by its {turned.source}, not "
                f"{30 / np.pi * speed:.5g} rpm as given"
            )
        return warnings


def separate(record: Record, model: RotorModel, speed: float | None = None) -> Separated:
    """Find how the rotor turned in a record, roughly at a speed (rad/s; 0: at rest) if known, and take the synchronous
    part out of all its channels.
    """
    excitation = find_excitation(record, model)
    turning = model if speed is None else replace(model, speed=speed)
    rotation = None if speed == 0.0 else rotation_of(record, turning, excitation)
    if rotation is None:
        return Separated(record=record, excitation=excitation, response=None)
    references = [f"{axis}_reference" for axis in model.axes if f"{axis}_reference" in record]
    roles = (*model.inputs, *model.outputs, *references)
    response = synchronous_response(record, roles, rotation, excitation)
    clean = without_synchronous(record, response)
    again = find_excitation(clean, model)  # off the lines of a period, a synchronous part looks like a transient
    if again != excitation:
        response = synchronous_response(record, roles, rotation, again)
        clean = without_synchronous(record, response)
    return Separated(record=clean, excitation=again, response=response)


def synchronous_response(
    record: Record, roles: Sequence[str], rotation: Rotation, excitation: Excitation | None = None
) -> SynchronousResponse:
    """Return the response of some channels at harmonics of the speed, with what remains of them."""
    rate, segment = record.rate_hz, _used(record, excitation)
    y = np.column_stack([record[role].values[segment] for role in roles])
    periods, angle = 1 if excitation is None else excitation.count, rotation.angle[segment]
    highest = max(1, min(_HARMONICS, int(_TOP * rate * 2.0 * np.pi / abs(rotation.speed))))
    orders = tuple(range(1, highest + 1))
    lines = _coincident(angle, orders, periods)
    waves = list(itertools.accumulate([np.exp(1j * angle)] * highest, np.multiply))  # of 1, 2, ... a turn
    a, own, left = _amplitudes(y - y.mean(axis=0), waves, lines, periods)
    return SynchronousResponse(
        roles=tuple(roles), rotation=rotation, orders=orders, amplitude=a,
        together=tuple(round(k * _turns(angle) / periods) in lines for k in orders),
        inflation=1.0 / np.maximum(own, 1e-12), left=left, periods=periods, rate_hz=rate,
    )  # fmt: skip


def without_synchronous(record: Record, response: SynchronousResponse) -> Record:
    """Return a record without its synchronous part; its history says so."""
    parts = np.real(np.exp(1j * np.outer(response.rotation.angle, response.orders)) @ response.amplitude)
    at = {role: k for k, role in enumerate(response.roles)}
    channels = tuple(replace(c, values=c.values - parts[:, at[c.name]]) if c.name in at else c for c in record.channels)
    step = Step(name="without_synchronous", settings={"speed": response.speed, "orders": list(response.orders)})
    return replace(record, channels=channels, history=(*record.history, step))


def _used(record: Record, excitation: Excitation | None) -> slice:
    """Return the samples that are used: whole periods."""
    if excitation is None:
        return slice(0, record.n_samples)
    return slice(excitation.first, excitation.first + excitation.count * excitation.period)


def _turns(angle: Array) -> float:
    """Return the turns in as many samples as there are: the number of the synchronous line of the whole record."""
    return abs(float(angle[-1] - angle[0])) / (angle.size - 1) * angle.size / (2.0 * np.pi)


def _coincident(angle: Array, orders: Sequence[int], periods: int) -> NDArray[np.intp]:
    """Return the lines of one period on which harmonics fall, within half a line of the whole record."""
    if periods < 2:
        return np.zeros(0, dtype=np.intp)
    at = np.array([k * _turns(angle) for k in orders])
    line = np.round(at / periods)
    return np.asarray(line[np.abs(at - line * periods) < 0.5], dtype=np.intp)


def _amplitudes(
    y: Array, waves: Sequence[Complex], samples: NDArray[np.intp], periods: int
) -> tuple[Complex, Array, Array]:
    """Fit Re Σ a_k wave_k in least squares beside all periodic signals but the `samples` lines; return amplitudes
    (n_waves, n_channels), of each wave the share of its power that is its own, what is left.
    """
    n = y.shape[0]
    columns = np.column_stack([part for w in waves for part in (w.real, -w.imag)])
    own, target = (aperiodic(x, samples, periods) for x in (columns, y))
    size = np.linalg.norm(own, axis=0) + 1e-300
    solved, *_ = np.linalg.lstsq(own / size, target, rcond=1e-9)
    solved = solved / size[:, None]
    gram = np.linalg.pinv(own.T @ own / (0.5 * n))
    share = 2.0 / np.maximum(np.diag(gram)[0::2] + np.diag(gram)[1::2], 1e-300)
    return solved[0::2] + 1j * solved[1::2], share, y - columns @ solved


def aperiodic(x: Array, samples: NDArray[np.intp], periods: int) -> Array:
    """Return signals (n, n_channels) without the mean over their periods, `samples` lines of which stay."""
    if periods < 2:
        return x
    parts = x.reshape(periods, -1, x.shape[1])
    mean = np.fft.rfft(parts.mean(axis=0), axis=0)
    mean[samples[samples < mean.shape[0]]] = 0.0
    return np.asarray((parts - np.fft.irfft(mean, parts.shape[1], axis=0)).reshape(x.shape))
