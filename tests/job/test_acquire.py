"""The acquisition job: what came is in the record, whatever ends it, and what is said of it is so."""

import json

import h5py
import numpy as np
import pytest

from ambid.acquisition.devices import _kernels as k
from ambid.acquisition.program import program
from ambid.acquisition.recorder import Recorder
from ambid.acquisition.session import Course, acquire
from ambid.errors import DeviceError
from ambid.record import read_record
from tests.acquisition.scripted import Listener
from tests.job.benches import EXCITATION, Silent, Spoiled, prototype

RIG = prototype()


def wave(amplitude=1.4):
    return program("multisine", amplitude_v=amplitude, band=(2.0, 66.0), rate_hz=2000.0, seconds=4.0)


def course(seconds=1.0, settle_s=0.1, playing=None):
    return Course(mode="levitate", seconds=seconds, settle_s=settle_s, program=playing)


def events_of(path, kind):
    with h5py.File(path) as file:
        told = json.loads(file["acquisition"][()])
    return [e["what"] for e in told["events"] if e["kind"] == kind]


def test_the_record_holds_what_the_run_passed_on(tmp_path):
    heard = Listener()
    with Spoiled(RIG) as device:
        done = acquire(device, RIG, tmp_path / "o.h5", course(), taps=[heard])
    record = read_record(tmp_path / "o.h5")
    passed = np.concatenate([f.block.values for f in heard.frames])
    np.testing.assert_array_equal(np.column_stack([c.values for c in record.channels]), passed)
    assert [c.name for c in record.channels] == ["position", "current", "duty", "excitation"]
    assert record.rate_hz == 2000.0
    assert (done.run.samples, done.quality.samples, done.not_stored, done.troubles) == (2000, 2000, 0, ())
    assert done.recorded is not None
    assert done.recorded.survey.samples == 2000
    assert list(tmp_path.iterdir()) == [tmp_path / "o.h5"]


def test_the_record_begins_when_the_bench_has_settled_to_the_excitation(tmp_path):
    with Spoiled(RIG) as device:
        acquire(device, RIG, tmp_path / "o.h5", course(seconds=2.0, playing=wave()))
    plays = read_record(tmp_path / "o.h5").channels[EXCITATION].values
    assert np.abs(plays[:20]).max() > 0
    period = wave().length * wave().hold
    np.testing.assert_array_equal(plays[:period], plays[period : 2 * period])


def test_progress_is_told_in_time_of_the_device(tmp_path):
    told = []
    with Spoiled(RIG) as device:
        acquire(device, RIG, tmp_path / "o.h5", course(), every_s=0.25, on_progress=told.append)
    assert [p.samples for p in told] == [500, 1000, 1500, 2000]
    assert {p.wanted for p in told} == {2000}
    assert told[-1].quality.samples == 2000


def test_a_fault_keeps_what_came_before_and_is_in_the_record(tmp_path):
    with Spoiled(RIG) as device:
        done = acquire(device, RIG, tmp_path / "o.h5", course(seconds=4.0, playing=wave(11.0)))
    assert done.run.fault is not None
    assert done.run.fault.what in ("over_current", "out_of_gap")
    if done.recorded is None:  # it tripped before the excitation had settled
        assert done.run.samples == 0
    else:
        assert len(read_record(tmp_path / "o.h5").channels[0].values) == done.run.samples


def test_a_fault_in_the_middle_of_a_record(tmp_path):
    def trip(values, device):
        if device.blocks == 40:
            device._numbers[k.CURRENT_LOW] = device._numbers[k.CURRENT_HIGH] = 0  # nothing is inside them any more

    with Spoiled(RIG, spoil=trip) as device:
        done = acquire(device, RIG, tmp_path / "o.h5", course(seconds=4.0))
        assert device.state == "fault"
    assert done.run.fault is not None
    assert done.run.fault.what == "over_current"
    assert 0 < done.run.samples < 8000
    record = read_record(tmp_path / "o.h5")
    assert len(record.channels[0].values) == done.run.samples == done.run.fault.sample - done.run.first
    assert events_of(tmp_path / "o.h5", "fault") == ["over_current"]


def test_lost_samples_are_gaps_in_the_record(tmp_path):
    with Spoiled(RIG, lose=lambda device: device.blocks == 50) as device:
        done = acquire(device, RIG, tmp_path / "o.h5", course())
    assert (done.run.lost, done.quality.lost, done.run.samples) == (20, 20, 1980)
    with pytest.raises(Exception, match="gaps"):
        read_record(tmp_path / "o.h5")
    values = read_record(tmp_path / "o.h5", gaps="interpolate").channels[0].values
    assert len(values) == 2000


def test_an_interruption_keeps_what_came(tmp_path):
    heard = Listener()
    with Spoiled(RIG) as device:
        done = acquire(
            device, RIG, tmp_path / "o.csv", course(60.0), taps=[heard], stopped=lambda: len(heard.frames) > 30
        )
        assert device.state == "idle"
    assert done.run.interrupted
    assert len(read_record(tmp_path / "o.csv").channels[0].values) == done.run.samples > 600


def test_a_lost_line_says_what_the_record_holds(tmp_path):
    said = pytest.raises(DeviceError, match=r"line is lost.*o\.h5 holds the \d+ samples before it")
    with Silent(RIG, after=180) as device, said:
        acquire(device, RIG, tmp_path / "o.h5", course(seconds=4.0, playing=wave()))
    assert len(read_record(tmp_path / "o.h5").channels[0].values) > 100


def test_a_tap_that_breaks_leaves_a_record_and_an_idle_device(tmp_path):
    with Spoiled(RIG) as device:
        with pytest.raises(RuntimeError, match="the tap broke"):
            acquire(device, RIG, tmp_path / "o.h5", course(), taps=[Listener(at=30)])
        assert device.state == "idle"
    assert len(read_record(tmp_path / "o.h5").channels[0].values) == 600


def test_a_record_that_exists_is_refused_before_anything_moves(tmp_path):
    (tmp_path / "o.h5").write_text("precious")
    with Spoiled(RIG) as device:
        with pytest.raises(DeviceError, match="exists"):
            acquire(device, RIG, tmp_path / "o.h5", course())
        assert device.starts == 0
    assert (tmp_path / "o.h5").read_text() == "precious"


def test_a_disk_that_fails_ends_the_run_and_is_told_at_once(tmp_path, monkeypatch):
    told, runs = [], []

    class Failing(Recorder):
        def append(self, block):
            if self.blocks == 40:
                self.flush()
                self._writer._fail(DeviceError("the disk is full"))
            return super().append(block)

    monkeypatch.setattr("ambid.acquisition.session.Recorder", Failing)
    with Spoiled(RIG) as device:
        done = acquire(device, RIG, tmp_path / "o.h5", course(seconds=60.0), on_trouble=told.append)
        runs.append(device.state)
    assert [str(t) for t in told] == ["the disk is full"] == [str(t) for t in done.troubles]
    assert done.not_stored > 0
    assert done.run.samples < 10_000  # it did not go on for nothing
    assert runs == ["idle"]
    assert len(read_record(tmp_path / "o.h5").channels[0].values) == done.run.samples - done.not_stored == 800
    assert (tmp_path / "o.h5.journal").exists()  # a disk that failed is not trusted


def test_what_the_run_played_is_in_the_record(tmp_path):
    with Spoiled(RIG) as device:
        acquire(device, RIG, tmp_path / "o.h5", course(playing=wave()))
    assert "amplitude=1.4" in events_of(tmp_path / "o.h5", "excitation")[0]
