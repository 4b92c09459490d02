"""Weak form: integrals without differentiation, no bias from noise in the regressors, intervals that hold."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from ambid.blackbox import weak_form
from ambid.blackbox.data import IOData
from ambid.blackbox.instrumental_continuous import srivc
from ambid.blackbox.weak_form import Bump, Equation, Rows, adjoint_moments, moments_at, weakform
from ambid.errors import EstimationError


def record(num, den, dt, n, noise, seed, *, delay=0, offset=2.0, u=None):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal(n) + 0.3 if u is None else u(rng, n)
    b, a, _ = cont2discrete((num, den), dt, "zoh")
    clean = lfilter(b.ravel(), a, np.r_[np.zeros(delay), u[: n - delay]])
    y = clean + noise * rng.standard_normal(n) + offset
    return IOData(
        u=u[:, None], y=y[:, None], dt=dt, inputs=("u",), outputs=("y",), units={"u": "V", "y": "m"}, open_loop=True
    )


def test_moments_are_those_of_the_derivatives():
    dt, n = 1e-3, 1500
    t = np.arange(n) * dt
    w = 2 * np.pi * 12.0
    derivatives = [w**k * np.sin(w * t + 0.4 + k * np.pi / 2) for k in range(4)]
    bump = Bump(half=60, degree=8, dt=dt)
    centres = bump.centres(n, 0)
    for k in range(4):
        by_parts = moments_at(derivatives[0], bump.kernel(k), bump.half, centres)
        direct = moments_at(derivatives[k], bump.kernel(0), bump.half, centres)
        np.testing.assert_allclose(by_parts, direct, atol=1e-9 * np.abs(direct).max())


def test_held_values_are_integrated_exactly():
    # the staircase itself, summed on a grid 400 times finer by the midpoint rule
    rng, dt, fine = np.random.default_rng(0), 0.1, 400
    u, bump = rng.standard_normal(60), Bump(half=12, degree=6, dt=0.1)
    for order in (0, 1, 2):
        got = moments_at(u, bump.held_kernel(order), bump.half, np.array([30]))[0]
        tau = (np.arange(-12 * fine, 12 * fine) + 0.5) / (12 * fine)
        phi = (np.polynomial.Polynomial([1.0, 0.0, -1.0]) ** 6).deriv(order)(tau) * (-1 / (12 * dt)) ** order
        index = np.floor(30 + tau * 12).astype(int)
        assert got == pytest.approx(float(np.sum(phi * u[index]) * dt / fine), rel=2e-3, abs=1e-6)


def test_spread_out_is_the_adjoint():
    rng, bump = np.random.default_rng(1), Bump(half=15, degree=6, dt=0.01)
    centres = bump.centres(200, 4)
    x, q, v = rng.standard_normal(200), rng.standard_normal(centres.size), bump.kernel(1)
    left = q @ moments_at(x, v, bump.half, centres)
    assert left == pytest.approx(x @ adjoint_moments(q, v, centres, 200), rel=1e-12)


def test_the_gradient_is_exact():
    # half the gradient of the criterion is Z^T r, with noise in every regressor and kinks in the output
    data = record([3.0, 20.0], [1.0, 8.0, 400.0], 0.01, 600, 0.02, 0)
    equation = Equation(y=data.y[:, 0] - data.y.mean(), u=data.u, n=2, nb=(2,), nk=(0,), dt=0.01)
    rows = Rows(equation, Bump(half=15, degree=7, dt=0.01))
    theta = np.array([390.0, 9.0, 21.0, 2.8, 0.1])
    state = rows.at(theta)
    gradient = 2 * state.Z.T @ state.r
    for j, size in enumerate(np.abs(theta)):
        ends = [rows.at(theta + s * 1e-4 * size * np.eye(5)[j]).cost for s in (-2, -1, 1, 2)]
        wanted = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12e-4 * size)
        assert gradient[j] == pytest.approx(wanted, rel=1e-6)


CASES = {
    "resonance": ([5.0], [1.0, 8.0, 400.0], 0.01, 1500, 3e-3, 0),
    "with a zero, delayed": ([3.0, 20.0], [1.0, 8.0, 400.0], 0.01, 1500, 2e-2, 2),
    "coil": ([550.0], [1.0, 860.0], 1e-4, 1500, 0.02, 0),
}


@pytest.mark.parametrize("name", list(CASES))
def test_no_bias_and_honest_intervals(name, monkeypatch):
    monkeypatch.setattr(weak_form, "supports", lambda n: [15])
    num, den, dt, n, noise, delay = CASES[name]
    runs = 60
    z = []
    for seed in range(runs):
        data = record(num, den, dt, n, noise, seed, delay=delay)
        fit = weakform(data, {"nf": len(den) - 1, "nb": len(num), "nk": delay})
        free = fit.sd > 0
        z.append(((fit.model.theta - np.r_[num, den]) / np.where(free, fit.sd, 1.0))[free])
        assert fit.status == "converged"
        assert fit.noise_covariance[0, 0] == pytest.approx(noise**2, rel=0.35)
        assert fit.offsets.y[0] - float(np.polyval(num, 0) / np.polyval(den, 0)) * fit.offsets.u[0] == pytest.approx(
            2.0, abs=0.05
        )
    z = np.array(z)
    assert np.all(np.abs(z.mean(axis=0)) < 3.5 / np.sqrt(runs))  # bias under half a standard deviation
    assert np.all(np.abs(np.mean(np.abs(z) < 1.96, axis=0) - 0.95) < 0.085)


@pytest.mark.parametrize(
    ("num", "den"),
    [([4000.0], [1.0, 14.0, 140.0, 1000.0]), ([200.0], [1.0, 4.0, 100.0]), ([40.0, 400.0], [1.0, 4.0, 100.0])],
)
def test_records_of_little_noise_are_not_biased_by_sums_for_integrals(num, den):
    # at 80 dB a degree too low for 20 samples of support left up to 260 standard deviations in the response
    def steps(rng, n):
        return np.repeat(rng.choice([-1.0, 1.0], size=n // 3 + 1), 3)[:n]

    z = []
    for seed in range(8):
        quiet = record(num, den, 0.01, 1000, 0.0, seed, delay=1, u=steps)
        noise = 1e-4 * quiet.y.std() * np.random.default_rng([seed, 1]).standard_normal(quiet.y.shape)
        fit = weakform(replace(quiet, y=quiet.y + noise), {"nf": len(den) - 1, "nb": len(num), "nk": 1})
        free = fit.sd > 0
        z.append(((fit.model.theta - np.r_[num, den]) / np.where(free, fit.sd, 1.0))[free])
    assert np.sqrt(np.mean(np.square(z))) < 1.5


def test_the_support_is_chosen_by_the_data():
    data = record([5.0], [1.0, 8.0, 400.0], 0.01, 3000, 3e-3, 1)
    fit = weakform(data, {"nf": 2, "nb": 1})
    tried = fit.details["supports"]["y"]
    assert len(tried) == 6
    chosen = round(fit.details["half_width_s"][0] / 0.01)
    sizes = {t["half_width_samples"]: t["log_det_covariance"] for t in tried}
    # supports far longer than the plant's 0.3 s miss it: all they find is noise
    noise = {t["half_width_samples"]: t["noise_sd_all_band"] for t in tried}
    assert noise[320] > 2 * noise[chosen]
    assert sizes[chosen] == min(v for k, v in sizes.items() if noise[k] < 1.05 * min(noise.values()))
    assert chosen < 100
    # where noise is white on the output, test functions lose little against refined instrumental variables
    sharp = srivc(data, {"nf": 2, "nb": 1, "nk": 0})
    free = fit.sd > 0
    assert np.all(fit.sd[free] < 1.25 * sharp.sd[free])


def test_a_support_that_is_too_long_is_not_believed(monkeypatch):
    # supports of 6 s see the static gain alone of a plant that settles in 0.5 s: any fast plant fits
    data = record([3.0, 20.0], [1.0, 8.0, 400.0], 0.01, 6000, 0.02, 0)
    with monkeypatch.context() as patched:
        patched.setattr(weak_form, "supports", lambda n: [320])
        assert any("too long" in w for w in weakform(data, {"nf": 2, "nb": 2}).warnings)
    fit = weakform(data, {"nf": 2, "nb": 2})
    free = fit.sd > 0
    assert not fit.warnings
    assert np.all(np.abs(fit.model.theta - [3.0, 20.0, 1.0, 8.0, 400.0])[free] < 4 * fit.sd[free])


def test_unstable_plants_are_no_harder():
    def pulse(rng, n):
        return rng.standard_normal(n) * np.exp(-np.arange(n) / 300)

    fits = [
        weakform(record([1.0], [1.0, 0.0, -25.0], 0.002, 1500, 1e-4, s, u=pulse), {"nf": 2, "nb": 1}) for s in range(5)
    ]
    for fit in fits:
        free = fit.sd > 0
        assert np.all(np.abs(fit.model.theta - [1.0, 1.0, 0.0, -25.0])[free] < 4 * fit.sd[free])
        assert np.max(fit.model.poles().real) == pytest.approx(5.0, rel=0.05)


def test_feedback_and_broken_orders_are_said():
    data = record([5.0], [1.0, 8.0, 400.0], 0.01, 400, 3e-3, 1)
    closed = IOData(**{k: getattr(data, k) for k in ("u", "y", "dt", "inputs", "outputs", "units")})
    assert any("biased" in w for w in weakform(closed, {"nf": 2, "nb": 1}).warnings)
    assert not weakform(data, {"nf": 2, "nb": 1}).warnings
    with pytest.raises(EstimationError, match="at most 2"):
        weakform(data, {"nf": 2, "nb": 3})
    with pytest.raises(EstimationError, match="nf is missing"):
        weakform(data, {"nb": 1})
    with pytest.raises(EstimationError, match="constant"):
        weakform(
            IOData(u=np.ones((400, 1)), y=data.y, dt=0.01, inputs=("u",), outputs=("y",), units=data.units),
            {"nf": 2, "nb": 1},
        )


def test_kinks_are_what_sampling_leaves_out(monkeypatch):
    # first-order plant without noise: with kinks taken into account the truth comes out, without them it does not
    data = record([550.0], [1.0, 860.0], 1e-4, 2000, 1e-9, 0)
    monkeypatch.setattr(weak_form, "supports", lambda n: [30])
    fit = weakform(data, {"nf": 1, "nb": 1})
    np.testing.assert_allclose(fit.model.theta, [550.0, 1.0, 860.0], rtol=2e-4)
    monkeypatch.setattr("ambid.blackbox.weak_form.kink", lambda u, delay, dt: np.zeros_like(u))
    plain = weakform(data, {"nf": 1, "nb": 1})
    assert abs(plain.model.theta[0] / 550.0 - 1) > 1e-3
