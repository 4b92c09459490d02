"""The limits that a controller holds to, in its counts: pulse widths, the safe state, trips and the point of rest."""

from __future__ import annotations

import math

import numpy as np

from ambid.acquire.board import ADC_TOP, PWM_TOP
from ambid.acquire.scales import Scale, who
from ambid.errors import RigError
from ambid.physics.loop import UNLIMITED, Interval
from ambid.rig.rig import Daq, Rig

_FEWEST_DUTY = 16  # counts of pulse width that a loop can work with
_OFF_SHARE = 0.02  # of the stage's full voltage: what duty_off may miss 0 V by
_NO_PULSE = 0.1  # of it: what a straight line may give for no pulse at all on a stage that drives one way
_ONE_SIDED = 0.05  # of the larger end of a current trip: the other end, where the sensor shows one sign only
_ROUND_OFF = 1e-6  # counts


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
            f"{who(rig)}: the pulse width may go from {low} to {high} counts; the loop needs"
            f" {_FEWEST_DUTY} at least. By channels.voltage, 0 to {PWM_TOP} counts are {volts[0]:.4g} to"
            f" {volts[1]:.4g} V. Correct that calibration, daq.duty or loop.limits.voltage"
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
        asked = "daq.duty_off is" if daq.duty_off is not None else "the pulse width nearest to 0 V is"
        raise RigError(
            f"{who(rig)}: {asked} {off} counts, {volts[off]:.4g} V by channels.voltage; the safe state has to be"
            f" 0 V within {_OFF_SHARE:.0%} of {most:.4g} V. Correct daq.duty_off or that calibration"
        )
    return off


def trip_counts(rig: Rig, scale: Scale) -> tuple[int, int]:
    """Return a trip in counts, rounded inwards; refuse one at which the converter is at its end, as it never trips."""
    wanted = rig.trip("current" if scale.role == "current" else "position")
    if not all(map(math.isfinite, wanted)):
        raise RigError(
            f"{who(rig)} has neither daq.trip.{scale.role} nor loop.limits.{scale.role}; the controller needs to"
            " know where to go to its safe state. Give one of them"
        )
    ends = np.sort(scale.to_counts(wanted))
    low, high = math.ceil(ends[0] - _ROUND_OFF), math.floor(ends[1] + _ROUND_OFF)
    if scale.role == "current":
        low, high = _one_sided(scale, wanted, low, high)
    elif low < 1 or high > ADC_TOP - 1:
        raise _beyond(rig, scale, wanted)
    if low >= high and 0.0 <= ends[0] < ends[1] <= ADC_TOP:
        raise RigError(
            f"{who(rig)}: the trip of {scale.role}, {wanted[0]:.4g} to {wanted[1]:.4g}, has no two counts in it: one is"
            f" {abs(scale.slope(float(ends.mean()))):.3g} by channels.{scale.role}. Widen daq.trip.{scale.role}"
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
        seen = wanted[side] if scale.si[-1] > scale.si[0] else wanted[1 - side]
        if abs(seen) >= _ONE_SIDED * needed:
            return 1, 0
        low, high = (max(low, 0), high) if side == 0 else (low, min(high, ADC_TOP))
    return low, high


def _beyond(rig: Rig, scale: Scale, wanted: Interval) -> RigError:
    shown = np.sort(scale.to_si([0.0, float(ADC_TOP)]))
    return RigError(
        f"{who(rig)}: the trip of {scale.role}, {wanted[0]:.4g} to {wanted[1]:.4g}, is not inside what the"
        f" converter can show, {shown[0]:.4g} to {shown[1]:.4g} (0 to {ADC_TOP} counts by channels.{scale.role}): it"
        f" would never trip. Narrow daq.trip.{scale.role}, or correct the calibration"
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
