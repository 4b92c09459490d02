"""The pages of the reference that describe themselves: commands from their own help, Python names from the packages."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

# Every public name stands once, with the job that it serves; rooms follow one another as a record goes through them.
GROUPS: dict[str, dict[str, str]] = {
    "The whole job": {"ambid": "what the commands call: one function each, and the nouns that they take and give"},
    "Records and rigs": {
        "ambid.record": "records and their files",
        "ambid.rig": "what is known of a bench",
        "ambid.signals": "excitation, conditioning, spectra, frequency responses, diagnostics",
    },
    "Physics": {
        "ambid.physics": "models, magnets, loops and noise",
        "ambid.simulation": "simulated benches and scenarios",
    },
    "Estimators": {
        "ambid.estimation": "the estimate",
        "ambid.bearing": "physical parameters of one axis",
        "ambid.rotor": "physical parameters of rotors on many axes",
        "ambid.blackbox": "linear black boxes",
        "ambid.nonlinear": "nonlinear black boxes",
        "ambid.recursive": "recursive estimators and filters",
        "ambid.tracking": "the supervised tracker",
    },
    "Jobs and hardware": {
        "ambid.control": "the loop as it is, and what is designed on it",
        "ambid.job": "whole jobs and their parts",
        "ambid.report": "figures",
        "ambid.acquisition": "records from a controller",
        "ambid.ledger": "estimates of many records, kept once each",
        "ambid.fleet": "a job on many records",
    },
}


# The order of the first page, on which a reader begins; what is not named here follows.
FIRST = ("identify", "identify_nonlinear", "fit", "frf", "compare", "track", "simulate", "acquire", "validate", "load")


def public_names(room: str) -> list[str]:
    """Return what a room exports: the jobs first, then by name, functions and classes alike."""
    names = getattr(import_module(room), "__all__", ())
    jobs = FIRST if room == "ambid" else ()
    return sorted(names, key=lambda name: (jobs.index(name) if name in jobs else len(jobs), name.lower()))


def write_reference(folder: Path) -> None:
    """Write `commands.md`, `python.md` and a page for each room into the folder; equal files are left alone."""
    folder.mkdir(parents=True, exist_ok=True)
    _write(folder / "commands.md", "\n".join(_commands()))
    _write(folder / "options.md", "\n".join(_options()))
    lines = [
        "# Python interface",
        "",
        "Public names only, from their docstrings. `import ambid` alone gives the jobs.",
        "",
    ]
    for group, rooms in GROUPS.items():
        lines += [f"## {group}", "", "| package | what is in it |", "|---|---|"]
        lines += [f"| [`{room}`]({room}.md) | {what} |" for room, what in rooms.items()] + [""]
    rooms = [(room, what) for group in GROUPS.values() for room, what in group.items()]
    lines += ["```{toctree}", ":hidden:", "", *(room for room, _ in rooms), "```", ""]
    _write(folder / "python.md", "\n".join(lines))
    for room, what in rooms:
        _write(folder / f"{room}.md", "\n".join(_room(room, what)))


def _room(room: str, what: str) -> Iterator[str]:
    yield from (f"# {room}", "", f"{what[0].upper()}{what[1:]}.", "")
    yield from ("```{eval-rst}", f".. currentmodule:: {room}", "")
    jobs = import_module("ambid")
    for name in public_names(room):
        thing = getattr(import_module(room), name)
        if room != "ambid" and name in jobs.__all__ and getattr(jobs, name) is thing:
            yield from (f"``{name}`` is :py:obj:`ambid.{name}`.", "")
            continue
        kind = "class" if inspect.isclass(thing) else "function" if callable(thing) else "data"
        yield f".. auto{kind}:: {name}"
        if kind == "class":
            yield "   :members:"
        yield ""
    yield "```"


def verbs() -> Iterator[tuple[str, Any]]:
    """Yield every verb with its command, those of a group one by one."""
    from ambid.cli.app import parser

    for name, command in parser().commands.items():
        inner = getattr(command, "commands", None)
        yield from ((name, command),) if inner is None else ((f"{name} {n}", c) for n, c in inner.items())


def _commands() -> Iterator[str]:
    yield from ("# Commands", "", "What `ambid COMMAND --help` says, made from the program itself.", "")
    for name, command in verbs():
        yield from _command(name, command)


def _options() -> Iterator[str]:
    """Yield every option once, as it is declared: its words in a shell and in Python, and the verbs that have it."""
    from ambid.settings.jobs import JOBS
    from ambid.settings.table import SETTINGS

    yield from (
        "# Options",
        "",
        "Every option once, with its name in Python and the commands that take it; what one of",
    )
    yield from (
        "them says otherwise stands in [Commands](commands.md).",
        "",
        "| option | in Python | what | commands |",
    )
    yield "|---|---|---|---|"
    for s in sorted(SETTINGS, key=lambda x: x.flag.lstrip("-")):
        jobs = [job for job in JOBS.values() if any(x.name == s.name for x in job.settings)]
        words = sorted({x.metavar if x.argument else x.flag for job in jobs for x in job.settings if x.name == s.name})
        links = ", ".join(f"[{job.name}](commands.md#ambid-{job.name.replace(' ', '-')})" for job in jobs)
        flags = ", ".join(f"`{w}`".replace("|", "\\|") for w in words)
        yield f"| {flags} | `{s.name}` | {_text(s.about)} | {links} |"


def _command(name: str, command: Any) -> Iterator[str]:
    import typer

    context = typer.Context(command, info_name=f"ambid {name}")
    usage = " ".join(command.collect_usage_pieces(context))
    yield from (f"## ambid {name}", "", "```text", f"ambid {name} {usage}", "```", "")
    yield from (_text(command.help or command.short_help or ""), "")
    rows = [row for p in command.params if (row := p.get_help_record(context))]
    for words, said in rows:
        yield from (f"`{words}`", f": {' '.join(_text(said).split())}", "")


def _text(said: str) -> str:
    """Help as Markdown: what would be read as markup is not."""
    said = re.sub(r"([*_<>|\[\]$\\])", r"\\\1", inspect.cleandoc(said).replace("\b", ""))
    return re.sub(r"(?<![\w-])--[a-z][a-z-]*", r"`\g<0>`", said)


def _write(path: Path, text: str) -> None:
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")
