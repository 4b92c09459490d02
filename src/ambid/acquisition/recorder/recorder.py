"""The recorder: blocks go through a bounded queue to a journal beside the wanted file, at the end a record; nobody
waits. A block on the disk is acknowledged, safe from kill and power cut; one without room is counted, told and marked.
"""

from __future__ import annotations

import contextlib
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from ambid.acquisition.device import DeviceEvent
from ambid.acquisition.recorder.convert import JournalReader, Recorded, check_target, recorded_from
from ambid.acquisition.recorder.journal import (
    BLOCK,
    CLOSE,
    EVENT,
    HEADER,
    LARGEST,
    REMOVED,
    Head,
    JournalFile,
    JournalHeader,
    disk_error,
    event_frame,
    frame_bytes,
    free_bytes,
    journal_path,
    json_bytes,
    packed_values,
    preamble,
)
from ambid.errors import DeviceError
from ambid.tracking.blocks import Block

_LEAST_FREE = 16 << 20  # bytes that are to be left on the disk
_AHEAD_S = 10.0  # a disk that would be full in this time is told
_EVENTS = 10_000  # that may wait
_LOOK_S = 1.0  # how often the disk is looked at
_HEADER_EVERY = 16 << 20  # bytes after which the header is written again: damage at the beginning costs no more
_HEADER_AGAIN = 16 << 10  # the same at first, four times as many each time: no single bad sector hits every header
_BEFORE_ALL = -(2**62)
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
        self._items.append(event_frame(DeviceEvent(kind="lost", what=what, sample=first, count=samples)))


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
        self.written = _BEFORE_ALL  # number of the sample after the last one that a kill of this process cannot undo
        self.lost_samples = 0  # taken from the queue and not written
        self.failed: DeviceError | None = None

    @property
    def started(self) -> bool:
        """Whether there is a file to write to."""
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
                self.written = max([self.written, *(h.first + h.n_samples for h, _ in items if h.kind == BLOCK)])
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
            callback = self._on_acknowledged
            self._call(lambda: callback(self.acknowledged))

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
            callback = self._on_trouble
            self._call(lambda: callback(error))

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


class Recorder:
    """A recording: a context that makes the journal, and at its end the record. One thread may append.

    It writes every `write_s` s, all that a kill costs; the disk may stall for `queue_s` s before blocks find no room.
    `on_trouble` gets a `DeviceError` at once, in the thread that sees it; `result` is None until closed, or if nothing
    came.
    """

    def __init__(
        self,
        path: str | Path,
        header: JournalHeader,
        *,
        sync_s: float = 0.5,
        write_s: float = 0.05,
        queue_s: float = 10.0,
        seconds: float | None = None,
        force: bool = False,
        on_acknowledged: Callable[[int], object] | None = None,
        on_trouble: Callable[[DeviceError], object] | None = None,
        open_file: Callable[[Path], JournalFile] = JournalFile,
    ) -> None:
        self.path = Path(path)
        self.journal = journal_path(self.path)
        self.result: Recorded | None = None
        self._header, self._force, self._seconds, self._open_file = header, force, seconds, open_file
        self._queue = WriteQueue(max(1, round(queue_s * header.rate_hz)))
        self._writer = JournalWriter(
            self._queue, header, sync_s=sync_s, write_s=min(write_s, sync_s), least_free=self._reserve(),
            on_acknowledged=on_acknowledged, on_trouble=on_trouble,
        )  # fmt: skip
        self._next: int | None = None
        self._closed = False

    def __enter__(self) -> Self:
        """Make the journal."""
        check_target(self.path, self._header, force=self._force)
        self._check_room()
        self._writer.start(self._open_file(self.journal))
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def acknowledged(self) -> int:
        """Number of blocks that are on the disk, counted from the first one that was taken."""
        return self._writer.acknowledged

    @property
    def written(self) -> int:
        """Number of the sample up to which the system has all that found room: a kill of this process loses none."""
        return self._writer.written

    @property
    def blocks(self) -> int:
        """Number of blocks that were taken."""
        return self._queue.blocks

    @property
    def lost_samples(self) -> int:
        """Samples that were appended and are not in the journal: no room, or after the disk had failed."""
        return self._queue.lost_samples + self._writer.lost_samples

    @property
    def failed(self) -> DeviceError | None:
        """Why nothing more is stored; None as long as all is well."""
        return self._writer.failed

    def append(self, block: Block) -> bool:
        """Take a block without waiting for the disk; return False, and count it, if there is no room or the disk has
        failed.
        """
        values = self._checked(block)
        n = len(values)
        if n == 0:
            return True
        if self._next is not None and block.first < self._next:
            what = f"numbers of samples went back from {self._next} to {block.first}"
            self.event(DeviceEvent(kind="note", what=what, sample=int(block.first)))
        self._next = block.first + n
        if self._writer.failed or self._closed:
            self._queue.count_lost(n)
            return False
        if not self._queue.has_room(n):
            self._queue.overrun(block.first, n)
            self._writer.trouble("slow", f"the disk of {self.journal} is too slow: samples are lost from number"
                                 f" {block.first} on. They are counted; end what else uses the disk")  # fmt: skip
            return False
        self._writer.over("slow")
        code, payload = packed_values(values)
        head = Head(
            kind=BLOCK, first=int(block.first), time_s=float(block.time_s), n_samples=n, n_columns=values.shape[1],
            dtype=code,
        )  # fmt: skip
        self._queue.put((head, payload))
        return True

    def event(self, event: DeviceEvent) -> None:
        """Put something that happened into the journal, in its place between the blocks."""
        self._queue.put(event_frame(event))

    def flush(self, timeout_s: float = 60.0) -> bool:
        """Wait at most `timeout_s` until everything taken is on the disk; return whether it is."""
        return self._writer.flush(self._queue.blocks, timeout_s)

    def close(self) -> Recorded | None:
        """End the recording: journal to record, read back, and only then the journal removed; None, and no file, if
        nothing came.

        Whatever goes wrong, Ctrl-C included, leaves the journal for ``ambid recover``. So do a disk that had failed,
        from which reading back proves little, and a journal that holds more than the record.
        """
        if self._closed or not self._writer.started:
            return self.result
        self._closed = True
        file = self._writer.end()
        try:
            reader = JournalReader(file.read, file.size, self.journal)
            extra = {"not_stored": self._writer.lost_samples} if self._writer.lost_samples else {}
            self.result = recorded_from(reader, self.path, force=self._force, extra=extra)
            if self.result is None or not (self.result.keep_journal or self.failed):
                file.remove()
        except DeviceError as failure:
            if "ambid recover" in str(failure) or not self.journal.exists():
                raise
            raise DeviceError(
                f"{str(failure).rstrip('.')}. What was recorded is in {self.journal}: ambid recover {self.journal}"
                " -o NAME"
            ) from None
        finally:
            file.close()
        self._writer.raise_fault()
        return self.result

    def _checked(self, block: Block) -> np.ndarray[Any, np.dtype[np.float64]]:
        values = np.asarray(block.values, dtype=np.float64)
        columns = len(self._header.columns)
        if values.ndim != 2 or values.shape[1] != columns or values.nbytes > LARGEST:
            raise DeviceError(
                f"block at sample {block.first} has shape {values.shape}; this recording takes (n_samples, {columns})"
                f" of at most {LARGEST >> 20} MB. Give the columns of the header"
            )
        if not isinstance(block.first, int | np.integer) or not -(2**62) < block.first < 2**62:
            raise DeviceError(f"a block begins at sample {block.first}; numbers of samples are whole and below 2^62")
        return values

    def _bytes_per_s(self) -> float:
        """Bytes of a second, as far as can be told before: counts take two a value."""
        widths = [2 if c.unit == "1" else 8 for c in self._header.columns]
        return self._header.rate_hz * sum(widths) * 1.1

    def _reserve(self) -> int:
        return _LEAST_FREE + round(_AHEAD_S * self._bytes_per_s())

    def _check_room(self) -> None:
        """Refuse a recording that the disk has no room for: the journal, and the record beside it."""
        wanted = self._reserve() + round(2 * self._bytes_per_s() * (self._seconds or 0.0))
        try:
            free = free_bytes(self.path.parent)
        except OSError as failure:
            raise disk_error(f"{self.path.parent} cannot be looked at", failure) from None
        if free < wanted:
            raise DeviceError(
                f"{self.path.parent} has {free / 1e6:.0f} MB left; this recording may take {wanted / 1e6:.0f} MB."
                " Make room, choose another folder, or record for a shorter time"
            )
