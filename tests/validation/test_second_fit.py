"""What a second record says against a fit: judged in Python and by the command's exit code."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.nonlinear.narmax import narmax
from ambid.validation.fits import judge, second_check, validation
from tests.nonlinear.systems import smooth


@pytest.fixture(scope="module")
def fit():
    data = smooth()
    return judge(narmax([data], {}), [data])


def test_a_record_of_the_same_plant_has_nothing_against_it(fit):
    assert second_check(fit, validation(fit, smooth(seed=1))).passed


def test_errors_that_have_grown_are_told_with_their_size(fit):
    noisy = smooth(seed=1)
    noisy = replace(noisy, y=noisy.y + 0.2 * np.random.default_rng(0).standard_normal(noisy.y.shape))
    found = validation(fit, noisy)
    times = found["y"]["one_step"]["rmse"] / fit.fit["y"].innovation_sd
    assert times > 3
    assert (
        f"one-step errors of y are {times:.3g} times as large as at identification" in second_check(fit, found).detail
    )


def test_a_record_outside_the_training_data_is_told(fit):
    found = validation(fit, smooth(seed=1))
    far = {"y": {**found["y"], "extrapolated": 0.2}}
    assert "20 % of it lies outside" in second_check(fit, far).detail
    near = {"y": {**found["y"], "extrapolated": 0.1}}
    assert second_check(fit, near).passed


def test_a_prediction_that_runs_away_is_told(fit):
    found = second_check(fit, {"y": {"one_step": None, "simulation": None}})
    assert not found.passed
    assert found.detail.endswith("the one-step prediction of y diverges")
