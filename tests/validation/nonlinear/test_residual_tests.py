"""Residual tests of nonlinear fits: right models pass at the rate that p promises, each defect is found by its test."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.nonlinear.narmax import narmax
from ambid.validation.fits import judge, nonlinear_residuals, run
from ambid.validation.residuals import correlations
from tests.tiers import runs
from tests.validation.nonlinear.plants import io, levitated, output_error, squared

TRUE = {"ny": 1, "nu": 1, "ne": 0, "constant": 0, "selection": "frols"}
TESTS = ("residuals_white", "residuals_uncorrelated", "residuals_nonlinear", "residual_variance", "feedback")
RUNS = runs(80, short=30)


@pytest.fixture(scope="module")
def chances() -> dict[str, list[float]]:
    """p of every test, over many records of a plant that the model can be."""
    found: dict[str, list[float]] = {name: [] for name in TESTS}
    for seed in range(RUNS):
        data = squared(500, seed)
        fit = judge(narmax([data], TRUE), [data])
        for name in TESTS:
            p = fit.checks[name].p
            assert p is not None
            found[name].append(p)
    return found


@pytest.mark.parametrize("name", TESTS)
def test_a_right_model_is_refused_as_often_as_p_says(chances: dict[str, list[float]], name: str) -> None:
    p = np.array(chances[name])
    hits = np.mean(p < 0.1)
    spread = np.sqrt(0.1 * 0.9 / RUNS)
    assert hits < 0.1 + 3.5 * spread
    if name != "residuals_nonlinear":  # joined from two tests by Bonferroni's rule
        assert hits > 0.1 - 3.5 * spread
    assert np.mean(p < 1e-3) < 0.03


def test_a_missing_square_is_found_by_the_nonlinear_test_alone() -> None:
    data = squared(1500, 1)
    fit = judge(narmax([data], {**TRUE, "degree": 1, "constant": 1}), [data])
    assert fit.checks["residuals_white"].passed
    assert fit.checks["residuals_uncorrelated"].passed
    check = fit.checks["residuals_nonlinear"]
    assert not check.passed
    assert "squares of past inputs" in check.detail
    assert check.values["largest_lag"] == 1


def test_noise_that_grows_with_the_input_is_found_by_the_variance_test_alone() -> None:
    data = squared(1500, 2, spread=3.0)
    fit = judge(narmax([data], TRUE), [data])
    assert not fit.checks["residual_variance"].passed
    assert fit.checks["residuals_nonlinear"].passed
    assert fit.checks["residuals_uncorrelated"].passed
    assert not fit.passed


def test_a_missing_linear_lag_is_found() -> None:
    data = squared(1500, 3)
    fit = judge(narmax([data], {**TRUE, "ny": 0}), [data])
    assert not fit.checks["residuals_uncorrelated"].passed
    assert "no fault" in fit.checks["residuals_white"].detail  # a model that looks at no outputs leaves colour open


def test_noise_that_a_predictor_does_not_describe_is_found() -> None:
    data = output_error(1500, 4)
    fit = judge(narmax([data], {**TRUE, "constant": 1}), [data])
    assert not fit.checks["residuals_white"].passed
    described = judge(narmax([data], {**TRUE, "ne": 2}), [data])
    assert described.checks["residuals_white"].passed


def test_feedback_is_seen_in_a_loop_and_not_without() -> None:
    seen = [judge(narmax([x], {}), [x]).checks["feedback"].values["seen"] for x in (levitated(800, 4), squared(800, 4))]
    assert seen == [1.0, 0.0]


def test_bounds_hold_95_percent_of_the_correlations() -> None:
    inside, count = 0, 0
    for seed in range(15):
        data = [squared(400, 1000 + seed), squared(300, 2000 + seed)]
        fit = narmax(data, TRUE)
        prepared = nonlinear_residuals(fit, data, [run(fit, x) for x in data], coloured=False)
        assert prepared is not None
        shown = correlations(prepared, ["u"], ["y"])
        assert [c.title for c in shown] == [
            "e of y, its past", "e of y, u", "e of y, u²", "e of y, e × u", "e² of y, u²",
        ]  # fmt: skip
        for c in shown:
            inside += int(np.sum(np.abs(c.values) <= c.band + 1e-12))
            count += c.values.size
    assert count == 15 * 5 * 20
    assert abs(inside / count - 0.95) < 0.02


def test_a_level_error_at_one_operating_point_is_left_in_the_residuals() -> None:
    low, high = squared(600, 5), squared(600, 6)
    fit = narmax([low], {**TRUE, "degree": 1, "constant": 1})
    assert fit.model is not None
    shifted = io(high.u[:, 0], high.y[:, 0] + 0.3)
    assert not judge(fit, [low, shifted]).checks["residuals_white"].passed


def test_instruments_refuse_right_free_run_models_as_often_as_p_says() -> None:
    p = []
    n = runs(40, short=12)
    for seed in range(n):
        data = output_error(400, seed)
        fit = narmax([data], {"focus": "simulation", "ne": 0, "ny": 1, "nu": 1, "constant": 0})
        p.append([judge(fit, [data]).checks[name].p for name in ("residuals_uncorrelated", "residuals_nonlinear")])
    hits = np.mean(np.array(p, dtype=float) < 0.1, axis=0)
    assert np.all(hits < 0.1 + 3.5 * np.sqrt(0.09 / n))
