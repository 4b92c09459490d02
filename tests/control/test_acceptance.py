"""What an acceptance is made from: the stiffness of bearings against the rotor that they hold, limits of standards."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.control.acceptance import dynamic_stiffness, outcome_of, stiffness_sd, whirl_lines
from ambid.control.closed import ClosedLoop, Plant
from ambid.control.controller import controller_of_loop
from ambid.control.limits import LIMITS, residual_unbalance, vibration_limit
from ambid.control.zones import Grade
from ambid.physics.presets import preset
from ambid.rig import rig_of_preset

RIG = rig_of_preset(preset("spindle"))
THETA = {p.name: p.value for p in RIG.parameters} | dict(preset("spindle").parameters)
RPM = np.pi / 30.0


def loop_at(frequency_hz, theta=THETA, **more):
    model, rate = RIG.rotor.at_speed(0.0), RIG.rate_hz
    plant = Plant(model=model, theta=theta, delays=np.ones(len(model.inputs)), rate_hz=rate, **more)
    controller = controller_of_loop(RIG.loop, model, rate)
    return ClosedLoop(plant=plant, controller=controller, frequency_hz=np.asarray(frequency_hz))


def test_a_rigid_rotor_in_these_bearings_has_the_compliance_of_the_loop():
    """Where sensors stand at their magnets, rotor and bearings alone say how a force moves the rotor."""
    theta = THETA | {"A.z_sensor": THETA["A.z"], "B.z_sensor": THETA["B.z"]}
    loop = loop_at([5.0, 30.0, 100.0, 250.0, 500.0], theta)
    rows, mass = loop.plant.model.rows(theta)[0], loop.plant.model.rotor_matrices(theta)[0]
    D = dynamic_stiffness(loop)
    for k, f in enumerate(loop.frequency_hz):
        free = np.linalg.inv(rows @ np.diag(1.0 / (mass * (2j * np.pi * f) ** 2)) @ rows.T)
        held = np.linalg.inv(free + np.diag(D[k]))
        np.testing.assert_allclose(loop.compliance[k], np.diag(held), rtol=5e-4)


def test_its_spread_is_that_of_drawn_plants():
    names, rng = ("ax.k_i", "ax.k_x", "ax.R", "ax_voltage.delay"), np.random.default_rng(1)
    sd = np.array([0.01 * THETA["ax.k_i"], 0.01 * abs(THETA["ax.k_x"]), 0.02 * THETA["ax.R"], 0.02])
    known = stiffness_sd(loop_at([100.0], names=names, covariance=np.diag(sd**2)))[0, 0]
    drawn = []
    for step in rng.standard_normal((400, 4)) * sd:
        loop = loop_at([100.0], THETA | {n: THETA[n] + x for n, x in zip(names[:3], step, strict=False)})
        delays = loop.plant.delays + np.eye(loop.plant.delays.size)[0] * step[3]
        drawn.append(dynamic_stiffness(replace(loop, plant=replace(loop.plant, delays=delays)))[0, 0])
    assert np.std(np.real(drawn)) == pytest.approx(known.real, rel=0.12)  # three deviations of a spread of 400
    assert np.std(np.imag(drawn)) == pytest.approx(known.imag, rel=0.12)


def test_the_whirl_of_a_loop_splits_with_the_speed():
    """The loop's modes are one at rest; turning, the forward ones stand above the backward ones."""
    loop = loop_at([10.0], THETA | {"Ip": 20.0 * THETA["Ip"]})
    found = whirl_lines(loop, np.array([0.0, 20_000.0 * RPM]))
    np.testing.assert_allclose(found.forward[0], found.backward[0], rtol=1e-9)
    assert not np.array_equal(found.forward[1], found.backward[1])


def test_limits_are_those_of_the_standards():
    assert vibration_limit(12_000.0 * RPM) == pytest.approx(25.4e-6)
    assert vibration_limit(3_000.0 * RPM) == pytest.approx(50.8e-6)
    assert vibration_limit(3_000.0 * RPM, running=True) == pytest.approx(25.4e-6)
    assert residual_unbalance(100.0, 6350.0 * RPM) == pytest.approx(100e-6)
    assert Grade.of_displacement(0.35, 0.0).letters == "B"
    assert Grade.of_displacement(0.31, 0.02).letters == "A or B"


@pytest.mark.parametrize(
    ("name", "confirmed"), [("sensitivity", True), ("sensitivity C", False), ("displacement", False)]
)
def test_a_limit_says_whether_it_is_confirmed(name, confirmed):
    assert ("unconfirmed" in LIMITS[name].source) != confirmed
    assert LIMITS[name].standard in LIMITS[name].source


@pytest.mark.parametrize(
    ("value", "sd", "outcome"),
    [(1.0, 0.0, "passed"), (1.9, 0.01, "passed"), (1.99, 0.1, "doubt"), (2.5, 0.1, "failed")],
)
def test_an_outcome_heeds_the_interval(value, sd, outcome):
    assert outcome_of(1.0, np.nan, 2.0) == "doubt"
    assert outcome_of(value, sd, 2.0) == outcome
