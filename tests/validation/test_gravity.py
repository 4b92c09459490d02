"""The balance of gravity: exact for a force that grows as the square of the current, off where current or sign are."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.physics.linear_model import Parameter
from ambid.physics.presets import preset
from ambid.record import Channel, Record
from ambid.rig import RigMagnet, rig_of_preset
from ambid.validation.physical import carries_weight, gravity_balance, loop_agrees

BALL = preset("levitated-ball")
THETA = dict(BALL.parameters)
SINGLE = RigMagnet(kind="single")
NAMES, COVARIANCE = ("m", "k_i"), np.diag([(0.005 * THETA["m"]) ** 2, (0.005 * THETA["k_i"]) ** 2])


def record(amplitude, current=1.0):
    """A ball that is moved along its rest points, x/i constant (thesis eq. 1.9), with some noise on the current."""
    t = np.arange(4000) / 1000.0
    x = 0.010 * (1.0 + amplitude * np.sin(2 * np.pi * t))
    i = current * 95.0 * x + 1e-4 * np.random.default_rng(1).standard_normal(t.size)
    columns = (("position", "m", x), ("current", "A", i))
    return Record(rate_hz=1000.0, channels=tuple(Channel(name=n, unit=u, values=c) for n, u, c in columns))


def balance(magnet=SINGLE, theta=THETA, found=None):
    return gravity_balance(magnet, record(0.01) if found is None else found, theta, NAMES, COVARIANCE)


def test_the_presets_own_parameters_balance_its_weight():
    check = balance()
    assert check.passed
    assert abs(check.values["relative"]) < 1e-3
    assert check.values["sd"] == pytest.approx(np.hypot(0.005, 0.005) * abs(THETA["k_i"] / THETA["m"]))


def test_a_current_with_an_offset_does_not_and_the_offset_is_told():
    """Were it a factor, k_i would be smaller by it, and the balance would hold."""
    check = balance(found=record(0.01, current=1.1))
    assert not check.passed
    assert "10 % more" in check.detail
    assert "A position that reads as much too large, or a current that reads 0.095 A at zero" in check.detail
    scaled = {**THETA, "k_i": THETA["k_i"] / 1.1}
    assert balance(theta=scaled, found=record(0.01, current=1.1)).passed
    assert "asks for -2 g/i0 = -18.78" in check.detail


def test_the_limit_is_what_is_not_known():
    """An offset of the current's zero that the rig admits, and a motion over which no tangent holds."""
    known = Parameter(name="i_offset", unit="A", role="prior", value=0.0, sd=0.05)
    assert balance(RigMagnet(kind="single", parameters=(known,)), found=record(0.01, current=1.1)).passed
    small, large = (balance(found=record(a)).values["expected_sd"] for a in (0.01, 0.2))
    assert small < 0.01 < 0.2 < large


def test_a_reversed_position_is_named_unless_gravity_is_turned_too():
    turned = {**THETA, "k_i": -THETA["k_i"]}
    check = balance(theta=turned)
    assert not check.passed
    assert "position is reversed" in check.detail
    upward = Parameter(name="g", unit="m/s^2", role="fixed", value=-9.81)
    assert balance(RigMagnet(kind="single", parameters=(upward,)), theta=turned).passed


def test_only_one_magnet_against_gravity_is_asked():
    one, both = np.array([0.9, 1.0]), np.array([-1.0, 1.0])
    level = Parameter(name="g", unit="m/s^2", role="fixed", value=0.0)
    assert carries_weight(SINGLE, one)
    assert carries_weight(RigMagnet(), one)
    assert carries_weight(RigMagnet(), -one)
    for magnet, current in ((None, one), (RigMagnet(), both), (RigMagnet(kind="pair"), one),
                            (RigMagnet(kind="single", saturation=True), one),
                            (RigMagnet(kind="single", parameters=(level,)), one)):  # fmt: skip
        assert not carries_weight(magnet, current)


@pytest.mark.parametrize("name", ["unstable-bearing", "rmit-axis", "levitated-ball", "prototype"])
def test_the_rigs_controller_tells_a_reversed_position(name):
    bench = preset(name)
    rig, theta = rig_of_preset(bench), dict(bench.parameters)
    assert loop_agrees(rig, theta, bench.rate_hz).passed
    check = loop_agrees(rig, {**theta, "k_i": -theta["k_i"]}, bench.rate_hz)
    assert not check.passed
    assert "position is reversed, or voltage and current both are" in check.detail
    assert check.values["mirrored"] < 1.0 < check.values["largest_pole"]
    assert "neither" in loop_agrees(rig, {**theta, "k_x": 1e6 * theta["k_x"]}, bench.rate_hz).detail


def test_where_no_loop_is_known_or_none_acted_nothing_is_asked():
    rig = rig_of_preset(BALL)
    assert loop_agrees(replace(rig, open_loop=True), THETA, 2000.0) is None
    assert loop_agrees(replace(rig, loop=None), THETA, 2000.0) is None
