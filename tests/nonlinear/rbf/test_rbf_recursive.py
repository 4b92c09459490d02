"""Training sample by sample: beside the batch solution, and with a bounded rate."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from ambid.nonlinear.fit import NonlinearFit
from ambid.nonlinear.kernels import descent_pass
from ambid.nonlinear.rbf import rbf, train_by_sample
from tests.nonlinear.rbf.systems import bumpy, data, network

GIVEN: dict[str, Any] = {"ny": 1, "nu": 1, "neurons": 6, "width": 0.7}


@cache
def fitted(**told: Any) -> NonlinearFit:
    return rbf([bumpy(800, 1, 0.1)[0]], {**GIVEN, **told})


def test_recursive_training_gives_the_batch_model() -> None:
    record = bumpy(800, 1, 0.1)[0]
    batch, own = fitted(), fitted(training="recursive")
    assert batch.model is not None
    assert own.model is not None
    mine, its = (x.predict(record.u, record.y)[1:] for x in (own.model, batch.model))
    np.testing.assert_allclose(mine, its, atol=1e-7)
    assert own.status == "converged"


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


def test_a_bounded_rate_never_lets_the_present_error_grow() -> None:
    rng = np.random.default_rng(3)
    F = np.hstack([3.0 * rng.standard_normal((300, 2)), np.ones((300, 1)), rng.random((300, 5)) ** 3])
    y, W, bounded = np.sin(2 * F[:, :1]) + 0.1 * rng.standard_normal((300, 1)), np.zeros((1, 8)), 0
    for t in range(300):
        one, size = slice(t, t + 1), float(F[t] @ F[t])
        before = float(y[t, 0] - W[0] @ F[t])
        descent_pass(F[one], y[one], 0.3, W)
        after = float(y[t, 0] - W[0] @ F[t])
        assert after == pytest.approx((1 - min(0.3, 1 / size) * size) * before, abs=1e-9 * (1 + abs(before)))
        assert abs(after) <= abs(before) * (1 + 1e-9)
        bounded += 2 / size < 0.3  # where the rate of the thesis, unbounded, would let it grow
    assert bounded > 20


def test_descent_comes_near_whatever_its_rate() -> None:
    tame = fitted(training="descent", rate=0.9)
    assert tame.model is not None
    assert np.max(tame.curves[1].training) < 1.5
    slow = fitted(training="descent")
    assert slow.curves[1].training[-1] < 1.15 * slow.curves[0].training[-1]
    assert slow.status == "stalled"  # it crawls along the flat directions, and says so
    assert any("not converged" in w for w in slow.warnings)
    assert slow.covariance is None
    assert any("standard deviations" in w for w in slow.warnings)


def test_the_triangle_stands_where_a_covariance_matrix_breaks_down() -> None:
    """Rounding, and with it the machine, decides in which of the cases the printed recursion is far off."""
    rng = np.random.default_rng(6)
    u = rng.standard_normal((400, 2))
    y = np.sin(2 * u[:, :1]) + 0.1 * rng.standard_normal((400, 1))
    u[:, 1] = u[:, 0] + 1e-8 * u[:, 1]  # condition of the normal matrix: 1e16
    y = y + 0.5 * u[:, :1] + 3e7 * (u[:, 1:] - u[:, :1])
    u, y = (np.concatenate([x[:1], x]) for x in (u, y))  # the first sample is past
    s, printed = network(1, 2, ny=0, nu=1, nk=0, neurons=5), []
    for seed in range(4, 10):
        theta = np.concatenate([np.zeros(s.n_weights), np.random.default_rng(seed).standard_normal(10), np.zeros(5)])
        rows = s.rows(y, u)
        found, _ = train_by_sample(s, theta, rows.x, rows.y, np.full((1, s.n_weights), 1e-10), None, None)
        A, target = s.features(theta, rows.x), rows.y[:, 0]
        batch = np.linalg.lstsq(A, target, rcond=1e-15)[0]
        off = [np.std(target - A @ w) for w in (s.matrix(found)[0], batch)]
        assert off[0] < 1.001 * off[1]
        w, P = np.zeros(s.n_weights), 1e20 * np.eye(s.n_weights)  # recursive least squares as it is usually printed
        for a, b in zip(A, target, strict=True):
            k = P @ a / (1 + a @ P @ a)
            w, P = w + k * (b - a @ w), P - np.outer(k, a @ P)
        printed.append(np.std(target - A @ w) / off[1])
    assert not max(printed) < 1.2


def test_curves_stand_beside_each_other_and_an_interruption_keeps_the_weights() -> None:
    for how, method, passes in (("descent", "steepest descent", 20), ("recursive", "recursive Gauss-Newton", 1)):
        fit = fitted(training=how)
        assert [c.method.split(",")[0] for c in fit.curves] == ["linear least squares", method]
        c = fit.curves[1]
        assert c.training[0] == pytest.approx(fit.curves[0].training[0])  # from weights of zero
        assert c.training[-1] >= fit.curves[0].training[-1] * (1 - 1e-6)
        assert c.training.size == 8 * passes + 1

    def stop(stage: str, done: float | None = None, /) -> None:
        del done
        if stage.startswith("steepest descent"):
            raise KeyboardInterrupt

    record = bumpy(800, 1, 0.1)[0]
    found = rbf([record], {**GIVEN, "training": "descent"}, tick=stop)
    assert found.status == "stalled"
    assert found.model is not None
    batch = fitted().model
    assert batch is not None
    np.testing.assert_array_equal(found.model.theta, batch.theta)
