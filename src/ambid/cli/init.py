"""``ambid init``: a first rig file, guessed from the columns of a record."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ambid.cli.options import Gaps, Rate, RecordFile
from ambid.cli.output import Outputs
from ambid.errors import AmbidError


def command(
    record: RecordFile,
    rig: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="RIG", help="Rig file to write.", show_default="standard output"),
    ] = None,
    rate: Rate = None,
    gaps: Gaps = None,
    force: Annotated[bool, typer.Option("--force", help="Write over a rig file that exists.")] = False,
) -> None:
    """Write a commented rig file, guessed from the record's columns, to be checked and edited."""
    from ambid.record import read_record
    from ambid.rig import draft_rig

    with Outputs(record) as outputs:
        outputs.claim(rig, "-o")
        if rig is not None and rig.exists() and not force:
            raise AmbidError(f"-o {rig} exists already; it may hold your changes. Choose another name, or give --force")
        text = draft_rig(read_record(record, rate_hz=rate, gaps=gaps or "error"))
        if rig is not None:
            outputs.stage_text(rig, text)
    if rig is None:
        typer.echo(text, nl=False)
        return
    open_points = [
        line for line in text.splitlines() if "CHECK" in line.partition("#")[2] and not line.startswith("# G")
    ]
    typer.echo(f"{rig} written; {len(open_points)} lines are marked CHECK. Then: ambid identify {record} --rig {rig}")
