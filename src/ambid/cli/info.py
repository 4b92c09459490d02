"""``ambid info``: what a record holds; ``ambid models``: what there is to identify and to simulate."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import TYPE_CHECKING

import typer

from ambid.cli.options import Gaps, Rate, RecordFile, RigFile
from ambid.cli.terminal import painter, progress

if TYPE_CHECKING:
    from ambid.nonlinear.structures import NonlinearStructure


def info(record: RecordFile, rig: RigFile = None, rate: Rate = None, gaps: Gaps = None) -> None:
    """Show what a record holds: channels, rate, levels, resolution, noise, saturation, drop-outs, outliers, excitation.

    With --rig: the channels by role, calibrated; the noise of the outputs is then told from what the input explains.
    """
    from ambid.physics.models import model
    from ambid.record import read_record
    from ambid.report.tables import record_text
    from ambid.rig import load_rig, read_bench

    with progress("look"):
        if rig is None:
            text = record_text(read_record(record, rate_hz=rate, gaps=gaps or "error"), paint=painter())
        else:
            bench = load_rig(rig)
            inputs = model(bench.model).inputs
            text = record_text(read_bench(record, bench, rate_hz=rate, gaps=gaps), inputs=inputs, paint=painter())
    typer.echo(text)


def models() -> None:
    """List models with their parameters and units, black-box structures, excitations, scenarios and preset benches."""
    from ambid.blackbox.structures import RESPONSE_STRUCTURES, STRUCTURES
    from ambid.nonlinear.structures import NONLINEAR_STRUCTURES
    from ambid.physics.models import model, model_names
    from ambid.physics.presets import preset, preset_names
    from ambid.report.text import columns
    from ambid.signals import EXCITATIONS
    from ambid.simulate import scenario, scenario_names

    paint = painter()
    for name in model_names():
        of = model(name)
        signals = [f"{role} [{of.units[role]}]" for role in (*of.inputs, *of.outputs)]
        count = len(of.inputs)
        typer.echo(paint(name, "strong"))
        typer.echo(textwrap.fill(of.summary, 80, initial_indent="  ", subsequent_indent="  "))
        typer.echo(f"  in: {', '.join(signals[:count])}; out: {', '.join(signals[count:])}")
        rows = [
            (f"  {p.name}", f"[{p.unit}]", p.meaning + ("" if p.default is None else f" ({p.default:g} unless given)"))
            for p in of.parameters
        ]
        typer.echo("\n".join(columns(rows)) + "\n")
    _magnet()
    typer.echo(f"{paint('structures', 'strong')}  black-box models for 'ambid fit'; * is biased under feedback")
    left = columns([(f"  {x.name}{'*' * (x.feedback == 'biased')}", " ".join(x.orders)) for x in STRUCTURES.values()])
    wide = max(map(len, left)) + 2
    for start, x in zip(left, STRUCTURES.values(), strict=True):
        typer.echo(textwrap.fill(x.summary, 80, initial_indent=start.ljust(wide), subsequent_indent=" " * wide))
    typer.echo(f"\n{paint('nonlinear structures', 'strong')}  for 'ambid fit', with settings (what they are; default)")
    for n in NONLINEAR_STRUCTURES.values():
        _nonlinear(n)
    typer.echo(f"\n{paint('structures from a frequency response', 'strong')}  for 'ambid frf'")
    for x in RESPONSE_STRUCTURES.values():
        start = f"  {x.name.ljust(14)}{' '.join(x.orders)}  "
        typer.echo(textwrap.fill(x.summary, 80, initial_indent=start, subsequent_indent=" " * len(start)))
    typer.echo()
    typer.echo(f"{paint('excitations', 'strong')}  {', '.join(EXCITATIONS)}\n")
    _listing("scenarios", "courses of known truth for 'ambid simulate --scenario'",
             {name: scenario(name).summary for name in scenario_names()})  # fmt: skip
    typer.echo()
    _listing("presets", "benches for 'ambid simulate'", {name: preset(name).summary for name in preset_names()})


def _magnet() -> None:
    """The numbers of the nonlinear magnet."""
    from ambid.physics.bearing_numbers import BEARING_NUMBERS
    from ambid.report.text import columns

    use = "  one-axis with 'ambid identify --nonlinear', beside m, R and c; what is known stands in [magnet.parameters]"
    typer.echo(textwrap.fill(f"{painter()('nonlinear magnet', 'strong')}{use}", 80, subsequent_indent="  "))
    left = columns([(f"  {p.name}", f"[{p.unit}]") for p in BEARING_NUMBERS])
    wide = max(map(len, left)) + 2
    for start, p in zip(left, BEARING_NUMBERS, strict=True):
        typer.echo(textwrap.fill(p.meaning, 80, initial_indent=start.ljust(wide), subsequent_indent=" " * wide))
    typer.echo()


def _nonlinear(of: NonlinearStructure) -> None:
    """A structure, then its settings, one below the other."""
    start = f"  {of.name}{'*' * (of.feedback == 'biased')}  "
    typer.echo(textwrap.fill(of.summary, 80, initial_indent=start, subsequent_indent=" " * len(start)))
    wide = max(map(len, of.settings), default=0) + 6
    for name, meaning in of.settings.items():
        typer.echo(textwrap.fill(meaning, 80, initial_indent=f"    {name}".ljust(wide), subsequent_indent=" " * wide))


def _listing(title: str, use: str, summaries: Mapping[str, str]) -> None:

    typer.echo(f"{painter()(title, 'strong')}  {use}")
    wide = max(map(len, summaries))
    for name, summary in summaries.items():
        start = f"  {name.ljust(wide)}  "
        typer.echo(textwrap.fill(summary, 80, initial_indent=start, subsequent_indent=" " * len(start)))
