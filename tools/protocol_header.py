"""Make what follows from the table of the wire protocol: ``.venv/bin/python tools/protocol_header.py [--check]``.

The controller's side is ``firmware/amb_daq/protocol.h``: constants, and for every message one function that reads it
and one that writes it, byte by byte, in C99 that is C++ and Arduino too. The reference page is ``docs/protocol.md``.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ambid.acquisition.protocol import CRC_BYTES, FORMATS, Entry, FieldType, MessageType, Table, table
from ambid.acquisition.protocol.codec import frame, message, pack

ROOT = Path(__file__).resolve().parents[1]

_SIDES = ("host", "controller")
_NAME = re.compile(r"[a-z][a-z0-9_]*")


def complaints(made: Table) -> Iterator[str]:
    """Say which rules of the wire or of the two languages a table breaks."""
    if not 0 < made.version < 256:
        yield f"version {made.version} does not fit a byte"
    if not 0 < made.largest <= 254:
        yield f"largest = {made.largest}: a frame of COBS with one block per zero byte has at most 254 bytes"
    for group, entries in [*made.enums.items(), *made.bits.items()]:
        yield from _twice(f"group {group}", [e.value for e in entries])
        most = 16 if group in made.bits else 256
        yield from (f"{group}.{e.name}: {e.value} is out of range" for e in entries if not 0 <= e.value < most)
    if [c.bit for c in made.stream] != list(range(len(made.stream))) or len(made.stream) > 8:
        yield "stream: bits are to be 0, 1, ... in order, 8 at most"
    yield from (f"stream.{c.name}: {c.kind} has not two bytes" for c in made.stream if c.kind not in ("u16", "i16"))
    for side in _SIDES:
        yield from _twice(f"codes to the {side}", [m.code for m in made.messages.values() if m.to == side])
    for kind in made.messages.values():
        yield from _complaints_of_message(kind, made.largest)
    names = [*made.enums, *made.bits, *(c.name for c in made.stream), *made.messages]
    names += [f.name for m in made.messages.values() for f in m.fields]
    yield from (f"{name!r} is no name in both languages" for name in names if not _NAME.fullmatch(name))
    texts = [e.about for entries in [*made.enums.values(), *made.bits.values()] for e in entries]
    texts += [c.about for c in made.stream] + [m.about for m in made.messages.values()]
    texts += [f.about for m in made.messages.values() for f in m.fields]
    yield from (f"{text!r} would end a comment or a row" for text in texts if re.search(r"\*/|/\*|[|\n\\]", text))


def _complaints_of_message(message: MessageType, largest: int) -> Iterator[str]:
    where = f"message {message.name}"
    if message.to not in _SIDES:
        yield f"{where}: to = {message.to!r}; it is one of {', '.join(_SIDES)}"
    if not 0 < message.code < 256:
        yield f"{where}: code {message.code} is not within 1 to 255"
    yield from _twice(where, [f.name for f in message.fields])
    for field in message.fields:
        if field.kind not in FORMATS:
            yield f"{where}: {field.name} has type {field.kind!r}; known are {', '.join(FORMATS)}"
        elif field.many and field is not message.fields[-1]:
            yield f"{where}: {field.name} is the rest of the frame, but others follow"
    if all(f.kind in FORMATS for f in message.fields) and message.length + CRC_BYTES > largest:
        yield f"{where}: {message.length + CRC_BYTES} bytes; the largest frame has {largest}"


def _twice(where: str, values: list[Any]) -> Iterator[str]:
    yield from (f"{where}: {value!r} stands twice" for value in sorted({v for v in values if values.count(v) > 1}))


_TYPES = {"u8": "uint8_t", "u16": "uint16_t", "u32": "uint32_t", "i8": "int8_t", "i16": "int16_t", "i32": "int32_t"}

_HEADER_HEAD = """\
/*
 * The wire protocol, version {version}: made by tools/protocol_header.py
 * from src/ambid/acquisition/protocol/messages.toml. Change the table, not this file.
 *
 * A frame is COBS( code | fields, little endian | CRC-16/XMODEM, low byte first ) 0x00.
 * read_NAME(p) takes the bytes from the code on, already found sound and long enough (LENGTH_NAME); write_NAME(p, ...)
 * puts code and fields at p and returns how many bytes these are. Neither knows of the CRC.
 * A message that ends in an array: LENGTH_NAME counts none of its elements; read_NAME(p, length) says how many there
 * are, and NAME_FIELD(p, i) gives the one with index i.
 */
#ifndef AMB_DAQ_PROTOCOL_H
#define AMB_DAQ_PROTOCOL_H

#include <stdint.h>

#define PROTOCOL_VERSION {version}
#define PROTOCOL_BAUD {baud}UL
#define FRAME_LARGEST {largest} /* bytes of code, fields and CRC */
"""

_BYTES = """\
static inline uint8_t get_u8(const uint8_t *p) { return p[0]; }
static inline uint16_t get_u16(const uint8_t *p) { return (uint16_t)(p[0] | (uint16_t)((uint16_t)p[1] << 8)); }
static inline uint32_t get_u32(const uint8_t *p) { return get_u16(p) | ((uint32_t)get_u16(p + 2) << 16); }
static inline int8_t get_i8(const uint8_t *p) { return (int8_t)get_u8(p); }
static inline int16_t get_i16(const uint8_t *p) { return (int16_t)get_u16(p); }
static inline int32_t get_i32(const uint8_t *p) { return (int32_t)get_u32(p); }

static inline void put_u8(uint8_t *p, uint8_t v) { p[0] = v; }
static inline void put_u16(uint8_t *p, uint16_t v) { p[0] = (uint8_t)v; p[1] = (uint8_t)(v >> 8); }
static inline void put_u32(uint8_t *p, uint32_t v) { put_u16(p, (uint16_t)v); put_u16(p + 2, (uint16_t)(v >> 16)); }
static inline void put_i8(uint8_t *p, int8_t v) { put_u8(p, (uint8_t)v); }
static inline void put_i16(uint8_t *p, int16_t v) { put_u16(p, (uint16_t)v); }
static inline void put_i32(uint8_t *p, int32_t v) { put_u32(p, (uint32_t)v); }
"""


def c_header(table: Table) -> str:
    """Return the text of the C header.

    `table`: the protocol. Returns C99 and C++, ending in a line feed.
    """
    parts = [_HEADER_HEAD.format(version=table.version, baud=table.baud, largest=table.largest)]
    messages = list(table.messages.values())
    parts.append(_defines("MSG", [(m.name, f"0x{m.code:02x}", f"to the {m.to}: {m.about}") for m in messages]))
    parts.append(_defines("LENGTH", [(m.name, str(m.length), "") for m in messages]))
    parts += [_enum(group, entries) for group, entries in table.enums.items()]
    parts += [_mask(group, [(e.name, e.value, e.about) for e in entries]) for group, entries in table.bits.items()]
    parts.append(_mask("stream", [(c.name, c.bit, f"{c.kind}: {c.about}") for c in table.stream]))
    parts.append(
        f"#define STREAM_ALL 0x{(1 << len(table.stream)) - 1:02x}\n#define STREAM_COLUMNS {len(table.stream)}\n"
    )
    parts.append(_BYTES)
    parts += [_functions(m) for m in messages]
    return "\n".join(parts) + "\n#endif\n"


def _defines(prefix: str, entries: Sequence[tuple[str, str, str]]) -> str:
    lines = (f"#define {prefix}_{n.upper()} {v}" + (f" /* {about} */" if about else "") for n, v, about in entries)
    return "".join(f"{line}\n" for line in lines)


def _enum(group: str, entries: Sequence[Entry]) -> str:
    return _defines(group.upper(), [(e.name, str(e.value), e.about) for e in entries])


def _mask(group: str, bits: Sequence[tuple[str, int, str]]) -> str:
    return _defines(group.upper(), [(name, f"0x{1 << bit:02x}", about) for name, bit, about in bits])


def _functions(message: MessageType) -> str:
    parts = [f"/* {message.name}: {message.about} */\n", *_struct(message), *_read(message)]
    if message.tail:
        parts += _element(message, message.tail)
    return "".join([*parts, *_write(message)])


def _struct(message: MessageType) -> Iterator[str]:
    yield f"struct msg_{message.name} {{\n"
    for field in message.fixed:
        yield f"    {_TYPES[field.kind]} {field.name}; /* {field.about} */\n"
    if message.tail:
        yield f"    uint8_t n_{message.tail.name}; /* number of elements: {message.tail.about} */\n"
    yield "};\n"


def _offsets(message: MessageType) -> Iterator[tuple[FieldType, int]]:
    at = 1
    for field in message.fixed:
        yield field, at
        at += field.width


def _read(message: MessageType) -> Iterator[str]:
    length = ", uint8_t length" if message.tail else ""
    yield f"static inline struct msg_{message.name} read_{message.name}(const uint8_t *p{length})\n{{\n"
    yield f"    struct msg_{message.name} m;\n"
    for field, at in _offsets(message):
        yield f"    m.{field.name} = get_{field.kind}(p + {at});\n"
    if message.tail:
        elements = f"(length - LENGTH_{message.name.upper()})"
        elements += f" / {message.tail.width}" if message.tail.width > 1 else ""
        yield f"    m.n_{message.tail.name} = (uint8_t)({elements});\n"
    yield "    return m;\n}\n"


def _element(message: MessageType, tail: FieldType) -> Iterator[str]:
    step = f"(uint8_t)({tail.width} * i)" if tail.width > 1 else "i"
    yield f"static inline {_TYPES[tail.kind]} {message.name}_{tail.name}(const uint8_t *p, uint8_t i)\n{{\n"
    yield f"    return get_{tail.kind}(p + LENGTH_{message.name.upper()} + {step});\n}}\n"


def _write(message: MessageType) -> Iterator[str]:
    arguments = "".join(f", {_TYPES[f.kind]} {f.name}" for f in message.fixed)
    tail = message.tail
    if tail:
        arguments += f", const {_TYPES[tail.kind]} *{tail.name}, uint8_t n_{tail.name}"
    yield f"static inline uint8_t write_{message.name}(uint8_t *p{arguments})\n{{\n"
    if tail:
        yield "    uint8_t i;\n"
    yield f"    p[0] = MSG_{message.name.upper()};\n"
    for field, at in _offsets(message):
        yield f"    put_{field.kind}(p + {at}, {field.name});\n"
    if not tail:
        yield f"    return LENGTH_{message.name.upper()};\n}}\n"
        return
    step = f"(uint8_t)({tail.width} * i)" if tail.width > 1 else "i"
    yield f"    for (i = 0; i < n_{tail.name}; i++)\n"
    yield f"        put_{tail.kind}(p + LENGTH_{message.name.upper()} + {step}, {tail.name}[i]);\n"
    size = f"{tail.width} * n_{tail.name}" if tail.width > 1 else f"n_{tail.name}"
    yield f"    return (uint8_t)(LENGTH_{message.name.upper()} + {size});\n}}\n"


_PAGE_HEAD = """\
# The wire protocol

What host and controller say to each other, version {version}. This page, the host's codec and the controller's header
`firmware/amb_daq/protocol.h` are made from one table, `src/ambid/acquisition/protocol/messages.toml`;
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
        _PAGE_HEAD.format(
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
        parts += ["\n".join(_section(m)) for m in table.messages.values() if m.to == to]
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


def _section(kind: MessageType) -> Iterator[str]:
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


def made() -> dict[Path, str]:
    """Return the files that are made from the table.

    Returns
    -------
    dict of Path to str
        Each file and its text.
    """
    if wrong := list(complaints(table())):
        raise ValueError("; ".join(wrong))
    return {
        ROOT / "firmware" / "amb_daq" / "protocol.h": c_header(table()),
        ROOT / "docs" / "protocol.md": protocol_page(table()),
    }


def main(arguments: list[str]) -> int:
    """Write the files, or with ``--check`` only say which are out of date.

    Parameters
    ----------
    arguments : list of str
        ``[]`` or ``["--check"]``.

    Returns
    -------
    int
        0, or 1 where a file is out of date.
    """
    stale = [p for p, text in made().items() if not p.is_file() or p.read_text(encoding="utf-8") != text]
    if arguments == ["--check"]:
        for path in stale:
            print(
                f"protocol: {path.relative_to(ROOT)} is out of date. Run `python tools/protocol_header.py`",
                file=sys.stderr,
            )
        return 1 if stale else 0
    for path in stale:
        path.write_text(made()[path], encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
