"""``ambid acquire``: a record from a controller, real, emulated or simulated."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ambid.cli import INTERRUPTED
from ambid.cli.acquire_end import finish, left, tell
from ambid.cli.acquire_wish import Wish, start_of_track, told
from ambid.cli.device_options import BandHz, BenchName, Pace, Port, RigOfDevice, Seed, course_mode, opened
from ambid.cli.interrupts import Stop, signals
from ambid.cli.options import band_of, json_path
from ambid.cli.output import Outputs
from ambid.cli.watch import watching
from ambid.errors import AmbidError

if TYPE_CHECKING:
    from ambid.acquire.device import Device, Program
    from ambid.acquire.session import Course
    from ambid.cli.watch import Watch
    from ambid.job.acquire import Acquired, Progress

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
            show_default="levitate where the rig has a loop; sample a replay",
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

    if json is not None and track is None:
        raise AmbidError("--json writes a track, and none is wanted. Give --track too, or leave it out")
    wanted_band = band_of(band)
    replayed = Path(port.removeprefix("replay:")) if port.startswith("replay:") else None
    with Outputs(rig, None if track in (None, "auto") else Path(str(track)), replayed) as outputs:
        outputs.claim(record, "-o", _ENDINGS)
        outputs.claim(json_path(json), "--json")
    known = load_rig(rig)
    chosen = course_mode(port, known, mode, excitation)
    wish = Wish(
        port=port, rig=known, record=record, mode=chosen, seconds=seconds, name=excitation, amplitude=amplitude,
        settle_s=(1.0 if chosen == "levitate" else 0.0) if settle is None else settle, band=wanted_band, seed=seed,
        force=force,
    )  # fmt: skip
    start, stop, before = start_of_track(track), Stop(), _changed(record)
    try:
        with watching() as watch, signals(stop.take), opened(port, known, bench=bench, pace=pace, seed=seed) as device:
            course = _course(wish, device, stop, watch)
            if track is None:
                done, track_end = _record(wish, device, course, stop, watch), None
            else:
                from ambid.cli.acquire_track import followed

                done, track_end = followed(wish, device, course, start, json, stop, live=not quiet)
    except KeyboardInterrupt:
        typer.echo(f"ambid: interrupted{left(record, _changed(record) != before)}", err=True)
        raise typer.Exit(stop.code or INTERRUPTED) from None
    tell(done, wish, stop, table=json != "-")
    if track_end is not None:
        track_end()
    finish(done, wish, stop, strict=strict)


def _course(wish: Wish, device: Device, stop: Stop, watch: Watch) -> Course:
    """Say what the device is to do; find the amplitude of its excitation where none is given."""
    from ambid.acquire.session import Course

    wish.check_length(device.info.rate_hz)
    return Course(
        mode=wish.mode, seconds=wish.seconds, settle_s=wish.settle_s, program=_wave(wish, device, stop, watch)
    )


def _wave(wish: Wish, device: Device, stop: Stop, watch: Watch) -> Program | None:
    if wish.name is None:
        return None
    if wish.amplitude is not None:
        return _played(wish, device, wish.amplitude, wish.seconds)
    _played(wish, device, 1.0, wish.seconds)  # so that what cannot be played is refused before anything moves
    return _played(wish, device, _found_amplitude(wish, device, stop, watch), wish.seconds)


def _played(wish: Wish, device: Device, amplitude_v: float, seconds: float) -> Program:
    from ambid.acquire.program import program

    return program(
        str(wish.name), amplitude_v=amplitude_v, band=_band(wish, device), rate_hz=device.info.rate_hz,
        seconds=seconds, seed=wish.seed,
    )  # fmt: skip


def _band(wish: Wish, device: Device) -> tuple[float, float] | None:
    """Return the band as wished; without one, a multisine that a levitated rotor follows."""
    from ambid.job.amplitude import moving_band

    if wish.band is not None or wish.mode != "levitate" or wish.name not in ("multisine", "schroeder"):
        return wish.band
    low, high = moving_band(device.info.rate_hz, wish.seconds)
    return (low, high) if 3.0 * low < high else None  # a short record has no room for slow lines


def _found_amplitude(wish: Wish, device: Device, stop: Stop, watch: Watch) -> float:
    """Try small excitations first, and say which one was taken."""
    from ambid.job.amplitude import Trial, fitting_amplitude

    watch.show("amplitude", 0.0, "trials, small first")
    trial = Trial(
        name=str(wish.name), band=_band(wish, device), mode=wish.mode, settle_s=wish.settle_s,
        seconds=_trial_s(wish, device), seed=wish.seed,
    )  # fmt: skip
    try:
        found = fitting_amplitude(device, wish.rig, trial, stopped=stop.wished)
    except AmbidError:
        if stop.wished():
            raise KeyboardInterrupt from None
        raise
    watch.clear()
    typer.echo(f"ambid: note: amplitude {found:.3g} V, found by trials", err=True)
    return found


def _trial_s(wish: Wish, device: Device) -> float:
    """Return the length of a trial, s: short, but an excitation of slow periods takes the whole record's."""
    try:
        _played(wish, device, 1.0, _TRIAL_S)
    except AmbidError:
        return wish.seconds
    return _TRIAL_S


def _record(wish: Wish, device: Device, course: Course, stop: Stop, watch: Watch) -> Acquired:
    from ambid.job.acquire import acquire
    from ambid.report.device_text import progress_line

    def show(now: Progress) -> None:
        watch.show("record", now.samples / max(now.wanted, 1), progress_line(now.quality, now.counters))

    return acquire(
        device, wish.rig, wish.record, course, force=wish.force, on_progress=show, on_trouble=told,
        stopped=stop.wished,
    )  # fmt: skip


def _changed(record: Path) -> int | None:
    return record.stat().st_mtime_ns if record.exists() else None
