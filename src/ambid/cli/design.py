"""``ambid design``: the experiment that shows a plant best, and the controller for it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import typer

from ambid.cli.options import Values, verb
from ambid.cli.output import Outputs
from ambid.cli.terminal import progress
from ambid.errors import AmbidError

group = typer.Typer(rich_markup_mode=None, help="Design what comes next on an identified model.")


@group.command("experiment", short_help="design the excitation that shows the parameters best within limits")
@verb("design experiment")
def experiment(v: Values) -> None:
    """Design the periodic excitation that shows the parameters best, within limits that it keeps by prediction.

    Amplitudes and phases are optimised together for the standard deviations that 'ambid identify' will report. The
    limits are those of the rig, for drawn plants and from rest too.
    """
    from ambid.job import design_experiment
    from ambid.job.experiment_design import one_period
    from ambid.physics.presets import preset_of
    from ambid.record import write_record

    known = None if v.source.lower().endswith(".json") else preset_of(v.source)
    of = None if known is not None else Path(v.source)
    with Outputs(of, v.rig, **v.outputs) as outputs, progress("design") as show:
        outputs.claim(v.out, "out", (".csv", ".csv.gz", ".h5", ".hdf5"), force=v.force)
        how = v.only("seconds period band criterion target use spread rate_hz closed seed")
        found = design_experiment(known or v.source, v.rig, **how, tick=show)
        outputs.give(found, show)
        if v.out is not None:
            outputs.stage(v.out, lambda path: write_record(one_period(found), path))
    outputs.show(found, strict=v.strict)


@group.command("controller", short_help="design the controller, and verify it on plants around the estimate")
@verb("design controller")
def controller(v: Values) -> None:
    """Design the controller of an identified bearing, and verify it on plants around the estimate.

    Goals are minimised on the worst of many plants; every other figure must not become worse than it is with the rig's
    [loop], unless a --limit says otherwise.
    """
    from ambid.control.design import GOALS
    from ambid.job import design_controller

    with Outputs(v.estimate, v.rig, **v.outputs) as outputs, progress("design") as show:
        outputs.claim(v.out, "out", force=v.force)
        how = v.only("form filters speeds_rpm plants seed")
        how |= {"limits": _figures(v.limits or ()), "spread": _sources(v.spread or ())}
        found = design_controller(v.estimate, v.rig, goals=v.goals or GOALS, **how, tick=show)
        outputs.give(found, show)
        if v.out is not None:
            from ambid.rig import rig_text

            outputs.stage_text(v.out, rig_text(found.new_rig, v.out.parent))
    outputs.show(found, strict=v.strict)


def _figures(words: Sequence[str]) -> dict[str, float]:
    """Read ``--limit``: figures with a number and a unit; the peak in dB, all else in SI."""
    from ambid.control.design import FIGURES
    from ambid.units import parse_unit

    found = {}
    for word in words:
        name, number, unit = _parts(word, "--limit", "peak=9.5dB")
        if name in FIGURES and name != "peak" and unit:
            of = parse_unit(unit)
            if not of.same_kind(parse_unit(FIGURES[name])):
                raise AmbidError(f"--limit {word}: {name} is in {FIGURES[name]}, not in {unit}. Correct the unit")
            number = float(of.to_si(number))
        elif unit not in ("", "dB") or (unit == "dB" and name != "peak"):
            raise AmbidError(f"--limit {word}: the peak is in dB, not in {unit}. Correct the unit")
        found[name] = number
    return found


def _sources(words: Sequence[str]) -> dict[str, object]:
    """Read ``--spread``: sources with a number, or two of them with a colon between."""
    found: dict[str, object] = {}
    for word in words:
        name, _, text = word.partition("=")
        low, _, high = text.partition(":")
        try:
            found[name] = (float(low), float(high)) if high else float(low)
        except ValueError:
            raise AmbidError(f"--spread {word} has no number. Give --spread delay=0.3, for example") from None
    return found


def _parts(word: str, option_name: str, example: str) -> tuple[str, float, str]:
    """Return name, number and unit of a word such as ``noise=0.3V``."""
    name, _, text = word.partition("=")
    digits = len(text) - len(text.lstrip("+-.0123456789"))
    for end in range(len(text), max(digits, 1) - 1, -1):
        try:
            return name.strip(), float(text[:end]), text[end:].strip()
        except ValueError:
            continue
    raise AmbidError(f"{option_name} {word} has no number. Give {option_name} {example}, for example")
