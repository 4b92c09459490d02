"""Margins of a position loop as predicted: poles, gain, phase, sensitivity; and a refusal. Opened at the controller's
output: L = 1/S - 1, S from an excitation to the command; ISO 14839-3 opens it at the position (`control/zones.py`).
Limits and quantisation are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import ModelError
from ambid.physics.loop import Interval, Loop
from ambid.settings.caller import setting
from ambid.simulation.plant import closed_loop_poles, excited_loop

Complex = NDArray[np.complex128]

_REACH = 20.0  # factor on the gains that is looked at, up and down
_GAINS = 81  # of them, even in the logarithm
_SLACK = 1e-9  # of a pole on the circle: an integrator that nothing holds
_REAL = 0.3  # imaginary over real part up to which L is on its way to the real axis
_STEEP = 0.5  # slope of ln |L| over ln f down to rest, from which L is behind an integrator
_SPAN = 1e-4  # of the rate: the lowest frequency
_FREQUENCIES = 400


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OpenLoop:
    """A stable closed loop opened at one signal, and its margins there."""

    frequency_hz: Array  # (n_frequencies,), up to half the rate
    open_loop: Complex  # (n_frequencies,), L, from the signal back to itself, for negative feedback

    @property
    def sensitivity(self) -> Array:
        """Modulus of S, shape (n_frequencies,)."""
        return np.asarray(1.0 / np.abs(1.0 + self.open_loop))

    @property
    def peak(self) -> tuple[float, float]:
        """Largest modulus of S (its inverse is the modulus margin), and its frequency in Hz."""
        k = int(np.argmax(self.sensitivity))
        return float(self.sensitivity[k]), float(self.frequency_hz[k])

    @property
    def phase_deg(self) -> float | None:
        """Smallest phase margin in degrees; None where the modulus of L never passes 1."""
        _, angle = self._crossovers()
        return float(np.degrees(np.min(np.abs(angle)))) if angle.size else None

    @property
    def delay_s(self) -> float | None:
        """Further delay in s that makes the loop unstable; None where the modulus of L never passes 1."""
        frequency, angle = self._crossovers()
        return float(np.min((angle % (2.0 * np.pi)) / (2.0 * np.pi * frequency))) if angle.size else None

    @property
    def gain_between(self) -> tuple[float | None, float | None]:
        """Factors on the gain nearest to 1, down and up, at which L passes -1; None: there is none."""
        first, last = (x.conj() if abs(x.imag) < _REAL * abs(x.real) else x for x in self.open_loop[[0, -1]])
        f, size = np.log(self.frequency_hz[:2]), np.log(np.abs(self.open_loop[:2]))
        if size[0] - size[1] > _STEEP * (f[1] - f[0]):
            first = self.open_loop[0]
        L = np.concatenate([[first], self.open_loop, [last]])  # real at rest, but behind an integrator, and at the end
        k = np.flatnonzero(np.diff(np.sign(L.imag)))
        share = L.imag[k] / (L.imag[k] - L.imag[k + 1])
        real = L.real[k] + share * (L.real[k + 1] - L.real[k])
        factors = -1.0 / real[real < 0.0]
        down, up = factors[factors < 1.0], factors[factors > 1.0]
        return (float(down.max()) if down.size else None, float(up.min()) if up.size else None)

    def _crossovers(self) -> tuple[Array, Array]:
        """Where the modulus of L is 1: frequencies, and angles of L from -1, in rad between -pi and pi."""
        size, angle = np.log(np.abs(self.open_loop)), np.unwrap(np.angle(self.open_loop))
        k = np.flatnonzero(np.diff(np.sign(size)))
        share = size[k] / (size[k] - size[k + 1])
        at = angle[k] + (angle[k + 1] - angle[k]) * share
        frequency = self.frequency_hz[k] * (self.frequency_hz[k + 1] / self.frequency_hz[k]) ** share
        return frequency, (at % (2.0 * np.pi)) - np.pi


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopMargins(OpenLoop):
    """What is predicted of a closed loop, opened at the controller's output."""

    poles: Complex  # (n_poles,), in the z plane, by falling modulus
    rate_hz: float
    # factors on all gains between which the loop is stable: around 1 where it is; else those nearest to it. None: there
    # are none within a factor of 20
    gain: Interval | None
    # of an unstable loop: the gains that hold it with the other sign, "kp, ki and kd" or "kc"
    reversed: str | None

    @property
    def largest_pole(self) -> float:
        """Largest modulus of the poles; the loop is unstable above 1."""
        return float(np.abs(self.poles[0]))

    @property
    def stable(self) -> bool:
        """Whether no pole lies outside the unit circle."""
        return self.largest_pole <= 1.0 + _SLACK

    def words(self) -> str:
        """Say how stable the loop is, on one line."""
        if not self.stable or self.gain is None:
            return f"unstable, largest pole {self.largest_pole:.5g}"
        low = f"less than {1 / _REACH:g}" if self.gain[0] <= 1 / _REACH else f"{self.gain[0]:.2g}"
        high = f"more than {_REACH:g}" if self.gain[1] >= _REACH else f"{self.gain[1]:.2g}"
        phase = "" if self.phase_deg is None else f", phase margin {self.phase_deg:.0f}°"
        peak, hz = self.peak
        return (
            f"largest pole {self.largest_pole:.4f}, stable for {low} to {high} times the gains{phase}, peak of the"
            f" sensitivity at the controller's output {20 * math.log10(peak):.1f} dB at {hz:.3g} Hz"
        )

    def refuse(self, where: str, *, remedy: str) -> None:
        """Raise `ModelError` for an unstable loop at `where` (plant, rate, delay): its largest pole, how far the gains
        are off, and the remedy, unless a sign is reversed.
        """
        if self.stable:
            return
        if self.reversed is not None:
            far = f"it is stable with the other sign of {self.reversed}"
            remedy = "Correct the sign of these gains, or that of k_i"
        elif self.gain is None:
            far = f"no factor of {1 / _REACH:g} to {_REACH:g} on its gains makes it stable"
        else:
            far = f"it is stable for {self.gain[0]:.2g} to {self.gain[1]:.2g} times its gains"
        raise ModelError(
            f"the loop is unstable on {where}: largest pole {self.largest_pole:.5g}; {far}. {remedy}, or go on with"
            f" {setting('force', True)}"
        )


def loop_margins(parameters: Mapping[str, float], loop: Loop, rate_hz: float, *, of: str = "one-axis") -> LoopMargins:
    """Predict poles and margins of controller and delay on the model called `of`, its parameters in SI."""

    def largest(tried: Loop) -> float:
        try:
            return float(np.abs(closed_loop_poles(parameters, tried, rate_hz, of=of)[0]))
        except ModelError:  # beyond all numbers
            return math.inf

    poles = closed_loop_poles(parameters, loop, rate_hz, of=of)
    stable = float(np.abs(poles[0])) <= 1.0 + _SLACK
    others = {"kp, ki and kd": loop.scaled(-1.0, 1.0), "kc": loop.scaled(1.0, -1.0)}
    own = np.abs(np.angle(poles)) * rate_hz / (2.0 * np.pi)  # a narrow peak of the sensitivity stands there
    own = own[(own > _SPAN * rate_hz) & (own < 0.5 * rate_hz)]
    frequency = np.union1d(np.geomspace(_SPAN * rate_hz, 0.5 * rate_hz, _FREQUENCIES), own)
    with np.errstate(all="ignore"):  # of a plant near the end of all numbers
        z, command, excited = excited_loop(parameters, loop, rate_hz, of=of)
        around = np.exp(2j * np.pi * frequency / rate_hz)[:, None, None] * np.eye(z.shape[0]) - z
        answer = np.linalg.solve(around, np.broadcast_to(excited[:, None], (frequency.size, z.shape[0], 1)))
        sensitivity = 1.0 + answer[:, :, 0] @ command
        open_loop = np.asarray(1.0 / sensitivity - 1.0, dtype=np.complex128)
    return LoopMargins(
        poles=poles,
        rate_hz=rate_hz,
        gain=_stable_gains(lambda g: largest(loop.scaled(g, g)), stable),
        reversed=None if stable else next((name for name, other in others.items() if largest(other) < 1.0), None),
        frequency_hz=frequency,
        open_loop=open_loop,
    )


def _stable_gains(largest: Callable[[float], float], stable: bool) -> Interval | None:
    """Return the factors on the gains between which the loop is stable, nearest to 1."""
    factors = np.geomspace(1.0 / _REACH, _REACH, _GAINS)
    holds = np.array([largest(float(g)) <= 1.0 + _SLACK for g in factors])
    middle = _GAINS // 2
    holds[middle] = stable
    if not holds.any():
        return None
    places = np.flatnonzero(holds)
    inside = int(places[np.argmin(np.abs(places - middle))])
    low = high = inside
    while low > 0 and holds[low - 1]:
        low -= 1
    while high < _GAINS - 1 and holds[high + 1]:
        high += 1
    first = factors[0] if low == 0 else _edge(largest, float(factors[low]), float(factors[low - 1]))
    last = factors[-1] if high == _GAINS - 1 else _edge(largest, float(factors[high]), float(factors[high + 1]))
    return float(first), float(last)


def _edge(largest: Callable[[float], float], stable: float, unstable: float) -> float:
    """Return the factor between a stable and an unstable one at which the loop becomes unstable."""
    for _ in range(10):
        middle = math.sqrt(stable * unstable)
        stable, unstable = (middle, unstable) if largest(middle) <= 1.0 + _SLACK else (stable, middle)
    return stable
