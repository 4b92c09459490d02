"""Subspace with the Laguerre operator: exact without noise, honest with it, unstable, several channels, held inputs."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.blackbox import frequency_subspace
from ambid.blackbox.frequency import check_lines
from ambid.blackbox.frequency_subspace import frf_subspace
from ambid.blackbox.model import pole_covariance
from ambid.errors import EstimationError
from tests.blackbox.frequency.responses import RATE, closed_loop, continuous, noisy, plant, poles_of

F = np.linspace(5.0, 2000.0, 120)


@pytest.mark.parametrize("name", ["unstable-bearing", "rmit-axis", "thesis"])
@pytest.mark.parametrize("hold", ["band-limited", "zoh"])
def test_exact_without_noise(name, hold):
    frf = replace(
        noisy(F, plant(name, F, hold=hold, delay=1), 1e-3, 1, hold=hold), G=plant(name, F, hold=hold, delay=1)
    )
    fit = frf_subspace(frf, {"n": 3}, delay=1 / RATE)
    np.testing.assert_allclose(np.sort_complex(fit.model.poles()), poles_of(name), rtol=1e-5, atol=1e-4)
    assert fit.model.dt is None
    assert fit.details["subspace_cost"] < 1e-6  # before the search
    assert fit.details["singular_values"][3] < 1e-5


def four_by_four() -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(3)
    A = np.diag([50.0, -60.0, 0, 0, 0, 0, 0, 0])
    for k, (w, damping) in enumerate(((300.0, 0.1), (900.0, 0.05), (2500.0, 0.03))):
        A[2 + 2 * k : 4 + 2 * k, 2 + 2 * k : 4 + 2 * k] = [[-damping * w, w], [-w, -damping * w]]
    return A, rng.normal(size=(8, 4)), rng.normal(size=(4, 8))


def test_four_by_four_of_order_eight():
    f = np.geomspace(5.0, 1000.0, 80)
    A, B, C = four_by_four()
    G = continuous(A, B, C, 2 * np.pi * f)
    fit = frf_subspace(noisy(f, G, 0.01, 1), {"n": 8})
    s = np.array(fit.details["singular_values"])
    assert s[7] > 10.0
    assert s[8] < 2.0  # the order is plain to see: noise alone is about 1
    assert fit.checks["cost"].passed
    np.testing.assert_allclose(np.sort_complex(fit.model.poles()), np.sort_complex(np.linalg.eigvals(A)), rtol=0.01)
    error = fit.model.frequency_response(2 * np.pi * f) - G
    assert np.sqrt(np.mean(np.abs(error) ** 2 / np.abs(G) ** 2)) < 0.005


def test_intervals_are_honest():
    runs, true, z, cost = 60, poles_of("unstable-bearing"), [], []
    f = np.linspace(5.0, 1000.0, 60)
    G = plant("unstable-bearing", f)
    for seed in range(runs):
        fit = frf_subspace(noisy(f, G, 0.01, seed), {"n": 3})
        order = np.argsort(fit.model.poles())
        sd = np.sqrt(np.diagonal(pole_covariance(fit.model, fit.covariance), axis1=1, axis2=2))[order]
        error = fit.model.poles()[order] - true
        z.append([error[0].real / sd[0, 0], error[0].imag / sd[0, 1], error[2].real / sd[2, 0]])
        cost.append(fit.details["cost"] / fit.details["expected_cost"])
    z = np.array(z)
    assert np.all(np.abs(z.mean(axis=0)) < 3.3 / np.sqrt(runs))
    assert np.all(np.sqrt(np.mean(z**2, axis=0)) < 1.35)
    assert np.all(np.sqrt(np.mean(z**2, axis=0)) > 0.65)
    assert np.mean(cost) == pytest.approx(1.0, abs=0.05)


def test_the_operator_is_what_makes_it_work():
    fit = frf_subspace(noisy(F, plant("unstable-bearing", F), 0.01, 2), {"n": 7})
    assert fit.details["condition"] < 100.0
    assert fit.details["condition_without"] > 1e5
    assert F[0] * 2 * np.pi <= fit.details["p"] <= 20 * np.pi * F[-1]


def test_order_by_itself():
    frf = noisy(F, plant("unstable-bearing", F), 0.01, 2)
    fit = frf_subspace(frf, {"n": "auto"})
    assert fit.orders == {"n": 3}
    assert list(fit.details["bic_by_order"]) == ["1", "2", "3"]


def test_closed_loop_bearing_within_one_percent():
    frf = closed_loop("unstable-bearing", 4, period=16_000, periods=6, rms=3.0).between(5.0, 800.0)
    fit = frf_subspace(frf, {"n": 3}, delay=1 / RATE)
    assert fit.checks["cost"].passed
    np.testing.assert_allclose(np.sort_complex(fit.model.poles()), poles_of("unstable-bearing"), rtol=0.01)


def test_a_direct_path_is_found():
    G = plant("unstable-bearing", F) + np.array([[1e-5], [0.2]])
    fit = frf_subspace(noisy(F, G, 0.01, 3), {"n": 3}, feedthrough=True)
    assert fit.checks["cost"].passed
    assert fit.model.D[1, 0] == pytest.approx(0.2, rel=0.02)


def test_continuous_form_of_a_sampled_model():
    frf = noisy(F, plant("unstable-bearing", F, hold="zoh"), 0.01, 3, hold="zoh")
    s, z = (frf_subspace(frf, {"n": 3}, domain=d) for d in ("s", "z"))
    assert (s.model.dt, z.model.dt) == (None, 1 / RATE)
    np.testing.assert_allclose(
        np.sort_complex(np.log(z.model.poles()) * RATE), np.sort_complex(s.model.poles()), rtol=1e-6
    )
    # the spread goes along: sd of log(z)/T is sd of z over |z| T
    k, j = int(np.argmax(s.model.poles().real)), int(np.argmax(z.model.poles().real))
    one = np.sqrt(pole_covariance(s.model, s.covariance)[k, 0, 0])
    other = np.sqrt(pole_covariance(z.model, z.covariance)[j, 0, 0]) / z.model.poles()[j].real * RATE
    assert one == pytest.approx(other, rel=1e-3)


def test_no_continuous_form_of_a_negative_pole():
    frf = noisy(F, plant("unstable-bearing", F, hold="zoh"), 0.01, 3, hold="zoh")
    model = frf_subspace(frf, {"n": 3}, domain="z").model
    turned = replace(model, A=-model.A)
    assert frequency_subspace.to_continuous(turned, np.zeros((turned.theta.size,) * 2)) is None


def test_units_do_not_matter():
    frf = noisy(F, plant("unstable-bearing", F), 0.02, 5)
    other = replace(frf, frequency_hz=F * 1e-4, G=frf.G * 1e6, covariance=frf.covariance * 1e12, rate_hz=2.0)
    one, two = frf_subspace(frf, {"n": 3}), frf_subspace(other, {"n": 3})
    np.testing.assert_allclose(np.sort_complex(two.model.poles()) * 1e4, np.sort_complex(one.model.poles()), rtol=1e-5)
    np.testing.assert_allclose(two.details["singular_values"][:3], one.details["singular_values"][:3], rtol=1e-6)


def test_a_part_of_a_sample_under_a_hold_is_refused():
    frf = noisy(F, plant("unstable-bearing", F, hold="zoh", delay=0.5), 0.01, 3, hold="zoh")
    with pytest.raises(EstimationError, match="whole samples"):
        frf_subspace(frf, {"n": 3}, delay=0.5 / RATE)


@pytest.mark.parametrize(
    ("orders", "options", "message"),
    [
        ({"n": 0}, {}, "at least 1"),
        ({"na": 2}, {}, "it takes n. Did you mean"),
        ({"n": 3}, {"domain": "z"}, "held"),
        ({"n": 3}, {"delay": -1.0}, "delay"),
        ({"n": 500}, {}, "too few"),
    ],
)
def test_what_breaks_a_rule_is_refused(orders, options, message):
    with pytest.raises(EstimationError, match=message):
        frf_subspace(noisy(F, plant("unstable-bearing", F), 0.02, 5), orders, **options)


def test_the_gauge_carries_no_information():
    frf = noisy(F, plant("unstable-bearing", F), 0.02, 5)
    fit, ln = frf_subspace(frf, {"n": 3}), check_lines(frf, 9)
    T = np.random.default_rng(0).normal(size=(3, 3)) + 2 * np.eye(3)
    turned = fit.model.in_states(T)
    other, _ = frequency_subspace.information(ln, turned, False)
    one, two = pole_covariance(fit.model, fit.covariance), pole_covariance(turned, other)
    np.testing.assert_allclose(two, one, rtol=1e-5, atol=1e-9)
