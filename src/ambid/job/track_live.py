"""Live tracking: a device in its own thread fills a queue, the tracker follows; nothing on the data's way waits for it.
An identification, or a check of the start, takes the stream's beginning, which is then tracked like the rest.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from threading import Event as Signal
from threading import Thread
from types import MappingProxyType
from typing import Any, Unpack

import numpy as np

from ambid.acquisition.device import AxesProgram, Device, DeviceEvent
from ambid.acquisition.devices.played import FrameQueue
from ambid.acquisition.session import Course, RunReport, Tap, run
from ambid.acquisition.settings import BenchView, fault_words
from ambid.arrays import Array
from ambid.errors import AmbidError, DeviceError
from ambid.estimation.estimate import Estimate
from ambid.job.following import Following, FollowingWords
from ambid.job.track_start import BenchRows, read_start, start_of
from ambid.job.tracking import follow
from ambid.record import Channel, Record
from ambid.recursive.lines import Track
from ambid.rig import Rig
from ambid.rig.load import SELECTED
from ambid.rotor.estimate import RotorEstimate
from ambid.rotor.spectra import find_excitation
from ambid.tracking.blocks import Block, Frame, Replay

_BLOCK_SAMPLES = 256  # of the blocks in which what was read for the start is tracked
_QUEUE_S = 30.0  # of samples that wait while a start is identified, or the machine is busy
_CHECKED_S = 0.5  # of the stream that a given start is checked with
_IDENTIFIED_S, _IDENTIFIED_SAMPLES = 2.0, 10_000  # at least, where a start is to be identified

_IDENTIFIED_PERIODS, _CHECKED_PERIODS = 4, 3  # of a rotor's excitation
_LOOKED_S, _SOUGHT_S = 1.0, 8.0  # of a rotor's stream, after which periods are looked for each time, and at most

LOOK_S = 0.1
"""How long a wait may last before it is looked whether it is still wanted, s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveTrack:
    """The result of live tracking."""

    track: Track  # header, lines where they were kept, summary
    run: RunReport  # of the device
    overruns: int  # blocks that found the queue full: they are gaps in the track, and counted there too


def track_live(
    device: Device,
    rig: Rig,
    course: Course,
    *,
    start: Estimate | RotorEstimate | str | Path | float | None = None,
    taps: Sequence[Tap] = (),
    on_event: Callable[[DeviceEvent], object] | None = None,
    on_run: Callable[[RunReport], object] | None = None,
    on_trouble: Callable[[AmbidError], object] | None = None,
    on_lag: Callable[[float], object] = lambda _: None,
    on_loop: Callable[[float, Mapping[str, Any]], object] = lambda _, __: None,
    stopped: Callable[[], bool] = lambda: False,
    **following: Unpack[FollowingWords],
) -> LiveTrack:
    """Let an opened, idle `device` do a `course`, and follow its bench once it has settled, to the course's end, a
    fault, or an interrupt. `start`: an estimate, or the seconds from which one is identified; `taps`: other listeners,
    such as a recorder; `on_event`: of the device, in the run's thread; `on_run`: given its result, also of interrupted
    tracking; `on_lag`: told a block's time from last sample to done work, s; `on_loop`: of a rotor, told a time and the
    sensitivity of each axis. Times of `Following` count from the first tracked sample.
    """
    plant = rig.plant
    view = BenchView(
        device.info, rig, (*plant.inputs, *plant.outputs) if rig.rotor is None else [c.role for c in rig.channels]
    )
    if rig.rotor is None:
        start = max(_IDENTIFIED_S, _IDENTIFIED_SAMPLES / view.rate_hz) if start is None else start
        wanted_s = start if isinstance(start, (int, float)) else _CHECKED_S
    else:
        wanted_s = _rotor_start_s(course, start, view.rate_hz)
    if course.seconds <= wanted_s:
        raise DeviceError(
            f"tracking needs {wanted_s:g} s for its start, and the run lasts {course.seconds:g} s. Run longer"
            + (", or give a start" if wanted_s == start else "")
        )
    queue = FrameQueue(max(1, round(_QUEUE_S * view.rate_hz)))
    queue.begin()
    tap = QueueTap(queue, view, waits=device.info.kind != "serial", stopped=stopped)
    job = partial(run, device, course, taps=(*taps, tap), on_event=on_event)  # who records is never behind
    runner = LiveRun(job, tap, queue, stopped, recorded=bool(taps), on_run=on_run, on_trouble=on_trouble)
    with runner:
        lead = _Lead(_frames(queue, real=device.info.real), runner, wanted_s, view, device.info.port)
        if rig.rotor is not None:
            from ambid.job.track_rotor import follow_rotor

            known = isinstance(course.program, AxesProgram) or isinstance(start, (int, float))
            sought_s = 0.0 if known else min(course.seconds / 3.0, _SOUGHT_S)
            source, how = lead.periodic(rig, sought_s), Following(**following)
            frames = lead.frames(None, 0, lambda _: None)

            def say(_: str, __: float | None = None, /) -> None:  # between steps of a start's identification
                if stopped():
                    raise DeviceError("the run was stopped while its start was identified: nothing was tracked")

            track = follow_rotor(source, frames, rig, start, how, on_lag=on_lag, on_loop=on_loop, say=say)
        else:
            assert not isinstance(start, RotorEstimate)
            source = lead.source
            begin = start_of(source, rig, start=start, rig_speaks=True)
            frames = lead.frames(source, begin.first, on_lag)
            track = follow(frames, source, begin, Following(**following), live=True)
    if queue.overruns and track.totals is not None and track.totals.latency is not None:
        latency = replace(track.totals.latency, overruns=queue.overruns)
        track = replace(track, totals=replace(track.totals, latency=latency))
    return LiveTrack(track=track, run=runner.report(), overruns=queue.overruns)


def live_start(path: str | Path, rig: Rig) -> Estimate | RotorEstimate:
    """Read the estimate with which a track is to begin, so that another file is refused before anything moves."""
    if rig.rotor is None:
        return read_start(path)
    from ambid.job.track_rotor import given_start

    return given_start(path)


def _rotor_start_s(course: Course, start: object, rate_hz: float) -> float:
    """Return the seconds in which the periods of a rotor's start are: known of an excitation that is played, else they
    are looked for from time to time.
    """
    if isinstance(start, (int, float)):
        return start
    if isinstance(course.program, AxesProgram):
        return (_IDENTIFIED_PERIODS if start is None else _CHECKED_PERIODS) * len(course.program.wave) / rate_hz
    return min(_LOOKED_S, course.seconds / 3.0)


class _Lead:
    """The beginning of the stream: read before tracking begins, and tracked with the rest."""

    def __init__(self, frames: Iterator[Frame], runner: LiveRun, wanted_s: float, view: BenchView, port: str) -> None:
        self._frames, self._blocks, self._view, self._port = frames, list[Block](), view, port
        if not self.read(wanted_s):
            raise _too_short(runner, wanted_s, view.rate_hz)

    def read(self, until_s: float) -> bool:
        """Read on; whether there was as much."""
        read, wanted = self._blocks, round(until_s * self._view.rate_hz) + 1
        while not read or read[-1].first + len(read[-1].values) < wanted:
            frame = next(self._frames, None)
            if frame is None:
                return False
            read.append(frame.block)
        return True

    @property
    def source(self) -> BenchRows:
        """What was read."""
        read, view = self._blocks, self._view
        values = np.concatenate([b.values for b in read])
        numbers = np.concatenate([b.first + np.arange(len(b.values)) for b in read])
        stamps = np.concatenate([b.time_s + np.arange(len(b.values)) / view.rate_hz for b in read])
        channels = tuple(
            Channel(name=role, unit=unit, values=values[:, k]) for k, (role, unit) in enumerate(view.units.items())
        )
        provenance = MappingProxyType({"file": self._port})
        return BenchRows(
            record=Record(channels=channels, rate_hz=view.rate_hz, provenance=provenance, history=(SELECTED,)),
            replay=Replay(
                values=values, numbers=numbers, time_s=stamps, rate_hz=view.rate_hz, block_samples=_BLOCK_SAMPLES
            ),
            forcing=None, t0=0.0,
        )  # fmt: skip

    def periodic(self, rig: Rig, most_s: float) -> BenchRows:
        """Read on until the periods of a rotor's start are there; return what was read."""
        source, periods = self.source, 0
        while periods <= _CHECKED_PERIODS and source.duration_s < most_s:
            if not self.read(source.duration_s + _LOOKED_S):
                break
            source = self.source
            found = find_excitation(source.record, rig.plant)
            periods = 0 if found is None else found.count
        return source

    def frames(self, source: BenchRows | None, first: int, on_lag: Callable[[float], object]) -> Iterator[Frame]:
        """Yield what was read (`source`), from a number on, and then what comes; what waited for the start counts from
        now.
        """
        began = time.perf_counter()
        for block in () if source is None else source.replay.since(first):
            yield Frame(block=block, arrived_s=began)
        for frame in self._frames:
            yield replace(frame, arrived_s=max(frame.arrived_s, began))
            on_lag(time.perf_counter() - frame.arrived_s)


def _frames(queue: FrameQueue, *, real: bool) -> Iterator[Frame]:
    """Yield the frames of a queue until its end; of a device whose time is not the host's, as come when they are asked
    for.
    """
    while True:
        frame = queue.take(LOOK_S)
        if frame is not None:
            yield frame if real else replace(frame, arrived_s=time.perf_counter())
        elif queue.ended:
            return


def _too_short(runner: LiveRun, wanted_s: float, rate_hz: float) -> DeviceError:
    """End a run that gave too little to begin with, and say why it did."""
    runner.__exit__(None, None, None)
    report = runner.report()
    if report.interrupted:
        return DeviceError(f"the run was interrupted after {report.samples / rate_hz:.3g} s, before tracking began")
    why = "" if report.fault is None else f" ({fault_words(report.fault)})"
    return DeviceError(
        f"the stream ended after {report.samples / rate_hz:.3g} s{why}; tracking needs {wanted_s:g} s for its "
        "start. Run longer, or correct what ended it"
    )


class QueueTap:
    """Puts what a device samples into a queue, by the rig's `view`, numbered from its first sample, uncovered by
    calibration as NaN, rejected and counted. A real bench waits for nobody, and blocks lost to a full queue are
    counted; one that is only played is held up (`waits`) until it is `stopped`. `over`: set when nobody reads.
    """

    def __init__(
        self, queue: FrameQueue, view: BenchView, *, waits: bool, stopped: Callable[[], bool] = lambda: False
    ) -> None:
        self._queue, self._view, self._waits, self._stopped = queue, view, waits, stopped
        self._origin: int | None = None
        self.over = Signal()

    def take(self, frame: Frame) -> None:
        """Put a block into the queue. `frame`: as it came."""
        block = self._seen(frame.block)
        if self._origin is None:
            self._origin = block.first
        n = len(block.values)
        while self._waits and not (self.over.is_set() or self._stopped() or self._queue.wait_for_room(n, LOOK_S)):
            pass
        self._queue.put(replace(frame, block=replace(block, first=block.first - self._origin)))

    def _seen(self, raw: Block) -> Block:
        try:
            return self._view.block(raw)
        except AmbidError:
            return replace(raw, values=np.concatenate([self._row(raw, k) for k in range(len(raw.values))]))

    def _row(self, raw: Block, k: int) -> Array:
        try:
            return self._view.block(replace(raw, values=raw.values[k : k + 1])).values
        except AmbidError:
            return np.full((1, len(self._view.units)), np.nan)


class LiveRun:
    """The run `job` of the device, in a thread of its own, ended with the context, as is the `queue`; `recorded`:
    it goes on for others where tracking fails; `on_run`: given its result.
    """

    def __init__(
        self,
        job: Callable[..., RunReport],
        tap: QueueTap,
        queue: FrameQueue,
        stopped: Callable[[], bool],
        *,
        recorded: bool,
        on_run: Callable[[RunReport], object] | None,
        on_trouble: Callable[[AmbidError], object] | None,
    ) -> None:
        self._job, self._tap, self._queue, self._recorded = job, tap, queue, recorded
        self._on_run, self._on_trouble = on_run, on_trouble
        self._stopped, self._stop = stopped, Signal()
        self._report: RunReport | None = None
        self._failure: BaseException | None = None
        self._thread = Thread(target=self._run, name="acquisition", daemon=True)

    def __enter__(self) -> LiveRun:
        self._thread.start()
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self._tap.over.set()
        try:
            if isinstance(error, AmbidError) and self._recorded and self._thread.is_alive():
                if self._on_trouble is not None:
                    self._on_trouble(error)
                while self._thread.is_alive():  # a wait that Ctrl-C can end
                    self._thread.join(LOOK_S)
        finally:
            self._stop.set()
            self._thread.join()
            if self._on_run is not None and self._report is not None:
                self._on_run(self._report)
                self._on_run = None

    def report(self) -> RunReport:
        """Return the result of the run; raise what ended it."""
        if self._failure is not None:
            raise self._failure
        assert self._report is not None
        return self._report

    def _run(self) -> None:
        try:
            self._report = self._job(stopped=lambda: self._stop.is_set() or self._stopped())
        except BaseException as failure:
            self._failure = failure
        finally:
            self._queue.end()
