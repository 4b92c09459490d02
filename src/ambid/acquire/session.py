"""One run of a device: started, settled, excited, listened to for a time, stopped; nothing is lost uncounted.

Blocks go to taps (recorder, quality, ring to a tracker) in the order in which they came. A fault of the device ends the
run: what came before it has been passed on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from ambid.acquire.device import Device, DeviceEvent, Mode, Program
from ambid.errors import DeviceError
from ambid.track.stream.block import Block, Frame

_LOOK_S = 0.1  # how often a wait looks whether the run should end
_SILENT_LOOKS = 50  # without a sample: the line is dead. Looks, not seconds: a host that slept has not listened
_ENDING = ("fault",)  # kinds of events that end a run


class Tap(Protocol):
    """Whoever listens to a run."""

    def take(self, frame: Frame) -> None:
        """Take a block; must not keep the run waiting.

        Parameters
        ----------
        frame : Frame
            A block with its time of arrival.
        """
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """What a run is to do.

    Attributes
    ----------
    mode : {"sample", "drive", "levitate"}
    seconds : float
        Length of what is passed on, s of the device's clock.
    settle_s : float
        Time after the start that is not passed on: lift-off and its transient, s.
    program : Program or None
        Excitation; it begins with the part that is passed on.
    """

    mode: Mode
    seconds: float
    settle_s: float = 0.0
    program: Program | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RunReport:
    """What came of a run.

    Attributes
    ----------
    samples : int
        Passed on.
    wanted : int
        Samples that the course asks for.
    lost : int
        Samples of the wanted ones, up to the last one that came, that never came.
    first, after : int
        Number of the first sample that was passed on, and of the one after the last; equal where none was.
    fault : DeviceEvent or None
        What ended the run early.
    interrupted : bool
        Whether it was ended by request.
    events : tuple of DeviceEvent
        All that the device told meanwhile.
    """

    samples: int
    wanted: int
    lost: int
    first: int
    after: int
    fault: DeviceEvent | None
    interrupted: bool
    events: tuple[DeviceEvent, ...]

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
    """Let a device do a course, and pass on what it samples.

    Parameters
    ----------
    device : Device
        Opened, idle.
    course : Course
    taps : sequence of Tap
        Each is given every block, cut to the wanted part.
    on_event : callable, optional
        Told of each event of the device as it comes.
    stopped : callable, optional
        Asked between blocks; True ends the run in an orderly way.

    Returns
    -------
    RunReport

    Raises
    ------
    DeviceError
        If the device refuses the course, or the line falls silent. The device is stopped in any case.
    """
    made = _Run(device, course, taps, on_event)
    try:
        device.start(course.mode)
        made.settle(stopped)
        if made.going and course.program is not None:
            device.excite(course.program)
        made.listen(stopped)
    finally:
        device.stop()
        made.hear()
    return made.report()


class _Run:
    """The numbers of a run under way."""

    def __init__(
        self, device: Device, course: Course, taps: Sequence[Tap], on_event: Callable[[DeviceEvent], object] | None
    ) -> None:
        rate_hz = device.info.rate_hz
        self._device, self._taps, self._on_event = device, taps, on_event
        self._wanted = max(1, round(course.seconds * rate_hz))
        self._settling = round(course.settle_s * rate_hz)
        self._origin: int | None = None  # number of the first sample that came at all
        self._first: int | None = None
        self._after = 0
        self._samples = 0
        self._fault: DeviceEvent | None = None
        self._interrupted = False
        self._events: list[DeviceEvent] = []

    @property
    def going(self) -> bool:
        """Whether nothing has ended the run yet."""
        return self._fault is None and not self._interrupted

    def settle(self, stopped: Callable[[], bool]) -> None:
        """Let the first samples pass."""
        if self._settling:
            for block in self._frames(stopped):
                if block.block.first + len(block.block.values) >= self._start(block.block) + self._settling:
                    return

    def listen(self, stopped: Callable[[], bool]) -> None:
        """Pass blocks on until all wanted samples are there."""
        if not self.going:
            return
        for frame in self._frames(stopped):
            block = frame.block
            if self._first is None:
                # after a pause in the middle of a block: from the next whole one
                self._first = self._after = block.first
            end = self._first + self._wanted
            if block.first >= end:
                return
            kept = block if block.first + len(block.values) <= end else _cut(block, end - block.first)
            for tap in self._taps:
                tap.take(replace(frame, block=kept))
            self._samples += len(kept.values)
            self._after = kept.first + len(kept.values)
            if self._after >= end:
                return

    def hear(self) -> None:
        """Take what the device tells."""
        for event in self._device.events():
            self._events.append(event)
            if event.kind in _ENDING and self._fault is None:
                self._fault = event
            if self._on_event is not None:
                self._on_event(event)

    def report(self) -> RunReport:
        first = self._after if self._first is None else self._first
        return RunReport(
            samples=self._samples,
            wanted=self._wanted,
            lost=self._after - first - self._samples,
            first=first,
            after=self._after,
            fault=self._fault,
            interrupted=self._interrupted,
            events=tuple(self._events),
        )

    def _start(self, block: Block) -> int:
        if self._origin is None:
            self._origin = block.first
        return self._origin

    def _frames(self, stopped: Callable[[], bool]) -> Iterator[Frame]:
        """Blocks as they come, until a fault, a wish to end, or the device's own end."""
        silent = 0
        while True:
            if stopped():
                self._interrupted = True
                return
            frame = self._device.read(_LOOK_S)
            self.hear()
            if frame is not None:
                silent = 0
                block, fault = frame.block, self._fault
                if fault is not None and fault.sample is not None and fault.sample < block.first + len(block.values):
                    # What was sampled before the fault is sound; after it the bench is another one.
                    if fault.sample > block.first:
                        yield replace(frame, block=_cut(block, fault.sample - block.first))
                    return
                yield frame
                continue
            if self._fault is not None or self._device.ended:
                return
            silent += 1
            if silent > _SILENT_LOOKS:
                raise DeviceError(
                    f"{self._device.info.port}: no sample came for {_SILENT_LOOKS * _LOOK_S:g} s; the device should"
                    f" send {self._device.info.rate_hz:g} in a second. Look at cable and supply, and start again"
                )


def _cut(block: Block, n: int) -> Block:
    return replace(block, values=block.values[:n])
