"""``ambid validate``: the checks of an estimate on other data."""

from __future__ import annotations

import json as json_format
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ambid.cli.options import FAILED_CHECK, From, Gaps, JsonFile, Rate, RecordFile, RigFile, Strict, To, json_path
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter, progress
from ambid.errors import AmbidError, EstimationError

if TYPE_CHECKING:
    from ambid.bearing.magnet.result import NonlinearBearingEstimate
    from ambid.blackbox.fit import BlackBoxFit
    from ambid.estimation.estimate import Estimate
    from ambid.nonlinear.fit import NonlinearFit
    from ambid.rig import Rig


def command(
    estimate: Annotated[
        Path,
        typer.Argument(
            metavar="ESTIMATE.json",
            help="What 'ambid identify --json' or 'ambid fit --json' wrote.",
            show_default=False,
        ),
    ],
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
    from ambid.bearing.magnet.result import NonlinearBearingEstimate
    from ambid.blackbox.fit import BlackBoxFit
    from ambid.job.estimates import read_estimate
    from ambid.nonlinear.fit import NonlinearFit

    with Outputs(estimate, record, rig) as outputs:
        outputs.claim(json_path(json), "--json")
        known = read_estimate(estimate)
        with progress("validate"):
            if isinstance(known, BlackBoxFit | NonlinearFit):
                if rig is not None:
                    raise EstimationError(f"{estimate.name} is a black-box fit, which knows no rig. Leave --rig out")
                found, lines = _judged_fit(known, record, (from_s, to_s), rate, gaps)
                model, passed = known.structure, bool(found["passed"])
            else:
                bench = _rig_of(known, estimate, rig)
                if isinstance(known, NonlinearBearingEstimate):
                    found, lines = _judged_bearing(known, record, bench, (from_s, to_s), rate, gaps)
                else:
                    found, lines = _judged_estimate(known, record, bench, (from_s, to_s), rate, gaps)
                model, passed = f"model {known.model}", bool(found["passed"])
        document = {"schema": "ambid.validation/1", "estimate": estimate.name, "record": record.name, **found}
        text = json_format.dumps(document, indent=1, allow_nan=False) + "\n"
        if (path := json_path(json)) is not None:
            outputs.stage_text(path, text)
    if json == "-":
        typer.echo(text, nl=False)
    else:
        paint = painter()
        typer.echo(f"{paint(record.name, 'strong')} judged with {estimate.name}, {model}\n")
        typer.echo("\n".join(lines))
    if strict and not passed:
        raise typer.Exit(FAILED_CHECK)


Part = tuple[float | None, float | None]


def _judged_estimate(
    known: Estimate, record: Path, bench: Rig, part: Part, rate: float | None, gaps: str | None
) -> tuple[dict[str, Any], list[str]]:
    from ambid.job import load, signals_of
    from ambid.physics.models import model
    from ambid.report.estimate_text import validation_lines
    from ambid.validate.second_record import validation

    used = load(record, bench, from_s=part[0], to_s=part[1], rate_hz=rate, gaps=gaps)
    found = dict(validation(known, signals_of(used, model(known.model))))
    return found, validation_lines(found, paint=painter())


def _judged_bearing(
    known: NonlinearBearingEstimate, record: Path, bench: Rig, part: Part, rate: float | None, gaps: str | None
) -> tuple[dict[str, Any], list[str]]:
    from ambid.job.nonlinear_bearing import validate_bearing
    from ambid.report.estimate_text import validation_lines

    found = validate_bearing(known, record, bench, from_s=part[0], to_s=part[1], rate_hz=rate, gaps=gaps)
    return found, validation_lines(found, paint=painter())


def _judged_fit(
    known: BlackBoxFit | NonlinearFit, record: Path, part: Part, rate: float | None, gaps: str | None
) -> tuple[dict[str, Any], list[str]]:
    from ambid.blackbox.fit import BlackBoxFit
    from ambid.estimation.documents import plain_json
    from ambid.job import read_data
    from ambid.job.blackbox import same_bench
    from ambid.report.fit_text import second_lines
    from ambid.validate.blackbox import validation
    from ambid.validate.second_record import objections

    found: Mapping[str, Any]
    data = read_data(record, known.inputs, known.outputs, part=part, rate_hz=rate, gaps=gaps)
    same_bench(known.units, known.dt, data)
    if not isinstance(known, BlackBoxFit):
        from ambid.validate.nonlinear import validation as nonlinear_validation

        found = nonlinear_validation(known, data)
    else:
        found = validation(known, data)
    lines = second_lines(found)
    against = objections(known, found)
    said = {"samples": data.n_samples, "fit": plain_json(found), "passed": not against, "objections": list(against)}
    return said, lines + [f"it does not hold there: {x}" for x in against]


def _rig_of(estimate: Estimate | NonlinearBearingEstimate, path: Path, rig: Path | None) -> Rig:
    """Load the rig that is given, or the one that the estimate remembers."""
    from ambid.rig import load_rig, rig_from_text

    if rig is not None:
        return load_rig(rig)
    text, folder = estimate.rig.get("text"), estimate.rig.get("folder")
    if not isinstance(text, str) or not isinstance(folder, str):
        raise EstimationError(f"estimate {path} does not hold its rig. Give --rig")
    try:
        return rig_from_text(text, Path(folder) / "rig.toml")
    except AmbidError as error:
        raise EstimationError(
            f"estimate {path}: the rig that it remembers cannot be used: {error}. Or give --rig"
        ) from None
