"""Two or more sensors of one position made into one channel, before a record goes through its rig.

Noise, offsets and pace come from the record; `ambid.recursive.fusion` leaves out a sensor that fails. What it decided
is in the record's history, from where a track takes it.
"""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np

from ambid.arrays import Array
from ambid.errors import RecordError
from ambid.estimation.estimate import fields_json
from ambid.record import Channel, Record, Step
from ambid.recursive.fusion import FusedSensor, SensorFusion
from ambid.recursive.lines import Event
from ambid.rig import Rig, RigChannel
from ambid.rig.load import calibrated_column

FUSED = "fuse"
_FIRST_S = 0.1  # of a record, from which offsets are taken
_LAGS = tuple(1 << k for k in range(10))  # samples over which the motion is looked at
_SHOWN = 4.0  # times the noise: a curvature of the path that is motion


def fused_record(record: Record, rig: Rig) -> Record:
    """Return a record with one column for each channel of the rig that names sensors, in its unit, those taken out."""
    for c in rig.channels:
        if c.sensors and c.column not in record.names:
            record = _fused(record, c, rig.plant.units[c.role])
    return record


def sensor_events(record: Record) -> tuple[Event, ...]:
    """Return what the fusion of a record's sensors decided: ``excluded``, ``restored`` and ``disturbed``."""
    steps = [step for step in record.history if step.name == FUSED]
    return tuple(Event(**e) for step in steps for e in step.settings["events"])  # type: ignore[attr-defined]


def _fused(record: Record, c: RigChannel, unit: str) -> Record:
    columns = [calibrated_column(record, s, unit) for s in c.sensors]
    values = np.column_stack([x.values for x in columns])
    head = values[: max(2, round(_FIRST_S * record.rate_hz))]
    if not np.isfinite(head).any(axis=0).all():
        raise RecordError(
            f"a sensor of channels.{c.role} gives nothing in the first {_FIRST_S:g} s, from which its offset is taken. "
            "Begin later, or omit the sensor"
        )
    offsets = np.nanmedian(head, axis=0)
    middle = float(np.median(offsets))
    noise, steps = np.array([_noise(x) for x in values.T]), [_resolution(x) for x in values.T]
    fusion = SensorFusion(
        record.rate_hz,
        [
            # a zero that walks by its noise in a second is no fault
            FusedSensor(
                name=s.column, gain=1.0, noise_sd=sd, resolution=step, offset=offset, offset_sd=sd, drift_rate=sd
            )
            for s, sd, step, offset in zip(c.sensors, noise.tolist(), steps, offsets.tolist(), strict=True)
        ],
        q=_pace(np.nanmedian(values - offsets, axis=1), noise, record.rate_hz),
        start_s=record.start_s,
    )
    path = fusion.update(values)[:, 0] + middle
    events = [{**fields_json(e), "values": dict(e.values)} for e in fusion.events]
    names = tuple(s.column for s in c.sensors)
    step = Step(name=FUSED, settings=MappingProxyType({"columns": names, "into": c.column, "events": events}))
    others = (x for x in record.channels if x.name not in names)
    channels = (*others, Channel(name=c.column, unit=unit, values=path))
    return replace(record, channels=channels, history=(*record.history, step))


def _noise(x: Array) -> float:
    """Standard deviation of a sensor's noise from third differences (motion is small), rounding included; without a
    grid, stretches without differences are of a stopped sensor.
    """
    third = np.diff(x, 3)
    third = np.abs(third[np.isfinite(third)])
    third = third if _resolution(x) else third[third > 0.0]
    sd = float(np.median(third)) / (0.6745 * np.sqrt(20.0)) if third.size else 0.0
    return max(sd, 0.29 * _resolution(x), 1e-15)


def _resolution(x: Array) -> float:
    """Smallest step between values, where they are on a grid; 0 where they are continuous."""
    levels = np.unique(x[np.isfinite(x)])
    return float(np.diff(levels).min()) if 1 < levels.size < 0.2 * x.size else 0.0


def _pace(x: Array, noise: Array, rate_hz: float) -> float:
    """Intensity of white acceleration that bends the path as much as it is bent over any lag, (m/s²)² s."""
    known = np.where(np.isfinite(x), x, 0.0)
    floor = 6.0 * float(np.min(noise)) ** 2
    paces = [floor * rate_hz**3 * 1e-6]
    for lag in _LAGS:
        if 2 * lag < x.size:
            bend = float(np.mean((known[2 * lag :] - 2.0 * known[lag:-lag] + known[: -2 * lag]) ** 2)) - floor
            paces.append(1.5 * bend * (rate_hz / lag) ** 3 if bend > _SHOWN * floor else 0.0)
    return max(paces)
