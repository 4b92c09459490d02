"""What a second record says against a fit: judged in Python and by the command's exit code."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.nonlinear.narmax import narmax
from ambid.validation.fits import judge, objections, validation
from tests.nonlinear.systems import smooth


@pytest.fixture(scope="module")
def fit():
    data = smooth()
    return judge(narmax([data], {}), [data])


def test_a_record_of_the_same_plant_has_nothing_against_it(fit):
    assert objections(fit, validation(fit, smooth(seed=1))) == ()


def test_errors_that_have_grown_are_told_with_their_size(fit):
    noisy = smooth(seed=1)
    noisy = replace(noisy, y=noisy.y + 0.2 * np.random.default_rng(0).standard_normal(noisy.y.shape))
    found = validation(fit, noisy)
    times = found["y"]["one_step"]["rmse"] / fit.fit["y"].innovation_sd
    assert times > 3
    assert f"one-step errors of y are {times:.3g} times as large as at identification" in objections(fit, found)


def test_a_record_outside_the_training_data_is_told(fit):
    found = validation(fit, smooth(seed=1))
    far = {"y": {**found["y"], "extrapolated": 0.2}}
    assert any(x.startswith("20 % of it lies outside") for x in objections(fit, far))
    near = {"y": {**found["y"], "extrapolated": 0.1}}
    assert objections(fit, near) == ()


def test_a_prediction_that_runs_away_is_told(fit):
    assert objections(fit, {"y": {"one_step": None, "simulation": None}}) == ("the one-step prediction of y diverges",)
