"""What is chosen where nothing is said: low-pass of the set point, error models to try, the criterion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ambid.identify.blackbox.data import IOData
from ambid.identify.blackbox.roots import roots_of
from ambid.identify.lpv.schedule import LEVEL, schedule_over
from ambid.identify.lpv.shape import LpvShape, part_of
from ambid.identify.lpv.start import least_squares
from ambid.identify.networks.records import Scaled

Array = NDArray[np.float64]

_SLOWER = 5.0  # times the slowest time constant of the linear model: what is frozen may be taken as standing still
_LEAST, _MOST = 10.0, 0.2  # low-pass: samples at least, part of the shortest record at most
_GRID = 3.0
_CLEAR = 10.0  # difference of the criterion from which a faster set point is taken
_EXTRA = 3  # lags of the trial model beyond the order, so that the colour of the noise does not decide


def information(criterion: str, cost: float, n: int, k: int, starts: int = 0) -> float:
    """Return an information criterion.

    Parameters
    ----------
    criterion : {"bic", "aic", "aicc"}
    cost : float
        Sum of squared one-step errors.
    n, k : int
        Samples and estimated parameters.
    starts : int, optional
        Numbers that stand for what was before the records: each takes a few squared errors off whatever the model, and
        counts as for Akaike's criterion.

    Returns
    -------
    float
        The smaller the better.
    """
    if not np.isfinite(cost) or cost < 0:
        return math.inf
    each = math.log(n) if criterion == "bic" else 2.0
    if criterion == "aicc":
        each *= n / (n - k - 1) if n > k + 1 else math.inf
    return n * math.log(max(cost / n, 1e-300)) + k * each + 2.0 * starts


def error_orders(form: str, order: int) -> tuple[tuple[int, int], ...]:
    """Return orders of D and C to try.

    Parameters
    ----------
    form : {"auto", "ar", "ma", "arma"}
    order : int

    Returns
    -------
    tuple of (int, int)
    """
    if order == 0:
        return ((0, 0),)
    found = {"ar": (order, 0), "ma": (0, order), "arma": (order, order)}
    return tuple(found.values()) if form == "auto" else (found[form],)


def chosen_time_constant(shape: LpvShape, records: Sequence[IOData], data: Scaled, first: int) -> float:
    """Choose the low-pass of the set point: the slowest that explains the data about as well as the best.

    Candidates are slower than the plant itself, so that what is identified around a set point stands still for it;
    judged by least squares with a few more lags than asked for.

    Parameters
    ----------
    shape : LpvShape
        Of the equation form.
    records : sequence of IOData
    data : Scaled
    first : int
        Equations count from this sample on.

    Returns
    -------
    float
        s.
    """
    dt, shortest = records[0].dt, min(x.n_samples for x in records)
    trial = replace(shape, order=shape.order + _EXTRA, nb=shape.nb + _EXTRA if shape.columns else 0)
    degree = shape.degree if shape.degree else 2
    first = max(first, trial.first)
    top = max(_MOST * shortest, _LEAST)
    low = min(max(_SLOWER * _slowest(shape, data, first), _LEAST), top)
    grid = [low * _GRID**k for k in range(12) if low * _GRID**k <= top]
    values = []
    for samples in grid:
        of, scheduled = schedule_over(records, LEVEL, -1, samples * dt), replace(trial, degree=degree)
        parts = [
            part_of(scheduled, y[:, 0], u, of.scaled(of.signal(x.u, x.y, dt)))
            for x, (y, u) in zip(records, data.parts, strict=True)
        ]
        n = sum(p.y.size - first for p in parts)
        values.append(information("bic", least_squares(scheduled, parts, first)[1], n, scheduled.n_theta))
    least = min(values)
    return dt * max(x for x, value in zip(grid, values, strict=True) if not value > least + _CLEAR)


def _slowest(shape: LpvShape, data: Scaled, first: int) -> float:
    """Largest time constant of the linear model, in samples."""
    linear = replace(shape, degree=0)
    parts = [part_of(linear, y[:, 0], u, np.zeros(y.shape[0])) for y, u in data.parts]
    theta, cost = least_squares(linear, parts, first)
    if not np.isfinite(cost):
        return _LEAST
    z = roots_of(np.concatenate([[1.0], theta[: shape.order]]))
    size = np.abs(np.log(np.where(z == 0, 1e-6, z)))
    return float(1.0 / max(size.min(), 1e-6))
