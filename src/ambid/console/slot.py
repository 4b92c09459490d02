"""Small files of a fixed size that are written in place, on a full disk too; half a write is never read."""

from __future__ import annotations

import errno
import json
import os
import struct
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from stat import S_ISREG
from typing import Any

from ambid.errors import AmbidError

_HEAD = struct.Struct("<II")  # length and check value of what follows
_BYTES = 8192
_PATIENCE_S = 0.3  # with another process that has it
_AGAIN = 5  # readings of a file that is being written


class Slot:
    """One JSON object in a file.

    `path`: need not exist.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def make(self) -> None:
        """Take the room on the disk that every later write needs."""
        with suppress(FileExistsError):
            fd = os.open(self._path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600)
            try:
                os.write(fd, bytes(_BYTES))
            finally:
                os.close(fd)

    def read(self) -> dict[str, Any]:
        """Return what is in it; nothing where it was never written, or is no file of this kind."""
        with suppress(OSError, ValueError, RecursionError):
            fd = descriptor(self._path, os.O_RDONLY)
            try:
                return _content(fd)
            finally:
                os.close(fd)
        return {}

    def write(self, content: Mapping[str, Any]) -> None:
        """Replace what is in it; one process at a time."""
        fd = descriptor(self._path, os.O_RDWR)
        try:
            _put(fd, content)
        finally:
            os.close(fd)

    @contextmanager
    def transaction(self) -> Iterator[dict[str, Any]]:
        """Yield what is in it, to be changed, while no other process changes it, and write what has become of it."""
        fd = descriptor(self._path, os.O_RDWR)
        try:
            end = time.monotonic() + _PATIENCE_S
            while not lock(fd):
                if time.monotonic() > end:
                    raise AmbidError("another console, which does not answer, holds this run. End it, or try again")
                time.sleep(0.005)
            content = before = _content(fd)
            yield (content := dict(before))
            if content != before:
                _put(fd, content)
        finally:
            os.close(fd)


def lock(fd: int) -> bool:
    """Lock a file for this process and those that inherit it, until the last of them closes it or dies; whether it is.

    Where the system has no locks, that is not looked at.
    """
    try:
        import fcntl
    except ImportError:
        return True
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


def descriptor(path: Path, how: int) -> int:
    """Open a plain file that exists: what is a link, a pipe or a device raises `OSError` and is not waited for."""
    fd = os.open(path, how | sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_BINARY")))
    if not S_ISREG(os.fstat(fd).st_mode):
        os.close(fd)
        raise OSError(f"{path.name} is no plain file")
    return fd


def append(path: Path, line: str) -> None:
    """Add a line to a file, which is made where there is none; one that does not fit raises `OSError`."""
    how = os.O_WRONLY | os.O_APPEND | os.O_CREAT
    fd = os.open(path, how | sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK")), 0o600)
    try:
        data = f"{line}\n".encode()
        if os.write(fd, data) < len(data):
            raise OSError(errno.ENOSPC, "no space left", path.name)
    finally:
        os.close(fd)


def _content(fd: int) -> dict[str, Any]:
    for _ in range(_AGAIN):
        os.lseek(fd, 0, os.SEEK_SET)
        data = os.read(fd, _BYTES)
        if len(data) < _HEAD.size:
            return {}
        length, check = _HEAD.unpack_from(data)
        text = data[_HEAD.size : _HEAD.size + length]
        if length and zlib.crc32(text) == check:
            content = json.loads(text)
            return content if isinstance(content, dict) else {}
        if not length:
            return {}
    return {}


def _put(fd: int, content: Mapping[str, Any]) -> None:
    text = json.dumps(content, allow_nan=False).encode()
    data = _HEAD.pack(len(text), zlib.crc32(text)) + text
    if len(data) > _BYTES:
        raise ValueError(f"{len(data)} bytes do not fit")
    os.lseek(fd, 0, os.SEEK_SET)
    os.write(fd, data)
