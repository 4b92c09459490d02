"""``ambid simulate``: a record from the physics."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from ambid.cli.options import Values, verb
from ambid.cli.output import Outputs
from ambid.cli.terminal import progress
from ambid.errors import AmbidError, counted
from ambid.settings.caller import refuse_given

if TYPE_CHECKING:
    from ambid.physics.presets import Preset
    from ambid.simulation import Simulation

_ENDINGS = (".csv", ".csv.gz", ".h5", ".hdf5")


@verb("simulate")
def command(v: Values) -> None:
    """Simulate a bench and write the record that it would log; equal seeds give equal records.

    With --scenario something changes on the way, and the record holds the truth of it in columns true_...
    """
    from ambid.job.simulation import only_references, simulate_used
    from ambid.physics.presets import preset_of
    from ambid.record import write_record

    preset = preset_of(v.rig)
    if v.scenario is not None:
        of_excitation = v.only("run_up excitation band nonlinear position periods axes settle excitation_only")
        refuse_given(of_excitation, "--scenario takes no {}. Omit {}")
        _run_scenario(v, preset)
        return
    if v.run_up is not None:
        refuse_given(v.only("excitation_only"), "--run-up takes no {}. Omit {}")
    if not v.nonlinear:
        refuse_given(v.only("position"), "{} is for --nonlinear. Omit {}")
    with Outputs(None if preset else Path(v.rig)) as outputs, progress("simulate"):
        outputs.claim(v.out, "out", _ENDINGS, force=v.force)
        how = v.only("duration rate_hz run_up excitation amplitude band periods seed settle closed nonlinear")
        how |= v.only("position log_excitation force") | {"axes": None if v.axes is None else v.axes.split(",")}
        done, told = simulate_used(preset or Path(v.rig), **how)
        made = only_references(done.record) if v.excitation_only else done.record
        comments: tuple[str, ...] = ()
        if v.out.suffix not in (".h5", ".hdf5"):
            between = "" if v.band is None else f" in {v.band[0]:g}:{v.band[1]:g} Hz"
            comments = (_recipe(v.rig, f"{told.words(6)}{between}", v.seed), f"truth: {truth_words(done)}")
        outputs.stage(v.out, lambda path: write_record(made, path))
        outputs.stage_notes(v.out, comments)
    warn(done)
    n, rate_hz = done.record.n_samples, done.record.rate_hz
    typer.echo(f"{v.out}: {counted(n, 'sample')} at {rate_hz:g} Hz, {told.words()}, seed {v.seed}")
    typer.echo("truth: " + truth_words(done))


def _recipe(rig: str, what: str, seed: int) -> str:
    from importlib.metadata import version

    return f"simulated by ambid {version('ambid')}: {Path(rig).name}, {what}, seed {seed}"


def _run_scenario(v: Values, preset: Preset | None) -> None:
    """Simulate a scenario, write the record and say what is in it."""
    from ambid.record import write_record
    from ambid.rig import load_rig
    from ambid.rig.draft import as_logged
    from ambid.simulation import simulate_scenario

    name, size_asked, at_s = _named(v.scenario)
    how = v.only("rate_hz amplitude closed log_excitation force")
    how |= {"duration_s": v.duration, "at_s": at_s, "size": size_asked}
    with Outputs(None if preset else Path(v.rig)) as outputs, progress("simulate"):
        outputs.claim(v.out, "out", _ENDINGS, force=v.force)
        done = simulate_scenario(name, as_logged(preset) if preset else load_rig(Path(v.rig)), seed=v.seed, **how)
        told: Mapping[str, Any] = next(step.settings for step in done.record.history if step.name == "scenario")
        lines = (f"truth: {truth_words(done)}", f"scenario {name}: {_words(done, told)}")
        size = f" of {told['size']:.6g} ({told['size_is']})" if "size" in told else ""
        made = _recipe(v.rig, f"scenario {told['name']}{size}, excitation of {told['amplitude']:.6g} V", v.seed)
        comments = () if v.out.suffix in (".h5", ".hdf5") else (made, *lines)
        outputs.stage(v.out, lambda path: write_record(done.record, path))
        outputs.stage_notes(v.out, comments)
    warn(done)
    n, rate = done.record.n_samples, done.record.rate_hz
    what_moves = f"excitation of {told['amplitude']:.4g} V, seed {v.seed}"
    typer.echo(f"{v.out}: {counted(n, 'sample')} at {rate:g} Hz, {what_moves}")
    for line in lines:
        typer.echo(line)


def _named(text: str) -> tuple[str, float | None, float | None]:
    """Read ``--scenario``: a name, a size after a colon, a start in s after an at sign."""
    before, at, start = text.partition("@")
    name, colon, size = before.partition(":")
    try:
        return name, float(size) if colon else None, float(start) if at else None
    except ValueError:
        raise AmbidError(
            f"--scenario is {text!r}; it must be NAME[:SIZE][@SECONDS], such as change:-0.15@2. Correct it"
        ) from None


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
