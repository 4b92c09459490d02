"""``ambid acquire``: a record from a controller, real, emulated or simulated.

With ``--track`` the run is recorded and tracked; what ends the tracking does not end the record.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ambid.cli import options as opt
from ambid.cli.devices import course_mode, open_bench
from ambid.cli.interrupts import INTERRUPTED, Stop, signals
from ambid.cli.options import option, switch
from ambid.cli.output import Outputs, end, json_path
from ambid.cli.terminal import painter, watching
from ambid.errors import AmbidError, refuse_given

if TYPE_CHECKING:
    from ambid.acquisition.amplitude import Trial
    from ambid.acquisition.device import Device, Mode
    from ambid.acquisition.recording import Acquired, Progress
    from ambid.acquisition.session import Course, RunReport
    from ambid.cli.terminal import Watch
    from ambid.estimation.estimate import Estimate
    from ambid.recursive.lines import Track
    from ambid.rig import Rig

_ENDINGS = (".h5", ".hdf5", ".csv", ".csv.gz")
_TRIAL_S = 2.0  # of each trial of an amplitude


def command(
    port: opt.Port,
    rig: opt.RigOfDevice,
    record: Annotated[Path, option("--output -o FILE", "Record to write: .h5, .csv or .csv.gz.")],
    seconds: Annotated[float, option("--seconds S", "Length of the record in s.", True)] = 10.0,
    excitation: Annotated[
        str | None,
        option(
            "--excitation NAME", "What the controller adds to its output: multisine, schroeder, prbs or steps.", "none"
        ),
    ] = None,
    amplitude: Annotated[
        float | None, option("--amplitude V", "Peak of the excitation in V.", "found by trials, small first")
    ] = None,
    band: opt.BandHz = None,
    mode: Annotated[
        Literal["sample", "drive", "levitate"] | None,
        option(
            "--mode",
            "Output off; excitation without feedback; position loop on the controller.",
            "levitate where the rig has a loop; sample a replay",
        ),
    ] = None,
    settle: Annotated[
        float | None, option("--settle S", "Time after the start that is not recorded, in s.", "1 to levitate")
    ] = None,
    bench: opt.BenchName = None,
    pace: opt.Pace = "fastest",
    seed: opt.Seed = 0,
    track: Annotated[
        str | None,
        option(
            "--track ESTIMATE.json|auto",
            "Follow the parameters meanwhile, from this estimate, or from one of the first seconds.",
        ),
    ] = None,
    json: Annotated[
        str | None, option("--json FILE", "With --track: the track as lines of JSON; - for standard output.")
    ] = None,
    quiet: Annotated[bool, switch("--no-live --quiet", "No live view of the track.")] = False,
    force: opt.ForceLoop = False,
    strict: Annotated[
        bool, switch("--strict", "End with exit code 3 if samples were lost or the quality is poor.")
    ] = False,
) -> None:
    """Record what a controller samples: it keeps the rotor levitated, plays the excitation and protects the bench.

    PORT is a serial port, 'emulated' (the firmware on an emulated controller before a simulated bench), 'simulated'
    (a simulated bench alone), or 'replay:FILE'. What is recorded is in a journal at once: see 'ambid recover'.
    """
    from ambid.acquisition.amplitude import Trial
    from ambid.rig import load_rig

    if json is not None and track is None:
        raise AmbidError("--json writes a track, and none is wanted. Give --track too, or leave it out")
    between = opt.band_of(band)
    replayed = Path(port.removeprefix("replay:")) if port.startswith("replay:") else None
    with Outputs(rig, None if track in (None, "auto") else Path(str(track)), replayed) as outputs:
        outputs.claim(record, "-o", _ENDINGS, force=force)
        outputs.claim(json_path(json), "--json")
    known = load_rig(rig)
    chosen = course_mode(port, known, mode, excitation)
    settle_s = (1.0 if chosen == "levitate" else 0.0) if settle is None else settle
    opt.check_positive({"--seconds": seconds, "--amplitude": amplitude})
    if not 0 <= settle_s <= opt.LARGEST:
        raise AmbidError(f"--settle is {settle_s:g}; it must be a number, 0 to {opt.LARGEST:g}. Correct it")
    _check_excitation(port, chosen, excitation, {"--amplitude": amplitude, "--band": between})
    if (record.exists() or record.is_symlink()) and not force:
        raise AmbidError(f"-o {record} exists already. Choose another name, or give --force")
    trial = Trial(name=str(excitation), band=between, mode=chosen, settle_s=settle_s, seconds=seconds, seed=seed)
    job = Recording(known, port, record, trial, force=force)
    start, before = start_of_track(track), _changed(record)
    try:
        closes = chosen == "levitate" and not force
        opening = open_bench(port, known, bench=bench, pace=pace, seed=seed, closes=closes)
        with watching() as watch, signals(job.stop.take), opening as device:
            course = job.course(device, watch, played=excitation is not None, amplitude=amplitude)
            if track is None:
                done, track_end = job.record_only(device, course, watch), None
            else:
                done, track_end = job.follow(device, course, start, json, quiet=quiet)
    except KeyboardInterrupt:
        typer.echo(f"ambid: interrupted{_left(record, _changed(record) != before)}", err=True)
        raise typer.Exit(job.stop.code or INTERRUPTED) from None
    job.tell(done, table=json != "-")
    if track_end is not None:
        track_end()
    job.finish(done, strict=strict)


def _check_excitation(port: str, mode: Mode, name: str | None, given: Mapping[str, object]) -> None:
    """Refuse an excitation that cannot be played, and what is `given` of one where none is named."""
    if name is None:
        refuse_given(given, "{} is of an excitation, and none is named. Give --excitation, or leave it out")
    elif port.startswith("replay:"):
        raise AmbidError("--excitation cannot be played to a record that is replayed. Leave it out")
    elif mode == "sample":
        raise AmbidError(
            "--mode sample has its output off: nothing can be excited. Leave --excitation out, or --mode drive"
        )


class Recording:
    """One recording: what is played, what is written, and what ends it."""

    def __init__(self, rig: Rig, port: str, record: Path, trial: Trial, *, force: bool) -> None:
        """Take note of what is wanted."""
        self.rig, self.port, self.path, self.trial, self.force = rig, port, record, trial, force
        self.stop = Stop()

    def course(self, device: Device, watch: Watch, *, played: bool, amplitude: float | None) -> Course:
        """Say what the device is to do; find the amplitude of its excitation where none is given."""
        from ambid.acquisition.amplitude import band_for
        from ambid.acquisition.session import Course
        from ambid.record.sampling import MIN_SAMPLES

        rate_hz, trial = device.info.rate_hz, self.trial
        samples = max(1, round(trial.seconds * rate_hz))
        if samples < MIN_SAMPLES:
            raise AmbidError(
                f"--seconds is {trial.seconds:g}: {samples} samples at {rate_hz:g} Hz; a record has {MIN_SAMPLES} at"
                f" least. Give {MIN_SAMPLES / rate_hz:.3g} or more"
            )
        if not played:
            return Course(mode=trial.mode, seconds=trial.seconds, settle_s=trial.settle_s)
        trial = replace(trial, band=band_for(trial, rate_hz))
        course = trial.course(1.0 if amplitude is None else amplitude, rate_hz)  # refused before anything moves
        return trial.course(self._amplitude(device, trial, watch), rate_hz) if amplitude is None else course

    def _amplitude(self, device: Device, trial: Trial, watch: Watch) -> float:
        """Try small excitations first, and say which one was taken."""
        from ambid.acquisition.amplitude import fitting_amplitude

        watch.show("amplitude", 0.0, "trials, small first")
        brief = replace(trial, seconds=_TRIAL_S)
        try:
            brief.course(1.0, device.info.rate_hz)
        except AmbidError:  # an excitation of slow periods takes the whole record's length
            brief = trial
        try:
            found = fitting_amplitude(device, self.rig, brief, stopped=self.stop.wished)
        except AmbidError:
            if self.stop.wished():
                raise KeyboardInterrupt from None
            raise
        watch.clear()
        typer.echo(f"ambid: note: amplitude {found:.3g} V, found by trials", err=True)
        return found

    def record_only(self, device: Device, course: Course, watch: Watch) -> Acquired:
        """Record without a tracker."""
        from ambid.acquisition.recording import acquire
        from ambid.report.device_text import progress_line

        def show(now: Progress) -> None:
            watch.show("record", now.samples / max(now.wanted, 1), progress_line(now.quality, now.counters))

        return acquire(
            device, self.rig, self.path, course, force=self.force, on_progress=show, on_trouble=_say_trouble,
            stopped=self.stop.wished,
        )  # fmt: skip

    def follow(
        self, device: Device, course: Course, start: Estimate | None, json: str | None, *, quiet: bool
    ) -> tuple[Acquired, Callable[[], None]]:
        """Record, and track what is recorded from `start`, or from an estimate of the first part.

        The second result prints the track, and raises what it ends with.
        """
        from ambid.acquisition.recording import recording
        from ambid.cli.live import Follower
        from ambid.job.track_live import track_live

        follower = Follower(json, keep=False, quiet=quiet, real_time=device.info.kind == "serial")
        runs: list[RunReport] = []
        failures: list[AmbidError] = []

        def lost(what: AmbidError) -> None:
            failures.append(what)
            typer.echo(f"ambid: tracking ended, the recording goes on: {what}", err=True)

        def job() -> Track:
            made = track_live(
                device, self.rig, course, start=start, taps=[tap], on_event=tap.tell, on_run=runs.append,
                on_trouble=lost, on_header=follower.on_header, on_line=follower.on_line, keep=False,
            )  # fmt: skip
            if made.overruns:
                typer.echo(
                    f"ambid: {made.overruns} blocks came faster than the tracker takes them, and are missing in the"
                    " track. Lower daq.rate_hz, or free the machine",
                    err=True,
                )
            return made.track

        with recording(device, self.rig, self.path, course, force=self.force, on_trouble=_say_trouble) as tap:
            try:
                follower.run(job)
            except (AmbidError, KeyboardInterrupt) as failure:
                # What ended tracking does not end the record: it is kept, and judged below.
                if not runs or not (failures or isinstance(failure, KeyboardInterrupt) or runs[0].fault):
                    raise
                if isinstance(failure, KeyboardInterrupt):
                    self.stop.number = self.stop.number or (follower.code or INTERRUPTED) - 128

        def ending() -> None:
            if failures:
                raise AmbidError(f"{failures[0]}; {self.path} holds all {runs[0].samples} samples")
            if follower.track is not None or (runs[0].fault is None and not self.stop.wished()):
                follower.finish(Outputs())

        return tap.acquired(runs[0]), ending

    def tell(self, done: Acquired, *, table: bool) -> None:
        """Say what was recorded; where standard output is of the track, only what is not good of it."""
        from ambid.report.device_text import acquired_text

        if done.recorded is None:
            return
        if table:
            said = acquired_text(
                self.path, done.info, done.run, done.quality, done.counters, not_stored=done.not_stored,
                paint=painter(),
            )  # fmt: skip
            try:
                typer.echo(said)
            except OSError:
                if self.stop.number is None:
                    raise
                sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - nobody reads: it stays open to the end
        notes = [] if table else list(done.quality.verdict)
        if done.recorded.keep_journal:
            journal, again = _journal(self.path), done.recorded.survey.misplaced
            if again:
                what = f"holds {again} samples that are not in {self.path}, as their numbers had come before"
            else:
                what = f"was damaged while it was written, and {self.path} lacks what could not be read"
            remedy = f"Look at it with 'ambid recover {journal} -o NAME', or remove it"
            notes.append(f"{journal} is kept: it {what}. {remedy}")
        for line in notes:
            typer.echo(f"ambid: note: {line}", err=True)

    def finish(self, done: Acquired, *, strict: bool) -> None:
        """Tell what ended the run early, and end with the exit code."""
        stored = done.run.samples - done.not_stored - done.quality.repeated
        kept = f"{self.path} holds the {stored} samples before it" if done.recorded else "nothing was recorded"
        if done.run.fault is not None:
            from ambid.acquisition.default_daq import fault_words
            from ambid.rig.rig import Daq

            rate_hz = done.info.rate_hz
            daq = self.rig.daq or Daq(rate_hz=rate_hz)
            why = fault_words(done.run.fault, rate_hz=rate_hz, lift_ms=daq.lift_ms)
            raise AmbidError(f"{self.port}: the controller went to its safe state: {why}; {kept}")
        if done.not_stored:
            raise AmbidError(self._not_stored(done))
        if self.stop.number is not None:
            typer.echo(f"ambid: interrupted; {kept}", err=True)
            raise typer.Exit(self.stop.code)
        if done.recorded is None and done.counters.samples:
            raise AmbidError(
                f"{self.port} ended after {done.counters.samples / done.info.rate_hz:.4g} s, within the"
                f" {self.trial.settle_s:g} s of --settle: nothing was recorded. Give a smaller --settle"
            )
        if done.recorded is None:
            raise AmbidError(f"{self.port}: no sample came. Look at cable and supply")
        if not done.run.complete and not done.run.lost:
            ended = f"{self.port} ended after {done.run.samples} of {done.run.wanted} samples"
            typer.echo(f"ambid: note: {ended}", err=True)
        end(failed=strict and (not done.run.complete or bool(done.quality.verdict)))

    def _not_stored(self, done: Acquired) -> str:
        """Say what is not in the record, and where the rest is; why was told when it happened."""
        journal, text = _journal(self.path), f"{done.not_stored} samples are not in {self.path}"
        if done.recorded is None:
            return f"{text}: nothing could be written. Make room, and record again"
        text += f", which holds {done.run.samples - done.not_stored}"
        if not journal.exists():
            return f"{text}, with gaps. End what else uses the disk, and record again"
        return f"{text}; {journal} is kept: 'ambid recover {journal} -o NAME' makes the record again"


def _changed(record: Path) -> int | None:
    return record.stat().st_mtime_ns if record.exists() else None


def _journal(record: Path) -> Path:
    from ambid.acquisition.recorder.layout import journal_path

    return journal_path(record)


def start_of_track(track: str | None) -> Estimate | None:
    """Read the estimate that tracking is to begin with; None where none is named."""
    if track in (None, "auto"):
        return None
    from ambid.job.results import read_linear_estimate

    return read_linear_estimate(
        str(track),
        f"--track {track} is a black-box fit or a nonlinear estimate; tracking follows linear physical parameters."
        " Give an estimate of 'ambid identify --json' without --nonlinear",
    )


def _say_trouble(what: AmbidError) -> None:
    typer.echo(f"ambid: {what}", err=True)


def _left(record: Path, changed: bool) -> str:
    """Say where what was recorded is, after a second signal tore the run off; `changed`: it is another file now."""
    journal = _journal(record)
    if changed:
        return f"; {record} holds what came before it"
    return f"; get what came with 'ambid recover {journal}'" if journal.exists() else "; nothing was recorded"
