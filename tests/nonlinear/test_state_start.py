"""State-space networks whose ordinary starts fail: global search finds the plant, and is not used elsewhere; delays."""

from __future__ import annotations

import pytest

from ambid.nonlinear.fit import NonlinearFit
from ambid.nonlinear.nn import nn
from tests.nonlinear.test_state_network import bearing, linearised, sampled


def errors(fit: NonlinearFit) -> dict[str, float]:
    """Relative errors of the weights."""
    assert fit.model is not None
    found = dict(zip(fit.model.names, fit.model.theta, strict=True))
    return {k: abs(found[k] / v - 1.0) for k, v in linearised().items()}


def test_where_every_start_fails_there_is_no_network_and_a_wrong_minimum_is_told() -> None:
    """Small signals in thirty times the usual noise, on which no subspace model leads to a predictor that stays."""
    assert nn([bearing(4000, 1.0, 1, quiet=30.0)], {"delay": 1, "descent": 0}).status == "failed"
    short = nn([bearing(600, 1.0, 2, quiet=30.0)], {"delay": 1, "descent": 0})
    assert any("local minimum" in w for w in short.warnings)
    assert short.noise_covariance[1, 1] > 2.0 * 0.06**2


def test_a_wrong_minimum_is_noticed_in_a_short_record() -> None:
    """One state for a system of two: 70 samples are few for the regression, and enough to see it."""
    record, *_ = sampled(70, 3, noise=0.05)
    fit = nn([record], {"states": 1, "neurons": 0})
    assert any("local minimum" in w for w in fit.warnings)


def test_a_sound_training_is_not_warned_of() -> None:
    fit = nn([bearing(4000, 1.0, 1)], {"delay": 1, "descent": 0})
    assert fit.status == "converged"
    assert max(errors(fit).values()) < 0.01
    assert not any("local minimum" in w for w in fit.warnings)


@pytest.mark.parametrize(("delay", "noise"), [(0, 0.2), (3, 0.01), (12, 0.2)])
def test_the_delay_of_a_stable_plant_is_found(delay: int, noise: float) -> None:
    fit = nn([sampled(1500, 2, noise=noise, delay=delay)[0]], {"descent": 0})
    assert fit.settings["delay"] == delay
    assert fit.settings["states"] == 2


@pytest.mark.parametrize(("n", "amplitude", "quiet"), [(1500, 1.0, 1.0), (4000, 4.0, 1.0), (8000, 4.0, 30.0)])
def test_the_delay_of_an_unstable_plant_under_feedback_is_found(n: int, amplitude: float, quiet: float) -> None:
    fit = nn([bearing(n, amplitude, 1, quiet=quiet)], {"descent": 0, "delay": "auto"})
    assert fit.settings["delay"] == 1
