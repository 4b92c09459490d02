"""From the working estimate to the published one: candidates, their validation, and the operator's orders.

The working estimate goes on whatever happens here; only what later data have confirmed, or the operator has ordered,
is published. Every decision is logged with its reason.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ambid.errors import EstimationError, nearest
from ambid.recursive.lines import Event, TrackedValue
from ambid.tracking.evidence import Evidence
from ambid.tracking.gate import Accepted, Gate
from ambid.tracking.numbers import Kind, TrackedNumbers, amplitude_and_phase
from ambid.tracking.rpem import PhysicalRpem


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


Flag = Literal["track", "hold", "accept", "revert"]
Order = Literal["accept", "revert"]
_FLAGS: tuple[str, ...] = get_args(Flag)


class Operator:
    """Flags of the operator; all methods may be called from any thread.

    ``track`` and ``hold`` are states: in ``hold`` the published numbers stay as they are. ``accept`` (the candidate,
    now and unjudged) and ``revert`` (to the numbers accepted before) are orders, carried out once.

    `hold`: whether to begin in ``hold``.
    """

    def __init__(self, *, hold: bool = False) -> None:
        self._lock = threading.Lock()
        self._hold = hold
        self._order: Order | None = None

    @property
    def holding(self) -> bool:
        """Whether the published numbers are to stay as they are."""
        with self._lock:
            return self._hold

    @property
    def waiting(self) -> Order | None:
        """The order that was not taken yet."""
        with self._lock:
            return self._order

    def set(self, flag: str, t: float = 0.0, why: str = "") -> Event:
        """Set a flag.

        `t`: time of the stream, s; `why`: the operator's reason, for the log. Returns for the log.
        """
        if flag not in _FLAGS:
            raise EstimationError(
                f"operator flag {flag!r} is unknown; known: {', '.join(_FLAGS)}.{nearest(flag, _FLAGS)}"
            )
        with self._lock:
            if flag == "accept" or flag == "revert":
                if self._order not in (None, flag):
                    raise EstimationError(f"operator: {self._order!r} is still pending. Give {flag!r} after that")
                self._order = "accept" if flag == "accept" else "revert"
                what = f"operator orders {flag}"
            else:
                same = self._hold == (flag == "hold")
                self._hold = flag == "hold"
                what = f"operator sets {flag}" + (" (already so)" if same else "")
        return Event(kind="operator", t=t, why=f"{what}: {why}" if why else what)

    def take(self) -> Order | None:
        """Return the order that waits, if any: it is done now and waits no longer."""
        with self._lock:
            order, self._order = self._order, None
        return order


def published(
    numbers: TrackedNumbers, accepted: Accepted, kind: Kind, fresh: Mapping[str, bool]
) -> dict[str, TrackedValue]:
    """Return the accepted numbers of one kind.

    Returns SI.
    """
    sd = np.sqrt(np.diag(accepted.covariance)) * numbers.magnitude
    values = accepted.values * numbers.magnitude
    return {
        numbers.names[j]: TrackedValue(
            value=float(values[j]), sd=float(sd[j]), stale=not fresh.get(numbers.names[j], True)
        )
        for j in numbers.places(kind)
    }


def beside(
    numbers: TrackedNumbers, accepted: Accepted, active: NDArray[np.bool_], *, stale: bool = False
) -> dict[str, TrackedValue]:
    """Return what is tracked beside the parameters: gains of sensors that were found to have changed, unbalance.

    `active`: (p,), which numbers the recursion may move; `stale`: whether they are no longer informed, or known to be
    no longer right. Returns SI; the unbalance in kg m, its phase in rad.
    """
    gains = tuple(numbers.names[j] for j in numbers.places("gain") if active[j])
    if not gains and not numbers.synchronous:
        return {}
    found = published(numbers, accepted, "gain", dict.fromkeys(gains, not stale))
    found = {name: found[name] for name in gains}
    if not numbers.synchronous:
        return found
    at = numbers.places("unbalance")
    size = numbers.magnitude[at]
    a, b = (accepted.values[at] * size).tolist()
    amplitude, sd, phase, phase_sd = amplitude_and_phase(
        a, b, accepted.covariance[np.ix_(at, at)] * np.outer(size, size)
    )
    return {
        **found,
        "unbalance": TrackedValue(value=amplitude, sd=sd, stale=stale),
        "unbalance_phase": TrackedValue(value=phase, sd=phase_sd, stale=stale),
    }


# Numbers that describe the noise are seen through the innovations alone: over short blocks the squares of what they
# explain are up to half as large again as chi-squared has it (as in the estimate of a root near one)
_SHORT_BLOCKS = 1.5


class Publication:
    """The published numbers of a tracker.

    `rpem`: the working estimate; what it starts from is published first; `t0`: time of the start, s of record.

    `unconfirmed`: numbers were found again after a change, and no later data have confirmed them yet; `updates`: times
    that published parameters or gains moved.
    """

    def __init__(self, rpem: PhysicalRpem, operator: Operator, log: DecisionLog, t0: float) -> None:
        numbers = rpem.numbers
        self._rpem, self._operator, self._log = rpem, operator, log
        self.gate = Gate(
            numbers.names,
            start=numbers.start,
            covariance=numbers.covariance,
            t=t0,
            overdispersion=numbers.overdispersion,
        )
        self._own = numbers.places("parameter", "gain")
        self.unconfirmed, self.updates = False, 0
        self._held = False

    @property
    def accepted(self) -> Accepted:
        """Published numbers."""
        return self.gate.accepted

    def restart(self) -> None:
        """Drop what waits: data from before a change say nothing of what holds now."""
        self.gate.restart()

    def propose(self, t: float, why: str) -> None:
        """Offer the working estimate.

        `t`: s of record.
        """
        refused = self.gate.propose(self._rpem.filter.q, self._rpem.filter.covariance, t, why)
        if refused is not None and self.unconfirmed:
            self._log.add(refused)

    def judge(self, evidence: Evidence, t: float) -> bool:
        """Decide on the candidate with one more block; offer the next.

        `evidence`: already taken in by the working estimate; `t`: its end, s of record. Returns whether numbers that
        were found again have been confirmed.
        """
        if self._operator.holding:
            self._held = True
            return False
        if self._held:  # what waited since before the hold is old by now
            self._held = False
            self.gate.restart()
        confirmed = False
        if self.gate.pending or self.gate.on_probation:
            self.gate.overdispersion = _SHORT_BLOCKS * max(self._rpem.noise, 1.0)
            before = self.accepted
            event = self.gate.judge(evidence, t)
            if event is not None:
                confirmed = self._decided(event, before)
        if not self.gate.pending:
            self.propose(t, "the recursion continued")
        return confirmed

    def _decided(self, event: Event, before: Accepted) -> bool:
        if event.kind != "accepted":
            self._log.add(event)
            if event.kind == "reverted":
                self._rpem.filter.set(self.accepted.values, self.accepted.covariance)
                self._rpem.move_to(self.accepted.values)
            return False
        self.updates += not np.array_equal(self.accepted.values[self._own], before.values[self._own])
        if not self.unconfirmed:
            return False
        self._log.add(event)
        self.unconfirmed = False
        return True

    def obey(self, t: float, *, searching: bool) -> bool:
        """Carry out what the operator ordered.

        `t`: s of record; `searching`: whether the working estimate is that from before a change whose search goes on.
        Returns whether something else is published now.
        """
        order = self._operator.take()
        if order is None:
            return False
        before = self.accepted
        if order == "accept" and searching:
            why = "a change was found but not its new value; there is nothing to accept"
            self._log.add(Event(kind="refused", t=t, why=why))
        elif order == "accept":
            self.gate.restart()
            self.propose(t, "the present estimate")
            self._log.add(self.gate.accept(t))
            self.unconfirmed = False
        else:
            self._log.add(self.gate.revert(t, "by order of the operator"))
            self._log.add(self._operator.set("hold", t, "after going back, until the operator sets track"))
        changed = self.accepted is not before
        self.updates += changed
        return changed

    def order(self, flag: str, t: float) -> None:
        """Take a flag of the operator; of two orders before the next block the first counts.

        `t`: s of record.
        """
        try:
            self._log.add(self._operator.set(flag, t))
        except EstimationError as waiting:
            self._log.add(Event(kind="refused", t=t, why=str(waiting)))
