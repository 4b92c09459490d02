"""What is chosen where nothing is said: low-pass of the set point, error models to try, the criterion."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.roots import roots_of

_SLOWER = 5.0  # times the slowest time constant of the linear model: what is frozen may be taken as standing still
_LEAST, _MOST = 10.0, 0.2  # low-pass: samples at least, part of the shortest record at most
_GRID = 3.0
_CLEAR = 10.0  # difference of the criterion from which a faster set point is taken


def information(criterion: str, cost: float, n: int, k: int, starts: int = 0) -> float:
    """Return an information criterion.

    `cost`: sum of squared one-step errors; `n`, `k`: samples and estimated parameters. Returns the smaller the better;
    infinite where there are no more samples than numbers, which fits anything.
    """
    if not np.isfinite(cost) or cost < 0 or n <= k + starts + 1:
        return math.inf
    each = math.log(n) if criterion == "bic" else 2.0
    if criterion == "aicc":
        each *= n / (n - k - 1)
    return n * math.log(max(cost / n, 1e-300)) + k * each + 2.0 * starts


def error_orders(form: str, order: int) -> tuple[tuple[int, int], ...]:
    """Return orders of D and C to try."""
    if order == 0:
        return ((0, 0),)
    found = {"ar": (order, 0), "ma": (0, order), "arma": (order, order)}
    return tuple(found.values()) if form == "auto" else (found[form],)


def time_constants(slowest: float, shortest: int, dt: float) -> list[float]:
    """Return low-passes of the set point to try: slower than the plant, so that it stands still beside its
    movements.

    `slowest`: largest time constant of the linear model, in samples; `shortest`: samples of the shortest record.
    Returns s; one at least.
    """
    top = max(_MOST * shortest, _LEAST)
    low = min(max(_SLOWER * slowest, _LEAST), top)
    return [dt * low * _GRID**k for k in range(12) if low * _GRID**k <= top]


def slowest_that_does(grid: Sequence[float], values: Sequence[float]) -> float:
    """Return the slowest set point that explains the data about as well as the best.

    `values`: criterion of each. Returns s.
    """
    least = min(values)
    return max(x for x, value in zip(grid, values, strict=True) if not value > least + _CLEAR)


def slowest_mode(a: Array) -> float:
    """Return the largest time constant of a polynomial, stable or not.

    `a`: (order + 1,), of q^0, q^-1, . Returns samples.
    """
    z = roots_of(a)
    size = np.abs(np.log(np.where(z == 0, 1e-6, z)))
    return float(1.0 / max(float(size.min()), 1e-6))
