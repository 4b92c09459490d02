"""The reader: a thread that does nothing but take bytes from the port as they come.

Bytes and their time of arrival go into a queue of limited size. A consumer that is late never holds the port up: what
finds no room is dropped whole, and counted.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from dataclasses import dataclass

import numpy as np

from ambid.acquire.link.port import Port

_WINDOW_S = 0.25  # at first; doubled whenever the windows are full
_WINDOWS = 512
_LEAST = 40  # windows before anything is said: a latency that grows at first looks like a drift, known very well
_FITTED = 7  # windows that a line is drawn through, at least
_OUTLIER = 4.0  # robust standard deviations above the line: a stall of the host
_ROUNDS = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift:
    """What is known of a clock."""

    drift: float = math.nan  # relative; positive if the controller's clock is fast, NaN while unknown
    drift_sd: float = math.nan  # its standard deviation
    offset_s: float = math.nan  # host time at which sample 0 was there, by `time.perf_counter`, s


class ClockDrift:
    """Learns from arrivals in constant memory.

    `rate_hz`: samples in a second by the controller's clock.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period = 1.0 / rate_hz
        self._width = _WINDOW_S
        self._lowest: dict[int, tuple[float, float]] = {}  # window -> time of the earliest, how late it was
        self._origin: float | None = None

    def learn(self, number: int, arrived_s: float) -> None:
        """Take in one arrival.

        `number`: sample number; `arrived_s`: when it was there by the host's clock, s.
        """
        if self._origin is None:
            self._origin = arrived_s - number * self._period
        t = number * self._period
        late, window = arrived_s - self._origin - t, int(t / self._width)
        kept = self._lowest.get(window)
        if kept is None or late < kept[1]:
            self._lowest[window] = (t, late)
        if len(self._lowest) > _WINDOWS:
            self._halve()

    def estimate(self) -> Drift:
        """Return what is known by now."""
        if self._origin is None or len(self._lowest) < _LEAST:
            return Drift()
        # The newest window may not be full yet: its minimum would lie too high.
        t, late = np.array([self._lowest[w] for w in sorted(self._lowest)[:-1]]).T
        keep = np.ones(t.size, dtype=bool)
        slope = level = 0.0
        for _ in range(_ROUNDS):
            slope, level = np.polyfit(t[keep], late[keep], 1)
            rest = late - level - slope * t
            middle = np.median(rest[keep])
            spread = 1.4826 * np.median(np.abs(rest[keep] - middle))
            now = rest <= middle + _OUTLIER * max(spread, 1e-7)
            if now.sum() < _FITTED or (now == keep).all():
                break
            keep = now
        return self._told(t[keep], late[keep], float(slope), float(level))

    def _told(self, t: np.ndarray, late: np.ndarray, slope: float, level: float) -> Drift:
        """Return the line with its standard deviation, which neighbours that are late together make wider."""
        assert self._origin is not None
        rest = late - level - slope * t
        n = t.size
        variance = float(rest @ rest) / max(n - 2, 1)
        together = float(rest[1:] @ rest[:-1]) / max(float(rest @ rest), 1e-300)
        wider = (1.0 + max(together, 0.0)) / (1.0 - min(max(together, 0.0), 0.95))
        sd = math.sqrt(wider * variance / max(float(((t - t.mean()) ** 2).sum()), 1e-300))
        # Late by `slope` seconds in each second of the controller: 1 / (1 + d) = 1 + slope.
        return Drift(drift=1.0 / (1.0 + slope) - 1.0, drift_sd=sd, offset_s=self._origin + level)

    def _halve(self) -> None:
        self._width *= 2.0
        merged: dict[int, tuple[float, float]] = {}
        for window, (t, late) in self._lowest.items():
            kept = merged.get(window // 2)
            if kept is None or late < kept[1]:
                merged[window // 2] = (t, late)
        self._lowest = merged


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

    `overruns`: reads dropped for want of room; `overrun_bytes`: bytes in them; `failure`: why the line is lost.
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
