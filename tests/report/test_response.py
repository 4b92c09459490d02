"""Frequency response and poles: exact values, and uncertainty that agrees with drawing parameters at random."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.estimation.estimate import Estimate
from ambid.physics.linear_model import model
from ambid.report.estimate_figures import poles, responses


def moved(estimate: Estimate, values) -> Estimate:
    changes = dict(zip(estimate.covariance_names, values, strict=True))
    return replace(
        estimate, parameters=tuple(replace(p, value=float(changes.get(p.name, p.value))) for p in estimate.parameters)
    )


def centre(estimate):
    return np.array([estimate.parameter(name).value for name in estimate.covariance_names])


def test_the_response_is_that_of_the_equations(stable):
    m, k_x, k_i, R, L = (stable.estimate.parameter(name).value for name in ("m", "k_x", "k_i", "R", "L"))
    r = responses(stable.estimate)
    s = 2j * np.pi * r.frequency_hz
    # thesis eq. 4.8: x (m s² + k_x) = k_i i, V = (R + L s) i + k_i s x
    D = (m * s**2 + k_x) * (R + L * s) + k_i**2 * s
    np.testing.assert_allclose(r.G[:, 0, 0], k_i / D, rtol=1e-6)
    np.testing.assert_allclose(r.G[:, 1, 0], (m * s**2 + k_x) / D, rtol=1e-6)


def test_the_response_spans_a_tenth_of_a_hertz_to_nyquist_and_meets_the_resonance(stable):
    found = responses(stable.estimate)
    assert found.frequency_hz[0] == pytest.approx(0.1)
    assert found.frequency_hz[-1] == pytest.approx(5000.0)
    # a plain grid of 600 points would miss this peak, whose half-width is 1.7 Hz at 639 Hz
    resonance = max(stable.estimate.continuous.poles, key=lambda p: p.imag)
    peak = np.abs(found.G[:, 1, 0]).max()
    assert peak == pytest.approx(1 / (2 * stable.estimate.parameter("L").value * abs(resonance.real)), rel=0.01)


@pytest.mark.parametrize("which", ["stable", "unstable"])
def test_bands_agree_with_parameters_drawn_at_random(which, request):
    estimate = request.getfixturevalue(which).estimate
    rng = np.random.default_rng(3)
    small = replace(estimate, covariance=estimate.covariance * 1e-4)  # where the delta method is exact
    draws = rng.multivariate_normal(centre(estimate), small.covariance, size=1500, method="cholesky")
    here = responses(small, n_frequencies=12)
    plant, s = model(estimate.model), 2j * np.pi * here.frequency_hz[:, None, None]
    logs = []
    for values in draws:
        space = plant.matrices(moved(estimate, values).values)
        logs.append(np.log(space.C @ np.linalg.solve(s * np.eye(3) - space.A, space.B + 0j)))
    logs = np.array(logs)  # (draws, frequencies, outputs, 1)
    np.testing.assert_allclose(logs.real.std(axis=0), here.log_sd, rtol=0.1)
    turned = np.angle(np.exp(1j * (logs.imag - np.angle(here.G))))
    np.testing.assert_allclose(turned.std(axis=0), here.phase_sd, rtol=0.1)


@pytest.mark.parametrize("which", ["stable", "unstable"])
def test_poles_and_their_spread(which, request):
    estimate = request.getfixturevalue(which).estimate
    found = poles(estimate)
    np.testing.assert_allclose(
        sorted(p.value.real for p in found), sorted(estimate.continuous.poles.real), rtol=1e-6, atol=1e-9
    )
    small = estimate.covariance * 1e-4
    rng = np.random.default_rng(4)
    draws = rng.multivariate_normal(centre(estimate), small, size=1500, method="cholesky")
    plant = model(estimate.model)
    sets = [np.linalg.eigvals(plant.matrices(moved(estimate, values).values).A) for values in draws]
    for pole in found:
        near = np.array([p[np.argmin(np.abs(p - pole.value))] for p in sets])
        expected = np.cov(np.stack([near.real, near.imag]))
        sd = np.sqrt(np.diag(pole.covariance)) * 1e-2
        np.testing.assert_allclose(np.sqrt(np.diag(expected)), sd, rtol=0.1, atol=1e-9 * abs(pole.value))


def test_a_double_pole_has_no_delta_method(stable):
    # without spring and coupling the free mass has two poles at zero
    names, values = stable.estimate.covariance_names, centre(stable.estimate)
    free = moved(stable.estimate, [0.0 if n in ("k_i", "k_x") else v for n, v in zip(names, values, strict=True)])
    coil, *double = poles(free)
    assert coil.covariance is not None  # a simple pole keeps its spread
    assert [(p.value, p.covariance) for p in double] == [(0, None), (0, None)]
