"""The section ``[daq]`` of a rig file: from its entries to what the controller is to hold, checked against the rig."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

from ambid.errors import RigError
from ambid.physics.linear_model import LinearModel
from ambid.physics.loop import UNLIMITED, Interval, Limits
from ambid.rig.rig import DAQ_RATE_HZ, Daq, RigChannel

if TYPE_CHECKING:
    from ambid.rig.schema import DaqEntry

_BAUD = (300, 12_000_000)
_HOST_MS = (20, 2000)
_LIFT_MS = (0, 2000)


def daq_of(
    entry: DaqEntry,
    *,
    channels: Sequence[RigChannel],
    plant: LinearModel,
    limits: Limits | None,
    record_rate_hz: float | None,
    where: str,
) -> Daq:
    """Check the entries of ``[daq]`` against each other and the rest of the rig.

    `entry`: as written; `channels`: of the rig; `plant`: its model; `limits`: its limits, SI; `record_rate_hz`:
    ``record.rate_hz``, the default of the rate, Hz; `where`: the file, for messages. Returns all numbers SI, counts or
    ms.
    """
    place = f"{where}: daq"
    if entry.duty is not None and not entry.duty[0] < entry.duty[1]:
        raise RigError(f"{place}.duty is {list(entry.duty)}; the lower comes first. Swap or correct them")
    if not _BAUD[0] <= entry.baud <= _BAUD[1]:
        raise RigError(
            f"{place}.baud is {entry.baud}; a serial line goes at {_BAUD[0]} to {_BAUD[1]} bit/s."
            " Give the firmware's, 1000000"
        )
    for name, (low, high) in (("host_ms", _HOST_MS), ("lift_ms", _LIFT_MS)):
        value = getattr(entry, name)
        if not low <= value <= high:
            raise RigError(f"{place}.{name} is {value}; the controller takes {low} to {high} ms. Correct it")
    _check_third(entry.third, channels, plant, place)
    return Daq(
        rate_hz=entry.rate_hz or record_rate_hz or DAQ_RATE_HZ,
        baud=entry.baud,
        duty=entry.duty,
        duty_off=entry.duty_off,
        host_ms=entry.host_ms,
        lift_ms=entry.lift_ms,
        third=entry.third,
        bench=entry.bench,
        position_trip=_trip("position", entry.trip.position, limits, plant, place),
        current_trip=_trip("current", entry.trip.current, limits, plant, place),
    )


def _check_third(third: str | None, channels: Sequence[RigChannel], plant: LinearModel, place: str) -> None:
    """Refuse a third input under the name of a column that comes from elsewhere; speed or angle may come from it."""
    elsewhere = {*plant.inputs, *plant.outputs, "reference"}
    for c in channels:
        if c.column == third and c.role in elsewhere:
            raise RigError(
                f"{place}.third is {third!r}, the column of channels.{c.role}, which comes otherwise. Give another name"
            )


def _trip(
    role: Literal["position", "current"],
    given: float | Interval | None,
    limits: Limits | None,
    plant: LinearModel,
    place: str,
) -> Interval | None:
    """Return the interval of a trip, which has to lie inside the limits of the bench."""
    if given is None:
        return None
    if role not in plant.outputs and role not in plant.inputs:
        raise RigError(f"{place}.trip.{role} is given; model {plant.name!r} has no {role}. Remove it")
    low, high = given if isinstance(given, tuple) else (-given, given)
    if not low < high:
        raise RigError(f"{place}.trip.{role} is [{low}, {high}]; the lower comes first. Swap or correct them")
    least, most = UNLIMITED if limits is None else getattr(limits, role)
    if low < least or high > most:
        raise RigError(
            f"{place}.trip.{role} is [{low}, {high}], outside loop.limits.{role} = [{least}, {most}]; the controller"
            " must trip before the bench is at its limit. Narrow the trip, or correct the limit"
        )
    return low, high
