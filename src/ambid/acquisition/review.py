"""What a rig's controller holds only roughly: one line with remedy each, before anything is switched on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from ambid.acquisition.device import DeviceInfo
from ambid.acquisition.scales import LAG_S, output_rates, scale_of, who
from ambid.acquisition.settings import (
    ControllerSettings,
    controller_settings,
    exact_gains,
    has_position,
    realised,
    with_default_daq,
)
from ambid.errors import ModelError, RigError
from ambid.physics.linear_model import model
from ambid.rig.rig import Rig
from ambid.simulation.margins import LoopMargins, loop_margins

_ROUNDED = 0.01  # of a gain: more is worth a line
_BENT = 1.5  # largest over least slope of a calibration between the trips
_NEAR_TRIP = 8  # counts between rest and a trip, under which noise may trip it
_COARSE = 64  # counts between the trips
_SLOW_PERIODS = 2000.0  # ticks in which a mode of the loop should have settled
_NOBODY: Mapping[str, float] = MappingProxyType({})


def review(rig: Rig, settings: ControllerSettings, *, parameters: Mapping[str, float] = _NOBODY) -> tuple[str, ...]:
    """Say what a rig's controller does only roughly, or what speaks against closing its loop: one line each with its
    remedy. `settings`: made by `ambid.acquisition.settings.controller_settings`; `parameters`: as `predicted`.
    """
    lines = [*_voltage(rig, settings), *_trips(rig, settings), *_tables(rig)]
    if not settings.drives:
        lines.append(
            f"at {settings.rate_hz:g} Hz the controller only samples: its output works at {output_rates()} only. "
            "Give such a daq.rate_hz to drive or levitate"
        )
    if settings.closed:
        lines += [*_rounding(rig, settings), *_slopes(rig, settings), *_stability(rig, settings, parameters)]
    elif has_position(rig):
        lines.append("the rig has no [loop] with a gain: it can sample and drive, not levitate. Add [loop]")
    return tuple(lines)


def _voltage(rig: Rig, settings: ControllerSettings) -> list[str]:
    """Say where the pulse widths given go beyond the limits of the loop."""
    if rig.limits is None or not all(map(math.isfinite, rig.limits.voltage)):
        return []
    volts = np.sort(scale_of(rig, "voltage").to_si([settings.duty_low, settings.duty_high]))
    low, high = rig.limits.voltage
    slack = 0.5 * abs(scale_of(rig, "voltage").slope(settings.duty_bias))
    if volts[0] >= low - slack and volts[1] <= high + slack:
        return []
    return [
        f"daq.duty allows {volts[0]:.4g} to {volts[1]:.4g} V, beyond loop.limits.voltage ({low:.4g} to {high:.4g} "
        "V): a simulation saturates earlier than the bench. Make them agree"
    ]


def _trips(rig: Rig, settings: ControllerSettings) -> list[str]:
    """Say where noise could trip at rest, and where the converter hardly sees the range it is to protect."""
    trips = [("current", settings.current_low, settings.current_rest, settings.current_high)]
    if has_position(rig):
        trips.append(("position", settings.position_low, settings.setpoint, settings.position_high))
    lines = []
    for role, low, rest, high in trips:
        near = min(rest - low, high - rest)
        # an end at the converter's own end cannot trip: nothing to be near to
        if near < _NEAR_TRIP and not (low == 0 and rest - low == near):
            lines.append(f"{role} at rest is {near} counts from its trip: noise may trip it. Widen daq.trip.{role}")
        if high - low < _COARSE:
            lines.append(
                f"{role} has {high - low} counts between its trips: too coarse for control and identification. Use "
                "a sensor or a divider that fills the converter"
            )
    return lines


def _tables(rig: Rig) -> list[str]:
    """Say where a table ends before the converter does: a sample beyond it makes the record unreadable."""
    roles = [role for role in ("position", "current") if role in model(rig.model).outputs]
    lines = []
    for role in roles:
        scale = scale_of(rig, role)
        if scale.ends is not None and (scale.ends[0] > 0 or scale.ends[1] < scale.top):
            lines.append(
                f"the table of channels.{role} covers {scale.ends[0]:g} to {scale.ends[1]:g} of 0 to {scale.top}"
                f" counts: a record beyond it cannot be read. Extend it, or set channels.{role}.extrapolate = true"
            )
    return lines


def _rounding(rig: Rig, settings: ControllerSettings) -> list[str]:
    exact = exact_gains(rig, (settings.duty_bias, settings.current_rest, settings.setpoint))
    lines = []
    for name, value in exact.items():
        error = abs(getattr(settings, name) - value) / abs(value) if value else 0.0
        if error > _ROUNDED:
            lines.append(
                f"loop.{name} is {value:.2f} steps of the controller, rounded by {error:.1%}. Use a sensor with "
                f"fewer counts, or a larger loop.{name}"
            )
    return lines


def _slopes(rig: Rig, settings: ControllerSettings) -> list[str]:
    """Say where a bent calibration gives the loop another gain than at rest."""
    lines = []
    for role, low, high in (
        ("position", settings.position_low, settings.position_high),
        ("current", settings.current_low, settings.current_high),
        ("voltage", settings.duty_low, settings.duty_high),
    ):
        least, most = scale_of(rig, role).slopes(low, high)
        if most > _BENT * least:
            lines.append(
                f"the slope of channels.{role}.table changes by a factor {most / least:.2g} over its range; the "
                "loop uses the gains at rest everywhere. Narrow the range, or make sure that the loop tolerates it"
            )
    return lines


def _stability(rig: Rig, settings: ControllerSettings, parameters: Mapping[str, float]) -> list[str]:
    """Say where the loop as the controller closes it does not hold the plant that the rig knows."""
    margins, whose = predicted(rig, settings, parameters)
    if margins is None:
        return [whose]
    if not margins.stable:
        try:
            _refuse(margins, whose, settings.rate_hz)
        except ModelError as failure:
            return [str(failure)]
    if margins.largest_pole > 1.0 - 1.0 / _SLOW_PERIODS:
        seconds = math.inf if margins.largest_pole >= 1.0 else -1.0 / math.log(margins.largest_pole) / settings.rate_hz
        return [
            f"the loop hardly damps {whose}: a mode takes {seconds:.2g} s to fall to a third (largest pole"
            f" {margins.largest_pole:.5f}). Raise loop.kd or loop.ki"
        ]
    return []


def predicted(
    rig: Rig, settings: ControllerSettings, parameters: Mapping[str, float] = _NOBODY
) -> tuple[LoopMargins | None, str]:
    """Return the margins of the loop that a controller will close, and whose plant it is; None and why where a value
    lacks. `parameters`: of the bench, SI, where the rig has no value of its own.
    """
    values = {p.name: p.value for p in rig.parameters if p.value is not None}
    lent = [p.name for p in rig.parameters if p.name not in values and p.name in parameters]
    missing = [p.name for p in rig.parameters if p.name not in values and p.name not in parameters]
    if missing:
        return None, (
            "the stability of the loop could not be checked, because the rig has no value for "
            f"{', '.join(missing)}. A rough value of each is enough"
        )
    whose = "the rig's own plant" + (f" with {', '.join(lent)} of the bench" if lent else "")
    try:
        numbers, loop = {**values, **{name: parameters[name] for name in lent}}, realised(settings, rig)
        return loop_margins(numbers, loop, settings.rate_hz, of=rig.model), whose
    except ModelError as failure:
        raise RigError(f"{who(rig)}: on {whose} {failure}") from None


def loop_on(
    rig: Rig, info: DeviceInfo, parameters: Mapping[str, float] = _NOBODY, *, delay: float | None = None
) -> tuple[LoopMargins | None, str]:
    """Predict, as `predicted`, the loop that a device closes on a plant of all these parameters (SI) or the rig's;
    `delay`: as identified, samples.
    """
    full = with_default_daq(rig) if info.kind in ("emulated", "simulated") else rig
    settings = controller_settings(full)
    if parameters:
        loop = realised(settings, full)
        loop = loop if delay is None else replace(loop, delay=delay)
        return loop_margins(parameters, loop, settings.rate_hz, of=rig.model), ""
    return predicted(full, settings, info.plant)


def refuse_unstable(rig: Rig, info: DeviceInfo) -> None:
    """Refuse to let a device close a loop that is predicted unstable."""
    margins, whose = loop_on(rig, info)
    if margins is not None:
        _refuse(margins, whose, info.rate_hz)


def _refuse(margins: LoopMargins, whose: str, rate_hz: float) -> None:
    where = f"{whose} at {rate_hz:g} Hz with the controller's delay of {LAG_S * rate_hz:.2g} samples"
    margins.refuse(where, remedy="Design [loop] for that rate and delay")
