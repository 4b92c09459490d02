"""``ambid identify --nonlinear``: one nonlinear magnet from several records; Ctrl-C keeps the best so far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import typer

from ambid.cli.interrupts import Stop, interruptible, signals
from ambid.cli.options import FAILED_CHECK, json_path, refuse_twice
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter, progress
from ambid.errors import AmbidError

if TYPE_CHECKING:
    from ambid.bearing.magnet.result import NonlinearBearingEstimate
    from ambid.job.bearing_records import TakenRecord

Part = tuple[float | None, float | None]

_FIGURES = (".png", ".svg", ".pdf")


@dataclass(frozen=True, slots=True, kw_only=True)
class Wishes:
    """Options that only the nonlinear magnet has."""

    held: tuple[Path, ...] = ()  # records with the rotor held at rest
    magnet: Literal["auto", "single", "pair"] | None = None  # none: as the rig says
    eddy: bool = False
    drift: bool = False
    off_below: float | None = None  # in V


def one_record(records: Sequence[Path], wishes: Wishes) -> Path:
    """Return the one record that the linear model takes."""
    given = {
        "--held": bool(wishes.held),
        "--magnet": wishes.magnet is not None,
        "--eddy": wishes.eddy,
        "--drift": wishes.drift,
        "--off-below": wishes.off_below is not None,
    }
    for option, was in given.items():
        if was:
            raise AmbidError(f"{option} is for the nonlinear magnet. Give --nonlinear too, or leave {option} out")
    if len(records) > 1:
        raise AmbidError(
            f"{len(records)} records are given; the linear model takes one, since k_x, k_i and L differ from one "
            "operating point to the next. Give --nonlinear for one model of all, or one record"
        )
    return records[0]


def identify_records(
    records: Sequence[Path],
    rig: Path | None,
    wishes: Wishes,
    *,
    part: Part,
    rate: float | None,
    gaps: str | None,
    second: Path | None,
    json: str | None,
    plot: Path | None,
    report: Path | None,
    strict: bool,
) -> None:
    """Identify a nonlinear magnet from records, write and show it.

    `records`: in which the rotor moves; `part`: of every record in which the rotor moves; `second`: to judge on.
    """
    from ambid.job.bearing_records import Reading
    from ambid.job.nonlinear_bearing import identify_taken, read_records
    from ambid.report.estimate_text import estimate_text

    stop = Stop()
    with Outputs(*records, *wishes.held, rig, second) as outputs:
        outputs.claim(json_path(json), "--json")
        outputs.claim(plot, "--plot", _FIGURES)
        outputs.claim(report, "--report", (".html", ".htm"))
        _check(records, wishes)
        with signals(stop.take), progress("identify") as show:
            tick = interruptible(show, stop)
            taken = read_records(
                records, rig, held=wishes.held, validate=second, magnet=wishes.magnet, eddy=wishes.eddy,
                drift=wishes.drift, off_below=wishes.off_below,
                how=Reading(from_s=part[0], to_s=part[1], rate_hz=rate, gaps=gaps), tick=tick,
            )  # fmt: skip
            estimate = identify_taken(taken, tick=tick)
            stop.torn()
            if plot or report:
                show("draw")
                _draw(estimate, taken.taken, outputs, plot, report)
        written = estimate.dumps()
        if (path := json_path(json)) is not None:
            outputs.stage_text(path, written)
    if json == "-":
        typer.echo(written, nl=False)
    else:
        typer.echo(estimate_text(estimate, paint=painter()))
    if stop.wished():
        raise typer.Exit(stop.code)
    if strict and not (estimate.passed and (estimate.validation is None or estimate.validation["passed"])):
        raise typer.Exit(FAILED_CHECK)


def _check(records: Sequence[Path], wishes: Wishes) -> None:
    """Refuse what would count data twice, and numbers that are none."""
    if wishes.off_below is not None and not isfinite(wishes.off_below):
        raise AmbidError(f"--off-below is {wishes.off_below}; it is a voltage in V. Give a number")
    refuse_twice([*records, *wishes.held])


def _draw(
    estimate: NonlinearBearingEstimate,
    taken: Sequence[TakenRecord],
    outputs: Outputs,
    plot: Path | None,
    report: Path | None,
) -> None:
    from datetime import UTC, datetime

    from ambid.report.drawing import save
    from ambid.report.figures import bearing_evidence, overview
    from ambid.report.page import report_html

    evidence = bearing_evidence(estimate, [(t.record, t.start_s) for t in taken])
    if plot is not None:
        outputs.stage(plot, lambda path: save(overview(evidence), path))
    if report is not None:
        made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
        outputs.stage_text(report, report_html(evidence, made=made))
