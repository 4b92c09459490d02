"""One run of a device: started, settled, excited, listened to, stopped, recorded. Taps get blocks in order, none lost
uncounted nor left from an earlier run; a fault ends the run, and what came before has been passed on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, TypedDict, Unpack

import numpy as np

from ambid.acquisition.device import AxesProgram, Counters, Device, DeviceEvent, DeviceInfo, LawTrial, Mode, Program
from ambid.acquisition.program import period_ticks
from ambid.acquisition.quality import Quality, QualityReport
from ambid.acquisition.recorder import JournalHeader, Recorded, Recorder
from ambid.errors import DeviceError
from ambid.estimation.result import Reason, Result
from ambid.record import Record, read_record
from ambid.rig import Rig
from ambid.tracking.blocks import Block, Frame

_LOOK_S = 0.1  # how often a wait looks whether the run should end
_SILENT_LOOKS = 50  # without a sample: the line is dead. Looks, not seconds: a host that slept has not listened
_LONGEST_LEAD_S = 1.0  # of excitation before samples are passed on
_LONGEST_WAIT_S = 10.0  # of samples until an excitation shows
_ENDING = ("fault",)  # kinds of events that end a run


class Tap(Protocol):
    """Whoever listens to a run."""

    def take(self, frame: Frame) -> None:
        """Take a block with its time of arrival; must not keep the run waiting."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """What a run is to do."""

    mode: Mode
    seconds: float  # length of what is passed on, s of the device's clock
    settle_s: float = 0.0  # time after the start that is not passed on: lift-off and its transient, s
    # excitation. It begins one period, at most a second, before the part that is passed on: what is passed on is
    # periodic from its first sample.
    program: Program | AxesProgram | None = None
    trial: LawTrial | None = None  # another law, tried and confirmed after the settling
    # pass on all of it, the settling too; `seconds` then count from the excitation's first sample on
    transient: bool = False


@dataclass(slots=True, kw_only=True)
class RunReport:
    """The result of a run; counted while it goes on."""

    wanted: int  # samples that the course asks for
    samples: int = 0  # passed on
    # samples of the wanted ones, up to the last one that came, that never came; those that come again make up for none
    lost: int = 0
    first: int = 0  # number of the first sample that was passed on, and of the one after the last; equal where none was
    after: int = 0
    fault: DeviceEvent | None = None  # what ended the run early
    interrupted: bool = False  # whether it was ended by request
    events: tuple[DeviceEvent, ...] = ()  # all that the device told meanwhile

    @property
    def complete(self) -> bool:
        """Whether every wanted sample came."""
        return self.samples == self.wanted


def run(
    device: Device,
    course: Course,
    *,
    taps: Sequence[Tap],
    on_event: Callable[[DeviceEvent], object] | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> RunReport:
    """Let an opened, idle device do a course; each tap gets every block, cut to the wanted part, `on_event` each event.
    `stopped` is asked between blocks; True ends the run in an orderly way.
    """
    state = _Run(device, course, taps, on_event)
    try:
        state.forget()
        if course.transient and course.program is not None:
            device.load(course.program)
        state.report.interrupted = stopped()  # while the device was opened: its output stays off
        if state.going:
            device.start(course.mode)
            state.settle(stopped, passed_on=course.transient)
        if state.going and course.trial is not None:
            state.arm(course.trial, stopped)
        if state.going and course.program is not None:
            device.excite(course.program)
            state.lead_in(course.program, passed_on=course.transient)
        state.listen(stopped)
    except BaseException:
        with suppress(DeviceError):  # a line that is lost cannot be told to stop; what went wrong first is raised
            device.stop()
        state.hear()
        raise
    device.stop()
    state.hear()
    return state.report


class _Run:
    """The numbers of a run under way."""

    def __init__(
        self, device: Device, course: Course, taps: Sequence[Tap], on_event: Callable[[DeviceEvent], object] | None
    ) -> None:
        self._rate_hz = rate_hz = device.info.rate_hz
        self._device, self._taps, self._on_event = device, taps, on_event
        self._wanted = max(1, round(course.seconds * rate_hz))
        self.report = RunReport(wanted=self._wanted)
        self._settling = round(course.settle_s * rate_hz)
        roles = [c.role for c in device.info.columns]  # of a rotor each axis has a reference
        self._excited = [k for k, r in enumerate(roles) if r == "excitation" or r.endswith("_reference")]
        self._lead: int | None = None  # ticks of excitation that are still to pass before samples are passed on
        self._awaited = False  # whether the excitation is waited for, and what comes meanwhile is passed on
        self._unheard = 0
        self._from: int | None = None  # number from which samples are passed on, once that is known

    @property
    def going(self) -> bool:
        """Whether nothing has ended the run yet."""
        return self.report.fault is None and not self.report.interrupted

    def forget(self) -> None:
        """Throw away what an earlier run left unread: its samples are of another course."""
        while self._device.read(0.0) is not None:
            pass

    def settle(self, stopped: Callable[[], bool], *, passed_on: bool) -> None:
        """Let the first samples pass, unseen unless `passed_on`."""
        settled = None
        for frame in self._frames(stopped) if self._settling else ():
            block = frame.block
            settled = block.first + self._settling if settled is None else settled
            if passed_on:
                self._extend(block, None)
                self._pass_on(frame, block)
            if block.first + len(block.values) >= settled:
                return

    def arm(self, trial: LawTrial, stopped: Callable[[], bool]) -> None:
        """Try another law, unseen, and keep it unless the controller does not."""
        until: int | None = None
        self._device.arm(trial)
        for frame in self._frames(stopped):
            if back := next((e for e in self.report.events if e.kind == "law"), None):
                raise DeviceError(
                    f"{self._device.info.port}: the controller returned to the loop that it ran before: {back.what} "
                    f"(sample {back.sample}). It kept levitating; nothing was recorded. Design the law again, or widen "
                    "its bounds"
                )
            until = until or frame.block.first + round(trial.seconds * self._rate_hz)
            if frame.block.first >= until:
                self._device.confirm()
                return

    def listen(self, stopped: Callable[[], bool]) -> None:
        """Pass blocks on until all wanted samples are there."""
        if not self.going:
            return
        self.report.wanted = self.report.after - self.report.first + self._wanted
        for frame in self._frames(stopped):
            block = self._after_lead(frame.block)
            if block is not None and self._pass_on(frame, block):
                return

    def _pass_on(self, frame: Frame, block: Block) -> bool:
        """Give the taps what of a block is wanted; whether that was the last."""
        report = self.report
        if not report.samples:
            report.first = report.after = block.first
        end = report.first + report.wanted
        if block.first >= end:
            return True
        part = block if block.first + len(block.values) <= end else _cut(block, end - block.first)
        passed = frame if part is frame.block else replace(frame, block=part)
        for tap in self._taps:
            tap.take(passed)
        report.samples += len(part.values)
        report.lost += max(0, part.first - report.after)
        report.after = max(report.after, part.first + len(part.values))
        return report.after >= end

    def lead_in(self, program: Program | AxesProgram, *, passed_on: bool) -> None:
        """Let the excitation settle before samples are passed on; `passed_on`: wait for it, but pass all on."""
        self._awaited = passed_on and bool(self._excited)
        if self._excited and not passed_on:
            self._lead = min(period_ticks(program), round(_LONGEST_LEAD_S * self._rate_hz))

    def _after_lead(self, block: Block) -> Block | None:
        """Return what of a block comes after the lead; what was under way when the excitation was ordered does not."""
        if self._awaited:
            begins = self._begin(block)
            self._awaited = begins is None
            self._extend(block, begins)
            return block
        if self._lead is None:
            return block
        if self._from is None:
            begins = self._begin(block)
            if begins is None:
                return None
            self._from = block.first + begins + self._lead
        passed = self._from - block.first
        if passed >= len(block.values):
            return None
        if passed <= 0:
            return block
        later = block.time_s + passed / self._rate_hz
        return Block(first=self._from, time_s=later, values=block.values[passed:])

    def _begin(self, block: Block) -> int | None:
        """Return at which sample of a block the excitation is seen first; None where it is not."""
        plays = np.flatnonzero(block.values[:, self._excited].any(axis=1))
        if plays.size:
            return int(plays[0])
        self._unheard += len(block.values)
        if self._unheard > _LONGEST_WAIT_S * self._rate_hz:
            raise DeviceError(
                f"{self._device.info.port}: the excitation was started but is not visible in {_LONGEST_WAIT_S:g} s "
                "of samples. Give a larger amplitude"
            )
        return None

    def _extend(self, block: Block, begins: int | None) -> None:
        """Want all of a block before the excitation; from where it `begins` what was wanted of the course."""
        before = block.first - (self.report.first if self.report.samples else block.first)
        self.report.wanted = before + (len(block.values) + 1 if begins is None else begins + self._wanted)

    def hear(self) -> None:
        """Take what the device tells."""
        for event in self._device.events():
            self.report.events += (event,)
            if event.kind in _ENDING and self.report.fault is None:
                self.report.fault = event
            if self._on_event is not None:
                self._on_event(event)

    def _frames(self, stopped: Callable[[], bool]) -> Iterator[Frame]:
        """Blocks as they come, until a fault, a wish to end, or the device's own end."""
        silent = 0
        while True:
            if stopped():
                self.report.interrupted = True
                return
            frame = self._device.read(_LOOK_S)
            self.hear()
            if frame is not None:
                silent = 0
                sound = _before(frame, self.report.fault)
                if sound is not None:
                    yield sound
                if sound is not frame:
                    return
                continue
            if self.report.fault is not None or self._device.ended:
                return
            silent += 1
            if silent > _SILENT_LOOKS:
                raise DeviceError(
                    f"{self._device.info.port}: no sample came for {_SILENT_LOOKS * _LOOK_S:g} s; the device "
                    f"should send {self._device.info.rate_hz:g} per second. Check cable and supply, and start again"
                )


def _before(frame: Frame, fault: DeviceEvent | None) -> Frame | None:
    """Return what of a block was sampled before a fault: that is sound; after it the bench is another one."""
    block = frame.block
    if fault is None or (fault.sample is not None and fault.sample >= block.first + len(block.values)):
        return frame
    if fault.sample is None or fault.sample <= block.first:
        return None
    return replace(frame, block=_cut(block, fault.sample - block.first))


def _cut(block: Block, n: int) -> Block:
    return replace(block, values=block.values[:n])


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
        reasons, run = list[Reason](), self.run
        if self.recorded is None:
            text = "nothing was recorded. Look at cable and supply, and record again"
            reasons.append(Reason(check="samples", text=text, grave=True))
        if run.fault is not None:
            text = f"the controller went to its safe state: {run.fault.what}. Remove the cause, and record again"
            reasons.append(Reason(check="fault", text=text))
        elif not run.complete and not run.lost:
            text = f"{run.samples} of {run.wanted} samples came before the end. Record again if they are too few"
            reasons.append(Reason(check="complete", text=text))
        if self.not_stored:
            text = f"{self.not_stored} samples are not in the record: the disk was too slow or failed. Make room"
            reasons.append(Reason(check="stored", text=text))
        return (*reasons, *self.quality.faults)


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
    force : bool, optional
        Whether a record that exists may be written over.
    taps : sequence of Tap, optional
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
    """Yield a tap that records, as `acquire`, what anybody's run passes on; on leaving, the record is made."""
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
        self.stored = False  # whether the last block found room

    @property
    def failed(self) -> DeviceError | None:
        """Why nothing more is stored; None as long as all is well."""
        return self._recorder.failed

    @property
    def written(self) -> int:
        """Number of the sample up to which a kill of this process loses nothing of what it `stored`."""
        return self._recorder.written

    def take(self, frame: Frame) -> None:
        """Take a block as it came."""
        self.stored = self._recorder.append(frame.block)
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
