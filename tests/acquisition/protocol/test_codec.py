"""Messages and frames: there and back, and against bytes worked out by hand."""

import random
import struct

import pytest

from ambid.acquisition.protocol import table
from ambid.acquisition.protocol.codec import (
    FrameCounters,
    FrameDecoder,
    Message,
    encode,
    frame,
    message,
    pack,
    refuse_other_version,
    unpack,
)
from ambid.errors import DeviceError
from tests.acquisition.protocol.vectors import random_message

KINDS = list(table().messages.values())


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_every_message_comes_back_as_it_was(kind):
    source = random.Random(kind.code)
    decoder = FrameDecoder(kind.to)
    sent = [random_message(kind, source) for _ in range(200)]
    line = b"".join(encode(m) for m in sent)
    assert [unpack(p, kind.to) for p in decoder.feed(line)] == sent
    assert decoder.counters.damaged == 0
    assert decoder.counters.kept_bytes == len(line)


# Worked out by hand from the table; check values with the bitwise shift register of its definition.
BY_HAND = [
    (message("stop", id=1), "19 01", "05 19 01"),
    (message("ack", id=7, code=4, detail=3), "02 07 04 03 00", "05 02 07 04 03 03"),
    (message("setpoint", id=9, setpoint=0x0200), "14 09 00 02", "03 14 09"),
    (message("sample", tick=0x0102, state=3, values=[0x03FF, 0]), "01 02 01 03 ff 03 00 00", "07 01"),
    (message("table", id=2, offset=1, values=[-1, 127, -127]), "16 02 01 00 ff 7f 81", "04 16 02 01"),
    (
        message("gains", id=1, kp=-2, ki=1, kd=0, pole=65535, kc=-(2**31), setpoint=1, current_rest=2, duty_bias=400),
        "13 01 fe ff ff ff 01 00 00 00 00 00 00 00 ff ff 00 00 00 80 01 00 02 00 90 01",
        "08 13 01 fe ff ff ff 01 01",
    ),
]


def crc_bit_by_bit(data):
    crc = 0
    for byte in data:
        for bit in range(8):
            top = crc >> 15 ^ byte >> 7 - bit & 1
            crc = crc << 1 & 0xFFFF ^ 0x1021 * top
    return crc


@pytest.mark.parametrize(("what", "payload", "begin"), BY_HAND, ids=lambda x: getattr(x, "name", ""))
def test_bytes_worked_out_by_hand(what, payload, begin):
    payload = bytes.fromhex(payload)
    assert pack(what) == payload
    line = encode(what)
    assert line.startswith(bytes.fromhex(begin))
    body = payload + struct.pack("<H", crc_bit_by_bit(payload))
    assert len(line) == len(body) + 2
    assert line.endswith(b"\0")
    assert line.count(0) == 1
    assert undo_cobs(line[:-1]) == body


def undo_cobs(stuffed):
    """The definition: a length, that many bytes less one, and a zero between the blocks."""
    blocks = []
    while stuffed:
        blocks.append(stuffed[1 : stuffed[0]])
        stuffed = stuffed[stuffed[0] :]
    return b"\0".join(blocks)


def test_the_whole_frame_of_a_stop_and_the_published_check_value():
    assert crc_bit_by_bit(b"123456789") == 0x31C3  # the catalogue's check value of CRC-16/XMODEM
    assert crc_bit_by_bit(b"\x19\x01") == 0xA9CA
    assert encode(message("stop", id=1)) == bytes.fromhex("05 19 01 ca a9 00")


def test_pieces_of_any_size_give_the_same():
    source = random.Random(5)
    line = b"".join(encode(random_message(k, source)) for k in KINDS * 20 if k.to == "host") + b"\xff" * 100 + b"\0\0\1"
    whole = FrameDecoder()
    expected = whole.feed(line)
    for size in (1, 2, 3, 7, 64, 65, 66, 67, 1000):
        decoder = FrameDecoder()
        found = [p for at in range(0, len(line), size) for p in decoder.feed(memoryview(line)[at : at + size])]
        assert found == expected
        assert decoder.counters == whole.counters
        assert decoder.pending == whole.pending == 1


GOOD = frame(pack(message("ack", id=1, code=0, detail=0)))
DAMAGE = {
    "crc": GOOD.replace(b"\x02\x01", b"\x02\x03", 1),
    "cobs": b"\x09\x01\x01\0",
    "code": frame(b"\x7f\x01"),
    "length": frame(b"\x02\x01\x02"),
    "overlong": b"\x01" * 66 + b"\0",
}


@pytest.mark.parametrize("reason", [*DAMAGE, "length of nothing"])
def test_damage_is_counted_by_its_reason_and_the_next_frame_is_found(reason):
    line = DAMAGE.get(reason, b"\x01\x01\0")
    decoder = FrameDecoder()
    assert decoder.feed(line + GOOD) == [b"\x02\x01\x00\x00\x00"]
    wanted = {"frames": 1, "kept_bytes": len(GOOD), "discarded_bytes": len(line), reason.split()[0]: 1}
    assert decoder.counters == FrameCounters(**wanted)
    assert decoder.counters.damaged == 1


def test_a_command_is_no_message_to_the_host():
    decoder = FrameDecoder("host")
    assert decoder.feed(encode(message("stop", id=1))) == []
    assert decoder.counters.code == 1
    with pytest.raises(DeviceError, match="no known code"):
        unpack(b"\x19\x01", "host")


def test_empty_frames_are_no_damage():
    decoder = FrameDecoder()
    assert decoder.feed(b"\0\0" + GOOD + b"\0") != []
    assert (decoder.counters.empty, decoder.counters.damaged) == (3, 0)


def test_another_version_gets_through_to_be_named_and_refused():
    payload = bytes([0x03, 1, table().version + 1, 9, 9, 9])  # longer or shorter: it is another version's
    decoder = FrameDecoder()
    assert decoder.feed(frame(payload)) == [payload]
    with pytest.raises(DeviceError, match=rf"version {table().version + 1} .* version {table().version} only"):
        unpack(payload)
    with pytest.raises(DeviceError, match="firmware of this ambid"):
        refuse_other_version(0)
    refuse_other_version(table().version)
    ours = bytes([0x03, 1, table().version, 9, 9, 9])
    assert decoder.feed(frame(ours)) == []
    assert decoder.counters.length == 1


WRONG = {
    "name": ({"name": "stopp", "id": 1}, "no message 'stopp'. Did you mean 'stop'"),
    "field": ({"name": "stop", "id": 1, "mode": 1}, "no field 'mode'"),
    "missing": ({"name": "start", "id": 1}, "lacks its field 'mode'"),
    "range": ({"name": "stop", "id": 256}, "id = 256 does not fit u8.*0 to 255"),
    "element": ({"name": "table", "id": 1, "offset": 0, "values": [128]}, r"values\[0\] = 128"),
    "too many": ({"name": "table", "id": 1, "offset": 0, "values": [0] * 59}, "at most 58"),
    "no array": ({"name": "stop", "id": 1, "values": [1]}, "ends in no array"),
}


@pytest.mark.parametrize(("given", "says"), WRONG.values(), ids=WRONG.keys())
def test_a_message_that_does_not_fit_is_refused(given, says):
    with pytest.raises(DeviceError, match=says):
        message(**given)


def test_packing_what_was_not_checked_says_what_is_wrong():
    with pytest.raises(DeviceError, match="id = 300"):
        pack(Message(name="stop", fields={"id": 300}))
    with pytest.raises(DeviceError, match="lacks its field 'id'"):
        pack(Message(name="stop"))


def test_a_frame_holds_what_the_table_says():
    assert len(frame(bytes(62))) == 66
    for wrong in (b"", bytes(63)):
        with pytest.raises(ValueError, match="1 to 62"):
            frame(wrong)
    with pytest.raises(DeviceError, match="has 3 bytes, expected 5"):
        unpack(b"\x02\x01\x01")
