"""H-infinity: the least bound where it is known in closed form, the gain that a law has, and its loop."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from ambid.control.knobs import Family
from ambid.control.lqg import (
    Generalised,
    SampledPlant,
    central,
    generalised,
    hinf,
    least_bound,
    lqg,
    to_continuous,
    to_discrete,
)
from ambid.errors import EstimationError
from tests.control.test_lqg import of_preset, weights_of


def scalar(a):
    """x' = a x + w1 + u, z = (x, u), y = x + w2 (Doyle and others 1989)."""
    B, C = np.array([[1.0, 0.0, 1.0]]), np.array([[1.0], [0.0], [1.0]])
    D = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    return Generalised(matrices=(np.array([[a]]), B, C, D), n_u=1, n_y=1)


def solution(a, gamma):
    """X = Y of 2 a X - (1 - 1/gamma²) X² + 1 = 0."""
    k = 1.0 - gamma**-2
    return (a + math.sqrt(a**2 + k)) / k


def largest_gain(of, K, points):
    """Peak of the largest singular value from w to z with u = K y, at points z or s."""
    B1, B2, C1, C2, D11, D12, D21, D22 = of.parts()

    def response(A, B, C, D):
        return C @ np.linalg.solve(points[:, None, None] * np.eye(A.shape[0]) - A, B[None] + 0j) + D

    A, k = of.matrices[0], response(*K)
    zw, zu, yw, yu = (response(A, *x) for x in ((B1, C1, D11), (B2, C1, D12), (B1, C2, D21), (B2, C2, D22)))
    closed = zw + zu @ k @ np.linalg.solve(np.eye(yu.shape[1]) - yu @ k, yw)
    return np.max(np.linalg.norm(closed, ord=2, axis=(1, 2)))


@pytest.mark.parametrize("a", [-0.3, 0.0, 0.5, 1.0])
def test_least_bound_of_one_state_is_that_in_closed_form(a):
    exact = brentq(lambda g: solution(a, g) - g, 1.0 + 1e-9, 100.0)  # where the spectral radius of X Y is gamma²
    assert exact == pytest.approx(math.sqrt(2.0)) or a != 0.0
    assert central(scalar(a), 0.9999 * exact) is None
    for factor in (1.0001, 1.2, 5.0):
        K = central(scalar(a), factor * exact)
        s = 1j * np.geomspace(1e-4, 1e4, 400)
        assert largest_gain(scalar(a), K, s) <= factor * exact * (1.0 + 1e-6)


def test_both_maps_keep_the_response():
    rng = np.random.default_rng(1)
    of = rng.standard_normal((4, 4)) / 3.0, rng.standard_normal((4, 2)), rng.standard_normal((3, 4)), np.ones((3, 2))
    for back, x in zip(to_discrete(to_continuous(of)), of, strict=True):
        np.testing.assert_allclose(back, x, atol=1e-12)
    z = np.exp(0.7j)
    s = (z - 1.0) / (z + 1.0)
    A, B, C, D = to_continuous(of)
    at = [c @ np.linalg.solve(p * np.eye(4) - a, b) + d for p, (a, b, c, d) in ((s, (A, B, C, D)), (z, of))]
    np.testing.assert_allclose(*at, atol=1e-12)


@pytest.mark.parametrize("name", ["prototype", "rmit-axis", "thesis"])
def test_law_of_a_bench_keeps_its_bound_where_lqg_does_not(name):
    bench, plant = of_preset(name)
    of, weights = SampledPlant.of(plant), weights_of(bench)
    P = generalised(of, weights, bench.noise, 1.0, 1.0)
    gamma, found = least_bound(replace(P, matrices=to_continuous(P.matrices)))
    z = np.exp(1j * np.geomspace(1e-5, 0.9999 * np.pi, 500))
    assert 0.9 * gamma < largest_gain(P, to_discrete(found), z) <= gamma * (1.0 + 1e-5)
    law, bound = hinf(plant, weights, bench.noise)
    assert bound == gamma
    assert of.largest_pole(law) < 1.0
    assert np.max(np.abs(np.linalg.eigvals(law.A - law.windup @ law.C))) < 1.0
    held = np.linalg.solve(
        np.eye(of.A.shape[0] + law.order) - of.closed(law), np.concatenate([of.E[:, 0], np.zeros(law.order)])
    )
    assert abs(held[0]) < 1e-9 * np.max(np.abs(of.E))  # the integral takes a constant force away
    family = Family(plants=(plant,), noise=(bench.noise.position, bench.noise.current))
    robust, mean = family.figures(law), family.figures(lqg(plant, weights, bench.noise).law)
    assert robust["compliance"] < mean["compliance"]
    assert robust["noise"] > mean["noise"]


def test_a_rotor_and_what_cannot_be_held():
    bench, plant = of_preset("rmit")
    law, _ = hinf(plant, weights_of(bench), bench.noise)
    assert SampledPlant.of(plant).largest_pole(law) < 1.0
    bench, plant = of_preset("prototype")
    dead = replace(plant, theta={**plant.theta, "k_i": 0.0})
    with pytest.raises(EstimationError, match=r"H-infinity law (holds the estimated|does not hold its own) plant"):
        hinf(dead, weights_of(bench), bench.noise)
