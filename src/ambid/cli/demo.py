"""``ambid demo``: the main job on the embedded record, which ``tools/demo_record.py`` makes, beside the truth."""

from __future__ import annotations

from importlib.resources import as_file, files
from importlib.resources.abc import Traversable
from typing import TYPE_CHECKING

import typer

from ambid.cli.terminal import painter, progress

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ambid.estimation.estimate import Estimate
    from ambid.report.text import Paint

# Truth of the thesis's simulation rig (table 4.1, corrected) and what its own identification found there (eq. 4.11).
_THESIS = {
    "m": (0.1, 0.0976), "k_x": (587.22, 608.1), "k_i": (-310.08, -320.0), "R": (1.25, 1.138), "L": (59.6e-3, 60.2e-3)
}  # fmt: skip
PRESET = "unstable-bearing"
_INSIDE = 3.29  # standard deviations of a 99.9 % interval


def command() -> None:
    """Identify the embedded record and print the estimate beside the truth.

    The record: 0.4 s of an unstable bearing levitated by a PID controller, simulated with noise. No parameter is given.
    """
    from ambid.job.identification import identify_axis
    from ambid.physics.presets import preset
    from ambid.report.estimate_text import delay_lines, header_lines, output_rows
    from ambid.report.text import check_lines, columns, verdict_lines
    from ambid.rig import load_rig

    with (
        as_file(demo_file("demo.csv.gz")) as record,
        as_file(demo_file("demo.toml")) as rig,
        progress("identify") as tick,
    ):
        estimate = identify_axis(record, load_rig(rig), tick=tick)
    paint = painter()
    truth = preset(PRESET).parameters
    typer.echo("\n".join([*verdict_lines(estimate.verdict, paint=paint), ""]))
    typer.echo(f"{header_lines(estimate, paint=paint)[0]}\nsimulated in closed loop; no parameter was given\n")
    typer.echo("\n".join(truth_lines(estimate, truth, paint)))
    typer.echo("\n" + "\n".join([*delay_lines(estimate), "", *columns(output_rows(estimate))]))
    typer.echo("\n" + "\n".join(check_lines(estimate.checks, paint=paint)))
    whole = sum(estimate.timing_s.values())
    typer.echo(f"\ntime: {whole:.2g} s from file to checked estimate (the thesis* reports about 5 s)")


def truth_lines(found: Estimate, truth: Mapping[str, float], paint: Paint) -> list[str]:
    """Write estimated parameters beside their truth.

    `found`: its fixed parameters are left out; `truth`: SI; `paint`: adds colour. Returns a table, and a
    line on how many truths lie inside their 99.9 % intervals.
    """
    from ambid.report.numbers import quantity
    from ambid.report.text import columns, verdict

    rows = [("", "estimate ± sd", "truth", "error", "in sd", "thesis*", "verdict")]
    inside = []
    for p in (p for p in found.parameters if p.role != "fixed"):
        true, (was, got) = truth[p.name], _THESIS[p.name]
        z = (p.value - true) / p.sd
        inside.append(abs(z) < _INSIDE)
        q = quantity(p.value, p.sd, p.unit)
        scale, decimals = p.value / float(q.value), len(q.value.partition(".")[2])
        shown = f"{true / scale:.{decimals}f} {q.unit}"
        errors = (_percent(p.value - true, true, 2), f"{z:+.1f}", _percent(got - was, was, 1))
        rows.append((p.name, q.text, shown, *errors, verdict(p, found.verdict)))
    mark = paint("✓", "good") if all(inside) else paint("✗", "bad")
    return [
        *columns(rows, right=(3, 4, 5)),
        "* error in eq. 4.11 of the thesis that ambid builds on, 'Physical parameters",
        "  identification for a prototype of Active Magnetic Bearing system', simulated",
        f"{mark} {sum(inside)} of {len(inside)} true values lie in their 99.9 % intervals",
    ]


def _percent(error: float, of: float, decimals: int) -> str:
    return f"{100 * error / abs(of):+.{decimals}f} %"


def demo_file(name: str) -> Traversable:
    """Return a file of the demo.

    `name`: ``"demo.csv.gz"`` or ``"demo.toml"``. Returns in the package's data.
    """
    return files("ambid").joinpath("data", name)
