"""``ambid init``: a first rig file, guessed from the columns of a record, or that of a bench with a controller."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

import typer

from ambid.cli.options import Values, verb
from ambid.cli.output import Outputs
from ambid.errors import AmbidError, counted, nearest

if TYPE_CHECKING:
    from ambid.rig.roles import Candidate


@verb("init")
def command(v: Values) -> None:
    """Write a commented rig file, guessed from a record's columns or of a preset bench, to be checked and edited."""
    from ambid.rig.draft import WIRED

    if (v.record is None) == (v.preset is None):
        given = (
            "both a record and --preset were given"
            if v.record is not None
            else "neither a record nor --preset was given"
        )
        raise AmbidError(f"{given}; a rig file comes from exactly one. Give RECORD, or --preset {WIRED[0]}")
    if v.preset is not None and (v.rate_hz is not None or v.gaps is not None or v.layout):
        raise AmbidError("--rate, --gaps and --layout are for reading a record; --preset reads none. Omit them")
    if v.preset is not None and (v.column or v.coil):
        raise AmbidError("--column and --coil are for a record; --preset reads none. Omit them")
    with Outputs(v.record) as outputs:
        outputs.claim(v.out, "out", force=v.force)
        text = _of_preset(v.preset) if v.preset is not None else _of_record(v)
        if v.out is not None:
            outputs.stage_text(v.out, text)
    if v.out is None:
        typer.echo(text, nl=False)
    elif v.preset in WIRED:
        typer.echo(
            f"{v.out} written; edit what differs on your bench. Then: ambid commission --rig {v.out} --port PORT"
        )
    elif v.record is None:
        law = " --nonlinear" if "\n[magnet]" in text else ""
        typer.echo(f"{v.out} written; edit what differs on your bench. Then: ambid simulate {v.out} -o RECORD{law}")
    else:
        open_points = [
            line for line in text.splitlines() if "CHECK" in line.partition("#")[2] and not line.startswith("# G")
        ]
        typer.echo(
            f"{v.out} written; {counted(len(open_points), 'line')} marked CHECK. Then: ambid identify {v.record} --rig "
            f"{v.out}"
        )


def _of_record(v: Values) -> str:
    from ambid.job.drafting import draft

    ask = None if v.yes or not _on_terminal() else _chosen
    made = draft(
        v.record, columns=v.column, coil=bool(v.coil), first=bool(v.yes), choose=ask, gaps=v.gaps or "error",
        **v.only("rate_hz layout"),
    )  # fmt: skip
    if made.guess is None:
        return made.text
    ranked = {role: found for role, found in made.guess.ranked.items() if not (v.coil and role == "position")}
    for role, found in ranked.items():
        typer.echo(f"{role}: {found[0].channel.name}, because {found[0].why}", err=True)
    for note in made.guess.notes:
        typer.echo(note, err=True)
    return made.text


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
    from ambid.physics.presets import preset, preset_names
    from ambid.rig.draft import WIRED, preset_text, wired_text

    if name not in preset_names():
        raise AmbidError(
            f"--preset {name!r} is unknown; known: {', '.join(preset_names())}.{nearest(name, preset_names())} "
            "Give one of them, or RECORD"
        )
    return wired_text(name) if name in WIRED else preset_text(preset(name))
