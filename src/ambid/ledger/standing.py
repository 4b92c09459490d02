"""How a bearing of a ledger stands now: last estimate, last usable one, its age, alarms that stand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from ambid.ledger.alarm import Alarm, Silence
from ambid.ledger.history import History, KnownEstimate
from ambid.ledger.monitor import watch
from ambid.ledger.rules import BUILT_IN, RecordRule, Rule

if TYPE_CHECKING:
    from ambid.ledger.store import Failure

_OF_RECORDS = ("stale", "unusable", "failed")  # alarms that are a state of their own

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
        kinds = {a.kind for a in self.alarms if a.open}
        if kinds - set(_OF_RECORDS):
            return "alarm"
        if age is None or self.last.verdict == "unusable" or kinds & {"unusable", "failed"}:
            return "unusable"
        if age > self.stale_after_s:
            return "stale"
        return "caution" if self.last.verdict == "caution" else "good"


def standing_of(
    history: History,
    rules: Sequence[Rule | RecordRule] = BUILT_IN,
    *,
    failures: Sequence[Failure] = (),
    silences: Sequence[Silence] = (),
    now: float | None = None,
) -> Standing:
    """Return how a bearing stands, by its history, rules of alarms, what failed and what somebody has taken note of."""
    watched = watch([history], rules, failures=failures, silences=silences, now=now)
    usable = [e for e in history.estimates if e.verdict != "unusable"]
    return Standing(
        bearing=history.bearing, plant=history.plant, estimates=len(history.estimates), last=history.estimates[-1],
        usable=usable[-1] if usable else None, stale_after_s=watched.states[0].overdue_s, alarms=watched.standing,
    )  # fmt: skip
