"""A feed: frames that one process appends to files and others read at their own pace.

Who writes never waits for who reads, and needs nobody who reads. A frame is its length and kind (little endian, 5
bytes), then JSON (``J``) or an envelope of signals (``E``). Files are numbered parts; old parts go, and each part
begins with the frames that a reader has to know (`sticky`), so that any part can be read alone.
"""

from __future__ import annotations

import errno
import json
import os
import struct
import threading
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import Any

from ambid.console.folder import open_plain

_HEAD = struct.Struct("<Ic")
_PART = 2 << 20  # bytes after which a new part begins: 2.7 minutes of eight signals at 200 envelopes a second
_KEPT = 24  # parts: about an hour
_SPARE = 1 << 16
_EVENTS, _MOST_EVENTS = ("alarm", "device", "note", "order"), 200  # kinds that later parts begin with too, the latest
_LONGEST = 1 << 26  # bytes of a frame; what claims more is damaged


class FeedWriter:
    """Appends frames to the feed of a folder.

    `folder`: exists; `part_bytes`, `kept`: size and number of the parts.
    """

    def __init__(self, folder: Path, *, part_bytes: int = _PART, kept: int = _KEPT) -> None:
        self._folder, self._size, self._kept = folder, part_bytes, kept
        self._lock = threading.Lock()
        self._sticky: dict[str, bytes] = {}
        self._events: deque[Mapping[str, Any]] = deque(maxlen=_MOST_EVENTS)
        self._states: dict[str, Callable[[], Mapping[str, Any]]] = {}
        self._number = next_part(folder)
        self._file: FileIO | None = None
        self._missed, self._closed = 0, False
        self._spare = folder / "spare"  # room that the end of a run needs on a full disk
        with suppress(OSError):
            self._spare.write_bytes(bytes(_SPARE))

    def tell(self, kind: str, content: Mapping[str, Any], *, sticky: str | None = None, last: bool = False) -> None:
        """Append a JSON frame of a `kind`; the last one under each name `sticky` begins each later part; the `last` one
        of all has room that was kept for it.
        """
        frame = _json_frame(kind, content)
        with self._lock:
            if sticky is not None:
                self._sticky[sticky] = frame
            if last:
                with suppress(OSError):
                    self._spare.unlink(missing_ok=True)
            self._append(frame)
            if kind in _EVENTS:
                self._events.append({"kind": kind, **content})

    def keep(self, kind: str, content: Callable[[], Mapping[str, Any]]) -> None:
        """Begin each later part with a JSON frame of what is known by then."""
        with self._lock:
            self._states[kind] = content

    def envelope(self, payload: bytes) -> None:
        """Append an envelope of signals; see `Envelope`."""
        with self._lock:
            self._append(_framed(b"E", payload))

    def close(self) -> None:
        """End the feed."""
        with self._lock:
            self._closed = True
            self._spare.unlink(missing_ok=True)
            if self._file is not None:
                self._file.close()

    def _append(self, frame: bytes) -> None:
        """Write a frame whole or not at all: a full disk stops no run, and is told once it takes again."""
        if self._closed:
            return
        try:
            file = self._room(len(frame))
            at = file.tell()
            if self._missed:
                note = {"kind": "note", "text": f"{self._missed} messages of this view are missing: the disk took none"}
                frame = _framed(b"J", json.dumps(note).encode()) + frame
            if not at:
                known = [_json_frame(kind, content()) for kind, content in self._states.items()]  # before any line
                known += [f for f in self._sticky.values() if not frame.endswith(f)]
                known += [_json_frame("before", {"events": list(self._events)})] if self._events else []
                frame = b"".join((*known, frame))
            if file.write(frame) < len(frame):
                file.truncate(file.seek(at))
                raise OSError(errno.ENOSPC, "no space left")
            self._missed = 0
        except OSError:
            self._missed += 1

    def _room(self, length: int) -> FileIO:
        """Return the part that takes so many bytes more."""
        if self._file is not None and self._file.tell() + length <= self._size:
            return self._file
        number = self._number + (self._file is not None)
        file = FileIO(part(self._folder, number), "ab")
        if self._file is not None:
            self._file.close()
        self._number, self._file = number, file
        part(self._folder, number - self._kept).unlink(missing_ok=True)
        return file


class FeedReader:
    """Reads whole frames of a feed as they come; a part that is gone is passed over.

    `parts`: how many of the last ones to begin with.
    """

    def __init__(self, folder: Path, *, parts: int = 2) -> None:
        self._folder = folder
        last = next_part(folder) - 1
        self._number = max(first_part(folder), last - parts + 1)
        self._file: FileIO | None = None
        self._over = False
        self._at, self.behind = 0, 0  # `behind`: bytes of this part that were not read yet, after the last read

    def read(self, most: int = 1 << 18) -> bytes:
        """Return whole frames, `most` bytes of them or the next one; empty where there is nothing new."""
        data = b""
        try:
            if self._file is None:
                self._file = open_plain(part(self._folder, self._number))
            self._file.seek(self._at)
            data = self._file.read(most)
        except OSError:  # not yet there, or gone
            pass
        whole = whole_frames(data)
        if data and not whole and len(data) == most and most < _LONGEST:
            return self.read(4 * most)
        self._at += whole
        if self._file is not None and whole:
            self.behind = max(0, os.fstat(self._file.fileno()).st_size - self._at)
        if not whole and part(self._folder, self._number + 1).exists():
            if self._over:
                self._number, self._at = max(self._number + 1, first_part(self._folder)), 0
                self._file = None
            self._over = not self._over  # what came between the read and the next part is read first
            return self.read(most)
        return data[:whole]


def whole_frames(data: bytes) -> int:
    """Return how many bytes at the begin of `data` are whole frames."""
    at = 0
    while at + _HEAD.size <= len(data):
        end = at + _HEAD.size + _HEAD.unpack_from(data, at)[0]
        if end > len(data):
            break
        at = end
    return at


def json_frames(data: bytes) -> list[dict[str, Any]]:
    """Return the JSON frames of whole frames."""
    found, at = [], 0
    while at + _HEAD.size <= len(data):
        length, kind = _HEAD.unpack_from(data, at)
        if kind == b"J":
            found.append(json.loads(data[at + _HEAD.size : at + _HEAD.size + length]))
        at += _HEAD.size + length
    return found


def part(folder: Path, number: int) -> Path:
    """Return where a part of a feed is."""
    return folder / f"feed-{number:06d}.bin"


def first_part(folder: Path) -> int:
    """Return the number of the oldest part; 0 without any."""
    return min(_numbers(folder), default=0)


def next_part(folder: Path) -> int:
    """Return the number after the newest part; 0 without any."""
    return max(_numbers(folder), default=-1) + 1


def _numbers(folder: Path) -> list[int]:
    return [int(p.stem.removeprefix("feed-")) for p in folder.glob("feed-[0-9]*.bin") if p.stem[5:].isdecimal()]


def _json_frame(kind: str, content: Mapping[str, Any]) -> bytes:
    assert "kind" not in content
    text = json.dumps({"kind": kind, **content}, ensure_ascii=False, allow_nan=False, default=str)
    return _framed(b"J", text.encode())


def _framed(kind: bytes, payload: bytes) -> bytes:
    return _HEAD.pack(len(payload), kind) + payload
