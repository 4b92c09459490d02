"""All verbs under one command. A verb's file is imported when the verb, or the help of all, is asked for."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import import_module
from typing import Annotated, Any

import typer
import typer.core

from ambid import compiled
from ambid.cli.terminal import plain_where_needed
from ambid.errors import AmbidError

DOORS = {
    "An Arduino and a magnet": {
        "demo": "identify the embedded record, and compare with the true parameters",
        "commission": "go from a controller to tracked parameters, step by step",
        "acquire": "take a record from a controller, real or emulated",
        "recover": "recover a recording that was cut off",
        "console": "watch, commission and judge a bearing in the browser",
    },
    "A machine on magnetic bearings": {
        "info": "show what a record contains",
        "init": "draft a rig file from a record",
        "identify": "identify physical parameters, with uncertainty, from a record",
        "validate": "check an estimate or a fit on another record",
        "margins": "show the margins of the loop of a record",
        "accept": "make the acceptance report of a machine",
        "track": "track parameters through a record, as on-line",
        "design": "design the next experiment or the controller on a model",
        "history": "show a bearing over time, from a ledger",
        "ledger": "check, back up, restore, merge and thin a ledger",
        "fleet": "do a job on many records, real or simulated",
    },
    "Research in identification": {
        "simulate": "simulate a record from the physics",
        "fit": "fit a black-box model to a record",
        "compare": "compare several black-box structures, or estimates",
        "frf": "measure a frequency response, and fit models to it",
        "export": "write an identified plant for other programs",
        "models": "list models, parameters, units, excitations, presets",
    },
}
"""What each verb does, in the order of the help, by who begins with it."""
VERBS = {name: said for door in DOORS.values() for name, said in door.items()}
_BESIDE = {"compare": "fit", "margins": "frf", "models": "info", "validate": "identify"}  # verbs in the file of another
_PART = "'ambid validate RESULT RECORD' with --from and --to"
# Words of the releases before, by job: what each is now; nothing where it is gone.
_FORMER: Mapping[str, Mapping[str, str]] = {
    "fit": {
        "settings": "--orders", "validate-from": _PART, "validate-to": _PART,
        "sensitivity": "--json FILE, which has the standard deviations",
        "stabilisation": "'ambid frf RECORD --modes auto --plot FILE.png'",
    },
    "identify": {
        "magnet": "magnet.kind of the rig", "off-below": "magnet.off_below of the rig",
        "export": "'ambid export ESTIMATE.json -o FILE', of what --json ESTIMATE.json wrote",
    },
    "console": dict.fromkeys(("key", "certificate", "listen"), "'ssh -L', which forwards the port"),
    "export": {"to": "--library"},
    "init": {"plot": "'ambid info RECORD --plot FILE.png'"},
    "history": {
        "export": "", "tables": "", "metrics": "--publish FILE.prom",
        "mqtt": "--json -, which any client of a broker passes on",
    },
    "design controller": {
        **dict.fromkeys(("export", "law"), "-o RIG, whose [loop] has the new gains or matrices"),
        **dict.fromkeys(("method", "kind", "judges", "schedule"), ""),
    },
    "design experiment": {"lines": "", "slew": ""},
    "fleet run": {"limit": "--time-limit", "dask": "--scheduler local:N"},
    "acquire": {"no-live": "", "quiet": ""},
    "track": {
        "flag": "'ambid console', whose Live page plays a record too", "reference": "--method armax",
        "start-seconds": "--start S", "no-live": "", "quiet": "",
    },
    "simulate": {"at": "--scenario NAME@S", "size": "--scenario NAME:SIZE"},
}  # fmt: skip


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


class _Doors(typer.core.TyperGroup):
    """All verbs, shown by door."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        del ctx
        limit = formatter.width - 6 - max(map(len, VERBS))
        for door, verbs in DOORS.items():
            with formatter.section(door):
                known = [(name, self.commands[name]) for name in verbs if name in self.commands]
                formatter.write_dl([(name, command.get_short_help_str(limit)) for name, command in known])


def _say_compiling() -> None:
    print("compiling the numerical kernels, once on this machine, some 5 s; later starts are faster", file=sys.stderr)


@cache
def parser(verb: str = "") -> Any:
    """Return the parser of one verb's words, or of all: reading all their settings takes 60 ms, so made once."""
    app = typer.Typer(
        cls=_Doors,
        rich_markup_mode=None,  # plain help: it pipes well, and starts without importing rich
        no_args_is_help=False,
        help="Physical parameters of active magnetic bearings, with honest uncertainty, from measured voltage, current "
        "and position.",
        epilog="Start with 'ambid demo', then 'ambid info RECORD' and 'ambid init RECORD -o RIG' for a record of your "
        "own.",
    )
    app.callback(invoke_without_command=True)(_global)
    for name in [verb] if verb else VERBS:
        module = import_module(f"ambid.cli.{_BESIDE.get(name, name)}")
        if hasattr(module, "group"):
            app.add_typer(module.group, name=name, short_help=VERBS[name])
        else:
            app.command(name, short_help=VERBS[name])(getattr(module, name, None) or module.command)
    return typer.main.get_command(app)


def run_verb(words: Sequence[str]) -> int:
    """Parse the words, run the verb and return its exit code.

    Errors come out as they are raised: `ambid.cli.run` is the one place that puts them into words.

    `words`: after ``ambid``. Returns 0, or 3 for a failed check under ``--strict``.
    """
    plain_where_needed(sys.stdout)
    plain_where_needed(sys.stderr)
    compiled.announce = _say_compiling if sys.stderr.isatty() else None
    _refuse_former(words)
    if "_AMBID_COMPLETE" in os.environ:  # the shell asks what may follow
        parser().main(list(words), prog_name="ambid")
    command = parser(words[0] if words and words[0] in VERBS else "")
    try:
        with command.make_context("ambid", list(words)) as context:
            command.invoke(context)
    except typer.Exit as end:
        return int(end.exit_code)
    return 0


def _refuse_former(words: Sequence[str]) -> None:
    """Refuse an option or a verb of a release before, and say what it is now."""
    if list(words[:2]) == ["fleet", "simulate"]:
        raise AmbidError("'ambid fleet simulate' is gone. Give records of 'ambid simulate' to 'ambid fleet run'")
    job = next((name for name in (" ".join(words[:2]), *words[:1]) if name in _FORMER), "")
    for word in words if job else ():
        new = _FORMER[job].get(word.partition("=")[0].removeprefix("--")) if word.startswith("--") else None
        if new is not None:
            now = f"now {new}. Give that" if new else "gone. Omit it"
            raise AmbidError(f"{word.partition('=')[0]} of 'ambid {job}' is {now}")


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
