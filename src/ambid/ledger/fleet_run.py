"""The results of a job on many records."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from ambid.errors import counted
from ambid.estimation.result import Reason, Result

SCHEMA = "ambid.fleet/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetRow:
    """One record of a fleet."""

    record: str
    bearing: str
    rig: str
    taken_at: float | None  # s since 1970, UTC
    state: Literal["done", "failed", "known"]  # "known": its result was in the ledger before
    status: str = ""  # of the search
    verdict: str = ""
    checks: tuple[str, ...] = ()  # that speak against the result
    reason: str = ""  # why there is none
    seconds: float = 0.0
    # value and standard deviation by name, SI; None where the record does not show it
    values: Mapping[str, tuple[float | None, float | None]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class FleetRun(Result):
    """A job on many records.

    Attributes
    ----------
    job : str
        Its name.
    settings : str
        What was asked for beside records and rigs, JSON.
    ledger : str or None
        Where estimates were stored.
    workers : int
        Processes at work.
    seconds : float
        Of the whole, s.
    records : int
        That were to be done.
    units : Mapping of str to str
        Of the values, by name.
    rows : tuple of FleetRow
        One for each record that was come to, in their order.
    """

    job: str
    settings: str
    ledger: str | None
    workers: int
    seconds: float
    records: int
    units: Mapping[str, str]
    rows: tuple[FleetRow, ...]

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of records by state: done, failed, known, left."""
        of = Counter(row.state for row in self.rows)
        return {s: of[s] for s in ("done", "failed", "known")} | {"left": self.records - len(self.rows)}

    @property
    def failures(self) -> Mapping[str, tuple[str, ...]]:
        """Records by the reason why there is no result of them, the commonest first."""
        found: dict[str, list[str]] = {}
        for row in self.rows:
            if row.state == "failed":
                name = row.record.rpartition("/")[2]
                reason = row.reason.replace(row.record, "…").replace(name, "…")
                found.setdefault(reason, []).append(row.record)
        return {reason: tuple(r) for reason, r in sorted(found.items(), key=lambda x: -len(x[1]))}

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """What stands against the run as a whole: failures, results in doubt, records that it did not come to."""
        found, n = [], self.counts
        if n["failed"]:
            text = f"{n['failed']} of {counted(self.records, 'record')} failed"
            found.append(
                Reason(check="failures", text=f"{text}; the reasons are below", grave=not n["done"] + n["known"])
            )
        doubtful = {word: sum(r.verdict == word for r in self.rows) for word in ("unusable", "caution")}
        for word, m in doubtful.items():
            if m:
                found.append(
                    Reason(check="verdicts", text=f"{counted(m, 'result')} {'is' if m == 1 else 'are'} {word}")
                )
        if n["left"]:
            text = f"{counted(n['left'], 'record')} left: run again to go on"
            found.append(Reason(check="interrupted", text=text))
        return tuple(found)
