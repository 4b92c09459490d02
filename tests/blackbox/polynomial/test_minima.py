"""Searches that could end in a wrong minimum: fast sampling, slow noise roots, and what is said where one is missed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from ambid.blackbox import polynomial
from ambid.blackbox.data import IOData
from ambid.blackbox.polynomial import missed_minimum
from ambid.blackbox.polynomial_predictor import Layout, predictor, scale_data
from ambid.blackbox.polynomial_search import search, separable_starts, starts
from ambid.physics.linear_model import model
from tests.bearing.benches import BEARING, run
from tests.blackbox.polynomial.systems import SYSTEMS, record


def bearing(seed: int, output: int) -> IOData:
    """One output of the unstable bearing in its loop, sampled at 20 kHz."""
    b = run("bearing", 8000, seed)
    return IOData(
        u=b.signals.u, y=b.signals.y[:, [output]], dt=1 / b.signals.rate_hz, inputs=("voltage",), outputs=("y",),
        units={"voltage": "V", "y": "1"},
    )  # fmt: skip


def layout(name: str, **orders: int) -> Layout:
    of = {k: orders.get(k, 0) for k in ("na", "nc", "nd")}
    return Layout(**of, nb=(orders["nb"],), nf=(orders.get("nf", 0),), nk=(1,))


@pytest.mark.parametrize("seed", [0, 1, 3, 4, 5, 7])
def test_a_levitated_bearing_sampled_fast(seed: int) -> None:
    falling = np.max(np.linalg.eigvals(model("one-axis").matrices(BEARING).A).real)
    truth = np.exp(falling / 20_000)
    position = polynomial.armax(bearing(seed, 0), {"na": 3, "nb": 3, "nc": 3, "nk": 1})
    current = polynomial.armax(bearing(seed, 1), {"na": 4, "nb": 4, "nc": 4, "nk": 1})
    assert position.status == "converged"
    assert np.max(np.abs(position.model.poles())) == pytest.approx(truth, abs=2e-4)
    assert np.max(np.abs(current.model.poles())) == pytest.approx(truth, abs=5e-4)


def test_a_minimum_that_was_missed_is_told() -> None:
    data, of = bearing(0, 0), layout("armax", na=3, nb=3, nc=3)
    scaled = scale_data("armax", data)
    p = predictor(of)
    wrong = search(p, scaled.y[0], scaled.u, next(starts(of, scaled.y[0], scaled.u)))
    right = polynomial.fit_output("armax", of, scaled, 0, {}, None)
    assert wrong.cost > 1.05 * right.cost
    (said,) = missed_minimum([of], [wrong], scaled)
    assert "may have missed a better minimum" in said
    assert not missed_minimum([of], [right], scaled)


def test_no_false_alarm_where_the_search_was_long() -> None:
    found = []
    for seed in range(40):
        system = SYSTEMS["armax"]
        scaled = scale_data("armax", system.data(seed, 400))
        of = layout("armax", na=2, nb=2, nc=2)
        fit = polynomial.fit_output("armax", of, scaled, 0, {}, None)
        found += missed_minimum([of], [replace(fit, iterations=99)], scaled)
    assert not found


def test_starts_from_a_grid_hold_slow_roots() -> None:
    rng = np.random.default_rng(2)
    C = np.poly([0.97, 0.96, 0.1])
    y = lfilter(C, np.poly([0.99, 0.5, -0.2]), rng.standard_normal(4000))
    scaled = scale_data("arma", record(np.empty((4000, 0)), y[:, None], open_loop=True))
    of = Layout(na=3, nb=(), nc=3, nd=0, nf=(), nk=())
    first = next(separable_starts(of, scaled.y[0], scaled.u))
    p = predictor(of)
    rest = [float(p.triangle(scaled.y[0], scaled.u, x, np.zeros(p.n_nuisance))[-1, -1] ** 2)
            for x in (first, next(starts(of, scaled.y[0], scaled.u)))]  # fmt: skip
    assert rest[0] < 1.01 * rest[1]
    assert not list(separable_starts(layout("oe", nb=2, nf=2), scaled.y[0], scaled.y))


@pytest.mark.parametrize("name", ["armax", "ararx", "ararmax", "oe", "bj"])
def test_the_search_ends_as_low_as_from_the_truth(name: str) -> None:
    worse = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(1, 4))
        A = np.poly(rng.uniform(-0.5, 0.97, n))
        B = np.r_[0.0, rng.standard_normal(n)]
        C = np.poly(rng.uniform(-0.8, 0.97, 1)) if name in ("armax", "ararmax", "bj") else np.ones(1)
        D = np.poly(rng.uniform(-0.8, 0.9, 1)) if name in ("ararx", "ararmax", "bj") else np.ones(1)
        u = rng.standard_normal(800)
        plant = "F" if name in ("oe", "bj") else "A"
        e = lfilter(C, np.convolve(A, D) if plant == "A" else D, rng.standard_normal(800))
        g = lfilter(B, A, u)
        y = g + e * np.std(g) / np.std(e) / 2
        scaled = scale_data(name, record(u[:, None], y[:, None], open_loop=True))
        of = layout(name, **{f"n{plant.lower()}": n}, nb=n, nc=C.size - 1, nd=D.size - 1)
        truth = of.start()
        truth[of.places["C", None]], truth[of.places["D", None]] = C, D
        truth[of.places[plant, None if plant == "A" else 0]] = A
        truth[of.places["B", 0]] = B * scaled.u_scale[0] / scaled.y_scale[0]
        there = search(predictor(of), scaled.y[0], scaled.u, truth)
        fit = polynomial.fit_output(name, of, scaled, 0, {}, None)
        worse += fit.cost > there.cost * (1 + 1.0 / fit.n_rows)  # by more than one unit of the log likelihood, twice
    assert worse <= 1
