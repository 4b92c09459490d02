"""``ambid compare``: several black-box structures on one record, judged on data that none of them has seen."""

from __future__ import annotations

from ambid.cli.options import Values, verb
from ambid.cli.output import Outputs
from ambid.cli.terminal import progress


@verb("compare")
def command(v: Values) -> None:
    """Fit several structures to a record and compare them on data that none of them has seen.

    Without --validate, the last part of the record is held back. Best first.
    """
    from ambid.job import compare

    with (
        Outputs(v.record, v.validate, **v.outputs) as outputs,
        progress("compare") as tick,
    ):
        how = v.only("input output reference open_loop from_s to_s rate_hz gaps layout validate holdout")
        found = compare(v.record, v.candidates, **how, tick=tick)
        outputs.give(found, tick)
    outputs.show(found, strict=v.strict)
