"""``ambid history``: a bearing over time, from a ledger."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ambid.cli import options as opt
from ambid.cli.options import option
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter
from ambid.errors import refuse_given


def command(
    ledger: Annotated[str, option("--ledger FILE.db|URL", "The ledger: file of SQLite, or URL of PostgreSQL.")],
    bearing: Annotated[str | None, opt.argument("BEARING", "Name of the bearing; without it all are listed.")] = None,
    export: Annotated[
        Path | None, option("--export FOLDER", "Write the ledger's tables as Parquet, for DuckDB or pandas.")
    ] = None,
    json: opt.JsonFile = None,
    plot: opt.Plot = None,
    report: opt.Report = None,
    strict: opt.Strict = False,
) -> None:
    """Show a bearing over time: its parameters with bands, verdicts, events, changes of the rig.

    What no record showed is a gap and never a number. Without BEARING the bearings of the ledger are listed, and the
    records that gave no estimate.
    """
    from ambid.ledger import open_ledger
    from ambid.report.history_text import bearings_text

    place = None if "://" in ledger else Path(ledger)
    with Outputs(place, json=json, plot=plot, report=report) as outputs:
        if bearing is None:
            refuse_given(
                {"--json": json, "--plot": plot, "--report": report, "--strict": strict},
                "{} is for one bearing. Name it, or omit {}",
            )
        with open_ledger(ledger, write=False) as found:
            if export is not None:
                typer.echo(f"{export} holds {', '.join(found.export(export))}", err=True)
            if bearing is None:
                typer.echo(bearings_text(found.bearings(), found.failures().values(), paint=painter()))
                return
            history = found.history(bearing)
        outputs.give(history)
    outputs.show(history, strict=strict)
