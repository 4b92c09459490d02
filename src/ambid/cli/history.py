"""``ambid history``: a bearing over time, from a ledger."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import typer

from ambid.cli.options import Values, verb
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter
from ambid.errors import AmbidError
from ambid.estimation.result import Result
from ambid.job.files import METRICS_ENDINGS
from ambid.settings.caller import command as command_of
from ambid.settings.caller import refuse_given, setting

_USUAL = "usual"
_CHANGES = ("rename", "redate", "remove", "undo")


def _corrected(v: Values) -> bool:
    """Correct the ledger, where that is asked for."""
    from ambid.ledger import open_ledger
    from ambid.ledger.entry import moment

    changes = [name for name in _CHANGES if v[name] not in (None, False)]
    if not changes:
        unused = v.only("record who why" if v.acknowledge is None else "record")
        refuse_given(unused, f"{{}} is for {', '.join(map(setting, _CHANGES))}. Give one, or omit {{}}")
        return False
    if len(changes) > 1:
        raise AmbidError(f"{' and '.join(map(setting, changes))} are {len(changes)} changes. Make them one by one")
    change: Any = changes[0]
    shown = "every alarms acknowledge until publish json plot report strict"
    refuse_given(v.only(shown), f"{{}} is not for {setting(change)}")
    if change == "undo":
        refuse_given(v.only("bearing record"), "--undo takes a number alone. Omit {}")
    elif v.bearing is None:
        raise AmbidError(f"{setting(change)} is for one bearing. Name it")
    about = {name: v[name] or "" for name in ("who", "why")}
    with open_ledger(v.ledger, make=False) as ledger:
        if change == "undo":
            done = ledger.undo(v.undo, **about)
        else:
            to = moment(v.redate, "redate") if change == "redate" else v.rename or ""
            done = ledger.correct(change, v.bearing, to, record=v.record, **about)
        typer.echo(f"{ledger.shown}: {done.text}. Undo: {command_of('history', ledger=ledger.shown, undo=done.number)}")
    return True


@verb("history")
def command(v: Values) -> None:
    """Show a bearing over time: its parameters with bands, verdicts, events, changes of the rig.

    What no record showed is a gap and never a number. Without BEARING the bearings of the ledger are listed, and the
    records that gave no estimate. With --alarms and --strict the exit code is 3 where an alarm stands that nobody has
    acknowledged or silenced.

    --rename, --redate and --remove correct the bearing, or one --record of it, and tell how that is undone. They hold
    for later estimates of the same records too.
    """
    if _corrected(v):
        return
    from ambid.ledger import Watched, open_ledger, read_rules, watch
    from ambid.ledger.entry import moment
    from ambid.ledger.rules import BUILT_IN
    from ambid.ledger.silences import silences, take_note
    from ambid.ledger.telling import write_metrics
    from ambid.report.history import bearings_text

    place = None if "://" in v.ledger else Path(v.ledger)
    file = None if v.alarms in (None, _USUAL) else Path(str(v.alarms))
    with Outputs(place, file, **v.outputs) as outputs:
        outputs.claim(v.publish, "publish", METRICS_ENDINGS)
        rules = BUILT_IN if file is None else read_rules(file)
        if v.alarms is None:
            refuse_given(v.only("publish acknowledge"), "{} needs --alarms. Give it, or omit {}")
            if v.bearing is None:
                refuse_given(v.only("every"), "{} is for one bearing. Name it, or omit {}")
        else:
            refuse_given(v.only("every"), "{} is not for --alarms. Omit {}")
        if v.acknowledge is None:
            refuse_given(v.only("until"), "{} needs --acknowledge. Give it, or omit {}")
        elif v.bearing is None or not (v.why or "").strip():
            raise AmbidError("--acknowledge needs the name of the BEARING, and --why. Give them")
        until = None if v.until is None else moment(v.until, "until")
        if until is not None and until <= time.time():
            raise AmbidError(f"{setting('until', v.until)} is over already. Give a later time")
        if v.bearing is None and v.alarms is None:
            refuse_given(v.only("json plot report strict"), "{} is for one bearing. Name it, or omit {}")
        with open_ledger(v.ledger, write=v.acknowledge is not None, make=False) as found:
            result: Result
            if v.alarms is not None:
                names = [b.name for b in found.bearings()] if v.bearing is None else [v.bearing]
                now = time.time()
                failed = [f for f in found.failures().values() if v.bearing in (None, f.bearing)]

                def look() -> Watched:
                    return watch(map(found.history, names), rules, failures=failed, silences=silences(found), now=now)

                watched = look()
                if v.acknowledge is not None:
                    said = {"now": now, "who": v.who or "", "why": v.why, "until": until}
                    own = take_note(found, watched.alarms, v.acknowledge, **said)
                    typer.echo(f"{', '.join(a.rule for a in own)}: noted in {found.shown}", err=True)
                    watched = look()
                result = watched
                if v.publish is not None:
                    outputs.stage(v.publish, lambda beside: write_metrics(watched, beside))
            elif v.bearing is None:
                known = found.bearings(), found.failures().values(), found.corrections()
                typer.echo(bearings_text(*known, paint=painter()))
                return
            else:
                result = found.history(v.bearing, every=v.every)
        outputs.give(result)
    outputs.show(result, strict=v.strict)
