"""``ambid fleet``: a job on many records, and many simulated records of one rig."""

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
from ambid.estimation.result import Result

group = typer.Typer(
    rich_markup_mode=None,
    no_args_is_help=False,
    help="Do a job on many records, or judge it on many simulated ones.",
)


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
    _show(outputs, found, stop, strict=v.strict, failed=n["failed"], good=n["done"] + n["known"])


@group.command("simulate", short_help="judge a job on many simulated records of a rig")
@verb("fleet simulate")
def simulate(v: Values) -> None:
    """Judge a job on many simulated records: bias, spread, and how often 95 % intervals hold the truth.

    The job gets the rig without the values of parameters that are free. Ctrl-C keeps what is done.
    Exit codes as of 'ambid fleet run': 3 some runs failed, 4 all did.
    """
    from ambid.fleet.trials import monte_carlo

    of_bench = v.only("duration amplitude") | {"nonlinear": v.nonlinear or None}
    stop = Stop()
    with Outputs(Path(v.rig) if Path(v.rig).is_file() else None, **v.outputs) as outputs:
        with signals(stop.take), progress("fleet") as show:
            found = monte_carlo(
                v.rig, simulated={n: x for n, x in of_bench.items() if x is not None}, stopped=stop.wished, tick=show,
                **v.only("runs seed job workers limit_s"), **_settings(v.set),
            )  # fmt: skip
        outputs.give(found)
    failed = found.counts["failed"]
    _show(outputs, found, stop, strict=v.strict, failed=failed, good=len(found.trials) - failed)


def _show(outputs: Outputs, found: Result, stop: Stop, *, strict: bool, failed: int, good: int) -> None:
    """Print what was found, and end with the code of the signal where one ended the work, or of what failed."""
    outputs.show(found)
    if stop.wished():
        raise typer.Exit(stop.code)
    if failed and not good:
        raise typer.Exit(NOTHING)
    end(failed=bool(failed) or (strict and not found.passed))


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
