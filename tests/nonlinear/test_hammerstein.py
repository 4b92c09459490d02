"""Hammerstein models: a known one comes back, spreads are right, outputs that the sensor blurs are fitted freely."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.nonlinear.hammerstein import hammerstein
from tests.nonlinear.test_narx import data


def made(n: int, seed: int, *, noise: float = 0.1, sensor: float = 0.0) -> IOData:
    """y = 1.2 y1 - 0.5 y2 + 0.6 w1 + 0.3 w2, w = u + 0.4 u^2 - 0.2 u^3."""
    rng = np.random.default_rng(seed)
    u, y = rng.uniform(-2, 2, n), np.zeros(n)
    w = u + 0.4 * u**2 - 0.2 * u**3
    for t in range(2, n):
        y[t] = 1.2 * y[t - 1] - 0.5 * y[t - 2] + 0.6 * w[t - 1] + 0.3 * w[t - 2] + noise * rng.standard_normal()
    return data(u, y + sensor * rng.standard_normal(n))


def static(fit, u: np.ndarray) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Its gain at rest as a function of the input, SI, without what does not depend on it."""
    out = []
    for level in u:
        run = fit.model.simulate(np.full((200, 1), level), np.zeros((2, 1)))
        out.append(run[-1, 0])
    return np.array(out) - out[0]


@pytest.mark.parametrize(("focus", "noise", "sensor"), [("prediction", 0.05, 0.0), ("simulation", 0.0, 0.3)])
def test_a_known_model_comes_back(focus: str, noise: float, sensor: float) -> None:
    fit = hammerstein([made(1500, 0, noise=noise, sensor=sensor)], {"focus": focus})
    assert fit.status == "converged"
    assert fit.covariance_from == ("information" if focus == "prediction" else "sandwich")
    np.testing.assert_allclose(fit.model.theta[:2], [1.2, -0.5], atol=0.01)
    u = np.linspace(-2, 2, 9)
    w = u + 0.4 * u**2 - 0.2 * u**3
    np.testing.assert_allclose(static(fit, u), 3.0 * (w - w[0]), atol=0.15)


def test_intervals_cover_the_truth() -> None:
    z = []
    for seed in range(60):
        fit = hammerstein([made(300, seed)], {})
        assert fit.sd is not None
        z.append((fit.model.theta[:2] - [1.2, -0.5]) / fit.sd[:2])
    assert 0.88 <= np.mean(np.abs(z) < 1.96) <= 1.0  # 0.95 with a deviation of 0.02
    assert abs(np.std(z) - 1.0) < 0.2


def test_one_output_and_an_input_are_needed() -> None:
    one = made(100, 1)
    with pytest.raises(EstimationError, match="one output"):
        hammerstein([data(np.empty((100, 0)), one.y)], {})
    with pytest.raises(EstimationError, match="one output"):
        hammerstein([data(one.u, np.hstack([one.y, one.u**2]))], {})
