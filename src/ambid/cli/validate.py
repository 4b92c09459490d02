"""``ambid validate``: the checks of an estimate on other data."""

from __future__ import annotations

from ambid.cli.options import Values, verb
from ambid.cli.output import Outputs
from ambid.cli.terminal import progress


@verb("validate")
def command(v: Values) -> None:
    """Judge an estimate on another record of the same bench: nothing is fitted but offsets and initial state.

    Without --rig, the record is read through the rig that the estimate was made with.
    """
    from ambid.job.results import validate

    with (
        Outputs(v.estimate, v.record, v.rig, **v.outputs) as outputs,
        progress("validate") as show,
    ):
        found = validate(v.estimate, v.record, v.rig, **v.only("from_s to_s rate_hz gaps layout"))
        outputs.give(found, show)
    outputs.show(found, strict=v.strict)
