"""Messages to bytes (code and fields, little endian) and frames: COBS( code | fields | CRC-16/XMODEM ) 0x00. COBS
(Cheshire and Baker 1999) leaves 0x00 to end a frame, to begin again after damage; under 254 bytes: undone in place.
"""

from __future__ import annotations

import functools
import struct
from binascii import crc_hqx
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from ambid.acquisition.protocol import CRC_BYTES, MessageType, table
from ambid.errors import DeviceError, nearest

_NO_FIELDS: Mapping[str, int] = MappingProxyType({})


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """One message."""

    name: str  # as in the table
    fields: Mapping[str, int] = field(default_factory=lambda: _NO_FIELDS)  # all fields of one element, by name
    values: tuple[int, ...] = ()  # elements of the last field where it is the rest of the frame; else empty

    def __getitem__(self, name: str) -> int:
        return self.fields[name]


def message(name: str, *, values: Iterable[int] = (), **fields: int) -> Message:
    """Make a message of the table and check it; `values`: elements of a last field that is an array."""
    kind = _kind(name)
    wanted = [f.name for f in kind.fixed]
    for field_name in fields:
        if field_name not in wanted:
            raise DeviceError(f"message {name!r} has no field {field_name!r}.{nearest(field_name, wanted)}")
    if missing := [w for w in wanted if w not in fields]:
        raise DeviceError(f"message {name!r} lacks its field {missing[0]!r}. Give {', '.join(missing)}")
    for one in kind.fixed:
        low, high = one.span
        if not low <= fields[one.name] <= high:
            raise DeviceError(
                f"message {name!r}: {one.name} = {fields[one.name]} does not fit {one.kind}. "
                f"Give a value within {low} to {high}"
            )
    result = Message(name=name, fields=MappingProxyType({w: int(fields[w]) for w in wanted}), values=tuple(values))
    _check_values(result, kind)
    return result


def pack(what: Message) -> bytes:
    """Return code and fields of a message as bytes, without CRC."""
    kind = _kind(what.name)
    tail = kind.tail
    layout = _head(kind).format + (f"{len(what.values)}{tail.format}" if tail else "")
    try:
        return struct.pack(layout, kind.code, *(what.fields[f.name] for f in kind.fixed), *what.values)
    except (struct.error, KeyError):
        message(what.name, values=what.values, **what.fields)  # says which one
        raise


def unpack(payload: bytes, to: str = "host") -> Message:
    """Read a message to a receiver from the code and fields of a sound frame, as `FrameDecoder.feed` gives them."""
    kind = _codes(to).get(payload[0]) if payload else None
    if kind is None:
        raise DeviceError(f"a frame to the {to} has no known code: {payload[:8].hex(' ') or 'it is empty'}. Drop it")
    if kind.name == "identity" and len(payload) > 2:
        refuse_other_version(payload[2])
    if not fits(kind, len(payload)):
        raise DeviceError(f"message {kind.name!r} has {len(payload)} bytes, expected {kind.length}. Drop it")
    head = _head(kind)
    numbers = head.unpack_from(payload)[1:]
    tail = kind.tail
    count = (len(payload) - kind.length) // tail.width if tail else 0
    values = struct.unpack_from(f"<{count}{tail.format}", payload, kind.length) if tail else ()
    fields = dict(zip((f.name for f in kind.fixed), numbers, strict=True))
    return Message(name=kind.name, fields=MappingProxyType(fields), values=values)


def fits(kind: MessageType, length: int) -> bool:
    """Tell whether code and fields of a message may have this many bytes."""
    if kind.tail is None:
        return length == kind.length
    return length >= kind.length and (length - kind.length) % kind.tail.width == 0


def refuse_other_version(version: int) -> None:
    """Refuse a controller whose ``identity`` has another version of the protocol."""
    ours = table().version
    if version != ours:
        older = "firmware of this ambid" if version < ours else "newer ambid, or the firmware of this one"
        raise DeviceError(
            f"the controller speaks version {version} of the wire protocol; this ambid speaks version {ours} only. "
            f"Put the {older} in place"
        )


def _check_values(what: Message, kind: MessageType) -> None:
    tail = kind.tail
    if tail is None:
        if what.values:
            raise DeviceError(f"message {what.name!r} ends in no array, but {len(what.values)} values are given")
        return
    low, high = tail.span
    for i, value in enumerate(what.values):
        if not low <= value <= high:
            raise DeviceError(f"message {what.name!r}: {tail.name}[{i}] = {value}. Give values within {low} to {high}")
    most = (table().largest - CRC_BYTES - kind.length) // tail.width
    if len(what.values) > most:
        raise DeviceError(f"message {what.name!r} has {len(what.values)} {tail.name}. Give at most {most} in one")


@functools.cache
def _codes(to: str) -> dict[int, MessageType]:
    return table().by_code(to)


def _kind(name: str) -> MessageType:
    messages = table().messages
    if name not in messages:
        raise DeviceError(f"there is no message {name!r}.{nearest(name, list(messages))}")
    return messages[name]


@functools.cache
def _head(kind: MessageType) -> struct.Struct:
    return struct.Struct("<B" + "".join(f.format for f in kind.fixed))


@dataclass(slots=True, kw_only=True)
class FrameCounters:
    """What a decoder has seen. Every byte fed is in `kept_bytes`, `discarded_bytes`, `empty`, or still pending."""

    frames: int = 0  # sound frames given out
    kept_bytes: int = 0  # bytes of these on the line, their 0x00 included
    # runs between two 0x00 that were discarded: wrong check value; too short or not of the message's length; unknown
    # code; not COBS; longer than any frame
    crc: int = 0
    length: int = 0
    code: int = 0
    cobs: int = 0
    overlong: int = 0
    discarded_bytes: int = 0  # bytes of those, their 0x00 included
    empty: int = 0  # bytes 0x00 with nothing before them: no damage

    @property
    def damaged(self) -> int:
        """Runs that were discarded, whatever their damage."""
        return self.crc + self.length + self.code + self.cobs + self.overlong


def frame(payload: bytes) -> bytes:
    """Return the bytes on the line for code and fields, with CRC, COBS and the 0x00 at the end."""
    if not 0 < len(payload) <= table().largest - CRC_BYTES:
        raise ValueError(f"{len(payload)} bytes of code and fields; a frame holds 1 to {table().largest - CRC_BYTES}")
    body = payload + crc_hqx(payload, 0).to_bytes(CRC_BYTES, "little")
    return b"".join(bytes((len(part) + 1,)) + part for part in body.split(b"\0")) + b"\0"


def encode(what: Message) -> bytes:
    """Return the bytes on the line for a message."""
    return frame(pack(what))


class FrameDecoder:
    """Finds the sound frames, for the side `to`, in what a line delivers in pieces of any size, and counts all the
    rest. Never raises, whatever it is fed, and keeps at most one frame's bytes between calls.
    """

    def __init__(self, to: str = "host") -> None:
        self._kinds = table().by_code(to)
        most = table().largest - CRC_BYTES
        self._lengths = {code: {n for n in range(most + 1) if fits(kind, n)} for code, kind in self._kinds.items()}
        self._longest = table().largest + 1  # on the line, without its 0x00
        self._tail = b""
        self._inside_overlong = False
        self.counters = FrameCounters()

    @property
    def pending(self) -> int:
        """Bytes of a frame that has not ended yet."""
        return len(self._tail)

    def feed(self, data: bytes | bytearray | memoryview) -> list[bytes]:
        """Take the next bytes of the line; return code and fields of each sound frame that ended in them, in order,
        code known and length that of the message.
        """
        runs = (self._tail + data).split(b"\0")
        tail = runs.pop()
        if self._inside_overlong:
            tail = self._leave_overlong(runs, tail)
        payloads: list[bytes] = []
        for run in runs:
            if not run:
                self.counters.empty += 1
                continue
            payload = self._open(run)
            if payload is None:
                self.counters.discarded_bytes += len(run) + 1
            else:
                self.counters.kept_bytes += len(run) + 1
                payloads.append(payload)
        if len(tail) > self._longest:
            self._inside_overlong = True
            self.counters.overlong += 1
            self.counters.discarded_bytes += len(tail)
            tail = b""
        self._tail = tail
        self.counters.frames += len(payloads)
        return payloads

    def _leave_overlong(self, runs: list[bytes], tail: bytes) -> bytes:
        """Discard what still belongs to a run that was too long; return what is left of the tail."""
        if runs:
            self._inside_overlong = False
            self.counters.discarded_bytes += len(runs.pop(0)) + 1
            return tail
        self.counters.discarded_bytes += len(tail)
        return b""

    def _open(self, run: bytes) -> bytes | None:
        """Undo COBS and check; None, counted, for a damaged run. Called for every frame: kept flat for speed."""
        end = len(run)
        if end > self._longest:
            self.counters.overlong += 1
            return None
        body = bytearray(run)
        at = 0
        while at < end:
            step = body[at]
            body[at] = 0
            at += step
        if at != end:
            self.counters.cobs += 1
            return None
        payload = bytes(body[1:-CRC_BYTES])
        if not payload:
            self.counters.length += 1
            return None
        if crc_hqx(payload, 0) != body[-2] | body[-1] << 8:
            self.counters.crc += 1
            return None
        if len(payload) not in self._lengths.get(payload[0], ()) and not self._allowed(payload):
            return None
        return payload

    def _allowed(self, payload: bytes) -> bool:
        """Judge a frame with sound CRC that has not a length of its code."""
        kind = self._kinds.get(payload[0])
        if kind is None:
            self.counters.code += 1
            return False
        # Another version's identity may be longer or shorter; it must get through, so that its version can be named.
        other_version = kind.name == "identity" and len(payload) > 2 and payload[2] != table().version
        if not other_version:
            self.counters.length += 1
        return other_version
