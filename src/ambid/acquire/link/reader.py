"""The reader: a thread that does nothing but take bytes from the port as they come.

Bytes and their time of arrival go into a queue of limited size. A consumer that is late never holds the port up: what
finds no room is dropped whole, and counted.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass

from ambid.acquire.link.port import Port

_ROOM = 1 << 24  # bytes: almost three minutes at 1 Mbaud
_PATIENCE_S = 5.0  # for the thread to end; a read lasts milliseconds


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
