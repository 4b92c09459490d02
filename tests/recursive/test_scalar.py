"""Streaming scalar filters: the off-line ones sample by sample, and variances that are the errors' own."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ambid.errors import EstimationError
from ambid.recursive.streaming import PassiveLowpass, ScalarKalman
from ambid.signals.scalar_filter import kalman_bucy, kalman_bucy_gain, passive_lowpass

RATE = 1000.0


def walk(seed, n, *, a=0.0, c=1.0, q=60.0, r=1.0, channels=1):
    """State and samples of x' = a x + noise of intensity q, y = c x + noise of intensity r."""
    rng = np.random.default_rng(seed)
    rho = np.exp(a / RATE)
    step = np.sqrt(q * (np.expm1(2 * a / RATE) / (2 * a) if a else 1 / RATE))
    x = np.zeros((n, channels))
    w = step * rng.standard_normal((n, channels))
    for k in range(1, n):
        x[k] = rho * x[k - 1] + w[k]
    return x, c * x + np.sqrt(r * RATE) * rng.standard_normal((n, channels))


@pytest.mark.parametrize("numbers", [{}, {"a": -3.0, "c": 2.0, "w": 0.5}, {"a": 2.0, "q": 5.0}])
def test_the_continuous_form_is_the_off_line_filter(numbers):
    y = walk(0, 2000)[1][:, 0]
    found = ScalarKalman(RATE, **numbers).update(y)
    np.testing.assert_allclose(found, kalman_bucy(y, RATE, **numbers), rtol=1e-10, atol=1e-10)


def test_the_passive_form_is_the_off_line_filter():
    y = walk(0, 2000)[1][:, 0]
    found = PassiveLowpass(RATE, corner_hz=3.0).update(y)
    np.testing.assert_allclose(found, passive_lowpass(y, RATE, corner_hz=3.0), rtol=1e-10, atol=1e-10)


FORMS = [
    lambda m: ScalarKalman(RATE, channels=m),
    lambda m: ScalarKalman(RATE, start_variance=3.0, channels=m),
    lambda m: ScalarKalman(RATE, form="discrete", channels=m),
    lambda m: ScalarKalman(RATE, form="discrete", start_variance=3.0, give="predicted", channels=m),
    lambda m: PassiveLowpass(RATE, corner_hz=5.0, channels=m),
]


@pytest.mark.parametrize("make", FORMS)
def test_splitting_a_stream_changes_no_number(make):
    y = walk(1, 600, channels=3)[1]
    y[:2, 1] = np.nan
    y[100:130] = np.nan
    y[300, 2] = np.inf
    whole = make(3)
    blocks, singles, alone = whole.copy(), whole.copy(), make(1)
    wanted = whole.update(y)
    np.testing.assert_array_equal(np.vstack([blocks.update(y[a:b]) for a, b in ((0, 1), (1, 117), (117, 600))]), wanted)
    np.testing.assert_array_equal([singles.update(row) for row in y], wanted)
    np.testing.assert_array_equal([alone.update(float(v)) for v in y[:, 1]], wanted[:, 1])
    assert singles.n_missing == whole.n_missing == 2 + 90 + 1
    assert singles.n_samples == 600
    assert np.isfinite(wanted[130:]).all()


def test_input_is_left_alone_and_may_be_read_only():
    y = walk(1, 50)[1]
    y.flags.writeable = False
    assert np.array_equal(ScalarKalman(RATE).update(y), ScalarKalman(RATE).update(y.copy()))
    assert ScalarKalman(RATE).update(list(y[:, 0])).shape == (50,)


@pytest.mark.parametrize("a", [0.0, -4.0, 3.0])
def test_variance_follows_the_riccati_equation(a):
    c, w, q, r, S0 = 2.0, 0.7, 60.0, 1.5, 9.0
    found = ScalarKalman(RATE, a=a, c=c, w=w, q=q, r=r, start_variance=S0)
    found.update(np.ones(137))
    wanted = solve_ivp(
        lambda _, S: 2 * a * S - (S * c) ** 2 / r + w * w * q, (0, 0.137), [S0], rtol=1e-11, atol=1e-12
    ).y[0, -1]
    assert found.variance[0] == pytest.approx(wanted, rel=1e-8)


@pytest.mark.parametrize("a", [0.0, -4.0, 3.0])
def test_estimate_of_the_varying_form_solves_the_filter_equation(a):
    y = np.array([1.0, -2.0, 3.0])
    found = ScalarKalman(2.0, a=a, start_variance=5.0, start=0.3)
    found.update(y)

    def both(t, z):
        return [a * z[0] + z[1] * (y[min(int(2 * t), 2)] - z[0]), 2 * a * z[1] - z[1] ** 2 + 60.0]

    z = [0.3, 5.0]
    for k in range(3):
        z = solve_ivp(both, (k / 2 + 1e-12, k / 2 + 0.5 - 1e-12), z, rtol=1e-11, atol=1e-12).y[:, -1]
    assert found.state[0] == pytest.approx(z[0], rel=1e-7)


@pytest.mark.parametrize("form", ["continuous", "discrete"])
@pytest.mark.parametrize("a", [0.0, -4.0, 1.0])
def test_the_varying_filter_becomes_the_stationary_one(form, a):
    y = walk(2, 6000)[1][:, 0]
    varying, steady = ScalarKalman(RATE, a=a, form=form, start_variance=1.0), ScalarKalman(RATE, a=a, form=form)
    gap = np.abs(varying.update(y) - steady.update(y))
    assert gap[0] == 0 or form == "discrete"
    assert gap[-1] < 1e-10
    np.testing.assert_allclose(varying.variance, steady.variance, rtol=1e-10)


def test_sampling_fast_makes_the_discrete_form_the_continuous_one():
    for rate, near in ((1e3, 1e-2), (1e6, 1e-5)):
        assert ScalarKalman(rate, form="discrete").gain * rate == pytest.approx(kalman_bucy_gain(), rel=near)


@pytest.mark.parametrize(("a", "c"), [(0.0, 1.0), (-5.0, 0.5)])
def test_variance_is_that_of_the_error_before_and_after_convergence(a, c):
    runs = 4000
    x, y = walk(3, 400, a=a, c=c, channels=runs)
    start = 2.0 * np.random.default_rng(4).standard_normal(runs)
    # every channel has its own start error of variance 4
    kalman = ScalarKalman(RATE, a=a, c=c, form="discrete", start_variance=4.0, start=0.0, channels=runs)
    x = x + start * np.exp(a * np.arange(400) / RATE)[:, None]
    y = y + c * start * np.exp(a * np.arange(400) / RATE)[:, None]
    done = 0
    for n in (5, 60, 399):
        kalman.update(y[done:n])
        done = n
        spread = np.mean((x[n] - kalman.state) ** 2)
        assert spread / kalman.variance[0] == pytest.approx(1.0, abs=4 * np.sqrt(2 / runs))


def test_variance_is_that_of_the_error_where_samples_are_missing():
    runs = 4000
    x, y = walk(5, 600, channels=runs)
    y[np.random.default_rng(6).random(600) < 0.7] = np.nan
    y[480:] = np.nan
    kalman = ScalarKalman(RATE, form="discrete", channels=runs, start=0.0, start_variance=0.0)
    kalman.update(y[:599])
    assert kalman.variance[0] > 1.5 * ScalarKalman(RATE, form="discrete").variance[0]
    assert np.mean((x[599] - kalman.state) ** 2) / kalman.variance[0] == pytest.approx(1, abs=4 * np.sqrt(2 / runs))


def test_kalman_bucy_beside_passive_filters_at_equal_noise():
    # Error variances of thesis figs 5.10-5.12's comparison: Q = 60, R = 1. A low-pass of corner w rad/s leaves
    # (Q + w^2 R)/(2 w); least at w = L = sqrt(60), where it is S = 7.746: the
    # Kalman-Bucy filter is the low-pass that fits the noise.
    x, y = walk(7, 100_000, channels=8)
    variance = {"kalman": np.mean((ScalarKalman(RATE, channels=8).update(y) - x)[2000:] ** 2)}
    for corner in (0.3, 1.0, 5.0, 20.0):
        found = PassiveLowpass(RATE, corner_hz=corner, channels=8).update(y)
        variance[corner] = np.mean((found - x)[2000:] ** 2)
        omega = 2 * np.pi * corner
        assert variance[corner] == pytest.approx((60 + omega**2) / (2 * omega), rel=0.08)
    assert variance["kalman"] == pytest.approx(np.sqrt(60), rel=0.05)
    assert variance["kalman"] == min(variance.values())
    assert variance[20.0] > 8 * variance["kalman"]
    discrete = ScalarKalman(RATE, form="discrete", channels=8).update(y)
    assert np.mean((discrete - x)[2000:] ** 2) < variance["kalman"]


def test_no_process_noise_is_averaging():
    y = walk(8, 500)[1][:, 0]
    found = ScalarKalman(RATE, q=0.0, start_variance=1e12, start=0.0, form="discrete")
    found.update(y)
    assert found.state[0] == pytest.approx(y.mean(), rel=1e-6)
    assert found.variance[0] == pytest.approx(RATE / 500, rel=1e-6)
    flat = ScalarKalman(RATE, q=0.0, start_variance=1e3)
    flat.update(y)
    assert flat.variance[0] == pytest.approx(1 / (1e-3 + 0.5), rel=1e-9)


def test_refusals():
    with pytest.raises(EstimationError, match="rate"):
        ScalarKalman(0.0)
    with pytest.raises(EstimationError, match="stationary"):
        ScalarKalman(RATE, q=0.0, form="discrete")
    with pytest.raises(EstimationError, match="form"):
        ScalarKalman(RATE, form="other")
    with pytest.raises(EstimationError, match="start_variance"):
        ScalarKalman(RATE, start_variance=-1.0)
    with pytest.raises(EstimationError, match="one sample"):
        ScalarKalman(1.0, q=1e9, start_variance=1.0)
    with pytest.raises(EstimationError, match="channels"):
        ScalarKalman(RATE, channels=0)
    with pytest.raises(EstimationError, match="corner"):
        PassiveLowpass(RATE, corner_hz=0.0)
    with pytest.raises(EstimationError, match=r"shape \(4,\)"):
        ScalarKalman(RATE, channels=3).update(np.ones(4))
