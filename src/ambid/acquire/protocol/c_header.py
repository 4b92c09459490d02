"""The controller's side of the protocol: the text of ``firmware/amb_daq/protocol.h``, from the same table.

Constants, and for every message one function that reads it and one that writes it, byte by byte, in C99 that is C++
and Arduino too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from ambid.acquire.protocol.table import Entry, FieldType, MessageType, Table

_TYPES = {"u8": "uint8_t", "u16": "uint16_t", "u32": "uint32_t", "i8": "int8_t", "i16": "int16_t", "i32": "int32_t"}

_HEAD = """\
/*
 * The wire protocol, version {version}: made from src/ambid/acquire/protocol/messages.toml by tools/protocol_header.py.
 * Change the table, not this file.
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
    parts = [_HEAD.format(version=table.version, baud=table.baud, largest=table.largest)]
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
    parts += [_message(m) for m in messages]
    return "\n".join(parts) + "\n#endif\n"


def _defines(prefix: str, entries: Sequence[tuple[str, str, str]]) -> str:
    lines = (f"#define {prefix}_{n.upper()} {v}" + (f" /* {about} */" if about else "") for n, v, about in entries)
    return "".join(f"{line}\n" for line in lines)


def _enum(group: str, entries: Sequence[Entry]) -> str:
    return _defines(group.upper(), [(e.name, str(e.value), e.about) for e in entries])


def _mask(group: str, bits: Sequence[tuple[str, int, str]]) -> str:
    return _defines(group.upper(), [(name, f"0x{1 << bit:02x}", about) for name, bit, about in bits])


def _message(message: MessageType) -> str:
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
