"""``ambid fleet``: a job on many records, and many simulated records of one rig."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any

import typer

from ambid.cli import options as opt
from ambid.cli.interrupts import Stop, signals
from ambid.cli.options import option
from ambid.cli.output import Outputs, end
from ambid.cli.terminal import progress
from ambid.errors import AmbidError
from ambid.estimation.result import Result

group = typer.Typer(
    rich_markup_mode=None,
    no_args_is_help=False,
    help="Do a job on many records, or judge it on many simulated ones.",
)

JobName = Annotated[
    str, option("--job JOB", "What is done: identify, identify_nonlinear, fit, frf, info, margins, validate.", True)
]
Set = Annotated[
    list[str] | None,
    option("--set NAME=VALUE", "Setting of the job, under its name in Python, such as from_s=0.5; repeatable."),
]
Workers = Annotated[int | None, option("--workers N", "Processes at work.", "one for each processor", min=1)]
Limit = Annotated[float, option("--limit S", "Longest time for one record, in s.", True)]
Scheduler = Annotated[
    str | None, option("--scheduler tcp://HOST:PORT", "Dask scheduler, which somebody has started, with its workers.")
]
Dask = Annotated[str | None, option("--dask local:N", "Start a Dask cluster of N workers on this machine.")]


@group.command("run", short_help="do a job on many records, each once")
def run(
    records: Annotated[
        list[str],
        opt.argument(
            "RECORD...",
            "Files, URLs, or patterns in quotes such as 'records/{bearing}/*.h5', where a word in braces stands for a "
            "part of one name.",
        ),
    ],
    ledger: Annotated[
        str, option("--ledger FILE.db|URL", "Ledger that keeps the estimates: what stands there is not done again.")
    ],
    rig: Annotated[
        str | None,
        option(
            "--rig RIG|MAP.csv",
            "Rig file of all records; or with words of the pattern, 'rigs/{bearing}.toml'; or a table with columns "
            "pattern, rig and perhaps bearing, taken_at.",
        ),
    ] = None,
    taken_at: Annotated[
        str | None,
        option(
            "--taken-at TIME|file",
            "When those were taken that say it neither themselves nor by {taken_at} or table; file: time of the file.",
        ),
    ] = None,
    job: JobName = "identify",
    settings: Set = None,
    again: Annotated[str | None, option("--again failed", "Do records again that failed before.")] = None,
    workers: Workers = None,
    limit: Limit = 600.0,
    scheduler: Scheduler = None,
    dask: Dask = None,
    json: opt.JsonFile = None,
    plot: opt.Plot = None,
    report: opt.Report = None,
    strict: opt.Strict = False,
) -> None:
    """Do a job on many records, each once, in processes of their own.

    A record that ends its worker, or takes too long, is told as failed; all others are done. After Ctrl-C, a crash or
    a power cut, the same command goes on where it was.
    """
    from ambid.fleet.run import run_fleet

    if again not in (None, "failed"):
        raise AmbidError(f"--again is {again!r}; it must be failed. Correct it")
    files = [None if x is None or "://" in x else Path(x) for x in (*records, rig, ledger)]
    stop = Stop()
    with Outputs(*files, json=json, plot=plot, report=report) as outputs:
        with signals(stop.take), progress("fleet") as show:
            found = run_fleet(
                records, rig, job=job, settings=_settings(settings), ledger=ledger, workers=workers, limit_s=limit,
                again=again is not None, taken_at=taken_at, scheduler=scheduler, dask=_local(dask),
                stopped=stop.wished, tick=show,
            )  # fmt: skip
        outputs.give(found)
    _show(outputs, found, stop, strict=strict)


@group.command("simulate", short_help="judge a job on many simulated records of a rig")
def simulate(
    rig: Annotated[
        str, opt.argument("RIG", "Rig file, or preset by its name; each parameter has a value: that is the truth.")
    ],
    runs: Annotated[int, option("--runs N", "Number of records.", True, min=1)] = 100,
    seed: Annotated[int, option("--seed N", "Seed of the first; the others follow.", True, min=0)] = 1,
    duration: Annotated[
        float | None, option("--duration S", "Length of each record, in s.", "as ambid simulate")
    ] = None,
    amplitude: Annotated[float | None, option("--amplitude V", "Peak of the excitation.", "as ambid simulate")] = None,
    nonlinear: Annotated[bool, option("--nonlinear", "Simulate the nonlinear magnet.")] = False,
    job: JobName = "identify",
    settings: Set = None,
    workers: Workers = None,
    limit: Limit = 600.0,
    json: opt.JsonFile = None,
    plot: opt.Plot = None,
    report: opt.Report = None,
    strict: opt.Strict = False,
) -> None:
    """Judge a job on many simulated records: bias, spread, and how often 95 % intervals hold the truth.

    The job gets the rig without the values of parameters that are free. Ctrl-C keeps what is done.
    """
    from ambid.fleet.trials import monte_carlo

    given = {"duration": duration, "amplitude": amplitude, "nonlinear": nonlinear or None}
    stop = Stop()
    with Outputs(Path(rig) if Path(rig).is_file() else None, json=json, plot=plot, report=report) as outputs:
        with signals(stop.take), progress("fleet") as show:
            found = monte_carlo(
                rig, runs=runs, seed=seed, job=job, simulated={n: x for n, x in given.items() if x is not None},
                workers=workers, limit_s=limit, stopped=stop.wished, tick=show, **_settings(settings),
            )  # fmt: skip
        outputs.give(found)
    _show(outputs, found, stop, strict=strict)


def _show(outputs: Outputs, found: Result, stop: Stop, *, strict: bool) -> None:
    """Print what was found, and end with the code of the signal where one ended the work."""
    outputs.show(found)
    if stop.wished():
        raise typer.Exit(stop.code)
    end(failed=strict and not found.passed)


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


def _local(text: str | None) -> int | None:
    if text is None:
        return None
    where, _, number = text.partition(":")
    if where != "local" or not number.isdigit() or not int(number):
        raise AmbidError(f"--dask is {text!r}; it must be local:N with a number of workers. Correct it")
    return int(number)
