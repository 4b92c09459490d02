"""What a device samples, seen through a rig: blocks in the units and the order that a model needs."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from ambid.acquisition.device import Column, DeviceInfo
from ambid.arrays import Array
from ambid.errors import RigError
from ambid.physics.linear_model import model
from ambid.record import Channel, Record
from ambid.rig import Rig, bench_record
from ambid.tracking.blocks import Block


def as_record(values: Array, columns: Sequence[Column], rate_hz: float, *, start_s: float = 0.0) -> Record:
    """Return samples of a device as a record.

    `values`: (n_samples, n_columns), in the columns' units, as blocks hold them; `columns`: of the device; `rate_hz`:
    sampling rate in Hz; `start_s`: time of the first sample, s. Returns one channel per column, named like it.
    """
    channels = tuple(Channel(name=c.name, unit=c.unit, values=values[:, k]) for k, c in enumerate(columns))
    return Record(channels=channels, rate_hz=rate_hz, start_s=start_s, provenance=MappingProxyType({}), history=())


class BenchView:
    """Turns raw blocks of a device into blocks of roles, SI.

    `info`: of the opened device; `rig`: its columns and calibrations; `roles`: which, in which order.

    `units`: SI unit of each role, in the order given; `rate_hz`: sampling rate in Hz.
    """

    def __init__(self, info: DeviceInfo, rig: Rig, roles: Sequence[str]) -> None:
        self.rate_hz = info.rate_hz
        self._columns, self._rig = info.columns, rig
        late = [c.role for c in rig.channels if c.delay not in ("auto", 0) and c.role not in model(rig.model).inputs]
        if late:
            raise RigError(
                f"channels.{late[0]}.delay is taken back in a whole record only; samples of a device come in blocks. "
                "Remove it for live work"
            )
        spare = [0.0 if c.span is None else (c.span[0] + c.span[1]) / 2.0 for c in info.columns]
        seen = self.record(np.array([spare]))  # so that what does not fit is told at once
        self.units = {role: seen.channel(role).unit for role in roles}
        self._lines = self._linear()

    def block(self, raw: Block) -> Block:
        """Return a block in the order of the roles.

        `raw`: shape (n_samples, n_columns), in the device's units. Returns shape (n_samples, n_roles), SI.
        """
        if self._lines is None:
            seen = self.record(raw.values)
            values = np.column_stack([seen[role].values for role in self.units])
        else:
            columns, gain, offset = self._lines
            values = np.ascontiguousarray(gain * raw.values[:, columns] + offset)
        return Block(first=raw.first, time_s=raw.time_s, values=values)

    def _linear(self) -> tuple[NDArray[np.int64], Array, Array] | None:
        """Return columns, gains and offsets of the roles; applying them takes a tenth of the time of making a record.

        None where a table or a declared unit asks for more.
        """
        columns = {c.name: k for k, c in enumerate(self._columns)}
        channels = {c.role: c for c in self._rig.channels}
        found = []
        for c in (channels[role] for role in self.units):
            k, of = columns[c.column], c.calibration
            if c.unit not in (None, self._columns[k].unit) or (of is not None and of.raw is not None):
                return None
            found.append((k, 1.0, 0.0) if of is None else (k, of.gain, of.offset))
        k, gain, offset = np.array(found).T
        return k.astype(int), gain, offset

    def record(self, values: Array, *, start_s: float = 0.0) -> Record:
        """Return samples as a record whose channels are named by role.

        `values`: (n_samples, n_columns), in the device's units, as blocks hold them; `start_s`: time of the first
        sample, s. Returns all of the rig's channels, SI.
        """
        return bench_record(as_record(values, self._columns, self.rate_hz, start_s=start_s), self._rig)
