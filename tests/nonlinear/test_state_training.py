"""Spread of networks where errors are not white, and where physics is a projection: coverage over Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambid.blackbox.data import IOData
from ambid.estimation.uncertainty import sandwich, score_covariance
from ambid.nonlinear.fit import NonlinearFit
from ambid.nonlinear.narx import narx
from ambid.nonlinear.nn import nn
from ambid.nonlinear.state_training import State, disagreement
from tests.nonlinear.test_narx import data
from tests.nonlinear.test_state_network import one_axis, sampled
from tests.tiers import runs


def coloured(n: int, seed: int, size: float, pole: float = 0.9) -> np.ndarray:
    e, v = np.random.default_rng([seed, 9]).standard_normal(n), np.zeros(n)
    for t in range(1, n):
        v[t] = pole * v[t - 1] + size * e[t]
    return v


def test_the_sum_of_correlated_scores_is_estimated() -> None:
    found = [score_covariance([coloured(4000, s, 1.0, 0.8)[:, None]])[0, 0] / 4000 for s in range(20)]
    assert np.mean(found) == pytest.approx(1.0 / 0.2**2, rel=0.15)
    white = [score_covariance([coloured(100, s, 1.0, 0.0)[:, None]])[0, 0] / 100 for s in range(100)]
    assert np.mean(white) == pytest.approx(1.0, rel=0.15)
    many = [score_covariance([np.full((7, 1), v) for v in coloured(40, s, 1.0, 0.0)])[0, 0] for s in range(50)]
    assert np.mean(many) == pytest.approx(40 * 49.0, rel=0.1)  # whole records are what is independent


def test_intervals_hold_where_few_samples_pull_much() -> None:
    # large |u| pull most and leave most, so that what is left there is too small
    def made(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, float]:
        u = coloured(n, seed, 0.6, 0.6)
        Z = np.stack([u, np.ones(n)], axis=1)
        y = np.tanh(1.5 * u)
        slope = np.linalg.lstsq(Z, y, rcond=None)[0]
        return Z, y - Z @ slope, float(slope[0])

    true = np.mean([made(50_000, 10_000 + k)[2] for k in range(4)])
    inside = np.zeros(2)
    for seed in range(300):
        Z, left, slope = made(200, seed)
        R, slopes, scores = np.linalg.qr(Z, mode="r"), [Z[:, None, :]], [Z * left[:, None]]
        for k, given in enumerate((None, slopes)):
            P, _ = sandwich(R, scores, slopes=given)
            assert P is not None
            inside[k] += abs(slope - true) < 1.96 * np.sqrt(P[0, 0])
    assert inside[1] / 300 > 0.93, inside
    assert inside[0] < inside[1], inside


def test_the_sandwich_is_that_of_a_linear_regression_with_correlated_errors() -> None:
    spreads, errors = np.zeros(40), np.zeros(40)
    for s in range(40):
        z, e = coloured(2000, 500 + s, 1.0, 0.8), coloured(2000, s, 1.0, 0.8)
        slope = float(z @ e / (z @ z))
        rows = np.stack([z, e - slope * z], axis=1)[:, None, :]
        R = np.linalg.qr(rows[:, 0], mode="r")[:, :1]
        P, _ = sandwich(R, [(z * (e - slope * z))[:, None]])
        assert P is not None
        spreads[s] = P[0, 0]
        errors[s] = slope
    assert spreads.mean() == pytest.approx(np.var(errors), rel=0.45)
    white = 1.0 / 2000  # variance of errors over that of z, were they white
    assert spreads.mean() > 3.0 * white


def coverage(fit: NonlinearFit, true: np.ndarray) -> np.ndarray:
    """Whether the first values of the impulse response are inside their 95 % intervals."""
    assert fit.model is not None
    assert fit.covariance is not None

    def impulse(theta: np.ndarray) -> np.ndarray:
        m = fit.model.with_theta(theta)  # type: ignore[union-attr]
        return np.array([(np.linalg.matrix_power(m.A, k) @ m.B)[0, 0] for k in range(true.size)])

    theta = fit.model.theta
    J = np.stack([(impulse(theta + h) - impulse(theta - h)) / 2e-6 for h in 1e-6 * np.eye(theta.size)], axis=1)
    return np.abs(impulse(theta) - true) < 1.96 * np.sqrt(np.diag(J @ fit.covariance @ J.T))


def test_intervals_of_a_network_trained_on_coloured_simulation_errors_cover_the_truth() -> None:
    _, A, B = sampled(10, 1)
    true = np.array([(np.linalg.matrix_power(A, k) @ B)[0] for k in range(6)])
    inside: dict[str, list[np.ndarray]] = {"auto": [], "laplace": []}
    origins = {}
    n = runs(18, short=5)
    for seed in range(n):
        clean = sampled(1000, 300 + seed)[0]
        # slow noise over fast: 4 times the power of white noise where this plant is slow
        y = clean.y + coloured(1000, seed, 0.1, 0.9)[:, None]
        record = IOData(
            u=clean.u, y=y, dt=0.01, inputs=("u",), outputs=("y",), units={"u": "V", "y": "1"}, open_loop=True
        )
        for how, found in inside.items():
            told = {"states": 2, "descent": 0, "delay": 0, "noise": "output", "uncertainty": how}
            fit = nn([record], told, seed=seed)
            found.append(coverage(fit, true))
            origins[how] = fit.covariance_from
    assert origins == {"auto": "sandwich", "laplace": "information"}
    share = {k: float(np.mean(v)) for k, v in inside.items()}
    assert n.limit(0.9) <= share["auto"] <= 1.0, share  # 0.987 over 50 records
    assert share["laplace"] < 0.88, share


def test_intervals_of_a_free_run_trained_on_it_cover_the_truth() -> None:
    def plant(u: np.ndarray) -> np.ndarray:
        x = np.zeros(u.size)
        for t in range(1, u.size):
            x[t] = 0.8 * x[t - 1] + 0.4 * np.tanh(u[t - 1])
        return x

    u0 = np.random.default_rng(99).standard_normal(60)
    inside: list[np.ndarray] = []
    n = runs(20, short=5)
    for seed in range(100, 100 + n):
        u = np.random.default_rng(seed).standard_normal(600)
        record = data(u, plant(u) + coloured(600, seed, 0.1, 0.8))
        told = {"ny": 1, "nu": 1, "neurons": 2, "focus": "simulation", "held_out": 0.0}
        inside.append(covered(narx([record], told, seed=seed), u0[:, None], plant(u0)[:, None]))
    assert n.limit(0.88) <= float(np.mean(inside)) <= 1.0


def covered(fit: NonlinearFit, U: np.ndarray, Y: np.ndarray) -> np.ndarray:
    """Whether a free run's values are inside their 95 % intervals."""
    assert fit.model is not None
    assert fit.covariance is not None
    theta = fit.model.theta
    both = [
        [fit.model.with_theta(theta + s * h).simulate(U, Y)[5::6, 0] for s in (1, -1)]  # type: ignore[attr-defined]
        for h in 1e-5 * np.eye(theta.size)
    ]
    J = np.stack([(p - m) / 2e-5 for p, m in both], axis=1)
    off = fit.model.simulate(U, Y)[5::6, 0] - Y[5::6, 0]
    return np.asarray(np.abs(off) < 1.96 * np.sqrt(np.einsum("tp,pq,tq->t", J, fit.covariance, J)))


def test_intervals_of_a_free_run_of_physics_with_a_network_cover_the_truth() -> None:
    def plant(u: np.ndarray) -> np.ndarray:
        x = np.zeros(u.size)
        for t in range(1, u.size):
            x[t] = 0.8 * x[t - 1] + 0.5 * np.tanh(1.5 * u[t - 1])
        return x

    u0, inside = 0.75 * np.random.default_rng(99).standard_normal(60), []
    n = runs(12, short=4)
    for seed in range(n):
        u = coloured(600, seed, 0.6, 0.6)
        y = plant(u) + 0.05 * np.random.default_rng(seed).standard_normal(600)
        told = {"states": 1, "delay": 0, "descent": 0, "neurons": 3, "starts": 1}
        fit = nn([data(u, y)], told, seed=seed)
        assert fit.covariance_from == "laplace"
        inside.append(covered(fit, u0[:, None], plant(u0)[:, None]))
        assert any("operating point" in w for w in fit.warnings)
    assert np.mean(inside) > n.limit(0.88), np.mean(inside)  # 0.945 over 20 records


def test_starts_that_fit_as_well_with_other_weights_widen() -> None:
    layout = one_axis(1, gain=False)
    theta = np.random.default_rng(0).standard_normal(layout.n_theta)
    one = State(layout=layout, theta=theta, x0=np.zeros((1, 3)), noise=0.01 * np.eye(2), n_rows=100)
    other = replace(one, theta=theta + 0.3 * np.eye(theta.size)[0], noise=0.0101 * np.eye(2))
    worse = replace(other, noise=0.011 * np.eye(2))
    covariance = 0.01 * np.diag(layout.unit**2)
    extra, told = disagreement(one, [one, other, worse], covariance)
    assert extra[0, 0] == pytest.approx((0.3 * layout.unit[0]) ** 2)
    assert np.count_nonzero(extra) == 1
    assert "a21 by 3.0" in told[0]
    assert disagreement(one, [one, worse], covariance)[1] == ()
