"""Recursive least squares against its batch definition, the Kalman filter, and through hard times."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.recursive.regression import RecursiveLeastSquares

N = 300


def data(p: int, n: int = N, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    phi = rng.normal(size=(n, p)) @ rng.normal(size=(p, p)) + 0.3
    return phi, phi @ np.arange(1.0, p + 1) + 0.2 * rng.normal(size=n)


def matrix(p: int) -> np.ndarray:
    A = np.random.default_rng(9).normal(size=(p, p))
    return 3 * np.eye(p) + A @ A.T


@pytest.mark.parametrize("p", [1, 3, 4, 6])  # four have a loop of their own
@pytest.mark.parametrize("factor", [None, 0.98, 0.6])
def test_is_weighted_batch_least_squares_with_the_same_prior(p: int, factor: float | None) -> None:
    phi, y = data(p)
    start, prior = np.full(p, 0.5), matrix(p)
    rls = RecursiveLeastSquares(p, start=start, prior=prior, factor=factor, limit=1e12, noise_sd=0.2)
    errors = rls.update(phi, y)
    keep = 1.0 if factor is None else factor
    w = keep ** np.arange(N - 1, -1, -1.0)
    inverse = np.linalg.inv(prior)
    information = phi.T @ (w[:, None] * phi) + keep**N * inverse
    P = np.linalg.inv(information)
    theta = P @ (phi.T @ (w * y) + keep**N * inverse @ start)
    squares = phi.T @ (w[:, None] ** 2 * phi) + keep ** (2 * N) * inverse
    np.testing.assert_allclose(rls.estimate, theta, rtol=1e-9)
    np.testing.assert_allclose(rls.P, P, rtol=1e-8, atol=1e-9 * np.abs(P).max())
    np.testing.assert_allclose(rls.covariance, 0.04 * P @ squares @ P, rtol=1e-7, atol=1e-8 * 0.04 * np.abs(P).max())
    np.testing.assert_allclose(errors[0], y[0] - phi[0] @ start, rtol=1e-13)


def test_with_forgetting_the_error_is_smaller_than_the_matrix_by_one_plus_factor() -> None:
    phi, y = data(4, 60_000)
    rls = RecursiveLeastSquares(4, factor=0.999, noise_sd=1.0)
    rls.update(phi, y)
    np.testing.assert_allclose(np.diag(rls.P) / np.diag(rls.covariance), 1.999, rtol=0.05)


def test_wind_up_ends_at_the_limit_and_the_estimate_stays() -> None:
    phi, y = data(4, 2000)
    rls = RecursiveLeastSquares(4, prior=2.0, memory=50, limit=10.0)
    rls.update(phi, y)
    at, covariance = rls.estimate, rls.covariance
    rls.update(np.zeros((100_000, 4)), np.zeros(100_000))
    assert 9.0 < np.mean(np.diag(rls.P) / 2.0) < 10.0 * (1 + 1e-9)
    np.testing.assert_array_equal(rls.estimate, at)
    np.testing.assert_allclose(rls.covariance, covariance, rtol=1e-6)  # silence says nothing of the error


@pytest.mark.parametrize("settings", [{"memory": 1000.0}, {"factor": 0.3}])
def test_ten_million_poor_updates_keep_the_covariance_sound(settings: dict[str, object]) -> None:
    """Regressors of 1e-9 to 1e6, bursts, collinear stretches and silence."""
    rng = np.random.default_rng(2)
    scale = np.array([1e-9, 1.0, 1e3, 1e6])
    n = 50_000
    phi = rng.normal(size=(n, 4))
    phi[n // 5 : 2 * n // 5] = phi[n // 5 : 2 * n // 5, :1]  # all the same
    phi[2 * n // 5 : 4 * n // 5] = 0.0
    phi[3 * n // 5] = 1e-3
    phi *= scale
    y = phi @ (np.arange(1.0, 5.0) / scale) + 0.1 * rng.normal(size=n)
    rls = RecursiveLeastSquares(4, prior=1e4 / scale**2, **settings)  # type: ignore[arg-type]
    turns = 200 if "memory" in settings else 15
    for _ in range(turns):
        rls.update(phi, y)
        for P in (rls.P, rls.covariance):
            sd = np.sqrt(np.diag(P))
            assert np.isfinite(P).all()
            assert (sd > 0).all()
            assert np.linalg.eigvalsh(P / np.outer(sd, sd))[0] > -1e-14
        assert (np.diag(rls._factors(0)) > 0).all()
    assert rls.n_used == turns * n
    assert (np.abs(rls.estimate * scale - np.arange(1.0, 5.0)) < 6 * np.sqrt(np.diag(rls.covariance)) * scale).all()


def test_scale_of_regressors_does_not_matter() -> None:
    phi, y = data(4)
    scale = 2.0 ** np.array([-30, 0, 10, 20])
    one = RecursiveLeastSquares(4, memory=80, prior=100.0)
    other = RecursiveLeastSquares(4, memory=80, prior=100.0 / scale**2)
    one.update(phi, y)
    other.update(phi * scale, y)
    np.testing.assert_allclose(other.estimate * scale, one.estimate, rtol=1e-12)


def test_numbers_that_lead_out_of_range_are_rejected() -> None:
    rls = RecursiveLeastSquares(4)
    rls.update(*data(4))
    at = rls.estimate
    assert np.isnan(rls.update(np.full(4, 1e120), 1.0))
    assert np.isnan(rls.update(np.ones(4), 1e200))
    assert rls.n_rejected == 2
    np.testing.assert_array_equal(rls.estimate, at)


def test_noise_is_found_from_few_samples_and_kept_in_silence() -> None:
    rng = np.random.default_rng(0)
    found = []
    for _ in range(300):
        phi = rng.normal(size=(24, 4))
        rls = RecursiveLeastSquares(4)
        rls.update(phi, 100 * phi.sum(1) + rng.normal(size=24))
        found.append(rls.noise_variance)
    assert 0.9 < np.mean(found) < 1.1
    rls.update(np.zeros((10_000, 4)), np.zeros(10_000))
    assert rls.noise_variance == found[-1]


@pytest.mark.parametrize(
    "settings",
    [
        {"factor": 1.0},
        {"factor": 0.9, "memory": 10.0},
        {"memory": 0.5},
        {"prior": -1.0},
        {"prior": np.ones((4, 4))},
        {"prior": [1.0, 2.0]},
        {"start": [1.0, np.nan, 0, 0]},
        {"limit": 0.0},
        {"noise_sd": 0.0},
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, object]) -> None:
    with pytest.raises(EstimationError):
        RecursiveLeastSquares(4, **settings)  # type: ignore[arg-type]
    with pytest.raises(EstimationError):
        RecursiveLeastSquares(("a", "a"))


@pytest.mark.parametrize("settings", [{}, {"memory": 500}], ids=str)
@pytest.mark.parametrize("size", [1e-7, 1e6])
def test_without_a_prior_the_units_of_the_signals_do_not_matter(settings: dict[str, object], size: float) -> None:
    phi, y = data(4, 3000)
    scale = np.array([1.0, size, 1.0, size])
    rls = RecursiveLeastSquares(4, **settings)  # type: ignore[arg-type]
    rls.update(phi * scale, y * 1e-6)
    sd = np.sqrt(np.diag(rls.covariance))
    assert (np.abs(rls.estimate - np.arange(1.0, 5.0) * 1e-6 / scale) < 4 * sd).all()
    assert (sd * scale < 0.2 * 1e-6).all()
    assert rls.noise_variance == pytest.approx(0.04e-12, rel=0.15)


def test_silence_winds_up_to_a_limit_without_a_prior_too() -> None:
    phi, y = data(4, 3000)
    rls = RecursiveLeastSquares(4, memory=50)
    rls.update(phi, y)
    best = np.diag(rls.P).mean()
    rls.update(np.zeros((100_000, 4)), np.zeros(100_000))
    assert 1e10 * best < np.diag(rls.P).mean() < 1e13 * best


@pytest.mark.parametrize("n", [4, 5])  # four have a loop of their own
def test_a_stuck_signal_makes_no_coefficient_surer(n: int) -> None:
    rng = np.random.default_rng(0)
    phi = np.column_stack([rng.normal(size=(12_000, n - 1)), np.ones(12_000)])
    truth = np.array([1.0, -2.0, 0.5, 3.0, 2.0])[:n]
    y = phi @ truth + 0.1 * rng.normal(size=12_000)
    rls = RecursiveLeastSquares(n, memory=500)
    rls.update(phi[:10_000], y[:10_000])
    sd, noise = np.sqrt(np.diag(rls.covariance)), rls.noise_variance
    stuck = np.tile(phi[10_000], (300_000, 1))
    rls.update(stuck, stuck @ rls.estimate)
    assert rls.noise_variance < 0.1 * noise  # the calm itself is told as it is
    assert (np.sqrt(np.diag(rls.covariance))[:-1] > 0.65 * sd[:-1]).all()
    assert np.linalg.eigvalsh(rls.covariance)[0] > 0
    rls.update(phi[10_000:], y[10_000:])
    assert rls.noise_variance > 0.1 * noise
    assert (np.abs(rls.estimate - truth) < 5 * sd).all()
