"""The run of a device beside a tracker: in its own thread, seen through the rig, through a ring that never stops it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from threading import Event as Signal
from threading import Thread

import numpy as np

from ambid.acquire.device import Device, DeviceEvent
from ambid.acquire.session import Course, RunReport, Tap, run
from ambid.acquire.view import BenchView
from ambid.arrays import Array
from ambid.errors import AmbidError
from ambid.track.blocks import Block, Frame
from ambid.track.ring import BlockRing

LOOK_S = 0.1
"""How long a wait may last before it is looked whether it is still wanted, s."""


class RingTap:
    """Puts what a device samples into the ring, seen through the rig, numbered from its first sample.

    A bench of this world waits for nobody: blocks that find the ring full are counted. One that is only played runs
    ahead of the tracker, and is held up instead. Samples that a calibration does not cover go in as NaN, which the
    tracker rejects and counts.

    `view`: of device and rig; `waits`: whether the device may be held up.

    `over`: set when nobody reads the ring any more.
    """

    def __init__(self, ring: BlockRing, view: BenchView, *, waits: bool) -> None:
        self._ring, self._view, self._waits = ring, view, waits
        self._origin: int | None = None
        self.over = Signal()

    def take(self, frame: Frame) -> None:
        """Put a block into the ring.

        `frame`: as it came.
        """
        block = self._seen(frame.block)
        if self._origin is None:
            self._origin = block.first
        while self._waits and not self.over.is_set() and not self._ring.wait_for_room(LOOK_S):
            pass
        self._ring.put(replace(block, first=block.first - self._origin), frame.arrived_s)

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
    """The run of the device, in a thread of its own; leaving the context ends it.

    `device`, `course`, `on_event`, `stopped`: as `ambid.acquire.session.run`; `ring_tap`: hears last of all: who
    records is never behind the tracker; `taps`: the others; `on_run`: given what came of the run; `ring`: ended with
    the run.
    """

    def __init__(
        self,
        device: Device,
        course: Course,
        ring_tap: RingTap,
        taps: Sequence[Tap],
        on_event: Callable[[DeviceEvent], object] | None,
        on_run: Callable[[RunReport], object] | None,
        on_trouble: Callable[[AmbidError], object] | None,
        stopped: Callable[[], bool],
        ring: BlockRing,
    ) -> None:
        self._job = (device, course, (*taps, ring_tap), on_event)
        self._ring_tap = ring_tap
        self._on_run, self._on_trouble, self._stopped = on_run, on_trouble, stopped
        self._ring, self._stop = ring, Signal()
        self._report: RunReport | None = None
        self._failure: BaseException | None = None
        self._thread = Thread(target=self._run, name="acquisition", daemon=True)

    def __enter__(self) -> LiveRun:
        self._thread.start()
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        _, _, taps, _ = self._job
        self._ring_tap.over.set()
        try:
            if isinstance(error, AmbidError) and len(taps) > 1 and self._thread.is_alive():
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
        """Return what came of the run; raise what ended it."""
        if self._failure is not None:
            raise self._failure
        assert self._report is not None
        return self._report

    def _run(self) -> None:
        device, course, taps, on_event = self._job
        try:
            self._report = run(
                device, course, taps=taps, on_event=on_event, stopped=lambda: self._stop.is_set() or self._stopped()
            )
        except BaseException as failure:
            self._failure = failure
        finally:
            self._ring.end()
