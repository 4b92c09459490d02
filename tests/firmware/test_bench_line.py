"""The emulated serial line: nothing is lost towards either end; what is to be lost or damaged is, and is counted."""

import time

import numpy as np
import pytest

from tests.firmware.probe_host import Line

PLANT = "kind linear\nm 1\nk_x 0\nk_i 0\nR 1\nL 1e-2\nhigh_voltage 24\nlow_voltage -24\n"


@pytest.fixture
def probe(emulated, probe_elf, tmp_path):
    lines = []

    def start(**options):
        path = tmp_path / "bench.plant"
        path.write_text(PLANT)
        bench = emulated(path, firmware=probe_elf, **options)
        lines.append(Line(bench.port))
        if "damage 1" not in options.get("script", ""):
            lines[-1].greet()
        return bench, lines[-1]

    yield start
    for line in lines:
        line.close()


def worked(pid):
    """Processor time of a process, in the system's ticks."""
    with open(f"/proc/{pid}/stat") as file:
        return int(file.read().rpartition(")")[2].split()[11])


def stands_still(pid):
    before = worked(pid)
    time.sleep(0.3)
    return worked(pid) == before


def ticks_of(stream):
    return np.frombuffer(stream[: len(stream) // 6 * 6], "<u2").reshape(-1, 3)[:, 0].astype(int)


def test_a_host_that_does_not_read_is_waited_for(probe):
    bench, line = probe(lockstep_ms=0)
    line.write(b"s\x01")
    stream = line.read(6000)
    line.wait_for(lambda: stands_still(bench.pid))
    stood = line.read(60000)
    line.wait_for(lambda: stands_still(bench.pid))
    ticks = ticks_of(stream + stood + line.read(120000))
    assert ticks.size == 31000
    assert np.array_equal(np.diff(ticks) % 65536, np.ones(ticks.size - 1))
    line.write(b"s\x00")
    line.read_until_quiet(0.2)
    bench.close(keep=True)
    assert bench.events("end")[0]["damaged"] == bench.events("end")[0]["vanished"] == 0


def test_a_byte_takes_ten_bits_at_the_speed_that_the_registers_say(probe):
    _, line = probe()
    line.write(b"t" + b"g\xff" * 25 + b"t")
    first = line.read(4)
    assert line.read(25 * 255) == bytes(range(255)) * 25
    ticks = int.from_bytes(line.read(4), "little") - int.from_bytes(first, "little")
    # All but the 255 that are still queued at the second look: 6124 bytes at 100 000 bytes/s are 122.5 ticks of 0.5 ms;
    # with eleven bits to a byte they would be 134.7.
    assert 122 <= ticks <= 124


def test_no_byte_to_the_controller_is_lost(probe):
    bench, line = probe()
    asked = bytes(k for n in range(30) for k in (ord("x"), n))
    for _ in range(40):
        assert line.ask(asked, 30) == bytes(range(30))
    bench.close(keep=True)
    end = bench.events("end")[0]
    assert end["to_controller"] >= 40 * 60
    assert end["late"] == 0


def test_what_nobody_hears_is_counted(probe):
    bench, line = probe(lockstep_ms=0)
    line.write(b"s\x01")
    line.read(600)
    line.close()
    line.wait_for(lambda: [e["open"] for e in bench.events("host")] == [1, 0])
    before = worked(bench.pid)
    line.wait_for(lambda: worked(bench.pid) > before + 10)
    with Line(bench.port) as again:
        first = ticks_of(again.read(12))
        line.wait_for(lambda: len(bench.events("host")) >= 3)
        again.write(b"s\x00")
        again.read_until_quiet(0.2)
    bench.close(keep=True)
    assert first.size == 2
    assert bench.events("end")[0]["unheard"] > 0
    assert [e["open"] for e in bench.events("host")][:3] == [1, 0, 1]


def test_a_cut_cable_swallows_both_directions_and_says_how_much(probe):
    bench, line = probe(script="+0.01 cable cut\n+0.02 cable mend")
    line.write(b"e\x01s\x01")
    assert line.read(1) == b"e"
    line.wait_for(lambda: len(bench.events("script")) == 2)
    ticks = ticks_of(line.read(6 * 100))
    steps = np.diff(ticks)
    assert sorted(set(steps.tolist()))[0] == 1
    assert steps.max() == pytest.approx(21, abs=1)
    assert np.count_nonzero(steps != 1) == 1
    line.write(b"s\x00")
    line.read_until_quiet(0.2)
    bench.close(keep=True)
    assert bench.events("end")[0]["vanished"] == pytest.approx(120, abs=6)


def test_a_damaged_line_turns_one_bit_of_a_byte(probe):
    bench, line = probe(script="0 line damage 1")
    line.write(b"\xff" * 60)
    said = line.read(60)
    line.read_until_quiet(0.2)
    bench.close(keep=True)
    # The probe sees no letter that it knows, and answers '?'; the boot letter may come first.
    assert {(byte ^ ord("?")).bit_count() for byte in said[1:]} == {1}
    assert bench.events("end")[0]["damaged"] >= 120


def test_a_line_may_be_damaged_now_and_then(probe):
    bench, line = probe(script="+0.01 line damage 0.02")
    line.write(b"e\x01s\x01")
    stream = line.read(900)
    bench.close(keep=True)
    end = bench.events("end")[0]
    assert 0 < end["damaged"] < 0.05 * (end["to_host"] + end["to_controller"])
    steps = np.diff(ticks_of(stream[1:]))
    assert np.count_nonzero(steps[:15] != 1) == 0
    assert np.count_nonzero(steps != 1) > 0
