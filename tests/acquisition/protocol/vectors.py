"""Random messages for the tests of the protocol, from a seeded generator."""

from __future__ import annotations

import random

from ambid.acquisition.protocol import CRC_BYTES, FieldType, MessageType, table
from ambid.acquisition.protocol.codec import Message, message


def number(field: FieldType, source: random.Random) -> int:
    """Any value of the field; its ends, zero and the byte 0x00 inside it more often than chance has it."""
    low, high = field.span
    some = source.randrange(low, high + 1)
    without_low_byte = some & ~0xFF if field.width > 1 else some
    return source.choice([low, high, 0, 1, some, some, without_low_byte, some & 0x7F])


def random_message(kind: MessageType, source: random.Random) -> Message:
    """A message of this kind, with random fields (an identity speaks our version) and as much array as fits."""
    values: list[int] = []
    if tail := kind.tail:
        most = (table().largest - CRC_BYTES - kind.length) // tail.width
        values = [number(tail, source) for _ in range(source.choice([0, 1, most, source.randrange(most + 1)]))]
    fields = {f.name: number(f, source) for f in kind.fixed}
    if kind.name == "identity":
        fields["protocol"] = table().version
    return message(kind.name, values=values, **fields)


def sample(tick: int, values: list[int], *, state: int = 3, cause: int = 0) -> Message:
    """A sample as a levitating controller sends it."""
    return message("sample", tick=tick % 65536, state=state | cause << 4, values=values)
