"""``ambid simulate``: a record from the physics."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ambid.cli.options import band_of, preset_of
from ambid.cli.output import Outputs
from ambid.cli.scenario import Course, simulate_course, truth_words, warn
from ambid.cli.terminal import progress
from ambid.errors import AmbidError

if TYPE_CHECKING:
    from ambid.arrays import Array
    from ambid.physics.loop import Limits
    from ambid.physics.nonlinear import OperatingPoint
    from ambid.physics.presets import Preset
    from ambid.simulate import Simulation

    Respond = Callable[[Array], Simulation]

_FRACTION = 0.5  # of the limits that an amplitude chosen by the program uses


def command(
    rig: Annotated[
        str,
        typer.Argument(
            metavar="RIG|PRESET", help="Rig file, or a bench that 'ambid models' lists.", show_default=False
        ),
    ],
    record: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="FILE", help="Record to write: .csv, .csv.gz or .h5.", show_default=False
        ),
    ],
    duration: Annotated[
        float | None,
        typer.Option("--duration", metavar="S", help="Length in s.", show_default="1, or the scenario's"),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option("--rate", metavar="HZ", help="Sampling rate in Hz.", show_default="the preset's, or the rig's"),
    ] = None,
    scenario: Annotated[
        str | None,
        typer.Option(
            "--scenario",
            metavar="NAME",
            help="A course of known truth, as 'ambid models' lists them: the record has columns true_... beside it.",
            show_default="nothing changes",
        ),
    ] = None,
    at: Annotated[
        float | None,
        typer.Option("--at", metavar="S", help="When the scenario begins, in s.", show_default="the scenario's"),
    ] = None,
    size: Annotated[
        float | None,
        typer.Option(
            "--size", metavar="X", help="How much the scenario changes, e.g. -0.15.", show_default="the scenario's"
        ),
    ] = None,
    excitation: Annotated[
        str | None,
        typer.Option(
            "--excitation", metavar="NAME", help="Excitation, as 'ambid models' lists them.", show_default="multisine"
        ),
    ] = None,
    amplitude: Annotated[
        float | None,
        typer.Option(
            "--amplitude",
            metavar="A",
            help="Peak in V (rms for gaussian).",
            show_default="what half of the limits allows",
        ),
    ] = None,
    band: Annotated[
        str | None,
        typer.Option(
            "--band",
            metavar="LO:HI",
            help="Band of the excitation in Hz.",
            show_default="one period to a fifth of the rate",
        ),
    ] = None,
    periods: Annotated[
        int, typer.Option("--periods", metavar="N", help="How often the excitation repeats, for 'ambid frf'.", min=1)
    ] = 1,
    log_excitation: Annotated[
        bool,
        typer.Option("--log-excitation", help="A column 'excitation' too: the reference that 'ambid frf' wants."),
    ] = False,
    seed: Annotated[int, typer.Option("--seed", metavar="N", help="Seed of excitation and noise.", min=0)] = 0,
    loop: Annotated[
        Literal["open", "closed"] | None,
        typer.Option("--loop", help="With or without the controller.", show_default="as the bench usually works"),
    ] = None,
    nonlinear: Annotated[
        bool,
        typer.Option("--nonlinear", help="The nonlinear magnet, of a rig its [magnet], instead of its linearisation."),
    ] = False,
    position: Annotated[
        float | None,
        typer.Option(
            "--position",
            metavar="M",
            help="With --nonlinear: where the loop holds the rotor, in m.",
            show_default="the operating point's",
        ),
    ] = None,
) -> None:
    """Simulate a bench and write the record that it would log; equal seeds give equal records.

    With --scenario something changes on the way, and the record holds the truth of it in columns true_...
    """
    from ambid.record import Channel, write_record
    from ambid.signals import excitation as make_excitation

    preset, closed = preset_of(rig), None if loop is None else loop == "closed"
    if scenario is not None:
        _refuse("--scenario", {"--excitation": excitation, "--band": band, "--nonlinear": nonlinear or None,
                               "--position": position, "--periods": None if periods == 1 else periods})  # fmt: skip
        course = Course(scenario, duration, rate, amplitude, at, size, seed, closed, log_excitation)
        simulate_course(course, preset, rig, record)
        return
    _refuse("a simulation without --scenario", {"--at": at, "--size": size})
    if not nonlinear:
        _refuse("a simulation without --nonlinear", {"--position": position})
    kind, duration = excitation or "multisine", 1.0 if duration is None else duration
    with Outputs(None if preset else Path(rig)) as outputs, progress("simulate"):
        outputs.claim(record, "-o", (".csv", ".csv.gz", ".h5", ".hdf5"))
        respond, by_role, rate_hz, limits, point = (
            _of_preset(preset, rate, seed, closed, nonlinear, position)
            if preset
            else _of_rig(Path(rig), rate, seed, closed, nonlinear, position)
        )
        n = _samples(duration, rate_hz)
        shape = _repeated(
            lambda part: make_excitation(kind, part, rate_hz, amplitude=1.0, band=band_of(band), seed=seed), n, periods
        )
        peak = _largest(by_role, shape, limits, point) if amplitude is None else amplitude
        done = respond(peak * shape)
        if log_excitation:
            logged = Channel(name="excitation", unit="V", values=peak * shape)
            done = replace(done, record=replace(done.record, channels=(*done.record.channels, logged)))
        comments = () if record.suffix in (".h5", ".hdf5") else _comments(rig, kind, peak, band, seed, done)
        outputs.stage(record, lambda path: write_record(done.record, path, comments=comments))
    warn(done)
    typer.echo(f"{record}: {n} samples at {rate_hz:g} Hz, {kind} of {peak:.4g} V, seed {seed}")
    typer.echo("truth: " + truth_words(done))


def _refuse(of: str, given: Mapping[str, object]) -> None:
    for option, value in given.items():
        if value is not None:
            raise AmbidError(f"{of} has no {option}. Leave {option} out")


def _of_preset(
    preset: Preset, rate: float | None, seed: int, closed: bool | None, nonlinear: bool, position: float | None
) -> tuple[Any, ...]:
    from ambid.simulate import simulate_preset

    rate_hz = preset.rate_hz if rate is None else rate
    if position is not None and preset.plant is not None:
        preset = replace(preset, operating_point=preset.plant.equilibrium(position))

    def respond(u: Array) -> Simulation:
        return simulate_preset(preset, u, seed=seed, rate_hz=rate_hz, closed=closed, nonlinear=nonlinear)

    return respond, respond, rate_hz, preset.limits, preset.operating_point


def _of_rig(
    path: Path, rate: float | None, seed: int, closed: bool | None, nonlinear: bool, position: float | None
) -> tuple[Any, ...]:
    from ambid.rig import load_rig
    from ambid.simulate import simulate_rig
    from ambid.simulate.rig_bench import parts_of_rig

    rig = load_rig(path)
    if position is not None:
        rig = replace(rig, operating_point={**rig.operating_point, "position": position})
    rate_hz = rig.record.rate_hz if rate is None else rate
    if rate_hz is None:
        raise AmbidError(f"rig {path} names no rate; a simulation needs one. Give --rate HZ, or record.rate_hz")

    def respond(u: Array, columns: bool = True) -> Simulation:
        return simulate_rig(rig, u, rate_hz=rate_hz, seed=seed, closed=closed, nonlinear=nonlinear, columns=columns)

    return (
        respond,
        partial(respond, columns=False),
        rate_hz,
        rig.limits,
        parts_of_rig(rig, closed, nonlinear=nonlinear)[2],
    )


def _largest(respond: Respond, shape: Array, limits: Limits | None, point: OperatingPoint | None) -> float:
    from ambid.simulate import largest_amplitude

    if limits is None:
        raise AmbidError("no amplitude is given, and the rig has no limits to find one from. Give --amplitude A in V")
    return float(f"{largest_amplitude(respond, shape, limits=limits, operating_point=point, fraction=_FRACTION):.3g}")


def _samples(duration: float, rate_hz: float) -> int:
    count = duration * rate_hz
    if not 1 <= count <= 1e8:
        raise AmbidError(
            f"--duration {duration:g} s at {rate_hz:g} Hz is {count:g} samples; it must be 1 to 1e8. Correct one"
        )
    return round(count)


def _repeated(make: Callable[[int], Array], n: int, periods: int) -> Array:
    """Lay equal periods one behind the other."""
    import numpy as np

    if n % periods:
        raise AmbidError(f"--periods {periods}: {n} samples are no whole number each. Change --duration or --periods")
    return np.tile(make(n // periods), periods)


def _comments(rig: str, excitation: str, size: float, band: str | None, seed: int, done: Simulation) -> tuple[str, ...]:
    from importlib.metadata import version

    between = "" if band is None else f" in {band} Hz"
    made = (
        f"simulated by ambid {version('ambid')}: {Path(rig).name}, {excitation} of {size:.6g} V{between}, seed {seed}"
    )
    return made, f"truth: {truth_words(done)}"
