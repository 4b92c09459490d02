"""``ambid acquire``: a record from a controller, real, emulated or simulated.

With ``--track`` the run is recorded and tracked; what ends the tracking does not end the record.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from ambid.cli.interrupts import INTERRUPTED, Stop, signals
from ambid.cli.options import Values, verb
from ambid.cli.output import Outputs, end, json_path
from ambid.cli.terminal import say_note, watching
from ambid.errors import AmbidError, counted

if TYPE_CHECKING:
    from ambid.acquisition.device import Device
    from ambid.acquisition.session import Acquired, Course, Progress, RunReport
    from ambid.estimation.estimate import Estimate
    from ambid.recursive.lines import Track
    from ambid.rig import Rig
    from ambid.rotor.estimate import RotorEstimate

_ENDINGS = (".h5", ".hdf5", ".csv", ".csv.gz")


@verb("acquire")
def command(v: Values) -> None:
    """Record what a controller samples: it keeps the rotor levitated, plays the excitation and protects the bench.

    PORT is a serial port, 'emulated' (the firmware on an emulated controller before a simulated bench), 'simulated'
    (a simulated bench alone), or 'replay:FILE'. What is recorded is in a journal at once: see 'ambid recover'.
    Exit codes, with --track too: 0 done; 2 refused, a fault of the controller, or tracking failed; 3 with --strict a
    lost sample or poor quality; 130 Ctrl-C.
    """
    from ambid.job.acquiring import Request, acquire, ready
    from ambid.physics.presets import preset_of
    from ambid.report.device import progress_line
    from ambid.rig import load_rig

    replayed = Path(v.port.removeprefix("replay:")) if v.port.startswith("replay:") else None
    start_file = None if v.track in (None, "auto") else Path(str(v.track))
    outputs = Outputs(v.rig, start_file, replayed, v.arm, **v.outputs | ({"json": None} if v.track else {}))
    outputs.claim(v.out, "out", _ENDINGS, force=v.force)
    outputs.claim(json_path(v.json) if v.track else None, "json")
    known, stop, behind = load_rig(v.rig), Stop(), None if v.bench is None else preset_of(v.bench) or v.bench
    settings = v.only("seconds excitation amplitude band mode settle seed")
    settings |= {"stopped": stop.wished, "arm": None if v.arm is None else load_rig(v.arm)}
    wanted, start, before = Request(**settings), None, _changed(v.out)
    if start_file is not None:
        from ambid.job.track_live import live_start

        start = live_start(start_file, known)
    job = Recording(wanted.measured(known), v.port, v.out, wanted.trial(v.port, known).settle_s, stop, force=v.force)
    if (v.out.exists() or v.out.is_symlink()) and not v.force:
        raise AmbidError(f"-o {v.out} already exists. Choose another name, or give --force")
    try:
        with watching() as watch, signals(stop.take):

            def note(line: str) -> None:
                watch.clear()
                say_note(line)

            def stage(name: str, _: float | None = None) -> None:
                if name == "amplitude":
                    watch.show(name, 0.0, "trials, smallest first")

            def show(now: Progress) -> None:
                watch.show("record", now.samples / max(now.wanted, 1), progress_line(now.quality, now.counters))

            if v.track is None:
                done, track_end = acquire(
                    v.port, known, v.out, **settings, bench=behind, pace=v.pace, force=v.force, on_note=note,
                    on_progress=show, on_trouble=_say_trouble, tick=stage,
                ), None  # fmt: skip
            else:
                opening = ready(v.port, known, wanted, bench=behind, pace=v.pace, force=v.force, note=note, tick=stage)
                with opening as (device, course):
                    done, track_end = job.follow(device, course, start, v.json)
    except KeyboardInterrupt:
        typer.echo(f"ambid: interrupted{_left(v.out, _changed(v.out) != before)}", err=True)
        raise typer.Exit(stop.code or INTERRUPTED) from None
    job.tell(done, outputs, table=v.track is None or v.json != "-")
    if track_end is not None:
        track_end()
    job.finish(done, strict=v.strict)


class Recording:
    """One recording: what is played, what is written, and what ends it."""

    def __init__(self, rig: Rig, port: str, record: Path, settle_s: float, stop: Stop, *, force: bool) -> None:
        """Take note of what is wanted."""
        self.rig, self.port, self.path, self.settle_s, self.stop, self.force = rig, port, record, settle_s, stop, force

    def follow(
        self, device: Device, course: Course, start: Estimate | RotorEstimate | None, json: str | None
    ) -> tuple[Acquired, Callable[[], None]]:
        """Record, and track what is recorded from `start`, or from an estimate of the first part.

        The second result prints the track, and raises what it ends with.
        """
        from ambid.acquisition.session import recording
        from ambid.cli.live import Follower
        from ambid.job.track_live import track_live

        follower = Follower(json, keep=False, real_time=device.info.kind == "serial")
        runs: list[RunReport] = []
        failures: list[AmbidError] = []
        loops: list[str] = []  # the last one of a rotor

        def lost(what: AmbidError) -> None:
            failures.append(what)
            typer.echo(f"ambid: tracking ended, recording continues: {what}", err=True)

        def judged(t: float, sensitivity: Mapping[str, Any]) -> None:
            loops[:] = loop_lines(t, sensitivity)

        def job() -> Track:
            made = track_live(
                device, self.rig, course, start=start, taps=[tap], on_event=tap.tell, on_run=runs.append,
                on_trouble=lost, on_header=follower.on_header, on_line=follower.on_line, keep=False,
                on_lag=follower.on_lag, on_loop=judged,
            )  # fmt: skip
            if made.overruns:
                typer.echo(
                    f"ambid: {counted(made.overruns, 'block')} came faster than the tracker could process and are "
                    "missing in the track. Lower daq.rate_hz, or free the machine",
                    err=True,
                )
            return made.track

        with recording(device, self.rig, self.path, course, force=self.force, on_trouble=_say_trouble) as tap:
            try:
                follower.run(job)
            except (AmbidError, KeyboardInterrupt) as failure:
                # What ended tracking does not end the record: it is kept, and judged below.
                if not runs:
                    raise
                if isinstance(failure, KeyboardInterrupt):
                    self.stop.number = self.stop.number or (follower.code or INTERRUPTED) - 128
                elif not failures and runs[0].fault is None:  # the run was over before
                    failures.append(failure)

        def ending() -> None:
            if json != "-":
                typer.echo("\n".join(["", *loops]))
            if failures:
                raise AmbidError(f"{failures[0]}; {self.path} holds all {runs[0].samples} samples")
            if follower.track is not None or (runs[0].fault is None and not self.stop.wished()):
                follower.finish(Outputs())

        return tap.acquired(runs[0]), ending

    def tell(self, done: Acquired, outputs: Outputs, *, table: bool) -> None:
        """Say what was recorded; where standard output is of the track, only what is not good of it."""
        if done.recorded is None:
            return
        with outputs:
            outputs.give(done)
        if table:
            try:
                outputs.show(done)
            except OSError:
                if self.stop.number is None:
                    raise
                sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - nobody reads: it stays open to the end
        notes = [] if table else list(done.quality.verdict)
        if done.recorded.keep_journal:
            journal, again = _journal(self.path), done.recorded.survey.misplaced
            if again:
                what = f"holds {again} samples that are not in {self.path}, because their numbers had occurred before"
            else:
                what = f"was damaged while it was written, and {self.path} lacks what could not be read"
            remedy = f"Look at it with 'ambid recover {journal} -o NAME', or remove it"
            notes.append(f"{journal} is kept: it {what}. {remedy}")
        for line in notes:
            typer.echo(f"ambid: note: {line}", err=True)

    def finish(self, done: Acquired, *, strict: bool) -> None:
        """Tell what ended the run early, and end with the exit code."""
        kept = f"{self.path} holds the {done.stored} samples before it" if done.recorded else "nothing was recorded"
        if done.run.fault is not None:
            from ambid.acquisition.settings import fault_words
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
                f" {self.settle_s:g} s of --settle: nothing was recorded. Give a smaller --settle"
            )
        if done.recorded is None:
            raise AmbidError(f"{self.port}: no sample came. Check cable and supply")
        if not done.run.complete and not done.run.lost:
            ended = f"{self.port} ended after {done.run.samples} of {done.run.wanted} samples"
            typer.echo(f"ambid: note: {ended}", err=True)
        end(failed=strict and not done.passed)

    def _not_stored(self, done: Acquired) -> str:
        """Say what is not in the record, and where the rest is; why was told when it happened."""
        journal, text = _journal(self.path), f"{done.not_stored} samples are not in {self.path}"
        if done.recorded is None:
            return f"{text}: nothing could be written. Free some space, and record again"
        text += f", which holds {done.run.samples - done.not_stored}"
        if not journal.exists():
            return f"{text}, with gaps. Stop what else uses the disk, and record again"
        return f"{text}; {journal} is kept: 'ambid recover {journal} -o NAME' writes the record again"


def _changed(record: Path) -> int | None:
    return record.stat().st_mtime_ns if record.exists() else None


def _journal(record: Path) -> Path:
    from ambid.acquisition.recorder.journal import journal_path

    return journal_path(record)


def loop_lines(t: float, sensitivity: Mapping[str, Any]) -> list[str]:
    """Write the sensitivity of each axis of a rotor beside its run, as an estimate has it."""
    from ambid.control.zones import Zone
    from ambid.estimation.result import NORMAL_95

    zones = {axis: Zone.read(entry) for axis, entry in sensitivity.items()}
    lines = [
        f"  {axis}  {z.value:.2f} dB, 95 % within ± {NORMAL_95 * z.sd:.2f} dB, zone {z.words}, {z.source}"
        for axis, z in zones.items()
    ]
    return [f"sensitivity at {t:.4g} s, opened at the position:", *lines, ""] if lines else []


def _say_trouble(what: AmbidError) -> None:
    typer.echo(f"ambid: {what}", err=True)


def _left(record: Path, changed: bool) -> str:
    """Say where what was recorded is, after a second signal tore the run off; `changed`: it is another file now."""
    journal = _journal(record)
    if changed:
        return f"; {record} holds what came before it"
    return f"; recover what came with 'ambid recover {journal}'" if journal.exists() else "; nothing was recorded"
