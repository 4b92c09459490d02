"""The reference page of the protocol: the text of ``docs/protocol.md``, from the same table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from ambid.acquire.protocol.codec import message, pack
from ambid.acquire.protocol.framing import frame
from ambid.acquire.protocol.table import CRC_BYTES, Entry, MessageType, Table

_HEAD = """\
# The wire protocol

What host and controller say to each other, version {version}. This page, the host's codec and the controller's header
`firmware/amb_daq/protocol.h` are made from one table, `src/ambid/acquire/protocol/messages.toml`;
`python tools/protocol_header.py` makes page and header anew, and a test says when one of them is stale.

The line is asynchronous serial, {baud} baud, 8 data bits, no parity, 1 stop bit.
The host requests, the controller decides: every command is answered, a refused one with the reason,
and the controller goes to its safe state by itself.

## Frames

A frame is

```text
COBS( code u8 | fields, little endian | CRC u16 ) 0x00
```

- **Fields** are integers, little endian, without padding. A type with `[]` is an array: the rest of the frame.
- **CRC** is CRC-16/XMODEM (polynomial 0x1021, start 0, not reflected, nothing inverted) over code and fields,
  low byte first. Of the ASCII text `123456789` it is 0x31c3.
- **COBS** (consistent overhead byte stuffing) takes every 0x00 out: the frame is cut at its zeros, and each part,
  an empty one too, is preceded by its length plus one. It adds one byte, as no frame is longer than {largest} bytes.
- **0x00** ends a frame and stands nowhere else. More of them between frames mean nothing.

### A worked example

The acknowledgement of command 7, refused in state 3 (code {state_code}, detail 3):

| step | bytes |
|---|---|
{example}

### Damage

A receiver that meets anything else than a sound frame discards all up to the next 0x00, counts it, and goes on:
the damaged frame is lost and, if its 0x00 was hit, the one after it. The host counts by reason (wrong CRC, wrong
length, unknown code, not COBS, overlong), and it counts every byte that belonged to no sound frame.
Samples that are missing are found by their numbers, and counted as well.

A check value of 16 bits cannot see everything: one in {collisions} frames that are damaged at random passes as sound.
With one frame in a million damaged, at 2000 frames in a second, that is once in a year.
Flipped bits and short bursts do less harm than that: of 1.5 million frames with one to eight bits flipped, bytes
overwritten or bytes swapped, two passed the host.
Such a frame must also have a known code and the length of its message; a sample must have the length of its stream
mask, a state and a cause that exist, and a number that goes on from the one before or that the next one goes on from.
A frame that passes all of this is taken for what it says.

## Versions

The controller names its version in `identity`. A host of another version refuses the controller with an error that
names both, and sends it nothing but `identify`. There is no half compatibility: firmware and host come together.

- **Never changes, in any version:** the framing above; `identify` (code 0x10, one field `id`); that `identity` has
  code 0x03 and begins with `id` and `protocol`. So any two versions can tell each other apart.
- **May change without a new version:** the words of this page; what the controller refuses with the codes below;
  new bits of `failed`; a new command of a code never used before, with an answer that it alone brings (a controller
  that does not know it answers `unknown`).
- **Needs a new version:** everything else. A field more or less, another width, order, unit or meaning; a new state,
  cause, code, mode, kind or column; a message to the host that no new command asked for.
  Codes of messages that were dropped are not used again.
"""


def protocol_page(table: Table) -> str:
    """Return the reference page of the protocol.

    Returns myST markdown, ending in a line feed.
    """
    state_code = table.value("code", "state")
    parts = [
        _HEAD.format(
            version=table.version,
            baud=table.baud,
            largest=table.largest,
            collisions=1 << 8 * CRC_BYTES,
            state_code=state_code,
            example="\n".join(_example(state_code)),
        )
    ]
    for to, title in (("host", "Controller to host"), ("controller", "Host to controller")):
        parts.append(f"## {title}\n")
        if to == "controller":
            parts.append(_COMMANDS)
        parts += ["\n".join(_message(m)) for m in table.messages.values() if m.to == to]
    parts.append("## Columns of a sample\n")
    parts.append(_STREAM)
    parts.append(
        _rows(("bit", "column", "type", "what"), [(c.bit, f"`{c.name}`", c.kind, c.about) for c in table.stream])
    )
    parts.append("## Named numbers\n")
    parts += [_group(f"Enum `{group}`", "value", entries) for group, entries in table.enums.items()]
    parts += [_group(f"Bits `{group}`", "bit", entries) for group, entries in table.bits.items()]
    return "\n".join(parts)


_COMMANDS = """\
Every command begins with `id`, its number from 1 to 255, which the answer repeats.
A command that comes again with number and code of the last one is answered again and not carried out: its answer was
lost.
`ping` and `ask_status` do not count as the last one; 200 further commands (pings too) and `identify` make the
controller forget it. A sound frame of a code below 0x10, which is an echo, is counted and gets no answer; neither it
nor another frame that is no command by code and length is a sign of life.
"""

_STREAM = """\
`configure` chooses the columns by a mask; a sample carries two bytes for each bit that is set, lowest bit first.
"""


def _example(state_code: int) -> Iterator[str]:
    what = message("ack", id=7, code=state_code, detail=3)
    payload, line = pack(what), frame(pack(what))
    crc = _crc(payload)
    yield f"| code and fields | `{payload.hex(' ')}` |"
    yield f"| CRC 0x{crc:04x}, low byte first | `{crc.to_bytes(CRC_BYTES, 'little').hex(' ')}` |"
    yield f"| COBS | `{line[:-1].hex(' ')}` |"
    yield f"| on the line | `{line.hex(' ')}` |"


def _crc(payload: bytes) -> int:
    """Return the CRC bit by bit, as the text says it, so that the example does not lean on the codec alone."""
    crc = 0
    for byte in payload:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (0x1021 if crc & 0x8000 else 0)) & 0xFFFF
    return crc


def _message(kind: MessageType) -> Iterator[str]:
    length = f"{kind.length} bytes of code and fields" + (", and the array" if kind.tail else "")
    yield f"### `{kind.name}` 0x{kind.code:02x}\n"
    yield f"{_sentence(kind.about)} ({length})\n"
    rows, at = [], 1
    for field in kind.fields:
        rows.append((at, f"`{field.name}`", field.kind + ("[]" if field.many else ""), field.about))
        at += field.width
    yield _rows(("byte", "field", "type", "what"), rows)


def _group(title: str, number: str, entries: Sequence[Entry]) -> str:
    return f"### {title}\n\n" + _rows((number, "name", "what"), [(e.value, f"`{e.name}`", e.about) for e in entries])


def _rows(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    lines = ["| " + " | ".join(str(cell) for cell in row) + " |" for row in [head, *rows]]
    return "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:]]) + "\n"


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + "."
