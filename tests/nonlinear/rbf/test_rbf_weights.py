"""Output weights: the prior of the restricted likelihood beside a likelihood by brute force; coverage of intervals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from ambid.nonlinear.lagged_problem import laplace
from ambid.nonlinear.rbf import RbfFunction, rbf_problem, solve_weights
from tests.nonlinear.rbf.systems import CENTRES, WIDTHS, bumpy, network


def values(s: RbfFunction, theta: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The network for given regressors."""
    return sum(b.values(t, b.prepare(x)) for b, t in zip(s.blocks, s.split(theta), strict=True))


def made(n: int, seed: int, p: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    s = network(p, 1, neurons=12)
    rng = np.random.default_rng(seed)
    z = rng.standard_normal((n, s.regressors.column.size))
    theta = np.concatenate(
        [np.zeros(s.n_weights), rng.standard_normal(12 * s.units.n_seen), np.log(rng.uniform(0.5, 2.0, 12))]
    )
    y = np.stack([np.sin(2 * z[:, 0] + k) + 0.3 * z[:, 1] for k in range(p)], axis=1)
    return z, theta, y + 0.2 * rng.standard_normal(y.shape)


def test_the_prior_is_that_of_the_largest_restricted_likelihood() -> None:
    z, theta, y = made(60, 0)
    s = network(neurons=12)
    found = solve_weights(s, theta, z, y, None)
    phi, F = s.activations(theta, z), np.hstack([z, np.ones((60, 1))])
    K = np.linalg.svd(F)[0][:, 3:]  # contrasts that the linear part does not touch

    def minus_log(v: np.ndarray) -> float:
        cov = K.T @ (np.exp(v[0]) * np.eye(60) + np.exp(v[1]) * phi @ phi.T) @ K
        return -float(multivariate_normal(cov=cov).logpdf(K.T @ y[:, 0]))

    best = minimize(minus_log, [np.log(0.05), 0.0], method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-8}).x
    assert np.log(found.noise[0]) == pytest.approx(best[0], abs=0.02)
    assert 2 * np.log(found.prior[0]) == pytest.approx(best[1], abs=0.05)


@pytest.mark.parametrize("linear", [True, False])
def test_a_prior_that_is_told_gives_ridge_regression_output_by_output(linear: bool) -> None:
    z, theta, y = made(80, 1, p=2)
    s = network(2, 1, neurons=12, linear=linear)
    theta = np.concatenate([np.zeros(s.n_weights), theta[-12 * 4 :]])
    found = solve_weights(s, theta, z, y, 0.7)
    np.testing.assert_allclose(found.prior, 0.7, rtol=1e-9)
    A = np.hstack([z if linear else z[:, :0], np.ones((80, 1)), s.activations(theta, z)])
    (L, c), (W, *_) = (b.parts(t) for b, t in zip((s.line, s.units), s.split(found.theta), strict=True))
    for o in range(2):
        ridge = np.sqrt(found.noise[o]) / 0.7 * np.eye(A.shape[1])[-12:]
        w = np.linalg.lstsq(np.vstack([A, ridge]), np.concatenate([y[:, o], np.zeros(12)]), rcond=None)[0]
        mine = np.concatenate([L[o] if linear else [], [c[o]], W[o]])
        np.testing.assert_allclose(mine, w, rtol=1e-8, atol=1e-10)
        rest = y[:, o] - A @ w
        penalised = rest @ rest + found.noise[o] / 0.7**2 * W[o] @ W[o]
        assert penalised / (80 - A.shape[1] + 12) == pytest.approx(found.noise[o], rel=1e-9)


def test_without_units_and_with_a_regressor_twice_it_is_least_squares() -> None:
    z, _, y = made(40, 2)
    twice = np.hstack([z, z[:, :1]])
    s = network(1, 1, ny=2, neurons=0)
    found = solve_weights(s, np.zeros(s.n_theta), twice, y, None)
    w = np.linalg.lstsq(np.hstack([z, np.ones((40, 1))]), y, rcond=None)[0]
    np.testing.assert_allclose(values(s, found.theta, twice), z @ w[:2] + w[2], atol=1e-9)


def test_numbers_that_are_not_finite_are_an_error() -> None:
    z, theta, y = made(40, 3)
    with pytest.raises(np.linalg.LinAlgError):
        solve_weights(network(neurons=12), theta, z, np.where(y > 0, np.inf, y), None)


def test_intervals_of_the_weights_cover_the_truth() -> None:
    s = network(neurons=3)
    placed = np.concatenate([np.zeros(s.n_weights), CENTRES.ravel(), np.log(WIDTHS)])
    truth = np.array([0.5, 0.3, 0.2, 1.0, -0.8, 0.6])
    inside, scores = 0, []
    for seed in range(150):
        record, _ = bumpy(300, 500 + seed, 0.1)
        z, y = s.rows(record.y, record.u).x, record.y[1:]
        found = solve_weights(s, placed, z, y, None)
        problem = rbf_problem(s, ((record.y, record.u),), found.theta, found.prior, placed, all_numbers=False)
        about = laplace(problem, found.theta)
        assert about.covariance is not None
        assert about.effective == pytest.approx(found.effective[0], rel=1e-3)
        assert about.noise[0, 0] == pytest.approx(found.noise[0], rel=0.02)
        away = (found.theta[: s.n_weights] - truth) / np.sqrt(np.diag(about.covariance))
        inside += np.count_nonzero(np.abs(away) < 1.96)
        scores.append(away)
    assert 0.92 <= inside / 900 <= 0.975  # 0.95 with a deviation of about 0.01
    assert np.all(np.abs(np.mean(scores, axis=0)) < 0.35)  # the prior draws weights inward by less than their spread


def test_regressors_that_are_the_same_cost_nothing() -> None:
    """An input that turns its sign every sample: its second lag is the first, and no direction is lost to it."""
    z, theta, y = made(60, 4)
    z[:, 1] = np.where(np.arange(60) % 2, 1.0, -1.0)
    s, wide = network(neurons=12), network(nu=2, neurons=12, metric=np.eye(3)[:2])
    theta = theta[s.n_weights :]
    one = solve_weights(s, np.concatenate([np.zeros(s.n_weights), theta]), z, y, None)
    twice = np.hstack([z, -z[:, 1:]])
    same = solve_weights(wide, np.concatenate([np.zeros(wide.n_weights), theta]), twice, y, None)
    np.testing.assert_allclose(values(wide, same.theta, twice), values(s, one.theta, z), atol=1e-9)
    np.testing.assert_allclose(same.noise, one.noise, rtol=1e-9)
    np.testing.assert_allclose(same.effective, one.effective, rtol=1e-9)
