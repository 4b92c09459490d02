"""``ambid fit``: a black-box model from one record, or a nonlinear one from several."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ambid.cli.blackbox_options import Inputs, OpenLoop, OutputColumns, References, SecondRecord, fixed_of, orders_of
from ambid.cli.fit_nonlinear import against_second, fit_records, one_record, only_one, refuse_linear_only
from ambid.cli.options import FAILED_CHECK, From, Gaps, JsonFile, Rate, RigFile, Strict, To, json_path
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter, progress

if TYPE_CHECKING:
    from ambid.bearing.physical import PhysicalFit
    from ambid.blackbox.data import IOData
    from ambid.blackbox.fit import BlackBoxFit
    from ambid.validate.sensitivity import SensitivityAnalysis

FIGURE_ENDINGS = (".png", ".svg", ".pdf")


def command(
    records: Annotated[
        list[Path],
        typer.Argument(
            metavar="RECORD...",
            help="Record: .csv, .csv.gz, .h5 or .mat; nonlinear structures take several of one bench.",
            show_default=False,
        ),
    ],
    structure: Annotated[
        str,
        typer.Option("--structure", metavar="NAME", help="Structure; 'ambid models' lists them.", show_default=False),
    ],
    inputs: Inputs = None,
    output: OutputColumns = None,
    orders: Annotated[
        str,
        typer.Option(
            "--orders",
            metavar="na=2,nb=2,nk=1",
            help="Orders; nb=2/3 for two inputs that differ, nk=auto to find a delay, auto to choose all.",
        ),
    ] = "auto",
    settings: Annotated[
        str | None,
        typer.Option(
            "--settings",
            metavar="ny=2,nu=2,degree=3",
            help="Settings of a nonlinear structure (--orders does the same); 'ambid models' lists them.",
            show_default=False,
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option("--seed", metavar="N", help="Of all that is random in a nonlinear structure.", show_default="0"),
    ] = None,
    criterion: Annotated[
        str, typer.Option("--criterion", help="What chooses orders: bic, aic, aicc, mdl, fpe, holdout or kfold.")
    ] = "bic",
    fix: Annotated[
        list[str] | None,
        typer.Option("--fix", metavar="NAME=NUMBER", help="A coefficient that is known; repeat.", show_default=False),
    ] = None,
    rig: RigFile = None,
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
        typer.Option(
            "--plot",
            metavar="FILE.png",
            help="Draw signals, residuals, Bode and poles; of a nonlinear structure signals, errors, coefficients and"
            " learning curves.",
            show_default=False,
        ),
    ] = None,
    stabilisation: Annotated[
        Path | None,
        typer.Option(
            "--stabilisation",
            metavar="FILE.png",
            help="Draw the poles of models of order 1 to 20 (n4sid, moesp or cva where --structure names them, else"
            " pbsid).",
            show_default=False,
        ),
    ] = None,
    sensitivity: Annotated[
        bool, typer.Option("--sensitivity", help="Show how much each coefficient matters, and which belong together.")
    ] = False,
    strict: Strict = False,
) -> None:
    """Fit a black-box model to a record: polynomial, subspace, continuous-time or nonlinear structures.

    The plant is taken to be under feedback unless --open-loop says otherwise: structures that feedback disturbs warn.
    With --rig, inputs and outputs are the rig's, and a linear fit is carried on to its physical parameters.
    Ctrl-C during a nonlinear fit keeps the best model so far (exit code 130).
    """
    from ambid.nonlinear.structures import NONLINEAR_STRUCTURES

    if structure in NONLINEAR_STRUCTURES:
        linear_only = {
            "--criterion": criterion != "bic",
            "--fix": bool(fix),
            "--reference": bool(reference),
            "--at-rest": at_rest,
            "--stabilisation": stabilisation is not None,
            "--sensitivity": sensitivity,
        }
        refuse_linear_only(linear_only, structure)
        fit_records(
            records,
            structure,
            orders if settings is None else only_one(orders, settings),
            inputs=inputs or (),
            outputs=output or (),
            open_loop=open_loop,
            part=(from_s, to_s),
            rate=rate,
            gaps=gaps,
            second=second,
            second_part=(validate_from, validate_to),
            rig=rig,
            seed=seed or 0,
            json=json,
            plot=plot,
            strict=strict,
        )
        return
    record = one_record(records, structure, settings, seed)
    from ambid.job import fit, physics, read_data
    from ambid.report.estimate_text import physics_text
    from ambid.report.fit_text import fit_text
    from ambid.rig import load_rig

    with Outputs(record, second, rig) as outputs:
        outputs.claim(json_path(json), "--json")
        outputs.claim(plot, "--plot", FIGURE_ENDINGS)
        outputs.claim(stabilisation, "--stabilisation", FIGURE_ENDINGS)
        wanted, known = orders_of(orders), fixed_of(fix)
        bench = None if rig is None else load_rig(rig)
        with progress("fit") as tick:
            found = fit(
                record,
                inputs=inputs or (),
                outputs=output or (),
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
                rig=bench,
                tick=tick,
            )
            physical = None if bench is None else physics(found, bench)
            matter = None
            if plot is not None or stabilisation is not None or sensitivity:
                part = (from_s, to_s)
                data = read_data(record, inputs or (), output or (), part=part, rate_hz=rate, gaps=gaps, rig=bench)
                if sensitivity:
                    from ambid.validate.sensitivity import sensitivity_analysis

                    matter = sensitivity_analysis(found, data)
                _draw(found, data, outputs, plot, stabilisation, tick)
        written = _json_text(found, physical, matter)
        if (path := json_path(json)) is not None:
            outputs.stage_text(path, written)
        elif json == "-":
            typer.echo(written, nl=False)
    if json != "-":
        typer.echo(fit_text(found, paint=painter()))
        if physical is not None:
            typer.echo("\n" + physics_text(physical, paint=painter()))
        if matter is not None:
            from ambid.report.tables import sensitivity_text

            typer.echo("\n" + sensitivity_text(matter, paint=painter()))
    against = against_second(found)
    if json != "-" and against:
        typer.echo("\n".join(against))
    if strict and (against or not (found.passed and (physical is None or physical.passed))):
        raise typer.Exit(FAILED_CHECK)


def _draw(
    found: BlackBoxFit,
    data: IOData,
    outputs: Outputs,
    plot: Path | None,
    stabilisation: Path | None,
    tick: Callable[[str], None],
) -> None:
    """Draw the figures that are asked for."""
    from ambid.report.drawing import save

    if plot is not None:
        from ambid.report.fit_figures import fit_overview

        tick("draw")
        page = fit_overview(found, data)
        outputs.stage(plot, lambda path: save(page, path))
    if stabilisation is not None:
        from ambid.report.fit_figures import stabilisation_figure
        from ambid.validate.stabilisation import stabilisation as poles_by_order

        method = found.structure if found.structure in ("n4sid", "moesp", "cva") else "pbsid"
        diagram = stabilisation_figure(poles_by_order(data, method, tick=lambda: tick("stabilisation")))
        outputs.stage(stabilisation, lambda path: save(diagram, path))


def _json_text(found: BlackBoxFit, physical: PhysicalFit | None, matter: SensitivityAnalysis | None) -> str:
    """Put the fit into ``ambid.fit/1``, with ``physical`` of a rig and ``sensitivity`` where they were asked for."""
    from ambid.blackbox.fit_file import fit_to_json
    from ambid.estimation.documents import covariance_together, fields_json, json_text, plain_json

    document = fit_to_json(found)
    if physical is not None:
        unsaid = ("structure", "singular_values", "weakest")
        document["physical"] = covariance_together(fields_json(physical, without=unsaid))
    if matter is not None:
        document["sensitivity"] = plain_json(matter)
    return json_text(document)
