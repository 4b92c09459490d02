"""Frames: every bit comes back, in the narrowest type, and no wrong byte passes."""

import numpy as np
import pytest

from ambid.acquisition.recorder import journal as layout
from ambid.acquisition.recorder.journal import (
    BLOCK,
    Head,
    frame_bytes,
    head_of,
    is_whole,
    packed_values,
    unpacked_values,
)
from tests.acquisition.recorder.signals import same_bits


def framed(values, **more):
    code, payload = packed_values(np.asarray(values, dtype=float))
    n, columns = np.shape(values)
    head = Head(
        kind=BLOCK, journal=7, frame=3, block=2, length=len(payload), first=40, time_s=0.02,
        n_samples=n, n_columns=columns, dtype=code, **more,
    )  # fmt: skip
    return head, frame_bytes(head, payload)


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ([[0.0, 1023.0], [-32768.0, 32767.0]], "int16"),
        ([[0.0], [65535.0]], "uint16"),
        ([[-1.0], [65535.0]], "int32"),
        ([[0.0], [2.0**31]], "float32"),
        ([[0.0], [-0.0]], "float32"),  # no integer has a negative zero
        ([[0.5], [float("inf")]], "float32"),
        ([[1.0], [float("nan")]], "float32"),
        ([[2.0**53]], "float32"),
        ([[1.0], [0.1]], "float64"),
        ([[1e300]], "float64"),
        ([[float(2**53 - 1)]], "float64"),
        ([[np.frombuffer(np.uint64(0x7FF8000000000123).tobytes(), dtype=float)[0]]], "float64"),  # a NaN of its own
    ],
)
def test_values_take_the_narrowest_type_that_keeps_every_bit(values, name):
    values = np.array(values, dtype=float)
    code, payload = packed_values(values)
    assert code == layout.TYPES[name][0]
    head, data = framed(values)
    assert head_of(data) == head
    assert is_whole(data, head)
    assert len(data) == head.size
    back = unpacked_values(data[layout.HEAD_SIZE : layout.HEAD_SIZE + head.length], head)
    assert same_bits(back, values)
    assert len(payload) == values.size * layout.TYPES[name][1].itemsize


def test_values_that_do_not_lie_row_by_row_come_back_in_place():
    values = np.asfortranarray(np.arange(12.0).reshape(4, 3))[::2]
    head, data = framed(values)
    assert same_bits(unpacked_values(data[layout.HEAD_SIZE : -4], head), values)


def test_no_wrong_bit_passes():
    head, data = framed([[1.0, 2.0], [3.0, 4.0]])
    for at in range(len(data)):
        for bit in range(8):
            wrong = bytearray(data)
            wrong[at] ^= 1 << bit
            found = head_of(bytes(wrong))
            assert found is None or (found == head and not is_whole(bytes(wrong), found)), (at, bit)


def test_nothing_short_passes():
    head, data = framed([[1.0, 2.0], [3.0, 4.0]])
    assert [n for n in range(len(data)) if head_of(data[:n]) and is_whole(data[:n], head)] == []


def test_a_head_that_contradicts_itself_is_none():
    _, payload = packed_values(np.ones((2, 2)))
    for wrong in ({"n_samples": 3}, {"n_columns": 1}, {"dtype": 9}):
        sizes = {"n_samples": 2, "n_columns": 2, "dtype": 1} | wrong
        head = Head(kind=BLOCK, journal=7, frame=0, block=0, length=len(payload), **sizes)
        assert head_of(frame_bytes(head, payload)) is None


def test_the_preamble_tells_the_version():
    assert layout.version_of(layout.preamble()) == layout.VERSION
    assert len(layout.preamble()) == layout.PREAMBLE_SIZE
    assert layout.version_of(layout.preamble()[:-1]) is None
    assert layout.version_of(b"X" + layout.preamble()[1:]) is None
