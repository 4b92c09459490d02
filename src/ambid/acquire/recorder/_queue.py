"""What waits to be written: bounded in samples, in the order in which it came, with every loss counted."""

from __future__ import annotations

import threading
from collections import deque
from typing import NamedTuple

from ambid.acquire.recorder.frames import EVENT
from ambid.acquire.recorder.header import Event, event_json

_EVENTS = 10_000  # that may wait


class Item(NamedTuple):
    """A frame that has no number yet."""

    kind: int
    first: int
    time_s: float
    n_samples: int
    n_columns: int
    dtype: int
    payload: bytes


class WriteQueue:
    """Frames on their way from the caller's thread to the writer's."""

    def __init__(self, room: int) -> None:
        self._room = room
        self._lock = threading.Lock()
        self._items: deque[Item] = deque()
        self._samples = 0  # in the queue, or being written
        self._events = 0
        self._gap: list[int] | None = None  # first sample, samples and blocks that found no room since the last put
        self.blocks = self.overruns = self.lost_samples = self.lost_events = 0

    def has_room(self, n: int) -> bool:
        """Whether `n` samples more fit; a block longer than the queue fits an empty one."""
        return self._samples == 0 or self._samples + n <= self._room

    def overrun(self, first: int, n: int) -> None:
        """Count a block that found no room."""
        with self._lock:
            self.overruns += 1
            self.lost_samples += n
            if self._gap is None:
                self._gap = [first, 0, 0]
            self._gap[1] += n
            self._gap[2] += 1

    def count_lost(self, n: int) -> None:
        """Count samples that came when nothing is stored any more."""
        with self._lock:
            self.lost_samples += n

    def put(self, item: Item) -> None:
        """Add a frame, after the mark of what was lost before it."""
        with self._lock:
            self._mark_gap()
            if item.kind == EVENT:
                if self._events >= _EVENTS:
                    self.lost_events += 1
                    return
                self._events += 1
            else:
                self._samples += item.n_samples
                self.blocks += 1
            self._items.append(item)

    def take(self, *, last: bool = False) -> list[Item]:
        """Take out everything; `last`: the mark of what was lost at the end too."""
        with self._lock:
            if last:
                self._mark_gap()
            items = list(self._items)
            self._items.clear()
            self._events = 0
            return items

    def written(self, n: int) -> None:
        """Make room for `n` samples."""
        with self._lock:
            self._samples -= n

    def _mark_gap(self) -> None:
        if self._gap is None:
            return
        first, samples, blocks = self._gap
        self._gap = None
        what = f"{blocks} blocks found no room in the queue: the disk was too slow"
        event = Event(kind="lost", what=what, sample=first, count=samples)
        self._items.append(Item(EVENT, first, float("nan"), 0, 0, 0, event_json(event)))
