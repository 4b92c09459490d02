"""The thread that writes: batches of frames, a sync at its time, acknowledgement, and a look at the disk."""

from __future__ import annotations

import contextlib
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from ambid.acquire.recorder.disk import REMOVED, JournalFile, disk_error, free_bytes
from ambid.acquire.recorder.layout import (
    BLOCK,
    CLOSE,
    EVENT,
    HEADER,
    Event,
    Head,
    JournalHeader,
    event_frame,
    frame_bytes,
    json_bytes,
    preamble,
)
from ambid.errors import DeviceError

_EVENTS = 10_000  # that may wait
_LOOK_S = 1.0  # how often the disk is looked at
_HEADER_EVERY = 16 << 20  # bytes after which the header is written again: damage at the beginning costs no more
_HEADER_AGAIN = 16 << 10  # the same at first, four times as many each time: no single bad sector hits every header
_NOTHING_LOST = "What is on the disk stays in the journal"


Item = tuple[Head, bytes]
"""A frame that has no number yet, and its payload."""


class WriteQueue:
    """Frames on their way from the caller's thread to the writer's."""

    def __init__(self, room: int) -> None:
        self._room = room
        self._lock = threading.Lock()
        self._items: deque[Item] = deque()
        self._samples = 0  # in the queue, or being written
        self._events = 0
        self._gap: list[int] | None = None  # first sample, samples and blocks that found no room since the last put
        self.blocks = self.lost_samples = self.lost_events = 0

    def has_room(self, n: int) -> bool:
        """Whether `n` samples more fit; a block longer than the queue fits an empty one."""
        return self._samples == 0 or self._samples + n <= self._room

    def overrun(self, first: int, n: int) -> None:
        """Count a block that found no room."""
        with self._lock:
            self.lost_samples += n
            if self._gap is None:
                self._gap = [first, 0, 0]
            self._gap[1] += n
            self._gap[2] += 1

    def count_lost(self, n: int) -> None:
        """Count samples that came when nothing is stored any more."""
        with self._lock:
            self.lost_samples += n

    def put(self, item: Item) -> None:
        """Add a frame, after the mark of what was lost before it."""
        with self._lock:
            self._mark_gap()
            if item[0].kind == EVENT:
                if self._events >= _EVENTS:
                    self.lost_events += 1
                    return
                self._events += 1
            else:
                self._samples += item[0].n_samples
                self.blocks += 1
            self._items.append(item)

    def take(self, *, last: bool = False) -> list[Item]:
        """Take out everything; `last`: the mark of what was lost at the end too."""
        with self._lock:
            if last:
                self._mark_gap()
            items = list(self._items)
            self._items.clear()
            self._events = 0
            return items

    def written(self, n: int) -> None:
        """Make room for `n` samples."""
        with self._lock:
            self._samples -= n

    def _mark_gap(self) -> None:
        if self._gap is None:
            return
        first, samples, blocks = self._gap
        self._gap = None
        what = f"{blocks} blocks found no room in the queue: the disk was too slow"
        self._items.append(event_frame(Event(kind="lost", what=what, sample=first, count=samples)))


class JournalWriter:
    """Everything that happens to the file of a journal while it is recorded."""

    def __init__(
        self,
        queue: WriteQueue,
        header: JournalHeader,
        *,
        sync_s: float,
        write_s: float,
        least_free: int,
        on_acknowledged: Callable[[int], object] | None,
        on_trouble: Callable[[DeviceError], object] | None,
    ) -> None:
        self._queue, self._sync_s, self._write_s, self._least_free = queue, sync_s, write_s, least_free
        self._header = json_bytes(header.as_json())
        self._on_acknowledged, self._on_trouble = on_acknowledged, on_trouble
        self._journal = secrets.randbits(64)
        self._frames = self._block = 0
        self._header_at, self._header_every = 0, min(_HEADER_AGAIN, _HEADER_EVERY)
        self._file: JournalFile | None = None
        self._thread = threading.Thread(target=self._run, name="ambid-recorder", daemon=True)
        self._wake = threading.Condition()
        self._closing = self._urgent = False
        self._unsynced = False
        self.removed = False
        self._told: set[str] = set()
        self._fault: Exception | None = None
        self.acknowledged = 0
        self.lost_samples = 0  # taken from the queue and not written
        self.failed: DeviceError | None = None

    @property
    def started(self) -> bool:
        return self._file is not None

    def start(self, file: JournalFile) -> None:
        """Write the header, bring it to the disk, and begin."""
        self._file = file
        try:
            file.write(preamble() + self._header_frame())
            file.sync()
        except OSError as failure:
            self._file = None
            file.remove()
            file.close()
            raise disk_error(f"{file.path} cannot be written", failure) from None
        self._thread.start()

    def end(self) -> JournalFile:
        """Write what is left and the closing frame, and give the file back."""
        with self._wake:
            self._closing = True
            self._wake.notify_all()
        self._thread.join()
        assert self._file is not None
        return self._file

    def flush(self, blocks: int, timeout_s: float) -> bool:
        """Wait until `blocks` are acknowledged."""
        with self._wake:
            self._urgent = True
            self._wake.notify_all()
            self._wake.wait_for(lambda: self.acknowledged >= blocks or self.failed or self.removed, timeout_s)
        return self.acknowledged >= blocks

    def raise_fault(self) -> None:
        """Raise what a callback raised."""
        if self._fault is not None:
            raise self._fault

    def _run(self) -> None:
        try:
            self._work()
        except Exception as failure:  # a defect, but the recording must not go on as if all were well
            self._fault = self._fault or failure
            self._fail(DeviceError(f"the recorder stopped: {type(failure).__name__}: {failure}. {_NOTHING_LOST}"))

    def _work(self) -> None:
        sync_due = look_due = time.monotonic()
        closing = False
        while not closing:
            with self._wake:
                if not (self._closing or self._urgent):
                    self._wake.wait(self._write_s)
                closing, urgent, self._urgent = self._closing, self._urgent, False
            now = time.monotonic()
            self._write(self._queue.take(last=closing))
            if closing:
                self._close()
            if closing or urgent or now >= sync_due:
                self._sync()
                sync_due = now + self._sync_s
            if now >= look_due:
                self._look()
                look_due = now + _LOOK_S

    def _write(self, items: list[Item]) -> None:
        """Write a batch in one piece; after a failure count what is not stored."""
        samples = sum(head.n_samples for head, _ in items)
        if self.failed is not None:
            self.lost_samples += samples
        elif items:
            before = self._open.size
            frames = [self._frame(*item) for item in items]
            if before - self._header_at > self._header_every:
                self._header_at, self._header_every = before, min(4 * self._header_every, _HEADER_EVERY)
                frames.append(self._header_frame())
            try:
                self._open.write(b"".join(frames))
                self._unsynced = True
            except OSError as failure:
                self._broken(failure, items, frames, before)
        self._queue.written(samples)

    def _broken(self, failure: OSError, items: list[Item], frames: list[bytes], before: int) -> None:
        """Acknowledge what was written whole before the disk failed, and count the rest."""
        end = before
        for (head, _), frame in zip(items, frames, strict=False):
            end += len(frame)
            if head.kind == BLOCK and end > self._open.size:
                self._block -= 1
                self.lost_samples += head.n_samples
        self._unsynced = True
        self._sync()
        self._fail(disk_error(f"{self._open.path} cannot be written", failure, _NOTHING_LOST))

    def _sync(self) -> None:
        """Bring what was written to the disk, and acknowledge it."""
        if self.failed or not self._unsynced:
            return
        try:
            self._open.sync()
        except OSError as failure:  # what became of the pages is not known: nothing more can be acknowledged
            self._fail(disk_error(f"{self._open.path} cannot be brought to the disk", failure, _NOTHING_LOST))
            return
        self._unsynced = False
        self._look_at_file()
        if self.removed:
            return
        with self._wake:
            new = self._block > self.acknowledged
            self.acknowledged = self._block
            self._wake.notify_all()
        if new and self._on_acknowledged is not None:
            told = self._on_acknowledged
            self._call(lambda: told(self.acknowledged))

    def _close(self) -> None:
        """Say in the journal that it is complete."""
        if self.failed is not None:
            return
        totals = {
            "blocks": self._block,
            "lost_samples": self._queue.lost_samples,
            "lost_events": self._queue.lost_events,
        }
        try:
            self._open.write(self._frame(Head(kind=CLOSE), json_bytes(totals)))
            self._unsynced = True
        except OSError as failure:
            self._broken(failure, [], [], self._open.size)

    def _look(self) -> None:
        """Tell of a disk that is nearly full while there is still time, and of a file that is gone."""
        if self.failed is not None:
            return
        self._look_at_file()
        with contextlib.suppress(OSError):
            free = free_bytes(self._open.path.parent)
            if free < self._least_free:
                self.trouble("disk", f"the disk of {self._open.path} is nearly full: {free / 1e6:.0f} MB left."
                              " Make room, or end the recording")  # fmt: skip

    def _look_at_file(self) -> None:
        fault = self._open.fault()
        if fault == REMOVED:
            with self._wake:
                self.removed = True
                self._wake.notify_all()
            self.trouble(fault, f"journal {self._open.path} {fault}; the recording goes on in the open file, and is"
                          " lost if this program is killed. End it in order: it is then saved as a record")  # fmt: skip
        elif fault:
            self.trouble(fault, f"journal {self._open.path} {fault}. Put it right before the recording ends")

    def trouble(self, kind: str, message: str) -> None:
        """Tell of trouble, once for each kind until `over`."""
        if kind not in self._told:
            self._told.add(kind)
            self._tell(DeviceError(message))

    def over(self, kind: str) -> None:
        """Let trouble of this kind be told again."""
        self._told.discard(kind)

    def _fail(self, error: DeviceError) -> None:
        with self._wake:
            self.failed = self.failed or error
            self._wake.notify_all()
        self._tell(error)

    def _tell(self, error: DeviceError) -> None:
        if self._on_trouble is not None:
            told = self._on_trouble
            self._call(lambda: told(error))

    def _call(self, callback: Callable[[], object]) -> None:
        """Call what the caller gave; its own failure is kept for the end, and does not stop the recording."""
        try:
            callback()
        except Exception as failure:
            self._fault = self._fault or failure

    def _frame(self, head: Head, payload: bytes) -> bytes:
        """Number a frame and put it together."""
        head = replace(head, journal=self._journal, frame=self._frames, block=self._block, length=len(payload))
        self._frames += 1
        self._block += head.kind == BLOCK
        return frame_bytes(head, payload)

    def _header_frame(self) -> bytes:
        return self._frame(Head(kind=HEADER), self._header)

    @property
    def _open(self) -> JournalFile:
        assert self._file is not None
        return self._file
