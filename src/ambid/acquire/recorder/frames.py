"""How a journal lies on disk: frames that can be found, checked and counted without anything that came before them.

    file      preamble, header frame, then frames in the order in which they were written; little endian throughout
    preamble  "AMBIDJNL", version u32, CRC-32 of these 12 bytes u32
    frame     head (64 bytes), payload, CRC-32 of head and payload u32

    head      0  sync word, 8 bytes         40  time of the first sample f64, s
              8  number of the journal u64   48  bytes of the payload u32
             16  number of the frame u64     52  samples u32
             24  blocks before it u64        56  columns u16
             32  first sample i64            58  kind u8, type of the values u8
                                             60  CRC-32 of these 60 bytes u32

    kind      1 header (JSON), 2 block (values, row by row), 3 event (JSON), 4 close (JSON)
    type      1 int16, 2 uint16, 3 int32, 4 float32, 5 float64; 0 where the payload is JSON

The head has a check value of its own, so that no length is believed before it is checked. The number of the journal is
drawn at random: what a file system leaves of another journal behind the end is not taken for a part of this one. Frames
are numbered, and blocks too, so that what is missing is counted, wherever it was.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, Final
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

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
    journal: int  # number of the journal that it belongs to
    frame: int  # running number of the frame
    block: int  # blocks before it: the running number of a block
    length: int  # bytes of the payload
    first: int = NO_SAMPLE  # number of the first sample; `NO_SAMPLE` where there is none
    time_s: float = float("nan")  # of the first sample by the acquisition's clock, s
    n_samples: int = 0  # rows and columns of a block
    n_columns: int = 0
    dtype: int = 0  # code of the type of its values

    @property
    def size(self) -> int:
        """Bytes of the whole frame."""
        return OVERHEAD + self.length


def preamble() -> bytes:
    """Return the first bytes of a journal.

    Returns `PREAMBLE_SIZE` of them.
    """
    text = _PREAMBLE.pack(_MAGIC, VERSION)
    return text + _CRC.pack(crc32(text))


def version_of(data: bytes) -> int | None:
    """Return the version that the first bytes of a file tell.

    `data`: at least `PREAMBLE_SIZE`, or all there are. Returns none if they are not those of a journal, or damaged.
    """
    if len(data) < PREAMBLE_SIZE or crc32(data[: _PREAMBLE.size]) != _CRC.unpack_from(data, _PREAMBLE.size)[0]:
        return None
    magic, version = _PREAMBLE.unpack_from(data)
    return int(version) if magic == _MAGIC else None


def frame_bytes(head: Head, payload: bytes) -> bytes:
    """Put a frame together.

    `head`: its ``length`` is that of the payload; `payload`: at most `LARGEST`. Returns ``head.size`` of them.
    """
    packed = _HEAD.pack(
        SYNC, head.journal, head.frame, head.block, head.first, head.time_s, head.length,
        head.n_samples, head.n_columns, head.kind, head.dtype,
    )  # fmt: skip
    packed += _CRC.pack(crc32(packed))
    return b"".join((packed, payload, _CRC.pack(crc32(payload, crc32(packed)))))


def head_of(data: bytes) -> Head | None:
    """Read the head of a frame.

    `data`: from the sync word on. Returns none if it is damaged, or does not agree with itself.
    """
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
    """Tell whether a frame's payload is what was written.

    `data`: the frame, ``head.size`` bytes or fewer; `head`: that it begins with. Returns false if a byte of it is wrong
    or missing.
    """
    if len(data) < head.size:
        return False
    end = HEAD_SIZE + head.length
    return crc32(memoryview(data)[:end]) == int(_CRC.unpack_from(data, end)[0])


def packed_values(values: NDArray[np.float64], declared: str | None = None) -> tuple[int, bytes]:
    """Write values in the narrowest type that gives every bit of them back.

    `values`: (n_samples, n_columns), float64, anything, NaN and signed zeros included; `declared`: type to be tried
    first, e.g. ``"float64"`` to have them as they are. Returns `code`: of the type; `payload`: row by row.
    """
    plain = np.ascontiguousarray(values, dtype="<f8")
    bits = plain.tobytes()
    with np.errstate(invalid="ignore", over="ignore"):
        names = ([declared] if declared else []) + _candidates(float(plain.flat[0]) if plain.size else 0.0)
        for name in names:
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
    """Return the values of a block's payload.

    `data`: the payload, or a frame cut to it; `head`: of the frame. Returns (n_samples, n_columns), float64, bit for
    bit what was packed.
    """
    flat = np.frombuffer(data, dtype=_DTYPES[head.dtype])
    return flat.reshape(head.n_samples, head.n_columns).astype(np.float64)
