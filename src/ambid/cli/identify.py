"""``ambid identify``: physical parameters with uncertainty from one record, or a nonlinear magnet from several."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ambid.cli.interrupts import INTERRUPTED, Stop, interruptible, signals
from ambid.cli.options import (
    FAILED_CHECK,
    FIGURE_ENDINGS,
    PAGE_ENDINGS,
    From,
    Gaps,
    JsonFile,
    Rate,
    RigFile,
    Strict,
    To,
    argument,
    json_path,
    option,
    refuse_given,
    refuse_twice,
    switch,
)
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter, progress
from ambid.errors import AmbidError
from ambid.estimation.progress import Tick

if TYPE_CHECKING:
    from ambid.bearing.magnet.result import NonlinearBearingEstimate
    from ambid.estimation.estimate import Estimate
    from ambid.job.data import Reading
    from ambid.report.figures import BearingEvidence, Evidence


def command(
    records: Annotated[
        list[Path],
        argument(
            "RECORD...", "Record: .csv, .csv.gz, .h5 or .mat; with --nonlinear several, best at several positions."
        ),
    ],
    rig: RigFile = None,
    nonlinear: Annotated[
        bool, switch("--nonlinear", "The nonlinear magnet: k_i, k_x and L as curves over position and current.")
    ] = False,
    held: Annotated[
        list[Path] | None,
        option("--held", "RECORD", "Nonlinear: a record with the rotor held at rest, which shows the coil; repeat."),
    ] = None,
    magnet: Annotated[
        Literal["auto", "single", "pair"] | None,
        option(
            "--magnet",
            None,
            "Nonlinear: one magnet, or two that oppose each other; auto looks at the sign of the current.",
            "as the rig says, or auto",
        ),
    ] = None,
    eddy: Annotated[bool, switch("--eddy", "Nonlinear: the force follows the current with a pole a/(s + a).")] = False,
    drift: Annotated[
        bool, switch("--drift", "Nonlinear: let a slowly walking force take up what the law leaves over.")
    ] = False,
    off_below: Annotated[
        float | None,
        option(
            "--off-below",
            "V",
            "Nonlinear: at or below this voltage the power stage is off, and the coil's voltage not known.",
            "as the rig says",
        ),
    ] = None,
    second: Annotated[Path | None, option("--validate", "RECORD2", "Judge the estimate on this second record.")] = None,
    from_s: From = None,
    to_s: To = None,
    rate: Rate = None,
    gaps: Gaps = None,
    json: JsonFile = None,
    plot: Annotated[
        Path | None,
        option(
            "--plot",
            "FILE.png",
            "Draw signals, residuals, Bode and poles; with --nonlinear curves with bands, and every record.",
        ),
    ] = None,
    report: Annotated[Path | None, option("--report", "FILE.html", "Write a report, all in one file.")] = None,
    strict: Strict = False,
) -> None:
    """Identify the physical parameters of a bench from a record of voltage, current and position.

    Without --rig: columns named voltage, current and position, model one-axis, everything free.
    With --nonlinear, one model for all records, and curves with bands; what is known of the magnet stands in [magnet]
    of the rig. Ctrl-C then keeps the best so far (exit code 130).
    """
    from ambid.job.data import Reading

    stop, kept, how = Stop(), tuple(held or ()), Reading(from_s=from_s, to_s=to_s, rate_hz=rate, gaps=gaps)
    own = {"magnet": magnet, "eddy": eddy, "drift": drift, "off_below": off_below}
    if not nonlinear:
        _check_linear(records, {"held": kept, **own})
    with Outputs(*records, *kept, rig, second) as outputs:
        outputs.claim(json_path(json), "--json")
        outputs.claim(plot, "--plot", FIGURE_ENDINGS)
        outputs.claim(report, "--report", PAGE_ENDINGS)
        with signals(stop.take) if nonlinear else nullcontext(), progress("identify") as show:
            estimate, evidence = (
                _nonlinear(records, kept, rig, second, how, own, interruptible(show, stop))
                if nonlinear
                else _linear(records[0], rig, second, how, show)
            )
            stop.torn()
            if plot or report:
                show("draw")
                draw(evidence(), outputs, plot=plot, report=report)
        written = estimate.dumps()
        outputs.stage_json(json, written)
    if json == "-":
        typer.echo(written, nl=False)
    else:
        from ambid.report.estimate_text import estimate_text

        typer.echo(estimate_text(estimate, paint=painter()))
    search = getattr(estimate, "global_search", None)
    if stop.wished() or (search is not None and search["interrupted"]):
        raise typer.Exit(stop.code or INTERRUPTED)
    if strict and not (estimate.passed and (estimate.validation is None or estimate.validation["passed"])):
        raise typer.Exit(FAILED_CHECK)


def _check_linear(records: Sequence[Path], given: Mapping[str, object]) -> None:
    """Refuse what only the nonlinear magnet has."""
    refuse_given(
        {f"--{name.replace('_', '-')}": not (x is None or x is False or x == ()) for name, x in given.items()},
        "{} is for the nonlinear magnet. Give --nonlinear too, or leave {} out",
    )
    if len(records) > 1:
        raise AmbidError(
            f"{len(records)} records are given; the linear model takes one, since k_x, k_i and L differ from one "
            "operating point to the next. Give --nonlinear for one model of all, or one record"
        )


def _linear(
    record: Path, rig: Path | None, second: Path | None, how: Reading, tick: Tick
) -> tuple[Estimate, Callable[[], Evidence]]:
    from ambid.job import identify, load
    from ambid.job.identification import evidence_of
    from ambid.rig import default_rig, load_rig

    bench, part = default_rig() if rig is None else load_rig(rig), asdict(how)
    estimate = identify(record, bench, validate=second, tick=tick, **part)
    return estimate, lambda: evidence_of(estimate, load(record, bench, **part))


def _nonlinear(
    records: Sequence[Path],
    held: Sequence[Path],
    rig: Path | None,
    second: Path | None,
    how: Reading,
    own: Mapping[str, Any],
    tick: Tick,
) -> tuple[NonlinearBearingEstimate, Callable[[], BearingEvidence]]:
    from ambid.job.identification import identify_taken, read_records
    from ambid.report.figures import bearing_evidence

    off_below = own["off_below"]
    if off_below is not None and not isfinite(off_below):
        raise AmbidError(f"--off-below is {off_below}; it is a voltage in V. Give a number")
    refuse_twice([*records, *held])
    job = read_records(records, rig, held=held, validate=second, how=how, tick=tick, **own)
    estimate = identify_taken(job, tick=tick)
    return estimate, lambda: bearing_evidence(estimate, [(t.record, t.start_s) for t in job.taken])


def draw(evidence: Evidence | BearingEvidence, outputs: Outputs, *, plot: Path | None, report: Path | None) -> None:
    """Draw the figures of an estimate, and write its report."""
    from ambid.job.identification import report_of
    from ambid.report.drawing import save
    from ambid.report.figures import overview

    if plot is not None:
        outputs.stage(plot, lambda path: save(overview(evidence), path))
    if report is not None:
        outputs.stage_text(report, report_of(evidence))
