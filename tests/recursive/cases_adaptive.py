"""The recursive estimators of linear regressions, as the suite over all estimators makes and feeds them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.recursive.regression import (
    Lms,
    Nlms,
    RecursiveArx,
    RecursiveLeastSquares,
)
from tests.recursive.cases import Case

Array = NDArray[np.float64]


def regression(n: int, seed: int) -> tuple[Array, Array]:
    """Regressors with an offset column and correlated columns, four coefficients, noise 0.1."""
    rng = np.random.default_rng([seed, 4])
    draws = rng.normal(size=(n, 4))
    phi = np.column_stack([draws[:, 0], draws[:, 0] + 0.3 * draws[:, 1], 10 * draws[:, 2], np.ones(n)])
    return phi, phi @ [1.0, -2.0, 0.3, 0.5] + 0.1 * draws[:, 3]


def three(n: int, seed: int) -> tuple[Array, Array]:
    """Three of the four."""
    phi, y = regression(n, seed)
    return phi[:, :3], y - 0.5


def loop(n: int, seed: int) -> tuple[Array, Array]:
    """Input and reference, output, of a second-order plant under feedback with coloured noise."""
    rng = np.random.default_rng([seed, 6])
    draws = rng.normal(size=(n, 2))
    u, y = np.zeros(n + 2), np.zeros(n + 2)
    for t in range(2, n + 2):
        v = 0.3 * (draws[t - 2, 1] + 0.9 * (draws[t - 3, 1] if t > 2 else 0.0))
        y[t] = 1.5 * y[t - 1] - 0.6 * y[t - 2] + 0.5 * u[t - 1] + 0.2 * u[t - 2] + v
        u[t] = draws[t - 2, 0] - 0.8 * y[t]
    return np.column_stack([u[2:], draws[:, 0]]), y[2:]


def input_alone(n: int, seed: int) -> tuple[Array, Array]:
    """The same without the reference."""
    inputs, y = loop(n, seed)
    return inputs[:, :1], y


CASES = [
    Case(name="lms", make=lambda: Lms(4, step=0.01), signals=regression),
    Case(name="nlms", make=lambda: Nlms(("a", "b", "c"), step=0.5, small=1e-3), signals=three),
    Case(name="rls", make=lambda: RecursiveLeastSquares(4), signals=regression),
    Case(name="rls-3", make=lambda: RecursiveLeastSquares(3), signals=three),
    Case(name="rls-forgetting", make=lambda: RecursiveLeastSquares(4, memory=100), signals=regression),
    Case(name="rls-forgetting-3", make=lambda: RecursiveLeastSquares(3, factor=0.6), signals=three),
    Case(
        name="arx-rls",
        make=lambda: RecursiveArx(2, 2, offset=True, estimator=lambda names: RecursiveLeastSquares(names, memory=80)),
        signals=input_alone,
    ),
]
