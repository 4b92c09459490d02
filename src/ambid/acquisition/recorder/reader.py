"""Read a journal, sound or not: every frame that is whole comes back, everything else is counted.

Nothing is believed without its check value. After damage the next sync word is looked for, so one bad byte costs one
frame; numbers of frames and blocks tell how many are missing.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np

from ambid.acquisition.device import DeviceEvent
from ambid.acquisition.recorder import layout
from ambid.acquisition.recorder.disk import lock
from ambid.acquisition.recorder.layout import (
    HEAD_SIZE,
    SYNC,
    Head,
    JournalHeader,
    event_of,
    head_of,
    is_whole,
    unpacked_values,
    version_of,
)
from ambid.errors import DeviceError
from ambid.tracking.blocks import Block

_WINDOW = 1 << 20  # bytes that are read at once
_SECTOR = 4096


@dataclass(slots=True, kw_only=True)
class Damage:
    """What a journal lacks. Counted while it is read."""

    blocks: int = 0  # blocks that are missing or damaged between sound ones
    frames: int = 0  # frames of any kind, those blocks included
    places: int = 0  # stretches of bytes that are no sound frame, the end not counted
    discarded_bytes: int = 0  # bytes of these stretches
    repeated: int = 0  # frames that came a second time and were passed over
    tail_bytes: int = 0  # bytes behind the last sound frame: what was being written when the recording was cut off
    closed: bool = False  # whether the recorder itself ended the journal


class JournalReader:
    """A journal to be read, from its beginning, as often as wanted.

    `read`: takes a place and a number of bytes, and gives them; `size`: bytes of the file; `path`: for messages.

    `damage`: of the last reading that came to its end.
    """

    def __init__(self, read: Callable[[int, int], bytes], size: int, path: Path) -> None:
        self.path, self._size = path, size
        self._window = _Window(read, size)
        self._fd = -1
        self.damage = Damage()
        self._journal, self.header = self._identity()

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """Open a journal, and keep recorders and other readers away until it is closed."""
        path = Path(path)
        try:
            fd = os.open(path, os.O_RDONLY | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0))
        except OSError as failure:
            raise DeviceError(f"journal {path} cannot be read: {failure.strerror}. Check the path") from None
        lock(fd, path)
        try:
            if path.is_dir():
                raise DeviceError(f"journal {path} is a folder; it must be a file. Name the file inside it")
            reader = cls(lambda at, n: os.pread(fd, n, at), os.fstat(fd).st_size, path)
        except BaseException:
            os.close(fd)
            raise
        reader._fd = fd
        return reader

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the file."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def items(self) -> Iterator[Block | DeviceEvent]:
        """Read from the beginning; `damage` is complete once the last item was taken.

        Returns in the order in which they were written.
        """
        damage, number, block = Damage(), 0, 0
        end = layout.PREAMBLE_SIZE  # of what is accounted for
        for at, head, data in self._frames(self._journal):
            if at > end:
                damage.places += 1
                damage.discarded_bytes += at - end
            end = at + head.size
            if head.frame < number:
                damage.repeated += 1
                continue
            damage.frames += head.frame - number
            damage.blocks += max(head.block - block, 0)
            number, block = head.frame + 1, head.block + (head.kind == layout.BLOCK)
            damage.closed = head.kind == layout.CLOSE
            yield from _item(head, data)
        damage.tail_bytes = max(self._size - end, 0)
        self.damage = damage

    def _identity(self) -> tuple[int, JournalHeader]:
        """Find a sound header, the first of which is right behind the preamble."""
        version = version_of(self._window.take(0, layout.PREAMBLE_SIZE))
        if version not in (None, layout.VERSION):
            raise DeviceError(
                f"journal {self.path} is of version {version}; this program reads {layout.VERSION}."
                " Recover it with the version that recorded it"
            )
        blocks = 0
        for _, head, data in self._frames(None):
            blocks += head.kind == layout.BLOCK
            if head.kind == layout.HEADER:
                return head.journal, JournalHeader.from_json(json.loads(_payload(head, data)))
        if not self._size:
            raise DeviceError(f"journal {self.path} is empty: it was cut off before anything was recorded. Remove it")
        if version is None:
            raise DeviceError(f"{self.path} is not a journal of ambid. Name a file that ends in .journal")
        if blocks:
            raise DeviceError(
                f"journal {self.path} holds {blocks} sound blocks, but every header, which says what they are, is"
                " damaged. Keep it, and copy it once more from where it was recorded"
            )
        raise DeviceError(
            f"journal {self.path} holds no intact header: it was cut off before anything was acknowledged, or is "
            "damaged throughout. There is nothing to recover: remove it"
        )

    def _frames(self, journal: int | None) -> Iterator[tuple[int, Head, bytes]]:
        """Yield place, head and bytes of every sound frame, of one journal if its number is given."""
        at = layout.PREAMBLE_SIZE if self._size > layout.PREAMBLE_SIZE else 0
        while True:
            head = head_of(self._window.take(at, HEAD_SIZE))
            sound = head is not None and journal in (None, head.journal)
            if sound and head is not None:
                data = self._window.take(at, head.size)
                if is_whole(data, head):
                    yield at, head, data
                    at += head.size
                    continue
                if self._window.take(at + head.size, len(SYNC)) == SYNC:  # its length is checked: only values are bad
                    at += head.size
                    continue
            found = self._window.find(SYNC, at + 1)
            if found < 0:
                return
            at = found


def _item(head: Head, data: bytes) -> Iterator[Block | DeviceEvent]:
    if head.kind == layout.BLOCK:
        yield Block(first=head.first, time_s=head.time_s, values=unpacked_values(_payload(head, data), head))
    elif head.kind == layout.EVENT:
        yield event_of(_payload(head, data))


def _payload(head: Head, data: bytes) -> bytes:
    return data[HEAD_SIZE : HEAD_SIZE + head.length]


class _Window:
    """A file read in large pieces; what the disk cannot give reads as zeros, which no check value passes."""

    def __init__(self, read: Callable[[int, int], bytes], size: int) -> None:
        self._read, self._size = read, size
        self._at, self._data = 0, b""

    def take(self, at: int, n: int) -> bytes:
        """Return `n` bytes from a place on; fewer at the end."""
        n = min(n, self._size - at)
        if n <= 0:
            return b""
        begin = at - self._at
        if begin < 0 or begin + n > len(self._data):
            self._at, self._data = at, self._piece(at, max(n, _WINDOW))
            begin = 0
        return self._data[begin : begin + n]

    def find(self, word: bytes, at: int) -> int:
        """Return the next place of a word; -1 if there is none."""
        while at + len(word) <= self._size:
            self.take(at, len(word))
            found = self._data.find(word, at - self._at)
            if found >= 0:
                return self._at + found
            at = self._at + len(self._data) - len(word) + 1
        return -1

    def _piece(self, at: int, n: int) -> bytes:
        end = min(at + n, self._size)
        try:
            return self._whole(at, n).ljust(end - at, b"\0")  # a file that somebody cut off meanwhile
        except OSError:
            return b"".join(self._sector(k, min(_SECTOR - k % _SECTOR, end - k)) for k in _sectors(at, end))

    def _whole(self, at: int, n: int) -> bytes:
        parts: list[bytes] = []
        while n > 0 and (part := self._read(at, n)):
            parts.append(part)
            at, n = at + len(part), n - len(part)
        return b"".join(parts)

    def _sector(self, at: int, n: int) -> bytes:
        try:
            return self._whole(at, n).ljust(n, b"\0")
        except OSError:
            return bytes(n)


def _sectors(at: int, end: int) -> Iterator[int]:
    while at < end:
        yield at
        at += _SECTOR - at % _SECTOR


@dataclass(slots=True, kw_only=True)
class Survey:
    """What a journal holds."""

    blocks: int = 0  # blocks, and rows of them that have a place in the record
    samples: int = 0
    first: int = 0  # number of the first sample, and of the one behind the last
    end: int = 0
    start_s: float = 0.0  # time of the first sample, s
    gaps: int = 0  # places where samples are missing, and how many
    gap_samples: int = 0
    misplaced: int = 0  # rows whose numbers were there before
    # largest difference between a block's time and that of its number at the rate of the header, s
    stamp_error_s: float = 0.0
    events: list[DeviceEvent] = field(default_factory=list)
    damage: Damage = field(default_factory=Damage)

    @property
    def rows(self) -> int:
        """Rows of the record, those of NaN included."""
        return self.end - self.first


def survey(reader: JournalReader) -> Survey:
    """Look through a journal."""
    found = Survey()
    rate = reader.header.rate_hz
    for item in reader.items():
        if isinstance(item, DeviceEvent):
            found.events.append(item)
            continue
        n = len(item.values)
        if found.blocks == 0:
            found.first = found.end = item.first
            found.start_s = item.time_s if np.isfinite(item.time_s) else item.first / rate
        found.blocks += 1
        if item.first > found.end:
            found.gaps += 1
            found.gap_samples += item.first - found.end
        old = min(max(found.end - item.first, 0), n)
        found.misplaced += old
        found.samples += n - old
        found.end = max(found.end, item.first + n)
        if not old and np.isfinite(item.time_s):
            due = found.start_s + (item.first - found.first) / rate
            found.stamp_error_s = max(found.stamp_error_s, abs(item.time_s - due))
    found.damage = reader.damage
    return found
