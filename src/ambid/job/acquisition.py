"""The acquisition job: a device does a course, a recorder writes it down, quality is watched; a record results."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ambid.acquire.device import Counters, Device, DeviceEvent, DeviceInfo
from ambid.acquire.quality import Quality, QualityReport
from ambid.acquire.recorder import Event, JournalHeader, Recorded, Recorder
from ambid.acquire.session import Course, RunReport, Tap, run
from ambid.errors import DeviceError
from ambid.rig import Rig
from ambid.track.blocks import Frame


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """How far an acquisition is."""

    samples: int  # so far, and in all
    wanted: int
    quality: QualityReport  # of what came so far
    counters: Counters  # of the line


@dataclass(frozen=True, slots=True, kw_only=True)
class Acquired:
    """What an acquisition gave."""

    info: DeviceInfo  # who gave it
    run: RunReport  # of the device
    quality: QualityReport  # of the samples
    counters: Counters  # of the line
    recorded: Recorded | None  # the record's file; None where no sample came
    troubles: tuple[DeviceError, ...]  # what the recorder told: a disk that is slow, nearly full, or failed
    not_stored: int = 0  # samples that came and are not in the record, because the disk was too slow or failed


def acquire(
    device: Device,
    rig: Rig,
    path: str | Path,
    course: Course,
    *,
    force: bool = False,
    taps: Sequence[Tap] = (),
    every_s: float = 0.25,
    on_progress: Callable[[Progress], object] | None = None,
    on_event: Callable[[DeviceEvent], object] | None = None,
    on_trouble: Callable[[DeviceError], object] | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Acquired:
    """Record what a device samples during a course.

    `device`: opened, idle; `rig`: its bench; its text goes with the record; `path`: the record: .h5, .hdf5, .csv or
    .csv.gz; `course`: what the device is to do; `force`: whether a record that exists may be written over; `taps`:
    others who listen; `every_s`: how often `on_progress` is called, s of the device's clock; `on_progress`, `on_event`:
    told how far it is, and what the device tells. Returns also where a fault ended the run early: see ``run.fault``.
    """
    with recording(
        device, rig, path, course, force=force, every_s=every_s, on_progress=on_progress, on_event=on_event,
        on_trouble=on_trouble,
    ) as tap:  # fmt: skip
        report = run(
            device, course, taps=[tap, *taps], on_event=tap.tell, stopped=lambda: stopped() or tap.failed is not None
        )
    return tap.acquired(report)


@contextmanager
def recording(
    device: Device,
    rig: Rig,
    path: str | Path,
    course: Course,
    *,
    force: bool = False,
    every_s: float = 0.25,
    on_progress: Callable[[Progress], object] | None = None,
    on_event: Callable[[DeviceEvent], object] | None = None,
    on_trouble: Callable[[DeviceError], object] | None = None,
) -> Iterator[Recording]:
    """Record what a run passes on, whoever runs it.

    `device`, `rig`, `path`, `course`, `force`, `every_s`, `on_progress`, `on_event`, `on_trouble`: as `acquire`.
    Returns a tap of the run; on leaving, the journal becomes the record.
    """
    troubles: list[DeviceError] = []

    def trouble(what: DeviceError) -> None:
        troubles.append(what)
        if on_trouble is not None:
            on_trouble(what)

    recorder = Recorder(
        path, JournalHeader.of(device.info, _text(rig)), seconds=course.seconds, force=force, on_trouble=trouble
    )
    try:
        with recorder:
            if course.program is not None:
                recorder.event(Event(kind="excitation", what=str(course.program)))
            yield Recording(recorder, device, course, every_s, on_progress, on_event, troubles)
    except DeviceError as failure:
        if recorder.result is None:
            raise
        raise DeviceError(
            f"{failure}; {path} holds the {recorder.result.survey.samples} samples before it"
        ) from failure


def _text(rig: Rig) -> str:
    from ambid.rig import rig_text

    return rig_text(rig, Path.cwd() if rig.source is None else rig.source.resolve().parent)


class Recording:
    """A tap that gives blocks to recorder and quality, and tells how far it is. Made by `recording`.

    `recorder`: opened; `device`: that samples; `course`: what it does; `every_s`: how often `on_progress` is called, s
    of the device's clock; `on_progress`, `on_event`: as `acquire`; `troubles`: what the recorder tells.
    """

    def __init__(
        self,
        recorder: Recorder,
        device: Device,
        course: Course,
        every_s: float,
        on_progress: Callable[[Progress], object] | None,
        on_event: Callable[[DeviceEvent], object] | None,
        troubles: list[DeviceError],
    ) -> None:
        """Begin with nothing."""
        rate_hz = device.info.rate_hz
        self._recorder, self._device, self._troubles = recorder, device, troubles
        self._quality = Quality(device.info, course.program)
        self._on_progress, self._on_event = on_progress, on_event
        self._every, self._wanted = max(1, round(every_s * rate_hz)), round(course.seconds * rate_hz)
        self._samples = self._shown = 0

    @property
    def failed(self) -> DeviceError | None:
        """Why nothing more is stored; None as long as all is well."""
        return self._recorder.failed

    def take(self, frame: Frame) -> None:
        """Take a block.

        `frame`: as it came.
        """
        self._recorder.append(frame.block)
        self._quality.add(frame)
        self._samples += len(frame.block.values)
        if self._on_progress is not None and self._samples - self._shown >= self._every:
            self._shown = self._samples
            self._on_progress(
                Progress(
                    samples=self._samples,
                    wanted=self._wanted,
                    quality=self._quality.report(),
                    counters=self._device.counters(),
                )
            )

    def tell(self, event: DeviceEvent) -> None:
        """Take what the device tells.

        `event`: it goes into the record too.
        """
        self._recorder.event(event)
        if self._on_event is not None:
            self._on_event(event)

    def acquired(self, report: RunReport) -> Acquired:
        """Return what came of it, once the recording is closed.

        `report`: of the run. Returns with the record's file.
        """
        return Acquired(
            info=self._device.info,
            run=report,
            quality=self._quality.report(),
            counters=self._device.counters(),
            recorded=self._recorder.result,
            troubles=tuple(self._troubles),
            not_stored=self._recorder.lost_samples,
        )
