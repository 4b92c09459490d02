"""Converter, pulse width and digital pins of the emulated controller, seen by a small firmware that only shows them."""

import csv

import numpy as np
import pytest

from tests.firmware.probe_host import Line

PLANT = {
    "kind": "linear",
    "m": 1e3,
    "k_x": 0.0,
    "k_i": 0.0,
    "R": 1.0,
    "L": 1e-2,
    "high_voltage": 24.0,
    "low_voltage": -24.0,
}


@pytest.fixture
def plant_file(tmp_path):
    def make(**entries):
        path = tmp_path / "bench.plant"
        path.write_text("".join(f"{k} {v}\n" for k, v in (PLANT | entries).items()))
        return path

    return make


@pytest.fixture
def probe(emulated, probe_elf, plant_file):
    """Start the probe before a plant: the emulator, and its open line."""
    lines = []

    def start(entries=None, **options):
        bench = emulated(plant_file(**(entries or {})), firmware=probe_elf, trajectory=True, **options)
        lines.append(Line(bench.port))
        lines[-1].greet()
        return bench, lines[-1]

    yield start
    for line in lines:
        line.close()


def trajectory(bench):
    with bench.trajectory_path.open() as file:
        rows = [[float(v) for v in row.values()] for row in csv.DictReader(file)]
    return np.array(rows)


def test_every_count_of_the_converter_is_reached_and_equally_wide(probe):
    # Pushed at the first ENABLE, the position runs over the whole range, and over both ends of it, in 2.1 s.
    motion = {"m": 1.0, "start_position": -0.1, "position_gain": 1.0, "third_offset": 1.0}
    bench, line = probe(motion, script="+0 pulse 2500 0.001")
    line.write(b"e\x01s\x01")
    assert line.read(1) == b"e"
    frames, said = [], b""
    while len(frames) < 4200:
        said += line.read(600)
        frames += [said[k : k + 6] for k in range(0, len(said) - 5, 6)]
        said = said[len(said) // 6 * 6 :]
        line.write(b"s\x01")  # keeps emulated time going
    bench.close(keep=True)
    ticks, counts, current = np.array([np.frombuffer(f, "<u2") for f in frames]).T.astype(int)
    assert np.array_equal(np.diff(ticks), np.ones(ticks.size - 1))
    assert not current.any()
    ideal = trajectory(bench)[ticks - 1, 1] / 5.0 * 1024.0
    clear = np.abs(ideal - np.rint(ideal)) > 1e-6
    assert np.array_equal(counts[clear], np.clip(np.floor(ideal[clear]), 0, 1023).astype(int))
    assert set(counts.tolist()) == set(range(1024))


def test_conversions_come_one_after_the_other_from_their_own_pins(probe):
    _, line = probe({"position_offset": 1.0, "current_offset": 2.0, "third_offset": 3.0})
    line.wait_ticks(2)
    assert np.frombuffer(line.ask(b"a", 6), "<u2").tolist() == [204, 409, 614]


@pytest.mark.parametrize("pwm", ["switched", "averaged"])
def test_the_pulse_is_as_wide_as_the_data_sheet_says(probe, pwm):
    cases = [(2, 0, 0), (2, 0, 1), (2, 0, 399), (2, 0, 798), (2, 0, 799), (2, 0, 900)]
    cases += [(3, 0, 0), (3, 0, 399), (3, 0, 799), (0, 0, 399), (0, 1, 399)]
    widths = [1, 2, 400, 799, 800, 800, 799, 400, 0, 0, 800]
    bench, line = probe({"pwm": pwm})
    for mode, level, value in cases:
        line.connect(mode, level)
        line.compare(value)
        line.wait_ticks(2)
        line.enable(1)
        line.wait_ticks(4)
        line.enable(0)
    bench.close(keep=True)
    edges = bench.events("enable")
    assert [e["duty"] for e in edges if e["level"]] == widths
    rows = trajectory(bench)
    for up, down, width in zip(edges[::2], edges[1::2], widths, strict=True):
        inside = rows[(rows[:, 0] > up["t"] + 5.1e-4) & (rows[:, 0] < down["t"])]
        assert len(inside) >= 2
        assert inside[:, 4] == pytest.approx(-24.0 + 48.0 * width / 800)
        assert inside[:, 5] == pytest.approx(width)


def test_a_new_pulse_width_acts_from_a_bottom_on(probe):
    bench, line = probe({})
    line.compare(199)  # the inputs are held within each pulse
    line.wait_ticks(2)
    line.enable(1)
    values = [699, 199, 599, 199, 499, 199, 699, 199]
    for value in values:
        line.wait_ticks(3)
        line.compare(value)
    line.wait_ticks(3)
    bench.close(keep=True)
    on = bench.events("enable")[0]["t"]
    rows = trajectory(bench)
    means = rows[rows[:, 0] > on + 5.1e-4][:, 4]
    ticks_high = (means + 24.0) / 48.0 * 8000  # of ten periods
    whole = [k * (value + 1) + (10 - k) * 200 for value in (699, 599, 499) for k in range(11)]
    assert np.abs(ticks_high[:, None] - np.array(whole)).min(axis=1) == pytest.approx(0.0, abs=1e-3)
    assert len({round(x) for x in ticks_high}) >= 4


def test_a_conversion_sees_the_current_of_that_moment(probe):
    bench, line = probe({"current_gain": 1.0, "current_offset": 0.0, "R": 1e-3})
    line.connect(0, 1)
    line.enable(1)
    line.wait_ticks(3)
    line.enable(0)
    line.wait_ticks(3)
    bench.close(keep=True)
    up, down = bench.events("enable")
    rows = trajectory(bench)
    inside = rows[(rows[:, 0] > up["t"]) & (rows[:, 0] < down["t"])]
    assert inside[:, 3] == pytest.approx(
        24.0 / 1e-3 * (1.0 - np.exp(-0.1 * (inside[:, 0] - up["t"]))), rel=1e-5, abs=1e-4
    )
    # Off: the diodes take it down as fast.
    after = rows[rows[:, 0] > down["t"]]
    assert after[-1, 3] == 0.0 or after[-1, 3] < inside[-1, 3]
    assert after[:, 5].max() == 0.0


def test_the_interlock_and_the_receive_line_are_at_their_pins(probe):
    script = "+0.01 interlock open\n+0.02 interlock closed\n+0.03 cable cut low\n+0.04 cable mend"
    bench, line = probe({}, script=script)
    assert line.ask(b"d", 1)[0] & 0x81 == 0x01
    line.ask(b"l", 1)
    line.enable(1)
    line.wait_for(lambda: len(bench.events("script")) == 4)
    assert line.ask(b"l", 1)[0] & 0x81 == 0x00
    assert line.ask(b"d", 1)[0] & 0x81 == 0x01
    assert line.ask(b"f", 1) == b"\x01"
    times = [e["t"] - bench.events("enable")[0]["t"] for e in bench.events("script")]
    assert times == pytest.approx([0.01, 0.02, 0.03, 0.04], abs=1e-4)
    assert min(times[k] - wanted for k, wanted in enumerate((0.01, 0.02, 0.03, 0.04))) >= -1e-7


def test_an_open_interlock_reads_high(probe):
    _, line = probe({}, script="0 interlock open")
    line.wait_ticks(2)
    assert line.ask(b"d", 1)[0] & 0x80


def test_the_script_forces_a_pin(probe):
    _, line = probe({"position_offset": 1.0}, script="+0.01 override position 4.0\n+0.02 override position off")
    line.write(b"e\x01s\x01")
    assert line.read(1) == b"e"
    counts = np.frombuffer(line.read(6 * 60), "<u2").reshape(-1, 3)[:, 1].tolist()
    assert set(counts) == {204, 819}
    assert counts.count(819) == pytest.approx(20, abs=1)


def test_the_script_pushes_the_rotor(probe):
    light = {"m": 1.0, "position_offset": 1.0}
    bench, line = probe(light, script="+0.01 pulse 2.0 0.005\n+0.03 force -1.0")
    line.enable(1)
    line.wait_ticks(90)
    bench.close(keep=True)
    begin = bench.events("script")
    rows = trajectory(bench)
    assert [e["text"] for e in begin] == ["+0.01 pulse 2.0 0.005", "end of pulse 2", "+0.03 force -1.0"]
    between = rows[(rows[:, 0] > begin[1]["t"]) & (rows[:, 0] < begin[2]["t"])]
    assert between[:, 2] == pytest.approx(2.0 * (begin[1]["t"] - begin[0]["t"]), rel=1e-4)
    later = rows[rows[:, 0] > begin[2]["t"] + 1e-3]
    assert np.diff(later[:, 2]) / np.diff(later[:, 0]) == pytest.approx(-1.0, rel=1e-3)


def test_a_reset_by_the_watchdog_takes_the_output_away(probe):
    bench, line = probe({"position_offset": 1.0})
    line.enable(1)
    line.wait_ticks(4)
    assert line.ask(b"h", 1) == b"w"
    line.wait_ticks(2)
    assert np.frombuffer(line.ask(b"a", 6), "<u2")[0] == 204
    assert line.ask(b"d", 1)[0] & 0x81 == 0x01
    assert [e["level"] for e in bench.events("enable")] == [1, 0]
    assert len(bench.events("reset")) == 1
    assert bench.events("reset")[0]["t"] - bench.events("enable")[1]["t"] < 1e-4


def test_a_touch_of_the_stops_is_told_once(probe):
    bench, line = probe({"m": 1.0, "stop_low": -1e-3, "stop_high": 1e-3}, script="+0 force 5\n+0.04 force -5")
    line.enable(1)
    line.wait_ticks(180)
    assert [e["side"] for e in bench.events("stop")] == ["high", "low"]


@pytest.mark.parametrize(("on", "conversions"), [(1, 1), (0, 0)])
def test_falling_asleep_starts_a_conversion_where_the_converter_is_on(probe, on, conversions):
    _, line = probe({})
    assert line.ask(bytes([ord("z"), on]), 1)[0] == conversions


@pytest.mark.parametrize("mode", range(16))
def test_the_top_is_taken_only_in_a_mode_that_has_it(probe, mode):
    bench, line = probe({})
    taken = mode in (8, 10, 12, 14)
    assert int.from_bytes(line.ask(bytes([ord("i"), mode, 77]), 2), "little") == (77 if taken else 799)
    assert len(bench.events("ignored")) == (not taken)
