"""From a drawing to the parameters of a rotor in its bearings, and back to a free rotor."""

import math

import numpy as np
import pytest

from ambid.physics import Support, campbell
from ambid.physics.rotor_model import Bearing, RotorModel
from ambid.physics.whirl import drawn_numbers, free_rotor_of, whirl_sd
from tests.physics.test_shaft import TWO_SLEEVES

PLANES = {"A.z": 0.10, "A.z_sensor": 0.13, "B.z": 0.65, "B.z_sensor": 0.62}
MODEL = RotorModel(
    bearings=(
        Bearing(name="A", axes=("ax", "ay"), z=0.10, z_sensors=(0.13,)),
        Bearing(name="B", axes=("bx", "by"), z=0.65, z_sensors=(0.62,)),
    ),
    speed=1500.0, polar=True, n_modes=3,
)  # fmt: skip


def test_drawn_numbers_are_the_models_parameters_and_give_its_whirl() -> None:
    theta = drawn_numbers(MODEL, TWO_SLEEVES, PLANES)
    others = {p.name for p in MODEL.parameters} - set(theta) - set(PLANES)
    assert {name.split(".")[-1] for name in others} == {"k_i", "k_x", "R", "L"}
    rest = {name: {"k_i": 60.0, "k_x": 2e6, "R": 1.0, "L": 0.01}[name.split(".")[-1]] for name in others}
    mass, stiff, damp = MODEL.rotor_matrices({**theta, **PLANES, **rest})
    rows, _ = MODEL.rows({**theta, **PLANES, **rest})
    K = np.diag(stiff) + (rows.T / mass[:, None]) @ (2e6 * rows)
    A = np.block([[np.zeros_like(damp), np.eye(mass.size)], [-K, -damp]])
    wanted = np.linalg.eigvals(A)
    wanted = np.sort(wanted.imag[wanted.imag > 0])
    rotor = free_rotor_of(MODEL, theta | PLANES)
    whirl = campbell(rotor, [MODEL.speed], [Support(z=PLANES[x], stiffness=2e6) for x in ("A.z", "B.z")])
    np.testing.assert_allclose(whirl.frequency[0], wanted, rtol=1e-9)
    assert theta["mode1.omega"] / (2 * math.pi) == pytest.approx(145.66, abs=0.01)


def test_a_plane_with_two_names_is_one_node() -> None:
    planes = {**PLANES, "A.z_sensor": 0.10}
    rotor = free_rotor_of(MODEL, drawn_numbers(MODEL, TWO_SLEEVES, planes) | planes)
    np.testing.assert_array_equal(rotor.z, [0.10, 0.62, 0.65])


def test_the_spread_of_whirl_is_that_of_drawn_parameters() -> None:
    model = MODEL.with_modes(2)
    theta = drawn_numbers(model, TWO_SLEEVES, PLANES) | PLANES | {"mode1.zeta": 0.01, "mode2.zeta": 0.02}
    names = ["Id", "Ip", "mode1.omega", "mode2.zeta", "gyro.12", "gyro.01", "gyro.22"]
    speeds = [50.0, 500.0, 2000.0]
    whirl = campbell(free_rotor_of(model, theta), speeds)
    for name in names:  # of each alone: the change of frequency by a small step
        h = 1e-3 * max(abs(theta[name]), 1e-3)
        up, down = (campbell(free_rotor_of(model, theta | {name: theta[name] + d}), speeds) for d in (h, -h))
        wanted = abs(up.frequency - down.frequency) / (2 * h)
        found = whirl_sd(model, theta, [name], np.ones((1, 1)), whirl)
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-14 * whirl.frequency.max() / h)
    at_rest = campbell(free_rotor_of(model, theta), [0.0])  # double poles
    found = whirl_sd(model, theta, ["mode1.omega"], np.ones((1, 1)), at_rest)
    np.testing.assert_allclose(found[0, 1:3], math.sqrt(1 - 0.01**2), rtol=1e-6)
    both = whirl_sd(model, theta, ["Ip", "mode3.omega", "mode1.omega", "ax.k_i"], np.diag([1e-8, 9.0, 4.0, 1.0]), whirl)
    alone = [whirl_sd(model, theta, [n], np.array([[v]]), whirl) for n, v in (("Ip", 1e-8), ("mode1.omega", 4.0))]
    np.testing.assert_allclose(both, np.hypot(*alone), rtol=1e-12)
