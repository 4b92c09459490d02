"""Which way a bench answers, before its loop is closed: short pulses of voltage, small ones first.

The rotor lies on a stop, or is drawn to one: it may only move away from it. So pulses of both signs are played without
feedback, each a little larger than the last, until the position moves or a part of the way to the current's trip is
used. Each lasts some milliseconds, and ends before the controller's time to lift is over.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ambid.acquisition.amplitude import Look, Room, why_incomplete
from ambid.acquisition.default_daq import with_default_daq
from ambid.acquisition.device import Program
from ambid.acquisition.program import FULL
from ambid.acquisition.scales import scale_of
from ambid.acquisition.session import Course
from ambid.acquisition.settings import controller_settings
from ambid.arrays import Array
from ambid.rig import Rig

_SETTLE_S, _HOLD_S, _LONGEST_S = 0.3, 0.015, 0.06  # before a pulse, its shortest and longest time
# of the time to lift, in which the rotor may lie outside its trips: what settles, and what a pulse takes
_SETTLE_SHARE, _HOLD_SHARE = 0.35, 0.2
_FEWEST_TICKS = 8  # of a pulse
_LENGTHS = 3.0  # of its time are looked at from its begin on
_TRIES = 3  # of a pulse that a busy line made late
_FIRST, _GROWTH, _BLIND = 0.02, 2.0, 0.2  # of the voltage: the first pulse, its growth, the most without a current
_STEPS = (0.1, 0.16, 0.25, 0.4, 0.6)  # parts of the way to the trip of the current that pulses use in turn
_MOST = 0.95  # of the voltage
_SIGMAS, _COUNTS, _MOTION = 6.0, 4.0, 0.01  # what shows: over noise, in counts, in parts of the way between the trips
_COMMON = 0.5  # of what both pulses of a pair did to the current alike: what they did differently is more
_TOGETHER = 3  # samples beyond it: one alone may be a disturbance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pulse:
    """One pulse, and what was seen of it; SI."""

    volts: float  # ordered about the voltage at rest, with its sign
    hold_s: float
    time_s: Array  # (n_samples,), from the pulse's begin
    voltage: Array  # (n_samples,)
    current: Array
    position: Array
    current_change: float  # at the end of the pulse, over before
    current_noise: float  # standard deviation of that
    motion: float  # the farthest that the position went; 0 where it is within the noise


@dataclass(frozen=True, slots=True, kw_only=True)
class Polarity:
    """What pulses showed."""

    pulses: tuple[Pulse, ...]
    # sign of the current for a positive voltage, and of the motion for a rising current; 0: not seen
    current: int
    motion: int
    troubles: tuple[str, ...] = ()  # what ended it early, or contradicts itself


def find_polarity(
    look: Look, room: Room, rig: Rig, rate_hz: float, *, clear: Callable[[], object] = lambda: None
) -> Polarity:
    """Find the signs from voltage to current and from current to motion.

    `look`: see `make_look`; `room`: limits; `rig`: of the device; `rate_hz`: of the device, Hz; `clear`: makes the
    device leave its safe state.
    """
    return _Pulses(look, room, rig, rate_hz, clear).found()


class _End(Exception):
    """A pulse ended otherwise than it should."""


class _Pulses:
    """The pulses of one bench."""

    def __init__(self, look: Look, room: Room, rig: Rig, rate_hz: float, clear: Callable[[], object]) -> None:
        full = with_default_daq(rig)
        settings = controller_settings(full)
        assert full.daq is not None
        self._look, self._rate_hz, self._clear, self._room = look, rate_hz, clear, room
        slope = scale_of(full, "voltage").slope(settings.duty_bias)
        self._rising, self._step = math.copysign(1.0, slope), abs(slope)
        self._counts = {
            "position": abs(scale_of(full, "position").slope(settings.setpoint)),
            "current": abs(scale_of(full, "current").slope(settings.current_rest)),
        }
        away = min(settings.duty_bias - settings.duty_low, settings.duty_high - settings.duty_bias)
        self._voltage = away * self._step
        lift_s = full.daq.lift_ms / 1e3
        self._settle_s = min(_SETTLE_S, _SETTLE_SHARE * lift_s)
        self._longest_s = min(_LONGEST_S, _HOLD_SHARE * lift_s)
        self._per_volt, self._hold_s = 0.0, 0.0  # what a pair of pulses did to the current, and how long they were
        self._pulses: list[Pulse] = []

    def found(self) -> Polarity:
        """Play pulses until both signs are known, or no more may be played."""
        current = motion = 0
        troubles: tuple[str, ...] = ()
        try:
            current = self._sign_of_current()
            motion = self._sign_of_motion() if current else 0
        except _End as end:
            troubles = (str(end),)
            current = _sign(self._per_volt)
        return Polarity(pulses=tuple(self._pulses), current=current, motion=motion, troubles=troubles)

    def _sign_of_current(self) -> int:
        """Raise pairs of pulses, longer first, until the current shows."""
        volts, hold_s = max(_FIRST * self._voltage, 2.0 * self._step), min(_HOLD_S, self._longest_s)
        while not self._weigh(up := self._play(volts, hold_s), down := self._play(-volts, hold_s)):
            if hold_s < self._longest_s:
                hold_s = min(2.0 * hold_s, self._longest_s)
            elif volts < _BLIND * self._voltage:
                volts = min(_GROWTH * volts, _BLIND * self._voltage)
            elif abs(up.current_change + down.current_change) > _SIGMAS * (up.current_noise + down.current_noise):
                raise _End("the current goes the same way whichever way the voltage is pulsed: look at its sensor")
            else:
                return 0
        return _sign(self._per_volt)

    def _weigh(self, up: Pulse, down: Pulse) -> bool:
        """Tell the current of a pair of pulses from what goes on without them; whether it is more than noise."""
        change, common = (
            (up.current_change - down.current_change) / 2.0,
            (up.current_change + down.current_change) / 2.0,
        )
        noise = _SIGMAS * math.hypot(up.current_noise, down.current_noise) / 2.0
        if abs(change) <= max(noise, self._counts["current"], _COMMON * abs(common)):
            return False
        farthest = max(abs(up.current_change), abs(down.current_change))
        self._per_volt, self._hold_s = math.copysign(farthest, change) / up.volts, up.hold_s
        return True

    def _sign_of_motion(self) -> int:
        """Raise pulses of both signs until the position moves; a second one like it has to agree."""
        for share in _STEPS:
            for side in (1.0, -1.0):
                volts, hold_s = self._size_for(share, side)
                seen = self._play(volts, hold_s)
                if not seen.motion:
                    continue
                if self._play(volts, hold_s).motion * seen.motion < 0.0:
                    raise _End("equal pulses moved the rotor once up and once down: something else moves it. Hold it")
                return _sign(seen.motion * volts * self._per_volt)
        return 0

    def _size_for(self, share: float, side: float) -> tuple[float, float]:
        """Return voltage and time of a pulse to one side that uses a part of the way to the current's trip.

        By the pair that showed the current: it grows with the voltage, and at most with the time.
        """
        most, wanted = _MOST * self._voltage, share * self._current_room(side) / abs(self._per_volt)
        longer = min(max(1.0, wanted / most), self._longest_s / self._hold_s)  # where the voltage does not reach it
        return math.copysign(max(2.0 * self._step, min(wanted / longer, most)), side), self._hold_s * longer

    def _current_room(self, side: float) -> float:
        """Return the way to the trip that a pulse to this side goes towards."""
        low, high = self._room.trips["current"]
        if not math.isfinite(high - low):  # nothing is known but the voltage
            return _BLIND * self._voltage * abs(self._per_volt)
        rest = float(np.median(self._pulses[-1].current[self._pulses[-1].time_s < 0.0]))
        return max(high - rest if side * self._per_volt > 0.0 else rest - low, 0.05 * (high - low))

    def _play(self, volts: float, hold_s: float) -> Pulse:
        """Play one pulse and look at it."""
        ticks = max(_FEWEST_TICKS, round(hold_s * self._rate_hz))
        peak = FULL if volts * self._rising > 0.0 else -FULL
        wave = Program(kind="table", amplitude=abs(volts), hold=ticks, length=2, cycles=1, table=(peak, 0))
        course = Course(
            mode="drive",
            seconds=_LENGTHS * ticks / self._rate_hz,
            settle_s=self._settle_s,
            program=wave,
            transient=True,
        )
        for _ in range(_TRIES):
            report, seen = self._look(course)
            pulse = self._seen(volts, ticks, seen)
            if report.fault is None or report.fault.what != "out_of_gap":
                break
            self._clear()  # the time to lift was over before the pulse was: it shows motion, or comes again
            if pulse.motion:
                self._pulses.append(pulse)
                return pulse
        self._pulses.append(pulse)
        if reasons := why_incomplete(report, f"a pulse of {volts:.3g} V for {ticks / self._rate_hz:.3g} s"):
            raise _End(reasons[0])
        return pulse

    def _seen(self, volts: float, ticks: int, seen: dict[str, Array]) -> Pulse:
        voltage = seen["voltage"]
        rest = voltage[-1] if voltage.size else 0.0
        ordered = np.flatnonzero((voltage - rest) * math.copysign(1.0, volts) > abs(volts) / 2.0)
        first = int(ordered[0]) if ordered.size else max(0, voltage.size - 1)
        before = slice(max(0, first - ticks), first + 1)  # the sample at which it is ordered is the last one without it
        change, noise, motion = 0.0, math.inf, 0.0
        if ordered.size > ticks // 2:
            end = slice(first + 1 + 3 * ticks // 4, first + 1 + ticks)
            change, noise = _change(seen["current"], before, end)
            motion = self._moved(seen["position"], before, first)
        time_s = (np.arange(voltage.size) - first) / self._rate_hz
        return Pulse(
            volts=volts, hold_s=ticks / self._rate_hz, time_s=time_s, voltage=voltage, current=seen["current"],
            position=seen["position"], current_change=change, current_noise=noise, motion=motion,
        )  # fmt: skip

    def _moved(self, position: Array, before: slice, first: int) -> float:
        """Return how far the position went from where it lay, 0 where it did not."""
        low, high = self._room.trips["position"]
        away = position[first:] - float(position[before].mean())
        width = high - low if math.isfinite(high - low) else 0.0
        swing = float(np.ptp(position[: first + 1]))  # what it does without the pulse
        bound = max(_SIGMAS * float(position[before].std()), swing, _COUNTS * self._counts["position"], _MOTION * width)
        beyond = np.abs(away) > bound
        held = np.convolve(beyond, np.ones(_TOGETHER), "valid") >= _TOGETHER
        if not held.any():
            return 0.0
        begun = int(np.argmax(held))
        same = away * away[begun] > 0.0  # a rotor that comes back and swings through is not looked at further
        stop = begun + int(np.argmin(same[begun:])) if not same[begun:].all() else away.size
        return float(away[begun:stop][np.argmax(np.abs(away[begun:stop]))])


def _change(values: Array, before: slice, end: slice) -> tuple[float, float]:
    """Return by how much the mean is another one at the end, and the standard deviation of that."""
    steps = np.diff(values[before])  # a slow drift is no noise
    sd = float(np.sqrt(np.mean(steps**2) / 2.0)) if steps.size else math.inf
    n = max(1, end.stop - end.start)
    return float(values[end].mean() - values[before].mean()), sd * math.sqrt(1.0 / n + 1.0 / max(1, steps.size))


def _sign(value: float) -> int:
    return int(np.sign(value))
