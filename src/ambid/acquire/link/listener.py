"""The listener: a thread that turns the bytes of the reader into samples and messages, in the order of the line."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

from ambid.acquire.link.port import Port
from ambid.acquire.link.reader import Reader
from ambid.acquire.protocol.codec import Message, unpack
from ambid.acquire.protocol.framing import FrameCounters, FrameDecoder
from ambid.acquire.protocol.table import table
from ambid.errors import DeviceError

_LOOK_S = 0.2
_PATIENCE_S = 5.0


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
