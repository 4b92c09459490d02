"""Three sensors of one position, named by the rig, through identify and track while one of them fails."""

from pathlib import Path

import numpy as np
import pytest

import ambid
from ambid.errors import RecordError, RigError
from ambid.job.sensors import _noise
from ambid.record import Channel, Record
from ambid.rig import rig_from_text
from ambid.rig.rig import rig_text

RIG = """
schema = "ambid.rig/1"
name = "three sensors"
model = "one-axis"

[channels.voltage]
column = "voltage"

[channels.current]
column = "current"

[[channels.position.sensors]]
column = "pos_a"

[[channels.position.sensors]]
column = "pos_b"
offset = 0.0

[[channels.position.sensors]]
column = "pos_c"
gain = -1.0
"""
FAILS_S = 1.5


@pytest.fixture(scope="module")
def bench() -> tuple[Record, Record]:
    """The record with one position, and with three sensors of it, the second of which stops at FAILS_S."""
    record = ambid.simulate("unstable-bearing", duration=2.5, seed=3)
    rng, x, t = np.random.default_rng(1), record["position"].values, record.time_s
    sensors = {
        f"pos_{n}": x + d + 1e-7 * rng.standard_normal(x.size) for n, d in zip("abc", (0, 3e-6, -2e-6), strict=True)
    }
    stopped = t >= t[0] + FAILS_S
    sensors["pos_b"][stopped] = sensors["pos_b"][stopped][0]
    sensors["pos_c"] *= -1.0
    others = tuple(c for c in record.channels if c.name != "position")
    channels = (*others, *(Channel(name=n, unit="m", values=v) for n, v in sensors.items()))
    three = Record(rate_hz=record.rate_hz, channels=channels, start_s=record.start_s)
    return record, three


@pytest.fixture(scope="module")
def rig() -> ambid.Rig:
    return rig_from_text(RIG, Path("three.toml"))


def test_a_rig_with_sensors_is_written_as_it_was_read(rig):
    again = rig_from_text(rig_text(rig, Path()), Path("three.toml"))
    assert rig_text(again, Path()) == rig_text(rig, Path())
    assert [s.column for s in again.channel("position").sensors] == ["pos_a", "pos_b", "pos_c"]


def test_identify_uses_the_fused_position_and_says_so(bench, rig):
    record, three = bench
    one, fused = ambid.identify(record), ambid.identify(three, rig)
    for p in one.parameters:
        if p.sd:
            assert abs(fused.values[p.name] - p.value) < 4 * p.sd
    (line,) = (str(s) for s in fused.record["history"] if str(s).startswith("fuse("))
    assert "'excluded'" in line
    assert "'pos_b'" in line


def test_a_sensor_that_fails_is_excluded_in_the_line_of_its_time(bench, rig, tmp_path):
    record, three = bench
    start = ambid.identify(record)
    followed = ambid.track(three, rig, start=start, every_s=0.05)
    told = [(line.t, e) for line in followed.lines for e in line.events if e.kind == "excluded"]
    ((t, event),) = told
    assert event.parameter == "pos_b"
    assert "constant" in event.why
    assert FAILS_S <= event.t - three.start_s < FAILS_S + 0.01
    assert event.t <= t < event.t + 0.05 + 1e-9
    last = followed.lines[-1].parameters["k_i"]
    assert abs(last.value - start.values["k_i"]) < 4 * last.sd
    assert not [e for line in followed.lines for e in line.events if e.kind == "change"]


@pytest.mark.parametrize("stopped", [0.0, 0.25, 0.6])
def test_the_noise_of_a_sensor_that_stops_is_that_before(stopped):
    x = 1e-7 * np.random.default_rng(2).standard_normal(4000)
    stop = round((1.0 - stopped) * x.size)
    x[stop:] = x[stop - 1]
    assert _noise(x) == pytest.approx(1e-7, rel=0.1)


def test_what_makes_no_sensors_is_refused(bench, rig):
    _, three = bench
    with pytest.raises(RecordError, match="pos_c"):
        ambid.identify(Record(rate_hz=three.rate_hz, channels=three.channels[:-1]), rig)
    for wrong, words in (
        (RIG.replace("pos_c", "pos_a"), "a column has one role"),
        (RIG + "[channels.reference]\nsensors = [{column = 'a'}, {column = 'b'}]\n", "only a position"),
        (RIG.replace("[channels.current]", "[channels.position]\nunit = 'um'\n[channels.current]"), "its own"),
        (RIG.replace('column = "pos_b"', ""), "needs a column"),
    ):
        with pytest.raises(RigError, match=words):
            rig_from_text(wrong, Path("wrong.toml"))
