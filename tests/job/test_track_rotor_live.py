"""A rotor followed beside its run: numbers and sensitivity of every axis, lost samples, and what cannot be followed."""

from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.acquisition.devices import open_device
from ambid.acquisition.session import Course
from ambid.control.zones import Zone
from ambid.errors import DeviceError, EstimationError
from ambid.job import track_rotor
from ambid.job.acquiring import Request
from ambid.job.track_live import track_live
from ambid.physics.presets import preset
from ambid.record import write_record
from ambid.rig import rig_of_preset
from ambid.simulation.rotor_bench import RotorBench

RIG = rig_of_preset(preset("spindle"))  # five axes, at 30 000 rpm
TRUTH = RotorBench.of(RIG, None, True).plant.parameters
SILENT = Course(mode="levitate", seconds=4.0)


@pytest.fixture(scope="module")
def start():
    return ambid.identify(ambid.simulate(RIG, duration=3.0, seed=1), RIG)


def excited(rig, seconds):
    wanted = Request(seconds=seconds, excitation="zippered", amplitude=4.0)
    with open_device("simulated", rig) as device:
        return wanted.course(device, rig, wanted.trial("simulated", rig), note=str, tick=str)


def near(value, truth):
    return abs(value.value - truth) < 4.0 * value.sd + 0.002 * abs(truth)


def test_every_axis_is_followed_with_its_sensitivity(start):
    told = []
    with open_device("simulated", RIG, seed=4) as device:
        done = track_live(
            device, RIG, excited(RIG, 14.0), start=start, on_loop=lambda t, found: told.append((t, found))
        )
    lines = done.track.lines
    assert done.run.complete
    assert len(lines) == 11  # a period each, after three in which the noise is looked at
    assert lines[-1].t == pytest.approx(14.0, abs=1e-9)
    for axis in RIG.rotor.axes:
        assert all(near(lines[-1].parameters[f"{axis}.{q}"], TRUTH[f"{axis}.{q}"]) for q in ("k_i", "k_x", "R"))
    assert [t for t, _ in told] == pytest.approx([3.0, 13.0])
    for _, found in told:
        zones = {axis: Zone.read(entry) for axis, entry in found.items()}
        assert {z.source for z in zones.values()} == {"measured"}
        for axis, zone in zones.items():
            assert zone.value == pytest.approx(start.sensitivity[axis]["peak_db"]["value"], abs=0.5)


def test_a_loop_that_is_unstable_by_the_numbers_of_now_keeps_no_sensitivity_of_before(start, monkeypatch):
    told, loops = [], []

    def refuses(loop, rig):
        loops.append(loop)
        if len(loops) > 1:
            raise EstimationError("the loop is not stable")

    monkeypatch.setattr(track_rotor, "refuse_unstable", refuses)
    with open_device("simulated", RIG, seed=4) as device:
        track_live(device, RIG, excited(RIG, 14.0), start=start, on_loop=lambda _, found: told.append(set(found)))
    assert told == [set(RIG.rotor.axes), set()]


def test_a_bench_that_is_not_as_the_start_says_is_found(start):
    """The magnets of one axis are 6 % stiffer."""
    other = replace(
        RIG, parameters=tuple(replace(p, value=1.06 * p.value) if p.name == "ax.k_x" else p for p in RIG.parameters)
    )
    with open_device("simulated", RIG, bench=other, seed=4) as device:
        done = track_live(device, RIG, excited(RIG, 8.0), start=start)
    last = done.track.lines[-1].parameters
    assert near(last["ax.k_x"], 1.06 * TRUTH["ax.k_x"])
    assert near(last["bx.k_x"], TRUTH["bx.k_x"])


def test_a_replayed_record_is_followed_as_it_was(start, tmp_path):
    record = ambid.simulate(RIG, duration=8.0, periods=8, seed=3)
    write_record(record, tmp_path / "played.h5")
    with open_device(f"replay:{tmp_path / 'played.h5'}", RIG) as device:
        done = track_live(device, RIG, Course(mode="sample", seconds=60.0), start=start)
    offline = ambid.track(record, RIG, start=start)
    last, other = done.track.lines[-1].parameters, offline.lines[-1].parameters
    assert done.track.lines[-1].t == pytest.approx(8.0, abs=1e-9)
    for name, value in other.items():
        assert abs(last[name].value - value.value) < 4.0 * np.hypot(last[name].sd, value.sd), name


def test_lost_samples_cost_a_block_and_nothing_else(start):
    class Leaky:
        """Drops some blocks of its device."""

        def __init__(self, device):
            self._device = device

        def __getattr__(self, name):
            return getattr(self._device, name)

        def read(self, timeout_s):
            frame = self._device.read(timeout_s)
            first = 0 if frame is None else frame.block.first - 40_000  # settling and lead
            return self._device.read(timeout_s) if 95_000 < first < 95_400 else frame

    with open_device("simulated", RIG, seed=4) as device:
        done = track_live(Leaky(device), RIG, excited(RIG, 8.0), start=start)
    lost = [line for line in done.track.lines if any(e.kind == "rejected" for e in line.events)]
    assert [line.t for line in lost] == pytest.approx([5.0, 6.0])  # a block, and the one that it stands before
    assert all(v.stale for line in lost for v in line.parameters.values())
    assert done.track.totals.rejected_samples == 40_000
    assert near(done.track.lines[-1].parameters["ax.k_x"], TRUTH["ax.k_x"])


def test_without_an_excitation_the_sensitivity_is_predicted_and_nothing_is_followed(start):
    told = []
    with (
        open_device("simulated", RIG) as device,
        pytest.raises(EstimationError, match="not periodic"),
    ):
        track_live(device, RIG, SILENT, start=start, on_loop=lambda t, found: told.append(found))
    (found,) = told
    assert {Zone.read(entry).source for entry in found.values()} == {"predicted"}
    assert set(found) == set(RIG.rotor.axes)


def test_what_is_no_start_of_a_rotor_is_refused():
    with open_device("simulated", RIG) as device:
        with pytest.raises(DeviceError, match="Run longer"):
            track_live(device, RIG, excited(RIG, 3.0), start=None)
        with pytest.raises(EstimationError, match="no estimate of a rotor"):
            track_live(
                device, RIG, excited(RIG, 8.0), start=ambid.identify(ambid.simulate("thesis", duration=0.3, seed=1))
            )


def test_stop_ends_the_identification_of_a_start(monkeypatch):
    stages, stop = [], []
    identify = track_rotor.identify_rotor

    def stopped_meanwhile(*records, tick):
        def say(stage, done=None, /):
            stages.append(stage)
            if stage == "modes":
                stop.append(True)
            tick(stage, done)

        return identify(*records, tick=say)

    monkeypatch.setattr(track_rotor, "identify_rotor", stopped_meanwhile)
    with open_device("simulated", RIG) as device, pytest.raises(DeviceError, match="stopped while"):
        track_live(device, RIG, excited(RIG, 5.0), stopped=lambda: bool(stop))
    assert "modes" in stages
    assert "fit" not in stages
