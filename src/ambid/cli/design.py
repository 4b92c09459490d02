"""``ambid design``: the experiment that shows a plant best, and the controller for it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from ambid.cli import options as opt
from ambid.cli.options import argument, band_of, option, switch
from ambid.cli.output import Outputs
from ambid.cli.terminal import progress
from ambid.errors import AmbidError

group = typer.Typer(rich_markup_mode=None, help="Design what comes next on an identified model.")


@group.command("experiment", short_help="design the excitation that shows the parameters best within limits")
def experiment(
    source: Annotated[
        str,
        argument("RIG|PRESET|ESTIMATE", "Rig file, a bench that 'ambid models' lists, or what identify --json wrote."),
    ],
    record: Annotated[
        Path | None, option("--out -o FILE", "Write one period of the excitation: .csv, .csv.gz or .h5.")
    ] = None,
    rig: opt.RigFile = None,
    seconds: Annotated[float | None, option("--seconds S", "Length of the record in s.", "10")] = None,
    period: Annotated[
        float | None,
        option("--period S", "Period of the excitation in s.", "a quarter of the record, or the controller's table"),
    ] = None,
    band: Annotated[
        str | None, option("--band LO:HI", "Band of the excitation in Hz.", "one period to a fifth of the rate")
    ] = None,
    lines: Annotated[int, option("--lines N", "How many lines are excited, at most.", True, min=2)] = 100,
    criterion: Annotated[str, option("--criterion NAME", "all, worst, or the parameter that matters.", True)] = "all",
    target: Annotated[
        str, option("--target SD", "Relative standard deviation whose length of record is told.", True)
    ] = "1%",
    use: Annotated[
        float, option("--use SHARE", "Part of the way to the limits of position and current that may be used.", True)
    ] = 0.3,
    slew: Annotated[float | None, option("--slew V/S", "Largest rate of change of the voltage.", "any")] = None,
    spread: Annotated[
        float,
        option(
            "--spread SHARE", "Two relative standard deviations of a rig's free parameters, for the drawn plants.", True
        ),
    ] = 0.1,
    rate: Annotated[float | None, option("--rate HZ", "Sampling rate in Hz.", "the bench's")] = None,
    loop: Annotated[
        Literal["open", "closed"] | None,
        option("--loop", "With or without the controller.", "as the bench usually works"),
    ] = None,
    seed: opt.Seed = 0,
    json: opt.JsonFile = None,
    plot: opt.Plot = None,
    report: opt.Report = None,
    strict: opt.Strict = False,
    force: opt.Force = False,
) -> None:
    """Design the periodic excitation that shows the parameters best, within limits that it keeps by prediction.

    Amplitudes and phases are optimised together for the standard deviations that 'ambid identify' will report. The
    limits are those of the rig, for drawn plants and from rest too.
    """
    from ambid.job import design_experiment
    from ambid.job.experiment_design import one_period
    from ambid.physics.presets import preset_of
    from ambid.record import write_record

    known = None if source.lower().endswith(".json") else preset_of(source)
    of = None if known is not None else Path(source)
    with Outputs(of, rig, json=json, plot=plot, report=report) as outputs, progress("design") as show:
        outputs.claim(record, "out", (".csv", ".csv.gz", ".h5", ".hdf5"), force=force)
        found = design_experiment(
            known or str(source), rig, seconds=seconds, period=period, band=band_of(band), lines=lines,
            criterion=criterion, target=opt.share_of(target, "target"), use=use, slew=slew, spread=spread,
            rate_hz=rate, closed=None if loop is None else loop == "closed", seed=seed, tick=show,
        )  # fmt: skip
        outputs.give(found, show)
        if record is not None:
            outputs.stage(record, lambda path: write_record(one_period(found), path))
    outputs.show(found, strict=strict)


@group.command("controller", short_help="design the controller, and verify it on plants around the estimate")
def controller(
    estimate: Annotated[Path, argument("ESTIMATE", "What 'ambid identify --json' wrote.")],
    rig: opt.RigFile = None,
    out: Annotated[Path | None, option("--out -o RIG", "Write the rig with the new [loop].")] = None,
    method: Annotated[
        str, option("--method NAME", "pid: the present structure, tuned; lqg or hinf: a state-space law.", True)
    ] = "pid",
    goal: Annotated[
        list[str] | None,
        option("--goal FIGURE", "To be small: peak, compliance, noise or settling; repeatable.", "peak and compliance"),
    ] = None,
    limit: Annotated[
        list[str] | None,
        option("--limit FIGURE=X", "Largest value, such as peak=9.5dB; repeatable.", "what the present loop has"),
    ] = None,
    spread: Annotated[
        list[str] | None,
        option(
            "--spread SOURCE=X", "How far plants are drawn, such as delay=0.3; repeatable.", "see the documentation"
        ),
    ] = None,
    form: Annotated[
        str, option("--form NAME", "Gains of a rotor's PID: axes (one set), bearings, or tilt (and parallel).", True)
    ] = "axes",
    filters: Annotated[int, option("--filters N", "Filters around a rotor's lowest bending modes.", True, min=0)] = 0,
    speeds: Annotated[
        str | None, option("--speeds LO:HI", "Of a rotor in rpm.", "from rest to the speed of rig or estimate")
    ] = None,
    schedule: Annotated[
        int, option("--schedule N", "Laws over a rotor's speeds, of which the nearest orders; lqg, hinf.", True, min=1)
    ] = 1,
    plants: Annotated[int, option("--plants N", "Plants that the design is tuned over.", True, min=1)] = 60,
    judges: Annotated[int, option("--judges N", "Plants that judge the design.", True, min=1)] = 200,
    seed: Annotated[int, option("--seed N", "Seed of the plants.", True, min=0)] = 0,
    json: opt.JsonFile = None,
    plot: opt.Plot = None,
    report: opt.Report = None,
    export: Annotated[
        Path | None,
        option("--export FILE", "Write the law for other programs: .mat, .py (python-control) or .c (C source)."),
    ] = None,
    strict: opt.Strict = False,
    force: Annotated[bool, switch("--force", "Overwrite an existing rig file.")] = False,
) -> None:
    """Design the controller of an identified bearing, and verify it on plants around the estimate.

    Goals are minimised on the worst of many plants; every other figure must not become worse than it is with the rig's
    [loop], unless a --limit says otherwise.
    """
    from ambid.control.design import GOALS
    from ambid.job import design_controller
    from ambid.job.files import LAW_ENDINGS

    with Outputs(estimate, rig, json=json, plot=plot, report=report) as outputs, progress("design") as show:
        outputs.claim(out, "out", force=force)
        outputs.claim(export, "export", LAW_ENDINGS)
        found = design_controller(
            estimate, rig, method=method, goals=tuple(goal) if goal else GOALS, limits=_figures(limit or ()),
            spread=_sources(spread or ()), form=form, filters=filters,
            speeds_rpm=None if speeds is None else _pair(speeds), schedule=schedule, plants=plants, judges=judges,
            seed=seed, tick=show,
        )  # fmt: skip
        outputs.give(found, show)
        if out is not None:
            from ambid.rig import rig_text

            outputs.stage_text(out, rig_text(found.new_rig, out.parent))
        if export is not None:
            outputs.stage(export, found.export)
    outputs.show(found, strict=strict)


def _pair(text: str) -> tuple[float, float]:
    """Read ``--speeds``."""
    low, _, high = text.partition(":")
    try:
        return float(low), float(high)
    except ValueError:
        raise AmbidError(f"--speeds is {text!r}; give two speeds in rpm with a colon between, such as 0:6000") from None


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
