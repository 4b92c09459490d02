"""A record with several position sensors, given one position: fit for identification, with its history."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.record.record import Channel, Record, Step
from ambid.recursive.fusion.fusion import SensorFusion
from ambid.recursive.fusion.motion import Motion
from ambid.recursive.fusion.sensor import FusedSensor
from ambid.recursive.lines import Event


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FusedRecord:
    """A record with its fused position, and what was found on the way."""

    record: Record  # with the channel ``position`` in m
    sd: Array  # (n_samples,), standard deviation of each position, m
    events: tuple[Event, ...]  # exclusions, returns and doubts, with time in s of record
    fusion: SensorFusion  # as it was after the last sample


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

    `motion`: at the rate of the record; `inputs`: channels that are the inputs of the motion, such as ``current``;
    `name`: of the new channel; `temperature_rate`, `false_alarms_per_hour`, `restore_s`: as of `SensorFusion`.
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
