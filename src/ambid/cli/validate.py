"""``ambid validate``: the checks of an estimate on other data."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from ambid.cli import options as opt
from ambid.cli.output import Outputs
from ambid.cli.terminal import progress


def command(
    estimate: Annotated[Path, opt.argument("ESTIMATE.json", "JSON file written by 'ambid identify' or 'ambid fit'.")],
    record: opt.RecordFile,
    rig: opt.RigFile = None,
    from_s: opt.From = None,
    to_s: opt.To = None,
    rate: opt.Rate = None,
    gaps: opt.Gaps = None,
    layout: opt.Layout = None,
    json: opt.JsonFile = None,
    plot: opt.Plot = None,
    report: opt.Report = None,
    strict: opt.Strict = False,
) -> None:
    """Judge an estimate on another record of the same bench: nothing is fitted but offsets and initial state.

    Without --rig, the record is read through the rig that the estimate was made with.
    """
    from ambid.job.results import validate

    with Outputs(estimate, record, rig, json=json, plot=plot, report=report) as outputs, progress("validate") as show:
        found = validate(
            estimate, record, rig, from_s=from_s, to_s=to_s, rate_hz=rate, gaps=gaps, layout=opt.layout_of(layout)
        )
        outputs.give(found, show)
    outputs.show(found, strict=strict)
