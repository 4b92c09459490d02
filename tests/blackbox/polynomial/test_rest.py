"""Records that begin at rest at zero: what is gained by saying so, and what happens where it is not true."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from ambid.blackbox import polynomial
from ambid.blackbox.data import IOData
from ambid.blackbox.polynomial_predictor import Layout, predictor
from ambid.errors import EstimationError
from tests.blackbox.polynomial.systems import SYSTEMS, A, B, System, record, two_outputs


def from_rest(system: System, seed: int, n: int, *, cut: int = 0, level: float = 0.0) -> IOData:
    """A record of `n` samples from rest; with the first `cut` samples lost or `level` added it is none."""
    rng = np.random.default_rng(seed)
    e = system.sd * rng.standard_normal(n + cut)
    y = lfilter(system.C, np.convolve(system.A, system.D), e)
    u = np.empty((n + cut, 0))
    if system.B:
        u = rng.standard_normal((n + cut, 1))
        y = y + lfilter(system.B, np.convolve(system.A, system.F), u[:, 0])
    return record(u[cut:], y[cut:, None] + level, open_loop=True)


def denied(fit) -> bool:
    return any("does not start at rest" in x for x in fit.warnings)


@pytest.mark.parametrize("name", [x for x in SYSTEMS if x != "arma"])
def test_noise_free_records_of_few_samples_give_the_truth(name: str) -> None:
    system = SYSTEMS[name]
    u = np.random.default_rng(1).standard_normal(30)
    y = lfilter(system.B, np.convolve(system.A, system.F), u)
    fit = system.fit(record(u[:, None], y[:, None], open_loop=True), at_rest=True)
    p = fit.model.outputs[0]
    for found, truth in ((p.A, system.A), (p.B[0], system.B), (p.F[0], system.F)):
        np.testing.assert_allclose(found, truth, atol=1e-9)
    assert not denied(fit)
    assert not np.any(fit.offsets.u)
    assert not np.any(fit.offsets.y)


def test_arx_is_least_squares_on_all_samples() -> None:
    data = from_rest(SYSTEMS["arx"], 2, 200)
    y, u = np.r_[0.0, 0.0, data.y[:, 0]], np.r_[0.0, 0.0, data.u[:, 0]]
    rows = np.column_stack([-y[1:-1], -y[:-2], u[1:-1], u[:-2]])
    x, rest, _, _ = np.linalg.lstsq(rows, y[2:], rcond=None)
    fit = SYSTEMS["arx"].fit(data, at_rest=True)
    use = fit.sd > 0
    np.testing.assert_allclose(fit.model.theta[use], x, rtol=1e-9)
    expected = rest[0] / (200 - 4) * np.linalg.inv(rows.T @ rows)
    np.testing.assert_allclose(fit.covariance[np.ix_(use, use)], expected, rtol=1e-7)


@pytest.mark.parametrize("name", ["armax", "oe", "bj"])
def test_short_records_reach_the_cramer_rao_bound(name: str) -> None:
    system, n, runs = SYSTEMS[name], 120, 150
    system = System(**{x: getattr(system, x) for x in ("structure", "orders", "A", "B", "C", "D", "F")}, sd=0.1)
    layout = Layout(
        **{"na": 0, "nc": 0, "nd": 0} | {k: v for k, v in system.orders.items() if k in ("na", "nc", "nd")},
        nb=(2,), nf=(system.orders.get("nf", 0),), nk=(1,), at_rest=True,
    )  # fmt: skip
    p, truth = predictor(layout), system.truth
    errors, free, information = [], [], np.zeros((layout.free.size,) * 2)
    for seed in range(runs):
        data = from_rest(system, seed, n)
        rows = p.rows(data.y[:, 0], np.ascontiguousarray(data.u.T), truth, np.zeros(0))[:-1]
        information += rows @ rows.T / system.sd**2 / runs
        fits = [system.fit(data, at_rest=told) for told in (True, False)]
        errors.append((fits[0].model.theta - truth)[layout.free])
        free.append((fits[1].model.theta - truth)[layout.free])
    bound = np.linalg.inv(information)

    def loss(e: list[np.ndarray]) -> float:
        return float(np.mean([x @ np.linalg.solve(bound, x) for x in e])) / layout.free.size

    told, not_told = loss(errors), loss(free)
    assert 0.85 < told < 1.25  # mean square over the bound; 150 runs know it to some 7 %
    assert told < not_told


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_record_that_is_not_at_rest_is_warned_of(name: str) -> None:
    system = SYSTEMS[name]
    level = 3.0 if name == "fir" else 0.0  # a short response has nearly no initial state
    told = [system.fit(from_rest(system, seed, 300, cut=cut, level=cut * level), at_rest=True) for seed in range(12)
            for cut in (0, 40)]  # fmt: skip
    assert sum(denied(x) for x in told[::2]) == 0
    least = 3 if name == "arma" else 8  # noise alone begins not far from rest
    assert sum(denied(x) for x in told[1::2]) >= least
    assert "Omit at_rest" in next(w for x in told[1::2] for w in x.warnings)


def test_an_offset_is_warned_of() -> None:
    assert denied(SYSTEMS["oe"].fit(from_rest(SYSTEMS["oe"], 5, 500, level=1.0), at_rest=True))
    assert not SYSTEMS["oe"].fit(from_rest(SYSTEMS["oe"], 5, 500, level=1.0)).warnings


def test_a_step_from_standstill() -> None:
    u = np.ones((200, 1))
    y = lfilter(B, A, u[:, 0]) + 0.01 * np.random.default_rng(6).standard_normal(200)
    data = record(u, y[:, None], open_loop=True)
    fit = polynomial.oe(data, SYSTEMS["oe"].orders, at_rest=True)
    assert np.max(np.abs(fit.model.theta - SYSTEMS["oe"].truth)[fit.sd > 0] / fit.sd[fit.sd > 0]) < 3.5
    with pytest.raises(EstimationError, match="is constant"):
        polynomial.oe(data, SYSTEMS["oe"].orders)


def test_units_do_not_matter_and_delays_are_found() -> None:
    data = from_rest(SYSTEMS["bj"], 7, 600)
    one = polynomial.bj(data, {**SYSTEMS["bj"].orders, "nk": "auto"}, at_rest=True)
    scaled = record(data.u * 1e-6, data.y * 1e6, open_loop=True)
    other = SYSTEMS["bj"].fit(scaled, at_rest=True)
    assert one.orders["nk"] == 1
    worth = np.array([1e12 if "b" in x else 1.0 for x in one.model.names])
    np.testing.assert_allclose(other.model.theta, one.model.theta * worth, rtol=1e-7)


def test_two_outputs_and_a_long_record() -> None:
    u, y, covariance = two_outputs(40_000)
    fit = polynomial.oe(record(u, y, open_loop=True), {"nb": 1, "nf": 1}, at_rest=True)  # cut out of a longer run
    np.testing.assert_allclose(fit.noise_covariance, covariance, rtol=0.05)
    assert fit.details["nk"] == [[1, 2], [1, 2]]
    values = np.linalg.eigvalsh(fit.covariance)
    assert values[0] > -1e-12 * values[-1]
