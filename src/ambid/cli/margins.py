"""``ambid margins``: the loop of a record, or of an estimate, as it is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from ambid.cli import options as opt
from ambid.cli.options import option
from ambid.cli.output import Outputs
from ambid.cli.terminal import progress


def command(
    record: Annotated[
        Path, opt.argument("RECORD|ESTIMATE", "Record of the levitated rotor, or what 'ambid identify --json' wrote.")
    ],
    rig: opt.RigFile = None,
    estimate: Annotated[
        Path | None,
        option("--estimate E.json", "Plant, as 'ambid identify --json' wrote it.", "identified from the record"),
    ] = None,
    reference: Annotated[
        str | None, option("--reference COL", "Column of the excitation, of one axis.", "as the rig says")
    ] = None,
    from_s: opt.From = None,
    to_s: opt.To = None,
    rate: opt.Rate = None,
    gaps: opt.Gaps = None,
    layout: opt.Layout = None,
    json: opt.JsonFile = None,
    plot: opt.Plot = None,
    report: opt.Report = None,
    strict: opt.Strict = False,
) -> None:
    """Show the margins of the loop: sensitivity by ISO 14839-3, gain, phase, delay, compliance.

    The controller is identified where the excitation is logged as reference, else it is the rig's [loop], as for an
    estimate alone. Without --rig, that of the estimate is used.
    """
    from ambid.job import margins

    with Outputs(record, rig, estimate, json=json, plot=plot, report=report) as outputs, progress("margins") as show:
        found = margins(
            record, rig, estimate=estimate, reference=reference, from_s=from_s, to_s=to_s, rate_hz=rate, gaps=gaps,
            layout=opt.layout_of(layout) or None, tick=show,
        )  # fmt: skip
        outputs.give(found, show)
    outputs.show(found, strict=strict)
