"""``ambid init``: a first rig file, guessed from the columns of a record, or that of a bench with a controller."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ambid.cli.options import RECORD, Gaps, Layout, Rate, argument, layout_of, option, switch
from ambid.cli.output import Outputs
from ambid.errors import AmbidError, counted, nearest

if TYPE_CHECKING:
    from ambid.rig.roles import Candidate

_WIRED = ("prototype",)  # presets with a controller, whose rig is among the package's data


def command(
    record: Annotated[Path | None, argument("RECORD", f"{RECORD}.")] = None,
    rig: Annotated[Path | None, option("--out -o RIG", "Rig file to write.", "standard output")] = None,
    preset: Annotated[
        str | None,
        option(
            "--preset NAME",
            "Instead of a record: the rig of a bench that 'ambid models' lists; prototype has a controller.",
        ),
    ] = None,
    plot: Annotated[
        Path | None, option("--plot FILE.png", "Draw the columns that may be a role: signals, coherences, scores.")
    ] = None,
    yes: Annotated[bool, switch("--yes", "Choose the most likely columns without asking.")] = False,
    rate: Rate = None,
    gaps: Gaps = None,
    layout: Layout = None,
    force: Annotated[bool, switch("--force", "Overwrite an existing rig file.")] = False,
) -> None:
    """Write a commented rig file, guessed from a record's columns or of a preset bench, to be checked and edited."""
    if (record is None) == (preset is None):
        given = (
            "both a record and --preset were given" if record is not None else "neither a record nor --preset was given"
        )
        raise AmbidError(f"{given}; a rig file comes from exactly one. Give RECORD, or --preset {_WIRED[0]}")
    if preset is not None and (rate is not None or gaps is not None or layout):
        raise AmbidError("--rate, --gaps and --layout are for reading a record; --preset reads none. Omit them")
    if preset is not None and plot is not None:
        raise AmbidError("--plot draws the columns of a record; --preset reads none. Omit it")
    with Outputs(record, plot=plot) as outputs:
        outputs.claim(rig, "out", force=force)
        text = (
            _of_preset(preset)
            if preset is not None
            else _of_record(record, rate, gaps, layout, outputs, plot, ask=not yes)
        )
        if rig is not None:
            outputs.stage_text(rig, text)
    if rig is None:
        typer.echo(text, nl=False)
    elif preset in _WIRED:
        typer.echo(f"{rig} written; edit what differs on your bench. Then: ambid commission --rig {rig} --port PORT")
    elif record is None:
        law = " --nonlinear" if "\n[magnet]" in text else ""
        typer.echo(f"{rig} written; edit what differs on your bench. Then: ambid simulate {rig} -o RECORD{law}")
    else:
        open_points = [
            line for line in text.splitlines() if "CHECK" in line.partition("#")[2] and not line.startswith("# G")
        ]
        typer.echo(
            f"{rig} written; {counted(len(open_points), 'line')} marked CHECK. Then: ambid identify {record} --rig "
            f"{rig}"
        )


def _of_record(
    record: Path | None, rate: Rate, gaps: Gaps, layout: Layout, outputs: Outputs, plot: Path | None, *, ask: bool
) -> str:
    from ambid.record import read_record
    from ambid.rig import draft_rig
    from ambid.rig.draft import axes_of
    from ambid.rig.roles import rank_roles

    assert record is not None
    read = read_record(record, rate_hz=rate, gaps=gaps or "error", layout=layout_of(layout))
    if plot is None and len(axes_of(read)) > 1:
        return draft_rig(read)
    ranked = rank_roles(read)
    if ask and _on_terminal():
        ranked = {role: _chosen(role, found) for role, found in ranked.items()}
    for role, found in ranked.items():
        typer.echo(f"{role}: {f'{found[0].channel.name}, because {found[0].why}' if found else 'none found'}", err=True)
    if plot is not None:
        from ambid.report.record import roles_figure  # much is loaded for it

        outputs.draw(plot, lambda: roles_figure(read, ranked), lambda _: None)
    return draft_rig(read, ranked)


def _on_terminal() -> bool:
    return sys.stdin.isatty() and sys.stderr.isatty()


def _chosen(role: str, found: Sequence[Candidate]) -> Sequence[Candidate]:
    """Ask which column is a role where two are nearly as likely."""
    from ambid.rig.roles import close

    if not close(found):
        return found
    for x in found:
        typer.echo(f"  {x.channel.name}: score {x.score:.2f}; {x.why}", err=True)
    names = [x.channel.name for x in found]
    answer = ""
    while answer not in names:
        answer = typer.prompt(f"Which column is the {role} ({', '.join(names)})?", default=names[0], err=True)
    return sorted(found, key=lambda x: x.channel.name != answer)


def _of_preset(name: str) -> str:
    from importlib.resources import files

    from ambid.physics.presets import preset, preset_names
    from ambid.rig import preset_text

    if name not in preset_names():
        raise AmbidError(
            f"--preset {name!r} is unknown; known: {', '.join(preset_names())}.{nearest(name, preset_names())} "
            "Give one of them, or RECORD"
        )
    if name not in _WIRED:
        return preset_text(preset(name))
    return files("ambid").joinpath("data", f"{name}.toml").read_text(encoding="utf-8")
