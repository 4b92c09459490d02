"""The recorder: blocks go to an append-only journal beside the wanted file, and at the end become a record.

The caller never waits: `Recorder.append` puts a block into a bounded queue, and a thread of the recorder's own writes
and brings it to the disk. A block is acknowledged once it is there; from then on neither a kill nor a power cut takes
it away. What finds no room in the queue is counted, told at once, and marked in the journal.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from ambid.acquire.device import DeviceEvent
from ambid.acquire.recorder._writer import JournalWriter, WriteQueue
from ambid.acquire.recorder.convert import Recorded, check_target, recorded_from
from ambid.acquire.recorder.disk import JournalFile, disk_error, free_bytes
from ambid.acquire.recorder.layout import (
    BLOCK,
    LARGEST,
    Event,
    Head,
    JournalHeader,
    event_frame,
    journal_path,
    packed_values,
)
from ambid.acquire.recorder.reader import JournalReader
from ambid.errors import DeviceError
from ambid.track.blocks import Block

_LEAST_FREE = 16 << 20  # bytes that are to be left on the disk
_AHEAD_S = 10.0  # a disk that would be full in this time is told


class Recorder:
    """A recording: a context that makes the journal, and at its end the record. One thread may append.

    `header`: what is recorded; `write_s`: how often it is written, s: a kill costs no more; `queue_s`: how long the
    disk may stall before blocks find no room, s; `force`: whether a record that exists may be written over;
    `on_trouble`: takes a `DeviceError` as soon as something is wrong, in whichever thread sees it; `open_file`: makes
    the file from its path.

    `path`, `journal`: the record to be, and its journal; `result`: what became of
    it, once closed; None before, and where nothing was recorded.
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def acknowledged(self) -> int:
        """Number of blocks that are on the disk, counted from the first one that was taken."""
        return self._writer.acknowledged

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
        """Take a block, without waiting for the disk.

        Returns false if it will not be stored: there was no room, or the disk has failed. It is then counted.
        """
        values = self._checked(block)
        n = len(values)
        if n == 0:
            return True
        if self._next is not None and block.first < self._next:
            what = f"numbers of samples went back from {self._next} to {block.first}"
            self.event(Event(kind="note", what=what, sample=int(block.first)))
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

    def event(self, event: Event | DeviceEvent) -> None:
        """Put something that happened into the journal, in its place between the blocks."""
        self._queue.put(event_frame(event if isinstance(event, Event) else Event.of(event)))

    def flush(self, timeout_s: float = 60.0) -> bool:
        """Wait until everything that was taken is on the disk.

        `timeout_s`: longest wait. Returns whether it is.
        """
        return self._writer.flush(self._queue.blocks, timeout_s)

    def close(self, progress: Callable[[float], object] | None = None) -> Recorded | None:
        """End the recording: journal to record, read back, and only then the journal removed.

        Whatever goes wrong, Ctrl-C included, leaves the journal, from which ``ambid recover`` makes the record. So does
        a disk that had failed, from which reading back proves little, and a journal that holds more than the record.

        `progress`: takes the part that is done, 0 to 1. Returns none if nothing was recorded; there is then neither
        record nor journal.
        """
        if self._closed or not self._writer.started:
            return self.result
        self._closed = True
        file = self._writer.end()
        try:
            reader = JournalReader(file.read, file.size, self.journal)
            extra = {"not_stored": self._writer.lost_samples} if self._writer.lost_samples else {}
            self.result = recorded_from(reader, self.path, force=self._force, extra=extra, progress=progress)
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
