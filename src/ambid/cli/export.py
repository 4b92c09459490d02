"""``ambid export``: an identified plant for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from ambid.cli.options import argument, option, switch
from ambid.cli.output import Outputs


def command(
    result: Annotated[Path, argument("ESTIMATE", "What 'ambid identify --json' or 'ambid fit --json' wrote.")],
    out: Annotated[Path, option("--out -o FILE", "File to write: .mat, .py, .c, .h or .fmu.")],
    to: Annotated[
        Literal["control", "ross"] | None,
        option("--to", "Library that a script (.py) is for.", "ross for a rotor, else control"),
    ] = None,
    anyway: Annotated[
        bool,
        switch("--anyway", "Export an unusable estimate too, or one whose record does not show all; the file says so."),
    ] = False,
    force: Annotated[bool, switch("--force", "Overwrite a file that is no export.")] = False,
) -> None:
    """Write an identified plant for other programs, by the ending of the file.

    .mat: matrices, continuous and sampled, parameters with covariance. .py: a script for python-control, or of a rotor
    for ROSS. .c and .h: C source, and its declarations. .fmu: co-simulation by FMI 2.0, source and the binary for this
    machine where it has a C compiler.
    """
    from ambid.errors import EstimationError
    from ambid.estimation.result import Linear
    from ambid.job import load
    from ambid.job.exchange import write_plant
    from ambid.job.files import EXPORT_ENDINGS

    with Outputs(result) as outputs:
        outputs.claim(out, "out", EXPORT_ENDINGS, force=force)
        found = load(result)
        if not isinstance(found, Linear):
            raise EstimationError(f"{result} holds no linear plant. Give an estimate, or the fit of a linear structure")
        outputs.stage(out, lambda beside: write_plant(found, beside, out.stem, to, anyway=anyway))
    typer.echo(f"{out}: {_what(out)}")


def _what(out: Path) -> str:
    if out.suffix.lower() != ".fmu":
        return {".mat": "matrices for MATLAB", ".py": "Python script", ".c": "C source"}.get(
            out.suffix.lower(), "C header"
        )
    from ambid.job.plant_source import binaries

    made = ", ".join(binaries(out))
    return f"FMU, FMI 2.0, co-simulation, source and {f'binary for {made}' if made else 'no binary (no C compiler)'}"
