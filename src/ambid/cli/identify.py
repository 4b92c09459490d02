"""``ambid identify``: physical parameters with uncertainty from one record, or a nonlinear magnet from several."""

from __future__ import annotations

from contextlib import nullcontext
from functools import partial
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ambid.cli import options as opt
from ambid.cli.interrupts import INTERRUPTED, Stop, interruptible, signals
from ambid.cli.keeping import Bearing, LedgerPlace, TakenAt, keeping
from ambid.cli.options import option, switch
from ambid.cli.output import Outputs, end
from ambid.cli.terminal import progress
from ambid.errors import AmbidError, EstimationError
from ambid.settings.caller import refuse_given

if TYPE_CHECKING:
    from ambid.bearing.magnet_result import NonlinearBearingEstimate
    from ambid.estimation.estimate import Estimate
    from ambid.rotor.estimate import RotorEstimate


def command(
    records: Annotated[
        list[Path],
        opt.argument(
            "RECORD...",
            f"{opt.RECORD}; with --nonlinear several, best at several positions; of a rotor "
            "several, best at rest and at speed.",
        ),
    ],
    rig: opt.RigFile = None,
    nonlinear: Annotated[
        bool,
        switch("--nonlinear", "Identify the nonlinear magnet: k_i, k_x and L as curves over position and current."),
    ] = False,
    held: Annotated[
        list[Path] | None,
        option(
            "--held RECORD",
            "With --nonlinear: a record with the rotor held at rest, which identifies the coil; repeatable.",
        ),
    ] = None,
    magnet: Annotated[
        Literal["auto", "single", "pair"] | None,
        option(
            "--magnet",
            "With --nonlinear: one magnet, or two opposing ones; auto looks at the sign of the current.",
            "as the rig says, or auto",
        ),
    ] = None,
    eddy: Annotated[
        bool, switch("--eddy", "With --nonlinear: the force follows the current with a pole a/(s + a).")
    ] = False,
    drift: Annotated[
        bool, switch("--drift", "With --nonlinear: let a random-walk force absorb what the force law does not explain.")
    ] = False,
    off_below: Annotated[
        float | None,
        option(
            "--off-below V",
            "With --nonlinear: at or below this voltage the power stage is off, and the coil voltage unknown.",
            "as the rig says",
        ),
    ] = None,
    speed: Annotated[
        list[float] | None,
        option(
            "--speed RPM",
            "Speed of a rotor in rpm; once for each record, in their order.",
            "as the record's angle or speed, or the rig, says",
        ),
    ] = None,
    experiment: Annotated[
        Path | None,
        option("--experiment E.json", "What 'ambid design experiment' promised: compare with the standard deviations."),
    ] = None,
    second: Annotated[Path | None, option("--validate RECORD2", "Validate the estimate on this second record.")] = None,
    from_s: opt.From = None,
    to_s: opt.To = None,
    rate: opt.Rate = None,
    gaps: opt.Gaps = None,
    layout: opt.Layout = None,
    json: opt.JsonFile = None,
    plot: Annotated[
        Path | None,
        option(
            "--plot FILE.png",
            "Draw signals, residuals, Bode and poles; with --nonlinear curves with bands, and every record.",
        ),
    ] = None,
    report: opt.Report = None,
    export: Annotated[
        Path | None,
        option("--export FILE", "Write the plant for other programs, as 'ambid export' does."),
    ] = None,
    ledger: LedgerPlace = None,
    bearing: Bearing = None,
    taken_at: TakenAt = None,
    strict: opt.Strict = False,
) -> None:
    """Identify the physical parameters of a bench from a record of voltage, current and position.

    Without --rig: columns named voltage, current and position, model one-axis, everything free.
    With --nonlinear, one model for all records, and curves with bands; what is known of the magnet stands in [magnet]
    of the rig. Ctrl-C then keeps the best so far (exit code 130).
    """
    from ambid.job import identification as job
    from ambid.job.exchange import write_plant
    from ambid.job.files import EXPORT_ENDINGS

    stop, kept = Stop(), tuple(held or ())
    own: dict[str, Any] = {"magnet": magnet, "eddy": eddy, "drift": drift, "off_below": off_below}
    how: dict[str, Any] = {"from_s": from_s, "to_s": to_s, "rate_hz": rate, "gaps": gaps, "validate": second}
    how |= {"layout": opt.layout_of(layout)} if layout else {}
    asked = {**how, **own, "nonlinear": nonlinear, "held": len(kept), "speed_rpm": speed, "experiment": experiment}
    with keeping(ledger, [*records, *kept], rig, bearing=bearing, taken_at=taken_at, job="identify", **asked) as store:
        with Outputs(*records, *kept, rig, second, experiment, json=json, plot=plot, report=report) as outputs:
            opt.refuse_twice([*records, *kept])
            outputs.claim(export, "export", EXPORT_ENDINGS)
            if nonlinear:
                if off_below is not None and not isfinite(off_below):
                    raise AmbidError(f"--off-below is {off_below}; it must be a voltage in V. Give a number")
                refuse_given({"speed_rpm": speed}, "{} is for rotors with a linear model. Omit {}")
                refuse_given({"experiment": experiment}, "{} is for the linear model. Omit {}")
            else:
                refuse_given(
                    {"held": kept, **own},
                    "{} is for the nonlinear magnet. Give --nonlinear too, or omit {}",
                )
            with signals(stop.take) if nonlinear else nullcontext(), progress("identify") as show:
                estimate: Estimate | NonlinearBearingEstimate | RotorEstimate = (
                    job.identify_nonlinear(records, rig, held=kept, tick=interruptible(show, stop), **own, **how)
                    if nonlinear
                    else job.identify(list(records), rig, speed_rpm=speed, experiment=experiment, tick=show, **how)
                )
                stop.torn()
                outputs.give(estimate, show)
                refused: AmbidError | None = None
                if export is not None:
                    try:
                        outputs.stage(export, partial(write_plant, estimate, name=export.stem))
                    except EstimationError as error:  # the estimate is given all the same
                        refused = error
        outputs.show(estimate)
        search = getattr(estimate, "global_search", None)
        if stop.wished() or (search is not None and search["interrupted"]):
            raise typer.Exit(stop.code or INTERRUPTED)
        store(estimate)
    if refused is not None:
        raise refused
    end(failed=strict and not estimate.passed)
