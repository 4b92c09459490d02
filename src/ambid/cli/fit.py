"""``ambid fit``: a black-box model from one record."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ambid.cli.blackbox_options import Inputs, OpenLoop, Outputs_, References, SecondRecord, fixed_of, orders_of
from ambid.cli.options import FAILED_CHECK, From, Gaps, JsonFile, Rate, RecordFile, Strict, To, json_path
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter, progress

FIGURE_ENDINGS = (".png", ".svg", ".pdf")


def command(
    record: RecordFile,
    output: Outputs_,
    structure: Annotated[
        str,
        typer.Option("--structure", metavar="NAME", help="Structure; 'ambid models' lists them.", show_default=False),
    ],
    inputs: Inputs = None,
    orders: Annotated[
        str,
        typer.Option(
            "--orders",
            metavar="na=2,nb=2,nk=1",
            help="Orders; nb=2/3 for two inputs that differ, nk=auto to find a delay, auto to choose all.",
        ),
    ] = "auto",
    criterion: Annotated[
        str, typer.Option("--criterion", help="What chooses orders: bic, aic, aicc, mdl, fpe, holdout or kfold.")
    ] = "bic",
    fix: Annotated[
        list[str] | None,
        typer.Option("--fix", metavar="NAME=NUMBER", help="A coefficient that is known; repeat.", show_default=False),
    ] = None,
    reference: References = None,
    open_loop: OpenLoop = False,
    at_rest: Annotated[
        bool,
        typer.Option(
            "--at-rest",
            help="Say that all was zero before the first sample: estimate no offsets and initial states (polynomial).",
        ),
    ] = False,
    from_s: From = None,
    to_s: To = None,
    rate: Rate = None,
    gaps: Gaps = None,
    second: SecondRecord = None,
    validate_from: Annotated[
        float | None,
        typer.Option(
            "--validate-from", metavar="S", help="Use the second record from here on, in s.", show_default=False
        ),
    ] = None,
    validate_to: Annotated[
        float | None,
        typer.Option("--validate-to", metavar="S", help="Use the second record up to here, in s.", show_default=False),
    ] = None,
    json: JsonFile = None,
    plot: Annotated[
        Path | None,
        typer.Option("--plot", metavar="FILE.png", help="Draw signals, residuals, Bode and poles.", show_default=False),
    ] = None,
    strict: Strict = False,
) -> None:
    """Fit a black-box model to a record: polynomial, subspace or continuous-time structures.

    The plant is taken to be under feedback unless --open-loop says otherwise: structures that feedback disturbs warn.
    """
    from ambid.identify.blackbox.fit_file import fit_text as fit_json
    from ambid.job import fit, read_data
    from ambid.report.fit_text import fit_text

    with Outputs(record, second) as outputs:
        outputs.claim(json_path(json), "--json")
        outputs.claim(plot, "--plot", FIGURE_ENDINGS)
        wanted, known = orders_of(orders), fixed_of(fix)
        with progress("fit") as tick:
            found = fit(
                record,
                inputs=inputs or (),
                outputs=output,
                structure_name=structure,
                orders=wanted,
                criterion=criterion,
                fixed=known or None,
                at_rest=at_rest,
                references=reference or (),
                open_loop=open_loop,
                from_s=from_s,
                to_s=to_s,
                rate_hz=rate,
                gaps=gaps,
                validate=second,
                validate_from_s=validate_from,
                validate_to_s=validate_to,
                tick=tick,
            )
            if plot is not None:
                from ambid.report.figures import save
                from ambid.report.fit_figures import overview

                tick("draw")
                data = read_data(record, inputs or (), output, part=(from_s, to_s), rate_hz=rate, gaps=gaps)
                page = overview(found, data)
                outputs.stage(plot, lambda path: save(page, path))
        path = json_path(json)
        if path is not None:
            outputs.stage_text(path, fit_json(found))
        elif json == "-":
            typer.echo(fit_json(found), nl=False)
    if json != "-":
        typer.echo(fit_text(found, paint=painter()))
    if strict and not found.passed:
        raise typer.Exit(FAILED_CHECK)
