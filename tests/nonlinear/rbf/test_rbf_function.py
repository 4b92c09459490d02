"""The function of a radial basis network: exact slopes, of predictions and of free runs; divergence; its file."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.nonlinear.cloud import cloud_of
from ambid.nonlinear.model_file import model_from_json, model_to_json
from ambid.nonlinear.rbf.model import RbfNetwork
from ambid.nonlinear.rbf.shape import RbfShape
from ambid.nonlinear.rbf.units import UNITS
from tests.nonlinear.rbf.systems import shape

SHAPES = [
    shape(2, 1, ny=2, nu=2, nk=0, unit="gaussian"),
    shape(1, 2, ny=2, nu=2, nk=3, unit="inverse-multiquadric", linear=False),
    shape(2, 0, ny=3, unit="thin-plate"),
    shape(1, 1, ny=2, nu=2, unit="gaussian", metric=np.array([[1.0, -1.0, 0.0, 0.5], [0.3, 0.0, 2.0, 0.0]])),
]
every = pytest.mark.parametrize("s", SHAPES, ids=["2 outputs", "2 inputs", "time series", "metric"])


def numbers(s: RbfShape, seed: int = 0, size: float = 1.0) -> np.ndarray:
    return size * np.random.default_rng(seed).standard_normal(s.n_theta)


@every
def test_slopes_are_those_of_a_complex_step(s: RbfShape) -> None:
    theta, rng = numbers(s), np.random.default_rng(1)
    z = s.lags.regressors(rng.standard_normal((20, s.n_outputs)), rng.standard_normal((20, s.lags.n_inputs)))
    J = s.slopes(theta, z)
    assert len(s.names) == len(set(s.names)) == s.n_theta
    for k in range(s.n_theta):
        moved = theta.astype(complex)
        moved[k] += 1e-30j
        np.testing.assert_allclose(J[:, :, k], s.values(moved, z).imag / 1e-30, rtol=1e-11, atol=1e-13)


@every
def test_slopes_of_the_free_run(s: RbfShape) -> None:
    rng = np.random.default_rng(2)
    theta = numbers(s, size=0.01 if s.unit == "thin-plate" else 0.2)
    y, u = rng.standard_normal((50, s.n_outputs)), rng.standard_normal((50, s.lags.n_inputs))
    z = s.free_run(theta, y, u)
    assert np.all(np.isfinite(z))
    rows = s.lags.regressors(z[:, : s.n_outputs], u)
    np.testing.assert_allclose(s.values(theta, rows), z[s.lags.lag :, : s.n_outputs], rtol=1e-12, atol=1e-12)
    J = s.free_slopes(theta, z, s.n_theta)
    for k in range(s.n_theta):
        step = np.zeros(theta.size)
        step[k] = 1e-6
        both = [s.free_run(theta + side * step, y, u)[:, : s.n_outputs] for side in (1, -1)]
        np.testing.assert_allclose(J[:, :, k], (both[0] - both[1]) / 2e-6, atol=1e-7)
    np.testing.assert_array_equal(s.free_slopes(theta, z, s.n_weights), J[:, :, : s.n_weights])


@pytest.mark.parametrize("unit", UNITS)
def test_a_unit_has_its_textbook_value_and_no_slope_at_its_centre(unit: str) -> None:
    s = shape(1, 1, neurons=1, unit=unit, linear=False)
    theta = np.array([0.0, 1.0, 0.5, -0.5, np.log(2.0)])  # c, weight, centre, log width
    at = np.array([[0.5, -0.5], [2.5, 1.5]])  # r = 0 and r^2 = 8, two widths squared: q = 2
    wanted = {
        "gaussian": (1.0, np.exp(-1.0)),
        "inverse-multiquadric": (1.0, 1 / np.sqrt(3.0)),
        "thin-plate": (0.0, np.log(2.0)),
    }
    np.testing.assert_allclose(s.values(theta, at)[:, 0], wanted[unit], rtol=1e-14)
    assert not np.any(s.slopes(theta, at)[0, 0, 2:])


def network(theta: np.ndarray, s: RbfShape) -> RbfNetwork:
    x = np.random.default_rng(3).standard_normal((50, s.lags.n_regressors))
    one = np.ones(1)
    return RbfNetwork(
        dt=0.01, shape=s, theta=theta, u_level=0.3 * one, u_scale=2 * one, y_level=-one, y_scale=0.5 * one,
        cloud=cloud_of(x),
    )  # fmt: skip


def test_a_run_that_diverges_is_nan_from_there_on() -> None:
    s = shape(neurons=1)
    grows = np.concatenate([[1.5, 0.0, 0.1], np.zeros(s.n_theta - 3)])
    model = network(grows, s)
    y, u = np.zeros((200, 1)), np.zeros((200, 1))
    run = model.simulate(u, y)[:, 0]
    lost = int(np.argmax(np.isnan(run)))
    assert 20 < lost < 60
    assert np.all(np.isfinite(run[:lost]))
    assert np.all(np.isnan(run[lost:]))
    assert abs((run[lost - 1] + 1) / 0.5) < 1e6 < abs((run[lost - 1] + 1) / 0.5) * 1.6


def test_what_was_written_is_read_bit_by_bit_and_damage_is_refused() -> None:
    s = SHAPES[3]
    model = network(numbers(s), s)
    found = json.loads(json.dumps(model_to_json(model)))
    back = model_from_json(found)
    assert isinstance(back, RbfNetwork)
    u, y = np.random.default_rng(4).standard_normal((2, 40, 1))
    np.testing.assert_array_equal(back.predict(u, y), model.predict(u, y))
    np.testing.assert_array_equal(back.shape.metric, s.metric)
    for key, value in (("unit", "square"), ("theta", found["theta"][:-1]), ("metric", [[1.0, None, 0.0, 0.0]])):
        with pytest.raises(EstimationError, match="radial basis"):
            model_from_json({**found, key: value})
    assert model.with_theta(model.theta + 1).theta[0] == model.theta[0] + 1
    assert replace(model, dt=1.0).dt == 1.0
