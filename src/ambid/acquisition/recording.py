"""The acquisition job: a device does a course, a recorder writes it down, quality is watched; a record results."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict, Unpack

from ambid.acquisition.device import Counters, Device, DeviceEvent, DeviceInfo
from ambid.acquisition.quality import Quality, QualityReport
from ambid.acquisition.recorder import JournalHeader, Recorded, Recorder
from ambid.acquisition.session import Course, RunReport, Tap, run
from ambid.errors import DeviceError
from ambid.estimation.result import Reason, Result
from ambid.record import Record, read_record
from ambid.rig import Rig
from ambid.tracking.blocks import Frame


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """How far an acquisition is."""

    samples: int  # so far, and in all
    wanted: int
    quality: QualityReport  # of what came so far
    counters: Counters  # of the line


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Acquired(Result):
    """What an acquisition gave, file schema ``ambid.acquisition/1``."""

    info: DeviceInfo  # who gave it
    run: RunReport  # of the device
    quality: QualityReport  # of the samples
    counters: Counters  # of the line
    recorded: Recorded | None  # the record's file; None where no sample came
    troubles: tuple[DeviceError, ...]  # what the recorder told: a disk that is slow, nearly full, or failed
    not_stored: int = 0  # samples that came and are not in the record, because the disk was too slow or failed

    @property
    def record(self) -> Record:
        """What was written, read back."""
        if self.recorded is None:
            raise DeviceError(f"{self.info.port}: nothing was recorded. Look at `run`, which says why")
        return read_record(self.recorded.path)

    @property
    def stored(self) -> int:
        """Samples in the record."""
        return self.run.samples - self.not_stored - self.quality.repeated

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """A run that ended early, samples that are not in the record, and what is not good enough of the others."""
        found, run = list[Reason](), self.run
        if self.recorded is None:
            text = "nothing was recorded. Look at cable and supply, and record again"
            found.append(Reason(check="samples", text=text, grave=True))
        if run.fault is not None:
            text = f"the controller went to its safe state: {run.fault.what}. Remove the cause, and record again"
            found.append(Reason(check="fault", text=text))
        elif not run.complete and not run.lost:
            text = f"{run.samples} of {run.wanted} samples came before the end. Record again if they are too few"
            found.append(Reason(check="complete", text=text))
        if self.not_stored:
            text = f"{self.not_stored} samples are not in the record: the disk was too slow or failed. Make room"
            found.append(Reason(check="stored", text=text))
        return (*found, *self.quality.faults)


class Listeners(TypedDict, total=False):
    """Who is told how a run goes."""

    every_s: float  # how often `on_progress` is called, s of the device's clock
    on_progress: Callable[[Progress], object]
    on_event: Callable[[DeviceEvent], object]  # what the device tells
    on_trouble: Callable[[DeviceError], object]  # what the recorder tells


def acquire(
    device: Device,
    rig: Rig,
    path: str | Path,
    course: Course,
    *,
    force: bool = False,
    taps: Sequence[Tap] = (),
    stopped: Callable[[], bool] = lambda: False,
    **listeners: Unpack[Listeners],
) -> Acquired:
    """Record what a device samples during a course.

    Parameters
    ----------
    device : Device
        Opened, idle.
    rig : Rig
        Its bench; its text goes with the record.
    path : str or Path
        The record: .h5, .hdf5, .csv or .csv.gz.
    course : Course
        What the device is to do.
    force : bool, optional
        Whether a record that exists may be written over.
    taps : sequence of Tap, optional
        Others who listen.
    stopped : callable, optional
        Asked now and then; True ends the run.
    **listeners
        See `Listeners`.

    Returns
    -------
    Acquired
        Also where a fault ended the run early: see ``run.fault``.

    Raises
    ------
    DeviceError
        If the device or the disk fails.
    """
    with recording(device, rig, path, course, force=force, **listeners) as tap:
        report = run(
            device, course, taps=[tap, *taps], on_event=tap.tell, stopped=lambda: stopped() or tap.failed is not None
        )
    return tap.acquired(report)


@contextmanager
def recording(
    device: Device, rig: Rig, path: str | Path, course: Course, *, force: bool = False, **listeners: Unpack[Listeners]
) -> Iterator[Recording]:
    """Record what a run passes on, whoever runs it: yield a tap of the run; on leaving, the journal becomes the record.

    Arguments as those of `acquire`.
    """
    troubles: list[DeviceError] = []

    def trouble(what: DeviceError) -> None:
        troubles.append(what)
        if "on_trouble" in listeners:
            listeners["on_trouble"](what)

    recorder = Recorder(
        path, JournalHeader.of(device.info, _text(rig)), seconds=course.seconds, force=force, on_trouble=trouble
    )
    try:
        with recorder:
            if course.program is not None:
                recorder.event(DeviceEvent(kind="excitation", what=str(course.program)))
            yield Recording(recorder, device, course, listeners, troubles)
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
    """A tap that gives blocks to recorder and quality, and tells how far it is. Made by `recording`."""

    def __init__(
        self, recorder: Recorder, device: Device, course: Course, listeners: Listeners, troubles: list[DeviceError]
    ) -> None:
        """Begin with nothing."""
        rate_hz = device.info.rate_hz
        self._recorder, self._device, self._troubles = recorder, device, troubles
        self._quality = Quality(device.info, course.program)
        self._on_progress, self._on_event = listeners.get("on_progress"), listeners.get("on_event")
        self._every = max(1, round(listeners.get("every_s", 0.25) * rate_hz))
        self._wanted = round(course.seconds * rate_hz)
        self._samples = self._shown = 0

    @property
    def failed(self) -> DeviceError | None:
        """Why nothing more is stored; None as long as all is well."""
        return self._recorder.failed

    def take(self, frame: Frame) -> None:
        """Take a block as it came."""
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
        """Take what the device tells; it goes into the record too."""
        self._recorder.event(event)
        if self._on_event is not None:
            self._on_event(event)

    def acquired(self, report: RunReport) -> Acquired:
        """Return the result of a run, once the recording is closed."""
        return Acquired(
            info=self._device.info,
            run=report,
            quality=self._quality.report(),
            counters=self._device.counters(),
            recorded=self._recorder.result,
            troubles=tuple(self._troubles),
            not_stored=self._recorder.lost_samples,
        )
