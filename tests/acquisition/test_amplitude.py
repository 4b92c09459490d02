"""The right size of an excitation: from small to large, within its part of the room, on any bench that is driven."""

import math
from itertools import pairwise

import numpy as np
import pytest

from ambid.acquisition.session import RunReport
from ambid.acquisition.trials import Room, Trial, find_amplitude, fitting_amplitude
from ambid.errors import DeviceError
from ambid.rig import rig_from_text
from tests.job.benches import COIL, THESIS, Spoiled, prototype

ROOM = Room(trips={"position": (-1e-3, 1e-3), "current": (-1.0, 1.0)}, voltage=(-10.0, 10.0))
TRIAL = Trial(name="multisine", band=(2.0, 66.0), mode="levitate", settle_s=0.2, seconds=2.0, seed=0)
DRIVE = Trial(name="prbs", band=None, mode="drive", settle_s=0.0, seconds=1.0, seed=0)
REST = {"position": 0.0, "current": 0.0}
SWING = np.array([-1.0, 1.0])


def moving(way, *, lose=0, trips_at=math.inf, volts=lambda size: size * SWING):
    """A bench that moves `way(size)` m to both sides, and the sizes that it was tried with."""
    sizes = []

    def look(course):
        size = course.program.amplitude
        sizes.append(size)
        n = 100 - lose
        report = RunReport(
            samples=n, wanted=100, lost=lose, first=0, after=100, fault=None, interrupted=False, events=()
        )
        seen = {"position": way(size) * SWING, "current": 0.01 * size * SWING, "voltage": volts(size)}
        return (report, seen) if size < trips_at else (report.__class__(**{**fields(report), "samples": 50}), seen)

    return look, sizes


def linear(slope, **options):
    return moving(lambda size: slope * size, **options)


def fields(report):
    return {name: getattr(report, name) for name in report.__slots__}


def found(look, **options):
    return find_amplitude(look, ROOM, TRIAL, REST, rate_hz=2000.0, **({"use": 0.3} | options))


def test_it_begins_small_grows_and_ends_within_its_part():
    look, sizes = linear(1e-4)
    size = found(look)
    assert size.reasons == ()
    assert sizes[0] == pytest.approx(0.2)  # 2 % of half the voltage
    assert sizes == sorted(sizes)
    assert 0.75 * 0.3 <= size.used <= 0.3
    assert size.amplitude_v == sizes[-1]
    assert size.amplitude_v * 1e-4 / 1e-3 == pytest.approx(size.used)
    assert len(size.findings) == len(sizes)


def test_a_step_is_never_larger_than_fourfold():
    look, sizes = linear(1e-7)
    size = found(look)
    assert all(b <= 4.0 * a * (1 + 1e-9) for a, b in pairwise(sizes))
    assert size.amplitude_v <= 10.0  # the voltage is a limit too


def test_a_bench_that_is_far_too_lively_is_driven_less():
    look, sizes = linear(4e-2)  # the first trial goes to eight times the trip's way
    size = found(look)
    assert size.reasons == ()
    assert sizes == sorted(sizes, reverse=True)
    assert all(a <= 4.0 * b * (1 + 1e-9) for a, b in pairwise(sizes))
    assert 0.75 * 0.3 <= size.used <= 1.2 * 0.3
    assert size.amplitude_v == sizes[-1]


def test_a_bench_that_grows_faster_than_its_excitation_is_brought_back():
    look, sizes = moving(lambda size: 5e-5 * size**3)
    size = found(look)
    assert size.reasons == ()
    assert 0.75 * 0.3 <= size.used <= 1.2 * 0.3
    assert len(sizes) <= 8
    assert max(sizes) > sizes[-1]  # one was too large on the way, and was not taken


def test_a_bench_that_moves_by_itself_is_not_driven_ever_less():
    look, sizes = moving(lambda size: 5e-4 + 1e-4 * size)  # half the way to the trip without any excitation
    size = found(look)
    assert len(sizes) == 2
    assert "moves position through 51 % of its available range; 36 % are allowed" in size.reasons[0]
    assert "the bench moves by itself; check noise and gains" in size.reasons[0]


def test_trials_that_never_fit_end_with_a_reason():
    look, sizes = moving(lambda size: 1.0)
    assert "the bench moves by itself" in found(look).reasons[0]
    tiny, sizes = linear(1e6)  # a sign or a unit that is wrong: four steps down are not enough
    size = found(tiny)
    assert len(sizes) == 8
    assert size.reasons[0].endswith("give a smaller one")


def test_a_voltage_that_holds_the_rotor_does_not_count_as_excitation():
    look, sizes = linear(1e-5, volts=lambda size: 6.0 + size * SWING)  # 4 V are left upwards
    size = found(look)
    assert size.reasons == ()
    assert 0.75 * 0.8 * 4.0 <= size.amplitude_v <= 0.8 * 4.0
    assert len(sizes) <= 4


def test_a_voltage_at_its_end_is_too_much():
    look, sizes = moving(lambda size: 0.0, volts=lambda size: np.clip(size**2, 0.0, 10.0) * SWING)
    size = found(look)
    assert size.reasons == ()
    assert max(sizes) ** 2 > 10.0  # clipped on the way
    assert 6.0 <= size.amplitude_v**2 < 9.6


def test_a_given_size_is_only_tried():
    look, sizes = linear(1e-4)
    assert found(look, amplitude_v=2.0).amplitude_v == 2.0
    assert sizes == [2.0]
    assert found(look, amplitude_v=7.0).reasons == ()  # more than its part: whoever gives a size has decided that
    assert (
        "moves position through 95 % of its available range; 85 % are allowed: give a smaller one"
        in found(look, amplitude_v=9.5).reasons[0]
    )


def test_a_trial_that_is_not_whole_ends_the_search():
    look, _ = linear(1e-4, trips_at=1.0)
    size = found(look)
    assert "ended after 50 of 100 samples" in size.reasons[0]
    assert math.isnan(size.used)
    assert len(size.findings) == 2  # the trials before it
    look, _ = linear(1e-4, lose=4)
    assert "4 of 100 samples were lost" in found(look).reasons[0]


def test_without_limits_of_the_voltage_a_size_has_to_be_given():
    room = Room(trips=ROOM.trips, voltage=(-math.inf, math.inf))
    look, sizes = linear(1e-4)
    size = find_amplitude(look, room, TRIAL, REST, rate_hz=2000.0, use=0.3)
    assert "no loop.limits.voltage" in size.reasons[0]
    assert sizes == []
    assert find_amplitude(look, room, TRIAL, REST, rate_hz=2000.0, use=0.3, amplitude_v=1.0).reasons == ()


def test_on_the_prototype_a_third_of_the_room_is_used():
    rig = prototype()
    with Spoiled(rig) as device:
        size = fitting_amplitude(device, rig, TRIAL)
        assert device.state == "idle"
        assert device.starts <= 4  # a look, and three trials
    assert 1.3 < size < 2.5


def test_it_keeps_to_the_pulse_widths_allowed():
    rig = prototype(("rate_hz = 2000.0", "rate_hz = 2000.0\nduty = [300, 500]"))
    fast = Trial(name="multisine", band=(200.0, 400.0), mode="levitate", settle_s=0.2, seconds=0.5, seed=0)
    with Spoiled(rig) as device:
        size = fitting_amplitude(device, rig, fast)
    assert 0.3 < size < 3.0  # with all of +-11.4 V a trial of 3.6 V would have been refused


@pytest.mark.parametrize("text", [COIL, THESIS], ids=["coil", "thesis"])
def test_a_bench_without_a_loop_is_driven_by_most_of_its_voltage(text):
    rig = rig_from_text(text, "rig.toml")
    with Spoiled(rig) as device:
        size = fitting_amplitude(device, rig, DRIVE)
    assert 0.5 < size / rig.limits.voltage[1] < 0.85


def test_a_bench_that_does_not_hover_has_no_amplitude():
    rig = prototype(("kd = 92.57", "kd = 0.0"))
    with (
        Spoiled(rig) as device,
        pytest.raises(DeviceError, match=r"no suitable amplitude was found: .*out_of_gap.*Give amplitude"),
    ):
        fitting_amplitude(device, rig, TRIAL)
