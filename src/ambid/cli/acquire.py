"""``ambid acquire``: a record from a controller, real, emulated or simulated.

With ``--track`` the run is recorded and tracked; what ends the tracking does not end the record.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ambid.cli.device_options import BandHz, BenchName, Pace, Port, RigOfDevice, Seed, course_mode, opened
from ambid.cli.interrupts import INTERRUPTED, Stop, signals
from ambid.cli.options import FAILED_CHECK, LARGEST, band_of, check_positive, json_path, option, switch
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter, watching
from ambid.errors import AmbidError

if TYPE_CHECKING:
    from ambid.acquire.device import Device, Mode, Program
    from ambid.acquire.recorder import Recorded
    from ambid.acquire.session import Course, RunReport
    from ambid.cli.terminal import Watch
    from ambid.estimation.estimate import Estimate
    from ambid.job.acquisition import Acquired, Progress
    from ambid.recursive.lines import Track
    from ambid.rig import Rig

_ENDINGS = (".h5", ".hdf5", ".csv", ".csv.gz")
_TRIAL_S = 2.0  # of each trial of an amplitude


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """What the user asks for; refused when it is made, where it does not go together."""

    port: str
    rig: Rig
    record: Path
    mode: Mode
    seconds: float  # length of the record, and time before it, s
    settle_s: float
    name: str | None  # of the excitation
    amplitude: float | None  # peak in V; None: found by trials
    band: tuple[float, float] | None  # in Hz
    seed: int
    force: bool  # whether a record that exists may be written over

    def __post_init__(self) -> None:
        """Refuse what does not go together."""
        check_positive({"--seconds": self.seconds, "--amplitude": self.amplitude})
        if not 0 <= self.settle_s <= LARGEST:
            raise AmbidError(f"--settle is {self.settle_s:g}; it must be a number, 0 to {LARGEST:g}. Correct it")
        if self.name is None:
            for option, y in (("--amplitude", self.amplitude), ("--band", self.band)):
                if y is not None:
                    raise AmbidError(
                        f"{option} is of an excitation, and none is named. Give --excitation, or leave it out"
                    )
        elif self.port.startswith("replay:"):
            raise AmbidError("--excitation cannot be played to a record that is replayed. Leave it out")
        elif self.mode == "sample":
            raise AmbidError(
                "--mode sample has its output off: nothing can be excited. Leave --excitation out, or --mode drive"
            )
        if (self.record.exists() or self.record.is_symlink()) and not self.force:
            raise AmbidError(f"-o {self.record} exists already. Choose another name, or give --force")

    def check_length(self, rate_hz: float) -> None:
        """Refuse a record that would be too short to be read.

        `rate_hz`: of the device.
        """
        from ambid.record.sampling import MIN_SAMPLES

        samples = max(1, round(self.seconds * rate_hz))
        if samples < MIN_SAMPLES:
            raise AmbidError(
                f"--seconds is {self.seconds:g}: {samples} samples at {rate_hz:g} Hz; a record has {MIN_SAMPLES} at"
                f" least. Give {MIN_SAMPLES / rate_hz:.3g} or more"
            )


def command(
    port: Port,
    rig: RigOfDevice,
    record: Annotated[Path, option("--output -o", "FILE", "Record to write: .h5, .csv or .csv.gz.")],
    seconds: Annotated[float, option("--seconds", "S", "Length of the record in s.", True)] = 10.0,
    excitation: Annotated[
        str | None,
        option(
            "--excitation",
            "NAME",
            "What the controller adds to its output: multisine, schroeder, prbs or steps.",
            "none",
        ),
    ] = None,
    amplitude: Annotated[
        float | None, option("--amplitude", "V", "Peak of the excitation in V.", "found by trials, small first")
    ] = None,
    band: BandHz = None,
    mode: Annotated[
        Literal["sample", "drive", "levitate"] | None,
        option(
            "--mode",
            None,
            "Output off; excitation without feedback; position loop on the controller.",
            "levitate where the rig has a loop; sample a replay",
        ),
    ] = None,
    settle: Annotated[
        float | None, option("--settle", "S", "Time after the start that is not recorded, in s.", "1 to levitate")
    ] = None,
    bench: BenchName = None,
    pace: Pace = "fastest",
    seed: Seed = 0,
    track: Annotated[
        str | None,
        option(
            "--track",
            "ESTIMATE.json|auto",
            "Follow the parameters meanwhile, from this estimate, or from one of the first seconds.",
        ),
    ] = None,
    json: Annotated[
        str | None, option("--json", "FILE", "With --track: the track as lines of JSON; - for standard output.")
    ] = None,
    quiet: Annotated[bool, switch("--no-live --quiet", "No live view of the track.")] = False,
    force: Annotated[bool, switch("--force", "Write over a record that exists.")] = False,
    strict: Annotated[
        bool, switch("--strict", "End with exit code 3 if samples were lost or the quality is poor.")
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
    from ambid.job.look import moving_band

    if wish.band is not None or wish.mode != "levitate" or wish.name not in ("multisine", "schroeder"):
        return wish.band
    low, high = moving_band(device.info.rate_hz, wish.seconds)
    return (low, high) if 3.0 * low < high else None  # a short record has no room for slow lines


def _found_amplitude(wish: Wish, device: Device, stop: Stop, watch: Watch) -> float:
    """Try small excitations first, and say which one was taken."""
    from ambid.job.look import Trial, fitting_amplitude

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
    from ambid.job.acquisition import acquire
    from ambid.report.device_text import progress_line

    def show(now: Progress) -> None:
        watch.show("record", now.samples / max(now.wanted, 1), progress_line(now.quality, now.counters))

    return acquire(
        device, wish.rig, wish.record, course, force=wish.force, on_progress=show, on_trouble=say_trouble,
        stopped=stop.wished,
    )  # fmt: skip


def _changed(record: Path) -> int | None:
    return record.stat().st_mtime_ns if record.exists() else None


def start_of_track(track: str | None) -> Estimate | None:
    """Read the estimate that tracking is to begin with.

    `track`: as given: None, ``auto``, or a file. Returns none where none is named.
    """
    if track in (None, "auto"):
        return None
    from ambid.job.results import read_linear_estimate

    return read_linear_estimate(
        str(track),
        f"--track {track} is a black-box fit or a nonlinear estimate; tracking follows linear physical parameters."
        " Give an estimate of 'ambid identify --json' without --nonlinear",
    )


def say_trouble(what: AmbidError) -> None:
    """Say on standard error what goes wrong while a recording goes on."""
    typer.echo(f"ambid: {what}", err=True)


def followed(
    wish: Wish, device: Device, course: Course, start: Estimate | None, json: str | None, stop: Stop, *, live: bool
) -> tuple[Acquired, Callable[[], None]]:
    """Record, and track what is recorded.

    `device`: opened, idle; `start`: where tracking begins; None: identified from the first part; `json`: where the
    track goes; `stop`: told of a signal that ended the run; `live`: whether a live view is wanted. Returns the second
    one prints the track, and raises what it ends with.
    """
    from ambid.cli.live import Follower
    from ambid.cli.track import finish
    from ambid.job.acquisition import recording
    from ambid.job.track_live import track_live
    from ambid.track.lines_file import TrackWriter

    path = json_path(json)
    writer = TrackWriter(path) if path else TrackWriter(sys.stdout) if json == "-" else None
    shown = live and sys.stderr.isatty() and not (json == "-" and sys.stdout.isatty())
    follower = Follower(writer, keep=False, live=shown, real_time=device.info.kind == "serial")
    runs: list[RunReport] = []
    failures: list[AmbidError] = []

    def lost(what: AmbidError) -> None:
        failures.append(what)
        typer.echo(f"ambid: tracking ended, the recording goes on: {what}", err=True)

    def job() -> Track:
        made = track_live(
            device, wish.rig, course, start=start, taps=[tap], on_event=tap.tell, on_run=runs.append, on_trouble=lost,
            on_header=follower.on_header, on_line=follower.on_line, keep=False,
        )  # fmt: skip
        if made.overruns:
            typer.echo(
                f"ambid: {made.overruns} blocks came faster than the tracker takes them, and are missing in the track."
                " Lower daq.rate_hz, or free the machine",
                err=True,
            )
        return made.track

    summary = None
    with recording(device, wish.rig, wish.record, course, force=wish.force, on_trouble=say_trouble) as tap:
        try:
            summary = follower.run(job)
        except (AmbidError, KeyboardInterrupt) as failure:
            # What ended tracking does not end the record: it is kept, and judged below.
            if not runs or not (failures or isinstance(failure, KeyboardInterrupt) or runs[0].fault):
                raise
            if isinstance(failure, KeyboardInterrupt):
                stop.number = stop.number or (follower.code or INTERRUPTED) - 128
    written = [str(p) for p in (path,) if p]

    def ending() -> None:
        if failures:
            raise AmbidError(f"{failures[0]}; {wish.record} holds all {runs[0].samples} samples")
        if summary is not None or (runs[0].fault is None and not stop.wished()):
            finish(follower, summary, written, table=json != "-", strict=False, flags=())

    return tap.acquired(runs[0]), ending


def tell(done: Acquired, wish: Wish, stop: Stop, *, table: bool) -> None:
    """Say what was recorded; where standard output is of the track, only what is not good of it.

    `table`: whether standard output is for it.
    """
    if done.recorded is None:
        return
    if table:
        from ambid.report.device_text import acquired_text

        try:
            said = acquired_text(
                wish.record, done.info, done.run, done.quality, done.counters, not_stored=done.not_stored,
                paint=painter(),
            )  # fmt: skip
            typer.echo(said)
        except OSError:
            if stop.number is None:
                raise
            sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - nobody reads: it stays open to the end
    else:
        for line in done.quality.verdict:
            typer.echo(f"ambid: note: {line}", err=True)
    if done.recorded.keep_journal:
        typer.echo(f"ambid: note: {_kept(done.recorded, wish.record)}", err=True)


def finish(done: Acquired, wish: Wish, stop: Stop, *, strict: bool) -> None:
    """Tell what ended the run early, and end with the exit code.

    `stop`: with the signal that ended it, if one did; `strict`: whether what is not good enough is a failed check.
    """
    stored = done.run.samples - done.not_stored - done.quality.repeated
    kept = f"{wish.record} holds the {stored} samples before it" if done.recorded else "nothing was recorded"
    if done.run.fault is not None:
        from ambid.acquire.default_daq import fault_words
        from ambid.rig.rig import Daq

        rate_hz = done.info.rate_hz
        daq = wish.rig.daq or Daq(rate_hz=rate_hz)
        why = fault_words(done.run.fault, rate_hz=rate_hz, lift_ms=daq.lift_ms)
        raise AmbidError(f"{wish.port}: the controller went to its safe state: {why}; {kept}")
    if done.not_stored:
        raise AmbidError(_not_stored(done, wish.record))
    if stop.number is not None:
        typer.echo(f"ambid: interrupted; {kept}", err=True)
        raise typer.Exit(stop.code)
    if done.recorded is None:
        raise AmbidError(_nothing(done, wish))
    if not done.run.complete and not done.run.lost:
        typer.echo(f"ambid: note: {wish.port} ended after {done.run.samples} of {done.run.wanted} samples", err=True)
    if strict and (not done.run.complete or done.quality.verdict):
        raise typer.Exit(FAILED_CHECK)


def left(record: Path, changed: bool) -> str:
    """Say where what was recorded is, after a second signal tore the run off.

    `changed`: whether it is another file than before. Returns what goes on after the word that it was interrupted.
    """
    from ambid.acquire.recorder.layout import journal_path

    journal = journal_path(record)
    if changed:
        return f"; {record} holds what came before it"
    return f"; get what came with 'ambid recover {journal}'" if journal.exists() else "; nothing was recorded"


def _kept(recorded: Recorded, record: Path) -> str:
    """Say why there is a journal beside the record, and what to do with it."""
    from ambid.acquire.recorder.layout import journal_path

    journal, again = journal_path(record), recorded.survey.misplaced
    if again:
        what = f"holds {again} samples that are not in {record}, as their numbers had come before"
    else:
        what = f"was damaged while it was written, and {record} lacks what could not be read"
    return f"{journal} is kept: it {what}. Look at it with 'ambid recover {journal} -o NAME', or remove it"


def _not_stored(done: Acquired, record: Path) -> str:
    """Say what is not in the record, and where the rest is; why was told when it happened."""
    from ambid.acquire.recorder.layout import journal_path

    journal = journal_path(record)
    text = f"{done.not_stored} samples are not in {record}"
    if done.recorded is None:
        return f"{text}: nothing could be written. Make room, and record again"
    stored = done.run.samples - done.not_stored
    if not journal.exists():
        return f"{text}, which holds {stored}, with gaps. End what else uses the disk, and record again"
    return f"{text}, which holds {stored}; {journal} is kept: 'ambid recover {journal} -o NAME' makes the record again"


def _nothing(done: Acquired, wish: Wish) -> str:
    """Say why there is no record at all."""
    if done.counters.samples:
        return (
            f"{wish.port} ended after {done.counters.samples / done.info.rate_hz:.4g} s, within the {wish.settle_s:g} s"
            " of --settle: nothing was recorded. Give a smaller --settle"
        )
    return f"{wish.port}: no sample came. Look at cable and supply"
