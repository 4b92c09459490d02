"""The file under a journal: made once, locked, appended to, brought to the disk; and what can go wrong with it.

A program that dies loses nothing of what was written; a power cut loses what was not brought to the disk by `sync`.
"""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path
from weakref import WeakSet

from ambid.errors import DeviceError

REMOVED = "was removed while it was written"
_DATA_SYNC = getattr(os, "fdatasync", os.fsync)
_WHY = {
    errno.ENOSPC: ("the disk is full", "Make room"),
    errno.EDQUOT: ("the disk quota is used up", "Make room"),
    errno.EFBIG: ("the file has reached the largest size that is allowed", "Raise the limit (ulimit -f)"),
    errno.EIO: ("the disk failed", "Check the disk"),
    errno.EROFS: ("the file system may only be read", "Choose another folder"),
    errno.EACCES: ("it may not be written", "Choose another folder"),
    errno.EPERM: ("it may not be written", "Choose another folder"),
    errno.ENOENT: ("its folder does not exist", "Make it first, or correct the path"),
    errno.ENOTDIR: ("its folder is a file", "Correct the path"),
}


def disk_error(what: str, failure: OSError, remedy: str = "") -> DeviceError:
    """Put what the system says of a file into words.

    `what`: which file, and what was done with it; `remedy`: what else to do, a sentence.
    """
    why, first = _WHY.get(failure.errno or 0, (failure.strerror or str(failure), "Check folder and disk"))
    return DeviceError(f"{what}: {why}. {first}{'. ' + remedy if remedy else ''}")


class JournalFile:
    """A file that is only appended to, and that no second recorder writes.

    `path`: must not exist.

    `size`: bytes written so far.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.size = path, 0
        flags = os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_APPEND | getattr(os, "O_CLOEXEC", 0)
        try:
            self._fd = os.open(path, flags | getattr(os, "O_BINARY", 0), 0o644)
        except FileExistsError:
            raise DeviceError(_occupied(path)) from None
        except OSError as failure:
            raise disk_error(f"{path} cannot be made", failure) from None
        lock(self._fd, path)
        _OPEN.add(self)
        sync_folder(path)

    def write(self, data: bytes) -> None:
        """Append all of the bytes."""
        rest = memoryview(data)
        while rest:
            written = os.write(self._fd, rest)
            self.size += written
            rest = rest[written:]

    def sync(self) -> None:
        """Bring all that was written to the disk, and wait for it."""
        _DATA_SYNC(self._fd)

    def fault(self) -> str:
        """Say what makes the file useless although it can still be written.

        Returns empty if it lies where it was made, in a folder that will take the record too.
        """
        if os.fstat(self._fd).st_nlink == 0:
            return REMOVED
        if not self.in_place:
            return "was moved while it was written"
        if not os.access(self.path.parent, os.W_OK):
            return "lies in a folder that may not be written any more"
        return ""

    @property
    def in_place(self) -> bool:
        """Whether its path still leads to it."""
        try:
            return os.path.samestat(os.stat(self.path), os.fstat(self._fd))
        except OSError:
            return False

    def read(self, at: int, n: int) -> bytes:
        """Return the bytes from a place on, also where the file was removed.

        `at`, `n`: first byte, and how many; fewer at the end.
        """
        return os.pread(self._fd, n, at)

    def remove(self) -> None:
        """Remove the file, if its path still leads to it."""
        if self.in_place:
            self.path.unlink()
            sync_folder(self.path)

    def close(self) -> None:
        """Let go of the file and its lock."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def _let_go() -> None:
    """Close the journals in a process that was forked off: it would hold their locks after the recorder's death."""
    for file in list(_OPEN):
        file.close()


_OPEN: WeakSet[JournalFile] = WeakSet()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_let_go)


def lock(fd: int, path: Path) -> None:
    """Lock a journal against every other recorder and recovery, until the file is closed.

    `fd`: closed if it cannot be locked; `path`: for the message.
    """
    try:
        import fcntl
    except ImportError:  # not a POSIX system: that it is made only once has to do
        return
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(fd)
        raise DeviceError(
            f"{path} is being written by a recorder, or recovered by another program. Wait until it ends, or end it"
        ) from None
    except OSError:  # a file system without locks
        return


def sync_folder(path: Path) -> None:
    """Bring the name of a file to the disk, as far as the system can.

    `path`: of the file.
    """
    if os.name != "posix":
        return
    with contextlib.suppress(OSError):  # not every file system has it
        fd = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)


def free_bytes(folder: Path) -> int:
    """Return how much more a folder takes.

    Returns bytes.
    """
    import shutil

    return shutil.disk_usage(folder).free


def _occupied(path: Path) -> str:
    return (
        f"{path} already exists: another recorder writes it, or one was ended before it could finish."
        f" Wait for it, or: ambid recover {path} --delete"
    )
