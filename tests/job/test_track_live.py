"""Live tracking: the stream of a device is followed, and neither the tracker nor its troubles cut off the recording."""

import time
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from ambid.acquisition.program import program
from ambid.acquisition.session import Course, acquire
from ambid.errors import AmbidError, DeviceError
from ambid.job import identify
from ambid.job.track_live import QueueTap, track_live
from ambid.record import read_record
from ambid.rig import rig_from_text
from ambid.tracking.blocks import Block, Frame
from tests.acquisition.scripted import Listener
from tests.job.benches import PROTOTYPE_FILE, Spoiled, prototype

RIG = prototype()
TRUTH = {"m": 0.3, "R": 6.0}


def course(seconds):
    wave = program("multisine", amplitude_v=1.4, band=(2.0, 66.0), rate_hz=2000.0, seconds=4.0)
    return Course(mode="levitate", seconds=seconds, settle_s=0.5, program=wave)


@cache
def estimate(folder):
    with Spoiled(RIG) as device:
        acquire(device, RIG, folder / "start.h5", course(4.0))
    return identify(folder / "start.h5", RIG)


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    return estimate(tmp_path_factory.mktemp("start"))


def test_it_follows_the_bench_from_an_estimate(start):
    heard = Listener()
    with Spoiled(RIG, seed=3) as device:
        done = track_live(device, RIG, course(3.0), start=start, taps=[heard])
        assert device.state == "idle"
    assert done.run.complete
    assert len(heard.numbers) == 6000
    assert done.overruns == 0
    assert done.track.totals.samples == 6000
    assert done.track.totals.rejected_samples == 0
    assert done.track.lines[-1].t == pytest.approx(3.0, abs=0.02)
    for name, truth in TRUTH.items():
        value = done.track.lines[-1].parameters[name]
        assert abs(value.value - truth) < 4.0 * value.sd + 0.01 * truth


def test_without_a_start_it_identifies_the_first_part_and_tracks_the_rest():
    with Spoiled(RIG) as device:
        done = track_live(device, RIG, course(6.0), start=4.0)
    assert done.run.complete
    assert done.track.totals.samples == 4000  # what came while it identified is tracked too, from the part's end on
    assert done.track.lines[-1].t == pytest.approx(6.0, abs=0.02)


def test_a_played_bench_waits_for_the_tracker(start, monkeypatch):
    monkeypatch.setattr("ambid.job.track_live._QUEUE_S", 0.1)
    with Spoiled(RIG) as device:
        done = track_live(device, RIG, course(8.0), start=start)
    assert done.overruns == 0
    assert done.track.totals.samples == 16_000
    assert done.track.totals.latency.late == 0  # its time is not the host's


def test_what_comes_in_many_short_blocks_waits_while_the_tracker_is_busy(start):
    class Hardware(Spoiled):
        """It waits for nobody, and its port gives 250 blocks a second, of 8 samples each."""

        @property
        def info(self):
            return replace(super().info, kind="serial")

    heard = Listener()

    def busy(_):
        while len(heard.frames) < 2000:
            time.sleep(0.01)

    with Hardware(RIG, block_samples=8) as device:
        done = track_live(device, RIG, course(8.0), start=start, taps=[heard], on_header=busy)
    assert done.overruns == 0
    assert done.track.totals.samples == 16_000


def test_the_lag_from_sample_to_decision_is_measured(start):
    lags, slept = [], []

    def slow(line):
        if line.t > 1.0 and not slept:
            slept.append(time.sleep(0.3))

    with Spoiled(RIG, pace="real") as device:
        done = track_live(device, RIG, course(2.5), start=start, on_line=slow, on_lag=lags.append)
    latency = done.track.totals.latency
    assert max(lags) >= 0.3
    assert latency.largest >= 0.3
    assert latency.late >= 10  # blocks of 10 ms came while it slept
    assert lags[-1] < 0.1
    assert done.overruns == 0


def test_a_gap_is_seen_by_the_tracker(start):
    with Spoiled(RIG, lose=lambda d: d.excited and d.blocks == 300) as device:
        done = track_live(device, RIG, course(4.0), start=start)
    assert done.run.lost == 20
    assert done.track.totals.samples + done.track.totals.rejected_samples >= 7980
    assert any(e.kind == "rejected" and "20 samples" in e.why for line in done.track.lines for e in line.events)


def test_a_sample_outside_a_calibration_table_is_rejected_and_ends_nothing(start, tmp_path):
    gain, offset = 2.44140625e-6, -1.248779296875e-3
    rows = [f"{count},{count * gain + offset!r}" for count in (100.0, 500.0, 923.0)]
    (tmp_path / "p.csv").write_text("\n".join(["counts [1],position [m]", *rows]) + "\n", encoding="utf-8")
    text = PROTOTYPE_FILE.read_text(encoding="utf-8")
    for line in ("gain   = 2.44140625e-6 ", "offset = -1.248779296875e-3 "):
        text = text.replace(line, f"# {line}")
    text = text.replace('column = "position"', 'column = "position"\ntable = "p.csv"')
    rig = rig_from_text(text, tmp_path / "rig.toml")

    def spike(values, device):
        if device.blocks == 300 and device.excited:
            values[3, 0] = 60.0

    heard = Listener()
    with Spoiled(rig, spoil=spike) as device:
        done = track_live(device, rig, course(4.0), start=start, taps=[heard])
    assert done.run.complete
    assert len(heard.numbers) == 8000
    assert 1 <= done.track.totals.rejected_samples < 40


def test_a_bench_that_changes_is_seen(start):
    def change(values, device):
        if device.blocks == 300 and device.excited:
            device.become(("R", 1.5))

    with Spoiled(RIG, spoil=change) as device:
        done = track_live(device, RIG, course(5.0), start=start)
    last = done.track.lines[-1]
    assert done.track.totals.changes or last.error > 1.5 or last.parameters["R"].value > 7.0


def test_a_run_that_is_too_short_is_refused_before_anything_moves(start):
    with Spoiled(RIG) as device:
        with pytest.raises(DeviceError, match=r"needs 5 s for its start, and the run lasts 3 s.*give a start"):
            track_live(device, RIG, course(3.0))
        with pytest.raises(DeviceError, match=r"needs 0\.5 s for its start"):
            track_live(device, RIG, course(0.4), start=start)
        assert device.starts == 0


def test_a_fault_before_there_is_enough_says_so(start):
    def trip(values, device):
        if device.excited and device.blocks > 100:
            device.become(("m", 0.01))

    with (
        Spoiled(RIG, spoil=trip) as device,
        pytest.raises(DeviceError, match=r"stream ended after .* s \(\w+, .*limits"),
    ):
        track_live(device, RIG, course(6.0), start=5.0)


def test_a_fault_while_it_tracks_ends_the_track_in_order(start):
    def trip(values, device):
        if device.excited and device.blocks > 400:
            device.become(("m", 0.01))

    with Spoiled(RIG, spoil=trip) as device:
        done = track_live(device, RIG, course(60.0), start=start)
    assert done.run.fault is not None
    assert done.track.totals is not None
    assert done.track.lines


def test_a_tracker_that_cannot_go_on_does_not_cut_off_who_else_listens(start):
    heard, told, runs = Listener(), [], []

    def broken(header):
        raise AmbidError("the tracker gave up")

    with Spoiled(RIG) as device:
        with pytest.raises(AmbidError, match="gave up"):
            track_live(
                device, RIG, course(60.0), start=start, taps=[heard], on_header=broken, on_trouble=told.append,
                on_run=runs.append,
            )  # fmt: skip
        assert device.state == "idle"
    assert [str(t) for t in told] == ["the tracker gave up"]
    assert len(heard.numbers) == 120_000
    assert runs[0].complete


def test_where_nobody_else_listens_it_ends_at_once(start):
    runs = []

    def broken(header):
        raise AmbidError("the tracker gave up")

    with Spoiled(RIG, pace="real") as device:
        with pytest.raises(AmbidError, match="gave up"):
            track_live(device, RIG, course(600.0), start=start, on_header=broken, on_run=runs.append)
        assert device.state == "idle"
    assert runs[0].interrupted


def test_an_interruption_ends_the_run(start):
    lines, runs = [], []

    def stop(line):
        lines.append(line)
        if len(lines) == 50:
            raise KeyboardInterrupt

    with Spoiled(RIG) as device:
        with pytest.raises(KeyboardInterrupt):
            track_live(device, RIG, course(600.0), start=start, on_line=stop, on_run=runs.append, keep=False)
        assert device.state == "idle"
    assert runs[0].interrupted


def test_a_wish_to_end_ends_the_track_in_order(start):
    heard = Listener()
    with Spoiled(RIG) as device:
        done = track_live(
            device, RIG, course(600.0), start=start, taps=[heard], stopped=lambda: len(heard.frames) > 150
        )
    assert done.run.interrupted
    assert done.track.totals.samples == len(heard.numbers) > 3000


def test_a_line_that_is_lost_is_raised(start, tmp_path):
    from tests.job.benches import Silent

    with Silent(RIG, after=200) as device, pytest.raises(DeviceError, match="line is lost"):
        track_live(device, RIG, course(60.0), start=start)


def test_a_record_made_meanwhile_is_whole(start, tmp_path):
    from ambid.acquisition.session import recording

    with Spoiled(RIG) as device, recording(device, RIG, tmp_path / "o.h5", course(2.0)) as tap:
        track_live(device, RIG, course(2.0), start=start, taps=[tap], on_event=tap.tell)
    assert len(read_record(tmp_path / "o.h5").channels[0].values) == 4000


def test_a_run_that_is_stopped_waits_for_no_room_in_the_queue():
    """A start is identified, nobody reads, and the queue is full."""
    looks = []

    def stopped():
        looks.append(len(looks))
        return len(looks) > 3

    put = []
    queue = SimpleNamespace(wait_for_room=lambda _n, _s: len(looks) > 99, put=put.append)
    view = SimpleNamespace(block=lambda block: block)
    tap = QueueTap(queue, view, waits=True, stopped=stopped)
    tap.take(Frame(block=Block(first=5, time_s=0.0, values=np.zeros((3, 1))), arrived_s=0.0))
    assert (len(looks), put[0].block.first) == (4, 0)
