"""Shared segments that are removed once, by whoever made them."""

from __future__ import annotations

import os
import secrets
import sys
import threading
from collections.abc import Sized
from multiprocessing import resource_tracker
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path

from ambid.errors import EstimationError

_PLACE = Path("/dev/shm")  # where Linux has shared memory
_ATTACHING = threading.Lock()


def created(size: int) -> SharedMemory:
    """Make a segment of zeros with a name of its own; the resource tracker removes it should this process be killed."""
    name = f"ambid-{os.getpid()}-{secrets.token_hex(4)}"
    segment = None
    try:
        segment = SharedMemory(name=name, create=True, size=size)
        _reserve(segment)
    except OSError as failure:
        if segment is not None:
            removed(segment)
        raise EstimationError(
            f"no shared memory of {size} bytes for a ring: {failure.strerror or failure}. Make room for it (on Linux in"
            f" {_PLACE}), or use fewer or shorter blocks"
        ) from None
    return segment


def _reserve(segment: SharedMemory) -> None:
    """Take the memory now, where it is a file of its own: one without room would kill whoever writes to it later."""
    path = _PLACE / segment.name
    if not path.exists() or not hasattr(os, "posix_fallocate"):
        return
    fd = os.open(path, os.O_RDWR)
    try:
        os.posix_fallocate(fd, 0, segment.size)
    finally:
        os.close(fd)


def attached(name: str) -> SharedMemory:
    """Open a segment that is somebody else's: the resource tracker of this process must not remove it."""
    try:
        if sys.version_info >= (3, 13):
            return SharedMemory(name=name, track=False)
        with _ATTACHING:
            register = resource_tracker.register
            resource_tracker.register = _not_registered
            try:
                return SharedMemory(name=name)
            finally:
                resource_tracker.register = register
    except (OSError, ValueError) as failure:
        why = getattr(failure, "strerror", None) or failure
        raise EstimationError(f"there is no shared memory {name!r} ({why}). Start the acquisition first") from None


def bytes_of(segment: SharedMemory) -> memoryview:
    """Return the bytes of an open segment."""
    buffer = segment.buf
    assert buffer is not None
    return buffer


def removed(segment: SharedMemory) -> None:
    """Close and remove a segment; it may be gone already."""
    segment.close()
    try:
        segment.unlink()
    except FileNotFoundError:
        resource_tracker.unregister(f"/{segment.name}", "shared_memory")


def _not_registered(name: Sized, rtype: str) -> None:
    del name, rtype
