"""Ring of blocks in shared memory between one process that acquires and one that tracks.

Each counter has one writer: no lock. The producer never waits; a block that finds the ring full is dropped and counted,
so that nothing is torn under the consumer's hands and one gap in the numbers is all that is lost.

    header     "AMBIDRNG", version, slots, samples and channels of a block, rate, names
    producer   blocks written, blocks dropped, ended, process
    consumer   blocks read, stop wanted, process
    slots      sequence number, check value, first sample, time, arrival, rows, columns, bytes, type; values
"""

from __future__ import annotations

import json
import os
import secrets
import struct
import sys
import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing import resource_tracker
from multiprocessing.shared_memory import SharedMemory
from operator import index
from pathlib import Path
from typing import Any, Self
from zlib import crc32

import numpy as np

from ambid.errors import EstimationError
from ambid.tracking.blocks import Block, Frame

_PLACE = Path("/dev/shm")  # where Linux has shared memory
_ATTACHING = threading.Lock()


def created(size: int) -> SharedMemory:
    """Make a segment of zeros with a name of its own; the resource tracker removes it should this process be killed."""
    name = f"ambid-{os.getpid()}-{secrets.token_hex(4)}"
    segment = None
    try:
        segment = SharedMemory(name=name, create=True, size=size)
        path = _PLACE / name
        if path.exists() and hasattr(os, "posix_fallocate"):
            # take the memory now: without room for it, whoever writes to it later would be killed
            with path.open("r+b") as file:
                os.posix_fallocate(file.fileno(), 0, segment.size)
    except OSError as failure:
        if segment is not None:
            removed(segment)
        raise EstimationError(
            f"no shared memory of {size} bytes for a ring: {failure.strerror or failure}. Make room for it (on Linux in"
            f" {_PLACE}), or use fewer or shorter blocks"
        ) from None
    return segment


def attached(name: str) -> SharedMemory:
    """Open a segment that is somebody else's: the resource tracker of this process must not remove it."""
    try:
        if sys.version_info >= (3, 13):
            return SharedMemory(name=name, track=False)
        with _ATTACHING:
            register = resource_tracker.register
            resource_tracker.register = lambda *_: None
            try:
                return SharedMemory(name=name)
            finally:
                resource_tracker.register = register
    except (OSError, ValueError) as failure:
        why = getattr(failure, "strerror", None) or failure
        raise EstimationError(f"there is no shared memory {name!r} ({why}). Start the acquisition first") from None


def bytes_of(segment: SharedMemory) -> memoryview:
    """Return the bytes of an open segment."""
    buffer = segment.buf
    assert buffer is not None
    return buffer


def removed(segment: SharedMemory) -> None:
    """Close and remove a segment; it may be gone already."""
    segment.close()
    try:
        segment.unlink()
    except FileNotFoundError:
        resource_tracker.unregister(f"/{segment.name}", "shared_memory")


_HEAD = struct.Struct(
    "=QQqddqqqQ8s"
)  # sequence, check, first, time, arrival, rows, columns (-1: none), bytes, spare, type
_UNCHECKED = 16  # bytes of sequence number and check value
HEAD_SIZE = _HEAD.size
NO_NUMBER = -(2**63)
NOT_CARRIED = b"?"  # type of values that do not fit a slot: what arrives has a wrong type too


def write_frame(buffer: memoryview, at: int, sequence: int, block: Block, arrived_s: float, capacity: int) -> None:
    """Write a block into a slot."""
    values: object = block.values
    data, rows, columns, kind = b"", 0, -1, NOT_CARRIED
    if isinstance(values, np.ndarray) and values.ndim in (1, 2) and values.nbytes <= capacity:
        code = values.dtype.str.encode()
        if values.dtype.kind in "biufc" and len(code) <= 8:
            data, rows, columns, kind = values.tobytes(), len(values), values.shape[1] if values.ndim == 2 else -1, code
    try:
        number = index(block.first)
    except TypeError:
        number = NO_NUMBER
    try:
        time_s = float(block.time_s)
    except (TypeError, ValueError, OverflowError):
        time_s = float("nan")
    number = number if -(2**63) <= number < 2**63 else NO_NUMBER
    head = (number, time_s, arrived_s, rows, columns, len(data), 0, kind)
    stop = at + _HEAD.size + len(data)
    _HEAD.pack_into(buffer, at, sequence, 0, *head)
    buffer[at + _HEAD.size : stop] = data
    check = crc32(buffer[at + _UNCHECKED : stop], sequence & 0xFFFFFFFF)
    struct.pack_into("=Q", buffer, at + 8, check)


def read_frame(buffer: memoryview, at: int, sequence: int, capacity: int) -> Frame | None:
    """Return the frame of this sequence number; None if the slot holds another one or a part of one."""
    written, check, first, time_s, arrived_s, rows, columns, size, _, kind = _HEAD.unpack_from(buffer, at)
    if written != sequence or not 0 <= size <= capacity:
        return None
    data = bytes(buffer[at + _UNCHECKED : at + _HEAD.size + size])
    if crc32(data, sequence & 0xFFFFFFFF) != check:
        return None
    values: np.ndarray[Any, Any] = np.empty(0, dtype=object)
    kind = kind.rstrip(b"\0")
    if kind != NOT_CARRIED:
        values = np.frombuffer(data[_HEAD.size - _UNCHECKED :], dtype=kind.decode())
        values = values if columns < 0 else values.reshape(rows, columns)
    return Frame(block=Block(first=first, time_s=time_s, values=values), arrived_s=arrived_s)


VERSION = 2
_MAGIC = b"AMBIDRNG"
_HEADER = struct.Struct("=8sQQQQdQQ")  # magic, version, slots, samples, channels, rate, bytes of names, check value
_LINE = 64  # bytes: what two processes write lies on different cache lines
_WRITTEN, _DROPPED, _ENDED, _PRODUCER = range(4)  # of the producer's line
_READ, _STOP, _CONSUMER = range(3)  # of the consumer's line
_RETRIES = 100  # of a frame whose check fails: its last bytes may be on their way


class BlockRing:
    """Blocks in shared memory, one producer and one consumer, made by `create` or `attach`, closed by ``with``.
    `owner`: whether to remove the `segment` in the end; `name`: of it, for `attach`; `slots`, `block_samples`: capacity
    in blocks, and the longest of them; `torn`: blocks passed over for a wrong check value.
    """

    def __init__(self, segment: SharedMemory, *, owner: bool) -> None:
        self._segment, self._owner, self._closed = segment, owner, False
        self._bytes = bytes_of(segment)
        fields = _HEADER.unpack_from(self._bytes, 0)
        _, _, self.slots, self.block_samples, n_channels, self.rate_hz, size, _ = fields
        self.name = segment.name
        text = bytes(self._bytes[_HEADER.size : _HEADER.size + size])
        self.channels: tuple[str, ...] = tuple(json.loads(text))
        self._capacity = int(self.block_samples * n_channels * 8)
        lines = _aligned(_HEADER.size + size)
        self._first_slot = lines + 2 * _LINE
        self._slot_size = _aligned(HEAD_SIZE + self._capacity)
        # Items of these views are read and written whole: one aligned machine word each.
        self._produced = self._bytes[lines : lines + _LINE].cast("Q")
        self._consumed = self._bytes[lines + _LINE : lines + 2 * _LINE].cast("Q")
        self._idle_s = min(max(self.block_samples / self.rate_hz / 10, 5e-5), 1e-3)
        self.torn = 0

    @classmethod
    def create(cls, *, rate_hz: float, channels: Sequence[str], slots: int = 64, block_samples: int = 200) -> Self:
        """Make a ring, to be removed by its maker; `channels`: in the order of the columns; `slots`: capacity in
        blocks; `block_samples`: of the longest block in a slot; longer ones are divided.
        """
        if slots < 1 or block_samples < 1 or not channels or not 0 < rate_hz < float("inf"):
            raise EstimationError(
                f"a ring of {slots} blocks of {block_samples} samples of {len(channels)} channels at {rate_hz} Hz holds"
                " nothing; each must be positive. Correct it"
            )
        names = json.dumps(list(channels)).encode()
        slot = _aligned(HEAD_SIZE + 8 * block_samples * len(channels))
        size = _aligned(_HEADER.size + len(names)) + 2 * _LINE + slots * slot
        segment = created(size)
        fields = (VERSION, slots, block_samples, len(channels), rate_hz, len(names))
        bytes_of(segment)[_HEADER.size : _HEADER.size + len(names)] = names
        _HEADER.pack_into(bytes_of(segment), 0, _MAGIC, *fields, _header_check(fields, names))
        return cls(segment, owner=True)

    @classmethod
    def attach(cls, name: str) -> Self:
        """Open a ring that another process made. `name`: of its segment."""
        segment = attached(name)
        fault = _fault(bytes_of(segment))
        if fault:
            segment.close()
            raise EstimationError(f"shared memory {name!r} {fault}. Name the segment of a ring made by this version")
        return cls(segment, owner=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the segment; whoever made the ring removes it. A second call does nothing."""
        if self._closed:
            return
        self._closed = True
        self._produced.release()
        self._consumed.release()
        self._bytes = memoryview(b"")
        removed(self._segment) if self._owner else self._segment.close()

    def __del__(self) -> None:
        if getattr(self, "_closed", True) is False:
            self.close()

    @property
    def filled(self) -> int:
        """Blocks that wait to be read."""
        return int(self._produced[_WRITTEN] - self._consumed[_READ])

    @property
    def overruns(self) -> int:
        """Blocks that were dropped because the ring was full."""
        return int(self._produced[_DROPPED])

    @property
    def ended(self) -> bool:
        """Whether the producer said that it is done and everything was read."""
        return bool(self._produced[_ENDED]) and self.filled == 0

    @property
    def stopping(self) -> bool:
        """Whether the consumer asked the producer to stop."""
        return bool(self._consumed[_STOP])

    def end(self) -> None:
        """Say, as the producer, that nothing else will come."""
        self._produced[_ENDED] = 1

    def stop(self) -> None:
        """Ask, as the consumer, the producer to stop."""
        self._consumed[_STOP] = 1

    def put(self, block: Block, arrived_s: float | None = None) -> bool:
        """Write a block without ever waiting, divided if longer than a slot, damaged ones as they are; values that no
        slot can hold arrive as an empty array of a wrong type. `arrived_s`: of its last sample, `time.perf_counter`,
        default now. Returns false if the ring was full and (a part of) the block was dropped and counted.
        """
        self._claim(self._produced, _PRODUCER, "produces")
        arrived = time.perf_counter() if arrived_s is None else arrived_s
        values = block.values
        if not _divisible(block, self._capacity):
            return self._put(block, arrived)
        rows = self._capacity // (values.shape[1] * 8)
        complete = True
        for k in range(0, values.shape[0], rows):
            time_s = block.time_s + k / self.rate_hz
            complete &= self._put(Block(first=block.first + k, time_s=time_s, values=values[k : k + rows]), arrived)
        return complete

    def _put(self, block: Block, arrived: float) -> bool:
        written = self._produced[_WRITTEN]
        if written - self._consumed[_READ] >= self.slots:
            self._produced[_DROPPED] += 1
            return False
        at = self._first_slot + (written % self.slots) * self._slot_size
        write_frame(self._bytes, at, written, block, arrived, self._capacity)
        self._produced[_WRITTEN] = written + 1  # last: only now may the consumer look
        return True

    def wait_for_room(self, timeout_s: float) -> bool:
        """Wait until a block would fit: for a source that can wait, such as a file. Returns whether there is room."""
        return self._wait(lambda: self.filled < self.slots, timeout_s)

    def read(self, timeout_s: float) -> Frame | None:
        """Take out the next block, None if none comes within `timeout_s`, or ever (`ended`). A torn block is passed
        over and counted in `torn`; its numbers are then missing.
        """
        self._claim(self._consumed, _CONSUMER, "consumes")
        if not self.filled and not self._wait(lambda: self.filled or self._produced[_ENDED], timeout_s):
            return None
        while self.filled:
            number = self._consumed[_READ]
            at = self._first_slot + (number % self.slots) * self._slot_size
            for _ in range(_RETRIES):
                frame = read_frame(self._bytes, at, number, self._capacity)
                if frame is not None:
                    break
                time.sleep(0)
            self._consumed[_READ] = number + 1  # last: only now may the producer write there
            if frame is not None:
                return frame
            self.torn += 1
        return None

    def _wait(self, ready: Callable[[], object], timeout_s: float) -> bool:
        """Wait until something holds, looking about ten times per block."""
        until = time.perf_counter() + timeout_s
        while not ready():
            left = until - time.perf_counter()
            if left <= 0:
                return False
            time.sleep(min(self._idle_s, left))
        return True

    def _claim(self, line: memoryview, at: int, does: str) -> None:
        """Refuse a second producer or consumer: each counter has one writer. A dead one is followed."""
        me, other = os.getpid(), line[at]
        if other == me:
            return
        if other and _alive(other):
            raise EstimationError(
                f"process {other} {does} in ring {self.name!r} already; only one may. Make another ring"
            )
        line[at] = me
        if other:
            line[_ENDED if at == _PRODUCER else _STOP] = 0


def _alive(process: int) -> bool:
    if os.name != "posix":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def _divisible(block: Block, capacity: int) -> bool:
    """Tell whether a block is too long for a slot and can be divided: sound but for its length."""
    values: object = block.values
    if not isinstance(values, np.ndarray) or values.ndim != 2 or values.dtype != np.float64:
        return False
    numbered = isinstance(block.first, int | np.integer) and isinstance(block.time_s, int | float)
    return numbered and values.nbytes > capacity and values.shape[1] * 8 <= capacity


def _aligned(size: int) -> int:
    return -(-size // _LINE) * _LINE


def _header_check(fields: Sequence[float], names: bytes) -> int:
    return crc32(repr(tuple(fields)).encode() + names)


def _fault(buffer: memoryview) -> str:
    """Say why a segment is no ring; nothing if it is one."""
    if len(buffer) < _HEADER.size or bytes(buffer[:8]) != _MAGIC:
        return "is no ring of blocks"
    _, *fields, check = _HEADER.unpack_from(buffer, 0)
    if fields[0] != VERSION:
        return f"is a ring of version {fields[0]}; this program knows {VERSION}"
    names = bytes(buffer[_HEADER.size : _HEADER.size + fields[-1]]) if fields[-1] < len(buffer) else b""
    return "" if _header_check(fields, names) == check else "is a ring with a damaged header"
