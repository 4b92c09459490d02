"""Prediction with models whose predictor is unstable."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.blackbox.model import Offsets, StateSpaceModel
from ambid.blackbox.prediction import one_step

NONE = Offsets(u=np.zeros(1), y=np.zeros(1))


def unstable(pole: float) -> StateSpaceModel:
    """One state, no gain: its predictor is its simulation."""
    one = np.ones((1, 1))
    return StateSpaceModel(A=pole * one, B=one, C=one, D=0 * one, K=0 * one, dt=1.0)


@pytest.mark.parametrize("pole", [1.5, -1.2, 3.0])
def test_a_predictor_that_runs_away_says_nothing(pole: float) -> None:
    rng = np.random.default_rng(1)
    u, y = rng.standard_normal((2000, 1)), rng.standard_normal((2000, 1))
    found = one_step(unstable(pole), u, y, NONE)  # 3^2000 is no number: least squares refused it
    assert found.shape == y.shape
    assert np.all(np.isnan(found))


def test_a_short_record_of_an_unstable_predictor_is_predicted() -> None:
    u = np.random.default_rng(2).standard_normal((40, 1))
    y = np.empty((40, 1))
    x = 0.3
    for t in range(40):
        y[t] = x
        x = 1.1 * x + u[t, 0]
    np.testing.assert_allclose(one_step(unstable(1.1), u, y, NONE), y, rtol=1e-9)
