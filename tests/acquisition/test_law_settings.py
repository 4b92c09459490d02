"""State-space laws from a rig to the controller's words and back, and what refuses them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ambid.acquisition.devices.simulated import SimulatedDevice
from ambid.acquisition.settings import controller_settings, law_trial, realised
from ambid.errors import DeviceError, RigError
from ambid.physics.law import StateLaw
from ambid.physics.loop import Loop
from ambid.physics.presets import preset
from ambid.rig import rig_of_preset
from tests.bars.host import prototype

RIG = prototype()
PID = RIG.loop.as_law(2000.0)


def with_law(law, rig=RIG):
    """Return the prototype's rig with another loop."""
    return replace(rig, loop=Loop(law=law, delay=rig.loop.delay))


def test_realised_is_the_law_within_its_rounding():
    rig = with_law(PID)
    settings = controller_settings(rig)
    assert (settings.kp, settings.ki, settings.kd, settings.kc) == (0, 0, 0, 0)
    assert (settings.setpoint, settings.duty_bias) == (512, 400)
    assert settings.closed
    f = np.geomspace(0.1, 990.0, 100)
    ratio = realised(settings, rig).law.response(f) / PID.response(f)
    assert 0.0 < np.abs(20.0 * np.log10(np.abs(ratio))).max() < 0.02
    # In SI its states are those of the words; what a rounded word is missing shows.
    assert realised(settings, rig).law.rate_hz == 2000.0


def test_a_law_of_the_position_alone_and_one_of_six_states():
    alone = RIG.loop.as_law(2000.0, current=False)
    assert controller_settings(with_law(alone)).law.rows[:, 4].tolist() == [0, 0]
    assert controller_settings(with_law(PID)).law.order == 2


def test_what_cannot_be_held_is_refused():
    many = StateLaw(A=np.diag(np.linspace(0.1, 0.9, 7)), B=np.ones((7, 2)), C=np.ones((1, 7)), D=PID.D, rate_hz=2000.0)
    with pytest.raises(RigError, match=r"loop.A has 7 states; the controller has room for 1 to 6"):
        controller_settings(with_law(many))
    with pytest.raises(RigError, match=r"is for 1000 Hz, not for 2000 Hz"):
        controller_settings(with_law(replace(PID, rate_hz=1000.0)))
    with pytest.raises(RigError, match=r"the row of loop.C and D sums up to"):
        controller_settings(with_law(replace(PID, D=100.0 * PID.D)))
    fast = replace(RIG, daq=replace(RIG.daq, rate_hz=2500.0))
    four = replace(many, A=many.A[:4, :4], B=many.B[:4], C=many.C[:, :4], G=many.windup[:4], rate_hz=2500.0)
    with pytest.raises(RigError, match=r"loop.A has 4 states; at 2500 Hz the controller has time for 3"):
        controller_settings(with_law(four, fast))
    with pytest.raises(RigError, match=r"has no .loop. with a gain"):
        law_trial(RIG, replace(RIG, loop=None))


def test_a_trial_is_bounded_half_way_to_the_trips():
    settings, trial = controller_settings(RIG), law_trial(RIG, RIG)
    assert trial.law == controller_settings(with_law(PID)).law
    assert settings.position_low < trial.low < settings.setpoint < trial.high < settings.position_high
    assert trial.low - settings.position_low == pytest.approx(settings.setpoint - trial.low, abs=1)


def test_the_simulated_controller_levitates_with_a_law_and_tries_none():
    with SimulatedDevice(with_law(PID)) as device:
        device.start("levitate")
        position = np.concatenate([device.read(0.1).block.values[:, 0] for _ in range(100)])
        assert device.state == "levitating"
        assert np.abs(position[:200] - 921).max() < 5  # it lies on its stop while the law watches
        assert np.abs(position[-500:] - 512).max() < 30
        with pytest.raises(DeviceError, match="only the firmware tries a law"):
            device.arm(law_trial(RIG, RIG))


def test_neither_a_rotors_loop_nor_a_law_of_another_rate_is_tried():
    with pytest.raises(RigError, match="rotor on many axes; the controller closes one loop"):
        law_trial(RIG, rig_of_preset(preset("rmit")))
    with pytest.raises(RigError, match=r"rig other.toml: the law of \[loop\] is for 1000 Hz"):
        law_trial(RIG, replace(with_law(replace(PID, rate_hz=1000.0)), source=Path("other.toml")))
