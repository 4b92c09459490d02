"""Pulses that find which way a bench answers: what they use, when they end, and what they say of one that hides it."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.acquisition.devices.simulated import SimulatedDevice
from ambid.acquisition.trials import Room, find_polarity, make_look
from ambid.job import commissioning_steps as judge
from ambid.physics.presets import preset
from tests.job.benches import CURRENT, POSITION, Spoiled, prototype

TRIP_A, TRIP_V = 1.0, 11.4


def polarity(device, rig=None):
    rig = rig or prototype()
    with device:
        return find_polarity(
            make_look(device, rig, lambda: False), Room.of(rig), rig, device.info.rate_hz, clear=device.clear
        )


def step(device, rig=None):
    rig = rig or prototype()
    with device:
        return judge.polarity(make_look(device, rig, lambda: False), Room.of(rig), rig, device)


@pytest.mark.parametrize("seed", range(4))
def test_a_sound_bench_answers_the_right_way_from_either_stop(seed):
    found = polarity(SimulatedDevice(prototype(), seed=seed))
    assert (found.current, found.motion, found.troubles) == (1, 1, ())


def test_pulses_are_small_first_short_and_keep_away_from_the_trip():
    found = polarity(SimulatedDevice(prototype()))
    assert abs(found.pulses[0].volts) == pytest.approx(0.02 * TRIP_V, rel=0.01)
    for pulse in found.pulses:
        assert pulse.hold_s <= 0.06
        assert np.max(np.abs(pulse.current)) < 0.7 * TRIP_A
        assert np.max(np.abs(pulse.voltage)) == pytest.approx(abs(pulse.volts), abs=0.03)
    moved = [p.motion for p in found.pulses if p.motion]
    assert len(moved) == 2  # the first that moved it, and once more
    assert moved[0] * moved[1] > 0


def heavy(**changes):
    """The prototype with a rotor that its weight holds down."""
    bench = preset("prototype")
    return replace(bench, plant=replace(bench.plant, gravity=20.0, **changes))


def test_a_rotor_that_cannot_be_lifted_is_a_caution_and_the_pulses_stay_within_their_limit():
    found = step(SimulatedDevice(prototype(), bench=heavy(m=0.6)))
    assert found.passed
    assert "the rotor did not move" in found.cautions[0]
    assert found.numbers == {"current": 1.0, "motion": 0.0}


def test_a_current_that_is_not_shown_ends_it_before_much_voltage_is_ordered():
    def dead(values, device):
        values[:, CURRENT] = 512

    device = Spoiled(prototype(), spoil=dead)
    found = step(device)
    assert "no current is shown" in found.reasons[0]
    assert "2.28 V" in found.reasons[0]  # a fifth of the voltage


def test_a_dead_position_sensor_is_a_caution():
    def dead(values, device):
        values[:, POSITION] = 512

    found = step(Spoiled(prototype(), spoil=dead))
    assert found.passed
    assert "the sign of the position could not be checked" in found.cautions[0]


def test_a_current_that_goes_one_way_only_is_named():
    def rectified(values, device):
        values[:, CURRENT] = 512 + np.abs(values[:, CURRENT] - 512.0)

    assert "whichever way the voltage is pulsed" in step(Spoiled(prototype(), spoil=rectified)).reasons[0]


def test_a_rotor_that_something_else_moves_is_named():
    def pushed(values, device):
        rest = 921.0 if values[0, POSITION] > 512 else 103.0
        values[:, POSITION] = rest + (-1) ** device.starts * np.abs(values[:, POSITION] - rest)

    found = step(Spoiled(prototype(), spoil=pushed))
    assert not found.passed
    assert "something else moves it" in found.reasons[0]


def test_a_trip_of_the_current_ends_it_with_its_words():
    rig = prototype(("current = [-1.0, 1.0] }", "current = [-0.015, 0.015] }"))
    found = step(SimulatedDevice(rig), rig)
    assert "safe state during a pulse of 0.228 V for 0.015 s: over_current" in found.reasons[0]


@pytest.mark.parametrize("phase", [1.0, 4.0])
def test_a_position_that_swings_by_itself_is_no_motion(phase):
    """A rotor that cannot be lifted, and 5 Hz of 40 counts: half of such benches would be said to be reversed."""
    seen = [0]

    def swinging(values, device):
        t = (seen[0] + np.arange(len(values))) / device.info.rate_hz
        values[:, POSITION] += 40.0 * np.sin(2 * np.pi * 5.0 * t + phase)
        seen[0] += len(values)

    found = polarity(Spoiled(prototype(), spoil=swinging, bench=heavy(m=0.6)))
    assert (found.current, found.motion) == (1, 0)


def test_a_noisy_position_hides_nothing_and_invents_nothing():
    noise = np.random.default_rng(1)

    def loud(values, device):
        values[:, POSITION] += 15 * noise.standard_normal(len(values))

    found = polarity(Spoiled(prototype(), spoil=loud))
    assert found.motion in (0, 1)
    assert not any(p.motion for p in found.pulses[:6])
