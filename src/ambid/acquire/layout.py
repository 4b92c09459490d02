"""What a sample of the controller carries, column by column, in counts and in SI."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ambid.acquire.board import ADC_TOP, PWM_TOP
from ambid.acquire.device import Column
from ambid.acquire.scales import Scale, scale_of
from ambid.arrays import Array
from ambid.physics.models import model
from ambid.rig.rig import Daq, Rig

if TYPE_CHECKING:
    from ambid.acquire.settings import ControllerSettings


STREAM = ("position", "current", "third", "voltage", "excitation", "reference")
"""Roles of what a sample may carry, in the order of the bits of the stream mask and of a block's columns."""


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
    from ambid.rig.load import role_units

    third = _third_role(rig) if role == "extra" else None
    return role_units(model(rig.model)).get(third or role, "1")
