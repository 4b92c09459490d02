"""What an alarm is, and the word of somebody who has taken note of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

RecordKind = Literal["stale", "unusable", "failed", "unseen", "date", "name", "double"]
KINDS: tuple[str, ...] = get_args(RecordKind)


@dataclass(frozen=True, slots=True, kw_only=True)
class Silence:
    """An alarm that somebody acknowledged, or silenced.

    Attributes
    ----------
    at : float
        When that was, s since 1970.
    kind : str
        "acknowledge": the alarm that stood then; "silence": whatever the rule raises until a time.
    bearing, rule, parameter : str
        Of the alarm.
    since : float or None
        When the alarm was raised; None: any of the rule.
    until : float or None
        When it is over, s since 1970; None: with the alarm.
    who, why : str
    """

    at: float
    kind: str
    bearing: str
    rule: str
    parameter: str = ""
    since: float | None = None
    until: float | None = None
    who: str
    why: str

    def of(self, alarm: Alarm, now: float) -> bool:
        """Return whether it is about an alarm, and not over.

        Parameters
        ----------
        alarm : Alarm
        now : float
            s since 1970.

        Returns
        -------
        bool
        """
        same = (self.bearing, self.rule, self.parameter) == (alarm.bearing, alarm.rule, alarm.parameter)
        return same and self.since in (None, alarm.raised) and (self.until is None or now < self.until)


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarm:
    """An alarm that a rule raised.

    Attributes
    ----------
    bearing, parameter, rule : str
        No parameter where it is about records; the rule is then the kind.
    raised : float
        Record that raised it, or when a record was overdue, s since 1970.
    cleared : float or None
        Record that cleared it; None while it stands.
    change, change_sd : float or None
        Relative, at the end or before it was cleared.
    limit : float or None
        What the rule makes of the first level, SI.
    kind : str
        "drift" or "step" of a parameter. Of records: "stale", none came; "unusable", "failed", none gave anything
        usable; "unseen", none showed a parameter; "date", taken at an impossible time; "name", perhaps another
        bearing's; "double", stored twice.
    at, at_from, at_to : float
        When the step was, or a drift crossed the limit, and the 95 % interval, s since 1970; of records the first one
        that is meant, and the stretch between the last sound one before and the next, or now.
    cause : str
        What the changes of all parameters together speak for, or that they leave it open; of records what was found.
    noted : Silence or None
        Who acknowledged or silenced it, until when and why.
    """

    bearing: str
    parameter: str
    rule: str
    raised: float
    cleared: float | None = None
    change: float | None = None
    change_sd: float | None = None
    limit: float | None = None
    kind: Literal["drift", "step"] | RecordKind
    at: float
    at_from: float
    at_to: float
    cause: str
    noted: Silence | None = None

    @property
    def open(self) -> bool:
        """Whether it stands and nobody has taken note of it."""
        return self.cleared is None and self.noted is None
