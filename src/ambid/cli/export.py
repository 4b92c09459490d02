"""``ambid export``: an identified plant for other programs."""

from __future__ import annotations

from pathlib import Path

import typer

from ambid.cli.options import Values, verb
from ambid.cli.output import Outputs


@verb("export")
def command(v: Values) -> None:
    """Write an identified plant for other programs, by the ending of the file.

    .mat: matrices, continuous and sampled, parameters with covariance. .py: a script for python-control, or of a rotor
    for ROSS. .c and .h: C source, and its declarations. .fmu: co-simulation by FMI 2.0, source and the binary for this
    machine where it has a C compiler.
    """
    from ambid.errors import EstimationError
    from ambid.estimation.result import Linear
    from ambid.job.exchange import write_plant
    from ambid.job.files import EXPORT_ENDINGS
    from ambid.job.results import load_result

    with Outputs(v.result) as outputs:
        outputs.claim(v.out, "out", EXPORT_ENDINGS, force=v.force)
        found = load_result(v.result)
        if not isinstance(found, Linear):
            raise EstimationError(
                f"{v.result} holds no linear plant. Give an estimate, or the fit of a linear structure"
            )
        outputs.stage(v.out, lambda beside: write_plant(found, beside, v.out.stem, v.to, anyway=v.anyway))
    typer.echo(f"{v.out}: {_what(v.out)}")


def _what(out: Path) -> str:
    if out.suffix.lower() != ".fmu":
        return {".mat": "matrices for MATLAB", ".py": "Python script", ".c": "C source"}.get(
            out.suffix.lower(), "C header"
        )
    from ambid.job.plant_source import binaries

    made = ", ".join(binaries(out))
    return f"FMU, FMI 2.0, co-simulation, source and {f'binary for {made}' if made else 'no binary (no C compiler)'}"
