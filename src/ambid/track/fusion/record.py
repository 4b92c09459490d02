"""A record with several position sensors, given one position: fit for identification, with its history."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.errors import EstimationError
from ambid.record.record import Channel, Record, Step
from ambid.track.fusion.fusion import SensorFusion
from ambid.track.fusion.motion import Motion
from ambid.track.fusion.sensor import FusedSensor
from ambid.track.lines import Event

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FusedRecord:
    """A record with its fused position, and what was found on the way.

    Attributes
    ----------
    record : Record
        With the channel ``position`` in m.
    sd : ndarray, shape (n_samples,)
        Standard deviation of each position, m.
    events : tuple of Event
        Exclusions, returns and doubts, with time in s of record.
    fusion : SensorFusion
        As it was after the last sample.
    """

    record: Record
    sd: Array
    events: tuple[Event, ...]
    fusion: SensorFusion


def fuse_record(
    record: Record,
    sensors: Sequence[FusedSensor],
    *,
    motion: Motion,
    inputs: Sequence[str] = (),
    name: str = "position",
    give: Literal["filtered", "instant"] = "instant",
    temperature_rate: float = 0.0,
    false_alarms_per_hour: float = 0.1,
    restore_s: float = 0.25,
) -> FusedRecord:
    """Add the fused position of several sensors to a record.

    By default each position is made of the values of its own instant, less the offsets: a filtered position has the
    filter's dynamics in it, which identification would take for the bearing's.

    Parameters
    ----------
    record : Record
        Holds a channel of the name of each sensor, in the unit that the sensor's numbers are in (SI).
    sensors : sequence of FusedSensor
    motion : Motion
        At the rate of the record.
    inputs : sequence of str
        Channels that are the inputs of the motion, such as ``current``.
    name : str
        Of the new channel.
    give : {"filtered", "instant"}
    temperature_rate, false_alarms_per_hour, restore_s : float
        As of `SensorFusion`.

    Returns
    -------
    FusedRecord

    Raises
    ------
    RecordError
        If a channel is not there.
    EstimationError
        If there is a channel `name` already, or settings do not fit.
    """
    if name in record.names:
        raise EstimationError(
            f"fuse_record: the record has a channel {name!r} already; nothing is overwritten. Give another name"
        )
    fusion = SensorFusion(
        record.rate_hz,
        sensors,
        motion=motion,
        temperature_rate=temperature_rate,
        false_alarms_per_hour=false_alarms_per_hour,
        restore_s=restore_s,
        give=give,
        start_s=record.start_s,
    )
    values = np.column_stack([record[s.name] for s in fusion.sensors])
    given = np.column_stack([record[i] for i in inputs]) if inputs else None
    out = fusion.update(values, given)
    step = Step(
        name="fuse",
        settings={
            "sensors": list(fusion.names),
            "channel": name,
            "give": give,
            "missing_samples": int(np.count_nonzero(np.isnan(out[:, 0]))),
            "sd_at_end": float(out[-1, 1]),
            "events": [f"{e.t:.6g} s {e.kind} {e.parameter or ''}: {e.why}" for e in fusion.events],
        },
    )
    position = Channel(name=name, unit="m", values=out[:, 0].copy())
    return FusedRecord(
        record=record.with_step(step, channels=(*record.channels, position)),
        sd=out[:, 1].copy(),
        events=fusion.events,
        fusion=fusion,
    )
