"""``ambid fit`` for nonlinear structures: settings, seed, several records, and Ctrl-C that keeps the best so far."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from ambid.cli.interrupts import Stop, interruptible, signals
from ambid.cli.options import FAILED_CHECK, json_path, refuse_twice
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter, progress
from ambid.errors import EstimationError, nearest

if TYPE_CHECKING:
    from ambid.blackbox.data import IOData
    from ambid.blackbox.fit import BlackBoxFit
    from ambid.nonlinear.fit import NonlinearFit, Settings

Part = tuple[float | None, float | None]


def fit_records(
    records: Sequence[Path],
    structure: str,
    settings: str,
    *,
    inputs: Sequence[str],
    outputs: Sequence[str],
    open_loop: bool,
    part: Part,
    rate: float | None,
    gaps: str | None,
    second: Path | None,
    second_part: Part,
    rig: Path | None,
    seed: int,
    json: str | None,
    plot: Path | None,
    strict: bool,
) -> None:
    """Fit a nonlinear model to records, write and show it.

    `structure`, `settings`: as the command line has them; `inputs`, `outputs`: columns; `part`: of every record;
    `second`: to judge on; `second_part`: of it.
    """
    from ambid.job import fit_nonlinear
    from ambid.nonlinear.fit_file import nonlinear_fit_text
    from ambid.report.fit_text import fit_text

    stop = Stop()
    with Outputs(*records, second, rig) as files:
        files.claim(json_path(json), "--json")
        files.claim(plot, "--plot", (".png", ".svg", ".pdf"))
        refuse_twice(records)
        _check_second(records, part, second, second_part)
        wanted = settings_of(settings)
        with signals(stop.take), progress("fit") as show:
            found = fit_nonlinear(
                records,
                inputs=inputs,
                outputs=outputs,
                structure_name=structure,
                settings=wanted,
                open_loop=open_loop,
                from_s=part[0],
                to_s=part[1],
                rate_hz=rate,
                gaps=gaps,
                validate=second,
                validate_from_s=second_part[0],
                validate_to_s=second_part[1],
                rig=rig,
                seed=seed,
                tick=interruptible(show, stop),
            )
            stop.torn()
            if plot is not None and found.model is not None:
                show("draw")
                _draw(found, records, second, files, plot, inputs, outputs, part, second_part, rate, gaps, rig)
        written = nonlinear_fit_text(found)
        if (path := json_path(json)) is not None:
            files.stage_text(path, written)
    if json == "-":
        typer.echo(written, nl=False)
    else:
        typer.echo(fit_text(found, paint=painter()))
    if stop.wished():
        raise typer.Exit(stop.code)
    against = against_second(found)
    if json != "-" and against:
        typer.echo("\n".join(against))
    if found.status == "failed" or (strict and (against or not found.passed)):
        raise typer.Exit(FAILED_CHECK)


def against_second(found: BlackBoxFit | NonlinearFit) -> list[str]:
    """Say why a fit does not hold on the second record, where there is one.

    Returns a line for each reason; empty where it holds, or was not judged there.
    """
    from ambid.validate.second_record import objections

    judged: Any = found.validation
    return [] if judged is None else [f"it does not hold on the second record: {x}" for x in objections(found, judged)]


def _check_second(records: Sequence[Path], part: Part, second: Path | None, second_part: Part) -> None:
    """Refuse to judge on samples that are fitted to; another part of a record is another record."""
    if second is None or second.resolve() not in {x.resolve() for x in records}:
        return
    (a, b), (c, d) = part, second_part
    begin, end = max(a or -inf, c or -inf), min(inf if b is None else b, inf if d is None else d)
    if not begin >= end:
        raise EstimationError(
            f"--validate {second} is fitted to as well: errors there say nothing about other records. Give another, or "
            "parts that do not overlap (--from, --to, --validate-from, --validate-to)"
        )


def settings_of(text: str) -> Settings:
    """Read settings as they are written on the command line."""
    found: dict[str, int | float | str | tuple[int, ...]] = {}
    if text.strip() in ("auto", ""):
        return found
    named = set[str]()
    for part in text.split(","):
        name, sign, value = (x.strip() for x in part.partition("="))
        if not (name and sign and value):
            raise EstimationError(f"--settings {text!r}: {part.strip()!r} is not NAME=VALUE. Write ny=2,nu=2,degree=3")
        if name in named:
            raise EstimationError(f"--settings {text!r}: {name} stands twice. Leave one out")
        named.add(name)
        if value != "auto":
            found[name] = _value(value)
    return found


def _value(text: str) -> int | float | str | tuple[int, ...]:
    parts = text.split("/")
    if len(parts) > 1 and all(x.strip().isdecimal() for x in parts):
        return tuple(int(x) for x in parts)
    for read in (int, float):
        try:
            return read(text)
        except ValueError:
            continue
    return text


def refuse_linear_only(given: Mapping[str, bool], structure: str) -> None:
    """Refuse options that only the linear structures have.

    `given`: by option: whether it was given.
    """
    for option, was in given.items():
        if was:
            raise EstimationError(f"{option} is for linear structures; {structure} has no use for it. Leave it out")


def only_one(orders: str, settings: str) -> str:
    """Return the settings where ``--orders``, which is another name for them, is not given too."""
    if orders != "auto":
        raise EstimationError("--orders and --settings say the same of a nonlinear structure. Give one of them")
    return settings


def one_record(records: Sequence[Path], structure: str, settings: str | None, seed: int | None) -> Path:
    """Return the one record that a linear structure is fitted to."""
    from ambid.blackbox.structures import RESPONSE_STRUCTURES, STRUCTURES
    from ambid.blackbox.structures import structure as linear
    from ambid.nonlinear.structures import NONLINEAR_STRUCTURES

    if structure in RESPONSE_STRUCTURES:
        linear(structure)  # says where those are fitted
    if structure not in STRUCTURES:
        every = [*STRUCTURES, *NONLINEAR_STRUCTURES]
        raise EstimationError(
            f"structure {structure!r} is not known; known: {', '.join(every)}.{nearest(structure, every)}"
        )
    if len(records) > 1:
        several = ", ".join(NONLINEAR_STRUCTURES)
        raise EstimationError(f"structure {structure} takes one record; {several} take several. Leave {records[1]} out")
    for option, value in (("--settings", settings), ("--seed", seed)):
        if value is not None:
            raise EstimationError(f"{option} is for nonlinear structures; {structure} has --orders. Leave it out")
    return records[0]


def _draw(
    found: NonlinearFit,
    records: Sequence[Path],
    second: Path | None,
    files: Outputs,
    plot: Path,
    inputs: Sequence[str],
    outputs: Sequence[str],
    part: Part,
    second_part: Part,
    rate: float | None,
    gaps: str | None,
    rig: Path | None,
) -> None:
    from ambid.job import read_data
    from ambid.report.drawing import save
    from ambid.report.nonlinear_figures import nonlinear_overview
    from ambid.rig import load_rig

    bench = None if rig is None else load_rig(rig)

    def read(record: Path, piece: Part) -> IOData:
        return read_data(record, inputs, outputs, part=piece, rate_hz=rate, gaps=gaps, rig=bench)

    data = [read(x, part) for x in records]
    page = nonlinear_overview(found, data, None if second is None else read(second, second_part))
    files.stage(plot, lambda path: save(page, path))
