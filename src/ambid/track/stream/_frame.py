"""How a block lies in a slot of the ring: as it is, damaged or not, with a value that checks it."""

from __future__ import annotations

import struct
from operator import index
from typing import Any
from zlib import crc32

import numpy as np

from ambid.track.stream.block import Block, Frame

_HEAD = struct.Struct(
    "=QQqddqqqQ8s"
)  # sequence, check, first, time, arrival, rows, columns (-1: none), bytes, spare, type
_UNCHECKED = 16  # bytes of sequence number and check value
HEAD_SIZE = _HEAD.size
NO_NUMBER = -(2**63)
NOT_CARRIED = b"?"  # type of values that do not fit a slot: what arrives has a wrong type too


def write_frame(buffer: memoryview, at: int, sequence: int, block: Block, arrived_s: float, capacity: int) -> None:
    """Write a block into a slot."""
    data, rows, columns, kind = _carried(block.values, capacity)
    head = (_number(block.first), _stamp(block.time_s), arrived_s, rows, columns, len(data), 0, kind)
    stop = at + _HEAD.size + len(data)
    _HEAD.pack_into(buffer, at, sequence, 0, *head)
    buffer[at + _HEAD.size : stop] = data
    check = crc32(buffer[at + _UNCHECKED : stop], sequence & 0xFFFFFFFF)
    struct.pack_into("=Q", buffer, at + 8, check)


def read_frame(buffer: memoryview, at: int, sequence: int, capacity: int) -> Frame | None:
    """Return the frame of this sequence number; None if the slot holds another one or a part of one."""
    found, check, first, time_s, arrived_s, rows, columns, size, _, kind = _HEAD.unpack_from(buffer, at)
    if found != sequence or not 0 <= size <= capacity:
        return None
    data = bytes(buffer[at + _UNCHECKED : at + _HEAD.size + size])
    if crc32(data, sequence & 0xFFFFFFFF) != check:
        return None
    values = _values(data[_HEAD.size - _UNCHECKED :], rows, columns, kind.rstrip(b"\0"))
    return Frame(block=Block(first=first, time_s=time_s, values=values), arrived_s=arrived_s)


def _number(first: object) -> int:
    try:
        number = index(first)  # type: ignore[arg-type]
    except TypeError:
        return NO_NUMBER
    return number if -(2**63) <= number < 2**63 else NO_NUMBER


def _stamp(time_s: object) -> float:
    try:
        return float(time_s)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return float("nan")


def _carried(values: object, capacity: int) -> tuple[bytes, int, int, bytes]:
    """Return bytes, rows, columns and type of values; a mark instead of the type if no slot can carry them."""
    if isinstance(values, np.ndarray) and values.ndim in (1, 2) and values.nbytes <= capacity:
        kind = values.dtype.str.encode()
        if values.dtype.kind in "biufc" and len(kind) <= 8:
            return values.tobytes(), values.shape[0], values.shape[1] if values.ndim == 2 else -1, kind
    return b"", 0, -1, NOT_CARRIED


def _values(data: bytes, rows: int, columns: int, kind: bytes) -> Any:
    if kind == NOT_CARRIED:
        return np.empty(0, dtype=object)
    flat = np.frombuffer(data, dtype=kind.decode())
    return flat if columns < 0 else flat.reshape(rows, columns)
