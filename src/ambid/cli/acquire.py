"""``ambid acquire``: a record from a controller, real, emulated or simulated."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ambid.cli.device_options import BandHz, BenchName, Pace, Port, RigOfDevice, Seed, course_mode, opened
from ambid.cli.interrupts import Stop, signals
from ambid.cli.options import FAILED_CHECK, band_of, json_path
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter
from ambid.cli.watch import watching
from ambid.errors import AmbidError

if TYPE_CHECKING:
    from ambid.acquire.device import Device, Mode, Program
    from ambid.acquire.session import Course, RunReport
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
    track: Annotated[
        str | None,
        typer.Option(
            "--track",
            metavar="ESTIMATE.json|auto",
            help="Follow the parameters meanwhile, from this estimate, or from one of the first seconds.",
            show_default=False,
        ),
    ] = None,
    json: Annotated[
        str | None,
        typer.Option(
            "--json",
            metavar="FILE",
            help="With --track: the track as lines of JSON; - for standard output.",
            show_default=False,
        ),
    ] = None,
    quiet: Annotated[bool, typer.Option("--no-live", "--quiet", help="No live view of the track.")] = False,
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
    _check_track(track, json)
    start = None if track in (None, "auto") else Path(str(track))
    wanted_band = band_of(band)
    with Outputs(rig, start) as outputs:
        outputs.claim(record, "-o", _ENDINGS)
        outputs.claim(json_path(json), "--json")
    known = load_rig(rig)
    chosen = course_mode(known, mode, excitation)
    wish = _Wish(
        port=port, rig=known, record=record, mode=chosen, seconds=seconds, name=excitation, amplitude=amplitude,
        settle_s=(1.0 if chosen == "levitate" else 0.0) if settle is None else settle, band=wanted_band, seed=seed,
        force=force,
    )  # fmt: skip
    stop, follow = Stop(), track is not None
    with watching() as watch, signals(stop.take), opened(port, known, bench=bench, pace=pace, seed=seed) as device:
        course = _course(wish, device, stop, watch)
        if follow:
            done, ending = _followed(wish, device, course, start, json, live=not quiet)
        else:
            done, ending = _record(wish, device, course, stop, watch), None
    if done.recorded is None and done.run.fault is None and stop.number is None:
        raise AmbidError(f"{port}: no sample came. Look at cable and supply")
    if done.recorded is not None and json != "-":
        from ambid.report.acquire_text import acquired_text

        typer.echo(acquired_text(done, record, paint=painter()))
    if ending is not None:
        ending()
    _finish(done, wish, stop, strict=strict)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Wish:
    """What the user asks for, checked."""

    port: str
    rig: Rig
    record: Path
    mode: Mode
    seconds: float
    settle_s: float
    name: str | None
    amplitude: float | None
    band: tuple[float, float] | None
    seed: int
    force: bool


def _check(seconds: float, amplitude: float | None, settle: float | None) -> None:
    for option, x, zero in (
        ("--seconds", seconds, False),
        ("--amplitude", amplitude, False),
        ("--settle", settle, True),
    ):
        if x is not None and not (math.isfinite(x) and (x > 0 or (zero and x == 0))):
            raise AmbidError(f"{option} is {x:g}; it must be a {'number, 0 or more' if zero else 'positive number'}."
                             " Correct it")  # fmt: skip


def _check_track(track: str | None, json: str | None) -> None:
    if json is not None and track is None:
        raise AmbidError("--json writes a track, and none is wanted. Give --track too, or leave it out")


def _course(wish: _Wish, device: Device, stop: Stop, watch: Watch) -> Course:
    """Say what the device is to do; find the amplitude of its excitation where none is given."""
    from ambid.acquire.session import Course

    return Course(
        mode=wish.mode, seconds=wish.seconds, settle_s=wish.settle_s, program=_wave(wish, device, stop, watch)
    )


def _wave(wish: _Wish, device: Device, stop: Stop, watch: Watch) -> Program | None:
    if wish.name is None:
        for option, x in (("--amplitude", wish.amplitude), ("--band", wish.band)):
            if x is not None:
                raise AmbidError(f"{option} is of an excitation, and none is named. Give --excitation, or leave it out")
        return None
    if wish.mode == "sample":
        raise AmbidError("--mode sample has its output off: nothing can be excited. Leave --excitation out, or drive")
    from ambid.acquire.program import program
    from ambid.job.amplitude import Trial, fitting_amplitude

    rate_hz, amplitude = device.info.rate_hz, wish.amplitude
    if amplitude is None:
        watch.show("amplitude", 0.0, "trials, small first")
        trial = Trial(
            name=wish.name, band=wish.band, mode=wish.mode, settle_s=wish.settle_s, seconds=_TRIAL_S, seed=wish.seed
        )
        amplitude = fitting_amplitude(device, wish.rig, trial, stopped=stop.wished)
    return program(
        wish.name, amplitude_v=amplitude, band=wish.band, rate_hz=rate_hz, seconds=wish.seconds, seed=wish.seed
    )


def _record(wish: _Wish, device: Device, course: Course, stop: Stop, watch: Watch) -> Acquired:
    from ambid.job.acquire import acquire
    from ambid.report.acquire_text import progress_line

    def show(now: Progress) -> None:
        watch.show("record", now.samples / max(now.wanted, 1), progress_line(now))

    return acquire(device, wish.rig, wish.record, course, force=wish.force, on_progress=show, stopped=stop.wished)


def _followed(
    wish: _Wish, device: Device, course: Course, start: Path | None, json: str | None, *, live: bool
) -> tuple[Acquired, Callable[[], None]]:
    """Record, and track what is recorded; the second value prints the track and ends with its exit code."""
    from ambid.cli.live import Follower
    from ambid.cli.track import finish
    from ambid.job.acquire import recording
    from ambid.job.track_live import track_live
    from ambid.track.lines_json import TrackWriter

    path = json_path(json)
    writer = TrackWriter(path) if path else TrackWriter(sys.stdout) if json == "-" else None
    shown = live and sys.stderr.isatty() and not (json == "-" and sys.stdout.isatty())
    follower = Follower(writer, keep=False, live=shown, real_time=device.info.kind == "serial")
    runs: list[RunReport] = []
    with recording(device, wish.rig, wish.record, course, force=wish.force) as tap:
        summary = follower.run(
            lambda: track_live(
                device, wish.rig, course, start=start, taps=[tap], on_event=tap.tell, on_run=runs.append,
                on_header=follower.on_header, on_line=follower.on_line, keep=False,
            ).track
        )  # fmt: skip
    if not runs:
        raise AmbidError(f"{wish.port}: the run ended before it began; {wish.record} may hold what came. Start again")
    written = [str(p) for p in (path,) if p]

    def ending() -> None:
        finish(follower, summary, written, table=json != "-", strict=False, flags=())

    return tap.acquired(runs[0]), ending


def _finish(done: Acquired, wish: _Wish, stop: Stop, *, strict: bool) -> None:
    """Tell what ended the run early, and end with the exit code."""
    kept = f"{wish.record} holds the {done.run.samples} samples before it" if done.recorded else "nothing was recorded"
    if done.run.fault is not None:
        raise AmbidError(
            f"{wish.port}: the controller went to its safe state: {done.run.fault.what}; {kept}. See to the cause"
        )
    if done.troubles:
        raise AmbidError(str(done.troubles[0]))
    if stop.number is not None:
        typer.echo(f"ambid: interrupted; {kept}", err=True)
        raise typer.Exit(stop.code)
    if strict and (done.run.lost or done.quality.verdict):
        raise typer.Exit(FAILED_CHECK)
