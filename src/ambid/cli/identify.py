"""``ambid identify``: physical parameters with uncertainty from one record, or a nonlinear magnet from several.

``ambid validate``: the checks of an estimate on other data.
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import TYPE_CHECKING

import typer

from ambid.cli.interrupts import INTERRUPTED, Stop, interruptible, signals
from ambid.cli.options import Values, refuse_twice, verb
from ambid.cli.output import Outputs, end, keeping
from ambid.cli.terminal import progress
from ambid.settings.caller import refuse_given

if TYPE_CHECKING:
    from ambid.bearing.magnet_result import NonlinearBearingEstimate
    from ambid.estimation.estimate import Estimate
    from ambid.rotor.estimate import RotorEstimate


@verb("identify")
def command(v: Values) -> None:
    """Identify the physical parameters of a bench from a record of voltage, current and position.

    Without --rig: columns named voltage, current and position, model one-axis, everything free.
    With --nonlinear, one model for all records, and curves with bands; what is known of the magnet stands in [magnet]
    of the rig. Ctrl-C then keeps the best so far (exit code 130).
    """
    from ambid.job import identification as job

    stop, kept = Stop(), tuple(v.held or ())
    own, how = v.only("eddy drift"), v.only("from_s to_s rate_hz gaps validate")
    how |= {"layout": v.layout} if v.layout else {}
    asked = {**how, **own, "held": len(kept), **v.only("nonlinear speed_rpm experiment")}
    with keeping(v, "identify", [*v.records, *kept], **asked) as store:
        with Outputs(*v.records, *kept, v.rig, v.validate, v.experiment, **v.outputs) as outputs:
            refuse_twice([*v.records, *kept])
            if v.nonlinear:
                refuse_given(v.only("speed_rpm"), "{} is for rotors with a linear model. Omit {}")
                refuse_given(v.only("experiment"), "{} is for the linear model. Omit {}")
            else:
                text = "{} is for the nonlinear magnet. Give --nonlinear too, or omit {}"
                refuse_given({"held": kept, **own}, text)
            with signals(stop.take) if v.nonlinear else nullcontext(), progress("identify") as show:
                estimate: Estimate | NonlinearBearingEstimate | RotorEstimate = (
                    job.identify_nonlinear(v.records, v.rig, held=kept, tick=interruptible(show, stop), **own, **how)
                    if v.nonlinear
                    else job.identify(v.records, v.rig, tick=show, **v.only("speed_rpm experiment"), **how)
                )
                stop.torn()
                outputs.give(estimate, show)
        outputs.show(estimate)
        search = getattr(estimate, "global_search", None)
        if stop.wished() or (search is not None and search["interrupted"]):
            raise typer.Exit(stop.code or INTERRUPTED)
        store(estimate)
    end(failed=v.strict and not estimate.passed)


@verb("validate")
def validate(v: Values) -> None:
    """Judge an estimate on another record of the same bench: nothing is fitted but offsets and initial state.

    Without --rig, the record is read through the rig that the estimate was made with.
    """
    from ambid.job.results import validate

    with Outputs(v.estimate, v.record, v.rig, **v.outputs) as outputs, progress("validate") as show:
        found = validate(v.estimate, v.record, v.rig, **v.only("from_s to_s rate_hz gaps layout"))
        outputs.give(found, show)
    outputs.show(found, strict=v.strict)
