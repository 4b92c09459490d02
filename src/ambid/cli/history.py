"""``ambid history``: a bearing over time, from a ledger."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ambid.cli import options as opt
from ambid.cli.options import option
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter
from ambid.errors import counted
from ambid.estimation.result import Result
from ambid.job.files import METRICS_ENDINGS
from ambid.settings.caller import refuse_given

_USUAL = "usual"


def command(
    ledger: Annotated[str, option("--ledger FILE.db|URL", "The ledger: file of SQLite, or URL of PostgreSQL.")],
    bearing: Annotated[str | None, opt.argument("BEARING", "Name of the bearing; without it all are listed.")] = None,
    export: Annotated[
        Path | None, option("--export FOLDER", "Write the ledger's tables as Parquet, for DuckDB or pandas.")
    ] = None,
    alarms: Annotated[
        str | None,
        option(
            "--alarms RULES.toml|usual",
            "Watch the bearing, or all of them, for drifts and steps: by rules of a file, or by the usual ones.",
        ),
    ] = None,
    metrics: Annotated[
        Path | None, option("--metrics FILE.prom", "Write latest values and alarms for Prometheus; needs --alarms.")
    ] = None,
    mqtt: Annotated[
        str | None,
        option(
            "--mqtt HOST[:PORT]/TOPIC",
            "Send latest values and alarms to a broker of MQTT; needs --alarms. User and password: AMBID_MQTT_USER, "
            "AMBID_MQTT_PASSWORD.",
        ),
    ] = None,
    json: opt.JsonFile = None,
    plot: opt.Plot = None,
    report: opt.Report = None,
    strict: opt.Strict = False,
) -> None:
    """Show a bearing over time: its parameters with bands, verdicts, events, changes of the rig.

    What no record showed is a gap and never a number. Without BEARING the bearings of the ledger are listed, and the
    records that gave no estimate. With --alarms and --strict the exit code is 3 where an alarm stands.
    """
    from ambid.ledger import open_ledger, read_rules, watch
    from ambid.ledger.monitor import BUILT_IN
    from ambid.ledger.telling import publish, write_metrics
    from ambid.report.history import bearings_text

    place = None if "://" in ledger else Path(ledger)
    file = None if alarms in (None, _USUAL) else Path(str(alarms))
    with Outputs(place, file, json=json, plot=plot, report=report) as outputs:
        outputs.claim(metrics, "metrics", METRICS_ENDINGS)
        rules = BUILT_IN if file is None else read_rules(file)
        if alarms is None:
            refuse_given({"metrics": metrics, "mqtt": mqtt}, "{} needs --alarms. Give it, or omit {}")
        if bearing is None and alarms is None:
            refuse_given(
                {"json": json, "plot": plot, "report": report, "strict": strict},
                "{} is for one bearing. Name it, or omit {}",
            )
        with open_ledger(ledger, write=False) as found:
            if export is not None:
                typer.echo(f"{export} holds {', '.join(found.export(export))}", err=True)
            result: Result
            if alarms is not None:
                names = [b.name for b in found.bearings()] if bearing is None else [bearing]
                result = watched = watch((found.history(name) for name in names), rules)
                if metrics is not None:
                    outputs.stage(metrics, lambda beside: write_metrics(watched, beside))
                if mqtt is not None:
                    typer.echo(f"{counted(publish(watched, mqtt), 'message')} sent to {mqtt}", err=True)
            elif bearing is None:
                typer.echo(bearings_text(found.bearings(), found.failures().values(), paint=painter()))
                return
            else:
                result = found.history(bearing)
        outputs.give(result)
    outputs.show(result, strict=strict)
