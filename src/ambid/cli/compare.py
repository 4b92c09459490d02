"""``ambid compare``: several black-box structures on one record, judged on data that none of them has seen."""

from __future__ import annotations

from typing import Annotated

from ambid.cli import options as opt
from ambid.cli.output import Outputs
from ambid.cli.terminal import progress


def command(
    record: opt.RecordFile,
    candidates: Annotated[
        list[str],
        opt.argument(
            "STRUCTURE:ORDERS...",
            "Structure and orders to compare: arx:na=2,nb=2,nk=1 or bj:auto; 'ambid models' lists the structures.",
        ),
    ],
    output: opt.OutputColumns = None,
    inputs: opt.Inputs = None,
    reference: opt.References = None,
    open_loop: opt.OpenLoop = False,
    from_s: opt.From = None,
    to_s: opt.To = None,
    rate: opt.Rate = None,
    gaps: opt.Gaps = None,
    layout: opt.Layout = None,
    second: opt.SecondRecord = None,
    holdout: Annotated[
        float, opt.switch("--holdout", "Fraction of the record held out for validation, without a second record.")
    ] = 0.3,
    json: opt.JsonFile = None,
    plot: opt.Plot = None,
    report: opt.Report = None,
    strict: opt.Strict = False,
) -> None:
    """Fit several structures to a record and compare them on data that none of them has seen.

    Without --validate, the last part of the record is held back. Best first.
    """
    from ambid.job import compare

    with Outputs(record, second, json=json, plot=plot, report=report) as outputs, progress("compare") as tick:
        found = compare(
            record, candidates, input=inputs, output=output, reference=reference,
            open_loop=open_loop, from_s=from_s, to_s=to_s, rate_hz=rate, gaps=gaps, layout=opt.layout_of(layout),
            validate=second, holdout=holdout, tick=tick,
        )  # fmt: skip
        outputs.give(found, tick)
    outputs.show(found, strict=strict)
