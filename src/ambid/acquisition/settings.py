"""From a rig in SI to the whole numbers that its controller is given, by the calibrations (slope at rest), and back.
What it cannot hold or protect is refused; what it holds only roughly is told by `ambid.acquisition.review`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ambid.acquisition.device import Column, DeviceEvent, DeviceInfo, LawTrial
from ambid.acquisition.law_words import LawWords, law_words
from ambid.acquisition.protocol import table
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
    nearest_rate,
    output_rates,
    period_of,
    scale_of,
    trip_counts,
    who,
)
from ambid.arrays import Array
from ambid.errors import DeviceError, ModelError, RigError
from ambid.physics.linear_model import model
from ambid.physics.loop import UNLIMITED, Interval, Loop
from ambid.record import Channel, Record
from ambid.record.calibration import Calibration
from ambid.rig import bench_record
from ambid.rig.rig import DAQ_RATE_HZ, Daq, Rig, RigChannel, role_units
from ambid.tracking.blocks import Block

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
    """Turn a rig with ``[daq]`` and calibrations from counts (`with_default_daq`) into what its controller is told:
    trips rounded inwards, all else to the nearest.
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
    """Return the ``[loop]`` of `new`, gains as a law of two states, to be tried by the controller of a rig that
    levitates. The bounds are half way from the set point to the trips.
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
    """Return the loop that the controller really closes after rounding, in SI, by the slopes of the rig's calibrations
    at rest; its delay is that of the controller itself.
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
    """Return a loop, gains or law, as the rig's controller holds it in fixed point; RigError where it does not fit. As
    it is without ``[daq]``, and of a rotor: the controller drives one axis.
    """
    if rig.daq is None or rig.rotor is not None:
        return loop
    full = replace(with_default_daq(rig), loop=loop)
    return replace(realised(controller_settings(full), full), delay=loop.delay)


def rest_of(rig: Rig) -> dict[str, float]:
    """Return the point about which the controller works: ``position`` (m), ``current`` (A), ``voltage`` (V)."""
    point = rig.operating_point
    current = point.get("current", 0.0)
    resistance = next((p.value for p in rig.parameters if p.name == "R"), None) or 0.0
    return {
        "position": point.get("position", 0.0),
        "current": current,
        "voltage": point.get("voltage", resistance * current),
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
    """Return ``kp``, ``ki``, ``kd``, ``kc`` in the steps of message ``gains``, not rounded, by the slopes of the
    calibrations at `rest`: counts of pulse width, current, position.
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
    """Return what a sample carries, in the order of the stream mask, in counts or SI. Spans are what the converter can
    give, for the voltage what the controller orders at most.
    """
    names = {c.column for c in rig.channels}
    result = []
    for role in carried(settings):
        name, column_role, span = _column(rig, settings, role)
        if role == "excitation" and name in names:
            name = "excitation_counts"
        scale = _si_scale(rig, settings, role) if si else None
        unit = "1"
        if scale is not None:
            low, high = sorted(scale.to_si(span).tolist())
            span, unit = (low, high), "V" if role == "excitation" else _unit(rig, column_role)
        result.append(Column(name=name, role=column_role, unit=unit, span=span))
    return tuple(result)


def in_si(rig: Rig, settings: ControllerSettings, values: ArrayLike) -> Array:
    """Return counts (n_samples, n_columns) in SI; columns without a calibration stay as they are."""
    out = np.array(values, dtype=np.float64)
    for k, role in enumerate(carried(settings)):
        scale = _si_scale(rig, settings, role)
        if scale is not None:
            out[:, k] = scale.to_si(out[:, k])
    return out


def stream_of(rig: Rig, daq: Daq) -> int:
    """Return the mask over `STREAM`: current, pulse width and excitation always, the rest where the rig has it."""
    wanted = {"current", "voltage", "excitation"} | ({"position"} if has_position(rig) else set())
    wanted |= {"third"} if daq.third is not None else set()
    wanted |= {"reference"} & {c.role for c in rig.channels}
    return sum(1 << bit for bit, role in enumerate(STREAM) if role in wanted)


def carried(settings: ControllerSettings) -> list[str]:
    """Return the roles of `STREAM` that a sample carries, in its order."""
    return [role for bit, role in enumerate(STREAM) if settings.stream >> bit & 1]


def has_position(rig: Rig) -> bool:
    """Return whether the rig's model has a position: false for a coil alone."""
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
        third = _third_role(rig)
        return scale_of(rig, third) if third is not None and rig.channel(third).calibration is not None else None
    if role == "excitation":
        slope = scale_of(rig, "voltage").slope(settings.duty_bias)
        ends = np.array([0.0, float(PWM_TOP)])
        return Scale(role=role, column=role, top=PWM_TOP, raw=ends, si=slope * ends)
    return scale_of(rig, "position" if role == "reference" else role)


def _unit(rig: Rig, role: str) -> str:
    third = _third_role(rig) if role == "extra" else None
    return role_units(model(rig.model)).get(third or role, "1")


SPAN = 1.25
"""Full scale of a sensor that is made up, over the limits of the loop."""

_UNITS = {"position": "m", "current": "A", "voltage": "V"}


def with_default_daq(rig: Rig) -> Rig:
    """Return a rig with ``[daq]`` and calibrations from counts for an emulated or simulated bench; what it has already
    stays. Needs limits of voltage, current and position where calibrations lack; `default_daq_notes` says what was made
    up.
    """
    return _filled(rig)[0]


def is_made_up(rig: Rig, full: Rig) -> bool:
    """Return whether `with_default_daq` made a calibration up: its counts mean nothing to anybody else."""
    return any(rig.channel(c.role).calibration is None and c.calibration is not None for c in full.channels)


def default_daq_notes(rig: Rig) -> tuple[str, ...]:
    """Return what `with_default_daq` makes up for a rig, one line each."""
    return _filled(rig)[1]


def _filled(rig: Rig) -> tuple[Rig, tuple[str, ...]]:
    notes: list[str] = []
    plant = model(rig.model)
    channels = []
    for c in rig.channels:
        wanted = c.role in _UNITS and c.role in (*plant.inputs, *plant.outputs)
        channels.append(_calibrated(rig, c, notes) if wanted and c.calibration is None else c)
    daq = rig.daq
    if daq is None:
        wanted_hz = rig.record.rate_hz or DAQ_RATE_HZ
        rate = nearest_rate(wanted_hz, output=True)
        possible = math.isclose(rate, wanted_hz, rel_tol=1e-9)
        daq = Daq(rate_hz=wanted_hz if possible else rate)
        if not possible:
            notes.append(
                f"rate: {rate:.6g} Hz, the nearest to {wanted_hz:g} Hz at which the controller drives"
                f" ({output_rates()})"
            )
    return replace(rig, channels=tuple(channels), daq=daq), tuple(notes)


def _calibrated(rig: Rig, c: RigChannel, notes: list[str]) -> RigChannel:
    """Give a channel a straight line from counts; its column is then in counts, whatever unit it was read in."""
    low, high = _full_scale(rig, c.role)
    top = PWM_TOP if c.role == "voltage" else ADC_TOP
    calibration = Calibration(unit_in="1", unit_out=_UNITS[c.role], gain=(high - low) / top, offset=low)
    notes.append(f"{c.role}: 0 to {top} counts assumed to be {low:.4g} to {high:.4g} {_UNITS[c.role]}")
    return replace(c, calibration=calibration, unit=None)


def _full_scale(rig: Rig, role: str) -> Interval:
    low, high = UNLIMITED if rig.limits is None else getattr(rig.limits, role)
    if not (math.isfinite(low) and math.isfinite(high)):
        raise RigError(
            f"{who(rig)}: channels.{role} has no calibration, and there is no loop.limits.{role} to derive one "
            "from. Give one of them"
        )
    if role == "voltage":
        return low, high
    middle, half = (low + high) / 2.0, SPAN * (high - low) / 2.0
    return middle - half, middle + half


_REMEDY: Mapping[str, str] = MappingProxyType(
    {
        "overrun": "Lower daq.rate_hz",
        "host_silent": "Free the machine, or raise daq.host_ms",
        "over_current": "Excite less, check the coil, or widen daq.trip.current if the coil can bear it",
        "out_of_gap": "Change the gains of [loop], excite less, or check sensor and daq.trip.position",
        "interlock": "Close the loop: cable, emergency stop",
        "line_break": "Check the cable",
        "self_test": "Correct what the self-test names",
        "watchdog": "Check the supply and the firmware build",
    }
)
"""What to do about each cause of `messages.toml`."""


_AT_ONCE_MS = 10  # after the time to lift


def fault_words(fault: DeviceEvent, *, rate_hz: float = math.nan, lift_ms: int = 0) -> str:
    """Write a fault for people, one sentence without full stop: cause, what it means, where, and the remedy."""
    about = {entry.name: entry.about for entry in table().enums["cause"]}.get(fault.what)
    at = "" if fault.sample is None else f" at sample {fault.sample}"
    meaning = "" if about is None else f", {about}"
    remedy = _REMEDY.get(fault.what, "Remove the cause")
    lifted = (lift_ms + _AT_ONCE_MS) * rate_hz / 1e3  # a rate that is not known compares false
    if fault.what == "out_of_gap" and fault.sample is not None and fault.sample <= lifted:
        remedy = f"The rotor was not levitated within daq.lift_ms = {lift_ms}: raise it, or change the gains of [loop]"
    return f"{fault.what}{meaning}{at}. {remedy}"


def as_record(values: Array, columns: Sequence[Column], rate_hz: float, *, start_s: float = 0.0) -> Record:
    """Return samples (n_samples, n_columns), in the columns' units as blocks hold them, as a record, one channel per
    column; `start_s`: time of the first, s.
    """
    channels = tuple(Channel(name=c.name, unit=c.unit, values=values[:, k]) for k, c in enumerate(columns))
    return Record(channels=channels, rate_hz=rate_hz, start_s=start_s, provenance=MappingProxyType({}), history=())


class BenchView:
    """Turns raw blocks of an opened device into blocks of the named `roles`, SI (`units`), in their order."""

    def __init__(self, info: DeviceInfo, rig: Rig, roles: Sequence[str]) -> None:
        self.rate_hz = info.rate_hz
        self._columns, self._rig = info.columns, rig
        late = [c.role for c in rig.channels if c.delay not in ("auto", 0) and c.role not in rig.plant.inputs]
        if late:
            raise RigError(
                f"channels.{late[0]}.delay is taken back in a whole record only; samples of a device come in blocks. "
                "Remove it for live work"
            )
        if rig.measured_input:
            raise RigError(
                "channels.current is measured, and taken with the sample after it, in a whole record only; samples of "
                "a device come in blocks. Name it channels.command where it is one, or give the voltage too"
            )
        spare = [0.0 if c.span is None else (c.span[0] + c.span[1]) / 2.0 for c in info.columns]
        record = self.record(np.array([spare]))  # so that what does not fit is told at once
        self.units = {role: record.channel(role).unit for role in roles}
        self._lines = self._linear()

    def block(self, raw: Block) -> Block:
        """Return a block (n_samples, n_roles) in SI, in the order of the roles, of (n_samples, n_columns) in the
        device's units.
        """
        if self._lines is None:
            record = self.record(raw.values)
            values = np.column_stack([record[role].values for role in self.units])
        else:
            columns, gain, offset = self._lines
            values = np.ascontiguousarray(gain * raw.values[:, columns] + offset)
        return Block(first=raw.first, time_s=raw.time_s, values=values)

    def _linear(self) -> tuple[NDArray[np.int64], Array, Array] | None:
        """Return columns, gains and offsets of the roles, ten times faster than a record; None where a table or a
        declared unit asks for more.
        """
        columns = {c.name: k for k, c in enumerate(self._columns)}
        channels = {c.role: c for c in self._rig.channels}
        lines = []
        for c in (channels[role] for role in self.units):
            k, calibration = columns[c.column], c.calibration
            if c.unit not in (None, self._columns[k].unit) or (calibration is not None and calibration.raw is not None):
                return None
            lines.append((k, 1.0, 0.0) if calibration is None else (k, calibration.gain, calibration.offset))
        k, gain, offset = np.array(lines).T
        return k.astype(int), gain, offset

    def record(self, values: Array, *, start_s: float = 0.0) -> Record:
        """Return samples (n_samples, n_columns), in the device's units, as a record of the rig's channels named by
        role, in SI; `start_s`: time of the first, s.
        """
        return bench_record(as_record(values, self._columns, self.rate_hz, start_s=start_s), self._rig)
