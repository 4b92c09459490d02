"""What the controller (ATmega328P at 16 MHz, an Arduino Uno) can do, and its counts in SI by a channel's calibration. A
tick is a whole number of periods of the pulse width, so that inputs are held at the same point of a pulse.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import DeviceError, RigError
from ambid.physics.loop import UNLIMITED, Interval
from ambid.rig.rig import Daq, Rig, RigChannel
from ambid.units import parse_unit

CLOCK_HZ = 16_000_000
PWM_TOP = 800
"""Pulse width that is always on, counts."""
PWM_HZ = CLOCK_HZ / PWM_TOP
"""Frequency of the pulse width modulation, Hz."""
ADC_TOP = 1023
"""Largest value of the converter, counts."""
TABLE_LENGTH = 1000
"""Elements of the excitation table."""
BYTE_BITS = 11
"""Bit times that a byte may take on the line: ten, and one kept for answers."""
FASTEST_OUTPUT, SLOWEST_OUTPUT = 8, 20
"""Shortest and longest tick with which the output may be on, periods: a tick's work must be done in time while
commands come, and a fault must end in the safe state within 2 ms."""
LARGEST_GAIN = 2**19
"""Largest step number of a gain: no product can then overflow the controller's arithmetic."""
SHORTEST_PERIOD, LONGEST_PERIOD = 5, 20_000
"""Of a tick, in periods of the pulse width modulation."""
LIFTED_MS = 100
"""Inside its limits for so long after a start, the position counts from then on, ms."""
LAG_S = 175e-6
"""From the moment that a sample stands for to that from which its pulse width acts, at every rate, s."""

_FEWEST_DUTY = 16  # counts of pulse width that a loop can work with
_OFF_SHARE = 0.02  # of the stage's full voltage: what duty_off may miss 0 V by
_NO_PULSE = 0.1  # of it: what a straight line may give for no pulse at all on a stage that drives one way
_ONE_SIDED = 0.05  # of the larger end of a current trip: the other end, where the sensor shows one sign only
_ROUND_OFF = 1e-6  # counts


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scale:
    """A straight or bent line from counts to SI, everywhere rising or everywhere falling."""

    role: str  # of the rig's channel
    column: str
    top: int  # largest count that the controller gives or takes; the least is 0
    raw: Array  # (n_points,), counts, corners of the line, increasing; at least two
    si: Array  # (n_points,), SI, values there, increasing or decreasing. The first and last piece go on outside.
    # counts outside which the calibration table refuses to be read; None: nowhere
    ends: tuple[float, float] | None = None

    def to_si(self, counts: ArrayLike) -> Array:
        """Return what counts mean, in a straight line outside the corners."""
        return _line(np.asarray(counts, dtype=np.float64), self.raw, self.si)

    def to_counts(self, si: ArrayLike) -> Array:
        """Return the counts of values, not rounded, straight on outside the corners; may be outside 0 to `top`."""
        order = slice(None) if self.si[-1] > self.si[0] else slice(None, None, -1)
        return _line(np.asarray(si, dtype=np.float64), self.si[order], self.raw[order])

    def slope(self, counts: float) -> float:
        """Return SI per count (signed, never 0) at a point; at a corner the mean of both sides."""
        slopes = np.diff(self.si) / np.diff(self.raw)
        last = slopes.size - 1
        after = int(np.clip(np.searchsorted(self.raw, counts, side="right") - 1, 0, last))
        before = int(np.clip(np.searchsorted(self.raw, counts, side="left") - 1, 0, last))
        return float((slopes[before] + slopes[after]) / 2.0)

    def slopes(self, low: float, high: float) -> tuple[float, float]:
        """Return the least and the largest slope between two counts, SI per count without sign."""
        slopes = np.abs(np.diff(self.si) / np.diff(self.raw))
        touched = (self.raw[:-1] < high) & (self.raw[1:] > low)
        inside = slopes[touched] if touched.any() else np.abs([self.slope(low)])
        return float(inside.min()), float(inside.max())


def scale_of(rig: Rig, role: str) -> Scale:
    """Return the calibration from counts to SI of a role: ``voltage`` (counts of pulse width), or an analog input
    (``position``, ``current``, ``speed``, ``angle``).
    """
    c = rig.channel(role)
    top = PWM_TOP if role == "voltage" else ADC_TOP
    calibration = c.calibration
    if calibration is None:
        raise RigError(
            f"{who(rig)}: channels.{role} has no calibration; the controller gives counts (0 to {top})."
            f" Give channels.{role}.gain and offset, or a table, from counts"
        )
    _check_counts(rig, c)
    if calibration.raw is None or calibration.out is None:
        raw = np.array([0.0, float(top)])
        si = calibration.gain * raw + calibration.offset
        _check_slopes(rig, role, raw, si)
        return Scale(role=role, column=c.column, top=top, raw=raw, si=si)
    steps = np.diff(calibration.out)
    if not (np.all(steps > 0.0) or np.all(steps < 0.0)):
        raise RigError(
            f"{who(rig)}: channels.{role}.table is not monotonic; the controller needs one value for each count "
            "and back. Cut the table to a part that only rises or only falls"
        )
    _check_slopes(rig, role, calibration.raw, calibration.out)
    ends = None if calibration.extrapolate else (float(calibration.raw[0]), float(calibration.raw[-1]))
    return Scale(role=role, column=c.column, top=top, raw=calibration.raw, si=calibration.out, ends=ends)


def who(rig: Rig) -> str:
    """Return how messages call a rig: its file, else its name."""
    return f"rig {rig.source}" if rig.source is not None else f"rig {rig.name!r}"


def _check_slopes(rig: Rig, role: str, raw: Array, si: Array) -> None:
    """Refuse values that do not differ from count to count, or are beyond all numbers."""
    with np.errstate(all="ignore"):
        slopes = np.concatenate([np.diff(si) / np.diff(raw), np.diff(raw) / np.diff(si)])
    if not np.all(np.isfinite(slopes)):
        raise RigError(
            f"{who(rig)}: channels.{role} gives {si[0]:.6g} at {raw[0]:g} counts and {si[-1]:.6g} at {raw[-1]:g}; "
            "each count needs a value of its own. Correct its gain, offset or table"
        )


def _check_counts(rig: Rig, c: RigChannel) -> None:
    """Refuse a calibration that begins with anything but plain counts."""
    assert c.calibration is not None
    unit = c.calibration.unit_in or "1"
    if c.unit is not None and (parse_unit(c.unit).si != "1" or parse_unit(c.unit).scale != 1.0):
        unit = c.unit
    if unit != "1":
        raise RigError(
            f"{who(rig)}: channels.{c.role} is calibrated from [{unit}]; the controller gives counts, a plain"
            " number [1]. Calibrate it from counts"
        )


def _line(x: Array, corners: Array, values: Array) -> Array:
    piece = np.clip(np.searchsorted(corners, x, side="right") - 1, 0, corners.size - 2)
    slope = np.diff(values) / np.diff(corners)
    return np.asarray(values[piece] + slope[piece] * (x - corners[piece]), dtype=np.float64)


def duty_range(rig: Rig, daq: Daq, voltage: Scale) -> tuple[int, int]:
    """Return the pulse widths allowed: as given, else those whose voltage is inside the limits of the loop."""
    if daq.duty is not None:
        low, high = daq.duty
        if high > PWM_TOP:
            raise RigError(
                f"{who(rig)}: daq.duty is [{low}, {high}]; a pulse width is 0 to {PWM_TOP} counts. Correct it"
            )
    else:
        low, high = 0, PWM_TOP
        limits = UNLIMITED if rig.limits is None else rig.limits.voltage
        if limits != UNLIMITED:
            ends = np.clip(np.sort(voltage.to_counts(limits)), 0.0, PWM_TOP)
            low, high = math.ceil(ends[0] - _ROUND_OFF), math.floor(ends[1] + _ROUND_OFF)
    if high - low < _FEWEST_DUTY:
        volts = np.sort(voltage.to_si([0.0, PWM_TOP]))
        raise RigError(
            f"{who(rig)}: the pulse width may be {low} to {high} counts; the loop needs at least {_FEWEST_DUTY}. "
            f"By channels.voltage, 0 to {PWM_TOP} counts are {volts[0]:.4g} to {volts[1]:.4g} V. Correct that "
            "calibration, daq.duty or loop.limits.voltage"
        )
    if voltage.ends is not None and (low < voltage.ends[0] or high > voltage.ends[1]):
        raise RigError(
            f"{who(rig)}: the table of channels.voltage runs from {voltage.ends[0]:g} to {voltage.ends[1]:g}"
            f" counts; the pulse width from {low} to {high}. Extend the table, or narrow daq.duty"
        )
    return low, high


def duty_off(rig: Rig, daq: Daq, voltage: Scale) -> int:
    """Return the pulse width of the safe state, which has to be without voltage."""
    volts = voltage.to_si(np.arange(PWM_TOP + 1))
    off = int(np.argmin(np.abs(volts))) if daq.duty_off is None else daq.duty_off
    if off > PWM_TOP:
        raise RigError(f"{who(rig)}: daq.duty_off is {off}; a pulse width is 0 to {PWM_TOP} counts. Correct it")
    most = float(np.abs(volts).max())
    # A single transistor that is never on is without voltage, whatever the line through its pulses says there.
    never_on = daq.duty_off == 0 and abs(volts[0]) <= _NO_PULSE * most and volts[0] * volts[-1] <= 0.0
    if abs(volts[off]) > _OFF_SHARE * most and not never_on:
        which = "daq.duty_off is" if daq.duty_off is not None else "the pulse width nearest to 0 V is"
        raise RigError(
            f"{who(rig)}: {which} {off} counts, {volts[off]:.4g} V by channels.voltage; the safe state must be 0 V "
            f"within {_OFF_SHARE:.0%} of {most:.4g} V. Correct daq.duty_off or that calibration"
        )
    return off


def trip_counts(rig: Rig, scale: Scale) -> tuple[int, int]:
    """Return a trip in counts, rounded inwards; refuse one at which the converter is at its end, as it never trips."""
    wanted = rig.trip("current" if scale.role == "current" else "position")
    if not all(map(math.isfinite, wanted)):
        raise RigError(
            f"{who(rig)} has neither daq.trip.{scale.role} nor loop.limits.{scale.role}; the controller needs to "
            "know when to enter its safe state. Give one of them"
        )
    ends = np.sort(scale.to_counts(wanted))
    low, high = math.ceil(ends[0] - _ROUND_OFF), math.floor(ends[1] + _ROUND_OFF)
    if scale.role == "current":
        low, high = _one_sided(scale, wanted, low, high)
    elif low < 1 or high > ADC_TOP - 1:
        raise _beyond(rig, scale, wanted)
    if low >= high and 0.0 <= ends[0] < ends[1] <= ADC_TOP:
        raise RigError(
            f"{who(rig)}: the trip of {scale.role}, {wanted[0]:.4g} to {wanted[1]:.4g}, spans less than two "
            f"counts: one is {abs(scale.slope(float(ends.mean()))):.3g} by channels.{scale.role}. Widen "
            f"daq.trip.{scale.role}"
        )
    if low >= high or low > ADC_TOP or high < 0:
        raise _beyond(rig, scale, wanted)
    return low, high


def _one_sided(scale: Scale, wanted: Interval, low: int, high: int) -> tuple[int, int]:
    """Let a current sensor that shows one sign only trip on that side only; elsewhere return what is refused."""
    needed = max(map(abs, wanted))
    for side, count in ((0, low), (1, high)):
        if 1 <= count <= ADC_TOP - 1:
            continue
        end = wanted[side] if scale.si[-1] > scale.si[0] else wanted[1 - side]
        if abs(end) >= _ONE_SIDED * needed:
            return 1, 0
        low, high = (max(low, 0), high) if side == 0 else (low, min(high, ADC_TOP))
    return low, high


def _beyond(rig: Rig, scale: Scale, wanted: Interval) -> RigError:
    ends = np.sort(scale.to_si([0.0, float(ADC_TOP)]))
    return RigError(
        f"{who(rig)}: the trip of {scale.role}, {wanted[0]:.4g} to {wanted[1]:.4g}, is not inside the range of the "
        f"converter, {ends[0]:.4g} to {ends[1]:.4g} (0 to {ADC_TOP} counts by channels.{scale.role}): it would "
        f"never trip. Narrow daq.trip.{scale.role}, or correct the calibration"
    )


def count_inside(rig: Rig, scale: Scale, value: float, low: int, high: int, what: str) -> int:
    """Return the count nearest to a value at rest, which has to lie inside an interval of counts."""
    count = round(float(scale.to_counts(value)))
    if not low <= count <= high:
        ends = np.sort(scale.to_si([float(low), float(high)]))
        raise RigError(
            f"{who(rig)}: {scale.role} at rest is {value:.4g} ({count} counts), outside the {what},"
            f" {ends[0]:.4g} to {ends[1]:.4g}. Correct operating_point.{scale.role}, or those"
        )
    return count


def period_of(rate_hz: float) -> int:
    """Return the tick of a rate in periods of the pulse width modulation."""
    exact = PWM_HZ / rate_hz
    period = round(exact)
    if SHORTEST_PERIOD <= period <= LONGEST_PERIOD and math.isclose(exact, period, rel_tol=1e-9):
        return period
    near = sorted({_possible(math.ceil(exact)), _possible(math.floor(exact))}, reverse=True)
    raise DeviceError(
        f"daq.rate_hz is {rate_hz:g} Hz; a tick of the controller is a whole number of periods of {PWM_HZ:g} Hz, "
        f"{SHORTEST_PERIOD} to {LONGEST_PERIOD} of them. The nearest rates: "
        f"{' or '.join(f'{PWM_HZ / n:.10g}' for n in near)} Hz"
    )


def nearest_rate(rate_hz: float, *, output: bool = False) -> float:
    """Return the rate in Hz that the controller can do nearest by ratio; `output`: with which the output may be on."""
    ends = (FASTEST_OUTPUT, SLOWEST_OUTPUT) if output else (SHORTEST_PERIOD, LONGEST_PERIOD)
    exact = PWM_HZ / rate_hz
    rates = [PWM_HZ / _possible(n, ends) for n in (math.floor(exact), math.ceil(exact))]
    return min(rates, key=lambda rate: abs(math.log(rate / rate_hz)))


def drives(period: int) -> bool:
    """Return whether the output may be on with ticks of `period` periods of the pulse width modulation."""
    return FASTEST_OUTPUT <= period <= SLOWEST_OUTPUT


def output_rates() -> str:
    """Return the rates with which the output may be on, such as ``1000 to 2500 Hz``."""
    return f"{PWM_HZ / SLOWEST_OUTPUT:g} to {PWM_HZ / FASTEST_OUTPUT:g} Hz"


def _possible(period: int, ends: tuple[int, int] = (SHORTEST_PERIOD, LONGEST_PERIOD)) -> int:
    return min(max(period, ends[0]), ends[1])
