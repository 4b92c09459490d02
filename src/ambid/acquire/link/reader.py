"""The reader: a thread that does nothing but take bytes from the port as they come.

Bytes and their time of arrival go into a queue of limited size. A consumer that is late never holds the port up: what
finds no room is dropped whole, and counted.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from ambid.acquire.link.port import Port
from ambid.acquire.protocol.codec import Message, unpack
from ambid.acquire.protocol.framing import FrameCounters, FrameDecoder
from ambid.acquire.protocol.table import table
from ambid.errors import DeviceError

_LOOK_S = 0.2
_ROOM = 1 << 24  # bytes: almost three minutes at 1 Mbaud
_PATIENCE_S = 5.0  # for the thread to end; a read lasts milliseconds


@dataclass(frozen=True, slots=True, kw_only=True)
class Hearing:
    """Who is told of what comes. All are called from the listener's thread and must not wait."""

    # given frames of samples that came together, and their time of arrival by `time.perf_counter`, s
    samples: Callable[[list[bytes], float], None]
    message: Callable[[Message], None]  # given every other message
    odd: Callable[[DeviceError], None]  # given what is wrong with a sound frame that is no message
    lost: Callable[[OSError], None]  # given why the line is lost, once


class Listener:
    """Listens to a port until it is closed or lost.

    `port`: nobody else may read from it; `hearing`: who is told.
    """

    def __init__(self, port: Port, hearing: Hearing) -> None:
        self._hearing = hearing
        self._decoder = FrameDecoder("host")
        self._sample = table().messages["sample"].code
        self._reader = Reader(port)
        self._thread = threading.Thread(target=self._run, name=f"listen {port.name}", daemon=True)
        self._thread.start()

    @property
    def counters(self) -> FrameCounters:
        """What the decoder saw."""
        return self._decoder.counters

    @property
    def overruns(self) -> tuple[int, int]:
        """Reads that the host had no room for, and the bytes in them."""
        return self._reader.overruns, self._reader.overrun_bytes

    def close(self) -> None:
        """Listen no more, after what has come already; again is harmless. The port stays open."""
        self._reader.close()
        if self._thread is not threading.current_thread():
            self._thread.join(_PATIENCE_S)

    def _run(self) -> None:
        try:
            while not self._reader.over:
                for chunk in self._reader.take(_LOOK_S):
                    self._hear(self._decoder.feed(chunk.data), chunk.arrived_s)
            failure = self._reader.failure
        except Exception as defect:  # nobody hears the controller any more: it must not be pinged on
            failure = OSError(f"a defect of ambid, {type(defect).__name__}: {defect}")
        if failure is not None:
            self._hearing.lost(failure)

    def _hear(self, payloads: list[bytes], arrived_s: float) -> None:
        together: list[bytes] = []
        for payload in payloads:
            if payload[0] == self._sample:
                together.append(payload)
                continue
            if together:
                self._hearing.samples(together, arrived_s)
                together = []
            try:
                told = unpack(payload)
            except DeviceError as failure:
                self._hearing.odd(failure)
            else:
                self._hearing.message(told)
        if together:
            self._hearing.samples(together, arrived_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class Chunk:
    """Bytes that came together."""

    data: bytes
    arrived_s: float  # when they were there, by `time.perf_counter`, s


class Reader:
    """Reads a port until it is closed or lost.

    `port`: nobody else may read from it; `room`: bytes that wait at most.

    `overruns`: reads dropped for want of room, and the bytes in them; `overrun_bytes`: reads dropped for want of room,
    and the bytes in them; `failure`: why the line is lost, once it is.
    """

    def __init__(self, port: Port, *, room: int = _ROOM) -> None:
        self._port, self._room = port, room
        self._chunks: deque[Chunk] = deque()
        self._held = 0
        self.overruns = self.overrun_bytes = 0
        self.failure: OSError | None = None
        self._stopping = False
        self._over = False
        self._news = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=f"read {port.name}", daemon=True)
        self._thread.start()

    def take(self, timeout_s: float) -> list[Chunk]:
        """Take all that has come.

        `timeout_s`: how long to wait for something, s. Returns empty if nothing came.
        """
        with self._news:
            self._news.wait_for(lambda: self._chunks or self._over, timeout_s)
            found = list(self._chunks)
            self._chunks.clear()
            self._held = 0
        return found

    @property
    def over(self) -> bool:
        """True once nothing more will come and all was taken."""
        with self._news:
            return self._over and not self._chunks

    def close(self) -> None:
        """Stop reading; again is harmless. The port stays open."""
        self._stopping = True
        if self._thread is not threading.current_thread():
            self._thread.join(_PATIENCE_S)

    def _run(self) -> None:
        failure: OSError | None = None
        try:
            while not self._stopping:
                data = self._port.read()
                if data:
                    self._put(data, time.perf_counter())
        except OSError as lost:
            failure = lost
        except Exception as defect:  # else nobody would learn that nothing is read any more
            failure = OSError(f"{type(defect).__name__}: {defect}")
        finally:
            with self._news:
                self.failure = None if self._stopping else failure
                self._over = True
                self._news.notify_all()

    def _put(self, data: bytes, arrived_s: float) -> None:
        with self._news:
            if self._held + len(data) > self._room:
                self.overruns += 1
                self.overrun_bytes += len(data)
                return
            self._chunks.append(Chunk(data=data, arrived_s=arrived_s))
            self._held += len(data)
            self._news.notify_all()
