"""Training sample by sample: beside the batch solution, and with a rate that is bounded or not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ambid.blackbox.data import IOData
from ambid.estimation.search import search
from ambid.nonlinear.fit import NonlinearFit
from ambid.nonlinear.lagged import Rows
from ambid.nonlinear.lagged_problem import LaggedProblem
from ambid.nonlinear.rbf import rbf
from ambid.nonlinear.rbf_kernels import descent_pass, recursive_pass
from ambid.nonlinear.rbf_network import RbfFunction, rbf_problem
from ambid.nonlinear.rbf_recursive import GAUSS_NEWTON, Recursion, left_to_gain
from tests.nonlinear.rbf.systems import CENTRES, WIDTHS, bumpy, data, network

GIVEN: dict[str, Any] = {"ny": 1, "nu": 1, "neurons": 6, "width": 0.7}


def fitted(n: int = 800, **told: Any) -> NonlinearFit:
    return rbf([bumpy(n, 1, 0.1)[0]], {**GIVEN, **told})


def test_recursive_training_gives_the_batch_model() -> None:
    record = bumpy(800, 1, 0.1)[0]
    batch, own = fitted(), fitted(training="recursive")
    assert batch.model is not None
    assert own.model is not None
    mine, its = (x.predict(record.u, record.y)[1:] for x in (own.model, batch.model))
    np.testing.assert_allclose(mine, its, atol=1e-7)
    assert own.status == "converged"


@pytest.mark.parametrize("passes", [1, 3])
def test_recursive_least_squares_ends_at_the_batch_weights(passes: int) -> None:
    problem, start = known_problem(bumpy(800, 1, 0.1)[0])
    of = problem.function
    assert isinstance(of, RbfFunction)
    problem = replace(problem, live=np.arange(of.n_theta) < of.n_weights, base=start)
    batch = search(problem, start[problem.live], stage="", most=20).theta
    own = Recursion(problem, start, method=GAUSS_NEWTON, rate=0.0, bounded=True, passes=passes)
    own.run(None)
    # the prior comes in turns, which is even over a pass to one row
    np.testing.assert_allclose(own.theta[problem.live], batch, rtol=1e-7 if passes == 1 else 1e-3, atol=1e-8)


def test_two_outputs_are_weighted_by_their_noise() -> None:
    rng = np.random.default_rng(2)
    u, y = rng.standard_normal((600, 1)), np.zeros((600, 2))
    for t in range(1, 600):
        y[t] = [0.5 * y[t - 1, 0] + np.tanh(2 * u[t - 1, 0]), 0.3 * y[t - 1, 0] + np.cos(u[t - 1, 0])]
        y[t] += [0.01, 0.3] * rng.standard_normal(2)
    found = [rbf([data(u, y)], {**GIVEN, "training": how}).model for how in ("linear", "recursive")]
    assert found[0] is not None
    assert found[1] is not None
    np.testing.assert_allclose(found[1].theta, found[0].theta, rtol=1e-6, atol=1e-8)


def known_problem(record: IOData) -> tuple[LaggedProblem, np.ndarray]:
    """The network that made the record, all of it to be trained; and a start beside the truth."""
    s, rng = network(neurons=3), np.random.default_rng(9)
    start = np.concatenate([np.zeros(s.n_weights), CENTRES.ravel(), np.log(WIDTHS)])
    start[s.n_weights :] += 0.2 * rng.standard_normal(start.size - s.n_weights)
    parts = ((record.y, record.u),)
    problem = rbf_problem(s, parts, start, np.array([10.0]), start, all_numbers=True)
    return replace(problem, weight=np.array([[10.0]])), start


def test_recursive_gauss_newton_over_everything_comes_to_the_batch_optimum() -> None:
    problem, start = known_problem(bumpy(2000, 1, 0.1)[0])
    batch = search(problem, start, stage="", most=100)
    assert batch.converged
    found = {}
    for passes in (1, 20):
        own = Recursion(problem, start, method=GAUSS_NEWTON, rate=0.0, bounded=True, passes=passes)
        own.run(None)
        found[passes] = problem.cost(own.theta) - batch.cost, left_to_gain(problem, own.theta)
    assert -1e-6 < found[20][0] < 0.5  # below a standard deviation of all numbers taken together
    assert found[20][1] < 1.0
    assert found[1][1] > found[20][1]


def rows(n: int, seed: int, size: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    z = size * rng.standard_normal((n, 2))
    return z, z.copy(), np.sin(2 * z[:, :1]) + 0.1 * rng.standard_normal((n, 1))


def seen(s: RbfFunction, z: np.ndarray, y: np.ndarray) -> Rows:
    """Regressors as rows."""
    return Rows(z=z, x=z, y=y, prepared=tuple(b.prepare(z) for b in s.blocks))


def placed(n_units: int = 5) -> np.ndarray:
    rng = np.random.default_rng(4)
    s = network(neurons=n_units)
    return np.concatenate([np.zeros(s.n_weights), rng.standard_normal(2 * n_units), np.zeros(n_units)])


def test_a_bounded_rate_never_lets_the_present_error_grow_and_an_unbounded_one_does() -> None:
    s, (z, x, y) = network(neurons=5), rows(300, 3, size=3.0)
    grown = {}
    for bounded in (1, 0):
        theta, count = placed(), 0
        for t in range(300):
            one = slice(t, t + 1)
            before = float((y[one] - s.values(theta, seen(s, z[one], y[one])))[0, 0])
            if descent_pass(z[one], x[one], y[one], 0.3, bounded, 0, 1, 5, s.n_weights, theta) >= 0:
                break
            after = float((y[one] - s.values(theta, seen(s, z[one], y[one])))[0, 0])
            size = float(np.sum(s.slopes(theta, seen(s, z[one], y[one]), free=False)[0, 0, : s.n_weights] ** 2))
            rate = min(0.3, 1 / size) if bounded else 0.3
            assert after == pytest.approx((1 - rate * size) * before, abs=1e-9 * (1 + abs(before)))
            if abs(before) > 1e-9:
                assert (abs(after) > abs(before)) == (rate > 2 / size)  # the bound of the thesis's rate, 2/lambda_max
            count += abs(after) > abs(before) * (1 + 1e-9)
        grown[bounded] = count
    assert grown[1] == 0
    assert grown[0] > 20


def test_descent_diverges_unbounded_and_comes_near_bounded() -> None:
    wild = fitted(training="descent", rate=0.9, bounded=0)
    assert wild.status == "failed"
    assert wild.model is None
    assert "steepest descent diverged" in wild.reason
    assert "bounded" in wild.reason
    tame = fitted(training="descent", rate=0.9)
    assert tame.model is not None
    assert np.max(tame.curves[1].training) < 1.5
    slow = fitted(training="descent")
    assert slow.curves[1].training[-1] < 1.15 * slow.curves[0].training[-1]
    assert slow.status == "stalled"  # it crawls along the flat directions, and says so
    assert any("not converged" in w for w in slow.warnings)
    assert slow.covariance is None
    assert any("standard deviations" in w for w in slow.warnings)


def test_centres_and_widths_descend_as_well() -> None:
    few = {"neurons": 3, "centres": "kmeans", "width": 1.0, "training": "descent", "rate": 0.05}
    fixed, all_ = fitted(**few), fitted(**few, trained="all")
    assert fixed.model is not None
    assert all_.model is not None
    assert not np.array_equal(all_.model.theta[-9:], fixed.model.theta[-9:])
    assert all_.curves[1].training[-1] < 0.9 * fixed.curves[1].training[-1]


def test_gauss_newton_needs_the_sample_in_its_matrix_before_the_step() -> None:
    wild = fitted(training="recursive", bounded=0)  # as printed: the step with R of before, which is next to nothing
    assert wild.status == "failed" or wild.curves[1].training[1] > 100 * wild.curves[1].training[0]
    s, (z, x, y) = network(neurons=5), rows(200, 5)
    theta, S = placed(), 1e-4 * np.eye(s.n_weights)
    none = np.empty(0)
    for t in range(200):
        one = slice(t, t + 1)
        before = float((y[one] - s.values(theta, seen(s, z[one], y[one])))[0, 0])
        gain = np.array([1.0 / (t + 2.0)])
        assert recursive_pass(z[one], x[one], y[one], np.ones(1), gain, 1, 0, 1, 5, none, none, 0, theta, S) == -1
        after = float((y[one] - s.values(theta, seen(s, z[one], y[one])))[0, 0])
        assert abs(after) <= abs(before) * (1 + 1e-9)
        assert after * before >= 0


def test_the_triangle_stands_where_a_covariance_matrix_breaks_down() -> None:
    s, (z, x, y) = network(neurons=5), rows(400, 6)
    z[:, 1] = z[:, 0] + 1e-8 * z[:, 1]  # condition of the normal matrix: 1e16
    x[:] = z
    y = y + 0.5 * z[:, :1] + 3e7 * (z[:, 1:] - z[:, :1])
    theta, S = placed(), 1e-10 * np.eye(s.n_weights)
    gain, none = 1.0 / (np.arange(400) + 2.0), np.empty(0)
    assert recursive_pass(z, x, y, np.ones(1), gain, 1, 0, 1, 5, none, none, 0, theta, S) == -1
    A = np.hstack([z, np.ones((400, 1)), s.activations(theta, z)])
    batch = np.linalg.lstsq(A, y[:, 0], rcond=1e-15)[0]
    off = [np.std(y[:, 0] - A @ w) for w in (theta[: s.n_weights], batch)]
    assert off[0] < 1.001 * off[1]
    w, P = np.zeros(s.n_weights), 1e20 * np.eye(s.n_weights)  # recursive least squares as it is usually printed
    for a, b in zip(A, y[:, 0], strict=True):
        k = P @ a / (1 + a @ P @ a)
        w, P = w + k * (b - a @ w), P - np.outer(k, a @ P)
    assert not np.std(y[:, 0] - A @ w) < 1.1 * off[1]


def test_curves_stand_beside_each_other_and_an_interruption_keeps_the_weights() -> None:
    fit = fitted(training="descent")
    assert [c.method.split(",")[0] for c in fit.curves] == [
        "linear least squares",
        "steepest descent",
        "recursive Gauss-Newton",
    ]
    for c in fit.curves[1:]:
        assert c.training[0] == pytest.approx(fit.curves[0].training[0])  # from weights of zero
        assert c.training[-1] >= fit.curves[0].training[-1] * (1 - 1e-6)
        assert c.training.size == 8 * 20 + 1

    def stop(stage: str, done: float | None = None, /) -> None:
        del done
        if stage == "steepest descent":
            raise KeyboardInterrupt

    record = bumpy(800, 1, 0.1)[0]
    found = rbf([record], {**GIVEN, "training": "descent"}, tick=stop)
    assert found.status == "stalled"
    assert found.model is not None
    batch = fitted().model
    assert batch is not None
    np.testing.assert_array_equal(found.model.theta, batch.theta)
