"""``ambid info``: what a record holds."""

from __future__ import annotations

import typer

from ambid.cli.options import Gaps, Rate, RecordFile, RigFile
from ambid.cli.terminal import painter, progress


def command(record: RecordFile, rig: RigFile = None, rate: Rate = None, gaps: Gaps = None) -> None:
    """Show what a record holds: channels, rate, levels, resolution, noise, saturation, drop-outs, outliers, excitation.

    With --rig: the channels by role, calibrated; the noise of the outputs is then told from what the input explains.
    """
    from ambid.physics.models import model
    from ambid.record import read_record
    from ambid.report.tables import record_text
    from ambid.rig import load_rig, read_bench

    with progress("look"):
        if rig is None:
            text = record_text(read_record(record, rate_hz=rate, gaps=gaps or "error"), paint=painter())
        else:
            bench = load_rig(rig)
            inputs = model(bench.model).inputs
            text = record_text(read_bench(record, bench, rate_hz=rate, gaps=gaps), inputs=inputs, paint=painter())
    typer.echo(text)
