"""``ambid fit``: a black-box model from one record, or a nonlinear one from several."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ambid.cli.interrupts import Stop, interruptible, signals
from ambid.cli.options import (
    FAILED_CHECK,
    FIGURE_ENDINGS,
    From,
    Gaps,
    Inputs,
    JsonFile,
    OpenLoop,
    OutputColumns,
    Rate,
    References,
    RigFile,
    SecondRecord,
    Strict,
    To,
    argument,
    fixed_of,
    json_path,
    option,
    orders_of,
    refuse_given,
    refuse_twice,
    settings_of,
    switch,
)
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter, progress
from ambid.errors import EstimationError, nearest

if TYPE_CHECKING:
    from ambid.blackbox.fit import BlackBoxFit
    from ambid.nonlinear.fit import NonlinearFit

Part = tuple[float | None, float | None]


def command(
    records: Annotated[
        list[Path],
        argument("RECORD...", "Record: .csv, .csv.gz, .h5 or .mat; nonlinear structures take several of one bench."),
    ],
    structure: Annotated[str, option("--structure", "NAME", "Structure; 'ambid models' lists them.")],
    inputs: Inputs = None,
    output: OutputColumns = None,
    orders: Annotated[
        str,
        option(
            "--orders",
            "na=2,nb=2,nk=1",
            "Orders; nb=2/3 for two inputs that differ, nk=auto to find a delay, auto to choose all.",
            True,
        ),
    ] = "auto",
    settings: Annotated[
        str | None,
        option(
            "--settings",
            "ny=2,nu=2,degree=3",
            "Settings of a nonlinear structure (--orders does the same); 'ambid models' lists them.",
        ),
    ] = None,
    seed: Annotated[int | None, option("--seed", "N", "Of all that is random in a nonlinear structure.", "0")] = None,
    criterion: Annotated[
        str, switch("--criterion", "What chooses orders: bic, aic, aicc, mdl, fpe, holdout or kfold.")
    ] = "bic",
    fix: Annotated[list[str] | None, option("--fix", "NAME=NUMBER", "A coefficient that is known; repeat.")] = None,
    rig: RigFile = None,
    reference: References = None,
    open_loop: OpenLoop = False,
    at_rest: Annotated[
        bool,
        switch(
            "--at-rest",
            "Say that all was zero before the first sample: estimate no offsets and initial states (polynomial).",
        ),
    ] = False,
    from_s: From = None,
    to_s: To = None,
    rate: Rate = None,
    gaps: Gaps = None,
    second: SecondRecord = None,
    validate_from: Annotated[
        float | None, option("--validate-from", "S", "Use the second record from here on, in s.")
    ] = None,
    validate_to: Annotated[
        float | None, option("--validate-to", "S", "Use the second record up to here, in s.")
    ] = None,
    json: JsonFile = None,
    plot: Annotated[
        Path | None,
        option(
            "--plot",
            "FILE.png",
            "Draw signals, residuals, Bode and poles; of a nonlinear structure signals, errors, coefficients and"
            " learning curves.",
        ),
    ] = None,
    stabilisation: Annotated[
        Path | None,
        option(
            "--stabilisation",
            "FILE.png",
            "Draw the poles of models of order 1 to 20 (n4sid, moesp or cva where --structure names them, else pbsid).",
        ),
    ] = None,
    sensitivity: Annotated[
        bool, switch("--sensitivity", "Show how much each coefficient matters, and which belong together.")
    ] = False,
    strict: Strict = False,
) -> None:
    """Fit a black-box model to a record: polynomial, subspace, continuous-time or nonlinear structures.

    The plant is taken to be under feedback unless --open-loop says otherwise: structures that feedback disturbs warn.
    With --rig, inputs and outputs are the rig's, and a linear fit is carried on to its physical parameters.
    Ctrl-C during a nonlinear fit keeps the best model so far (exit code 130).
    """
    from ambid.job import fit, fit_nonlinear, physics, read_data
    from ambid.nonlinear.structures import NONLINEAR_STRUCTURES
    from ambid.rig import load_rig

    nonlinear, part, second_part = structure in NONLINEAR_STRUCTURES, (from_s, to_s), (validate_from, validate_to)
    linear_only = {
        "--criterion": criterion != "bic",
        "--fix": bool(fix),
        "--reference": bool(reference),
        "--at-rest": at_rest,
        "--stabilisation": stabilisation is not None,
        "--sensitivity": sensitivity,
    }
    if nonlinear:
        refuse_given(linear_only, f"{{}} is for linear structures; {structure} has no use for it. Leave it out")
        if settings is not None and orders != "auto":
            raise EstimationError("--orders and --settings say the same of a nonlinear structure. Give one of them")
    else:
        _check_linear(records, structure, {"--settings": settings is not None, "--seed": seed is not None})
    stop, extras = Stop(), list[tuple[str, Any, Callable[..., str]]]()
    with Outputs(*records, second, rig) as outputs:
        outputs.claim(json_path(json), "--json")
        outputs.claim(plot, "--plot", FIGURE_ENDINGS)
        outputs.claim(stabilisation, "--stabilisation", FIGURE_ENDINGS)
        refuse_twice(records)
        if nonlinear:
            _check_second(records, part, second, second_part)
        bench = None if rig is None else load_rig(rig)
        channels: dict[str, Any] = {"inputs": inputs or (), "outputs": output or (), "rate_hz": rate, "gaps": gaps}
        channels["rig"] = bench
        words = {
            **channels, "structure_name": structure, "open_loop": open_loop, "from_s": from_s, "to_s": to_s,
            "validate": second, "validate_from_s": validate_from, "validate_to_s": validate_to,
        }  # fmt: skip
        found: BlackBoxFit | NonlinearFit
        with signals(stop.take) if nonlinear else nullcontext(), progress("fit") as show:
            if nonlinear:
                wished = settings_of(orders if settings is None else settings)
                tick = interruptible(show, stop)
                found = fit_nonlinear(records, settings=wished, seed=seed or 0, tick=tick, **words)
                stop.torn()
            else:
                found = linear = fit(
                    records[0], orders=orders_of(orders), criterion=criterion, fixed=fixed_of(fix) or None,
                    at_rest=at_rest, references=reference or (), tick=show, **words,
                )  # fmt: skip
                if bench is not None:
                    from ambid.report.estimate_text import physics_text

                    extras.append(("physical", physics(linear, bench), physics_text))
            if (plot is not None and found.status != "failed") or stabilisation is not None or sensitivity:
                data = [read_data(x, part=part, **channels) for x in records]
                other = None if second is None or not nonlinear else read_data(second, part=second_part, **channels)
                if sensitivity:
                    from ambid.report.tables import sensitivity_text
                    from ambid.validate.sensitivity import sensitivity_analysis

                    extras.append(("sensitivity", sensitivity_analysis(linear, data[0]), sensitivity_text))
                show("draw")
                _draw(found, data, other, outputs, plot, stabilisation, show)
        written = _json_text(found, extras)
        outputs.stage_json(json, written)
    if json == "-":
        typer.echo(written, nl=False)
    else:
        from ambid.report.fit_text import fit_text

        texts = [fit_text(found, paint=painter()), *(text(x, paint=painter()) for _, x, text in extras)]
        typer.echo("\n\n".join(texts))
    if stop.wished():
        raise typer.Exit(stop.code)
    against = against_second(found)
    if json != "-" and against:
        typer.echo("\n".join(against))
    sound = found.passed and all(x.passed for name, x, _ in extras if name == "physical")
    if found.status == "failed" or (strict and (against or not sound)):
        raise typer.Exit(FAILED_CHECK)


def _check_linear(records: Sequence[Path], structure: str, given: Mapping[str, bool]) -> None:
    """Refuse what a linear structure has no use for, and a structure that is none."""
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
    refuse_given(given, f"{{}} is for nonlinear structures; {structure} has --orders. Leave it out")


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


def against_second(found: BlackBoxFit | NonlinearFit) -> list[str]:
    """Say why a fit does not hold on the second record, a line for each reason; empty where it was not judged there."""
    from ambid.validate.second_record import objections

    judged: Any = found.validation
    return [] if judged is None else [f"it does not hold on the second record: {x}" for x in objections(found, judged)]


def _draw(
    found: Any,
    data: Sequence[Any],
    second: Any,
    outputs: Outputs,
    plot: Path | None,
    stabilisation: Path | None,
    tick: Callable[[str], None],
) -> None:
    """Draw the figures that are asked for."""
    from ambid.blackbox.fit import BlackBoxFit
    from ambid.report.drawing import save
    from ambid.report.fit_figures import fit_overview, stabilisation_figure

    if plot is not None and isinstance(found, BlackBoxFit):
        page = fit_overview(found, data[0])
        outputs.stage(plot, lambda path: save(page, path))
    elif plot is not None:
        from ambid.report.nonlinear_figures import nonlinear_overview

        pages = nonlinear_overview(found, data, second)
        outputs.stage(plot, lambda path: save(pages, path))
    if stabilisation is not None:
        from ambid.validate.stabilisation import stabilisation as poles_by_order

        method = found.structure if found.structure in ("n4sid", "moesp", "cva") else "pbsid"
        diagram = stabilisation_figure(poles_by_order(data[0], method, tick=lambda: tick("stabilisation")))
        outputs.stage(stabilisation, lambda path: save(diagram, path))


def _json_text(found: Any, extras: Sequence[tuple[str, Any, object]]) -> str:
    """Put a fit into ``ambid.fit/1``, with ``physical`` of a rig and ``sensitivity`` where they were asked for."""
    from ambid.blackbox.fit import BlackBoxFit
    from ambid.estimation.documents import covariance_together, fields_json, json_text

    if not isinstance(found, BlackBoxFit):
        from ambid.nonlinear.fit_file import nonlinear_fit_text

        return nonlinear_fit_text(found)
    from ambid.blackbox.fit_file import fit_to_json

    document = fit_to_json(found)
    for name, x, _ in extras:
        entries = fields_json(x, without=("structure", "singular_values", "weakest") if name == "physical" else ())
        document[name] = covariance_together(entries) if name == "physical" else entries
    return json_text(document)
