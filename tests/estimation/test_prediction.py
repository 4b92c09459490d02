"""Prediction and simulation: against a plain filter, the model's own standard deviations, and the definition of fit."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.estimation.likelihood import expected_prediction_sd, innovations, prediction_error, search, simulation_error
from ambid.estimation.predictor import assemble
from ambid.validation.residuals import fit_of
from tests.bearing.benches import problem_of, run
from tests.estimation.reference import sampled

AXIS = ("m", "k_x", "k_i", "R", "L")


def fitted(name, n, seed, names=AXIS, **settings):
    problem, vector = problem_of(run(name, n, seed), estimated=names, **settings)
    return search(problem, vector)


def test_fit_is_one_minus_relative_error():
    y = np.array([[1.0, 10], [2, 20], [3, 30], [4, 50]])
    np.testing.assert_allclose(fit_of(0 * y, y), [1, 1])
    np.testing.assert_allclose(fit_of(y - y.mean(axis=0), y), [0, 0], atol=1e-15)
    e = np.array([[1.0, 0], [0, 0], [0, 0], [0, 0]])
    np.testing.assert_allclose(fit_of(e, y), [1 - 1 / np.sqrt(5.0), 1])
    assert np.isnan(fit_of(np.ones((3, 1)), np.ones((3, 1)))[0])


def plain_predictions(fit, steps):
    """Filter with the gain up to a sample, then go on by the plant alone, one sample after the other."""
    problem, sc = fit.problem, fit.problem.scales
    a, now, _, e, c = sampled(problem, problem.parameters(fit.vector), 0.0)
    push = e @ fit.vector[problem.slices["offset"]]
    gain = assemble(problem, fit.vector, with_derivatives=False).gain
    u, y, d = problem.u / sc.input, problem.y / sc.output, problem.delay
    x, errors = fit.vector[problem.slices["initial"]].copy(), []
    for t in range(problem.skip, y.shape[0] - steps + 1):
        ahead = x
        for j in range(steps - 1):
            ahead = a @ ahead + now @ u[t + j - d] + push
        errors.append(y[t + steps - 1] - c @ ahead)
        x = a @ x + now @ u[t - d] + push + gain @ (y[t] - c @ x)
    return np.array(errors) * sc.output


@pytest.mark.parametrize("steps", [1, 2, 7, 40])
@pytest.mark.parametrize("name", ["bearing", "thesis"])
def test_prediction_errors_are_those_of_a_plain_filter(name, steps):
    fit = fitted(name, 500, 41)
    got, wanted = prediction_error(fit, steps), plain_predictions(fit, steps)
    assert got.shape == wanted.shape == (fit.problem.n_used - steps + 1, 2)
    np.testing.assert_allclose(got, wanted, rtol=1e-6, atol=1e-8 * np.abs(wanted).max(axis=0).max())


@pytest.mark.parametrize(("name", "steps"), [("bearing", 1), ("bearing", 10), ("bearing", 60), ("thesis", 10)])
def test_the_model_knows_how_well_it_predicts(name, steps):
    fit = fitted(name, 16_000, 42)
    rms = np.sqrt(np.mean(prediction_error(fit, steps) ** 2, axis=0))
    # errors of overlapping predictions are correlated over `steps` samples
    tolerance = max(0.03, 4 * np.sqrt(steps / 16_000))
    np.testing.assert_allclose(rms, expected_prediction_sd(fit, steps), rtol=tolerance)


def test_one_step_is_the_innovation():
    fit = fitted("bearing", 2000, 43)
    e = innovations(fit.problem, fit.vector) * fit.problem.scales.output
    np.testing.assert_array_equal(prediction_error(fit, 1), e)
    np.testing.assert_allclose(
        expected_prediction_sd(fit, 1), np.sqrt(np.diag(fit.covariance)) * fit.problem.scales.output, rtol=1e-12
    )


def test_predictions_get_worse_with_distance():
    fit = fitted("bearing", 4000, 44)
    sds = np.array([expected_prediction_sd(fit, k) for k in (1, 5, 20, 80)])
    assert np.all(np.diff(sds, axis=0) > 0)


def test_an_unstable_plant_has_no_simulation():
    assert simulation_error(fitted("bearing", 1000, 45)) is None
    assert simulation_error(fitted("falling rotor", 1000, 45, ("k_x", "k_i"))) is None


def test_simulation_of_a_stable_plant_is_input_alone():
    bench = run("coil", 3000, 46, voltage=1e-4)
    problem, vector = problem_of(bench, estimated=("R", "L"))
    fit = search(problem, vector)
    error = simulation_error(fit)
    # without process noise only the sensor is left
    assert error.std() == pytest.approx(bench.sensor[0], rel=0.08)
    a, now, _, e, c = sampled(problem, problem.parameters(fit.vector), 0.0)
    x, out = fit.vector[problem.slices["initial"]].copy(), []
    for t in range(problem.skip, 3000):
        out.append(problem.y[t] / problem.scales.output - c @ x)
        x = a @ x + now @ (problem.u[t] / problem.scales.input) + e @ fit.vector[problem.slices["offset"]]
    np.testing.assert_allclose(error, np.array(out) * problem.scales.output, rtol=1e-7, atol=1e-10)


def test_simulation_does_not_hang_on_measured_outputs():
    fit = fitted("thesis", 1500, 47)
    before = simulation_error(fit)
    y = fit.problem.y.copy()
    y[700, 0] += 1e-3
    after = simulation_error(replace(fit, problem=replace(fit.problem, y=y)))
    changed = np.flatnonzero(np.any(np.abs(after - before) > 1e-12, axis=1))
    assert changed.tolist() == [700 - fit.problem.skip]


def test_far_ahead_prediction_of_a_stable_plant_becomes_simulation():
    fit = fitted("coil", 1500, 48, ("R", "L"))
    far = 300  # the coil forgets within L/R = 1.2 ms, that is 12 samples
    np.testing.assert_allclose(prediction_error(fit, far), simulation_error(fit)[far - 1 :], rtol=1e-7, atol=1e-9)
