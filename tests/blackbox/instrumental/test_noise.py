"""The noise model and what it does to instrumental sums."""

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from ambid.blackbox.blocks import score_covariance_of
from ambid.blackbox.instrumental import Autoregression, autoregression, noise_covariance, score_covariance

D = np.array([1.0, -1.2, 0.5])


def test_burg_finds_order_coefficients_and_variance():
    e = lfilter([1.0], D, 0.3 * np.random.default_rng(1).standard_normal(20_000))
    found = autoregression(e, 12)
    assert 2 <= found.order <= 5  # Akaike's criterion does not choose too low, and rarely far too high
    np.testing.assert_allclose(found.D[:3], D, atol=0.04)
    assert found.variance == pytest.approx(0.09, rel=0.03)
    assert np.max(np.abs(np.roots(found.D))) < 1


def test_white_noise_needs_no_coefficients_most_of_the_time():
    orders = [autoregression(np.random.default_rng(s).standard_normal(500), 10).order for s in range(40)]
    assert np.mean(np.array(orders) == 0) > 0.5


def test_score_covariance_is_that_of_the_full_noise_matrix():
    # Z' R Z with R the covariance matrix of a long stationary noise, written out
    rng, n = np.random.default_rng(2), 400
    Z = np.zeros((n, 2))
    Z[:300] = rng.standard_normal((300, 2))  # ends before the record does, so that no start or end is cut
    h = lfilter([1.0], D, np.eye(1, 400)[0])
    r = np.array([h[: h.size - k] @ h[k:] for k in range(n)])
    wanted = Z.T @ toeplitz(r) @ Z
    found = score_covariance(np.vstack([np.zeros((200, 2)), Z]), Autoregression(D=D, variance=1.0))
    np.testing.assert_allclose(found, wanted, rtol=1e-9)


def test_spectral_scores_see_slow_noise_under_white_noise():
    # the sum of the noise over the record: an autoregression of order 10 misses its slow part altogether
    n, runs, sums, claimed = 4000, 200, [], []
    Z = np.stack([np.sin(2 * np.pi * 6 * np.arange(n) / n), np.cos(2 * np.pi * 9 * np.arange(n) / n)], axis=1)
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        e = lfilter([0.02], [1, -0.99], rng.standard_normal(n + 2000))[2000:] + rng.standard_normal(n)
        sums.append(Z.T @ e)
        claimed.append(np.diag(score_covariance_of([Z], [e])))
    np.testing.assert_allclose(np.mean(claimed, axis=0), np.var(sums, axis=0), rtol=0.25)


def test_covariance_of_the_noise_model():
    n, runs = 2000, 200
    found = []
    for seed in range(runs):
        e = lfilter([1.0], [1, -0.8], np.random.default_rng(seed).standard_normal(n))
        found.append(autoregression(e, 1).D[1])
    wanted = noise_covariance(Autoregression(D=np.array([1, -0.8]), variance=1.0), n)[1, 1]
    assert wanted == pytest.approx((1 - 0.64) / n, rel=1e-12)
    assert np.var(found) == pytest.approx(wanted, rel=0.3)
