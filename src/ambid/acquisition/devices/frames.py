"""Blocks on their way from the thread that makes them to the one that reads them.

The maker never waits: a block without room is dropped whole, and counted as an overrun.
"""

from __future__ import annotations

import threading
from collections import deque

from ambid.errors import DeviceError
from ambid.tracking.blocks import Frame

ROOM = 4_000_000
"""Samples that wait at most: half an hour at 2 kHz."""


class FrameQueue:
    """A queue of frames with an end, and perhaps a reason for it.

    `room`: samples that wait at most; `overruns`: blocks dropped for want of room; `overrun_samples`: samples in them.
    """

    def __init__(self) -> None:
        self.room, self._held = ROOM, 0
        self._frames: deque[Frame] = deque()
        self._changed = threading.Condition()
        self._ended = True
        self._failure: DeviceError | None = None
        self.overruns = self.overrun_samples = 0

    def begin(self) -> None:
        """Expect frames; what still waits can be read before them."""
        with self._changed:
            self._ended = False

    def put(self, frame: Frame) -> bool:
        """Append a frame, or count it as lost.

        Returns false if there was no room.
        """
        n = len(frame.block.values)
        with self._changed:
            if self._held + n > self.room:
                self.overruns += 1
                self.overrun_samples += n
                return False
            self._frames.append(frame)
            self._held += n
            self._changed.notify_all()
            return True

    def end(self, failure: DeviceError | None = None) -> None:
        """Say that nothing more will come until the next beginning.

        `failure`: why; raised to whoever reads, once all frames are read.
        """
        with self._changed:
            self._ended = True
            self._failure = self._failure or failure
            self._changed.notify_all()

    def take(self, timeout_s: float) -> Frame | None:
        """Take the next frame.

        `timeout_s`: how long to wait for it, s. Returns none if none came in time, or at the end.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._frames or self._ended, timeout_s)
            if self._frames:
                frame = self._frames.popleft()
                self._held -= len(frame.block.values)
                return frame
            if self._failure is not None:
                raise self._failure
            return None

    @property
    def held(self) -> int:
        """Samples that wait."""
        return self._held

    @property
    def ended(self) -> bool:
        """Whether all was read and nothing more will come."""
        with self._changed:
            return self._ended and not self._frames
