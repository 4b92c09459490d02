"""``ambid compare``: several black-box structures on one record, judged on data that none of them has seen."""

from __future__ import annotations

from typing import Annotated

import typer

from ambid.cli.options import (
    FAILED_CHECK,
    From,
    Gaps,
    Inputs,
    JsonFile,
    OpenLoop,
    OutputColumns,
    Rate,
    RecordFile,
    References,
    SecondRecord,
    Strict,
    To,
    argument,
    json_path,
    orders_of,
    switch,
)
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter, progress


def command(
    record: RecordFile,
    candidates: Annotated[
        list[str],
        argument(
            "STRUCTURE:ORDERS...",
            "What to compare: arx:na=2,nb=2,nk=1 or bj:auto; 'ambid models' lists the structures.",
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
        float, switch("--holdout", "Part of the record held back to judge on, where there is no second.")
    ] = 0.3,
    json: JsonFile = None,
    strict: Strict = False,
) -> None:
    """Fit several structures to a record and compare them on data that none of them has seen.

    Without --validate, the last part of the record is held back. Best first.
    """
    from ambid.estimation.documents import json_text, plain_json
    from ambid.job import compare
    from ambid.report.tables import comparison_text

    with Outputs(record, second) as outputs:
        outputs.claim(json_path(json), "--json")
        named = (c.partition(":") for c in candidates)
        wanted = [(name.strip(), orders_of(orders or "auto")) for name, _, orders in named]
        with progress("compare") as tick:
            found = compare(
                record, wanted, inputs=inputs or (), outputs=output or (), references=reference or (),
                open_loop=open_loop, from_s=from_s, to_s=to_s, rate_hz=rate, gaps=gaps, validate=second,
                holdout=holdout, tick=tick,
            )  # fmt: skip
        document = {"schema": "ambid.comparison/1", "record": record.name, **plain_json(found.as_dict())}
        written = json_text(document)
        outputs.stage_json(json, written)
    typer.echo(written if json == "-" else comparison_text(found, paint=painter()), nl=json != "-")
    if strict and any(e.fit is None or not e.fit.passed for e in found.entries):
        raise typer.Exit(FAILED_CHECK)
