"""Instruments for a rig that has none: an emulated or simulated bench samples in counts, whatever its rig says.

Sensors are made up so that the limits of the loop fill four fifths of the converter, the power stage so that the limits
of the voltage are its ends. A rig for hardware has to say all this itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from ambid.acquisition.device import DeviceEvent
from ambid.acquisition.protocol.table import table
from ambid.acquisition.scales import ADC_TOP, PWM_TOP, nearest_rate, output_rates, who
from ambid.errors import RigError
from ambid.physics.linear_model import model
from ambid.physics.loop import UNLIMITED, Interval
from ambid.record.calibration import Calibration
from ambid.rig.rig import DAQ_RATE_HZ, Daq, Rig, RigChannel

SPAN = 1.25
"""Full scale of a sensor that is made up, over the limits of the loop."""

_UNITS = {"position": "m", "current": "A", "voltage": "V"}


def with_default_daq(rig: Rig) -> Rig:
    """Return a rig with ``[daq]`` and calibrations from counts; what it has already stays.

    `rig`: with limits of voltage, current and position where it has no calibrations. Returns for `controller_settings`,
    as an emulated or simulated bench uses it; `default_daq_notes` says what was made up.
    """
    return _filled(rig)[0]


def is_made_up(rig: Rig, full: Rig) -> bool:
    """Return whether `with_default_daq` made a calibration up: its counts mean nothing to anybody else."""
    return any(rig.channel(c.role).calibration is None and c.calibration is not None for c in full.channels)


def default_daq_notes(rig: Rig) -> tuple[str, ...]:
    """Return what `with_default_daq` makes up for a rig, one line each.

    `rig`: as for `with_default_daq`. Returns empty where the rig is complete.
    """
    return _filled(rig)[1]


def _filled(rig: Rig) -> tuple[Rig, tuple[str, ...]]:
    notes: list[str] = []
    plant = model(rig.model)
    channels = []
    for c in rig.channels:
        wanted = c.role in _UNITS and c.role in (*plant.inputs, *plant.outputs)
        channels.append(_calibrated(rig, c, notes) if wanted and c.calibration is None else c)
    return replace(rig, channels=tuple(channels), daq=rig.daq or _daq(rig, notes)), tuple(notes)


def _calibrated(rig: Rig, c: RigChannel, notes: list[str]) -> RigChannel:
    """Give a channel a straight line from counts; its column is then in counts, whatever unit it was read in."""
    low, high = _full_scale(rig, c.role)
    top = PWM_TOP if c.role == "voltage" else ADC_TOP
    of = Calibration(unit_in="1", unit_out=_UNITS[c.role], gain=(high - low) / top, offset=low)
    notes.append(f"{c.role}: 0 to {top} counts assumed to be {low:.4g} to {high:.4g} {_UNITS[c.role]}")
    return replace(c, calibration=of, unit=None)


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


def _daq(rig: Rig, notes: list[str]) -> Daq:
    wanted = rig.record.rate_hz or DAQ_RATE_HZ
    rate = nearest_rate(wanted, output=True)
    if math.isclose(rate, wanted, rel_tol=1e-9):
        return Daq(rate_hz=wanted)
    notes.append(f"rate: {rate:.6g} Hz, the nearest to {wanted:g} Hz at which the controller drives ({output_rates()})")
    return Daq(rate_hz=rate)


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
    """Write a fault for people: cause, what it means, where, and what to do.

    `fault`: of kind ``fault``. Returns one sentence with its remedy, without a full stop.
    """
    about = {entry.name: entry.about for entry in table().enums["cause"]}.get(fault.what)
    at = "" if fault.sample is None else f" at sample {fault.sample}"
    meaning = "" if about is None else f", {about}"
    remedy = _REMEDY.get(fault.what, "Remove the cause")
    lifted = (lift_ms + _AT_ONCE_MS) * rate_hz / 1e3  # a rate that is not known compares false
    if fault.what == "out_of_gap" and fault.sample is not None and fault.sample <= lifted:
        remedy = f"The rotor was not levitated within daq.lift_ms = {lift_ms}: raise it, or change the gains of [loop]"
    return f"{fault.what}{meaning}{at}. {remedy}"
