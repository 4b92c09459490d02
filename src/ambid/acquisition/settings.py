"""From a rig in SI to the whole numbers that its controller is given, and back.

Gains, set point, limits and trips go through the calibrations of the channels; a bent calibration is taken by its slope
at rest. What a controller cannot hold, or could not protect, is refused; what it holds only roughly is told by
`ambid.acquisition.review`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ambid.acquisition.device import Column, LawTrial
from ambid.acquisition.law_words import LawWords, law_words
from ambid.acquisition.protocol.table import table
from ambid.acquisition.scales import (
    ADC_TOP,
    BYTE_BITS,
    LAG_S,
    LARGEST_GAIN,
    PWM_HZ,
    PWM_TOP,
    Scale,
    count_inside,
    drives,
    duty_off,
    duty_range,
    period_of,
    scale_of,
    trip_counts,
    who,
)
from ambid.arrays import Array
from ambid.errors import DeviceError, ModelError, RigError
from ambid.physics.linear_model import model
from ambid.physics.loop import Loop
from ambid.rig.rig import Daq, Rig

GAIN_BITS, INTEGRAL_BITS, POLE_BITS = 12, 16, 16
"""Binary places of kp, kd and kc, of ki, and of the pole, as the message ``gains`` has them."""

FEWEST_STEPS = 3  # of a gain: coarser than that it is another gain
_FAST_LAWS = ((9, 3), (10, 4))  # ticks of fewer periods, and the states that a law may have there
_FRAME_BYTES = 8  # of a sample on the wire beside its values: code, tick, state, CRC, COBS, end
STREAM = ("position", "current", "third", "voltage", "excitation", "reference")
"""Roles of what a sample may carry, in the order of the bits of the stream mask and of a block's columns."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerSettings:
    """What the messages ``configure``, ``limits`` and ``gains`` want, under the names of their fields."""

    period: int  # tick in periods of the pulse width modulation; mask of what a sample carries
    stream: int
    position_low: int  # trips, counts
    position_high: int
    current_low: int
    current_high: int
    duty_low: int  # pulse widths, counts
    duty_high: int
    duty_off: int
    host_ms: int  # silence of the host, time to lift, ms
    lift_ms: int
    kp: int = 0  # gains in the fixed point of the message ``gains``
    ki: int = 0
    kd: int = 0
    pole: int = 0
    kc: int = 0
    setpoint: int = 0  # rest, counts
    current_rest: int = 0
    duty_bias: int = 0
    law: LawWords | None = None  # what runs instead of the gains, which are then 0; messages ``law`` and ``arm``

    @property
    def rate_hz(self) -> float:
        """Ticks in one second, exactly as the controller makes them, Hz."""
        return PWM_HZ / self.period

    @property
    def drives(self) -> bool:
        """True at a rate at which the output may be on; else the controller only samples."""
        return drives(self.period)

    @property
    def closed(self) -> bool:
        """True where a law or any gain acts: without one there is nothing to levitate with."""
        return self.law is not None or any((self.kp, self.ki, self.kd, self.kc))

    def fields(self, message: str) -> dict[str, int]:
        """Return the fields of the message ``configure``, ``limits`` or ``gains``, without its number."""
        return {f.name: getattr(self, f.name) for f in table().messages[message].fixed if f.name != "id"}


def controller_settings(rig: Rig) -> ControllerSettings:
    """Turn a rig into what its controller is told.

    `rig`: with ``[daq]`` and calibrations from counts; `ambid.acquisition.default_daq.with_default_daq` makes them up.
    Returns each within what the controller takes. Trips are rounded inwards, all else to the nearest.
    """
    daq = _daq(rig)
    voltage, current = scale_of(rig, "voltage"), scale_of(rig, "current")
    position = scale_of(rig, "position") if has_position(rig) else None
    rest = rest_of(rig)
    duty_low, duty_high = duty_range(rig, daq, voltage)
    off = duty_off(rig, daq, voltage)
    current_low, current_high = trip_counts(rig, current)
    position_low, position_high = trip_counts(rig, position) if position else (0, ADC_TOP)
    bias = count_inside(rig, voltage, rest["voltage"], duty_low, duty_high, "pulse widths allowed (daq.duty)")
    current_rest = count_inside(rig, current, rest["current"], current_low, current_high, "trips")
    setpoint = (
        0 if position is None else count_inside(rig, position, rest["position"], position_low, position_high, "trips")
    )
    settings = ControllerSettings(
        period=_period(rig, daq),
        stream=stream_of(rig, daq),
        position_low=position_low,
        position_high=position_high,
        current_low=current_low,
        current_high=current_high,
        duty_low=duty_low,
        duty_high=duty_high,
        duty_off=off,
        host_ms=daq.host_ms,
        lift_ms=daq.lift_ms,
        setpoint=setpoint,
        current_rest=current_rest,
        duty_bias=bias,
        law=_law(rig, (bias, current_rest, setpoint)),
        **_gains(rig, (bias, current_rest, setpoint)),
    )
    _check_line(rig, daq, settings)
    return settings


def law_trial(rig: Rig, new: Rig) -> LawTrial:
    """Return another rig's loop as a law to be tried by the controller of a rig that levitates.

    `rig`: with ``[daq]`` and calibrations; `new`: whose ``[loop]`` is tried, gains as a law of two states. The
    bounds are half way from the set point to the trips.
    """
    if new.loop is None or not new.loop.closed:
        raise RigError(f"{who(new)} has no [loop] with a gain; there is nothing to arm. Give it one")
    if new.rotor is not None:
        raise RigError(f"{who(new)} is of a rotor on many axes; the controller closes one loop. Arm a rig of one axis")
    old = controller_settings(rig)
    law = new.loop.as_law(old.rate_hz)
    settings = controller_settings(replace(rig, loop=replace(new.loop.opened(), law=law), source=new.source))
    assert settings.law is not None
    return LawTrial(
        law=settings.law,
        low=(old.setpoint + old.position_low) // 2,
        high=(old.setpoint + old.position_high + 1) // 2,
    )


def realised(settings: ControllerSettings, rig: Rig) -> Loop:
    """Return the loop that the controller really closes, after rounding, in SI.

    `settings`: what it is told; `rig`: the rig that they were made from, for its calibrations. Returns in SI, by the
    slopes of the calibrations at rest; its delay is that of the controller itself.
    """
    voltage = scale_of(rig, "voltage").slope(settings.duty_bias)
    current = scale_of(rig, "current").slope(settings.current_rest)
    position = scale_of(rig, "position").slope(settings.setpoint) if has_position(rig) else math.inf
    if settings.law is not None:
        law = settings.law.law(settings.rate_hz).in_units((1.0 / position, 1.0 / current), voltage)
        return Loop(law=law, delay=LAG_S * settings.rate_hz)
    period, pole = 1.0 / settings.rate_hz, settings.pole / 2.0**POLE_BITS
    tau = period * pole / (1.0 - pole)
    per_count = voltage / position / 2.0**GAIN_BITS
    return Loop(
        kp=settings.kp * per_count,
        ki=settings.ki * voltage / position / 2.0**INTEGRAL_BITS / period,
        kd=settings.kd * per_count * (tau + period),
        kc=settings.kc * voltage / current / 2.0**GAIN_BITS,
        derivative_cutoff_hz=1.0 / (2.0 * math.pi * tau) if tau else math.inf,
        delay=LAG_S * settings.rate_hz,
    )


def held_by(rig: Rig, loop: Loop) -> Loop:
    """Return a loop, gains or law, as the rig's controller holds it in fixed point; RigError where it does not fit.

    As it is where there is no ``[daq]``, and of a rotor: the controller drives one axis.
    """
    if rig.daq is None or rig.rotor is not None:
        return loop
    from ambid.acquisition.default_daq import with_default_daq

    full = replace(with_default_daq(rig), loop=loop)
    return replace(realised(controller_settings(full), full), delay=loop.delay)


def rest_of(rig: Rig) -> dict[str, float]:
    """Return the point about which the controller works.

    Returns ``position`` (m), ``current`` (A), ``voltage`` (V).
    """
    given = rig.operating_point
    current = given.get("current", 0.0)
    resistance = next((p.value for p in rig.parameters if p.name == "R"), None) or 0.0
    return {
        "position": given.get("position", 0.0),
        "current": current,
        "voltage": given.get("voltage", resistance * current),
    }


def _period(rig: Rig, daq: Daq) -> int:
    try:
        return period_of(daq.rate_hz)
    except DeviceError as failure:
        raise DeviceError(f"{who(rig)}: {failure}") from None


def _daq(rig: Rig) -> Daq:
    plant = model(rig.model)
    if plant.inputs != ("voltage",) or "current" not in plant.outputs:
        raise RigError(
            f"{who(rig)}: model {rig.model!r} is not a coil driven by a voltage; the controller drives one and"
            " samples its current. Use model one-axis or coil"
        )
    if rig.daq is None:
        raise RigError(
            f"{who(rig)} has no section [daq]; the controller needs its rate, pulse widths and trips. Add [daq] "
            "(docs/rig.md)"
        )
    return rig.daq


def exact_gains(rig: Rig, rest: tuple[int, int, int]) -> dict[str, float]:
    """Return the loop's gains in steps of the controller, not rounded, by the slopes of the calibrations at rest.

    `rig`: with a loop, ``[daq]`` and calibrations; `rest`: counts at rest: pulse width, current, position. Returns
    ``kp``, ``ki``, ``kd``, ``kc`` in the units of the message ``gains``.
    """
    assert rig.loop is not None
    assert rig.daq is not None
    loop, period = rig.loop, 1.0 / rig.daq.rate_hz
    volts = scale_of(rig, "voltage").slope(rest[0])
    amperes = scale_of(rig, "current").slope(rest[1]) / volts
    metres = scale_of(rig, "position").slope(rest[2]) / volts
    return {
        "kp": loop.kp * metres * 2.0**GAIN_BITS,
        "ki": loop.ki * period * metres * 2.0**INTEGRAL_BITS,
        "kd": loop.kd * metres / (loop.filter_s + period) * 2.0**GAIN_BITS,
        "kc": loop.kc * amperes * 2.0**GAIN_BITS,
    }


def _law(rig: Rig, rest: tuple[int, int, int]) -> LawWords | None:
    """Return the words of the loop's state-space law, by the slopes of the calibrations at rest."""
    if rig.loop is None or rig.loop.law is None or not has_position(rig):
        return None
    assert rig.daq is not None
    law = rig.loop.law
    if law.D.shape == (1, 1):  # no current is fed back
        law = replace(law, B=np.pad(law.B, ((0, 0), (0, 1))), D=np.pad(law.D, ((0, 0), (0, 1))))
    volts, amperes, metres = (
        scale_of(rig, r).slope(at) for r, at in zip(("voltage", "current", "position"), rest, strict=True)
    )
    period = _period(rig, rig.daq)
    most = next((n for below, n in _FAST_LAWS if period < below), law.order)
    if law.order > most:
        raise RigError(
            f"{who(rig)}: loop.A has {law.order} states; at {PWM_HZ / period:.5g} Hz the controller has time for"
            f" {most}."
            " Lower daq.rate_hz and design the law for it, or reduce the law's order"
        )
    try:
        law.check(1, 2, PWM_HZ / period)
        return law_words(law.in_units((metres, amperes), 1.0 / volts))
    except (ModelError, RigError) as failure:
        raise RigError(f"{who(rig)}: {failure}") from None


def _gains(rig: Rig, rest: tuple[int, int, int]) -> Mapping[str, int]:
    """Return the loop's gains in fixed point."""
    loop = rig.loop
    if loop is None or loop.law is not None or not loop.closed or not has_position(rig):
        return {}
    assert rig.daq is not None
    period, tau = 1.0 / rig.daq.rate_hz, loop.filter_s
    pole = round(tau / (tau + period) * 2**POLE_BITS)
    if pole >= 2**POLE_BITS:
        raise RigError(
            f"{who(rig)}: loop.derivative_cutoff_hz is {loop.derivative_cutoff_hz:.4g} Hz, too low for a tick of"
            f" {period:.4g} s. Give at least {rig.daq.rate_hz / (2 * math.pi * 2**POLE_BITS):.4g} Hz"
        )
    rounded = {name: _gain(rig, name, value) for name, value in exact_gains(rig, rest).items()}
    return {**rounded, "pole": pole if loop.kd else 0}


def _gain(rig: Rig, name: str, value: float) -> int:
    if abs(value) > LARGEST_GAIN:
        raise RigError(
            f"{who(rig)}: loop.{name} is {value:.4g} steps of the controller, whose limit is {LARGEST_GAIN}: one "
            "count of the sensor would demand too much. Use a sensor of a smaller range, reduce that gain, or "
            "correct the calibrations"
        )
    steps = round(value)
    if value != 0.0 and abs(steps) < FEWEST_STEPS:
        raise RigError(
            f"{who(rig)}: loop.{name} is {value:.2g} steps of the controller, fewer than {FEWEST_STEPS}: too "
            f"small to be represented. Raise loop.{name}, set it to 0, or use a sensor with fewer counts"
        )
    return steps


def _check_line(rig: Rig, daq: Daq, settings: ControllerSettings) -> None:
    bits = BYTE_BITS * (_FRAME_BYTES + 2 * len(carried(settings)))
    if bits * settings.rate_hz > daq.baud:
        raise RigError(
            f"{who(rig)}: {settings.rate_hz:g} samples per second of {bits} bit times each exceed daq.baud = "
            f"{daq.baud} bit/s, which carries {daq.baud / bits:.0f}. Lower daq.rate_hz"
        )


def columns(rig: Rig, settings: ControllerSettings, *, si: bool = False) -> tuple[Column, ...]:
    """Return what a sample carries, column by column.

    `rig`: names the columns; `settings`: which there are; `si`: as `in_si` gives them instead of in counts. Returns in
    the order of the stream mask; spans are what the converter can give, for the voltage what the controller orders at
    most.
    """
    taken = {c.column for c in rig.channels}
    found = []
    for role in carried(settings):
        name, kept, span = _column(rig, settings, role)
        if role == "excitation" and name in taken:
            name = "excitation_counts"
        scale = _si_scale(rig, settings, role) if si else None
        unit = "1"
        if scale is not None:
            low, high = sorted(scale.to_si(span).tolist())
            span, unit = (low, high), "V" if role == "excitation" else _unit(rig, kept)
        found.append(Column(name=name, role=kept, unit=unit, span=span))
    return tuple(found)


def in_si(rig: Rig, settings: ControllerSettings, values: ArrayLike) -> Array:
    """Turn samples in counts into SI.

    `rig`: with calibrations; `settings`: what a sample carries; `values`: (n_samples, n_columns), counts, as the
    controller sends them. Returns (n_samples, n_columns), SI, columns without a calibration stay as they are.
    """
    out = np.array(values, dtype=np.float64)
    for k, role in enumerate(carried(settings)):
        scale = _si_scale(rig, settings, role)
        if scale is not None:
            out[:, k] = scale.to_si(out[:, k])
    return out


def stream_of(rig: Rig, daq: Daq) -> int:
    """Return the stream mask: current, pulse width and excitation always, the rest where the rig has it.

    `rig`: with channel ``reference`` or not; `daq`: with a third input or not. Returns one bit for each of `STREAM`.
    """
    wanted = {"current", "voltage", "excitation"} | ({"position"} if has_position(rig) else set())
    wanted |= {"third"} if daq.third is not None else set()
    wanted |= {"reference"} & {c.role for c in rig.channels}
    return sum(1 << bit for bit, role in enumerate(STREAM) if role in wanted)


def carried(settings: ControllerSettings) -> list[str]:
    """Return the roles of what a sample carries.

    `settings`: with the stream mask. Returns of `STREAM`, in its order.
    """
    return [role for bit, role in enumerate(STREAM) if settings.stream >> bit & 1]


def has_position(rig: Rig) -> bool:
    """Return whether the rig's model has a position.

    `rig`: any. Returns false for a coil alone.
    """
    return "position" in model(rig.model).outputs


def _third_role(rig: Rig) -> str | None:
    """Role whose column the third input is, where the rig has one."""
    third = rig.daq.third if rig.daq else None
    return next((c.role for c in rig.channels if third is not None and c.column == third), None)


def _column(rig: Rig, settings: ControllerSettings, role: str) -> tuple[str, str, tuple[float, float]]:
    """Return name, role and span of what a sample carries, in counts."""
    analog = (0.0, float(ADC_TOP))
    if role == "third":
        assert rig.daq is not None
        return rig.daq.third or "third", "extra", analog
    if role == "excitation":
        return "excitation", role, (-float(PWM_TOP), float(PWM_TOP))
    span = (float(settings.duty_low), float(settings.duty_high)) if role == "voltage" else analog
    return rig.channel(role).column, role, span


def _si_scale(rig: Rig, settings: ControllerSettings, role: str) -> Scale | None:
    """Return the scale of a column, None where its counts have no meaning in SI."""
    if role == "third":
        of = _third_role(rig)
        return scale_of(rig, of) if of is not None and rig.channel(of).calibration is not None else None
    if role == "excitation":
        slope = scale_of(rig, "voltage").slope(settings.duty_bias)
        ends = np.array([0.0, float(PWM_TOP)])
        return Scale(role=role, column=role, top=PWM_TOP, raw=ends, si=slope * ends)
    return scale_of(rig, "position" if role == "reference" else role)


def _unit(rig: Rig, role: str) -> str:
    from ambid.rig.rig import role_units

    third = _third_role(rig) if role == "extra" else None
    return role_units(model(rig.model)).get(third or role, "1")
