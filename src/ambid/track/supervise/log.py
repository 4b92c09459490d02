"""Every decision with its reason: a bounded list of events, and how many of each kind there were."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping
from types import MappingProxyType

from ambid.errors import EstimationError
from ambid.recursive.lines import Event


class DecisionLog:
    """Keep the last events and count all.

    `capacity`: events kept.
    """

    def __init__(self, capacity: int = 1000, listener: Callable[[Event], None] | None = None) -> None:
        if capacity < 1:
            raise EstimationError(f"a log of {capacity} events keeps nothing. Give a capacity of 1 or more")
        self._events: deque[Event] = deque(maxlen=capacity)
        self._counts: dict[str, int] = {}
        self._listener, self._lock = listener, threading.Lock()

    def add(self, event: Event) -> None:
        """Keep an event; the oldest one goes if there is no room."""
        with self._lock:
            self._events.append(event)
            self._counts[event.kind] = self._counts.get(event.kind, 0) + 1
        if self._listener is not None:
            self._listener(event)

    @property
    def events(self) -> tuple[Event, ...]:
        """Those that are kept, the oldest first."""
        with self._lock:
            return tuple(self._events)

    @property
    def counts(self) -> Mapping[str, int]:
        """How many events of each kind there were, those no longer kept included."""
        with self._lock:
            return MappingProxyType(dict(self._counts))

    def since(self, t: float) -> tuple[Event, ...]:
        """Return the kept events at or after a time.

        `t`: s of record.
        """
        return tuple(event for event in self.events if event.t >= t)
