"""Recursive instrumental variables against two-stage least squares."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.recursive.regression import RecursiveInstrumentalVariables


def data(m: int, n: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    zeta = rng.normal(size=(n, m))
    phi = zeta @ rng.normal(size=(m, 3)) + 0.5 * rng.normal(size=(n, 3))
    return phi, zeta, phi @ [1.0, -2.0, 0.5] + 0.3 * rng.normal(size=n)


@pytest.mark.parametrize("m", [3, 5])
@pytest.mark.parametrize("factor", [None, 0.98])
def test_is_weighted_two_stage_least_squares(m: int, factor: float | None) -> None:
    phi, zeta, y = data(m)
    w = (1.0 if factor is None else factor) ** np.arange(y.size - 1, -1, -1.0)
    iv = RecursiveInstrumentalVariables(3, n_instruments=m, factor=factor, limit=1e12)
    iv.update(np.column_stack([phi, zeta]), y)
    Zw = w[:, None] * zeta
    weight = np.linalg.inv(Zw.T @ zeta)
    A = phi.T @ Zw @ weight
    theta = np.linalg.solve(A @ (Zw.T @ phi), A @ (Zw.T @ y))
    np.testing.assert_allclose(iv.estimate, theta, rtol=1e-8)


def test_with_the_regressor_as_instrument_it_is_least_squares() -> None:
    phi, _, y = data(3)
    iv = RecursiveInstrumentalVariables(3, correlation=1)
    iv.update(np.column_stack([phi, phi]), y)
    theta, rest, _, _ = np.linalg.lstsq(phi, y, rcond=None)
    np.testing.assert_allclose(iv.estimate, theta, rtol=1e-8)
    covariance = np.linalg.inv(phi.T @ phi) * rest[0] / (y.size - 3)
    np.testing.assert_allclose(np.diag(iv.covariance), np.diag(covariance), rtol=0.25)
    np.testing.assert_allclose(iv.noise_variance, 0.09, rtol=0.2)


def test_silent_instruments_neither_wind_up_nor_move_the_estimate() -> None:
    phi, zeta, y = data(4)
    iv = RecursiveInstrumentalVariables(3, n_instruments=4, memory=50, limit=5.0)
    iv.update(np.column_stack([phi, zeta]), y)
    at, covariance = iv.estimate, iv.covariance
    silence = np.zeros((50_000, 7))
    silence[:, :3] = 0.01
    iv.update(silence, np.full(50_000, 9.0))
    np.testing.assert_allclose(iv.estimate, at, rtol=1e-9)
    np.testing.assert_allclose(iv.covariance, covariance, rtol=1e-3)


def test_instruments_without_bearing_on_the_regressor_give_a_large_covariance() -> None:
    rng = np.random.default_rng(8)
    phi, zeta = rng.normal(size=(2, 1000, 2))
    iv = RecursiveInstrumentalVariables(2)
    y = phi @ [1.0, 1.0] + rng.normal(size=1000)
    iv.update(np.column_stack([phi, zeta]), y)
    good = RecursiveInstrumentalVariables(2)
    good.update(np.column_stack([phi, phi]), y)
    assert (np.diag(iv.covariance) > 50 * np.diag(good.covariance)).all()


def test_too_few_instruments_are_refused() -> None:
    with pytest.raises(EstimationError, match="do not determine"):
        RecursiveInstrumentalVariables(3, n_instruments=2)
    with pytest.raises(EstimationError):
        RecursiveInstrumentalVariables(3, factor=0.9, memory=10)
