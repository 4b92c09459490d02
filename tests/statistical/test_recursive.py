"""Standard deviations of recursive estimators cover the truth; least squares is biased in a loop, instruments are not.

400 runs: the share of 95 % intervals that cover is 0.95 ± 0.011; several coefficients of one run are one draw.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ambid.recursive.estimator import RecursiveEstimator
from ambid.recursive.regression import Lms, Nlms, RecursiveLeastSquares
from tests.tiers import runs

RUNS = runs(400, short=100)
TRUTH = np.array([1.5, -0.7, 1.0, 0.5])
IN_LOOP = np.array([1.5, -0.6, 0.5, 0.2])


def autoregression(n: int, colour: float, feedback: float, truth: np.ndarray) -> tuple[np.ndarray, ...]:
    """Regressors (n, RUNS, 4), outputs and references of all runs at once."""
    rng = np.random.default_rng(11)
    r, w = rng.normal(size=(2, n + 8, RUNS))
    u, y = np.zeros((2, n + 8, RUNS))
    for t in range(2, n + 8):
        v = 0.5 * (w[t] + colour * w[t - 1])
        y[t] = truth[0] * y[t - 1] + truth[1] * y[t - 2] + truth[2] * u[t - 1] + truth[3] * u[t - 2] + v
        u[t] = r[t] - feedback * y[t]
    k = np.arange(8, n + 8)
    past = np.stack([r[k - lag] for lag in range(1, 7)], axis=-1)
    return np.stack([y[k - 1], y[k - 2], u[k - 1], u[k - 2]], axis=-1), y[k], past


def scores(make: Callable[[], RecursiveEstimator], rows: np.ndarray, y: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Errors over standard deviations, (RUNS, p)."""
    out = []
    for run in range(RUNS):
        estimator = make()
        estimator.update(rows[:, run], y[:, run])
        out.append((estimator.estimate - truth) / np.sqrt(np.diag(estimator.covariance)))
    return np.array(out)


@pytest.fixture(scope="module")
def open_loop() -> tuple[np.ndarray, np.ndarray]:
    return autoregression(1200, 0.0, 0.0, TRUTH)[:2]


RECURSIONS = {
    "least squares": lambda: RecursiveLeastSquares(4),
    "memory of 400": lambda: RecursiveLeastSquares(4, memory=400),
    "memory of 50": lambda: RecursiveLeastSquares(4, memory=50),
}


@pytest.mark.parametrize("name", RECURSIONS)
def test_least_squares_knows_its_error(name: str, open_loop: tuple[np.ndarray, np.ndarray]) -> None:
    z = scores(RECURSIONS[name], *open_loop, TRUTH)
    covered = (np.abs(z) < 1.96).mean(axis=0)
    assert ((covered > RUNS.limit(0.915)) & (covered < RUNS.limit(0.98))).all(), covered
    assert (
        np.abs(z.mean(axis=0)) < RUNS.limit(0.25, centre=0)
    ).all()  # a small bias of order 1/n is known of autoregressions


@pytest.mark.parametrize("make", [lambda: Lms(4, step=0.02), lambda: Nlms(4, step=0.1, small=1e-6)])
def test_gradient_recursions_know_their_error(make: Callable[[], RecursiveEstimator]) -> None:
    rng = np.random.default_rng(12)
    phi = rng.normal(size=(1500, RUNS, 4))
    z = scores(make, phi, phi @ TRUTH + 0.5 * rng.normal(size=(1500, RUNS)), TRUTH)
    covered = (np.abs(z) < 1.96).mean(axis=0)
    assert ((covered > RUNS.limit(0.917)) & (covered < RUNS.limit(0.983))).all(), covered
