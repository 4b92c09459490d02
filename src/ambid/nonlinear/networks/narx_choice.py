"""Which lags and how many neurons a neural NARX model gets, where that is left open: the smallest that predict held-out
data as well as the best does, within a few per cent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.estimation.progress import Tick
from ambid.estimation.search import search
from ambid.nonlinear.networks.narx_function import NarxShape
from ambid.nonlinear.networks.narx_train import NarxProblem, linear_start, random_start
from ambid.nonlinear.records import Parts

_LAGS = (1, 2, 3, 4, 6)
_NEURONS = (2, 4, 8, 12)
_FIRST_NEURONS = 4  # with which lags are compared
_AS_GOOD = 1.02
_MOST_ROWS = 6000  # that a comparison looks at
_ITERATIONS = 15


@dataclass(frozen=True, slots=True, kw_only=True)
class Tried:
    """One candidate."""

    ny: int
    nu: int
    neurons: int
    held_out: float  # root mean square one-step error on held-out data, in deviations of the outputs


def split(parts: Parts, share: float, lag: int) -> tuple[Parts, Parts]:
    """Cut the end off each record.

    `share`: part that is held out; 0 for nothing; `lag`: samples before the held-out part that it needs as its past.
    Returns `training, held_out`: empty second where nothing is held out.
    """
    if not share > 0:
        return parts, ()
    training, held = [], []
    for y, u in parts:
        cut = max(round(y.shape[0] * (1.0 - share)), lag + 1)
        training.append((y[:cut], u[:cut]))
        held.append((y[cut - lag :], u[cut - lag :]))
    return tuple(training), tuple(held)


def held_out_error(shape: NarxShape, parts: Parts, theta: Array, *, free: bool = False) -> float:
    """Return the root mean square error on held-out data.

    `theta`: (n_theta,); `free`: of the free run. Returns in deviations of the outputs; infinite where the model
    diverges.
    """
    problem = NarxProblem(shape=shape, parts=parts, weight=np.ones(shape.n_outputs), prior=1.0, free=free)
    with np.errstate(over="ignore", invalid="ignore"):
        found = float(np.sqrt(np.mean(np.concatenate(problem.errors(theta)) ** 2)))
    return found if np.isfinite(found) else np.inf


def chosen_sizes(
    parts: Parts,
    open_sizes: tuple[int | None, int | None, int | None],
    *,
    nk: int,
    share: float,
    prior: float,
    seed: int,
    tick: Tick | None,
) -> tuple[int, int, int, tuple[Tried, ...]]:
    """Choose what is left open of lags and neurons.

    `open_sizes`: none where left open; `share`: held out of each record.
    """
    ny, nu, neurons = open_sizes
    n_u = parts[0][1].shape[1]
    short = min(y.shape[0] for y, _ in parts)
    tried: list[Tried] = []

    def run(a: int, b: int, h: int) -> Tried:
        if tick is not None:
            tick("choice of lags and neurons", len(tried) / (len(_LAGS) + len(_NEURONS)))
        shape = NarxShape(n_outputs=parts[0][0].shape[1], n_inputs=n_u, ny=a, nu=b if n_u else 0, nk=nk, neurons=h)
        found = Tried(ny=a, nu=shape.nu, neurons=h, held_out=_compared(shape, parts, share, prior, seed))
        tried.append(found)
        return found

    if ny is None or nu is None:
        lags = [k for k in _LAGS if 3 * (k + nk) < short * share] or [1]
        seen = [run(ny or k, k if nu is None else nu, neurons or _FIRST_NEURONS) for k in lags]
        one = _smallest(seen)
        ny, nu = one.ny, one.nu
    if neurons is None:
        neurons = _smallest([run(ny, nu, h) for h in _NEURONS]).neurons
    return ny, nu if n_u else 0, neurons, tuple(tried)


def _smallest(tried: Sequence[Tried]) -> Tried:
    best = min(x.held_out for x in tried)
    return next((x for x in tried if x.held_out <= _AS_GOOD * best), tried[0])


def _compared(shape: NarxShape, parts: Parts, share: float, prior: float, seed: int) -> float:
    """Held-out error after a short training on part of the data."""
    most = max(_MOST_ROWS // len(parts), 4 * shape.lag + 40)
    training, held = split(tuple((y[:most], u[:most]) for y, u in parts), share, shape.lag)
    start = random_start(shape, linear_start(shape, training), np.random.default_rng(seed))
    problem = problem_at(shape, training, start, prior)
    found = search(
        problem, start, stage="", most=_ITERATIONS, held_out=lambda t: held_out_error(shape, held, t), slack=0.0,
        solved=problem.solved, n_linear=problem.n_linear,
    )  # fmt: skip
    return min(found.held_out)


def problem_at(shape: NarxShape, parts: Parts, theta: Array, prior: float, *, free: bool = False) -> NarxProblem:
    """Return the problem whose errors have unit variance at given weights.

    `theta`: (n_theta,).
    """
    one = NarxProblem(shape=shape, parts=parts, weight=np.ones(shape.n_outputs), prior=prior, free=free)
    with np.errstate(over="ignore", invalid="ignore"):
        size = np.sqrt(np.mean(np.concatenate(one.errors(theta)) ** 2, axis=0))
    size = np.where(np.isfinite(size), np.maximum(size, 1e-7), 1.0)
    return NarxProblem(shape=shape, parts=parts, weight=1.0 / size, prior=prior, free=free)
