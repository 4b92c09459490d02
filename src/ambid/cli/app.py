"""All verbs under one command. The files of the verbs import nothing heavy before they run."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from functools import cache
from typing import Annotated, Any

import typer

from ambid import compiled
from ambid.cli import (
    acquire,
    commission,
    compare,
    console,
    demo,
    design,
    export,
    fit,
    fleet,
    frf,
    history,
    identify,
    info,
    init,
    margins,
    recover,
    simulate,
    track,
    validate,
)
from ambid.cli.terminal import plain_where_needed
from ambid.errors import AmbidError
from ambid.settings.jobs import RENAMED

app = typer.Typer(
    rich_markup_mode=None,  # plain help: it pipes well, and starts without importing rich
    no_args_is_help=False,
    help="Physical parameters of active magnetic bearings, with honest uncertainty, from measured voltage, current and"
    " position.",
    epilog="Start with 'ambid demo', then 'ambid info RECORD' and 'ambid init RECORD -o RIG' for a record of your own.",
)
app.command("demo", short_help="identify the embedded record, and compare with the true parameters")(demo.command)
app.command("identify", short_help="identify physical parameters, with uncertainty, from a record")(identify.command)
app.command("fit", short_help="fit a black-box model to a record")(fit.command)
app.command("frf", short_help="measure a frequency response, and fit models to it")(frf.command)
app.command("compare", short_help="compare several black-box structures")(compare.command)
app.command("acquire", short_help="take a record from a controller, real or emulated")(acquire.command)
app.command("commission", short_help="go from a controller to tracked parameters, step by step")(commission.command)
app.command("console", short_help="watch, commission and judge a bearing in the browser")(console.command)
app.command("track", short_help="track parameters through a record, as on-line")(track.command)
app.command("margins", short_help="show the margins of the loop of a record")(margins.command)
app.command("history", short_help="show a bearing over time, from a ledger")(history.command)
app.add_typer(design.group, name="design", short_help="design the next experiment or the controller on a model")
app.command("export", short_help="write an identified plant for other programs")(export.command)
app.add_typer(fleet.group, name="fleet", short_help="do a job on many records, real or simulated")
app.command("recover", short_help="recover a recording that was cut off")(recover.command)
app.command("init", short_help="draft a rig file from a record")(init.command)
app.command("simulate", short_help="simulate a record from the physics")(simulate.command)
app.command("validate", short_help="check an estimate or a fit on another record")(validate.command)
app.command("info", short_help="show what a record contains")(info.info)
app.command("models", short_help="list models, parameters, units, excitations, presets")(info.models)


@app.callback(invoke_without_command=True)
def _global(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
    traceback: Annotated[
        bool, typer.Option("--traceback", help="Show where an error arose (before or after the verb).")
    ] = False,
) -> None:
    del traceback  # taken out of the words before they come here
    if version:
        from importlib.metadata import version as installed

        typer.echo(f"ambid {installed('ambid')}")
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


def _say_compiling() -> None:
    print("compiling the numerical kernels, once on this machine, some 5 s; later starts are faster", file=sys.stderr)


@cache
def parser() -> Any:
    """Return the parser of the words: made once, as all signatures of the verbs are read for it (60 ms)."""
    return typer.main.get_command(app)


def run_verb(words: Sequence[str]) -> int:
    """Parse the words, run the verb and return its exit code.

    Errors come out as they are raised: `ambid.cli.run` is the one place that puts them into words.

    `words`: after ``ambid``. Returns 0, or 3 for a failed check under ``--strict``.
    """
    plain_where_needed(sys.stdout)
    plain_where_needed(sys.stderr)
    compiled.announce = _say_compiling if sys.stderr.isatty() else None
    command = parser()
    _refuse_former(words)
    if "_AMBID_COMPLETE" in os.environ:  # the shell asks what may follow
        command.main(list(words), prog_name="ambid")
    try:
        with command.make_context("ambid", list(words)) as context:
            command.invoke(context)
    except typer.Exit as end:
        return int(end.exit_code)
    return 0


def _refuse_former(words: Sequence[str]) -> None:
    """Refuse an option by its name of the release before, and say the new one."""
    job = next((name for name in (" ".join(words[:2]), *words[:1]) if name in RENAMED), "")
    for word in words if job else ():
        new = RENAMED[job].get(word.partition("=")[0].removeprefix("--")) if word.startswith("--") else None
        if new is not None:
            raise AmbidError(f"{word.partition('=')[0]} of 'ambid {job}' is now --{new}. Give that")


def refusal(error: Exception) -> str | None:
    """Put an error of usage into one line.

    `error`: anything that a verb raised. Returns what is wrong with the words, and where help is; None for an error of
    another kind.
    """
    if not isinstance(error, typer.TyperException) or not hasattr(error, "format_message"):
        return None
    context = getattr(error, "ctx", None)
    path = "ambid" if context is None else context.command_path
    said = " ".join(str(error.format_message()).split()).rstrip(".")
    return f"{said}{'' if said.endswith('?') else '.'} See '{path} --help'"
