"""A record played back as a device: the blocks that were once sampled, with their gaps, in real time or faster.

What was is over: it can be listened to (mode ``sample``), but neither driven, nor levitated, nor excited.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import NoReturn

import numpy as np

from ambid.acquisition.device import Column, DeviceInfo, Mode, Program, SelfTest
from ambid.acquisition.devices.played import Pace, PlayedDevice
from ambid.errors import DeviceError, RecordError
from ambid.physics.linear_model import model
from ambid.record import Record, read_rows
from ambid.rig.rig import Rig, role_units
from ambid.tracking.blocks import Block
from ambid.tracking.replay import Replay, blocks_of
from ambid.units import UNKNOWN


class ReplayDevice(PlayedDevice):
    """A record file as a device.

    Each start out of idle plays it from its first row on; numbers count on. ``Block.time_s`` is what the record says,
    counted from the first row.

    `path`: ``.csv``, ``.csv.gz``, ``.h5``; `rig`: its columns are played first, then all others of the record.
    """

    def __init__(self, path: str | Path, rig: Rig, *, pace: Pace = "real") -> None:
        rows = read_rows(path, rate_hz=rig.record.rate_hz)
        record = rows.record
        missing = [c.column for c in rig.channels if c.column not in record.names]
        if missing:
            raise DeviceError(
                f"record {path} has no column {missing[0]!r}, which the rig needs; it has {', '.join(record.names)}."
                " Correct the rig, or use another record"
            )
        _check_units(record, rig, f"record {path}")
        super().__init__(record.rate_hz, pace)
        roles = {c.column: c.role for c in rig.channels}
        others = {name: name if name == "excitation" else "extra" for name in record.names if name not in roles}
        try:
            self._replay: Replay = blocks_of(record, self._size, channels=(*roles, *others), time_s=rows.time_s)
        except RecordError as failure:
            raise DeviceError(str(failure)) from None
        columns = tuple(
            Column(name=name, role=role, unit=record.channel(name).unit) for name, role in (roles | others).items()
        )
        # A name of other bytes than UTF-8 cannot be written into a record as it is.
        port = os.fsencode(path).decode("utf-8", "replace")
        self._info = DeviceInfo(kind="replay", port=port, rate_hz=record.rate_hz, columns=columns)
        self._row = self._base = 0

    def _opened(self) -> None:
        self._row = 0

    def _begin(self, mode: Mode) -> None:
        if mode != "sample":
            self._refuse_playing(f"mode {mode!r}")
        self._row, self._base = 0, self._next

    def _play(self, program: Program | None) -> None:
        if program is not None:
            self._refuse_playing("an excitation")

    def _tested(self) -> SelfTest:
        bad = int(np.isnan(self._replay.values).any(axis=1).sum())
        failed = (f"{bad} of {len(self._replay.values)} rows have holes",) if bad else ()
        return SelfTest(failed=failed, numbers={"rows": float(len(self._replay.values)), "rows_with_holes": float(bad)})

    def _made(self, room: int) -> Block | None:
        played = self._replay
        start, total = self._row, played.numbers.size
        if start >= total:
            return None
        stop = min(start + room, total)
        # A block ends where the numbers do not follow on each other.
        steps = np.diff(played.numbers[start:stop])
        jumps = np.flatnonzero(steps != 1)
        if jumps.size:
            stop = start + int(jumps[0]) + 1
        self._row = stop
        return Block(
            first=self._base + int(played.numbers[start] - played.numbers[0]),
            time_s=self._base / self._rate + float(played.time_s[start] - played.time_s[0]),
            values=played.values[start:stop],
        )

    def _refuse_playing(self, what: str) -> NoReturn:
        raise DeviceError(
            f"{self._where} refuses {what}; a record can be listened to, not acted on. Use mode 'sample', or a"
            " simulated device"
        )


def _check_units(record: Record, rig: Rig, where: str) -> None:
    """Refuse a column whose unit is not the one that the rig's calibration begins with; one without unit may pass."""
    wanted = role_units(model(rig.model))
    for c in rig.channels:
        channel, of = record.channel(c.column), c.calibration
        if c.unit is not None or channel.unit == UNKNOWN:
            continue
        counts = "1" if rig.daq is not None else channel.unit  # a gain of a controller's rig is for counts
        unit = wanted.get(c.role, channel.unit) if of is None else of.unit_in or counts
        if channel.unit != unit:
            raise DeviceError(
                f"{where}: column {c.column!r} is in [{channel.source_unit or channel.unit}]; channels.{c.role} of the"
                f" rig takes [{unit}]{', counts' if unit == '1' else ''}. Replay it with the rig that it was taken"
                " with, or correct the calibration"
            )
