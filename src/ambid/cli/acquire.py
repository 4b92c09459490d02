"""``ambid acquire``: a record from a controller, real, emulated or simulated."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ambid.cli.device_options import BandHz, BenchName, Pace, Port, RigOfDevice, Seed, course_mode, opened
from ambid.cli.interrupts import Stop, signals
from ambid.cli.options import FAILED_CHECK, band_of
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter
from ambid.cli.watch import watching
from ambid.errors import AmbidError

if TYPE_CHECKING:
    from ambid.acquire.device import Device, Program
    from ambid.cli.watch import Watch
    from ambid.job.acquire import Acquired, Progress
    from ambid.rig import Rig

_ENDINGS = (".h5", ".hdf5", ".csv", ".csv.gz")
_TRIAL_S = 2.0  # of each trial of an amplitude


def command(
    port: Port,
    rig: RigOfDevice,
    record: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="FILE", help="Record to write: .h5, .csv or .csv.gz.", show_default=False
        ),
    ],
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", help="Length of the record in s.")] = 10.0,
    excitation: Annotated[
        str | None,
        typer.Option(
            "--excitation",
            metavar="NAME",
            help="What the controller adds to its output: multisine, schroeder, prbs or steps.",
            show_default="none",
        ),
    ] = None,
    amplitude: Annotated[
        float | None,
        typer.Option(
            "--amplitude", metavar="V", help="Peak of the excitation in V.", show_default="found by trials, small first"
        ),
    ] = None,
    band: BandHz = None,
    mode: Annotated[
        Literal["sample", "drive", "levitate"] | None,
        typer.Option(
            "--mode",
            help="Output off; excitation without feedback; position loop on the controller.",
            show_default="levitate where the rig has a loop",
        ),
    ] = None,
    settle: Annotated[
        float | None,
        typer.Option(
            "--settle",
            metavar="S",
            help="Time after the start that is not recorded, in s.",
            show_default="1 to levitate",
        ),
    ] = None,
    bench: BenchName = None,
    pace: Pace = "fastest",
    seed: Seed = 0,
    force: Annotated[bool, typer.Option("--force", help="Write over a record that exists.")] = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="End with exit code 3 if samples were lost or the quality is poor.")
    ] = False,
) -> None:
    """Record what a controller samples: it keeps the rotor levitated, plays the excitation and protects the bench.

    PORT is a serial port, 'emulated' (the firmware on an emulated controller before a simulated bench), 'simulated'
    (a simulated bench alone), or 'replay:FILE'. What is recorded is in a journal at once: see 'ambid recover'.
    """
    from ambid.rig import load_rig

    _check(seconds, amplitude, settle)
    wanted_band = band_of(band)
    with Outputs(rig) as outputs:
        outputs.claim(record, "-o", _ENDINGS)
    known = load_rig(rig)
    chosen = course_mode(known, mode, excitation)
    rest_s = (1.0 if chosen == "levitate" else 0.0) if settle is None else settle
    stop = Stop()
    with watching() as watch, signals(stop.take), opened(port, known, bench=bench, pace=pace, seed=seed) as device:
        wave = _wave(device, known, excitation, amplitude, wanted_band, seconds, seed, chosen, rest_s, stop, watch)
        done = _record(device, known, record, chosen, seconds, rest_s, wave, force, stop, watch)
    from ambid.report.acquire_text import acquired_text

    if done.recorded is None and done.run.fault is None and stop.number is None:
        raise AmbidError(f"{port}: no sample came. Look at cable and supply")
    if done.recorded is not None:
        typer.echo(acquired_text(done, record, paint=painter()))
    _finish(done, port, record, stop, strict=strict)


def _check(seconds: float, amplitude: float | None, settle: float | None) -> None:
    for option, x, zero in (
        ("--seconds", seconds, False),
        ("--amplitude", amplitude, False),
        ("--settle", settle, True),
    ):
        if x is not None and not (math.isfinite(x) and (x > 0 or (zero and x == 0))):
            raise AmbidError(f"{option} is {x:g}; it must be a {'number, 0 or more' if zero else 'positive number'}."
                             " Correct it")  # fmt: skip


def _wave(
    device: Device,
    rig: Rig,
    name: str | None,
    amplitude: float | None,
    band: tuple[float, float] | None,
    seconds: float,
    seed: int,
    mode: Literal["sample", "drive", "levitate"],
    settle_s: float,
    stop: Stop,
    watch: Watch,
) -> Program | None:
    """Make the excitation; find its amplitude where none is given."""
    if name is None:
        for option, x in (("--amplitude", amplitude), ("--band", band)):
            if x is not None:
                raise AmbidError(f"{option} is of an excitation, and none is named. Give --excitation, or leave it out")
        return None
    if mode == "sample":
        raise AmbidError("--mode sample has its output off: nothing can be excited. Leave --excitation out, or drive")
    from ambid.acquire.program import program
    from ambid.job.amplitude import Trial, fitting_amplitude

    rate_hz = device.info.rate_hz
    if amplitude is None:
        watch.show("amplitude", 0.0, "trials, small first")
        trial = Trial(name=name, band=band, mode=mode, settle_s=settle_s, seconds=_TRIAL_S, seed=seed)
        amplitude = fitting_amplitude(device, rig, trial, stopped=stop.wished)
    return program(name, amplitude_v=amplitude, band=band, rate_hz=rate_hz, seconds=seconds, seed=seed)


def _record(
    device: Device,
    rig: Rig,
    record: Path,
    mode: Literal["sample", "drive", "levitate"],
    seconds: float,
    settle_s: float,
    wave: Program | None,
    force: bool,
    stop: Stop,
    watch: Watch,
) -> Acquired:
    from ambid.acquire.session import Course
    from ambid.job.acquire import acquire
    from ambid.report.acquire_text import progress_line

    def show(now: Progress) -> None:
        watch.show("record", now.samples / max(now.wanted, 1), progress_line(now))

    course = Course(mode=mode, seconds=seconds, settle_s=settle_s, program=wave)
    return acquire(device, rig, record, course, force=force, on_progress=show, stopped=stop.wished)


def _finish(done: Acquired, port: str, record: Path, stop: Stop, *, strict: bool) -> None:
    """Tell what ended the run early, and end with the exit code."""
    kept = f"{record} holds the {done.run.samples} samples before it" if done.recorded else "nothing was recorded"
    if done.run.fault is not None:
        raise AmbidError(
            f"{port}: the controller went to its safe state: {done.run.fault.what}; {kept}. See to the cause"
        )
    if done.troubles:
        raise AmbidError(str(done.troubles[0]))
    if stop.number is not None:
        typer.echo(f"ambid: interrupted; {kept}", err=True)
        raise typer.Exit(stop.code)
    if strict and (done.run.lost or done.quality.verdict):
        raise typer.Exit(FAILED_CHECK)
