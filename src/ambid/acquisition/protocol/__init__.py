"""The table of the wire protocol, ``messages.toml``: codec, and by ``tools/protocol_header.py`` C header and page."""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from types import MappingProxyType
from typing import Any

CRC_BYTES = 2
FORMATS = {"u8": "B", "u16": "H", "u32": "I", "i8": "b", "i16": "h", "i32": "i"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """A named number: an entry of an enum, or a bit of a mask."""

    name: str
    value: int  # of the enum; of a mask the number of the bit
    about: str  # what it means, one line


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldType:
    """One field of a message."""

    name: str
    kind: str  # an integer, little endian
    many: bool  # true for a last field that is the rest of the frame: any number of elements, none included
    about: str  # meaning and unit, one line

    @property
    def width(self) -> int:
        """Bytes of one element."""
        return int(self.kind[1:]) // 8

    @property
    def format(self) -> str:
        """Letter of `struct` for one element."""
        return FORMATS[self.kind]

    @property
    def span(self) -> tuple[int, int]:
        """Least and largest value."""
        bits = 8 * self.width
        return (-(1 << bits - 1), (1 << bits - 1) - 1) if self.kind[0] == "i" else (0, (1 << bits) - 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class MessageType:
    """One message."""

    name: str
    code: int  # first byte of its frames
    to: str  # who receives it
    about: str  # one line
    fields: tuple[FieldType, ...]  # in their order on the wire

    @property
    def fixed(self) -> tuple[FieldType, ...]:
        """The fields of one element each."""
        return tuple(f for f in self.fields if not f.many)

    @property
    def tail(self) -> FieldType | None:
        """The last field, where it is the rest of the frame."""
        return self.fields[-1] if self.fields and self.fields[-1].many else None

    @property
    def length(self) -> int:
        """Bytes of code and fields, without CRC; the least, where the last field is the rest of the frame."""
        return 1 + sum(f.width for f in self.fixed)


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamColumn:
    """What a sample may carry."""

    name: str
    bit: int  # of the stream mask
    kind: str  # how its two bytes are read
    about: str  # meaning and unit, one line


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """The whole protocol."""

    version: int  # controllers of another version are refused
    baud: int  # of the serial line, bits in one second
    largest: int  # bytes of a frame before COBS: code, fields and CRC
    # named numbers by group; in a group of `bits` the values are numbers of bits
    enums: Mapping[str, tuple[Entry, ...]]
    bits: Mapping[str, tuple[Entry, ...]]
    stream: tuple[StreamColumn, ...]  # in the order of their bits, which is their order in a sample
    messages: Mapping[str, MessageType]  # by name

    def by_code(self, to: str) -> dict[int, MessageType]:
        """Return the messages that side `to` receives, by their code."""
        return {m.code: m for m in self.messages.values() if m.to == to}

    def value(self, group: str, name: str) -> int:
        """Return the number of entry `name` of enum `group`."""
        return next(e.value for e in self.enums[group] if e.name == name)

    def name(self, group: str, value: int) -> str:
        """Return the name of `value` in enum `group`, or its digits where it has none."""
        return next((e.name for e in self.enums[group] if e.value == value), str(value))

    def names_of_bits(self, group: str, mask: int) -> tuple[str, ...]:
        """Return the names of the bits of `group` that are set in `mask`."""
        return tuple(e.name for e in self.bits[group] if mask >> e.value & 1)


@functools.cache
def table() -> Table:
    """Return the protocol that this version of `ambid` speaks."""
    text = resources.files(__package__).joinpath("messages.toml").read_text(encoding="utf-8")
    return read_table(text)


def read_table(text: str) -> Table:
    """Read a protocol from text as in ``messages.toml``, which ``tools/protocol_header.py`` checks."""
    raw = tomllib.loads(text)
    return Table(
        version=raw["version"],
        baud=raw["baud"],
        largest=raw["largest"],
        enums=MappingProxyType({g: _entries(es) for g, es in raw["enums"].items()}),
        bits=MappingProxyType({g: _entries(es) for g, es in raw["bits"].items()}),
        stream=tuple(StreamColumn(name=n, bit=v[0], kind=v[1], about=v[2]) for n, v in raw["stream"].items()),
        messages=MappingProxyType({n: _message(n, v) for n, v in raw["messages"].items()}),
    )


def _entries(raw: Mapping[str, Any]) -> tuple[Entry, ...]:
    return tuple(Entry(name=name, value=value[0], about=value[1]) for name, value in raw.items())


def _message(name: str, raw: Mapping[str, Any]) -> MessageType:
    fields = tuple(
        FieldType(name=n, kind=kind.removesuffix("[]"), many=kind.endswith("[]"), about=about)
        for n, kind, about in raw["fields"]
    )
    return MessageType(name=name, code=raw["code"], to=raw["to"], about=raw["about"], fields=fields)
