"""``ambid identify``: physical parameters with uncertainty from one record, or a nonlinear magnet from several."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ambid.cli.identify_nonlinear import Wishes, identify_records, one_record
from ambid.cli.options import FAILED_CHECK, From, Gaps, JsonFile, Rate, RigFile, Strict, To, json_path
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter, progress

if TYPE_CHECKING:
    from ambid.estimation.estimate import Estimate
    from ambid.record import Record

FIGURE_ENDINGS = (".png", ".svg", ".pdf")

Records = Annotated[
    list[Path],
    typer.Argument(
        metavar="RECORD...",
        help="Record: .csv, .csv.gz, .h5 or .mat; with --nonlinear several, best at several positions.",
        show_default=False,
    ),
]
PlotFile = Annotated[
    Path | None,
    typer.Option(
        "--plot",
        metavar="FILE.png",
        help="Draw signals, residuals, Bode and poles; with --nonlinear curves with bands, and every record.",
        show_default=False,
    ),
]
ReportFile = Annotated[
    Path | None,
    typer.Option("--report", metavar="FILE.html", help="Write a report, all in one file.", show_default=False),
]


def command(
    records: Records,
    rig: RigFile = None,
    nonlinear: Annotated[
        bool,
        typer.Option("--nonlinear", help="The nonlinear magnet: k_i, k_x and L as curves over position and current."),
    ] = False,
    held: Annotated[
        list[Path] | None,
        typer.Option(
            "--held",
            metavar="RECORD",
            help="Nonlinear: a record with the rotor held at rest, which shows the coil; repeat.",
            show_default=False,
        ),
    ] = None,
    magnet: Annotated[
        Literal["auto", "single", "pair"] | None,
        typer.Option(
            "--magnet",
            help="Nonlinear: one magnet, or two that oppose each other; auto looks at the sign of the current.",
            show_default="as the rig says, or auto",
        ),
    ] = None,
    eddy: Annotated[
        bool, typer.Option("--eddy", help="Nonlinear: the force follows the current with a pole a/(s + a).")
    ] = False,
    drift: Annotated[
        bool, typer.Option("--drift", help="Nonlinear: let a slowly walking force take up what the law leaves over.")
    ] = False,
    off_below: Annotated[
        float | None,
        typer.Option(
            "--off-below",
            metavar="V",
            help="Nonlinear: at or below this voltage the power stage is off, and the coil's voltage not known.",
            show_default="as the rig says",
        ),
    ] = None,
    second: Annotated[
        Path | None,
        typer.Option(
            "--validate", metavar="RECORD2", help="Judge the estimate on this second record.", show_default=False
        ),
    ] = None,
    from_s: From = None,
    to_s: To = None,
    rate: Rate = None,
    gaps: Gaps = None,
    json: JsonFile = None,
    plot: PlotFile = None,
    report: ReportFile = None,
    strict: Strict = False,
) -> None:
    """Identify the physical parameters of a bench from a record of voltage, current and position.

    Without --rig: columns named voltage, current and position, model one-axis, everything free.
    With --nonlinear, one model for all records, and curves with bands; what is known of the magnet stands in [magnet]
    of the rig. Ctrl-C then keeps the best so far (exit code 130).
    """
    wishes = Wishes(held=tuple(held or ()), magnet=magnet, eddy=eddy, drift=drift, off_below=off_below)
    if nonlinear:
        identify_records(
            records, rig, wishes, part=(from_s, to_s), rate=rate, gaps=gaps, second=second, json=json, plot=plot,
            report=report, strict=strict,
        )  # fmt: skip
        return
    record = one_record(records, wishes)
    from ambid.job import identify, load
    from ambid.rig import default_rig, load_rig

    with Outputs(record, rig, second) as outputs:
        outputs.claim(json_path(json), "--json")
        outputs.claim(plot, "--plot", FIGURE_ENDINGS)
        outputs.claim(report, "--report", (".html", ".htm"))
        bench = default_rig() if rig is None else load_rig(rig)
        with progress("identify") as tick:
            estimate = identify(
                record, bench, validate=second, from_s=from_s, to_s=to_s, rate_hz=rate, gaps=gaps, tick=tick
            )
            if plot or report:
                tick("draw")
                used = load(record, bench, from_s=from_s, to_s=to_s, rate_hz=rate, gaps=gaps)
                draw(estimate, used, outputs, plot=plot, report=report)
        stage_json(estimate, json, outputs)
    if json != "-":
        from ambid.report.estimate_text import estimate_text

        typer.echo(estimate_text(estimate, paint=painter()))
    if estimate.global_search is not None and estimate.global_search["interrupted"]:
        raise typer.Exit(130)
    if strict and not (estimate.passed and (estimate.validation is None or estimate.validation["passed"])):
        raise typer.Exit(FAILED_CHECK)


def stage_json(estimate: Estimate, json: str | None, outputs: Outputs) -> None:
    """Give the estimate out as JSON, where that is wanted.

    `estimate`: what to write; `json`: the option ``--json``; `outputs`: takes the file.
    """
    path = json_path(json)
    if path is not None:
        outputs.stage_text(path, estimate.dumps())
    elif json == "-":
        typer.echo(estimate.dumps(), nl=False)


def draw(estimate: Estimate, used: Record, outputs: Outputs, *, plot: Path | None, report: Path | None) -> None:
    """Draw the figures of an estimate, and write its report.

    `estimate`: what is shown; `used`: the record it came from, cut, channels named by role; `outputs`: takes the files;
    `plot`, `report`: where figures and report go.
    """
    from datetime import UTC, datetime

    from ambid.job import signals_of
    from ambid.physics.models import model
    from ambid.report.drawing import save
    from ambid.report.figures import Evidence, overview
    from ambid.report.page import report_html
    from ambid.validate.second_record import replay

    run = replay(estimate, signals_of(used, model(estimate.model)))
    evidence = Evidence(estimate=estimate, run=run, start_s=used.start_s)
    if plot is not None:
        outputs.stage(plot, lambda path: save(overview(evidence), path))
    if report is not None:
        made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
        outputs.stage_text(report, report_html(evidence, made=made))
