"""From noise levels to the predictor: Riccati equation, gain, and its exact derivatives."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from ambid.estimation.predictor import gain_derivatives, predictor_gain, predictor_gains, solve_lyapunov, stable
from tests.bearing.benches import problem_of, run
from tests.estimation.reference import STEP, riccati, sampled

BENCHES = ["thesis", "bearing", "coil", "sprung rotor", "falling rotor"]


def system(name, level=1.0):
    bench = run(name, 200, 0)
    problem, _ = problem_of(bench)
    a, _, _, e, c = sampled(problem, dict(bench.truth), 0.0)
    q = level**2 * (e * (bench.disturbance / problem.scales.disturbance) ** 2) @ e.T
    return a, c, q, np.diag((bench.sensor / problem.scales.output) ** 2)


@pytest.mark.parametrize("level", [1e-3, 1.0, 30.0])
@pytest.mark.parametrize("name", BENCHES)
def test_riccati_equation_is_solved(name, level):
    a, c, q, r = system(name, level)
    got = predictor_gain(a, c, q, r)
    s = c @ got.P @ c.T + r
    left = a @ got.P @ a.T - a @ got.P @ c.T @ np.linalg.solve(s, c @ got.P @ a.T) + q
    size = np.abs(np.diag(got.P)) ** 0.5
    assert np.max(np.abs(left - got.P) / np.outer(size, size)) < 1e-10
    np.testing.assert_allclose(got.S, s, rtol=1e-13)
    np.testing.assert_allclose(got.K, a @ got.P @ c.T @ np.linalg.inv(s), rtol=1e-10, atol=1e-14)
    assert stable(a - got.K @ c)
    assert np.linalg.eigvalsh(got.P).min() > -1e-12 * np.linalg.eigvalsh(got.P).max()


@pytest.mark.parametrize("name", BENCHES)
def test_gain_equals_scipy(name):
    a, c, q, r = system(name)
    p = solve_discrete_are(a.T, c.T, q, r)
    gain = np.linalg.solve(c @ p @ c.T + r, c @ p @ a.T).T
    got = predictor_gain(a, c, q, r).K
    np.testing.assert_allclose(got, gain, rtol=1e-6, atol=1e-8 * np.abs(gain).max())


@pytest.mark.parametrize("name", BENCHES)
def test_a_start_nearby_changes_nothing(name):
    a, c, q, r = system(name)
    alone, near = predictor_gain(a, c, q, r), predictor_gain(a, c, 3 * q, r).K
    warm = predictor_gain(a, c, q, r, near=near)
    np.testing.assert_allclose(warm.K, alone.K, rtol=1e-9, atol=1e-12 * np.abs(alone.K).max())
    # a start that does not stabilise is not used
    wild = predictor_gain(a, c, q, r, near=1e3 * np.ones_like(near))
    np.testing.assert_allclose(wild.K, alone.K, rtol=1e-9, atol=1e-12 * np.abs(alone.K).max())


@pytest.mark.parametrize("name", BENCHES)
def test_gain_derivatives_equal_a_complex_newton(name):
    a, c, q, r = system(name)
    n, n_y = a.shape[0], c.shape[0]
    rng = np.random.default_rng(5)
    d_a = 1e-3 * rng.standard_normal((4, n, n)) * np.abs(a).max()
    half = rng.standard_normal((4, n, n)) * np.abs(q).max()
    d_q = half + np.swapaxes(half, 1, 2)
    d_r = np.array([np.diag(v) for v in rng.standard_normal((4, n_y))])
    at = predictor_gain(a, c, q, r)
    got = gain_derivatives(a, c, at, d_a, d_q, d_r)
    for j in range(4):
        moved, *_ = riccati(a + 1j * STEP * d_a[j], c + 0j, q + 1j * STEP * d_q[j], r + 1j * STEP * d_r[j])
        wanted = np.imag(moved) / STEP
        np.testing.assert_allclose(got[j], wanted, rtol=1e-8, atol=1e-8 * np.abs(wanted).max())


def test_lyapunov_equals_scipy_and_stacks():
    rng = np.random.default_rng(1)
    f = rng.standard_normal((4, 4))
    f *= 0.97 / np.abs(np.linalg.eigvals(f)).max()
    q = rng.standard_normal((3, 4, 4))
    q = q + np.swapaxes(q, 1, 2)
    got = solve_lyapunov(f, q)
    for j in range(3):
        np.testing.assert_allclose(got[j], solve_discrete_lyapunov(f, q[j]), rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(solve_lyapunov(f, q[j]), got[j], rtol=1e-12)


def test_scalar_random_walk_has_the_golden_gain():
    # x+ = x + w, y = x + e with equal variances: P = (1 + sqrt 5)/2 by hand
    one = np.ones((1, 1))
    got = predictor_gain(one, one, one, one)
    golden = (1 + np.sqrt(5)) / 2
    assert got.P[0, 0] == pytest.approx(golden, rel=1e-14)
    assert got.K[0, 0] == pytest.approx(golden / (1 + golden), rel=1e-14)


def test_an_unseen_unstable_state_has_no_gain():
    a, c = np.diag([1.2, 0.5]), np.array([[0.0, 1.0]])
    with pytest.raises(np.linalg.LinAlgError):
        predictor_gain(a, c, np.eye(2), np.eye(1))


def test_a_gain_that_is_far_off_does_not_settle_and_warns_of_nothing():
    from ambid.estimation.predictor import _newton

    A, C, one = np.array([[0.5, 0.1], [0.0, 0.4]]), np.array([[0.0, 0.0]]), np.eye(2)
    assert _newton(A, C, one, np.eye(1), np.full((2, 1), 1e200)) is None  # its covariance is no number
    assert _newton(A, C, one, np.eye(1), np.zeros((2, 1))) is not None


def test_a_start_whose_pole_runs_away_leaves_the_others_their_gains():
    """Its rough covariance is 1e274: products of it overflow."""
    away = [[1.49e129, -3.104e134, -1.83e135], [9.69e132, -2.0197e138, -1.19e139], [-1.568e135, 3.266e140, 1.926e141]]
    a = np.array([away, np.diag([0.9, 0.8, 0.7])])
    c, q, r = np.eye(3)[[0, 2]], np.array([np.zeros((3, 3)), 0.01 * np.eye(3)]), np.array([np.eye(2)] * 2)
    gains, led = predictor_gains(a, c, q, r)
    assert led.tolist() == [False, True]
    np.testing.assert_allclose(gains[1], predictor_gain(a[1], c, q[1], r[1]).K, rtol=1e-9)
