"""The triangle of lagged samples is that of the whole regressor matrix, however it is cut into blocks."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.signals.delay import lagged_triangle


@pytest.mark.parametrize("n", [9, 500, 20_000])
def test_triangle_is_that_of_all_rows(n: int) -> None:
    rng = np.random.default_rng(0)
    x, y = rng.standard_normal((2, n))
    R = lagged_triangle([(x, 0), (x, 3), (np.ones(n), 0), (y, 5), (y, 0)], 5)
    rows = np.column_stack([x[5:], x[2:-3], np.ones(n - 5), y[:-5], y[5:]])
    assert R.shape == (5, 5)
    assert not np.any(np.tril(R, -1))
    assert pytest.approx(rows.T @ rows, rel=1e-10, abs=1e-10) == R.T @ R
    if n == 9:  # fewer rows than columns
        assert not np.any(R[-1])
