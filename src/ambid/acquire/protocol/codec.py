"""Messages to bytes and back: code and fields, little endian, as the table says. Framing is in ``framing.py``."""

from __future__ import annotations

import functools
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from ambid.acquire.protocol.table import CRC_BYTES, MessageType, table
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
    """Make a message, checked against the table.

    `name`: as in the table; `values`: elements of the last field, for a message that ends in an array; `**fields`:
    every other field.
    """
    kind = _kind(name)
    wanted = [f.name for f in kind.fixed]
    for given in fields:
        if given not in wanted:
            raise DeviceError(f"message {name!r} has no field {given!r}.{nearest(given, wanted)}")
    if missing := [w for w in wanted if w not in fields]:
        raise DeviceError(f"message {name!r} lacks its field {missing[0]!r}. Give {', '.join(missing)}")
    for one in kind.fixed:
        low, high = one.span
        if not low <= fields[one.name] <= high:
            raise DeviceError(
                f"message {name!r}: {one.name} = {fields[one.name]} does not fit {one.kind}. "
                f"Give a value within {low} to {high}"
            )
    made = Message(name=name, fields=MappingProxyType({w: int(fields[w]) for w in wanted}), values=tuple(values))
    _check_values(made, kind)
    return made


def pack(what: Message) -> bytes:
    """Return code and fields of a message as bytes, without CRC.

    `what`: made by `message`, or with fields as the table has them.
    """
    kind = _kind(what.name)
    tail = kind.tail
    layout = _head(kind).format + (f"{len(what.values)}{tail.format}" if tail else "")
    try:
        return struct.pack(layout, kind.code, *(what.fields[f.name] for f in kind.fixed), *what.values)
    except (struct.error, KeyError):
        message(what.name, values=what.values, **what.fields)  # says which one
        raise


def unpack(payload: bytes, to: str = "host") -> Message:
    """Read a message from the code and fields of a sound frame.

    `payload`: as `FrameDecoder.feed` returns them; `to`: who receives it.
    """
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
    """Tell whether code and fields of a message may have this many bytes.

    `kind`: the message; `length`: bytes of code and fields.
    """
    if kind.tail is None:
        return length == kind.length
    return length >= kind.length and (length - kind.length) % kind.tail.width == 0


def refuse_other_version(version: int) -> None:
    """Refuse a controller that speaks another version of the protocol.

    `version`: what the controller says (field ``protocol`` of ``identity``).
    """
    ours = table().version
    if version != ours:
        older = "firmware of this ambid" if version < ours else "newer ambid, or the firmware of this one"
        raise DeviceError(
            f"the controller speaks version {version} of the wire protocol; this ambid speaks version {ours} only. "
            f"Put the {older} in place"
        )


def _check_values(made: Message, kind: MessageType) -> None:
    tail = kind.tail
    if tail is None:
        if made.values:
            raise DeviceError(f"message {made.name!r} ends in no array, but {len(made.values)} values are given")
        return
    low, high = tail.span
    for i, value in enumerate(made.values):
        if not low <= value <= high:
            raise DeviceError(f"message {made.name!r}: {tail.name}[{i}] = {value}. Give values within {low} to {high}")
    most = (table().largest - CRC_BYTES - kind.length) // tail.width
    if len(made.values) > most:
        raise DeviceError(f"message {made.name!r} has {len(made.values)} {tail.name}. Give at most {most} in one")


@functools.cache
def _codes(to: str) -> dict[int, MessageType]:
    return table().by_code(to)


def _kind(name: str) -> MessageType:
    known = table().messages
    if name not in known:
        raise DeviceError(f"there is no message {name!r}.{nearest(name, list(known))}")
    return known[name]


@functools.cache
def _head(kind: MessageType) -> struct.Struct:
    return struct.Struct("<B" + "".join(f.format for f in kind.fixed))
