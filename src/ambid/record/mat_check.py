"""Whether the elements of a MATLAB file of version 5 fit into one another: else SciPy's parser may end the program.

MAT-File Format (MathWorks), chapter 1. Compressed elements have a checksum of their own and are left to the parser.
"""

from __future__ import annotations

import math
import struct

# bytes of numbers by type
_SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8, 16: 1, 17: 2, 18: 4}
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _OBJECT, _CHAR, _SPARSE, _FUNCTION = 1, 2, 3, 4, 5, 16
_DEEPEST = 100


def check_elements(data: bytes) -> None:
    """Raise ValueError where an element of a file of version 5 is damaged."""
    if 0 in data[:4]:  # version 4
        return
    if data[124:128] not in (b"\0\1IM", b"\1\0MI"):
        raise ValueError("its head is of no version")
    order = "<" if data[126:128] == b"IM" else ">"
    at = 128
    while at < len(data):
        kind, begin, size, following = _element(data, at, len(data), order)
        if kind == _MATRIX:
            _check_matrix(data, begin, begin + size, order, 0)
        elif kind != _COMPRESSED:
            raise ValueError(f"an element of type {kind} at byte {at}")
        at = begin + size if kind == _COMPRESSED else following


def _element(data: bytes, at: int, end: int, order: str) -> tuple[int, int, int, int]:
    """Return type, begin, size and what follows an element, which must lie before `end`."""
    if at + 8 > end:
        raise ValueError(f"half an element at byte {at}")
    word, size = struct.unpack_from(f"{order}II", data, at)
    kind, begin = word, at + 8
    if word >> 16:  # a small one
        kind, size, begin = word & 0xFFFF, word >> 16, at + 4
    following = at + 8 if word >> 16 else begin + size + (-size % 8 if kind != _COMPRESSED else 0)
    if (kind not in _SIZES and kind not in (_MATRIX, _COMPRESSED)) or begin + size > (at + 8 if word >> 16 else end):
        raise ValueError(f"an element of type {kind} and {size} bytes at byte {at}")
    return kind, begin, size, following


def _check_matrix(data: bytes, at: int, end: int, order: str, depth: int) -> None:
    if at == end:
        return
    if depth > _DEEPEST:
        raise ValueError("structures within structures without end")

    def number(kinds: tuple[int, ...]) -> tuple[int, int, int]:
        nonlocal at
        kind, begin, size, at = _element(data, at, end, order)
        if kind not in kinds:
            raise ValueError(f"an element of type {kind} at byte {begin}")
        return kind, begin, size

    _, begin, size = number((6,))
    if size != 8:
        raise ValueError("flags of an array")
    flags = struct.unpack_from(f"{order}I", data, begin)[0]
    array = flags & 0xFF
    if array > _FUNCTION:  # an object, which is not read
        return
    _, begin, size = number((5, 6))
    shape = struct.unpack_from(f"{order}{size // 4}i", data, begin)
    if len(shape) < 2 or size % 4 or min(shape) < 0:
        raise ValueError(f"an array of shape {shape}")
    number((1, 2, 16))
    count = math.prod(shape)
    if array == _OBJECT:
        number((1, 2, 16))
    if array in (_STRUCT, _OBJECT):
        _, begin, size = number((5, 6))
        longest = struct.unpack_from(f"{order}i", data, begin)[0] if size == 4 else 0
        _, begin, size = number((1, 2, 16))
        if longest < 1 or size % longest:
            raise ValueError("names of fields")
        count *= size // longest
    if array in (_STRUCT, _OBJECT, _CELL, _FUNCTION):
        for _ in range(1 if array == _FUNCTION else count):
            _, begin, size = number((_MATRIX,))
            _check_matrix(data, begin, begin + size, order, depth + 1)
        return
    for _ in range(2 if array == _SPARSE else 0):
        number((5, 6))
    for _ in range(2 if flags & 0x800 else 1):
        kind, _, size = number(tuple(_SIZES))
        if array not in (_CHAR, _SPARSE) and size != count * _SIZES[kind]:
            raise ValueError(f"{size} bytes for an array of shape {shape}")
