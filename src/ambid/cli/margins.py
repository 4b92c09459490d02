"""``ambid margins``: the loop of a record, or of an estimate, as it is."""

from __future__ import annotations

from ambid.cli.options import Values, verb
from ambid.cli.output import Outputs
from ambid.cli.terminal import progress


@verb("margins")
def command(v: Values) -> None:
    """Show the margins of the loop: sensitivity by ISO 14839-3, gain, phase, delay, compliance.

    The controller is identified where the excitation is logged as reference, else it is the rig's [loop], as for an
    estimate alone. Without --rig, that of the estimate is used.
    """
    from ambid.job import margins

    with (
        Outputs(v.record, v.rig, v.estimate, **v.outputs) as outputs,
        progress("margins") as show,
    ):
        how = v.only("estimate reference from_s to_s rate_hz gaps layout")
        found = margins(v.record, v.rig, **how, tick=show)
        outputs.give(found, show)
    outputs.show(found, strict=v.strict)
