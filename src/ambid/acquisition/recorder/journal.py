"""A journal on the disk: framed blocks with a check value, header and events as JSON; made once, locked, appended to. A
program that dies loses nothing written; a power cut loses what `sync` did not bring to the disk.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import struct
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Self
from weakref import WeakSet
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from ambid.acquisition.device import Column, DeviceEvent, DeviceInfo
from ambid.errors import DeviceError, UnitError
from ambid.estimation.estimate import fields_json, read_as
from ambid.settings.caller import command
from ambid.units import UNKNOWN, parse_unit

SCHEMA = "ambid.journal/1"
SUFFIX = ".journal"


@dataclass(frozen=True, slots=True, kw_only=True)
class JournalHeader:
    """What is recorded, from what, since when."""

    columns: tuple[Column, ...]  # in the order of a block's values
    rate_hz: float  # samples in one second
    # who gave them: ``kind``, ``port``, ``identity``
    device: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    rig: str = ""  # text of the rig file; empty where there is none
    started: str = ""  # date and time, UTC, as ISO 8601 has it
    version: str = ""  # of the program that recorded

    def __post_init__(self) -> None:
        names = [c.name for c in self.columns]
        if not names or len(set(names)) < len(names):
            raise DeviceError(f"columns {names} make no record; it needs at least one, each with its own name. Rename")
        if not 0 < self.rate_hz < float("inf"):
            raise DeviceError(f"a rate of {self.rate_hz} Hz records nothing; it must be positive. Correct it")
        for column in self.columns:
            _check_unit(column)

    @classmethod
    def of(cls, info: DeviceInfo, rig: str = "") -> Self:
        """Describe a recording that begins now, of a device and the text of a rig file."""
        from importlib.metadata import version

        return cls(
            columns=info.columns,
            rate_hz=info.rate_hz,
            device={"kind": info.kind, "port": info.port, "identity": dict(info.identity)},
            rig=rig,
            started=datetime.now(UTC).isoformat(timespec="milliseconds"),
            version=version("ambid"),
        )

    @property
    def rig_sha256(self) -> str:
        """SHA-256 of the rig's text in UTF-8; empty where there is no rig."""
        return hashlib.sha256(self.rig.encode()).hexdigest() if self.rig else ""

    def as_json(self) -> dict[str, object]:
        """Return it as a JSON object for `from_json`."""
        return {"schema": SCHEMA, **fields_json(self), "rig_sha256": self.rig_sha256}

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Self:
        """Read back what `as_json` made."""
        if document.get("schema") != SCHEMA:
            raise DeviceError(f"the journal's schema is {document.get('schema')!r}; this program reads {SCHEMA!r}."
                              " Recover it with the version that recorded it")  # fmt: skip
        try:
            return read_as(cls, document)
        except (TypeError, ValueError) as failure:
            raise DeviceError(f"the journal's header: {failure}. It was written by another version") from None


def _check_unit(column: Column) -> None:
    """Refuse a unit that a record file would scale: a recording holds values as they came."""
    if column.unit == UNKNOWN:
        return
    try:
        unit = parse_unit(column.unit)
    except UnitError as failure:
        raise DeviceError(f"column {column.name!r}: {failure}") from None
    if float(unit.to_si(1.0)) != 1.0 or float(unit.to_si(0.0)) != 0.0:
        raise DeviceError(f"column {column.name!r} is in [{column.unit}]; a recording is in SI units or counts [1]."
                          f" Give it in [{unit.si}]")  # fmt: skip


def json_bytes(value: object) -> bytes:
    """Write a header or an event as UTF-8."""
    return json.dumps(value, ensure_ascii=False, separators=(",", ":")).encode()


def journal_path(path: Path) -> Path:
    """Return where the journal of a record lies: beside it."""
    return path.with_name(path.name + SUFFIX)


def record_path(journal: Path) -> Path:
    """Return the record, beside it, that a journal was to become."""
    name = journal.name.removesuffix(SUFFIX)
    return journal.with_name(name if name != journal.name else name + ".h5")


VERSION: Final = 1
SYNC: Final = b"\x9dAMBfrm\xe2"
HEADER: Final = 1
BLOCK: Final = 2
EVENT: Final = 3
CLOSE: Final = 4
NO_SAMPLE: Final = -(2**63)
LARGEST: Final = 1 << 26  # bytes of a payload

TYPES: Final[dict[str, tuple[int, np.dtype[Any]]]] = {
    "int16": (1, np.dtype("<i2")),
    "uint16": (2, np.dtype("<u2")),
    "int32": (3, np.dtype("<i4")),
    "float32": (4, np.dtype("<f4")),
    "float64": (5, np.dtype("<f8")),
}
_DTYPES: Final = dict(TYPES.values())

_MAGIC: Final = b"AMBIDJNL"
_PREAMBLE: Final = struct.Struct("<8sI")
_HEAD: Final = struct.Struct("<8sQQQqdIIHBB")
_CRC: Final = struct.Struct("<I")
HEAD_SIZE: Final = _HEAD.size + _CRC.size
OVERHEAD: Final = HEAD_SIZE + _CRC.size
PREAMBLE_SIZE: Final = _PREAMBLE.size + _CRC.size


@dataclass(frozen=True, slots=True, kw_only=True)
class Head:
    """Head of a frame."""

    kind: int  # `HEADER`, `BLOCK`, `EVENT` or `CLOSE`
    journal: int = 0  # number of the journal that it belongs to
    frame: int = 0  # running number of the frame
    block: int = 0  # blocks before it: the running number of a block
    length: int = 0  # bytes of the payload
    first: int = NO_SAMPLE  # number of the first sample; `NO_SAMPLE` where there is none
    time_s: float = float("nan")  # of the first sample by the acquisition's clock, s
    n_samples: int = 0  # rows and columns of a block
    n_columns: int = 0
    dtype: int = 0  # code of the type of its values

    @property
    def size(self) -> int:
        """Bytes of the whole frame."""
        return OVERHEAD + self.length


def event_frame(event: DeviceEvent) -> tuple[Head, bytes]:
    """Return the frame of an event, not numbered yet, and its payload."""
    return Head(kind=EVENT, first=NO_SAMPLE if event.sample is None else event.sample), json_bytes(asdict(event))


def event_of(text: bytes) -> DeviceEvent:
    """Read an event from the payload of `event_frame`."""
    return DeviceEvent(**json.loads(text))


def preamble() -> bytes:
    """Return the first `PREAMBLE_SIZE` bytes of a journal."""
    text = _PREAMBLE.pack(_MAGIC, VERSION)
    return text + _CRC.pack(crc32(text))


def version_of(data: bytes) -> int | None:
    """Return the version in the first `PREAMBLE_SIZE` bytes; None if they are not those of a journal, or damaged."""
    if len(data) < PREAMBLE_SIZE or crc32(data[: _PREAMBLE.size]) != _CRC.unpack_from(data, _PREAMBLE.size)[0]:
        return None
    magic, version = _PREAMBLE.unpack_from(data)
    return int(version) if magic == _MAGIC else None


def frame_bytes(head: Head, payload: bytes) -> bytes:
    """Put a frame of ``head.size`` bytes together from its head and a payload of at most `LARGEST`."""
    packed = _HEAD.pack(
        SYNC, head.journal, head.frame, head.block, head.first, head.time_s, head.length,
        head.n_samples, head.n_columns, head.kind, head.dtype,
    )  # fmt: skip
    packed += _CRC.pack(crc32(packed))
    return b"".join((packed, payload, _CRC.pack(crc32(payload, crc32(packed)))))


def head_of(data: bytes) -> Head | None:
    """Read the head of a frame from the sync word on; None if it is damaged, or does not agree with itself."""
    if len(data) < HEAD_SIZE or data[:8] != SYNC or crc32(data[:60]) != _CRC.unpack_from(data, _HEAD.size)[0]:
        return None
    _, journal, frame, block, first, time_s, length, n_samples, n_columns, kind, dtype = _HEAD.unpack_from(data)
    head = Head(
        kind=kind, journal=journal, frame=frame, block=block, first=first, time_s=time_s, length=length,
        n_samples=n_samples, n_columns=n_columns, dtype=dtype,
    )  # fmt: skip
    return head if length <= LARGEST and (kind != BLOCK or _agrees(head)) else None


def _agrees(head: Head) -> bool:
    """Whether the length of a block is that of its rows."""
    dtype = _DTYPES.get(head.dtype)
    return dtype is not None and head.length == head.n_samples * head.n_columns * dtype.itemsize


def is_whole(data: bytes, head: Head) -> bool:
    """Tell whether a frame's payload is what was written: false if a byte of it is wrong or missing."""
    if len(data) < head.size:
        return False
    end = HEAD_SIZE + head.length
    return crc32(memoryview(data)[:end]) == int(_CRC.unpack_from(data, end)[0])


def packed_values(values: NDArray[np.float64]) -> tuple[int, bytes]:
    """Return code and row-major bytes of values (n_samples, n_columns) in the narrowest type that gives every bit back,
    NaN and signed zeros included.
    """
    plain = np.ascontiguousarray(values, dtype="<f8")
    bits = plain.tobytes()
    with np.errstate(invalid="ignore", over="ignore"):
        for name in _candidates(float(plain.flat[0]) if plain.size else 0.0):
            code, dtype = TYPES[name]
            narrow = plain.astype(dtype)
            if narrow.astype("<f8").tobytes() == bits:
                return code, narrow.tobytes()
    return TYPES["float64"][0], bits


def _candidates(first: float) -> list[str]:
    """Types narrower than float64 that can hold the first value: it alone rules most of them out."""
    if first.is_integer():
        return ["int16", "uint16", "int32", "float32"]
    return ["float32"] if float(np.float32(first)) == first or first != first else []


def unpacked_values(data: bytes, head: Head) -> NDArray[np.float64]:
    """Return the values (n_samples, n_columns) of a block's payload, bit for bit what was packed."""
    flat = np.frombuffer(data, dtype=_DTYPES[head.dtype])
    return flat.reshape(head.n_samples, head.n_columns).astype(np.float64)


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
    """Put into words what the system says of a file, with what was done to it and a sentence of remedy."""
    why, first = _WHY.get(failure.errno or 0, (failure.strerror or str(failure), "Check folder and disk"))
    return DeviceError(f"{what}: {why}. {first}{'. ' + remedy if remedy else ''}")


class JournalFile:
    """A new file that is only appended to (`size` bytes so far), and that no second recorder writes."""

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
        """Say what makes a writable file useless; empty if it lies where it was made, in a folder that takes the record
        too.
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
        """Return `n` bytes from a place on, fewer at the end, also where the file was removed."""
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
    """Lock a journal against every other recorder and recovery; `fd` is closed if that fails."""
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
    """Bring the name of a file to the disk, as far as the system can."""
    if os.name != "posix":
        return
    with contextlib.suppress(OSError):  # not every file system has it
        fd = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)


def free_bytes(folder: Path) -> int:
    """Return how many more bytes a folder takes."""
    import shutil

    return shutil.disk_usage(folder).free


def _occupied(path: Path) -> str:
    return (
        f"{path} already exists: another recorder writes it, or one was ended before it could finish."
        f" Wait for it, or: {command('recover', path, delete=True)}"
    )
