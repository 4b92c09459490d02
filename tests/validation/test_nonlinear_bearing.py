"""A nonlinear bearing on a further record: right numbers pass, wrong ones and other places are named."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.validation.nonlinear_bearing import replay, validation
from tests.bearing.magnet.estimates import LEVELS, by_hand, seen


@pytest.fixture(scope="module")
def truth():
    return by_hand({"ball.csv": seen(1), "other.csv": seen(2)})


def test_the_truth_passes_on_a_record_that_it_has_not_seen(truth):
    found = validation(truth, seen(3))
    assert found["passed"], found["checks"]
    assert found["fit"]["position"]["one_step"] > 0.99
    assert found["fit"]["position"]["simulation"] is None
    assert found["samples"] == 4000


def test_innovations_are_as_large_as_the_predictor_expects(truth):
    run = replay(truth, seen(3))
    size = np.mean((run.innovations / run.sd) ** 2, axis=0)
    assert size == pytest.approx([1.0, 1.0], abs=0.08)
    assert run.measured - run.predicted == pytest.approx(run.innovations)


def test_numbers_are_wrong_where_the_force_is_not_the_weight():
    found = validation(by_hand({"ball.csv": seen(1)}, k=1.2), seen(3))["checks"]
    assert not found["carries_its_weight"]["passed"]
    assert found["carries_its_weight"]["relative"] == pytest.approx(0.2, abs=0.01)
    assert "% above the weight" in found["carries_its_weight"]["detail"]


def test_other_resistance_shows_in_the_innovations():
    found = validation(by_hand({"ball.csv": seen(1)}, L_leak=1.5), seen(3))
    assert not found["passed"]
    assert not found["checks"]["residuals_white"]["passed"]


def test_a_place_that_was_not_seen_is_flagged(truth):
    found = validation(truth, seen(4, low=13e-3, high=15e-3))["checks"]["inside_range"]
    assert not found["passed"]
    assert found["outside"] > 0.5
    assert "extrapolates" in found["detail"]


def test_the_noise_of_the_likeliest_record_is_taken(truth):
    loud = {name: 10 * x for name, x in LEVELS.items()}
    assert replay(replace(truth, noise={"ball.csv": loud, "other.csv": LEVELS}), seen(3)).noise_of == "other.csv"
    assert replay(replace(truth, noise={"ball.csv": LEVELS, "other.csv": loud}), seen(3)).noise_of == "ball.csv"
    assert replay(truth, seen(3), noise_of="other.csv").noise_of == "other.csv"


def test_another_rate_or_too_few_samples_are_refused(truth):
    record = seen(3)
    with pytest.raises(EstimationError, match="sampled at 500 Hz, the estimate's predictor at 2000 Hz"):
        replay(truth, replace(record, rate_hz=500.0))
    coil = replace(truth, records=(truth.records[0], {**truth.records[1], "rate_hz": 500.0, "held": True}))
    with pytest.raises(EstimationError, match="predictor at 2000 Hz; the rates"):  # 500 Hz is known of the coil alone
        replay(coil, replace(record, rate_hz=500.0))
    with pytest.raises(EstimationError, match="too few to test"):
        replay(
            truth, replace(record, u=record.u[:40], loose=record.loose[:40], y=record.y[:40], valid=record.valid[:40])
        )
