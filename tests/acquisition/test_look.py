"""Looks at a bench: what a run shows by role, the room that is used, and why a run is not whole."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ambid.acquisition.device import DeviceEvent
from ambid.acquisition.session import Course, RunReport
from ambid.acquisition.trials import Room, make_look, why_incomplete
from ambid.rig import rig_from_text
from tests.job.benches import COIL, PLAIN, Spoiled, prototype

WHOLE = RunReport(samples=100, wanted=100, lost=0, first=0, after=100, fault=None, interrupted=False, events=())


def test_a_look_gives_the_samples_by_role_in_si():
    rig = prototype()
    with Spoiled(rig) as device:
        report, seen = make_look(device, rig, lambda: False)(Course(mode="levitate", seconds=0.5, settle_s=0.5))
        assert device.state == "idle"
    assert report.complete
    assert set(seen) == {"voltage", "position", "current"}
    assert all(len(values) == 1000 for values in seen.values())
    assert np.abs(seen["position"]).max() < 1e-4
    assert np.abs(seen["voltage"]).max() < 3.0


def test_a_look_that_shows_nothing_gives_empty_arrays():
    rig = prototype()
    with Spoiled(rig) as device:
        report, seen = make_look(device, rig, lambda: True)(Course(mode="sample", seconds=0.5))
    assert report.interrupted
    assert all(values.shape == (0,) for values in seen.values())


def test_the_room_is_the_way_from_rest_to_the_nearer_trip():
    room = Room(trips={"position": (-1e-3, 1e-3)}, voltage=(-11.4, 11.4))
    assert room.used("position", np.array([0.0, 5e-4]), 0.0) == pytest.approx(0.5)
    assert room.used("position", np.array([0.0, -5e-4]), 5e-4) == pytest.approx(2 / 3)
    assert room.used("position", np.array([7e-4, 1e-4]), 5e-4) == pytest.approx(0.4)
    assert room.used("position", np.array([2e-3]), 0.0) == pytest.approx(2.0)
    assert math.isinf(room.used("position", np.array([2e-3]), 1.5e-3))  # rest itself is outside


def test_without_a_limit_no_room_is_used():
    room = Room(trips={"current": (-math.inf, math.inf)}, voltage=(-1.0, 1.0))
    assert room.used("current", np.array([5.0, -3.0]), 0.0) == 0.0


@pytest.mark.parametrize(
    ("rig", "roles"),
    [(prototype(), {"position", "current"}), (rig_from_text(COIL, "c.toml"), {"current"})],
    ids=["axis", "coil"],
)
def test_the_room_has_what_the_bench_has(rig, roles):
    assert set(Room.of(rig).trips) == roles


def test_a_rig_without_daq_has_the_trips_that_the_device_makes_up():
    room = Room.of(rig_from_text(PLAIN, "plain.toml"))
    assert room.trips["position"] == pytest.approx((-0.9e-3, 0.9e-3))
    assert room.voltage == (-11.4, 11.4)


@pytest.mark.parametrize(
    ("duty", "volts"), [("[300, 500]", (-3.0, 3.0)), ("[0, 500]", (-11.4, 3.0)), ("[0, 800]", (-11.4, 11.4))]
)
def test_the_voltage_is_what_the_pulse_widths_allowed_can_order(duty, volts):
    room = Room.of(prototype(("rate_hz = 2000.0", f"rate_hz = 2000.0\nduty = {duty}")))
    assert room.voltage == pytest.approx(volts)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, None),
        (
            {"fault": DeviceEvent(kind="fault", sample=7, what="out_of_gap"), "samples": 7},
            "safe state during the trial: out_of_gap, position outside limits at sample 7. Change the gains",
        ),
        ({"interrupted": True, "samples": 40}, "the trial was interrupted after 40 samples"),
        ({"lost": 3, "samples": 97}, "3 of 100 samples were lost during the trial: check cable"),
        ({"samples": 60}, "the trial ended after 60 of 100 samples"),
    ],
    ids=["whole", "fault", "interrupted", "lost", "short"],
)
def test_why_a_run_is_not_whole(changes, said):
    found = why_incomplete(replace(WHOLE, **changes), "the trial")
    assert (len(found) == 1 and said in found[0]) if said else found == ()
