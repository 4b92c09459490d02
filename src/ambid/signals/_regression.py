"""Least squares on lagged samples by QR: the autoregressions behind outliers, signal-to-noise ratio and delay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.signals.lagged import lagged_triangle


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Regression:
    """A least-squares fit: coefficients and their sd, shape (n_columns,), residual variance and the number of rows."""

    coefficients: Array
    sd: Array
    variance: float
    n_rows: int


def fit_arx(y: Array, inputs: Sequence[Array], na: int, lags: Sequence[int]) -> Regression:
    """Fit y(t) = -a·y(t-1…t-na) + b·u(t-lags) + constant by QR.

    Columns: `na` of the output, then len(lags) of each input, then the constant. Coefficients hold +y weights (-a).
    """
    reach = max([na, *lags])
    n_columns, n_rows = na + len(lags) * len(inputs) + 1, y.size - reach
    if n_rows <= 2 * n_columns:
        raise EstimationError(
            f"{y.size} samples are too few for a regression on {n_columns} lagged values; it needs more than "
            f"{2 * n_columns + reach}. Use a longer record, or a lower order"
        )
    signals = [y, *inputs]
    sizes = [float(np.linalg.norm(x)) or 1.0 for x in signals]
    past_y, *past = (x / size for x, size in zip(signals, sizes, strict=True))
    columns = [(past_y, lag) for lag in range(1, na + 1)] + [(u, lag) for u in past for lag in lags]
    norms = np.repeat([*sizes, np.sqrt(n_rows)], [na, *(len(lags) for _ in inputs), 1])
    r = lagged_triangle([*columns, (np.full(y.size, 1.0 / norms[-1]), 0), (y, 0)], reach)
    triangle, rhs = r[:n_columns, :n_columns], r[:n_columns, n_columns]
    # A noise-free record makes lagged columns dependent: the smallest norm among all solutions predicts as well.
    u, s, vt = np.linalg.svd(triangle)
    kept = s > s[0] * 1e-12
    inverse = (vt[kept].T / s[kept]) @ u[:, kept].T
    variance = float(r[n_columns, n_columns] ** 2) / (n_rows - int(kept.sum()))
    sd = np.sqrt(variance * np.sum(inverse**2, axis=1)) / norms
    return Regression(coefficients=inverse @ rhs / norms, sd=sd, variance=variance, n_rows=n_rows)
