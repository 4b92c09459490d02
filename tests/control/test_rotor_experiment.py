"""Experiments for rotors: zippered over the axes, each within its limits, promised as the estimator reports."""

from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.control.experiment import Task, lines_of
from ambid.errors import AmbidError
from ambid.physics.loop import Noise
from ambid.physics.presets import preset
from ambid.rig import rig_of_preset


@pytest.fixture(scope="module")
def rig():
    return rig_of_preset(preset("rmit"))


@pytest.fixture(scope="module")
def designed(rig):
    return ambid.design_experiment(rig, seconds=1.6, period=0.05, lines=48)


@pytest.fixture(scope="module")
def estimate(rig, designed):
    return ambid.identify(ambid.simulate(rig, excitation=designed, seed=1), rig, experiment=designed)


def test_a_line_keeps_its_input_whatever_lines_are_chosen():
    class Loop:
        e = np.zeros((3, 4))

    task = Task.__new__(Task)
    object.__setattr__(task, "loops", [Loop])
    every, keep = np.arange(1, 200), np.array([0, 3, 4, 7, 20, 21, 50])
    assert np.array_equal(task.inputs(every)[keep], task.inputs(every[keep]))
    assert set(task.inputs(every).tolist()) == {0, 1, 2, 3}


def test_each_line_moves_one_input(designed):
    waves = designed.played(designed.period, designed.rate_hz)
    lines, c = lines_of(waves)
    assert np.allclose(lines * designed.rate_hz / designed.period, designed.frequency_hz)
    power = np.abs(np.fft.rfft(waves, axis=0)[lines]) ** 2
    assert np.allclose(power.max(axis=1), power.sum(axis=1))
    sizes = np.column_stack(list(designed.amplitude.values()))
    assert np.allclose(sizes.sum(axis=1), np.abs(c))
    assert np.all(np.count_nonzero(sizes, axis=0) >= 4)


def test_what_is_promised_is_what_identify_reports(designed, estimate):
    assert estimate.passed
    ratio = estimate.checks["experiment"].values
    assert set(ratio) == set(designed.expected)
    assert ratio == pytest.approx(dict.fromkeys(ratio, 1.0), abs=0.1)
    weakest = max(designed.expected.values(), key=lambda x: x.relative_sd)
    assert weakest.relative_sd < 0.7 * max(x.flat_sd * x.relative_sd / x.sd for x in designed.expected.values())


def test_limits_are_kept_by_rotors_that_are_ten_percent_off_from_rest(rig, designed):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        off = tuple(
            replace(p, value=p.value * (1.0 + 0.1 * rng.uniform(-1, 1))) if p.role == "free" else p
            for p in rig.parameters
        )
        record = ambid.simulate(replace(rig, parameters=off), excitation=designed, settle=0, seed=seed)
        for name, use in designed.signals.items():
            if name in record.names:
                assert np.max(np.abs(record[name].values)) < use.high


def test_the_next_one_is_designed_from_the_estimate(designed, estimate):
    found = ambid.design_experiment(estimate, seconds=1.6, period=0.05, lines=48)
    assert set(found.expected) == set(designed.expected)
    worst = [max(x.relative_sd for x in e.expected.values()) for e in (designed, found)]
    assert 0.4 < worst[1] / worst[0] < 1.0  # less is kept free for other plants


def test_lines_beside_the_speed_are_left_out_and_unbalance_keeps_its_room():
    turning = rig_of_preset(preset("spindle"))
    found = ambid.design_experiment(turning, seconds=0.3, period=0.05, lines=30)
    order = found.frequency_hz / 500.0
    assert np.min(np.abs(order - np.maximum(np.round(order), 1.0))) * 500.0 > 1.4 / 0.05
    room = [found.signals[f"{axis}_position"].reserve for axis in ("ax", "az")]
    assert room[0] > 1.2 * room[1]  # unbalance moves no axial bearing


def test_what_cannot_be_promised_is_refused(rig, designed):
    for changed, said in (({"limits": None}, "no limits"), ({"noise": Noise()}, "noise"), ({"loop": None}, "unstable")):
        with pytest.raises(AmbidError, match=said):
            ambid.design_experiment(replace(rig, **changed), seconds=0.4, lines=8)
    for how in ({"lines": 12}, {"seconds": 0.1, "period": 0.1}, {"band": (100.0, 200.0)}):
        with pytest.raises(AmbidError, match="20 lines and 2 periods"):
            ambid.design_experiment(rig, **{"seconds": 0.4, "lines": 40, **how})
    with pytest.raises(AmbidError, match="xL_voltage"):
        ambid.simulate("prototype", excitation=designed)
