"""Which lags, how many units and how wide, where that is left open: the least that do as well as the best does.

Candidates are compared by their error on held-out data (of the free run, where the model is to simulate), or by an
information criterion of the training errors, in which numbers count as far as the data determine them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.identify.narmax.selection import penalty
from ambid.identify.networks.records import Parts
from ambid.identify.nonlinear.progress import Tick
from ambid.identify.rbf.placing import MIDDLE, NEURONS, Placing, Told, shape_of
from ambid.identify.rbf.shape import RbfShape
from ambid.identify.rbf.weights import Weights

Array = NDArray[np.float64]

_LAGS = (1, 2, 3, 4, 6)
_FIRST = 12  # units with which lags are compared
_WIDTHS = (0.35, 0.7, 1.4, 2.8, 5.6)
_AS_GOOD = 1.02


@dataclass(frozen=True, slots=True, kw_only=True)
class Tried:
    """One candidate.

    Attributes
    ----------
    ny, nu, neurons : int
    width : float
    score : float
        Root mean square error in deviations of the outputs, held out; or what stands for it in a criterion.
    """

    ny: int
    nu: int
    neurons: int
    width: float
    score: float


def split(parts: Parts, share: float, lag: int) -> tuple[Parts, Parts]:
    """Cut the end off each record.

    Parameters
    ----------
    parts : tuple of (outputs, inputs)
    share : float
        Part that is held out; 0 for nothing.
    lag : int
        Samples before the held-out part that it needs as its past.

    Returns
    -------
    training, held_out : Parts
        Empty second where nothing is held out.
    """
    if not share > 0:
        return parts, ()
    cuts = [max(round(y.shape[0] * (1.0 - share)), lag + 1) for y, _ in parts]
    training = tuple((y[:c], u[:c]) for c, (y, u) in zip(cuts, parts, strict=True))
    held = tuple((y[c - lag :], u[c - lag :]) for c, (y, u) in zip(cuts, parts, strict=True))
    return training, held


def error(shape: RbfShape, theta: Array, parts: Parts, *, free: bool = False) -> float:
    """Return the root mean square error.

    Parameters
    ----------
    shape : RbfShape
    theta : ndarray, shape (n_theta,)
    parts : tuple of (outputs, inputs)
    free : bool, optional
        Of the free run.

    Returns
    -------
    float
        In deviations of the outputs; infinite where the model diverges.
    """
    lag = shape.lags.lag
    with np.errstate(over="ignore", invalid="ignore"):
        if free:
            e = [(y - shape.free_run(theta, y, u)[:, : shape.n_outputs])[lag:] for y, u in parts]
        else:
            e = [y[lag:] - shape.values(theta, shape.lags.regressors(y, u)) for y, u in parts]
        found = float(np.sqrt(np.mean(np.concatenate(e) ** 2)))
    return found if np.isfinite(found) else np.inf


def chosen(told: Told, parts: Parts, seed: int, tick: Tick | None) -> tuple[RbfShape, Array, float, tuple[Tried, ...]]:
    """Choose what is left open, and place the units.

    Parameters
    ----------
    told : Told
    parts : tuple of (outputs, inputs), scaled
    seed : int
    tick : callable or None

    Returns
    -------
    shape : RbfShape
    theta : ndarray, shape (n_theta,)
        Centres and widths; weights of zero.
    width : float
    tried : tuple of Tried
    """
    tried: list[Tried] = []
    ny, nu = told.ny, told.nu
    if ny is None or nu is None:
        short = min(y.shape[0] for y, _ in parts)
        lags = [k for k in _LAGS if 3 * (k + told.nk) < short * (told.share or 0.2)] or [1]
        pairs = [(k if told.ny is None else told.ny, k if told.nu is None else told.nu) for k in lags]
        middle, few = told.width or MIDDLE, min(told.neurons or _FIRST, _FIRST)
        seen = []
        for i, (a, b) in enumerate(pairs):
            if tick is not None:
                tick("choice of lags", 0.3 * i / len(pairs))
            seen += _scores(told, parts, a, b, (few,), (middle,), seed)
        tried += seen
        one = _least(seen, told)
        ny, nu = one.ny, one.nu
    neurons, width = told.neurons, told.width
    if neurons is None or width is None:
        widths = _WIDTHS if width is None else (width,)
        counts = NEURONS if neurons is None else (neurons,)
        seen = []
        for i, w in enumerate(widths):
            if tick is not None:
                tick("choice of units", 0.3 + 0.7 * i / len(widths))
            seen += _scores(told, parts, ny, nu, counts, (w,), seed)
        tried += seen
        one = _least(sorted(seen, key=lambda t: t.neurons), told)
        neurons, width = one.neurons, one.width
    placing = Placing(told, shape_of(told, parts, ny, nu, neurons), parts, seed)
    return *placing.theta(neurons, width), width, tuple(tried)


def _scores(
    told: Told, parts: Parts, ny: int, nu: int, counts: Sequence[int], widths: Sequence[float], seed: int
) -> list[Tried]:
    by_criterion = told.choice != "held_out"
    shape = shape_of(told, parts, ny, nu, 0)
    training, held = (parts, ()) if by_criterion else split(parts, told.share or 0.2, shape.lags.lag)
    placing = Placing(told, shape, training, seed)
    out: list[Tried] = []
    for width in widths:
        for count in counts:
            at, found = placing.solved(count, width)
            if by_criterion:
                score = _criterion(told.choice, placing, at, found)
            else:
                score = error(at, found.theta, held, free=told.free)
            out.append(Tried(ny=ny, nu=shape.lags.nu, neurons=at.neurons, width=width, score=score))
    return out


def _criterion(name: str, placing: Placing, shape: RbfShape, found: Weights) -> float:
    """Return a criterion as the error that would have it without any parameter."""
    n, p = placing.y.shape
    square = np.mean((placing.y - shape.values(found.theta, placing.z)) ** 2, axis=0)
    pays = sum(penalty(name, round(k), n, n) for k in found.effective)
    return float(np.exp(0.5 * np.mean(np.log(np.maximum(square, 1e-26))) + 0.5 * pays / (n * p)))


def _least(tried: Sequence[Tried], told: Told) -> Tried:
    """Return the first that is as good as the best; the best itself by a criterion, which has paid for size."""
    best = min(x.score for x in tried)
    slack = _AS_GOOD if told.choice == "held_out" else 1.0
    return next((x for x in tried if x.score <= slack * best), tried[0])
