"""``ambid fleet``: a job on many records."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import typer

from ambid.cli.interrupts import Stop, signals
from ambid.cli.options import Values, verb
from ambid.cli.output import NOTHING, Outputs, end
from ambid.cli.terminal import progress
from ambid.errors import AmbidError

group = typer.Typer(rich_markup_mode=None, no_args_is_help=False, help="Do a job on many records.")


@group.command("run", short_help="do a job on many records, each once")
@verb("fleet run")
def run(v: Values) -> None:
    """Do a job on many records, each once, in processes of their own.

    A record that ends its worker, or takes too long, counts as failed; all others are done. After Ctrl-C, a crash or
    a power cut, the same command goes on where it was. Several runs at once, also on several machines, share the work.
    Exit codes: 0 all done; 3 some records failed, or --strict and not usable; 4 none succeeded; 2 refused before
    anything ran; 130 Ctrl-C.
    """
    from ambid.fleet.run import run_fleet

    if v.again not in (None, "failed"):
        raise AmbidError(f"--again is {v.again!r}; it must be failed. Correct it")
    files = [None if x is None or "://" in x else Path(x) for x in (*v.records, v.rig, v.ledger)]
    stop = Stop()
    with Outputs(*files, **v.outputs) as outputs:
        with signals(stop.take), progress("fleet") as show:
            how = v.only("job ledger workers limit_s taken_at scheduler")
            found = run_fleet(
                v.records, v.rig, settings=_settings(v.set), again=v.again is not None, stopped=stop.wished,
                tick=show, **how,
            )  # fmt: skip
        outputs.give(found)
    n = found.counts
    outputs.show(found)
    if stop.wished():  # the code of the signal that ended the work
        raise typer.Exit(stop.code)
    if n["failed"] and not n["done"] + n["known"]:
        raise typer.Exit(NOTHING)
    end(failed=bool(n["failed"]) or (v.strict and not found.passed))


def _settings(words: list[str] | None) -> dict[str, Any]:
    """Read ``--set``: names with values as TOML writes them; what is none of these is a text."""
    found: dict[str, Any] = {}
    for word in words or ():
        name, is_, value = word.partition("=")
        if not (is_ and name.isidentifier()):
            raise AmbidError(f"--set {word} must be NAME=VALUE, such as from_s=0.5. Correct it")
        try:
            found[name] = tomllib.loads(f"x = {value}")["x"]
        except tomllib.TOMLDecodeError:
            found[name] = value
    return found
