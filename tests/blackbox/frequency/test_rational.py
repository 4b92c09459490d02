"""Maximum likelihood: exact slope, honest intervals and cost, model errors seen, nothing silent."""

import json
from dataclasses import replace

import numpy as np
import pytest

from ambid.blackbox import frequency as rational
from ambid.blackbox.fit import fit_from_json, fit_text
from ambid.blackbox.frequency import frf_ml, orthogonal_polynomials
from ambid.blackbox.model import pole_covariance, response_covariance
from ambid.errors import EstimationError
from tests.blackbox.frequency.responses import RATE, closed_loop, extrapolated, noisy, plant, poles_of
from tests.tiers import runs

F = np.linspace(5.0, 2000.0, 120)


def second_order(f: np.ndarray) -> np.ndarray:
    s = 2j * np.pi * f
    return ((3e4 * s + 4e7) / (s**2 + 400.0 * s + 1.6e7))[:, None, None]


def test_polynomials_are_orthogonal_and_know_their_powers():
    x, w = 1j * np.linspace(0.01, 3, 200), np.linspace(1, 2, 200)
    q, powers = orthogonal_polynomials(x, w, 20)
    gram = ((w[:, None] * q).conj().T @ (w[:, None] * q)).real
    np.testing.assert_allclose(gram, np.eye(21), atol=1e-12)
    np.testing.assert_allclose(x[:, None] ** np.arange(9) @ powers[:9, :9], q[:, :9], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("domain", ["s", "z"])
def test_slope_is_exact(domain):
    hold = "zoh" if domain == "z" else "band-limited"
    frf = noisy(F, plant("unstable-bearing", F, hold=hold, delay=1), 0.05, 1, hold=hold)
    form = rational._form(frf, {"nf": 3, "nb": (2, 3)}, domain)
    _, at, vector, lag = rational._starts(form, 1 / RATE)[0]
    if domain == "s":
        at, vector = replace(at, delay_free=True), np.append(vector, 0.9)
    found = rational._residual(at, vector, lag, slope=True)[1]
    steps = 0.5 / np.abs(found).max(axis=0)  # of the response by about 3 %
    wanted = extrapolated(lambda v: rational._residual(at, v, lag)[0], vector, steps)
    np.testing.assert_allclose(found * steps, wanted * steps, atol=1e-9)


def modes(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Light modes inside the band, half of them unstable, and residues of two inputs and two outputs."""
    rng = np.random.default_rng(seed)
    up = 10 ** rng.uniform(1.8, 4.0, n // 2) * (rng.choice([-1, 1], n // 2) * rng.uniform(0.01, 0.1, n // 2) + 1j)
    R = (rng.normal(size=(n // 2, 2, 2)) + 1j * rng.normal(size=(n // 2, 2, 2))) * np.abs(up)[:, None, None]
    return np.stack([up, up.conj()], 1).ravel(), np.stack([R, R.conj()], 1).reshape(n, 2, 2)


@pytest.mark.parametrize("n", [2, 6, 12, 20])
@pytest.mark.parametrize("hold", ["band-limited", "zoh"])
def test_exact_up_to_order_20(n, hold):
    poles, residues = modes(n, n)
    f = np.linspace(5.0, 2000.0, 400)
    points = 2j * np.pi * f if hold == "band-limited" else np.exp(2j * np.pi * f / RATE)
    true = poles if hold == "band-limited" else np.exp(poles / RATE)
    G = np.array([[1.0, 0.5], [-0.2, 2.0]]) + np.einsum("fk,kyu->fyu", 1 / (points[:, None] - true), residues)
    fit = frf_ml(replace(noisy(f, G, 1e-3, 1, hold=hold), G=G), {"nf": n, "nb": n + 1})
    assert fit.details["cost"] < 1e-15
    if hold == "band-limited" or n < 10:  # more poles near z = 1 are lost in the powers of z
        np.testing.assert_allclose(np.sort_complex(fit.model.poles()[:n]), np.sort_complex(true), rtol=1e-5)


def test_light_modes_in_much_noise_are_found():
    # from poles with a hundredth of damping alone the search ends in 626.5, where noise alone leaves 585 +- 24
    rng, f = np.random.default_rng(1000), np.linspace(5.0, 2000.0, 300)
    up = 10 ** rng.uniform(1.8, 4.0, 5) * (rng.choice([-1, 1], 5) * rng.uniform(0.002, 0.1, 5) + 1j)
    R = (rng.normal(size=(5, 2, 1)) + 1j * rng.normal(size=(5, 2, 1))) * np.abs(up)[:, None, None]
    z, pairs = np.exp(2j * np.pi * f / RATE)[:, None], ((up, R), (up.conj(), R.conj()))
    G = sum(np.einsum("fk,kyu->fyu", 1 / (z - np.exp(p / RATE)), r) for p, r in pairs)
    fit = frf_ml(noisy(f, G, 0.1, 0, hold="zoh"), {"nf": 10, "nb": 10})
    assert fit.details["cost"] == pytest.approx(561.7, abs=0.5)


@pytest.mark.parametrize("freedom", [np.inf, 6.0])
def test_intervals_and_cost_are_honest(freedom):
    f = np.linspace(20.0, 2000.0, 60)
    G, true = second_order(f), np.roots([1.0, 400.0, 1.6e7])
    true = true[np.argmax(true.imag)]
    z, cost = [], []
    for seed in range(150):
        fit = frf_ml(noisy(f, G, 0.05, seed, freedom=freedom), {"nf": 2, "nb": 2})
        poles = fit.model.poles()
        k = int(np.argmax(poles.imag))
        sd = np.sqrt(np.diag(pole_covariance(fit.model, fit.covariance)[k]))
        z.append([(poles[k].real - true.real) / sd[0], (poles[k].imag - true.imag) / sd[1]])
        cost.append([fit.details["cost"], fit.details["expected_cost"], fit.details["cost_sd"]])
    z, (value, expected, spread) = np.array(z), np.array(cost).T
    assert np.all(np.abs(z.mean(axis=0)) < 3.3 / np.sqrt(150))
    assert np.all(np.abs(np.mean(z**2, axis=0) - 1) < 3.3 * np.sqrt(2 / 150) + (0.1 if np.isfinite(freedom) else 0.0))
    assert 0.90 <= np.mean(np.abs(z) < 1.96) <= 0.985
    assert abs(value.mean() - expected[0]) < 3.3 * spread[0] / np.sqrt(150)
    assert np.std(value) == pytest.approx(spread[0], rel=0.25)


def test_model_errors_are_seen():
    frf = noisy(F, plant("unstable-bearing", F), 0.01, 3)
    good, poor = frf_ml(frf, {"nf": 3, "nb": (1, 3)}), frf_ml(frf, {"nf": 2, "nb": (1, 2)})
    assert good.checks["cost"].passed
    assert not good.warnings
    assert not poor.checks["cost"].passed
    assert "model errors" in poor.warnings[0]


def test_a_hold_wants_z_and_s_says_what_it_leaves_out():
    frf = noisy(F, plant("unstable-bearing", F, hold="zoh"), 1e-4, 3, hold="zoh")
    exact, near = frf_ml(frf, {"nf": 3, "nb": 3}), frf_ml(frf, {"nf": 3, "nb": (1, 3)}, domain="s")
    assert exact.model.dt == 1 / RATE
    assert exact.checks["cost"].passed
    assert not near.checks["cost"].passed
    assert any("held" in w for w in near.warnings)
    np.testing.assert_allclose(
        np.sort_complex(np.log(exact.model.poles()[:3]) * RATE), poles_of("unstable-bearing"), rtol=1e-3
    )


@pytest.mark.parametrize("delay", [0.0, 1.4, 3.0])
def test_a_delay_is_found(delay):
    frf = noisy(F, plant("unstable-bearing", F, delay=delay), 0.02, 5)
    fit = frf_ml(frf, {"nf": 3, "nb": (1, 3)}, delay="auto")
    sd = fit.details["delay_sd_s"]
    assert sd < 0.02 / RATE
    assert abs(fit.details["delay_s"] - delay / RATE) < 3.3 * sd
    assert fit.model.delay == (fit.details["delay_s"],)


def test_an_estimated_delay_is_part_of_every_spread():
    # without the delay in the covariance the response missed the truth by up to 22 of its standard deviations
    f = np.linspace(20.0, 1900.0, 60)
    G = second_order(f) * np.exp(-2j * np.pi * f * 1.3e-4)[:, None, None]
    scores = []
    n = runs(20, short=6)
    for seed in range(n):
        fit = frf_ml(noisy(f, G, 0.05, seed), {"nf": 2, "nb": 2}, delay="auto")
        spread = response_covariance(fit.model, fit.covariance, 2 * np.pi * f)[:, 0, 0]
        error = fit.model.frequency_response(2 * np.pi * f)[:, 0, 0] - G[:, 0, 0]
        scores.append(np.stack([error.real, error.imag]) / np.sqrt(np.diagonal(spread, axis1=1, axis2=2).T))
    assert fit.model.names[-1] == "delay[0]"
    assert fit.sd[-1] == pytest.approx(fit.details["delay_sd_s"])
    assert n.limit(0.8, centre=1) < np.sqrt(np.mean(np.square(scores))) < n.limit(1.25, centre=1)
    again = fit_from_json(json.loads(fit_text(fit)), "fit")
    np.testing.assert_array_equal(again.model.theta, fit.model.theta)


def test_units_do_not_matter():
    frf = noisy(F, plant("unstable-bearing", F), 0.02, 5)
    other = replace(frf, frequency_hz=F * 1e-4, G=frf.G * 1e6, covariance=frf.covariance * 1e12, rate_hz=2.0)
    one, two = (frf_ml(x, {"nf": 3, "nb": (1, 3)}) for x in (frf, other))
    np.testing.assert_allclose(np.sort_complex(two.model.poles()) * 1e4, np.sort_complex(one.model.poles()), rtol=1e-6)
    np.testing.assert_allclose(two.details["cost"], one.details["cost"], rtol=1e-9)
    ratio = pole_covariance(two.model, two.covariance)[0, 0, 0] / pole_covariance(one.model, one.covariance)[0, 0, 0]
    assert ratio == pytest.approx(1e-8, rel=1e-4)


def test_nothing_is_changed_and_all_is_repeatable():
    frf = noisy(F, plant("unstable-bearing", F), 0.02, 5)
    G, C = frf.G.copy(), frf.covariance.copy()
    one, two = (frf_ml(frf, {"nf": 3, "nb": (1, 3)}) for _ in range(2))
    np.testing.assert_array_equal(one.model.theta, two.model.theta)
    np.testing.assert_array_equal(frf.G, G)
    np.testing.assert_array_equal(frf.covariance, C)
    some = one.sd > 0
    assert (
        np.linalg.eigvalsh(one.covariance[np.ix_(some, some)] / np.outer(one.sd, one.sd)[np.ix_(some, some)])[0] > -1e-9
    )


def test_closed_loop_bearing_within_one_percent():
    frf = closed_loop("unstable-bearing", 4, period=16_000, periods=6, rms=3.0)
    fit = frf_ml(frf, {"nf": 3, "nb": 3}, delay="auto")
    assert fit.checks["cost"].passed
    assert fit.details["delay_s"] * RATE == pytest.approx(1.0)
    np.testing.assert_allclose(
        np.sort_complex(np.log(fit.model.poles()[:3]) * RATE), poles_of("unstable-bearing"), rtol=0.01
    )


def broken(what):
    frf = noisy(F, plant("unstable-bearing", F), 0.02, 5)
    G, C = frf.G.copy(), frf.covariance.copy()
    if what == "nan":
        G[3] = np.nan
    elif what == "no variance":
        C[5] = 0.0
    elif what == "singular":
        C[5] = np.outer([1, 2], [1, 2])
    return replace(frf, G=G, covariance=C, degrees_of_freedom=4.0 if what == "freedom" else np.inf)


@pytest.mark.parametrize(
    ("what", "orders", "options", "message"),
    [
        ("nan", {"nf": 3}, {}, "G is not finite on line 3"),
        ("no variance", {"nf": 3}, {}, "no variance"),
        ("singular", {"nf": 3}, {}, "positive definite"),
        ("freedom", {"nf": 3}, {}, "degrees of freedom"),
        ("", {"nf": 200}, {}, "too few"),
        ("", {"nf": -1}, {}, "order nf"),
        ("", {"nf": 2, "nb": 4}, {}, "order nb"),
        ("", {"n": 2}, {}, "order 'n' is unknown; it takes nb, nf"),
        ("", {"nf": 2}, {"domain": "w"}, "domain"),
        ("", {"nf": 2}, {"domain": "z"}, "held"),
        ("", {"nf": 2}, {"delay": -1.0}, "delay"),
    ],
)
def test_what_breaks_a_rule_is_refused(what, orders, options, message):
    with pytest.raises(EstimationError, match=message):
        frf_ml(broken(what), orders, **options)


def test_unsorted_lines_are_refused():
    frf = noisy(F, plant("unstable-bearing", F), 0.02, 5)
    with pytest.raises(EstimationError, match=r"rising|increas"):
        frf_ml(replace(frf, frequency_hz=F[::-1].copy()), {"nf": 3})
