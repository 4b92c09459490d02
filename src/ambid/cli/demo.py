"""``ambid demo``: the main job on the embedded record, which ``tools/demo_record.py`` makes, beside the truth."""

from __future__ import annotations

from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import TYPE_CHECKING, Any

import typer

from ambid.cli.terminal import painter, progress

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ambid.estimation.estimate import Estimate
    from ambid.report.document import Table

# Truth of the thesis's simulation rig (table 4.1, corrected) and what its own identification found there (eq. 4.11).
_THESIS = {
    "m": (0.1, 0.0976), "k_x": (587.22, 608.1), "k_i": (-310.08, -320.0), "R": (1.25, 1.138), "L": (59.6e-3, 60.2e-3)
}  # fmt: skip
PRESET = "unstable-bearing"
_INSIDE = 3.29  # standard deviations of a 99.9 % interval


def command() -> None:
    """Identify the embedded record and print the estimate beside the truth.

    The record: 0.1 s of an unstable bearing levitated by a PID controller, simulated with noise. No parameter is given.
    """
    from ambid.job.identification import demo
    from ambid.physics.presets import preset
    from ambid.report.document import Checks, Lines, Section, sections_text
    from ambid.report.estimate import delay_lines, header, output_table
    from ambid.report.parameters import calibration_lines
    from ambid.report.text import verdict_lines

    with progress("identify") as tick:
        estimate = demo(tick=tick)
    paint = painter()
    truth = preset(PRESET).parameters
    whole = sum(estimate.timing_s.values())
    inside = [abs(row.z) < _INSIDE for row in truth_rows(estimate, truth)]
    mark = ("✓", "good") if all(inside) else ("✗", "bad")
    sections = [
        Section(parts=[*header(estimate), Lines(lines=["simulated in closed loop; no parameter was given"])]),
        Section(
            parts=[
                truth_table(estimate, truth),
                Lines(
                    lines=[
                        "* error in eq. 4.11 of the thesis that ambid builds on, 'Physical parameters",
                        "  identification for a prototype of Active Magnetic Bearing system', simulated",
                        [mark, f" {sum(inside)} of {len(inside)} true values lie in their 99.9 % intervals"],
                    ],
                    wrap=False,
                ),
            ]
        ),
        Section(parts=[Lines(lines=calibration_lines(estimate), indent=2)]),
        Section(parts=[Lines(lines=delay_lines(estimate))]),
        Section(parts=[output_table(estimate)]),
        Section(parts=[Checks(checks=estimate.checks)]),
        Section(
            parts=[Lines(lines=[f"time: {whole:.2g} s from file to checked estimate (the thesis* reports about 5 s)"])]
        ),
    ]
    typer.echo("\n".join([*verdict_lines(estimate.verdict, paint=paint), "", sections_text(sections, paint=paint)]))


def truth_rows(estimate: Estimate, truth: Mapping[str, float]) -> list[Any]:
    """Return the parameters that were estimated beside their truth, SI."""
    from ambid.report.parameters import TrueRow

    return [
        TrueRow(parameter=p, verdict=estimate.verdict, truth=truth[p.name])
        for p in estimate.parameters
        if p.role != "fixed"
    ]


def truth_table(estimate: Estimate, truth: Mapping[str, float]) -> Table:
    """Return the table of parameters with truth and errors, and the errors of the thesis."""
    from ambid.report.document import Column, Table
    from ambid.report.parameters import varied

    def theirs(row: Any) -> str:
        was, got = _THESIS[row.parameter.name]
        return _percent(got - was, was, 1)

    more = [
        Column(label="truth", cell=lambda row: row.true_text),
        Column(label="error", cell=lambda row: _percent(row.parameter.value - row.truth, row.truth, 2), right=True),
        Column(label="in sd", cell=lambda row: f"{row.z:+.1f}", right=True),
        Column(label="thesis*", cell=theirs, right=True),
    ]
    labels = {"value ± sd": "estimate ± sd", "95 % interval": None, "in SI": None}
    return Table(columns=varied(labels, {"value ± sd": more}), rows=truth_rows(estimate, truth))


def _percent(error: float, of: float, decimals: int) -> str:
    return f"{100 * error / abs(of):+.{decimals}f} %"


def demo_file(name: str) -> Traversable:
    """Return a file of the demo.

    `name`: ``"demo.csv.gz"`` or ``"demo.toml"``. Returns in the package's data.
    """
    return files("ambid").joinpath("data", name)
