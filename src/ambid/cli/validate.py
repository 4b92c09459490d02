"""``ambid validate``: the checks of an estimate on other data."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ambid.cli.options import (
    FAILED_CHECK,
    From,
    Gaps,
    JsonFile,
    Rate,
    RecordFile,
    RigFile,
    Strict,
    To,
    argument,
    json_path,
)
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter, progress
from ambid.errors import EstimationError


def command(
    estimate: Annotated[Path, argument("ESTIMATE.json", "What 'ambid identify --json' or 'ambid fit --json' wrote.")],
    record: RecordFile,
    rig: RigFile = None,
    from_s: From = None,
    to_s: To = None,
    rate: Rate = None,
    gaps: Gaps = None,
    json: JsonFile = None,
    strict: Strict = False,
) -> None:
    """Judge an estimate on another record of the same bench: nothing is fitted but offsets and initial state.

    Without --rig: the record is read as the one that the estimate came from.
    """
    from ambid.blackbox.fit import BlackBoxFit
    from ambid.estimation.documents import json_text, plain_json
    from ambid.job.results import judge_estimate, judge_fit, read_estimate, rig_of
    from ambid.nonlinear.fit import NonlinearFit
    from ambid.report.estimate_text import validation_lines
    from ambid.report.fit_text import second_lines
    from ambid.rig import load_rig

    with Outputs(estimate, record, rig) as outputs:
        outputs.claim(json_path(json), "--json")
        known = read_estimate(estimate)
        with progress("validate"):
            if isinstance(known, BlackBoxFit | NonlinearFit):
                if rig is not None:
                    raise EstimationError(f"{estimate.name} is a black-box fit, which knows no rig. Leave --rig out")
                found, model = judge_fit(known, record, (from_s, to_s), rate, gaps), known.structure
                lines = [*second_lines(found["fit"]), *(f"it does not hold there: {x}" for x in found["objections"])]
            else:
                bench, model = rig_of(known, estimate) if rig is None else load_rig(rig), f"model {known.model}"
                found = dict(judge_estimate(known, record, bench, (from_s, to_s), rate, gaps))
                lines = validation_lines(found, paint=painter())
        document = {"schema": "ambid.validation/1", "estimate": estimate.name, "record": record.name, **found}
        written = json_text(plain_json(document))
        outputs.stage_json(json, written)
    if json == "-":
        typer.echo(written, nl=False)
    else:
        typer.echo(f"{painter()(record.name, 'strong')} judged with {estimate.name}, {model}\n")
        typer.echo("\n".join(lines))
    if strict and not found["passed"]:
        raise typer.Exit(FAILED_CHECK)
