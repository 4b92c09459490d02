"""Alarms that were acknowledged or silenced, as a ledger keeps them: nothing is taken out, the latest word counts."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, fields

from ambid.errors import AmbidError, choices
from ambid.ledger.alarm import Alarm, Silence
from ambid.ledger.correcting import user
from ambid.ledger.entry import tables
from ambid.ledger.store import Ledger


def silences(ledger: Ledger) -> tuple[Silence, ...]:
    """Return what was acknowledged or silenced, in order."""
    from sqlalchemy import select

    t = tables().tables["silence"]
    names = [f.name for f in fields(Silence)]
    with ledger._reading() as c:
        rows = c.execute(select(*(t.c[name] for name in names)).order_by(t.c.at, t.c.id)).mappings().all()
    return tuple(Silence(**row) for row in rows)


def take_note(
    ledger: Ledger,
    alarms: Iterable[Alarm],
    rule: str,
    *,
    now: float,
    why: str,
    who: str = "",
    until: float | None = None,
) -> tuple[Alarm, ...]:
    """Acknowledge the alarms of a rule that stand, or silence the rule until a time; return which stand.

    `rule`: as alarms name it, or its parameter; `who`: default the account.
    """
    from sqlalchemy import insert

    standing = [a for a in alarms if a.cleared is None]
    own = tuple(a for a in standing if rule and rule in (a.rule, a.parameter))
    if not own:
        known = sorted({a.rule for a in standing})
        there = f"those that stand: {choices(rule, known)}" if known else "none stands."
        raise AmbidError(f"no alarm {rule!r} stands; {there} Check the name")
    said = [
        Silence(
            at=now, kind="acknowledge" if until is None else "silence", bearing=a.bearing, rule=a.rule,
            parameter=a.parameter, since=a.raised if until is None else None, until=until, who=who or user(), why=why,
        )
        for a in own
    ]  # fmt: skip
    with ledger._writing() as c:
        c.execute(insert(tables().tables["silence"]), [asdict(x) for x in said])
    return own
