"""Frames of the firmware: encoding, and a decoder that no damage upsets (bar 5, the controller's end)."""

import binascii

import numpy as np
import pytest

from tests.firmware.native.console import IDLE, Console, build, command, stand
from tests.firmware.native.line_code import expected, frame


@pytest.fixture(scope="module")
def console(native_cc, tmp_path_factory):
    """The C of the firmware on this machine."""
    return Console(build(native_cc, tmp_path_factory.mktemp("console")))


def _bodies(rng, n):
    """Bodies of all lengths, rich in zeros."""
    for _ in range(n):
        body = rng.integers(0, 256, int(rng.integers(1, 63)), dtype=np.uint8)
        body[rng.random(body.size) < rng.choice([0.0, 0.2, 0.9])] = 0
        yield body.tobytes()


def test_reference_vectors(console):
    # CRC-16/XMODEM of "123456789" is 0x31c3 by its catalogue; the stuffing by hand.
    assert binascii.crc_hqx(b"123456789", 0) == 0x31C3
    lines = console(["encode 313233343536373839", "encode 1100", "encode 00"])
    assert lines[0] == "0c313233343536373839c33100"
    assert lines[1] == frame(b"\x11\x00").hex()
    assert lines[2] == "0101010100"


def test_encoding_at_every_place_of_the_ring(console):
    bodies = list(_bodies(np.random.default_rng(1), 600))
    lines = console(["encode " + b.hex() for b in bodies])
    assert lines == [frame(b).hex() for b in bodies]


def test_decoder_gives_back_what_was_encoded(console):
    bodies = list(_bodies(np.random.default_rng(2), 500))
    line = b"".join(frame(b) + b"\0" * (i % 3) for i, b in enumerate(bodies))
    assert console(["feed 00" + line.hex()])[0].split() == [b.hex() for b in bodies]


def test_a_million_random_bytes(console):
    rng = np.random.default_rng(3)
    noise = rng.integers(0, 256, 1_000_000, dtype=np.uint8)
    noise[rng.random(noise.size) < 0.03] = 0  # so that runs of a frame's length come often
    good = [b"\x1b\x05", b"\x1c\x06"]
    line = noise.tobytes() + b"\x55" + b"".join(map(frame, good))
    found = console(["feed " + line.hex()])[0].split()
    assert found == expected(line)
    assert found.count("-") > 20_000
    assert found[-1] == good[-1].hex()  # the first is spoilt by the noise before it, the second is sound


def _mutated(rng, whole):
    """Damage of one of the kinds that lines know."""
    data = bytearray(whole)
    at = int(rng.integers(0, len(data)))
    match int(rng.integers(0, 5)):
        case 0:
            data[at] ^= 1 << int(rng.integers(0, 8))
        case 1:
            del data[at]
        case 2:
            data.insert(at, int(rng.integers(0, 256)))
        case 3:
            del data[at : at + int(rng.integers(1, 9))]
        case _:
            data[at:at] = rng.integers(0, 256, int(rng.integers(1, 80)), dtype=np.uint8).tobytes()
    return bytes(data)


def test_ten_thousand_mutated_frames(console):
    rng = np.random.default_rng(4)
    line, sound = bytearray(), []
    for i, body in enumerate(_bodies(rng, 10_000)):
        line += _mutated(rng, frame(body))
        sound += [bytes([0x1B, 1 + i % 250, i % 256]), bytes([0x1C, 1 + i % 250, i // 256])]
        line += frame(sound[-2]) + frame(sound[-1])
    found = console(["feed " + line.hex()])[0].split()
    assert found == expected(bytes(line))
    # Back in step within two frames of every damage: all of the second ones are there, in their order.
    seconds = [s.hex() for s in sound[1::2]]
    known = set(seconds)
    assert [f for f in found if f in known] == seconds
    assert found.count("-") > 8_000


def test_the_main_loop_answers_after_any_damage(console):
    rng = np.random.default_rng(5)
    body = bytes.fromhex(command("ping", 7).split()[1])
    requests = []
    for _ in range(1_000):
        requests += ["line " + _mutated(rng, frame(body)).hex(), "line " + 2 * frame(body).hex()]
    lines = console(requests)
    answer = frame(bytes([0x02, 7, 0, 0, 0])).hex()
    assert all(line.count(answer) >= 1 for line in lines[1::2])
    assert stand(lines[-1]).state == IDLE
    damaged = sum(line.startswith(" ") for line in lines[::2])
    # A damaged frame without its zero takes the next frame with it, as one damage.
    assert stand(lines[-1]).rx_errors >= damaged > 500
