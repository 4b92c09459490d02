"""Which lags, how many units and how wide, where that is left open: the least that do as well as the best does.

Candidates are compared by their error on held-out data (of the free run, where the model is to simulate), or by an
information criterion of the training errors, in which numbers count as far as the data determine them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array
from ambid.estimation.criteria import penalty
from ambid.estimation.progress import Tick
from ambid.nonlinear.rbf.placing import MIDDLE, NEURONS, Placing, Told, shape_of
from ambid.nonlinear.rbf.shape import RbfShape
from ambid.nonlinear.rbf.weights import Weights
from ambid.nonlinear.records import Parts

_LAGS = (1, 2, 3, 4, 6)
_FIRST = 12  # units with which lags are compared
_WIDTHS = (0.35, 0.7, 1.4, 2.8, 5.6)
_AS_GOOD = 1.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Tried:
    """One candidate."""

    ny: int
    nu: int
    neurons: int
    width: float
    seen: str
    score: float  # root mean square error in deviations of the outputs, held out; or what stands for it in a criterion
    one_step: float  # the same of the predictions, where `score` is that of the free run


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chosen:
    """What was chosen."""

    shape: RbfShape
    theta: Array  # (n_theta,), centres and widths; weights of zero
    width: float
    seen: str
    tried: tuple[Tried, ...]


def split(parts: Parts, share: float, lag: int) -> tuple[Parts, Parts]:
    """Cut the end off each record.

    `share`: part that is held out; 0 for nothing; `lag`: samples before the held-out part that it needs as its past.
    Returns `training, held_out`: empty second where nothing is held out.
    """
    if not share > 0:
        return parts, ()
    cuts = [max(round(y.shape[0] * (1.0 - share)), lag + 1) for y, _ in parts]
    training = tuple((y[:c], u[:c]) for c, (y, u) in zip(cuts, parts, strict=True))
    held = tuple((y[c - lag :], u[c - lag :]) for c, (y, u) in zip(cuts, parts, strict=True))
    return training, held


def error(shape: RbfShape, theta: Array, parts: Parts, *, free: bool = False) -> float:
    """Return the root mean square error.

    `theta`: (n_theta,); `free`: of the free run. Returns in deviations of the outputs; infinite where the model
    diverges.
    """
    lag = shape.lags.lag
    with np.errstate(over="ignore", invalid="ignore"):
        if free:
            e = [(y - shape.free_run(theta, y, u)[:, : shape.n_outputs])[lag:] for y, u in parts]
        else:
            e = [y[lag:] - shape.values(theta, shape.lags.regressors(y, u)) for y, u in parts]
        found = float(np.sqrt(np.mean(np.concatenate(e) ** 2)))
    return found if np.isfinite(found) else np.inf


def chosen(told: Told, parts: Parts, seed: int, tick: Tick | None) -> Chosen:
    """Choose what is left open, and place the units."""
    ny, nu, tried = _lags(told, parts, seed, tick)
    neurons, width, seen = told.neurons, told.width, told.seen
    if neurons is None or width is None or seen is None:
        questions = [
            (which, w)
            for which in (_seen(ny, nu, parts) if seen is None else (seen,))
            for w in (_WIDTHS if width is None else (width,))
        ]
        found: list[Tried] = []
        for i, (which, w) in enumerate(questions):
            if tick is not None:
                tick("choice of units", 0.2 + 0.8 * i / len(questions))
            counts = NEURONS if neurons is None else (neurons,)
            found += _scores(replace(told, seen=which), parts, ny, nu, counts, w, seed)
        tried += found
        one = _least(sorted(found, key=lambda t: t.neurons), told)
        neurons, width, seen = (one.neurons if neurons is None else neurons), one.width, one.seen
    told = replace(told, seen=seen)
    placing = Placing(told, shape_of(told, parts, ny, nu, neurons), parts, seed, most=neurons)
    shape, theta = placing.theta(neurons, width)
    return Chosen(shape=shape, theta=theta, width=width, seen=seen, tried=tuple(tried))


def _lags(told: Told, parts: Parts, seed: int, tick: Tick | None) -> tuple[int, int, list[Tried]]:
    """Choose the lags with few units of middle width that see all of them."""
    if told.ny is not None and told.nu is not None:
        return told.ny, told.nu, []
    short = min(y.shape[0] for y, _ in parts)
    lags = [k for k in _LAGS if 3 * (k + told.nk) < short * (told.share or 0.2)] or [1]
    few, tried = min(_FIRST if told.neurons is None else told.neurons, _FIRST), list[Tried]()
    for i, k in enumerate(lags):
        if tick is not None:
            tick("choice of lags", 0.2 * i / len(lags))
        ny, nu = (k if told.ny is None else told.ny), (k if told.nu is None else told.nu)
        tried += _scores(told, parts, ny, nu, (few,), told.width or MIDDLE, seed)
    one = _least(tried, told)
    return one.ny, one.nu if told.nu is None else told.nu, tried


def _seen(ny: int, nu: int, parts: Parts) -> tuple[str, ...]:
    both = ny > 0 and nu > 0 and parts[0][1].shape[1] > 0
    return ("outputs", "inputs", "all") if both else ("all",)


def _scores(told: Told, parts: Parts, ny: int, nu: int, counts: Sequence[int], width: float, seed: int) -> list[Tried]:
    by_criterion = told.choice != "held_out"
    shape = shape_of(told, parts, ny, nu, 0)
    training, held = (parts, ()) if by_criterion else split(parts, told.share, shape.lags.lag)
    placing = Placing(told, shape, training, seed, most=max(counts))
    out: list[Tried] = []
    for count in counts:
        at, found = placing.solved(count, width)
        if by_criterion:
            score = one_step = _criterion(told.choice, placing, at, found)
        else:
            score = one_step = error(at, found.theta, held)
            if told.free:
                score = error(at, found.theta, held, free=True)
        out.append(
            Tried(
                ny=ny,
                nu=shape.lags.nu,
                neurons=at.neurons,
                width=width,
                seen=told.seen or "all",
                score=score,
                one_step=one_step,
            )
        )
    return out


def _criterion(name: str, placing: Placing, shape: RbfShape, found: Weights) -> float:
    """Return a criterion as the error that would have it without any parameter."""
    n, p = placing.y.shape
    square = np.mean((placing.y - shape.values(found.theta, placing.z)) ** 2, axis=0)
    pays = sum(penalty(name, round(k), n, n) for k in found.effective)
    return float(np.exp(0.5 * np.mean(np.log(np.maximum(square, 1e-26))) + 0.5 * pays / (n * p)))


def _least(tried: Sequence[Tried], told: Told) -> Tried:
    """Return the first that is as good as the best; the best itself by a criterion, which has paid for size."""
    scores = [x.score for x in tried]
    if not np.any(np.isfinite(scores)):  # every free run diverges
        scores = [x.one_step for x in tried]
    slack = _AS_GOOD if told.choice == "held_out" else 1.0
    return tried[next((k for k, x in enumerate(scores) if x <= slack * min(scores)), 0)]
