"""Delays, refusals, warnings and records that are hard on an estimator."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy.signal import lfilter

from ambid.blackbox import polynomial
from ambid.blackbox.cancellation import cancellations
from ambid.blackbox.model import reflect, stable
from ambid.errors import EstimationError
from tests.blackbox.polynomial.systems import SYSTEMS, A, B, System, record, unstable_loop

BOTH = {"nb": 2, "nf": 2}


def delayed(nk: tuple[int, ...], seed: int, n: int = 1500, noise: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """Second-order responses to white inputs, each after its delay, in coloured noise."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n, len(nk)))
    y = lfilter([1.0], [1, -0.9], noise * rng.standard_normal(n))
    for k, w in zip(nk, u.T, strict=True):
        y = y + lfilter([0.0] * k + [0.4, 0.3], A, w)
    return u, y[:, None]


@pytest.mark.parametrize("name", ["fir", "arx", "armax", "ararx", "oe", "bj"])
@pytest.mark.parametrize("nk", [1, 4, 17])
def test_delay_is_found(name: str, nk: int) -> None:
    u, y = delayed((nk,), 10 + nk)
    orders = {k: 1 if k in ("nc", "nd") else 2 for k in SYSTEMS[name].orders if k != "nk"}
    fit = getattr(polynomial, name)(record(u, y, open_loop=True), orders | ({"nb": 25} if name == "fir" else {}))
    assert fit.orders["nk"] == nk
    assert fit.details["nk"] == [[nk]]


def test_delays_of_two_inputs_and_none() -> None:
    u, y = delayed((0, 6), 3)
    fit = polynomial.bj(record(u, y, open_loop=True), {**BOTH, "nc": 0, "nd": 1, "nk": "auto"})
    assert fit.orders["nk"] == (0, 6)
    # not told that the loop is open, a path within the same sample may be the controller's
    assert polynomial.bj(record(u, y), {**BOTH, "nc": 0, "nd": 1}).orders["nk"][0] == 1


def test_a_delay_at_the_end_of_the_search_is_warned_of() -> None:
    u, y = delayed((23,), 6)
    fit = polynomial.arx(record(u, y, open_loop=True), {"na": 2, "nb": 2})
    assert any("may be longer" in x for x in fit.warnings)


def test_delay_under_feedback() -> None:
    data, _, _ = unstable_loop(2000, 5)
    assert polynomial.armax(data, {"na": 2, "nb": 1, "nc": 2}).orders["nk"] == 1


@pytest.mark.parametrize(
    ("name", "orders", "words"),
    [
        ("oe", {"nb": 2, "nk": 1}, "order nf is missing"),
        ("oe", {"nb": 2, "nf": 2, "na": 2, "nk": 1}, "order 'na' is unknown; it takes nb, nf, nk"),
        ("arx", {"na": -1, "nb": 2, "nk": 1}, "na = -1; it must be a whole number of at least 0"),
        ("arx", {"na": 1.5, "nb": 2, "nk": 1}, "na = 1.5; it must be a whole number"),
        ("arx", {"na": True, "nb": 2, "nk": 1}, "na = True; it must be a whole number"),
        ("arx", {"na": 1, "nb": 0, "nk": 1}, "nb = 0; it must be a whole number of at least 1"),
        ("arx", {"na": 1, "nb": (1, 2), "nk": 1}, r"nb has 2 numbers for 1 input"),
        ("arx", {"na": 1, "nb": 1, "nk": "later"}, "nk = 'later'; it must be a whole number"),
        ("arx", {"na": 1, "nb": 150, "nk": 1}, "at least 455 are needed"),
        ("arma", {"na": 1, "nc": 1}, "arma takes no inputs"),
    ],
)
def test_orders_that_break_a_rule_are_refused(name: str, orders: dict, words: str) -> None:
    data = SYSTEMS["arx"].data(1, 200)
    with pytest.raises(EstimationError, match=words):
        getattr(polynomial, name)(data, orders)


def test_data_that_say_nothing_are_refused() -> None:
    data = SYSTEMS["arx"].data(1, 200)
    orders = SYSTEMS["arx"].orders
    with pytest.raises(EstimationError, match="'u0' is constant"):
        polynomial.arx(record(0.1 + 0 * data.u, data.y), orders)
    with pytest.raises(EstimationError, match="'y0' is constant"):
        polynomial.arx(record(data.u, 0.3 + 0 * data.y), orders)
    with pytest.raises(EstimationError, match="arx needs an input"):
        polynomial.arx(record(np.empty((200, 0)), data.y), orders)
    with pytest.raises(EstimationError, match="all orders are 0"):
        polynomial.arma(record(np.empty((200, 0)), data.y), {"na": 0, "nc": 0})
    with pytest.raises(EstimationError, match="too few to find the delay"):
        polynomial.arx(record(data.u[:30], data.y[:30]), {"na": 1, "nb": 1})


@pytest.mark.parametrize("name", ["arx", "armax", "ararx", "ararmax", "oe", "bj"])
def test_noise_free_records_give_the_truth(name: str) -> None:
    rng = np.random.default_rng(12)
    u = rng.standard_normal((400, 1))
    y = lfilter(B, A, u[:, 0])
    fit = getattr(polynomial, name)(record(u, y[:, None], open_loop=True), SYSTEMS[name].orders)
    p = fit.model.outputs[0]
    np.testing.assert_allclose(p.F[0] if name in ("oe", "bj") else p.A, A, atol=1e-8)
    np.testing.assert_allclose(p.B[0], B, atol=1e-8)
    assert fit.noise_covariance[0, 0] < 1e-18
    assert np.all(np.isfinite(fit.covariance))


def test_too_high_orders_are_named_and_their_spread_is_wide() -> None:
    system = SYSTEMS["oe"]
    fit = polynomial.oe(system.data(13, 1500), {"nb": 3, "nf": 3, "nk": 1})
    assert [c.where for c in cancellations(fit)] == ["B and F"]
    exact = System(structure="oe", orders={"nb": 3, "nf": 3, "nk": 1}, B=B, F=A, sd=0.0)
    fit = exact.fit(exact.data(13, 600))
    assert any("do not distinguish" in x and "f" in x for x in fit.warnings)
    assert fit.details["condition"][0] > 1e8
    assert fit.sd[-1] > 0.1  # any common root would do
    white = polynomial.bj(system.data(14, 1500), {"nb": 2, "nc": 1, "nd": 1, "nf": 2, "nk": 1})
    assert [c.where for c in cancellations(white)] == ["C and D"]
    whiteness = polynomial.armax(SYSTEMS["fir"].data(14, 1500), {"na": 1, "nb": 4, "nc": 1, "nk": 1})
    assert [c.where for c in cancellations(whiteness)] == ["A with B and C"]


def test_right_orders_raise_no_warning() -> None:
    found = {name: s.fit(s.data(15, 2000)).warnings for name, s in SYSTEMS.items()}
    assert not any(found.values()), found


def test_a_noise_root_on_the_circle_is_named() -> None:
    rng = np.random.default_rng(16)
    e = rng.standard_normal(1000)
    y = lfilter([1, -1.0], [1, -0.5], e)[:, None]
    fit = polynomial.arma(record(np.empty((1000, 0)), y), {"na": 1, "nc": 1})
    assert stable(fit.model.outputs[0].C)
    assert any("root of C" in x and "stability limit" in x for x in fit.warnings)


def test_feedback_is_warned_of_only_where_it_biases() -> None:
    data = SYSTEMS["oe"].data(17, 800)
    closed = record(data.u, data.y)
    assert any("biased" in x for x in polynomial.oe(closed, SYSTEMS["oe"].orders).warnings)
    assert not polynomial.oe(data, SYSTEMS["oe"].orders).warnings
    assert not polynomial.bj(closed, {**SYSTEMS["oe"].orders, "nc": 0, "nd": 0}).warnings


def test_a_million_samples_need_little_memory() -> None:
    n = 1_000_000
    rng = np.random.default_rng(18)
    u = rng.standard_normal((n, 1))
    y = lfilter(B, A, u[:, 0])[:, None] + 0.5 * rng.standard_normal((n, 1))
    data = record(u, y, open_loop=True)
    tracemalloc.start()
    try:
        fit = polynomial.oe(data, SYSTEMS["oe"].orders)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 10 * u.nbytes  # all gradients at once would take 8 of the 10 for themselves, their copies more
    np.testing.assert_allclose(fit.model.outputs[0].F[0], A, atol=2e-3)


def test_every_look_at_the_data_ticks() -> None:
    count = []
    fit = polynomial.oe(SYSTEMS["oe"].data(19, 500), SYSTEMS["oe"].orders, tick=lambda: count.append(1))
    assert len(count) >= fit.details["iterations"][0] >= 1


@pytest.mark.parametrize(
    "roots", [[0.5], [0.9 + 0.3j, 0.9 - 0.3j, -0.2], [1.01, 0.3], [0.8 + 0.7j, 0.8 - 0.7j], [-1.0]]
)
def test_stability_is_that_of_the_roots(roots: list[complex]) -> None:
    p = np.real(np.poly(roots))
    assert stable(p) == (np.max(np.abs(roots)) < 1.0)
    assert stable(np.append(p, 0.0)) == stable(p)
    assert stable(reflect(p))
    assert not stable(np.array([1.0, np.nan]))


def test_a_long_impulse_response() -> None:
    data = SYSTEMS["arx"].data(20, 3000)
    fit = polynomial.fir(data, {"nb": 200, "nk": 0})
    truth = lfilter(B, A, np.eye(1, 200)[0])
    assert np.mean(np.abs(fit.model.outputs[0].B[0] - truth) < 1.96 * fit.sd[1:201]) > 0.85
