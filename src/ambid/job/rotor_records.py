"""Records of one rotor, each with the speed at which it was taken; one bearing may be excited at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isfinite, pi
from typing import Unpack

import numpy as np

from ambid.errors import EstimationError, RecordError, counted
from ambid.estimation.progress import Tick
from ambid.job.data import Reading, Source, load_bench, overlap
from ambid.record import Record
from ambid.rig import Rig
from ambid.settings.caller import setting

_TURNING = ("angle", "speed", "tacho")
_SAME_RATE = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RotorRecord:
    """A record of a rotor."""

    bench: Record  # channels named by role
    speed: float | None  # rad/s; None: its own channels or the rig say it
    warnings: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The name of its file."""
        return str(self.bench.provenance.get("file") or "record")


def read_records(
    records: Sequence[Source],
    rig: Rig,
    speed_rpm: float | Sequence[float] | None,
    say: Tick,
    **reading: Unpack[Reading],
) -> list[RotorRecord]:
    """Read the records of one rotor.

    `speed_rpm`: of each record, or of a single one; None: each says its own, and one without the channel of angle or
    speed that another has was taken at rest. A record of several experiments becomes several.
    """
    from ambid.rotor.spectra import experiments_of

    speeds = _speeds(speed_rpm, len(records))
    readings = []
    for source, speed in zip(records, speeds, strict=True):
        say("read")
        readings.append(RotorRecord(bench=_read(source, rig, speed, len(records), reading), speed=speed))
    _check_together(readings)
    assert rig.rotor is not None
    readings = [replace(r, bench=part) for r in readings for part in experiments_of(r.bench, rig.rotor)]
    turning = [r for r in readings if any(role in r.bench for role in _TURNING)]
    if not turning or len(turning) == len(readings) or speed_rpm is not None:
        return readings
    warning = (
        "has no column of the angle or speed that other records have: it is taken to be at rest. Else give "
        f"{setting('speed_rpm')}"
    )
    return [r if r in turning else replace(r, speed=0.0, warnings=(f"{r.name} {warning}",)) for r in readings]


def _speeds(speed_rpm: float | Sequence[float] | None, n: int) -> list[float | None]:
    if speed_rpm is None:
        return [None] * n
    speeds = [speed_rpm] if isinstance(speed_rpm, (int, float)) else list(speed_rpm)
    if len(speeds) != n:
        raise EstimationError(
            f"{counted(n, 'record')} and {counted(len(speeds), 'speed')} are given. Give {setting('speed_rpm')} once "
            "for each record, "
            "in their order"
        )
    wrong = next((x for x in speeds if not isfinite(x)), None)
    if wrong is not None:
        raise EstimationError(f"{setting('speed_rpm')} is {wrong}; it must be a speed in rpm. Give a number")
    return [x * 2.0 * pi / 60.0 for x in speeds]


def _read(source: Source, rig: Rig, speed: float | None, n: int, reading: Reading) -> Record:
    """Read a record; where its speed is known otherwise, or other records may show it, it need not have its column."""
    try:
        return load_bench(source, rig, **reading)
    except RecordError:
        still = tuple(c for c in rig.channels if c.role not in _TURNING)
        if len(still) == len(rig.channels) or (speed is None and n == 1):
            raise
        try:
            return load_bench(source, replace(rig, channels=still), **reading)
        except RecordError as error:
            raise error from None


def _check_together(readings: Sequence[RotorRecord]) -> None:
    """Refuse what cannot be one machine at one rate, or would count twice."""
    first = readings[0]
    for k, one in enumerate(readings):
        rate, other = one.bench.rate_hz, first.bench.rate_hz
        if abs(rate / other - 1.0) > _SAME_RATE:
            raise EstimationError(
                f"{one.name} is sampled at {rate:g} Hz, {first.name} at {other:g} Hz; delays count in samples of one "
                "rate. Identify them apart"
            )
        twice = next((r for r in readings[:k] if _same(r.bench, one.bench)), None)
        if twice is not None:
            raise EstimationError(f"{twice.name} and {one.name} hold the same samples and would count twice. Omit one")


def _same(a: Record, b: Record) -> bool:
    """Whether two records share samples: of one file, or one column of noise that repeats."""
    stretches = [(r.provenance.get("sha256"), r.start_s, r.n_samples, r.rate_hz) for r in (a, b)]
    return overlap(*stretches) or np.array_equal(a.channels[0].values, b.channels[0].values)
