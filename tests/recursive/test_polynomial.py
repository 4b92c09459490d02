"""Recursive prediction error method: equal to off-line, consistent under feedback, sound for ever."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from ambid.blackbox import polynomial
from ambid.errors import EstimationError
from ambid.recursive.estimator import covariance_of
from ambid.recursive.polynomial import RecursivePolynomial
from tests.blackbox.polynomial.systems import SYSTEMS, System, record, two_outputs, unstable_loop
from tests.recursive.cases_polynomial import ORDERS, fit_of, signals
from tests.tiers import ALL

SLOW = System(  # a lightly damped plant sampled fast, coloured noise: what a bearing looks like
    structure="bj",
    orders={"nb": 2, "nc": 1, "nd": 1, "nf": 2, "nk": 1},
    B=(0.0, 0.02, 0.01),
    C=(1.0, 0.5),
    D=(1.0, -0.95),
    F=(1.0, -1.94, 0.9509),
    sd=0.1,
)
BAR_6 = {name: SYSTEMS[name] for name in ("armax", "oe", "bj", "arma", "ararmax")} | {"slow": SLOW}


def distance(found: RecursivePolynomial, fit) -> float:
    """Largest distance from an off-line fit in its standard deviations."""
    free = fit.sd > 0
    return float(np.max(np.abs(found.estimate - fit.model.theta[free]) / fit.sd[free]))


@pytest.mark.parametrize("name", BAR_6)
@pytest.mark.parametrize("seed", range(3))
def test_final_estimate_is_the_offline_one(name: str, seed: int) -> None:
    system, n = BAR_6[name], 20_000
    data = system.data(seed, n, offset=10.0)
    fit, first = system.fit(data), system.fit(data.part(0, n // 2))
    u, y = data.u, data.y[:, 0]

    primed = RecursivePolynomial.from_fit(first, samples=n // 2)
    primed.prime(u[: n // 2], y[: n // 2])
    primed.update(u[n // 2 :], y[n // 2 :])
    assert distance(primed, fit) < 0.2
    nothing = RecursivePolynomial(system.structure, system.orders, dt=1e-3)
    nothing.update(u, y)
    assert distance(nothing, fit) < 0.2
    for r in (primed, nothing):
        np.testing.assert_allclose(r.sd, fit.sd[fit.sd > 0], rtol=0.05)
        np.testing.assert_allclose(r.noise_variance, fit.noise_covariance[0, 0], rtol=0.03)
        np.testing.assert_allclose(r.model.dt, 1e-3)


def test_without_the_last_samples_before_it_a_fit_goes_on_with_little_loss() -> None:
    system = SYSTEMS["armax"]
    data = system.data(1, 20_000, offset=10.0)
    r = RecursivePolynomial.from_fit(system.fit(data.part(0, 10_000)))
    r.update(data.u[10_000:], data.y[10_000:, 0])
    assert 0 < r.counts["waited"] < 30
    assert distance(r, system.fit(data)) < 0.2


def test_two_inputs_follow_the_offline_fit() -> None:
    u, y, _ = two_outputs(8000)
    data = record(u, y[:, :1] + 3.0, open_loop=True)
    orders = {"nb": 1, "nf": 1, "nk": (1, 2)}
    r = RecursivePolynomial("oe", orders, n_inputs=2, dt=1e-3, open_loop=True)
    r.update(u, y[:, :1] + 3.0)
    assert distance(r, polynomial.oe(data, orders)) < 0.2
    assert r.names == ("b1.0", "b2.1", "f1.0", "f1.1")


def test_arx_is_least_squares_with_a_prior() -> None:
    fit, (u, y) = fit_of("arx"), signals("arx")(500, 4)
    r = RecursivePolynomial.from_fit(fit, samples=100)
    r.update(u, y)
    rows = np.column_stack([-y[1:-1], -y[:-2], u[1:-1], u[:-2], np.ones(y.size - 2)])[1:]
    prior = np.append(fit.covariance[fit.sd > 0][:, fit.sd > 0].diagonal(), 0.09 / 100)
    information = np.diag(0.09 / prior) + rows.T @ rows
    start = np.append(fit.model.theta[fit.sd > 0], 0.0)
    theta = np.linalg.solve(information, 0.09 / prior * start + rows.T @ y[3:])
    np.testing.assert_allclose(r.estimate, theta[:-1], rtol=1e-9)
    spread = np.linalg.inv(information)[:-1, :-1] * r.noise_variance
    np.testing.assert_allclose(r.covariance, spread, rtol=1e-9)


def test_covariance_with_forgetting_is_that_of_the_error() -> None:
    fit, (u, y) = fit_of("arx"), signals("arx")(400, 4)
    r = RecursivePolynomial.from_fit(fit, samples=100, forgetting=0.95)
    errors = r.update(u, y)[3:]
    rows = np.column_stack([-y[1:-1], -y[:-2], u[1:-1], u[:-2], np.ones(y.size - 2)])[1:]
    first = np.diag(0.09 / np.append(fit.covariance[fit.sd > 0][:, fit.sd > 0].diagonal(), 0.09 / 100))
    once, twice, forget, squares, weight = first, 0.09 * first, 0.95, 9.0, 100.0
    for row, e in zip(rows, errors, strict=True):
        size = 1 + row @ np.linalg.solve(once, row) / forget
        squares, weight = forget * squares + e**2 / size, forget * weight + 1
        once = forget * once + np.outer(row, row)
        twice = forget**2 * twice + squares / weight * np.outer(row, row)
    P = np.linalg.inv(once)
    np.testing.assert_allclose(r.covariance, (P @ twice @ P)[:-1, :-1], rtol=1e-7)
    assert r.noise_variance == pytest.approx(squares / weight, rel=1e-9)


def test_signals_that_stand_still_make_no_coefficient_surer() -> None:
    system = SYSTEMS["bj"]
    data = system.data(1, 4000)
    r = RecursivePolynomial.from_fit(system.fit(data.part(0, 2000)), forgetting=0.998)
    r.update(data.u[2000:], data.y[2000:, 0])
    before = r.sd
    r.update(np.zeros((30_000, 1)), np.zeros(30_000))
    assert np.all(r.sd > 0.7 * before)
    assert any("are constant" in w for w in r.warnings)
    noise = r.noise_variance
    r.update(data.u, data.y[:, 0])
    assert r.noise_variance > 1e3 * noise  # and the calm is forgotten
    assert r.noise_variance == pytest.approx(system.fit(data).noise_covariance[0, 0], rel=0.5)


def test_armax_is_consistent_on_an_unstable_plant_in_a_loop() -> None:
    data, a, c = unstable_loop(30_000, 2)
    r = RecursivePolynomial("armax", {"na": 2, "nb": 1, "nc": 2, "nk": 1})
    r.update(data.u, data.y)
    truth = np.concatenate([a[1:], [0.5], c[1:]])
    assert np.all(np.abs(r.estimate - truth) < 3.5 * r.sd)
    assert np.all(r.sd < 0.02)
    assert np.max(np.abs(r.model.poles())) > 1.05  # A need not be stable
    assert not r.warnings


def test_bias_under_feedback_is_told() -> None:
    assert any("biased" in w for w in RecursivePolynomial("oe", ORDERS["oe"]).warnings)
    assert not any("biased" in w for w in RecursivePolynomial("oe", ORDERS["oe"], open_loop=True).warnings)
    assert any("biased" in w for w in RecursivePolynomial.from_fit(fit_of("oe")).warnings)


def moving_armax(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    a1 = -1.5 + 0.2 * np.sin(np.linspace(0.0, np.pi, n))
    u, e, y = rng.standard_normal(n), 0.3 * rng.standard_normal(n), np.zeros(n)
    for t in range(2, n):
        y[t] = -a1[t] * y[t - 1] - 0.7 * y[t - 2] + u[t - 1] + 0.5 * u[t - 2] + e[t] + 0.5 * e[t - 1] + 0.3 * e[t - 2]
    return u, y, a1


def test_a_moving_coefficient_is_followed() -> None:
    u, y, a1 = moving_armax(20_000, 0)
    error = {}
    for forget in (0.995, 1.0):
        r, found = RecursivePolynomial("armax", ORDERS["armax"], forgetting=forget), []
        for k in range(0, u.size, 100):
            r.update(u[k : k + 100], y[k : k + 100])
            found.append(r.estimate[0])
        error[forget] = np.sqrt(np.mean((np.array(found[20:]) - a1[99::100][20:]) ** 2))
    assert error[0.995] < 0.018  # 0.012 from noise, 0.006 behind at most
    assert error[1.0] > 4 * error[0.995]


def test_gaps_do_not_move_the_estimate_away() -> None:
    data = SLOW.data(5, 30_000, offset=10.0)
    u, y = data.u, data.y[:, 0].copy()
    first = SLOW.fit(data.part(0, 10_000))
    y[11_000::2000] = np.nan
    y[11_003::6000] = np.inf
    r = RecursivePolynomial.from_fit(first, samples=10_000)
    errors = r.update(u[10_000:], y[10_000:])
    assert r.n_rejected == np.sum(~np.isfinite(y[10_000:]))
    assert distance(r, SLOW.fit(data)) < 0.6  # a tenth of the samples fill the filters anew
    used = errors[np.isfinite(errors)]
    assert abs(np.std(used) / SLOW.sd - 1) < 0.03  # no sample was predicted from half-filled filters
    assert np.max(np.abs(used)) < 6 * SLOW.sd


def test_coefficients_that_would_be_unstable_are_held_back_and_counted() -> None:
    rng = np.random.default_rng(0)
    u, e = rng.standard_normal(4000), rng.standard_normal(4000)
    start = System(
        structure="bj", orders={"nb": 1, "nc": 1, "nd": 0, "nf": 1, "nk": 1}, B=(0, 1), F=(1, -0.9), C=(1, -0.9)
    )
    fit = start.fit(start.data(1, 300))
    y = lfilter([0.0, 1.0], [1.0, -0.97], u) + lfilter([1.0, -1.0], [1.0], e)  # a zero of the noise at 1
    r = RecursivePolynomial.from_fit(fit, forgetting=0.97)
    for k in range(0, 4000, 50):
        r.update(u[k : k + 50], y[k : k + 50])
        p = r.model.outputs[0]
        assert abs(p.C[1]) < 1
        assert abs(p.F[0][1]) < 1
    assert r.counts["projected"] > 0
    assert any("unstable C or F" in w for w in r.warnings)
    assert abs(r.estimate[0] - 1.0) < 0.3
    assert abs(r.estimate[2] + 0.97) < 0.03


def test_errors_that_grow_are_told() -> None:
    r, (u, y) = RecursivePolynomial.from_fit(fit_of("armax")), signals("armax")(1000, 2)
    r.update(u, y)
    assert not r.warnings
    r.update(u, y + np.random.default_rng(3).standard_normal(y.size))
    assert any("times those at the start" in w for w in r.warnings)
    r.update(np.nan, np.nan)
    assert any("need history" in w for w in r.warnings)


def test_no_excitation_no_wind_up() -> None:
    fit, (u, y) = fit_of("armax"), signals("armax")(5000, 2)
    r = RecursivePolynomial.from_fit(fit, forgetting=0.99)
    r.update(u, y)
    before, sd, rng = r.estimate, r.sd, np.random.default_rng(1)
    e = 0.3 * rng.standard_normal(200_000)
    still = np.full(e.size, 2.0)
    offset = 5.0 + 2.0 * 1.5 / 0.2
    r.update(still, offset + lfilter([1.0, 0.5, 0.3], [1.0, -1.5, 0.7], e))
    b = slice(2, 4)
    assert np.all(np.abs(r.estimate[b] - before[b]) < 4 * np.maximum(sd, r.sd)[b])
    assert np.all(np.linalg.eigvalsh(r.covariance) > 0)
    assert r.counts["held"] > 100_000
    r.update(u, y)
    assert np.all(np.abs(r.estimate - [-1.5, 0.7, 1.0, 0.5, 0.5, 0.3]) < 5 * r.sd)


def test_a_stalled_start_says_so_in_its_deviations_until_a_later_search_converges() -> None:
    system = System(
        structure="bj",
        orders={"nb": 2, "nc": 1, "nd": 1, "nf": 2, "nk": 1},
        B=(0, 1.0, 0.5),
        C=(1, -0.995),  # a long memory: short windows do not show it
        D=(1, -0.6),
        F=(1, -1.5, 0.7),
    )
    truth, stalled = np.array([1.0, 0.5, -0.995, -0.6, -1.5, 0.7]), 0
    for seed in (0, 7, 9, 14):
        data = system.data(seed, 6000)
        r = RecursivePolynomial("bj", system.orders, dt=1e-3, burn_in=150)
        for k in range(0, 6000, 1000):
            r.update(data.u[k : k + 1000], data.y[k : k + 1000, 0])
            doubtful = any("did not converge" in w for w in r.warnings)
            if r.started:
                assert np.all(np.abs(r.estimate - truth) < 4.5 * r.sd)
            if r.started and doubtful:
                assert np.all(r.sd > 0.5 * np.abs(truth))
                stalled += 1
        assert not doubtful
        assert r.n_used == 6000
    assert stalled > 0
    doubted = RecursivePolynomial.from_fit(replace(fit_of("bj"), status="stalled"))
    assert np.all(doubted.sd >= 0.99)


@pytest.mark.parametrize("forgetting", [0.995, 0.97, 0.8])
def test_a_short_memory_winds_up_to_the_limit_and_not_beyond(forgetting: float) -> None:
    r = RecursivePolynomial.from_fit(fit_of("arx"), forgetting=forgetting)
    r.update(*signals("arx")(2000, 2))
    largest = 0.0
    for _ in range(3000):  # the input stands still, so its coefficients are not seen
        r.update(2.0, 20.0)
        state = r._state
        assert state is not None
        variance = max(r.noise_variance, 0.09) * np.diag(covariance_of(state.F))
        largest = max(largest, float(np.max(variance / state.limit)))
    assert largest <= 1.0 + 1e-9
    assert r.counts["held"] > 0


def test_a_memory_too_short_for_a_gradient_is_told() -> None:
    short = RecursivePolynomial.from_fit(fit_of("bj"), forgetting=0.99)
    assert any("short for 7 coefficients" in w and "160" in w for w in short.warnings)
    assert any("short for" in w for w in RecursivePolynomial("bj", ORDERS["bj"], forgetting=0.99).warnings)
    assert not any("short" in w for w in RecursivePolynomial.from_fit(fit_of("bj"), forgetting=0.994).warnings)
    assert not any("short" in w for w in RecursivePolynomial.from_fit(fit_of("arx"), forgetting=0.9).warnings)


def test_millions_of_updates_keep_the_covariance_positive_definite() -> None:
    r, (u, y) = RecursivePolynomial.from_fit(fit_of("armax"), forgetting=0.9995), signals("armax")(500_000, 6)
    rounds = 20 if ALL else 4
    for _ in range(rounds):
        r.update(u, y)
        P = r.covariance
        np.testing.assert_array_equal(P, P.T)
        assert np.all(np.linalg.eigvalsh(P) > 0)
    assert r.n_used == rounds * 500_000
    assert np.all(np.abs(r.estimate - [-1.5, 0.7, 1.0, 0.5, 0.5, 0.3]) < 5 * r.sd)


def test_nothing_is_learnt_from_a_window_without_excitation() -> None:
    system = SYSTEMS["armax"]
    data = system.data(3, 4000)
    r = RecursivePolynomial("armax", system.orders, burn_in=500)
    r.update(np.zeros(9000), np.full(9000, 3.0))
    assert not r.started
    assert r.counts["failed_starts"] > 0
    assert np.isnan(r.noise_variance)
    assert "no estimate" in r.warnings[0]
    errors = r.update(data.u, data.y[:, 0])
    assert r.started
    assert np.isfinite(errors[-1])
    assert r.n_used == 13_000


@pytest.mark.parametrize(
    ("structure", "orders", "options", "match"),
    [
        ("armax", {"na": 2, "nb": 2, "nc": 2}, {}, "nk"),
        ("n4sid", {"n": 2}, {}, "not a polynomial structure"),
        ("arx", {"na": 2, "nb": 2, "nk": 1}, {"burn_in": 10}, "burn_in"),
        ("arx", {"na": 2, "nb": 2, "nk": 1, "nc": 1}, {}, "nc"),
        ("arx", {"na": 2, "nb": 2, "nk": 1}, {"forgetting": 1.5}, "forgetting"),
    ],
)
def test_what_cannot_be_done_is_refused(structure, orders, options, match) -> None:
    with pytest.raises(EstimationError, match=match):
        RecursivePolynomial(structure, orders, **options)


def test_fits_that_cannot_be_followed_are_refused() -> None:
    two = System(structure="arx", orders={"na": 1, "nb": 1, "nk": 1}, A=(1.0, -0.5), B=(0.0, 1.0))
    data = two.data(0, 300)
    both = record(data.u, np.column_stack([data.y, data.y[::-1]]), open_loop=True)
    with pytest.raises(EstimationError, match="2 outputs"):
        RecursivePolynomial.from_fit(two.fit(both))
