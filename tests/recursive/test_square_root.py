"""The square-root core against dense matrices: every change of a covariance, at scales twelve decades apart."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.recursive import square_root_kernels as core
from ambid.recursive.estimator import covariance_of, factors_of

SCALE = 10.0 ** np.array([-6, 0, 3, 6, -2])
N = SCALE.size


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(1)


@pytest.fixture
def P(rng: np.random.Generator) -> np.ndarray:
    half = SCALE[:, None] * rng.normal(size=(N, N + 2))
    return half @ half.T


def assert_covariance(F: np.ndarray, P: np.ndarray) -> None:
    sd = np.sqrt(np.diag(P))
    np.testing.assert_allclose(covariance_of(F) / np.outer(sd, sd), P / np.outer(sd, sd), atol=1e-12)
    assert (np.diag(F) > 0).all()


def test_factors_are_those_of_the_matrix(P: np.ndarray) -> None:
    F = factors_of(P)
    assert_covariance(F, P)
    for i in range(N):
        assert core.variance(F, i) == pytest.approx(P[i, i], rel=1e-12)
    flat = factors_of(np.outer(SCALE, SCALE))  # one direction alone: the rest is rounding
    np.testing.assert_allclose(covariance_of(flat) / np.outer(SCALE, SCALE), 1.0, atol=1e-6)


def test_a_measurement_takes_what_it_says(P: np.ndarray, rng: np.random.Generator) -> None:
    F, h, f, k = factors_of(P), rng.normal(size=N) / SCALE, np.empty(N), np.empty(N)
    core.project(F, h, f)
    assert core.size(F, f) == pytest.approx(h @ P @ h, rel=1e-12)
    alpha = core.shrink(F, f, 0.7, k)
    assert alpha == pytest.approx(0.7 + h @ P @ h, rel=1e-12)
    np.testing.assert_allclose(k, P @ h, rtol=1e-10)
    assert_covariance(F, P - np.outer(k, k) / alpha)


@pytest.mark.parametrize("leading", [N, 3])
def test_adding_one_direction(P: np.ndarray, rng: np.random.Generator, leading: int) -> None:
    F, a = factors_of(P), np.zeros(N)
    a[:leading] = SCALE[:leading] * rng.normal(size=leading)
    core.widen(F, a[:leading].copy(), 2.0)
    assert_covariance(F, P + 2 * np.outer(a, a))


@pytest.mark.parametrize("columns", [0, 2, 3])
def test_leading_states_are_carried_and_the_rest_stays(P: np.ndarray, rng: np.random.Generator, columns: int) -> None:
    n, noises = 2, 3
    s = SCALE[:n, None]
    A, G = s * rng.normal(size=(n, n)) / SCALE[:n], s * rng.normal(size=(n, noises))
    J = s * rng.normal(size=(n, columns)) / SCALE[n : n + columns]
    F = factors_of(P)
    core.propagate(F, A, J, G, np.empty((n, n + noises)), np.empty(n + noises))
    whole = np.eye(N)
    whole[:n, :n], whole[:n, n : n + columns] = A, J
    moved = whole @ P @ whole.T
    moved[:n, :n] += G @ G.T
    assert_covariance(F, moved)


def test_a_noiseless_step_that_forgets_a_state_leaves_no_nan(P: np.ndarray) -> None:
    F = factors_of(P)
    core.propagate(F, np.diag([1.0, 0.0]), np.zeros((2, 0)), np.zeros((2, 1)), np.empty((2, 3)), np.empty(3))
    assert np.isfinite(np.tril(F)).all()
    assert core.variance(F, 1) == 0.0
    core.widen(F, np.array([0.0, 1e-3]), 1.0)
    assert core.variance(F, 1) == pytest.approx(1e-6)


def test_many_measurements_of_one_direction_keep_the_rest(P: np.ndarray) -> None:
    F, h, f, k = factors_of(P), 1 / SCALE, np.empty(N), np.empty(N)
    for _ in range(20_000):
        core.project(F, h, f)
        core.shrink(F, f, 1e-9, k)
        F[np.diag_indices(N)] *= 1.001
    assert np.isfinite(F).all()
    assert (np.diag(F) > 0).all()
