"""Four-step instrumental variables: unbiased where least squares is not, with standard deviations that hold."""

import numpy as np
import pytest
from scipy.signal import lfilter

from ambid.blackbox.instrumental import Signals, iv4, least_squares
from ambid.blackbox.model import response_covariance
from ambid.blackbox.polynomial_predictor import arx_layout
from ambid.errors import EstimationError
from tests.blackbox.instrumental.records import io_data, monte_carlo, second_order
from tests.blackbox.systems import noise_response
from tests.tiers import runs

A, B = np.array([1, -1.5, 0.7]), np.array([0, 1.0, 0.5])
ORDERS = {"na": 2, "nb": 2, "nk": 1}
TRUTH, PLACES = np.array([-1.5, 0.7, 1.0, 0.5]), [1, 2, 4, 5]


def _record(rng, n=1000, scale=1.0, noise=0.5):
    u, e = rng.standard_normal((2, n + 200))
    v = noise * lfilter([1, 0.9, 0.3], np.convolve(A, [1, -0.8]), e)
    y = lfilter(B, A, u) + v
    return io_data(u[200:] + 3, scale * (y[200:] + 7), open_loop=True)


def test_consistent_under_coloured_noise_where_least_squares_is_not():
    n = runs(100, short=30)
    errors, scores = monte_carlo(_record, lambda d: iv4(d, ORDERS), TRUTH, PLACES, n)
    assert np.all(np.abs(errors.mean(axis=0)) < 4 * errors.std(axis=0) / np.sqrt(n))
    assert np.all(np.mean(np.abs(scores) < 1.96, axis=0) > n.limit(0.87))
    assert np.all((scores.std(axis=0) > n.limit(0.8, centre=1)) & (scores.std(axis=0) < n.limit(1.25, centre=1)))

    def plain(seed):
        d = _record(np.random.default_rng(seed))
        s = Signals(y=d.y[:, 0] - d.y.mean(), u=d.u - d.u.mean())
        return least_squares("arx", s, arx_layout(2, (2,), (1,)))[:4] - TRUTH

    biased = np.mean([plain(s) for s in range(20)], axis=0)
    assert np.max(np.abs(biased) / errors.std(axis=0)) > 2


@pytest.mark.parametrize(("damping", "n", "noise"), [(4.0, 1000, 0.7), (0.04, 2000, 0.1)])
def test_fast_sampling_and_light_damping(damping, n, noise):
    # 63 samples a period: four steps from least squares missed the response by 6 and by 435 standard deviations
    transition, drive = second_order(100.0, damping, 200.0, 0.01)
    a = np.poly(transition)
    b = np.convolve([drive[0, 0], (transition @ drive)[0, 0]], a)[:2]
    z = np.exp(-0.01j * np.array([1.0, 6.0, 10.0, 20.0]))
    truth = z * np.polyval(b[::-1], z) / np.polyval(a[::-1], z)
    scores, relative = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.choice([-1.0, 1.0], n // 3 + 1), 3)[:n] + 0.3 * rng.standard_normal(n)
        y = lfilter(np.r_[0.0, b], a, u)
        fit = iv4(io_data(u, y + noise * y.std() * rng.standard_normal(n), dt=0.01, open_loop=True), ORDERS)
        omega = np.array([1.0, 6.0, 10.0, 20.0])
        error = fit.model.frequency_response(omega)[:, 0, 0] - truth
        spread = response_covariance(fit.model, fit.covariance, omega)[:, 0, 0]
        scores.append(np.stack([error.real, error.imag]) / np.sqrt(np.diagonal(spread, axis1=1, axis2=2).T))
        relative.append(np.median(np.abs(error / truth)))
    assert np.sqrt(np.mean(np.square(scores))) < 1.3
    assert np.median(relative) < 0.12


def test_offsets_noise_model_and_poles():
    fit = iv4(_record(np.random.default_rng(1), n=20_000), ORDERS)
    gain = B.sum() / A.sum()
    # the operating point is a line: output offset follows the input's
    assert fit.offsets.y[0] - gain * (fit.offsets.u[0] - 3) == pytest.approx(7, abs=0.3)
    np.testing.assert_allclose(np.sort_complex(fit.model.poles()), np.sort_complex(np.roots(A)), atol=0.01)
    # the noise model is that of the equation: H = C/(A D) = 1/(A D')
    omega = np.array([0.1, 0.5, 1.5])
    z = np.exp(-1j * omega)
    H = np.polyval([0.3, 0.9, 1], z) / (np.polyval(A[::-1], z) * (1 - 0.8 * z))
    np.testing.assert_allclose(np.abs(noise_response(fit.model, omega)[:, 0, 0]), np.abs(H), rtol=0.1)
    assert fit.noise_covariance[0, 0] == pytest.approx(0.25, rel=0.05)


def test_two_inputs_and_two_outputs():
    rng, n = np.random.default_rng(4), 5000
    u = rng.standard_normal((n, 2))
    v = lfilter([1.0], [1, -0.9], rng.standard_normal((n, 2)), axis=0) * 0.1
    y0 = lfilter([0, 1, 0.5], A, u[:, 0]) + lfilter([0, 0, -0.7], A, u[:, 1]) + v[:, 0]
    y1 = lfilter([0, 0.3, 0], A, u[:, 0]) + lfilter([0, 0, 2.0], A, u[:, 1]) + v[:, 1]
    fit = iv4(io_data(u, np.stack([y0, y1], axis=1), open_loop=True), {"na": 2, "nb": (2, 1), "nk": (1, 2)})
    names = list(fit.model.names)
    for name, value in {
        "y0:b1.0": 1.0, "y0:b2.0": 0.5, "y0:b2.1": -0.7, "y1:b1.0": 0.3, "y1:b2.0": 0.0, "y1:b2.1": 2.0, "y1:a1": -1.5,
    }.items():  # fmt: skip
        k = names.index(name)
        assert abs(fit.model.theta[k] - value) < 4 * fit.sd[k], name
    assert fit.sd[names.index("y0:b0.0")] == 0  # a delay is not estimated


def test_units_do_not_matter():
    one, other = (iv4(_record(np.random.default_rng(2), scale=s), ORDERS) for s in (1.0, 1e-6))
    np.testing.assert_allclose(other.model.outputs[0].A, one.model.outputs[0].A, rtol=1e-9)
    np.testing.assert_allclose(other.model.outputs[0].B[0], 1e-6 * one.model.outputs[0].B[0], rtol=1e-9)
    np.testing.assert_allclose(other.sd[1:3], one.sd[1:3], rtol=1e-8)


def test_exact_data_give_exact_coefficients():
    fit = iv4(_record(np.random.default_rng(2), noise=0.0), ORDERS)
    np.testing.assert_allclose(fit.model.theta[PLACES], TRUTH, atol=1e-9)


def test_feedback_is_warned_of():
    d = _record(np.random.default_rng(1))
    closed = io_data(d.u, d.y)
    assert any("feedback" in w for w in iv4(closed, ORDERS).warnings)
    assert not iv4(d, ORDERS).warnings


@pytest.mark.parametrize(
    ("orders", "word"),
    [
        ({"nb": 2}, "na"),
        ({"na": 2, "nb": 2, "nf": 1}, "nf"),
        ({"na": 2, "nb": 0}, "nb"),
        ({"na": 2, "nb": (2, 2)}, "nb"),
        ({"na": 400, "nb": 2}, "samples"),
    ],
)
def test_orders_that_break_a_rule(orders, word):
    with pytest.raises(EstimationError, match=word):
        iv4(_record(np.random.default_rng(1)), orders)


def test_an_input_that_does_not_excite():
    n = 500
    u = np.cos(0.3 * np.arange(n))
    y = lfilter(B, A, u)
    with pytest.raises(EstimationError, match="excite"):
        iv4(io_data(u, y, open_loop=True), {"na": 3, "nb": 3})
    with pytest.raises(EstimationError, match="constant"):
        iv4(io_data(np.ones(n), y, open_loop=True), ORDERS)
