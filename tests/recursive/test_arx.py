"""Regressors from signals, and ARX models on them."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.recursive.regression import RecursiveArx, RecursiveLeastSquares


class Rows:
    """In place of an estimator: keeps the regressors that it is fed with."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names, self.rows = names, np.empty((0, len(names)))

    def update(self, rows: np.ndarray, outputs: np.ndarray) -> np.ndarray:
        self.rows = np.vstack([self.rows, rows])
        return np.zeros(outputs.shape)


def regressor(*orders: object, offset: bool = False) -> tuple[RecursiveArx, Rows]:
    arx = RecursiveArx(*orders, offset=offset, estimator=Rows)  # type: ignore[arg-type]
    return arx, arx._estimator  # type: ignore[return-value]


def test_rows_are_those_of_the_definition_however_the_signals_come() -> None:
    rng = np.random.default_rng(1)
    u, y = rng.normal(size=(50, 2)), rng.normal(size=50)
    arx, whole = regressor(2, [1, 3], [0, 2], offset=True)
    assert arx.names == ("a1", "a2", "b0.0", "b2.1", "b3.1", "b4.1", "offset")
    arx.update(u, y)
    arx, parts = regressor(2, [1, 3], [0, 2], offset=True)
    for part in (slice(0, 1), slice(1, 4), slice(4, None)):
        arx.update(u[part], y[part])
    np.testing.assert_array_equal(parts.rows, whole.rows)
    assert np.isnan(whole.rows[:4]).any(axis=1).all()
    for t in (4, 30):
        expected = [-y[t - 1], -y[t - 2], u[t, 0], u[t - 2, 1], u[t - 3, 1], u[t - 4, 1], 1.0]
        np.testing.assert_array_equal(whole.rows[t], expected)


def test_only_rows_that_need_a_bad_sample_are_spoilt() -> None:
    u, y = np.ones(30), np.ones(30)
    u[10], y[20] = np.nan, np.inf
    arx, found = regressor(1, 2, 1)
    arx.update(u, y)
    bad = np.flatnonzero(~np.isfinite(found.rows).all(axis=1))
    np.testing.assert_array_equal(bad, [0, 1, 10, 11, 12, 20, 21])


def test_orders_and_shapes_are_checked() -> None:
    for na, nb, nk in ((-1, 1, 1), (0, 0, 1), (1, [1, 1], [1])):
        with pytest.raises(EstimationError):
            regressor(na, nb, nk)
    with pytest.raises(EstimationError):
        regressor(1, 1)[0].update(np.ones((3, 2)), np.ones(3))


def test_an_exact_model_is_found() -> None:
    rng = np.random.default_rng(3)
    u, y = rng.normal(size=300), np.zeros(300)
    for t in range(2, 300):
        y[t] = 1.2 * y[t - 1] - 0.5 * y[t - 2] + 0.7 * u[t - 2] + 2.0
    arx = RecursiveArx(2, 1, 2, offset=True, estimator=lambda names: RecursiveLeastSquares(names, prior=1e10))
    arx.update(u, y)
    assert arx.names == ("a1", "a2", "b2", "offset")
    np.testing.assert_allclose(arx.estimate, [-1.2, 0.5, 0.7, 2.0], rtol=1e-5)
    assert arx.n_rejected == 2
