"""How a bearing of a ledger stands now: last estimate, last usable one, its age, alarms that stand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ambid.ledger.history import History, KnownEstimate
from ambid.ledger.monitor import Alarm, watch
from ambid.ledger.rules import BUILT_IN, Rule

_LATE = 3.0  # usual times between two estimates after which the last usable one is stale
_DAY_S = 86400.0
_UNKNOWN_S = 30.0 * _DAY_S  # that time where two estimates do not say what is usual

State = Literal["alarm", "unusable", "stale", "caution", "good"]
STATES: tuple[State, ...] = ("alarm", "unusable", "stale", "caution", "good")
"""The gravest first."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Standing:
    """How a bearing stands."""

    bearing: str
    plant: str
    estimates: int
    last: KnownEstimate
    usable: KnownEstimate | None  # the last one that may be used, with caution or without; None: there is none
    stale_after_s: float  # age of that from which it is stale, s
    alarms: tuple[Alarm, ...]  # that stand

    def age_s(self, now: float) -> float | None:
        """Return the age of the last usable estimate at a time, s since 1970."""
        return None if self.usable is None else max(0.0, now - self.usable.taken_at)

    def state(self, now: float) -> State:
        """Return the gravest that can be said: an alarm stands, the last estimate is not to be used, no usable one is
        recent, caution.
        """
        age = self.age_s(now)
        if self.alarms:
            return "alarm"
        if age is None or self.last.verdict == "unusable":
            return "unusable"
        if age > self.stale_after_s:
            return "stale"
        return "caution" if self.last.verdict == "caution" else "good"


def standing_of(history: History, rules: Sequence[Rule] = BUILT_IN) -> Standing:
    """Return how a bearing stands, by its history and rules of alarms."""
    taken = np.array([e.taken_at for e in history.estimates])
    gaps = np.diff(taken)
    usual = float(np.median(gaps[gaps > 0.0])) if np.count_nonzero(gaps > 0.0) > 1 else None
    usable = [e for e in history.estimates if e.verdict != "unusable"]
    return Standing(
        bearing=history.bearing, plant=history.plant, estimates=len(history.estimates), last=history.estimates[-1],
        usable=usable[-1] if usable else None,
        stale_after_s=_UNKNOWN_S if usual is None else max(_LATE * usual, _DAY_S),
        alarms=watch([history], rules).standing,
    )  # fmt: skip
