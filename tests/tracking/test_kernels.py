"""Compiled steps of the parameter filter against the dense formulas that they stand for."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.recursive.estimator import covariance_of, factors_of
from ambid.tracking import kernels
from ambid.tracking.evidence import Evidence, EvidenceSum
from ambid.tracking.rpem import ParameterFilter

P = 7


def spd(rng, p=P):
    a = rng.normal(size=(p, 2 * p))
    return a @ a.T / p


def block(rng, p=P):
    return np.triu(rng.normal(size=(p, p))), rng.normal(size=p), rng.normal(size=p)


def evidence(J, r, at):
    names = tuple("abcdefg")
    return Evidence(names=names, at=at, J=J, r=r, rest=1.0, n_samples=9, n_outputs=1, first=0, last=9)


def absorbed(covariance, q, J, r, at, active, noise=1.0, positive=None):
    q, F = q.copy(), factors_of(covariance)
    positive = np.zeros(q.size, dtype=bool) if positive is None else positive
    misfit, part = kernels.absorb(q, F, J, r, at, active, positive, noise, np.empty((q.size + 2, q.size)))
    return q, covariance_of(F), misfit, part


@pytest.mark.parametrize("held", [(), (2,), (0, 3, 4), tuple(range(P - 1))])
@pytest.mark.parametrize("noise", [1.0, 7.0])
def test_absorb_is_josephs_formula_with_schmidts_gain(held, noise):
    rng = np.random.default_rng(len(held))
    covariance, q = spd(rng), rng.normal(size=P)
    J, r, at = block(rng)
    active = ~np.isin(np.arange(P), held)
    found, after, misfit, part = absorbed(covariance, q, J, r, at, active, noise)
    rho = r + J @ (q - at)
    V = noise * np.eye(P) + J @ covariance @ J.T
    K = covariance @ J.T @ np.linalg.inv(V)
    K[~active] = 0.0
    left = np.eye(P) - K @ J
    np.testing.assert_allclose(found, q - K @ rho, rtol=1e-11)
    np.testing.assert_allclose(after, left @ covariance @ left.T + noise * K @ K.T, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(found[~active], q[~active])
    assert misfit == pytest.approx(rho @ np.linalg.solve(V, rho))
    assert part == 1.0


def test_a_positive_number_loses_at_most_half_and_the_covariance_is_that_of_the_shorter_gain():
    rng = np.random.default_rng(3)
    covariance, q = spd(rng), np.ones(P)
    J, r, at = np.eye(P), np.zeros(P), np.ones(P)
    r[2] = 50.0
    positive = np.arange(P) == 2
    found, after, _, part = absorbed(covariance, q, J, r, at, np.ones(P, dtype=bool), 1.0, positive)
    free = absorbed(covariance, q, J, r, at, np.ones(P, dtype=bool))[0]
    assert free[2] < 0.0
    assert found[2] == pytest.approx(0.5)
    np.testing.assert_allclose(found - q, part * (free - q), rtol=1e-12)
    K = part * covariance @ np.linalg.inv(np.eye(P) + covariance)
    left = np.eye(P) - K
    np.testing.assert_allclose(after, left @ covariance @ left.T + K @ K.T, rtol=1e-9)


def test_walk_lets_active_numbers_walk():
    rng = np.random.default_rng(4)
    covariance, rates, active = spd(rng), rng.uniform(size=P), rng.uniform(size=P) > 0.4
    found = ParameterFilter(np.zeros(P), covariance)
    found.active = active
    found.walk(rates, 0.3)
    np.testing.assert_allclose(found.covariance, covariance + np.diag(0.3 * rates * active), rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(found.sd, np.sqrt(np.diag(found.covariance)), rtol=1e-12)


def test_fold_keeps_the_normal_equations():
    rng = np.random.default_rng(6)
    R, rows = np.triu(rng.normal(size=(P, P))), rng.normal(size=(P, 40))
    found = R.copy()
    kernels.fold(found, rows.copy(), 23, 23)
    np.testing.assert_allclose(found.T @ found, R.T @ R + rows[:, :23] @ rows[:, :23].T, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found, np.triu(found), atol=1e-12)


def test_a_sum_of_evidence_moves_blocks_to_one_point():
    rng = np.random.default_rng(7)
    q, other, total, more = rng.normal(size=P), rng.normal(size=P), EvidenceSum(P), 0.0
    total.clear(rng.normal(size=P))
    for _ in range(3):
        J, r, at = block(rng)
        assert total.add(evidence(J, r, at))
        more += np.sum((r + J @ (q - at)) ** 2) - np.sum((r + J @ (other - at)) ** 2)
    for _ in range(2):
        left, right = (np.sum((total.T @ np.append(x - total.at, 1.0)) ** 2) for x in (q, other))
        assert left - right == pytest.approx(more)
        total.move(rng.normal(size=P))
    before = total.T.copy()
    assert not total.add(evidence(J, np.full(P, np.nan), at))
    assert np.array_equal(total.T, before)
    assert total.blocks == 3


def test_far_is_what_it_says():
    rng = np.random.default_rng(8)
    J, q, at = np.triu(rng.normal(size=(P, P))), rng.normal(size=P), rng.normal(size=P)
    covariance, never = spd(rng), np.full(P, np.inf)
    found, length, sd = ParameterFilter(q, covariance), np.sum((J @ (q - at)) ** 2), np.sqrt(np.diag(covariance))
    assert not found.far(at, J, never, 1.01 * length)
    assert found.far(at, J, never, 0.99 * length)
    just = (q - at) ** 2 / sd
    assert not found.far(at, J, 1.01 * just, np.inf)
    assert found.far(at, J, np.where(np.arange(P) == 4, 0.99, 1.01) * just, np.inf)


def likelihood(J, r, at, q, covariance, variance, noise):
    """-2 log-likelihood of blocks r + J (q - at) ~ N(0, noise I), q a random walk, and what is known after the last."""
    total = 0.0
    for one, left, point in zip(J, r, at, strict=True):
        rho, V = left + one @ (q - point), noise * np.eye(q.size) + one @ covariance @ one.T
        K = covariance @ one.T @ np.linalg.inv(V)
        total += rho @ np.linalg.solve(V, rho) + np.linalg.slogdet(V)[1]
        q, known = q - K @ rho, covariance - K @ one @ covariance
        covariance = known + np.diag(variance)
    return total, q, known


@pytest.mark.parametrize("first", [0, 5])
def test_the_walk_score_is_the_slope_of_the_exact_likelihood(first):
    rng = np.random.default_rng(9)
    count, p, noise = 9, 4, 1.3
    J = np.array([np.triu(rng.normal(size=(p, p))) for _ in range(count)])
    r, at = rng.normal(size=(count, p)), rng.normal(size=(count, p))
    q, covariance, variance = rng.normal(size=p), spd(rng, p), rng.uniform(0.05, 0.5, p)
    ring = np.roll(np.arange(count), -first)
    end, known, found = q.copy(), covariance.copy(), np.empty((4, p))
    K, N = np.empty((count, p, p + 2)), np.empty((p, p))
    kernels.filter_ring(J, r, at, count, first, end, known, np.sqrt(variance), noise, K)
    kernels.smooth_ring(J, count, first, K, found, N)
    squares, powers = found[:2]
    slope = np.empty(p)
    for j in range(p):
        h = 1e-5 * np.eye(p)[j]
        up, down = (likelihood(J[ring], r[ring], at[ring], q, covariance, variance + s * h, noise)[0] for s in (1, -1))
        slope[j] = (up - down) / 2e-5
    np.testing.assert_allclose(powers - squares, slope, rtol=1e-6, atol=1e-7)
    _, q_end, covariance_end = likelihood(J[ring], r[ring], at[ring], q, covariance, variance, noise)
    np.testing.assert_allclose(end, q_end, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(known, covariance_end, rtol=1e-8, atol=1e-10)
