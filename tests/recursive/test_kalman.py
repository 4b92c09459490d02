"""The discrete Kalman filter against a textbook one, its covariance against the errors, and a long run."""

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.recursive.kalman import KalmanFilter, constant_velocity, linear_state

TRACK = constant_velocity(1000.0, q=50.0, r=1e-4)
LEVEL = linear_state([[0.99]], [[2.0]], [[0.06]], [[1e3]])  # the thesis's scalar filter, sampled


def textbook(model, y, u=None, *, P, x):
    """Covariance form, missing outputs left out; filtered states and the last predicted covariance."""
    out = []
    for k, row in enumerate(y):
        seen = np.isfinite(row)
        if seen.any():
            C = model.C[seen]
            K = P @ C.T @ np.linalg.inv(C @ P @ C.T + model.R[np.ix_(seen, seen)])
            x = x + K @ (row[seen] - C @ x)
            P = P - K @ C @ P
        out.append(x)
        x = model.A @ x + (0 if u is None else model.B @ u[k])
        P = model.A @ P @ model.A.T + model.Q
    return np.array(out), P


def some_model(seed=0, *, inputs=1):
    rng = np.random.default_rng(seed)
    G, L = rng.standard_normal((4, 4)), rng.standard_normal((3, 3))
    A = 0.9 * np.eye(4) + 0.05 * rng.standard_normal((4, 4))
    B = rng.standard_normal((4, inputs)) if inputs else None
    return linear_state(A, rng.standard_normal((3, 4)), G @ G.T, L @ L.T + np.eye(3), B=B), rng


@pytest.mark.parametrize("model", [TRACK, LEVEL])
@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_one_and_two_states_like_the_textbook(model, missing):
    rng = np.random.default_rng(0)
    y = np.cumsum(np.cumsum(rng.standard_normal((1500, 1)), axis=0), axis=0) * 1e-3
    y[rng.random(1500) < missing] = np.nan
    n = model.A.shape[0]
    wanted, P = textbook(model, y, P=np.eye(n), x=np.zeros(n))
    found = KalmanFilter(model, start_covariance=np.eye(n))
    np.testing.assert_allclose(found.update(y), wanted, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found.covariance, P, rtol=1e-9, atol=1e-18)
    assert found.n_missing == np.isnan(y).sum()


@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_several_outputs_with_noise_in_common_like_the_textbook(missing):
    model, rng = some_model()
    y, u = rng.standard_normal((400, 3)), rng.standard_normal((400, 1))
    y[rng.random(y.shape) < missing] = np.nan
    wanted, P = textbook(model, y, u, P=np.eye(4), x=np.ones(4))
    found = KalmanFilter(model, start=np.ones(4), start_covariance=np.eye(4))
    np.testing.assert_allclose(found.update(y, u), wanted, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(found.covariance, P, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("model", [TRACK, LEVEL])
@pytest.mark.parametrize("varying", [False, True])
def test_splitting_a_stream_changes_no_number(model, varying):
    y = np.random.default_rng(1).standard_normal(800)
    y[[0, 50, 51, 400]] = np.nan
    y[600] = np.inf
    whole = KalmanFilter(model, start_covariance=np.eye(model.A.shape[0]) if varying else None)
    parts, singles = whole.copy(), whole.copy()
    wanted = whole.update(y)
    np.testing.assert_array_equal(np.vstack([parts.update(y[a:b]) for a, b in ((0, 51), (51, 52), (52, 800))]), wanted)
    np.testing.assert_array_equal([singles.update(float(v)) for v in y], wanted)
    np.testing.assert_array_equal(singles.covariance, whole.covariance)
    assert singles.n_missing == 5


def test_splitting_several_outputs_changes_no_number():
    model, rng = some_model(3)
    y, u = rng.standard_normal((300, 3)), rng.standard_normal((300, 1))
    y[rng.random(y.shape) < 0.1] = np.nan
    whole = KalmanFilter(model)
    singles = whole.copy()
    np.testing.assert_array_equal([singles.update(y[k], u[k]) for k in range(300)], whole.update(y, u))


@pytest.mark.parametrize("model", [LEVEL, TRACK, some_model(inputs=0)[0]])
def test_the_varying_gain_becomes_the_stationary_one(model):
    y = np.random.default_rng(2).standard_normal((3000, model.C.shape[0]))
    steady = KalmanFilter(model)
    varying = KalmanFilter(model, start_covariance=np.eye(model.A.shape[0]))
    gap = np.abs(steady.update(y) - varying.update(y))
    assert gap[0].max() > 1e-6
    assert gap[-1].max() < 1e-9
    np.testing.assert_allclose(varying.covariance, steady.covariance, rtol=1e-9)


def test_covariance_is_that_of_the_errors():
    runs, n, rng = 1500, 40, np.random.default_rng(5)
    model, _ = some_model(inputs=0)
    LQ, LR = np.linalg.cholesky(model.Q), np.linalg.cholesky(model.R)
    gaps = rng.random((n, 3)) < 0.3
    errors = np.empty((runs, 4))
    for run in range(runs):
        x = rng.standard_normal(4)
        y = np.empty((n, 3))
        for k in range(n):
            y[k] = model.C @ x + LR @ rng.standard_normal(3)
            x = model.A @ x + LQ @ rng.standard_normal(4)
        y[:-1][gaps[:-1]] = np.nan
        kalman = KalmanFilter(model, start_covariance=np.eye(4))
        kalman.update(y)
        errors[run] = kalman.state - x
    whitened = np.linalg.solve(np.linalg.cholesky(kalman.covariance), errors.T)
    np.testing.assert_allclose(whitened @ whitened.T / runs, np.eye(4), atol=4.5 * np.sqrt(2 / runs))


def test_noise_of_constant_velocity_is_discretised_exactly():
    # two samples of half the period add up to one
    T, half = constant_velocity(10.0, q=3.0, r=1.0), constant_velocity(20.0, q=3.0, r=1.0)
    np.testing.assert_allclose(half.A @ half.A, T.A, rtol=1e-14)
    np.testing.assert_allclose(half.A @ half.Q @ half.A.T + half.Q, T.Q, rtol=1e-14)


@pytest.mark.parametrize(("q", "r"), [(50.0, 1e-4), (1e-6, 1e-14)])
def test_ten_million_samples_leave_the_covariance_positive_definite(q, r):
    model = constant_velocity(20_000.0, q=q, r=r)
    kalman = KalmanFilter(model, start_covariance=1e6 * np.eye(2))
    rng, block = np.random.default_rng(6), np.zeros(100_000)
    for _ in range(100):
        block[:] = np.sqrt(r) * rng.standard_normal(block.size)
        block[rng.integers(0, block.size, 500)] = np.nan
        states = kalman.update(block)
    assert kalman.n_samples == 10_000_000
    P, steady = kalman.covariance, KalmanFilter(model).covariance
    np.testing.assert_array_equal(P, P.T)
    assert np.linalg.eigvalsh(P / np.sqrt(np.outer(np.diag(P), np.diag(P)))).min() > 1e-3
    assert (np.diag(P) >= np.diag(steady) * (1 - 1e-9)).all()
    assert (np.diag(P) < 2 * np.diag(steady)).all()
    assert np.abs(states[:, 0]).max() < 7 * np.sqrt(steady[0, 0])


def test_velocity_is_followed_from_noisy_positions():
    rng, n = np.random.default_rng(8), 20_000
    t = np.arange(n) / 1000.0
    truth = 0.2 * np.sin(2 * np.pi * t)
    found = KalmanFilter(TRACK).update(truth + 1e-2 * rng.standard_normal(n))
    velocity = 0.2 * 2 * np.pi * np.cos(2 * np.pi * t)
    raw = np.diff(truth + 1e-2 * rng.standard_normal(n)) * 1000
    assert np.std((found[:, 1] - velocity)[1000:]) < np.std(raw - velocity[1:]) / 30


def test_refusals():
    with pytest.raises(EstimationError, match="A has shape"):
        linear_state(np.ones((2, 3)), np.ones((1, 2)), np.eye(2), np.eye(1))
    with pytest.raises(EstimationError, match="R must be"):
        linear_state(np.eye(2), np.ones((1, 2)), np.eye(2), [[0.0]])
    with pytest.raises(EstimationError, match="Q must be"):
        linear_state(np.eye(2), np.ones((1, 2)), -np.eye(2), [[1.0]])
    with pytest.raises(EstimationError, match="stationary"):
        KalmanFilter(linear_state(2 * np.eye(2), [[1.0, 0.0]], np.eye(2), [[1.0]]))
    with pytest.raises(EstimationError, match="start_covariance"):
        KalmanFilter(TRACK, start_covariance=np.zeros((2, 2)))
    with pytest.raises(EstimationError, match="inputs"):
        KalmanFilter(some_model()[0]).update(np.ones(3))
    with pytest.raises(EstimationError, match="positive"):
        constant_velocity(1000.0, q=0.0, r=1.0)
    with pytest.raises(EstimationError, match="shape"):
        KalmanFilter(TRACK).update(np.ones((3, 2)))
