"""Temporary folders of emulated benches: each is locked while its program lives, and removed by whoever finds it dead.

A program that is killed outright removes nothing; the next one that makes such a folder does it in its place.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from contextlib import suppress
from pathlib import Path

_PREFIX = "ambid-emulated-"
_LOCK = "in_use"
_YOUNG_S = 60.0  # a folder as young may be about to be locked


class TemporaryFolder:
    """A folder of this program alone."""

    def __init__(self) -> None:
        """Make it, and remove what dead programs have left."""
        _remove_dead()
        self.path = Path(tempfile.mkdtemp(prefix=_PREFIX))
        self._lock = os.open(self.path / _LOCK, os.O_CREAT | os.O_RDWR | getattr(os, "O_CLOEXEC", 0), 0o600)
        _locked(self._lock)

    def remove(self) -> None:
        """Remove it with all that it holds; again is harmless."""
        if self._lock >= 0:
            shutil.rmtree(self.path, ignore_errors=True)
            os.close(self._lock)
            self._lock = -1


def _locked(fd: int) -> bool:
    """Lock a file; whether nobody else holds it."""
    try:
        import fcntl
    except ImportError:  # not a POSIX system: there is no emulated bench either
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _remove_dead() -> None:
    """Remove the folders of this user that nobody holds."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with suppress(OSError):  # of another user, or just being removed
            if folder.is_symlink() or time.time() - folder.stat().st_mtime < _YOUNG_S:
                continue
            fd = os.open(folder / _LOCK, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
            try:
                if _locked(fd):
                    shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(fd)
