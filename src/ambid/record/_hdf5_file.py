"""An HDF5 file that is being written on a disk that may be full.

The HDF5 library does not survive a write that fails: what it could not flush crashes the program when it ends. So it
writes through a file of ours, which never fails towards the library and raises afterwards what the disk had said. For
the same reason a signal whose handler raises, such as Ctrl-C, waits until the library has come back.
"""

from __future__ import annotations

import io
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any


@contextmanager
def new_hdf5(path: Path) -> Iterator[tuple[Any, Callable[[], None]]]:
    """Make an HDF5 file, and close it; what the disk said is raised as OSError then, or by ``check`` in between.

    Yields the h5py.File, and that check.
    """
    import h5py

    with open(path, "w+b", buffering=0) as plain:
        file = _Unfailing(plain)
        with _no_interrupt(file), h5py.File(file, "w") as hdf5:
            yield hdf5, file.check
        file.check()


@contextmanager
def _no_interrupt(file: _Unfailing) -> Iterator[None]:
    """Take what a handler of signals raises for a failure of the file, which is raised by the next check."""
    usual: dict[int, Any] = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def take(number: int, frame: FrameType | None) -> None:
        try:
            usual[number](number, frame)
        except BaseException as failure:
            file.fail(failure)

    taken = [number for number, handler in usual.items() if callable(handler)]
    for number in taken:
        signal.signal(number, take)
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, usual[number])


class _Unfailing:
    """A file whose writes always succeed: what the disk does not take is held in memory from then on."""

    def __init__(self, plain: io.FileIO) -> None:
        self._plain, self._at, self._size = plain, 0, 0
        self._held: list[tuple[int, bytes]] = []
        self._failure: BaseException | None = None

    def fail(self, failure: BaseException) -> None:
        """Take note of the first failure."""
        self._failure = self._failure or failure

    def check(self) -> None:
        """Raise the first failure."""
        if self._failure is not None:
            raise self._failure

    def seek(self, offset: int, whence: int = 0) -> int:
        self._at = offset + (0, self._at, self._size)[whence]
        return self._at

    def tell(self) -> int:
        return self._at

    def read(self, n: int = -1) -> bytes:
        """Return the next `n` bytes, or all."""
        data = bytearray(n if n >= 0 else max(self._size - self._at, 0))
        self.readinto(data)
        return bytes(data)

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        at, n = self._at, len(view)
        self._plain.seek(at)
        data = bytearray((self._plain.read(n) or b"").ljust(n, b"\0"))
        for offset, held in self._held:
            begin, end = max(offset, at), min(offset + len(held), at + n)
            if begin < end:
                data[begin - at : end - at] = held[begin - offset : end - offset]
        view[:] = data
        self._at += n
        return n

    def write(self, data: Any) -> int:
        content = bytes(data)
        if self._failure is None:
            try:
                self._put(content)
            except OSError as failure:
                self.fail(failure)
        if self._failure is not None:
            self._held.append((self._at, content))
        self._at += len(content)
        self._size = max(self._size, self._at)
        return len(content)

    def _put(self, content: bytes) -> None:
        self._plain.seek(self._at)
        rest = memoryview(content)
        while rest:  # an unbuffered file may take a part, and fails with the next one
            rest = rest[self._plain.write(rest) or 0 :]

    def truncate(self, size: int) -> int:
        self._size = size
        if self._failure is None:
            try:
                self._plain.truncate(size)
            except OSError as failure:
                self.fail(failure)
        return size

    def flush(self) -> None:
        """Nothing is held back."""
