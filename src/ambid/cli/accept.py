"""``ambid accept``: the acceptance report of a machine."""

from __future__ import annotations

from ambid.cli.options import Values, verb
from ambid.cli.output import Outputs
from ambid.cli.terminal import progress


@verb("accept")
def command(v: Values) -> None:
    """Make the acceptance report of a machine: ISO 14839-2 and -3, API 617, item by item, from measured records.

    A record is recognised by what it holds. Each item has its limit with source and edition; one that no record shows
    says which record would. --report writes the page or the PDF.
    """
    from ambid.job import accept

    with Outputs(*v.records, v.rig, v.estimate, **v.outputs) as outputs, progress("accept") as show:
        how = v.only("estimate speed_rpm from_s to_s rate_hz gaps layout")
        result = accept(v.records, v.rig, **how, tick=show)
        outputs.give(result, show)
    outputs.show(result, strict=v.strict)
