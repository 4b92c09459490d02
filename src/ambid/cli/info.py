"""``ambid info``: what a record holds; ``ambid models``: what there is to identify and to simulate."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable

import typer

from ambid.cli.options import Values, verb
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter, progress


@verb("info")
def info(v: Values) -> None:
    """Show what a record holds: channels, rate, levels, resolution, noise, saturation, drop-outs, outliers, excitation.

    With --rig, channels are named by role and calibrated, and what the inputs explain does not count as noise.
    """
    from ambid.job import info

    with Outputs(v.record, v.rig, **v.outputs) as outputs, progress("look") as show:
        found = info(v.record, v.rig, **v.only("rate_hz gaps layout"))
        outputs.give(found, show)
    outputs.show(found, strict=v.strict)


def models() -> None:
    """List models with their parameters and units, black-box structures, excitations, scenarios and preset benches."""
    from ambid.blackbox.fit import RESPONSE_STRUCTURES, STRUCTURES
    from ambid.nonlinear.fit import NONLINEAR_STRUCTURES
    from ambid.physics.law_magnet import BEARING_NUMBERS
    from ambid.physics.linear_model import model, model_names
    from ambid.physics.presets import preset, preset_names
    from ambid.physics.rotor_model import Bearing, RotorModel
    from ambid.report.text import columns
    from ambid.signals import AXES_EXCITATIONS, EXCITATIONS
    from ambid.simulation.scenarios import scenario, scenario_names

    paint = painter()
    bearing = Bearing(name="A", axes=("ax",))
    rotor = RotorModel(bearings=(bearing,), polar=True, extras=("a", "ax.gain", "ax.sensor_pole"))
    for name, of in [*((name, model(name)) for name in model_names()), ("rotor on many axes, here ax", rotor)]:
        signals = [f"{role} [{of.units[role]}]" for role in (*of.inputs, *of.outputs)]
        count = len(of.inputs)
        typer.echo(paint(name, "strong"))
        _entries([("  ", of.summary)], indent=2)
        typer.echo(f"  in: {', '.join(signals[:count])}; out: {', '.join(signals[count:])}")
        left = columns([(f"  {p.name}", f"[{p.unit}]") for p in of.parameters])
        defaults = ["" if p.default is None else f" ({p.default:g} unless given)" for p in of.parameters]
        _entries(zip(left, (p.meaning + x for p, x in zip(of.parameters, defaults, strict=True)), strict=True))
        typer.echo()
    use = "  one-axis with 'ambid identify --nonlinear', with m, R and c; known values belong in [magnet.parameters]"
    typer.echo(textwrap.fill(f"{paint('nonlinear magnet', 'strong')}{use}", 80, subsequent_indent="  "))
    left = columns([(f"  {p.name}", f"[{p.unit}]") for p in BEARING_NUMBERS])
    _entries(zip(left, (p.meaning for p in BEARING_NUMBERS), strict=True))
    typer.echo(f"\n{paint('structures', 'strong')}  black-box models for 'ambid fit'; * biased by feedback")
    left = columns([(f"  {x.name}{'*' * (x.feedback == 'biased')}", " ".join(x.orders)) for x in STRUCTURES.values()])
    _entries(zip(left, (x.summary for x in STRUCTURES.values()), strict=True))
    typer.echo(f"\n{paint('nonlinear structures', 'strong')}  for 'ambid fit', with settings (meaning; default)")
    for n in NONLINEAR_STRUCTURES.values():
        _entries([(f"  {n.name}{'*' * (n.feedback == 'biased')}", n.summary)])
        _entries((f"    {name}", meaning) for name, meaning in n.settings.items())
    typer.echo(f"\n{paint('structures from a frequency response', 'strong')}  for 'ambid frf'")
    for x in RESPONSE_STRUCTURES.values():
        _entries([(f"  {x.name.ljust(14)}{' '.join(x.orders)}", x.summary)])
    typer.echo(f"\n{paint('excitations', 'strong')}  {', '.join(EXCITATIONS)}")
    typer.echo(f"  over the axes of a rotor: {', '.join(AXES_EXCITATIONS)}\n")
    typer.echo(f"{paint('scenarios', 'strong')}  changes with known truth for 'ambid simulate --scenario'")
    _entries((f"  {name}", scenario(name).summary) for name in scenario_names())
    typer.echo(f"\n{paint('presets', 'strong')}  benches for 'ambid simulate'")
    _entries((f"  {name}", preset(name).summary) for name in preset_names())


def _entries(rows: Iterable[tuple[str, str]], *, indent: int | None = None) -> None:
    """Print rows of a name and what it means, the meanings in one column that is wrapped."""
    found = list(rows)
    wide = max((len(name) + 2 for name, _ in found), default=0) if indent is None else indent
    for name, meaning in found:
        typer.echo(textwrap.fill(meaning, 80, initial_indent=name.ljust(wide), subsequent_indent=" " * wide))
