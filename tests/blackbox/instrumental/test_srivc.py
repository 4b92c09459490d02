"""Continuous-time transfer functions: the Rao-Garnier benchmark, stiff and fast sampled plants, several inputs."""

import numpy as np
import pytest
from scipy.signal import lfilter, lsim, max_len_seq

from ambid.blackbox.instrumental_continuous import responses, srivc
from ambid.errors import EstimationError
from tests.blackbox.instrumental.records import io_data, monte_carlo, zoh
from tests.tiers import runs

# Rao and Garnier 2002: stiff (2 and 20 rad/s, damping 0.1 and 0.25), non-minimum phase
NUM, DEN = np.array([-6400.0, 1600.0]), np.array([1, 5, 408, 416, 1600.0])
PRBS = np.repeat(2.0 * max_len_seq(10)[0] - 1, 7)  # as published: ten stages, clock 7, 7161 samples of 10 ms


def _output(num, den, dt, u):
    full = np.zeros((1, len(den)))
    full[0, len(den) - len(num) :] = num
    return responses(np.array(den, dtype=float), full, dt, np.reshape(u, (-1, 1))).y


CLEAN = _output(NUM, DEN, 0.01, PRBS)


def _rao_garnier(rng, snr_db=10.0, colour=None):
    e = rng.standard_normal(PRBS.size + 500)
    v = (e if colour is None else lfilter(*colour, e))[500:]
    v *= CLEAN.std() / v.std() * 10 ** (-snr_db / 20)
    return io_data(PRBS, CLEAN + v + 3.0, dt=0.01, open_loop=True)


ORDERS = {"nb": 2, "nf": 4, "nk": 0}
TRUTH, PLACES = np.r_[NUM, DEN[1:]], [0, 1, 3, 4, 5, 6]


def test_simulation_agrees_with_an_independent_one():
    t = 0.01 * np.arange(400)
    u = np.repeat([1.0, -1.0, 0.5, 0.0], 100)
    fine = np.repeat(u, 50)
    _, wanted, _ = lsim((NUM, DEN), np.append(fine, 0.0), 0.0002 * np.arange(fine.size + 1), interp=False)
    np.testing.assert_allclose(_output(NUM, DEN, 0.01, u), wanted[:-1:50], atol=1e-8)
    assert t.size == u.size


def test_rao_garnier_at_10_db():
    n = runs(25, short=8)
    errors, scores = monte_carlo(_rao_garnier, lambda d: srivc(d, ORDERS), TRUTH, PLACES, n)
    # no bias, and 95 % intervals that hold
    assert np.all(np.abs(errors.mean(axis=0)) < 4 * errors.std(axis=0) / np.sqrt(n))
    assert np.mean(np.abs(scores) < 1.96) > n.limit(0.91)
    # the Cramer-Rao bound for white noise: no unbiased method is sharper than 40, 71, 0.059, 1.04, 3.5, 7.5
    bound = np.array([40.2, 70.6, 0.0595, 1.042, 3.467, 7.486])
    assert np.all(errors.std(axis=0) < n.limit(1.4, centre=1) * bound)


def test_rao_garnier_without_noise():
    fit = srivc(_rao_garnier(np.random.default_rng(0), snr_db=300), ORDERS)
    np.testing.assert_allclose(fit.model.theta[PLACES], TRUTH, rtol=1e-6)
    assert fit.status == "converged"
    assert fit.offsets.y[0] - (NUM[-1] / DEN[-1]) * fit.offsets.u[0] == pytest.approx(3.0, abs=1e-6)


def test_intervals_hold_under_coloured_noise():
    def make(rng):
        u = np.repeat(rng.choice([-1.0, 1.0], 200), 6)
        v = lfilter([0.05], np.convolve([1, -0.95], [1, -0.8]), rng.standard_normal(1700))[500:]
        return io_data(u, _output([5.0, 100.0], [1, 4, 100.0], 0.02, u) + v, dt=0.02, open_loop=True)

    orders, truth, places = {"nb": 2, "nf": 2, "nk": 0}, np.array([5, 100, 4, 100.0]), [0, 1, 3, 4]
    n = runs(25, short=8)
    _, scores = monte_carlo(make, lambda d: srivc(d, orders), truth, places, n)
    assert np.mean(np.abs(scores) < 1.96) > n.limit(0.9)


@pytest.mark.parametrize("rate", [50.0, 1e3, 5e3])
def test_fast_sampling_does_no_harm(rate):
    # resonance at 30 rad/s, 12 s of record: 1000 samples a period at the fastest
    n, rng = int(12 * rate), np.random.default_rng(3)
    u = np.repeat(rng.choice([-1.0, 1.0], 120), n // 120)
    y = _output([900.0], [1, 6, 900.0], 1 / rate, u)
    fit = srivc(io_data(u, y + 0.1 * rng.standard_normal(n), dt=1 / rate, open_loop=True), {"nb": 1, "nf": 2, "nk": 0})
    np.testing.assert_array_less(np.abs(fit.model.theta - [900, 1, 6, 900]), 4 * fit.sd + 1e-12)
    assert np.all(fit.sd < [20, 1e-9, 0.6, 20])


def test_units_do_not_matter():
    d = _rao_garnier(np.random.default_rng(5))
    one = srivc(d, ORDERS)
    other = srivc(io_data(1e3 * d.u, 1e-6 * d.y, dt=1e-7, open_loop=True), ORDERS)  # time in 1e-5 of the unit as well
    power = 1e5 ** np.r_[3, 4, np.arange(5)]
    gain = np.r_[1e-9, 1e-9, np.ones(5)]
    np.testing.assert_allclose(other.model.theta, one.model.theta * power * gain, rtol=1e-5)
    np.testing.assert_allclose(other.sd, one.sd * power * gain, rtol=1e-4)


def test_initial_states_and_slow_free_responses_are_not_taken_for_the_plant():
    A, B = zoh(np.array([[0, 1.0], [-4.0, -0.2]]), np.array([[0], [4.0]]), 0.05)
    x, y, rng = np.array([5.0, -3.0]), [], np.random.default_rng(1)
    u = np.repeat(rng.choice([-1.0, 1.0], 60), 10)
    for k in range(u.size):
        y.append(x[0])
        x = A @ x + B[:, 0] * u[k]
    fit = srivc(io_data(u, np.array(y), dt=0.05, open_loop=True), {"nb": 1, "nf": 2, "nk": 0})
    np.testing.assert_allclose(fit.model.theta, [4, 1, 0.2, 4], rtol=1e-6)


def _two_inputs(rng, noise=0.02):
    n, dt, den = 3000, 0.02, [1, 3, 25.0]
    u = np.stack([np.repeat(rng.choice([-1.0, 1.0], n // 10), 10) for _ in range(2)], axis=1)
    y = _output([25.0], den, dt, u[:, 0]) + _output([-2.0], den, dt, np.r_[np.zeros(3), u[:-3, 1]])
    return io_data(u, y + noise * rng.standard_normal(n) + 1, dt=dt, open_loop=True)


def test_every_input_has_its_own_delay():
    fit = srivc(_two_inputs(np.random.default_rng(2)), {"nb": 1, "nf": 2, "nk": (0, 3)})
    truth = np.array([25, 1, 3, 25, -2, 1, 3, 25])
    np.testing.assert_array_less(np.abs(fit.model.theta - truth), 4 * fit.sd + 1e-12)
    assert np.all(fit.sd < 0.02 * np.abs(truth) + 1e-12)
    assert fit.status == "converged"
    assert fit.model.delay == pytest.approx((0.0, 0.06))


def test_a_common_denominator_carries_the_same_uncertainty_for_every_input():
    rng, dt = np.random.default_rng(7), 0.02
    u = np.stack([np.repeat(rng.choice([-1.0, 1.0], 200), 10) for _ in range(2)], axis=1)
    den = [1, 3, 25.0]
    y = _output([25.0], den, dt, u[:, 0]) + _output([2.0, -5.0], den, dt, u[:, 1]) + 0.05 * rng.standard_normal(2000)
    fit = srivc(io_data(u, y, dt=dt, open_loop=True), {"nb": (1, 2), "nf": 2, "nk": 0})
    truth = np.r_[25, den, 2, -5, den]
    np.testing.assert_array_less(np.abs(fit.model.theta - truth), 4 * fit.sd + 1e-12)
    np.testing.assert_allclose(fit.sd[1:4], fit.sd[6:9])
    correlation = fit.covariance[2, 7] / fit.sd[2] / fit.sd[7]
    assert correlation == pytest.approx(1)


def test_the_delay_is_found_where_it_is_not_given():
    rng, dt = np.random.default_rng(9), 0.02
    u = rng.choice([-1.0, 1.0], 1500)
    y = _output([25.0], [1, 3, 25.0], dt, np.r_[np.zeros(4), u[:-4]]) + 0.02 * rng.standard_normal(1500)
    fit = srivc(io_data(u, y, dt=dt, open_loop=True), {"nb": 1, "nf": 2})
    assert fit.orders["nk"] == (4,)
    assert fit.model.delay == pytest.approx((0.08,))


def test_feedthrough_is_a_numerator_of_full_degree():
    rng, dt = np.random.default_rng(9), 0.02
    u = rng.choice([-1.0, 1.0], 1500)
    y = _output([0.5, 3.0], [1, 2.0], dt, u) + 0.01 * rng.standard_normal(1500)
    fit = srivc(io_data(u, y, dt=dt, open_loop=True), {"nb": 2, "nf": 1, "nk": 0})
    np.testing.assert_array_less(np.abs(fit.model.theta - [0.5, 3, 1, 2]), 4 * fit.sd + 1e-12)


def test_refusals():
    d = _two_inputs(np.random.default_rng(2))
    with pytest.raises(EstimationError, match="nb"):
        srivc(d, {"nb": 4, "nf": 2, "nk": 0})
    with pytest.raises(EstimationError, match="no input"):
        srivc(io_data(np.empty((d.n_samples, 0)), d.y), {"nb": 1, "nf": 2})
    assert any("feedback" in w for w in srivc(io_data(d.u, d.y, dt=0.02), {"nb": 1, "nf": 2, "nk": 0}).warnings)
