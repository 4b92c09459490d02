"""``ambid simulate``: a record from the physics."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ambid.cli.options import ForceLoop, argument, band_of, option, switch
from ambid.cli.output import Outputs
from ambid.cli.terminal import progress
from ambid.errors import counted
from ambid.settings.caller import refuse_given

if TYPE_CHECKING:
    from ambid.physics.presets import Preset
    from ambid.simulation import Simulation

_ENDINGS = (".csv", ".csv.gz", ".h5", ".hdf5")


def command(
    rig: Annotated[str, argument("RIG|PRESET", "Rig file, or a bench that 'ambid models' lists.")],
    record: Annotated[Path, option("--out -o FILE", "Record to write: .csv, .csv.gz or .h5.")],
    duration: Annotated[
        float | None, option("--duration S", "Length in s.", "1, or the scenario's or experiment's")
    ] = None,
    rate: Annotated[float | None, option("--rate HZ", "Sampling rate in Hz.", "the preset's, or the rig's")] = None,
    scenario: Annotated[
        str | None,
        option(
            "--scenario NAME",
            "A change with known truth, as 'ambid models' lists them; the truth goes into columns true_....",
            "nothing changes",
        ),
    ] = None,
    at: Annotated[float | None, option("--at S", "Start of the scenario, in s.", "the scenario's")] = None,
    size: Annotated[float | None, option("--size X", "Size of the change, e.g. -0.15.", "the scenario's")] = None,
    excitation: Annotated[
        str | None,
        option(
            "--excitation NAME",
            "Excitation, as 'ambid models' lists them, or a file that 'ambid design experiment --json' wrote.",
            "multisine",
        ),
    ] = None,
    amplitude: Annotated[
        float | None, option("--amplitude A", "Peak in V (rms for gaussian).", "what half of the limits allows")
    ] = None,
    band: Annotated[
        str | None, option("--band LO:HI", "Band of the excitation in Hz.", "one period to a fifth of the rate")
    ] = None,
    periods: Annotated[
        int | None,
        option(
            "--periods N",
            "Number of repetitions of the excitation, for 'ambid frf'.",
            "1; of a rotor about one a second, at least 4",
            min=1,
        ),
    ] = None,
    axes: Annotated[
        str | None, option("--axes AX,...", "Axes of a rotor that are excited, with commas between.", "all")
    ] = None,
    settle: Annotated[
        int | None,
        option("--settle N", "Periods that a rotor runs before the record begins, in steady state.", "1", min=0),
    ] = None,
    excitation_only: Annotated[
        bool,
        switch("--excitation-only", "Write only what is to be added to the controllers' outputs of a rotor."),
    ] = False,
    log_excitation: Annotated[
        bool, switch("--log-excitation", "Add a column 'excitation': the reference for 'ambid frf'.")
    ] = False,
    seed: Annotated[int, option("--seed N", "Seed of excitation and noise.", True, min=0)] = 0,
    loop: Annotated[
        Literal["open", "closed"] | None,
        option("--loop", "With or without the controller.", "as the bench usually works"),
    ] = None,
    nonlinear: Annotated[
        bool, switch("--nonlinear", "Simulate the nonlinear magnet ([magnet] of a rig) instead of its linearisation.")
    ] = False,
    position: Annotated[
        float | None,
        option(
            "--position M",
            "With --nonlinear: position at which the loop holds the rotor, in m.",
            "the operating point's",
        ),
    ] = None,
    force: ForceLoop = False,
) -> None:
    """Simulate a bench and write the record that it would log; equal seeds give equal records.

    With --scenario something changes on the way, and the record holds the truth of it in columns true_...
    """
    from ambid.job.simulation import only_references, simulate_used
    from ambid.physics.presets import preset_of
    from ambid.record import write_record

    preset = preset_of(rig)
    closed, source = None if loop is None else loop == "closed", None if preset else Path(rig)
    if scenario is not None:
        of_excitation = {"excitation": excitation, "band": band, "nonlinear": nonlinear, "position": position,
                         "periods": periods, "axes": axes, "settle": settle,
                         "excitation_only": excitation_only}  # fmt: skip
        refuse_given(of_excitation, "--scenario takes no {}. Omit {}")
        words = {"duration_s": duration, "rate_hz": rate, "amplitude": amplitude, "at_s": at, "size": size,
                 "closed": closed, "log_excitation": log_excitation, "force": force}  # fmt: skip
        _run_scenario(scenario, preset, rig, record, seed, words, force=force)
        return
    refuse_given({"at": at, "size": size}, "{} is for --scenario. Omit {}")
    if not nonlinear:
        refuse_given({"position": position}, "{} is for --nonlinear. Omit {}")
    with Outputs(source) as outputs, progress("simulate"):
        outputs.claim(record, "out", _ENDINGS, force=force)
        done, told = simulate_used(
            preset or Path(rig), duration=duration, rate_hz=rate,
            excitation=excitation, amplitude=amplitude, band=band_of(band), periods=periods, seed=seed,
            axes=None if axes is None else axes.split(","), settle=settle, closed=closed, nonlinear=nonlinear,
            position=position, log_excitation=log_excitation, force=force,
        )  # fmt: skip
        made = only_references(done.record) if excitation_only else done.record
        comments: tuple[str, ...] = ()
        if record.suffix not in (".h5", ".hdf5"):
            between = "" if band is None else f" in {band} Hz"
            comments = (
                _recipe(rig, f"{told.kind} of {told.peak:.6g} {told.unit}{between}", seed),
                f"truth: {truth_words(done)}",
            )
        outputs.stage(record, lambda path: write_record(made, path, comments=comments))
    warn(done)
    n, rate_hz = done.record.n_samples, done.record.rate_hz
    typer.echo(
        f"{record}: {counted(n, 'sample')} at {rate_hz:g} Hz, {told.kind} of {told.peak:.4g} {told.unit}, seed {seed}"
    )
    typer.echo("truth: " + truth_words(done))


def _recipe(rig: str, what: str, seed: int) -> str:
    from importlib.metadata import version

    return f"simulated by ambid {version('ambid')}: {Path(rig).name}, {what}, seed {seed}"


def _run_scenario(
    name: str, preset: Preset | None, rig: str, record: Path, seed: int, words: Mapping[str, Any], *, force: bool
) -> None:
    """Simulate a scenario, write the record and say what is in it; `words` are those of `simulate_scenario`.

    A scenario that loses samples is written as CSV.
    """
    from ambid.record import write_record
    from ambid.rig import load_rig
    from ambid.simulation import simulate_scenario
    from ambid.simulation.scenarios import damage, scenario

    what = scenario(name)
    with Outputs(None if preset else Path(rig)) as outputs, progress("simulate"):
        outputs.claim(record, "out", _ENDINGS[:2] if what.dropped else _ENDINGS, force=force)
        done = simulate_scenario(what, preset or load_rig(Path(rig)), seed=seed, **words)
        told: Mapping[str, Any] = next(step.settings for step in done.record.history if step.name == "scenario")
        lines = (f"truth: {truth_words(done)}", f"scenario {what.name}: {_words(done, told)}")
        size = f" of {told['size']:.6g} ({told['size_is']})" if "size" in told else ""
        made = _recipe(rig, f"scenario {told['name']}{size}, excitation of {told['amplitude']:.6g} V", seed)
        comments = () if record.suffix in (".h5", ".hdf5") else (made, *lines)
        lost = 0

        def write(path: Path) -> None:
            nonlocal lost
            if not what.dropped:
                write_record(done.record, path, comments=comments)
                return
            first = round(told["from_s"] * done.record.rate_hz)
            share = told["size"]
            found = damage(done.record, path, share=share, seed=seed, first=first, comments=comments)
            lost = sum(x.stop - x.first for x in found)

        outputs.stage(record, write)
    warn(done)
    n, rate = done.record.n_samples, done.record.rate_hz
    short = f", {lost} of them lost or without a value" if lost else ""
    typer.echo(
        f"{record}: {counted(n, 'sample')} at {rate:g} Hz{short}, excitation of {told['amplitude']:.4g} V, seed {seed}"
    )
    for line in lines:
        typer.echo(line)


def warn(done: Simulation) -> None:
    """Say on standard error what went wrong in a simulation."""
    for warning in done.warnings:
        typer.echo(f"ambid: warning: {warning}", err=True)


def truth_words(done: Simulation) -> str:
    """Return the parameters of a simulation on one line."""
    return ", ".join(f"{name} {value:.6g}" for name, value in done.truth.items()) + " (SI; delay in samples)"


def _words(done: Simulation, told: Mapping[str, Any]) -> str:
    """Say what varies, from where to where, and from when."""
    from ambid.simulation import truth_columns

    moved = []
    for name, c in truth_columns(done.record).items():
        first, last, unit = float(c.values[0]), float(c.values[-1]), "" if c.unit == "1" else f" {c.unit}"
        moved.append(f"{name} {first:.6g}{unit}" if first == last else f"{name} {first:.6g} to {last:.6g}{unit}")
    begins = f", from {told['from_s']:g} s" if "from_s" in told else ""
    return (", ".join(moved) or "no parameter changes") + begins
