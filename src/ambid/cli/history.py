"""``ambid history``: a bearing over time, from a ledger."""

from __future__ import annotations

from pathlib import Path

import typer

from ambid.cli.options import Values, verb
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter
from ambid.errors import counted
from ambid.estimation.result import Result
from ambid.job.files import METRICS_ENDINGS
from ambid.settings.caller import refuse_given

_USUAL = "usual"


@verb("history")
def command(v: Values) -> None:
    """Show a bearing over time: its parameters with bands, verdicts, events, changes of the rig.

    What no record showed is a gap and never a number. Without BEARING the bearings of the ledger are listed, and the
    records that gave no estimate. With --alarms and --strict the exit code is 3 where an alarm stands.
    """
    from ambid.ledger import open_ledger, read_rules, watch
    from ambid.ledger.monitor import BUILT_IN
    from ambid.ledger.telling import publish, write_metrics
    from ambid.report.history import bearings_text

    place = None if "://" in v.ledger else Path(v.ledger)
    file = None if v.alarms in (None, _USUAL) else Path(str(v.alarms))
    with Outputs(place, file, **v.outputs) as outputs:
        gauges = [Path(x) for x in v.publish or () if x.endswith(METRICS_ENDINGS)]
        for path in gauges:
            outputs.claim(path, "publish", METRICS_ENDINGS)
        rules = BUILT_IN if file is None else read_rules(file)
        if v.alarms is None:
            refuse_given(v.only("publish"), "{} needs --alarms. Give it, or omit {}")
            if v.bearing is None and v.export is None:
                refuse_given(v.only("every"), "{} is for one bearing, or for --tables. Name it, or omit {}")
        else:
            refuse_given(v.only("every"), "{} is not for --alarms. Omit {}")
        if v.bearing is None and v.alarms is None:
            refuse_given(v.only("json plot report strict"), "{} is for one bearing. Name it, or omit {}")
        with open_ledger(v.ledger, write=False) as found:
            if v.export is not None:
                typer.echo(f"{v.export} holds {', '.join(found.export(v.export, every=v.every))}", err=True)
            result: Result
            if v.alarms is not None:
                names = [b.name for b in found.bearings()] if v.bearing is None else [v.bearing]
                result = watched = watch((found.history(name) for name in names), rules)
                for path in gauges:
                    outputs.stage(path, lambda beside: write_metrics(watched, beside))
                for broker in (x for x in v.publish or () if not x.endswith(METRICS_ENDINGS)):
                    typer.echo(f"{counted(publish(watched, broker), 'message')} sent to {broker}", err=True)
            elif v.bearing is None:
                typer.echo(bearings_text(found.bearings(), found.failures().values(), paint=painter()))
                return
            else:
                result = found.history(v.bearing, every=v.every)
        outputs.give(result)
    outputs.show(result, strict=v.strict)
