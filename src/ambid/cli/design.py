"""``ambid design``: the experiment that shows a plant best, and the controller for it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from ambid.cli import options as opt
from ambid.cli.options import argument, band_of, option, preset_of
from ambid.cli.output import Outputs
from ambid.cli.terminal import progress

group = typer.Typer(rich_markup_mode=None, help="Design what comes next on an identified model.")


@group.command("experiment", short_help="design the excitation that shows the parameters best within limits")
def experiment(
    source: Annotated[
        str,
        argument("RIG|PRESET|ESTIMATE", "Rig file, a bench that 'ambid models' lists, or what identify --json wrote."),
    ],
    record: Annotated[
        Path | None, option("--out -o FILE", "Write one period of the excitation: .csv, .csv.gz or .h5.")
    ] = None,
    rig: opt.RigFile = None,
    seconds: Annotated[float | None, option("--seconds S", "Length of the record in s.", "10")] = None,
    period: Annotated[
        float | None,
        option("--period S", "Period of the excitation in s.", "a quarter of the record, or the controller's table"),
    ] = None,
    band: Annotated[
        str | None, option("--band LO:HI", "Band of the excitation in Hz.", "one period to a fifth of the rate")
    ] = None,
    lines: Annotated[int, option("--lines N", "How many lines are excited, at most.", True, min=2)] = 100,
    criterion: Annotated[str, option("--criterion NAME", "all, worst, or the parameter that matters.", True)] = "all",
    target: Annotated[
        str, option("--target SD", "Relative standard deviation whose length of record is told.", True)
    ] = "1%",
    use: Annotated[
        float, option("--use SHARE", "Part of the way to the limits of position and current that may be used.", True)
    ] = 0.5,
    slew: Annotated[float | None, option("--slew V/S", "Largest rate of change of the voltage.", "any")] = None,
    spread: Annotated[
        float, option("--spread SHARE", "Part of their values within which a rig's free parameters may lie.", True)
    ] = 0.1,
    rate: Annotated[float | None, option("--rate HZ", "Sampling rate in Hz.", "the bench's")] = None,
    loop: Annotated[
        Literal["open", "closed"] | None,
        option("--loop", "With or without the controller.", "as the bench usually works"),
    ] = None,
    seed: opt.Seed = 0,
    json: opt.JsonFile = None,
    plot: opt.Plot = None,
    report: opt.Report = None,
    strict: opt.Strict = False,
    force: opt.Force = False,
) -> None:
    """Design the periodic excitation that shows the parameters best, within limits that it keeps by prediction.

    Amplitudes and phases are optimised together for the standard deviations that 'ambid identify' will report. The
    limits are those of the rig, for drawn plants and from rest too.
    """
    from ambid.job import design_experiment
    from ambid.job.experiment_design import one_period
    from ambid.record import write_record

    known = None if source.lower().endswith(".json") else preset_of(source)
    of = None if known is not None else Path(source)
    with Outputs(of, rig, json=json, plot=plot, report=report) as outputs, progress("design") as show:
        outputs.claim(record, "-o", (".csv", ".csv.gz", ".h5", ".hdf5"), force=force)
        found = design_experiment(
            known or str(source), rig, seconds=seconds, period=period, band=band_of(band), lines=lines,
            criterion=criterion, target=opt.share_of(target, "--target"), use=use, slew=slew, spread=spread,
            rate_hz=rate, closed=None if loop is None else loop == "closed", seed=seed, tick=show,
        )  # fmt: skip
        outputs.give(found, show)
        if record is not None:
            outputs.stage(record, lambda path: write_record(one_period(found), path))
    outputs.show(found, strict=strict)
