"""Regressors from signals, and ARX models on them."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.recursive.regression import RecursiveArx, RecursiveIvArx, RecursiveLeastSquares
from tests.recursive.cases_adaptive import input_alone, loop


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
    with pytest.raises(EstimationError, match="instruments"):
        RecursiveIvArx(1, 1, instruments="none")  # type: ignore[arg-type]


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


def test_in_open_loop_coloured_noise_does_no_harm() -> None:
    rng = np.random.default_rng(5)
    n = 20_000
    u, w, y = rng.normal(size=n), rng.normal(size=n), np.zeros(n)
    for t in range(2, n):
        y[t] = 1.2 * y[t - 1] - 0.5 * y[t - 2] + u[t - 1] + 0.4 * u[t - 2] + 0.5 * (w[t] + 0.9 * w[t - 1])
    truth = np.array([-1.2, 0.5, 1.0, 0.4])
    iv = RecursiveIvArx(2, 2, instruments="auxiliary model")
    iv.update(u, y)
    sd = np.sqrt(np.diag(iv.covariance))
    assert (np.abs(iv.estimate - truth) < 3.5 * sd).all()
    assert (sd < 0.02).all()
    plain = RecursiveArx(2, 2, estimator=RecursiveLeastSquares)
    plain.update(u, y)
    assert np.abs(plain.estimate - truth).max() > 5 * sd.max()


def test_a_reference_as_instrument_is_consistent_under_feedback() -> None:
    inputs, y = loop(20_000, 1)
    iv = RecursiveIvArx(2, 2, instruments="reference")
    iv.update(inputs, y)
    truth = np.array([-1.5, 0.6, 0.5, 0.2])
    assert (np.abs(iv.estimate - truth) < 3.5 * np.sqrt(np.diag(iv.covariance))).all()
    plain = RecursiveArx(2, 2, estimator=RecursiveLeastSquares)
    plain.update(inputs[:, 0], y)
    assert np.abs((plain.estimate - truth) / np.sqrt(np.diag(plain.covariance))).max() > 8


@pytest.mark.parametrize("sizes", [(1e3, 1e-6), (1e3, 1e3), (1e-6, 1e6)])
def test_the_units_of_the_signals_do_not_matter(sizes: tuple[float, float]) -> None:
    u, y = input_alone(3000, 2)
    one, other = (RecursiveIvArx(2, 1, instruments="auxiliary model") for _ in range(2))
    one.update(u, y)
    other.update(u * sizes[0], y * sizes[1])
    unit = np.array([1.0, 1.0, sizes[1] / sizes[0]])
    np.testing.assert_allclose(other.estimate, one.estimate * unit, rtol=1e-4)
    np.testing.assert_allclose(other.covariance, one.covariance * np.outer(unit, unit), rtol=1e-3, atol=0)


def test_instruments_made_of_the_input_want_an_open_loop_and_say_so() -> None:
    made = {k: RecursiveIvArx(1, 1, instruments=k) for k in ("reference", "auxiliary model")}
    assert [len(iv.warnings) for iv in made.values()] == [0, 1]
    assert not RecursiveIvArx(1, 1, instruments="auxiliary model", open_loop=True).warnings
