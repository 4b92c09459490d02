"""From the working estimate to the published one: candidates, their validation, and the operator's orders.

The working estimate goes on whatever happens here; only what later data have confirmed, or the operator has ordered,
is published.
"""

from __future__ import annotations

import numpy as np

from ambid.errors import EstimationError
from ambid.recursive.lines import Event
from ambid.track.evidence import Evidence
from ambid.track.physical.rpem import PhysicalRpem
from ambid.track.supervise.comparison import Accepted
from ambid.track.supervise.gate import Gate
from ambid.track.supervise.log import DecisionLog
from ambid.track.supervise.operator import Operator

# Numbers that describe the noise are seen through the innovations alone: over short blocks the squares of what they
# explain are up to half as large again as chi-squared has it (as in the estimate of a root near one)
_SHORT_BLOCKS = 1.5


class Publication:
    """The published numbers of a tracker.

    `rpem`: the working estimate; what it starts from is published first; `t0`: time of the start, s of record.

    `unconfirmed`: numbers were found anew after a change, and no later data have confirmed them yet; `updates`: times
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
        were found anew have been confirmed.
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
            self.propose(t, "the recursion went on")
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
            why = "a change has been found and its new value has not; there is nothing to accept"
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
