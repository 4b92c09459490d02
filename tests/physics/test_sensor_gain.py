"""Gains of sensors as parameters: exact derivatives, and what a gain of the position sensor hides behind."""

import numpy as np
import pytest

from ambid.errors import ModelError
from ambid.physics.linear_model import model, model_names, zero_order_hold
from ambid.physics.sensor_gain import SensorGains

THETA = {"m": 4.0, "k_x": -1.29e5, "k_i": 55.7, "R": 1.6, "L": 0.026, "c": 3.0}


def parts(matrices):
    return [getattr(matrices, name) for name in "ABEC"]


def at(name, **gains):
    plant = SensorGains(model(name))
    return plant, {p.name: THETA.get(p.name, 1.0) for p in plant.base.parameters} | gains


@pytest.mark.parametrize("name", model_names())
def test_a_gain_of_one_changes_nothing(name):
    plant, theta = at(name)
    for seen, base in zip(parts(plant.matrices(theta)), parts(plant.base.matrices(theta)), strict=True):
        np.testing.assert_array_equal(seen, base)


@pytest.mark.parametrize("name", model_names())
def test_derivatives_are_those_of_the_complex_step(name):
    plant, theta = at(name)
    theta |= {gain: 0.7 + 0.2 * k for k, gain in enumerate(plant.gains)}
    for parameter in (p.name for p in plant.parameters):
        h = 1e-30
        moved = plant.matrices({**theta, parameter: theta[parameter] + 1j * h})
        for found, seen in zip(parts(plant.derivative(theta, parameter)), parts(moved), strict=True):
            np.testing.assert_allclose(found, np.imag(seen) / h, rtol=1e-12, atol=1e-9)


def test_a_gain_of_the_position_hides_behind_the_mass():
    """Logged position g x: the same as a bench with m/g^2, c/g^2, k_x/g^2 and k_i/g, its force scaled by 1/g."""
    g = 0.8
    plant, theta = at("one-axis", gain_position=g)
    other = {k: theta[k] / g**2 for k in ("m", "c", "k_x")} | {"k_i": theta["k_i"] / g}
    seen, hidden = plant.matrices(theta), plant.base.matrices({**theta, **other})
    np.testing.assert_allclose(seen.A, hidden.A, rtol=1e-14)
    np.testing.assert_allclose(seen.B, hidden.B, rtol=1e-14)
    force = plant.disturbances.index("force")
    np.testing.assert_allclose(seen.E[:, force], hidden.E[:, force] / g, rtol=1e-14)


def test_outputs_are_those_of_the_bench_times_their_gains():
    plant, theta = at("one-axis", gain_position=1.3, gain_current=0.6)
    responses = []
    for matrices in (plant.matrices(theta), plant.base.matrices(theta)):
        A, B = zero_order_hold(matrices.A, matrices.B, 1e-4)
        x, y = np.zeros(3), []
        for k in range(50):
            y.append(matrices.C @ x)
            x = A @ x + B[:, 0] * np.cos(0.3 * k)
        responses.append(np.array(y))
    np.testing.assert_allclose(responses[0], responses[1] * [1.3, 0.6], rtol=1e-9, atol=1e-15)


def test_an_unknown_parameter_is_refused():
    plant, theta = at("one-axis")
    with pytest.raises(ModelError):
        plant.derivative(theta, "gain_speed")
