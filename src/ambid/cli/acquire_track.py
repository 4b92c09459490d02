"""``ambid acquire --track``: the run is recorded and tracked; what ends the tracking does not end the record."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

import typer

from ambid.cli import INTERRUPTED
from ambid.cli.acquire_wish import Wish, told
from ambid.cli.options import json_path
from ambid.errors import AmbidError

if TYPE_CHECKING:
    from ambid.acquire.device import Device
    from ambid.acquire.session import Course, RunReport
    from ambid.cli.interrupts import Stop
    from ambid.estimation.estimate import Estimate
    from ambid.job.acquire import Acquired
    from ambid.recursive.lines import Track


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
    from ambid.job.acquire import recording
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
    with recording(device, wish.rig, wish.record, course, force=wish.force, on_trouble=told) as tap:
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
