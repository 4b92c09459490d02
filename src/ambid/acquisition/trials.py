"""Short looks at a bench, seen through the rig. Pulses of both signs, without feedback, grow until the rotor leaves its
stop or part of the way to the current's trip is used; a few ms, within the time to lift. Then the excitation's size.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from ambid.acquisition.device import Device, Mode, Program
from ambid.acquisition.program import FULL, program
from ambid.acquisition.scales import scale_of
from ambid.acquisition.session import Course, RunReport, run
from ambid.acquisition.settings import BenchView, controller_settings, fault_words, with_default_daq
from ambid.arrays import Array
from ambid.errors import DeviceError
from ambid.physics.linear_model import model
from ambid.rig import Rig
from ambid.settings.caller import setting
from ambid.tracking.blocks import Frame

_FEWEST_PERIODS = 4.5  # four whole ones, whatever the period is rounded to
_TRIALS, _FIRST, _GROWTH = 8, 0.02, 4.0  # first: as a part of half the voltage; growth: largest step, down as up
_ENOUGH = 0.75  # of the part that is wished
TOO_MUCH, AIM = 1.2, 0.9
"""Of the part of the room that is wished: what is refused, and what another size aims at."""
USE = 0.3  # of the way to the trips that an excitation may use
VOLTAGE = 0.8  # of the voltage is its part; all of it is then too much
_NEAR = 0.85  # of the way to a trip: no room left


@dataclass(frozen=True, slots=True, kw_only=True)
class Room:
    """Where a bench may work, SI."""

    # of position and current, those of them that the bench has: the controller's limits
    trips: Mapping[str, tuple[float, float]]
    voltage: tuple[float, float]  # that may be ordered: inside the limits of the loop and ``daq.duty``

    @classmethod
    def of(cls, rig: Rig) -> Room:
        """Take it from a rig with ``[daq]``; infinite where the rig knows no limit."""
        unlimited = (-math.inf, math.inf)
        roles = [role for role in ("position", "current") if role in rig.plant.outputs]
        trips: dict[str, tuple[float, float]] = {role: rig.trip(role) or unlimited for role in roles}
        return cls(
            trips=MappingProxyType(trips), voltage=_ordered(rig, rig.limits.voltage if rig.limits else unlimited)
        )

    def used(self, role: str, values: Array, rest: float) -> float:
        """Return which part of the way from rest to the nearer trip `values` (n_samples,), SI, use: 0 to 1 and beyond;
        0 where there is no limit.
        """
        low, high = self.trips[role]
        up, down = float(values.max()) - rest, rest - float(values.min())
        return max(
            up / (high - rest) if high > rest else math.inf, down / (rest - low) if rest > low else math.inf, 0.0
        )


def _ordered(rig: Rig, limits: tuple[float, float]) -> tuple[float, float]:
    """Return what of the limits of the voltage the pulse widths allowed can order."""
    if rig.daq is None or rig.daq.duty is None:
        return limits
    low, high = sorted(scale_of(with_default_daq(rig), "voltage").to_si(rig.daq.duty).tolist())
    return max(low, limits[0]), min(high, limits[1])


Look = Callable[[Course], tuple[RunReport, dict[str, Array]]]


def make_look(device: Device, rig: Rig, stopped: Callable[[], bool]) -> Look:
    """Return a way of running a course on an opened, idle device: it gives the report, and what came, by role in SI."""
    plant = model(rig.model)
    view = BenchView(device.info, rig, (*plant.inputs, *plant.outputs))

    def look(course: Course) -> tuple[RunReport, dict[str, Array]]:
        tap = Kept(view)
        report = run(device, course, taps=[tap], stopped=stopped)
        return report, tap.roles()

    return look


class Kept:
    """Keeps what a run passes on, seen through a view; at most `most` samples, and the rest of a block."""

    def __init__(self, view: BenchView, *, most: float = math.inf) -> None:
        self._view, self._left = view, most
        self.values: list[Array] = []

    def take(self, frame: Frame) -> None:
        """Take a block as it came."""
        if self._left > 0:
            self.values.append(self._view.block(frame.block).values)
            self._left -= len(frame.block.values)

    def roles(self) -> dict[str, Array]:
        """Return what was kept by role, (n_samples,) each, SI."""
        values = np.concatenate([np.empty((0, len(self._view.units))), *self.values])
        return {role: values[:, k] for k, role in enumerate(self._view.units)}


def why_incomplete(report: RunReport, what: str) -> tuple[str, ...]:
    """Say why a run for `what` is not whole; empty where it is."""
    if report.fault is not None:
        return (f"the controller went to its safe state during {what}: {fault_words(report.fault)}",)
    if report.interrupted:
        return (f"{what} was interrupted after {report.samples} samples",)
    if report.lost:
        return (f"{report.lost} of {report.wanted} samples were lost during {what}: check cable, baud rate and load",)
    if not report.complete:
        return (f"{what} ended after {report.samples} of {report.wanted} samples",)
    return ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """What is played, and how long."""

    name: str  # excitation, as `ambid.acquisition.program` knows it
    band: tuple[float, float] | None  # in Hz
    mode: Mode  # of the device
    settle_s: float  # time after the start, and length of the trial, s
    seconds: float
    seed: int  # of the excitation

    def course(self, amplitude_v: float, rate_hz: float) -> Course:
        """Return the course that plays it with a peak in V; refuse what a controller of this rate cannot play."""
        wave = program(
            self.name, amplitude_v=amplitude_v, band=self.band, rate_hz=rate_hz, seconds=self.seconds, seed=self.seed
        )
        return Course(mode=self.mode, seconds=self.seconds, settle_s=self.settle_s, program=wave)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Size:
    """What trials found."""

    amplitude_v: float  # peak of the excitation, V
    used: float  # part of the room that it used, 0 to 1 and beyond
    findings: tuple[str, ...]  # what each trial showed; why the size is not good
    reasons: tuple[str, ...] = ()
    trials: tuple[tuple[float, float], ...] = ()  # peak in V and part of the room of each that was whole
    last: Mapping[str, Array] = field(default_factory=dict)  # what the last trial showed, by role, SI


def moving_band(rate_hz: float, seconds: float = math.inf) -> tuple[float, float]:
    """Return the band, rate/1000 to rate/30 in Hz, in which a levitated rotor moves; above it only the coil is seen."""
    return max(rate_hz / 1000.0, _FEWEST_PERIODS / seconds), rate_hz / 30.0


def band_for(trial: Trial, rate_hz: float) -> tuple[float, float] | None:
    """Return the band as requested; without one, of a multisine that is to levitate, that in which the rotor moves."""
    if trial.band is not None or trial.mode != "levitate" or trial.name not in ("multisine", "schroeder"):
        return trial.band
    low, high = moving_band(rate_hz, trial.seconds)
    return (low, high) if 3.0 * low < high else None  # a short record has no room for slow lines


def find_amplitude(
    look: Look,
    room: Room,
    trial: Trial,
    resting: Mapping[str, float],
    *,
    rate_hz: float,
    use: float,
    amplitude_v: float | None = None,
) -> Size:
    """Find the excitation that uses its part `use` of the room: three quarters of it at least, a fifth more at most.
    The first trial is small enough for a bench that is hard to hold; one too large is followed by a smaller.

    `resting`: position in m and current in A without excitation. Returns the last trial's, with reasons where it
    tripped or used too much; it may use less where trials have run out.
    """
    low, high = room.voltage
    if amplitude_v is None and not math.isfinite(high - low):
        why = "the rig has no loop.limits.voltage to derive an amplitude from: give one"
        return Size(amplitude_v=math.nan, used=math.nan, findings=(), reasons=(why,))
    size = _FIRST * (high - low) / 2.0 if amplitude_v is None else amplitude_v
    tried: list[tuple[float, float]] = []  # size, and what it used
    findings: list[str] = []
    while True:
        report, signals = look(trial.course(size, rate_hz))
        reasons = why_incomplete(report, f"excitation of {size:.3g} V")
        if reasons:
            return Size(
                amplitude_v=size, used=math.nan, findings=tuple(findings), reasons=reasons, trials=tuple(tried),
                last=signals,
            )  # fmt: skip
        worst, share = room_used(signals, room, resting, use)
        tried.append((size, share))
        findings.append(f"{size:.3g} V moves {worst} through {100.0 * share:.0f} % of its available range")
        larger_or_smaller = _next_size(tried, use) if amplitude_v is None else None
        if larger_or_smaller is None:
            break
        size = larger_or_smaller
    return Size(
        amplitude_v=size, used=share, findings=tuple(findings), trials=tuple(tried), last=signals,
        reasons=_too_much(tried, worst, TOO_MUCH * use if amplitude_v is None else _NEAR),
    )  # fmt: skip


def fitting_amplitude(device: Device, rig: Rig, trial: Trial, *, stopped: Callable[[], bool] = lambda: False) -> float:
    """Find the amplitude, peak in V, for a device that is opened, idle and has not run yet."""
    look, room = make_look(device, rig, stopped), Room.of(rig)
    report, signals = look(Course(mode=trial.mode, seconds=trial.seconds, settle_s=trial.settle_s))
    reasons = why_incomplete(report, "the look before the excitation")
    if not reasons:
        resting = {role: float(signals[role].mean()) for role in room.trips}
        size = find_amplitude(look, room, trial, resting, rate_hz=device.info.rate_hz, use=USE)
        if not size.reasons:
            return size.amplitude_v
        reasons = size.reasons
    raise DeviceError(
        f"{device.info.port}: no suitable amplitude was found: {'; '.join(reasons)}. Give {setting('amplitude')}"
    )


def _next_size(tried: list[tuple[float, float]], use: float) -> float | None:
    """Return the size to try next; None where the last one is good, or another would not be better."""
    size, share = tried[-1]
    good = _ENOUGH * use <= share <= TOO_MUCH * use
    if good or len(tried) == _TRIALS or (share > use and _at_the_floor(tried)):
        return None
    wanted = size * (_GROWTH if share <= 0.0 else min(max(AIM * use / share, 1.0 / _GROWTH), _GROWTH))
    # Where more is used than in proportion, the good size lies between two that were tried.
    below = max((s for s, part in tried if part <= use), default=0.0)
    above = min((s for s, part in tried if part > use), default=math.inf)
    return wanted if below < wanted < above else math.sqrt(below * above)


def _at_the_floor(tried: list[tuple[float, float]]) -> bool:
    """Whether a smaller size used hardly less: by less than half of what is in proportion."""
    if len(tried) < 2 or tried[-1][0] >= tried[-2][0]:
        return False
    (larger, before), (smaller, now) = tried[-2:]
    return now / before > (1.0 + smaller / larger) / 2.0


def _too_much(tried: list[tuple[float, float]], worst: str, most: float) -> tuple[str, ...]:
    """Say that the last trial used more of the room than `most`; nothing where it did not."""
    size, share = tried[-1]
    if share <= most:
        return ()
    text = (
        f"an excitation of {size:.3g} V moves {worst} through {100.0 * share:.0f} % of its available range; "
        f"{100.0 * most:.0f} % are"
    )
    if _at_the_floor(tried):
        return (
            f"{text} allowed, and a larger amplitude hardly moved it more: the bench moves by itself; check noise "
            "and gains",
        )
    return (f"{text} allowed: give a smaller one",)


def room_used(signals: Mapping[str, Array], room: Room, resting: Mapping[str, float], use: float) -> tuple[str, float]:
    """Return which quantity uses most of its room, and how much of it."""
    shares = {role: room.used(role, signals[role], resting[role]) for role in room.trips}
    low, high = room.voltage
    if math.isfinite(high - low):
        volts = signals["voltage"]
        rest = min(max(float(volts.mean()), low), high)  # an excitation has no mean; what holds the rotor may have one
        up, down = float(volts.max()) - rest, rest - float(volts.min())
        reach = max(up / (high - rest) if high > rest else 1.0, down / (rest - low) if rest > low else 1.0)
        # A voltage that is used as far as it may be counts like a position at the part that is wished.
        shares["voltage"] = reach * use / VOLTAGE
    worst = max(shares, key=lambda role: shares[role])
    return worst, shares[worst]


_SETTLE_S, _HOLD_S, _LONGEST_S = 0.3, 0.015, 0.06  # before a pulse, its shortest and longest time
# of the time to lift, in which the rotor may lie outside its trips: what settles, and what a pulse takes
_SETTLE_SHARE, _HOLD_SHARE = 0.35, 0.2
_FEWEST_TICKS = 8  # of a pulse
_LENGTHS = 3.0  # of its time are looked at from its begin on
_TRIES = 3  # of a pulse that a busy line made late
_FIRST_PULSE, _PULSE_GROWTH, _BLIND = (
    0.02,
    2.0,
    0.2,
)  # of the voltage: the first pulse, its growth, the most without a current
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
    """Find the signs from voltage to current and from current to motion; `clear`: out of the safe state."""
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
        volts, hold_s = max(_FIRST_PULSE * self._voltage, 2.0 * self._step), min(_HOLD_S, self._longest_s)
        while not self._weigh(up := self._play(volts, hold_s), down := self._play(-volts, hold_s)):
            if hold_s < self._longest_s:
                hold_s = min(2.0 * hold_s, self._longest_s)
            elif volts < _BLIND * self._voltage:
                volts = min(_PULSE_GROWTH * volts, _BLIND * self._voltage)
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
                pulse = self._play(volts, hold_s)
                if not pulse.motion:
                    continue
                if self._play(volts, hold_s).motion * pulse.motion < 0.0:
                    raise _End("equal pulses moved the rotor once up and once down: something else moves it. Hold it")
                return _sign(pulse.motion * volts * self._per_volt)
        return 0

    def _size_for(self, share: float, side: float) -> tuple[float, float]:
        """Return voltage and time of a pulse to one side that uses a part of the way to the current's trip, by the pair
        that showed the current: it grows with the voltage, and at most with the time.
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
            report, signals = self._look(course)
            pulse = self._seen(volts, ticks, signals)
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

    def _seen(self, volts: float, ticks: int, signals: dict[str, Array]) -> Pulse:
        voltage = signals["voltage"]
        rest = voltage[-1] if voltage.size else 0.0
        ordered = np.flatnonzero((voltage - rest) * math.copysign(1.0, volts) > abs(volts) / 2.0)
        first = int(ordered[0]) if ordered.size else max(0, voltage.size - 1)
        before = slice(max(0, first - ticks), first + 1)  # the sample at which it is ordered is the last one without it
        change, noise, motion = 0.0, math.inf, 0.0
        if ordered.size > ticks // 2:
            end = slice(first + 1 + 3 * ticks // 4, first + 1 + ticks)
            change, noise = _change(signals["current"], before, end)
            motion = self._moved(signals["position"], before, first)
        time_s = (np.arange(voltage.size) - first) / self._rate_hz
        return Pulse(
            volts=volts, hold_s=ticks / self._rate_hz, time_s=time_s, voltage=voltage, current=signals["current"],
            position=signals["position"], current_change=change, current_noise=noise, motion=motion,
        )  # fmt: skip

    def _moved(self, position: Array, before: slice, first: int) -> float:
        """Return how far the position went from where it lay, 0 where it did not."""
        low, high = self._room.trips["position"]
        away = position[first:] - float(position[before].mean())
        width = high - low if math.isfinite(high - low) else 0.0
        swing = float(np.ptp(position[: first + 1]))  # what it does without the pulse
        bound = max(_SIGMAS * float(position[before].std()), swing, _COUNTS * self._counts["position"], _MOTION * width)
        beyond = np.abs(away) > bound
        lasting = np.convolve(beyond, np.ones(_TOGETHER), "valid") >= _TOGETHER
        if not lasting.any():
            return 0.0
        begun = int(np.argmax(lasting))
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
