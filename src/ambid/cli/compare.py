"""``ambid compare``: several black-box structures on one record, judged on data that none of them has seen."""

from __future__ import annotations

import json as json_format
from typing import Annotated

import typer

from ambid.cli.blackbox_options import Inputs, OpenLoop, OutputColumns, References, SecondRecord, orders_of
from ambid.cli.options import FAILED_CHECK, From, Gaps, JsonFile, Rate, RecordFile, Strict, To, json_path
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter, progress


def command(
    record: RecordFile,
    candidates: Annotated[
        list[str],
        typer.Argument(
            metavar="STRUCTURE:ORDERS...",
            help="What to compare: arx:na=2,nb=2,nk=1 or bj:auto; 'ambid models' lists the structures.",
            show_default=False,
        ),
    ],
    output: OutputColumns = None,
    inputs: Inputs = None,
    reference: References = None,
    open_loop: OpenLoop = False,
    from_s: From = None,
    to_s: To = None,
    rate: Rate = None,
    gaps: Gaps = None,
    second: SecondRecord = None,
    holdout: Annotated[
        float, typer.Option("--holdout", help="Part of the record held back to judge on, where there is no second.")
    ] = 0.3,
    json: JsonFile = None,
    strict: Strict = False,
) -> None:
    """Fit several structures to a record and compare them on data that none of them has seen.

    Without --validate, the last part of the record is held back. Best first.
    """
    from ambid.estimation.documents import plain_json
    from ambid.job import compare
    from ambid.report.tables import comparison_text

    with Outputs(record, second) as outputs:
        outputs.claim(json_path(json), "--json")
        wanted = [
            (name.strip(), orders_of(orders or "auto")) for name, _, orders in (c.partition(":") for c in candidates)
        ]
        with progress("compare") as tick:
            found = compare(
                record,
                wanted,
                inputs=inputs or (),
                outputs=output or (),
                references=reference or (),
                open_loop=open_loop,
                from_s=from_s,
                to_s=to_s,
                rate_hz=rate,
                gaps=gaps,
                validate=second,
                holdout=holdout,
                tick=tick,
            )
        document = {"schema": "ambid.comparison/1", "record": record.name, **plain_json(found.as_dict())}
        written = json_format.dumps(document, indent=1, allow_nan=False) + "\n"
        if (path := json_path(json)) is not None:
            outputs.stage_text(path, written)
    if json == "-":
        typer.echo(written, nl=False)
    else:
        typer.echo(comparison_text(found, paint=painter()))
    if strict and any(e.fit is None or not e.fit.passed for e in found.entries):
        raise typer.Exit(FAILED_CHECK)
