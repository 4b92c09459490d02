"""``ambid simulate --scenario``: a record in which something changes, and the truth of it beside it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from ambid.cli.output import Outputs
from ambid.cli.terminal import progress

if TYPE_CHECKING:
    from ambid.physics.presets import Preset
    from ambid.simulate import Simulation


@dataclass(frozen=True, slots=True)
class Course:
    """What the user says of a scenario; None for what the scenario or the bench says."""

    name: str  # of the scenario
    duration_s: float | None  # as `ambid.simulate.simulate_scenario`
    rate_hz: float | None
    amplitude: float | None
    at_s: float | None
    size: float | None
    seed: int  # of excitation, noise and losses
    closed: bool | None  # closed or open loop
    log_excitation: bool  # a column ``excitation`` too


def simulate_course(course: Course, preset: Preset | None, rig: str, record: Path) -> None:
    """Simulate, write the record and say what is in it.

    `course`: the scenario; `preset`: the bench; None: the rig file; `rig`: the bench in the user's words; `record`:
    file to write; a scenario that loses samples is written as CSV.
    """
    from ambid.record import write_record
    from ambid.rig import load_rig
    from ambid.simulate import damage, scenario, simulate_scenario

    what = scenario(course.name)
    with Outputs(None if preset else Path(rig)) as outputs, progress("simulate"):
        outputs.claim(record, "-o", (".csv", ".csv.gz") if what.dropped else (".csv", ".csv.gz", ".h5", ".hdf5"))
        done = simulate_scenario(
            what, preset or load_rig(Path(rig)), duration_s=course.duration_s, rate_hz=course.rate_hz, seed=course.seed,
            amplitude=course.amplitude, at_s=course.at_s, size=course.size, closed=course.closed,
            log_excitation=course.log_excitation,
        )  # fmt: skip
        told: Mapping[str, Any] = next(step.settings for step in done.record.history if step.name == "scenario")
        lines = (f"truth: {truth_words(done)}", f"scenario {what.name}: {_words(done, told)}")
        comments = () if record.suffix in (".h5", ".hdf5") else (_made(rig, told), *lines)
        lost = 0

        def write(path: Path) -> None:
            nonlocal lost
            if not what.dropped:
                write_record(done.record, path, comments=comments)
                return
            first = round(told["from_s"] * done.record.rate_hz)
            share = told["size"]
            found = damage(done.record, path, share=share, seed=course.seed, first=first, comments=comments)
            lost = sum(x.stop - x.first for x in found)

        outputs.stage(record, write)
    warn(done)
    n, rate = done.record.n_samples, done.record.rate_hz
    short = f", {lost} of them lost or without a value" if lost else ""
    typer.echo(
        f"{record}: {n} samples at {rate:g} Hz{short}, excitation of {told['amplitude']:.4g} V, seed {course.seed}"
    )
    for line in lines:
        typer.echo(line)


def warn(done: Simulation) -> None:
    """Say on standard error what went wrong in a simulation.

    `done`: with its warnings.
    """
    for warning in done.warnings:
        typer.echo(f"ambid: warning: {warning}", err=True)


def truth_words(done: Simulation) -> str:
    """Return the parameters of a simulation in words.

    `done`: with its truth. Returns names and values on one line.
    """
    return ", ".join(f"{name} {value:.6g}" for name, value in done.truth.items()) + " (SI; delay in samples)"


def _words(done: Simulation, told: Mapping[str, Any]) -> str:
    """Say what varies, from where to where, and from when."""
    from ambid.simulate import truth_columns

    moved = []
    for name, c in truth_columns(done.record).items():
        first, last, unit = float(c.values[0]), float(c.values[-1]), "" if c.unit == "1" else f" {c.unit}"
        moved.append(f"{name} {first:.6g}{unit}" if first == last else f"{name} {first:.6g} to {last:.6g}{unit}")
    begins = f", from {told['from_s']:g} s" if "from_s" in told else ""
    return (", ".join(moved) or "no parameter changes") + begins


def _made(rig: str, told: Mapping[str, Any]) -> str:
    from importlib.metadata import version

    size = f" of {told['size']:.6g} ({told['size_is']})" if "size" in told else ""
    return (
        f"simulated by ambid {version('ambid')}: {Path(rig).name}, scenario {told['name']}{size}, excitation of"
        f" {told['amplitude']:.6g} V, seed {told['seed']}"
    )
