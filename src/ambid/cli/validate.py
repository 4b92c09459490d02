"""``ambid validate``: the checks of an estimate on other data."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from ambid.cli import options as opt
from ambid.cli.output import Outputs, end
from ambid.cli.terminal import progress

if TYPE_CHECKING:
    from ambid.report.text import Paint


def command(
    estimate: Annotated[
        Path, opt.argument("ESTIMATE.json", "What 'ambid identify --json' or 'ambid fit --json' wrote.")
    ],
    record: opt.RecordFile,
    rig: opt.RigFile = None,
    from_s: opt.From = None,
    to_s: opt.To = None,
    rate: opt.Rate = None,
    gaps: opt.Gaps = None,
    json: opt.JsonFile = None,
    strict: opt.Strict = False,
) -> None:
    """Judge an estimate on another record of the same bench: nothing is fitted but offsets and initial state.

    Without --rig: the record is read as the one that the estimate came from.
    """
    from ambid.estimation.estimate import json_text, plain_json
    from ambid.job.results import load, validate
    from ambid.report.estimate_text import validation_lines
    from ambid.report.fit_text import second_lines
    from ambid.rig import load_rig

    with Outputs(estimate, record, rig, json=json) as outputs:
        known: Any = load(estimate)
        with progress("validate"):
            bench = None if rig is None else load_rig(rig)
            found = validate(
                known, estimate, record, bench, from_s=from_s, to_s=to_s, rate_hz=rate, gaps=gaps
            )  # fmt: skip
        document = {"schema": "ambid.validation/1", "estimate": estimate.name, "record": record.name, **found}
        outputs.keep(json_text(plain_json(document)))

    def text(paint: Paint) -> str:
        if "objections" in found:
            model = known.structure
            lines = [*second_lines(found["fit"]), *(f"it does not hold there: {x}" for x in found["objections"])]
        else:
            model, lines = f"model {known.model}", validation_lines(found, paint=paint)
        return "\n".join([f"{paint(record.name, 'strong')} judged with {estimate.name}, {model}\n", *lines])

    outputs.show(text)
    end(failed=strict and not found["passed"])
