"""``ambid fit``: a black-box model of one record or several; ``ambid compare``: several structures on one record."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import typer

from ambid.cli.interrupts import Stop, interruptible, signals
from ambid.cli.options import Values, refuse_twice, verb
from ambid.cli.output import Outputs, end
from ambid.cli.terminal import progress
from ambid.errors import EstimationError


@verb("fit")
def command(v: Values) -> None:
    """Fit a black-box model to a record: polynomial, subspace, continuous-time or nonlinear structures.

    The plant is taken to be under feedback unless --open-loop says otherwise: structures that feedback disturbs warn.
    With --rig, inputs and outputs are the rig's, and a linear fit is carried on to its physical parameters.
    Ctrl-C during a nonlinear fit keeps the best model so far (exit code 130).
    """
    from ambid.job import fit, physics
    from ambid.nonlinear.fit import NONLINEAR_STRUCTURES
    from ambid.rig import load_rig

    nonlinear = v.structure in NONLINEAR_STRUCTURES
    stop = Stop()
    with Outputs(*v.records, v.validate, v.rig, **v.outputs) as outputs:
        refuse_twice(v.records)
        if nonlinear and v.validate is not None and v.validate.resolve() in {x.resolve() for x in v.records}:
            raise EstimationError(
                f"--validate {v.validate} is used for fitting too, so it cannot validate. Give another record, or fit "
                "to --to and judge the rest by 'ambid validate' with --from"
            )
        bench = None if v.rig is None else load_rig(v.rig)
        how = v.only(
            "structure input output orders criterion fix at_rest seed open_loop reference from_s to_s validate"
        )
        how |= v.only("rate_hz gaps layout")
        with signals(stop.take) if nonlinear else nullcontext(), progress("fit") as show:
            found: Any = fit(v.records, rig=bench, tick=interruptible(show, stop) if nonlinear else show, **how)
            stop.torn()
            if bench is not None and not nonlinear:
                found = replace(found, derived={"physical": physics(found, bench)})
            outputs.give(found, show)
    outputs.show(found)
    if stop.wished():
        raise typer.Exit(stop.code)
    end(failed=found.status == "failed" or (v.strict and not found.passed))


@verb("compare")
def compare(v: Values) -> None:
    """Fit several structures to a record and compare them on data that none of them has seen.

    Without --validate, the last part of the record is held back. Best first. With what 'ambid identify --json' or
    'ambid fit --json' wrote in the place of record and structures: whether the estimates are of one machine.
    """
    from ambid.job import compare

    with Outputs(v.record, v.validate, v.rig, **v.outputs) as outputs, progress("compare") as tick:
        how = v.only("input output reference rig open_loop from_s to_s rate_hz gaps layout validate holdout")
        found = compare(v.record, v.candidates, **how, tick=tick)
        outputs.give(found, tick)
    outputs.show(found, strict=v.strict)
