"""What is left open of a hybrid model: neurons by held-out errors, the order of C by a criterion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import log

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.estimation.criteria import penalty
from ambid.estimation.progress import Tick, part_of, portions
from ambid.estimation.search import Found, search
from ambid.nonlinear.fit import LearningCurve
from ambid.nonlinear.hybrid.function import HybridShape
from ambid.nonlinear.hybrid.settings import MOST_NOISE
from ambid.nonlinear.hybrid.train import HybridProblem, Parts, problem_at, random_start

Counted = tuple[NDArray[np.bool_], ...]

NEURONS = (0, 1, 2, 4, 8)
_STARTED_ON = 12000  # rows from which starts are trained
_MOST_ROWS = 6000  # that a comparison looks at, all stretches together
_BATCHES = 20  # of held-out data, over which squared errors are compared
_SURE = 2.0  # standard errors by which a larger network has to be better
ROUGH = 0.01  # gain of the cost, errors of unit variance, that no choice hangs on
_FIRST = 12  # iterations of every start, with the network alone and then with all numbers


@dataclass(frozen=True, slots=True, kw_only=True)
class Tried:
    """One candidate."""

    neurons: int
    held_out: float  # root mean square one-step error on held-out data, scaled


def moved(old: HybridShape, theta: Array, new: HybridShape) -> Array:
    """Return the numbers of another shape: those with the same names are taken over, new ones are zero.

    `theta`: (n_theta of the old one,). Returns (n_theta of the new one,), C is drawn towards zero, its roots all by the
    same factor, where it would not be invertible.
    """
    known = dict(zip(old.names, theta, strict=True))
    out = np.array([known.get(name, 0.0) for name in new.names], dtype=np.float64)
    return inverted(new, out)[0]


def inverted(shape: HybridShape, theta: Array) -> tuple[Array, float]:
    """Return numbers with an invertible C to start from: all its roots drawn in by one factor where one is outside.

    `theta`: (n_theta,). Returns `theta`: (n_theta,), the same where C is invertible; `factor`: 1 where nothing was
    done.
    """
    radius = shape.noise_radius(theta)
    if shape.deep or not radius >= 1.0:
        return theta, 1.0
    p, out, factor = shape.n_outputs, theta.copy(), 0.95 / radius if np.isfinite(radius) else 0.0
    C = shape.parts(theta)[1].copy()
    for k in range(shape.ne):
        C[:, k * p : (k + 1) * p] *= factor ** (k + 1)
    first = shape.sizes[0]
    out[first : first + C.size] = np.where(np.isfinite(C), C, 0.0).ravel()
    return out, factor


def trained(
    shape: HybridShape,
    linear: Array,
    parts: Parts,
    prior: float,
    starts: int,
    seed: int,
    tick: Tick | None,
    counted: Counted | None = None,
) -> tuple[Array, LearningCurve]:
    """Train a network on what polynomial and C leave, then all numbers for a while, from several random starts.

    Only the begin of a long record is looked at. Every other start takes C as 1 and the polynomial as free: what this
    could not do alone has coloured the errors, and gone into the first C.

    `linear`: (n_linear,), polynomial and C; `counted`: (n_samples,), samples of each record that are trained on; all of
    them without. Returns `theta`: (n_theta,), of the best start; `curve`: of its search with the network alone.
    """
    most = max(_STARTED_ON // len(parts), 10 * shape.lag + 60)
    parts = tuple((y[:most], u[:most]) for y, u in parts)
    counted = None if counted is None else tuple(x[:most] for x in counted)
    rng, best, best_cost, curve = np.random.default_rng(seed), None, np.inf, None
    place = np.arange(shape.n_theta)
    level = np.concatenate([linear, np.zeros(shape.n_theta - linear.size)])
    coloured = problem_at(shape, parts, level, prior, live=place >= shape.n_linear, counted=counted)
    in_c = (place >= shape.sizes[0]) & (place < shape.n_linear)
    white = coloured.at(np.where(in_c, 0.0, level), ~in_c)
    every = replace(coloured, live=np.ones(shape.n_theta, dtype=np.bool_))  # one weight for all
    for k in range(starts):
        alone = white if k % 2 else coloured
        start = random_start(alone, rng)
        share = part_of(tick, k / starts, (k + 1) / starts)
        if share is not None:
            share("network on the residual", 0.0)
        found = search(
            alone,
            start[alone.live],
            stage="network on the residual",
            most=_FIRST,
            enough=ROUGH,
            tick=part_of(share, 0.0, 0.5),
        )
        both = search(
            every,
            alone.whole(found.theta),
            stage="starts of all together",
            most=_FIRST,
            enough=ROUGH,
            tick=part_of(share, 0.5, 1.0),
        )
        if best is None or both.cost < best_cost:
            best, best_cost, curve = both.theta, both.cost, learning(found, alone, "network on the residual")
    assert best is not None
    assert curve is not None
    return best, curve


def learning(found: Found, problem: HybridProblem, stage: str) -> LearningCurve:
    """Return how a search went."""
    noise = np.linalg.inv(problem.weight) if np.isfinite(found.cost) else np.ones((1, 1))  # its square root
    size = float(np.sqrt(np.sum(noise**2) / noise.shape[0]))
    return LearningCurve(
        method=f"{stage}: Levenberg-Marquardt, prediction errors",
        seconds=np.array(found.seconds),
        training=np.sqrt(np.array(found.costs) / max(problem.n_errors, 1)) * size,
    )


def chosen_neurons(
    shape: HybridShape, linear: Array, parts: Parts, prior: float, share: float, seed: int, tick: Tick | None
) -> tuple[int, tuple[Tried, ...]]:
    """Choose the number of hidden units by one-step errors on held-out stretches of each record.

    The smallest whose squared errors are not above those of the best by more than two standard errors of the
    difference, taken over batches of time; 0 where no network does better. A long record holds out its end, a short
    one each stretch in turn. The predictor runs through what is held out; only its errors do not count.

    `shape`: its number of units does not count; `linear`: (n_linear,), polynomial and C; `share`: held out of each
    record at a time.
    """
    most = max(_MOST_ROWS // len(parts), 10 * shape.lag + 60)
    parts = tuple((y[:most], u[:most]) for y, u in parts)
    n = sum(y.shape[0] - shape.lag for y, _ in parts)
    folds = int(np.clip(_MOST_ROWS // max(n, 1), 1, round(1.0 / share)))
    if n * share * folds < 2 * _BATCHES:
        return 0, ()
    squares: list[Array] = []
    tried: list[Tried] = []
    for k, h in enumerate(NEURONS):
        one, found = shape.with_sizes(neurons=h), []
        for j in range(folds):
            now = part_of(tick, (k + j / folds) / len(NEURONS), (k + (j + 1) / folds) / len(NEURONS))
            held = tuple(_stretch(y.shape[0], shape.lag, share, j) for y, _ in parts)
            found.append(_held_out(one, linear, parts, prior, held, seed, now))
        squares.append(np.concatenate(found))
        tried.append(Tried(neurons=h, held_out=float(np.sqrt(np.mean(squares[-1])))))
        if k >= 3 and not any(_better(squares[j], squares[k - 2]) for j in (k, k - 1)):
            break
    best = int(np.argmin([x.held_out for x in tried]))
    fits = next(x for x, e in zip(tried, squares, strict=True) if x is tried[best] or not _better(squares[best], e))
    return fits.neurons, tuple(tried)


def _stretch(n: int, lag: int, share: float, which: int) -> NDArray[np.bool_]:
    """Samples of a record that are held out: its end, or a stretch of that length before."""
    length = (n - lag) * share
    t = np.arange(n)
    return (t >= max(n - (which + 1) * length, lag)) & (t < n - which * length)


def _held_out(
    shape: HybridShape, linear: Array, parts: Parts, prior: float, held: Counted, seed: int, tick: Tick | None
) -> Array:
    """Squared errors of held-out samples after training on the others; infinite where a model diverges."""
    training = tuple(~x for x in held)
    theta = linear
    if shape.neurons:
        theta, _ = trained(shape, linear, parts, prior, 2, seed, part_of(tick, 0.0, 0.8), training)
    problem = problem_at(shape, parts, theta, prior, counted=training)
    theta = search(
        problem, theta, stage="choice of neurons", most=_FIRST, enough=ROUGH, tick=part_of(tick, 0.8, 1.0)
    ).theta
    errors = np.concatenate(replace(problem, counted=held).errors(theta))
    out = np.sum(errors**2, axis=1)
    return np.where(np.isfinite(out), out, np.inf)


def _better(one: Array, other: Array) -> bool:
    """Whether squared errors are surely below others."""
    if not np.all(np.isfinite(one)):
        return False
    if not np.all(np.isfinite(other)):
        return True
    batches = min(_BATCHES, one.size)
    gains = np.array([np.mean(x) for x in np.array_split(other - one, batches)])
    return bool(np.mean(gains) > _SURE * np.std(gains, ddof=1) / np.sqrt(batches))


def chosen_noise(problem: HybridProblem, theta: Array, criterion: str, tick: Tick | None) -> tuple[HybridShape, Array]:
    """Choose the order of C by an information criterion of the one-step errors, all numbers searched anew for each.

    `theta`: (n_theta,), at the optimum for the order there is. Returns `theta`: (n_theta,).
    """
    first = max(problem.shape.lag, MOST_NOISE)  # for all orders the same errors
    counted = tuple(np.arange(y.shape[0]) >= first for y, _ in problem.parts)

    def searched(shape: HybridShape, start: Array, share: Tick | None) -> tuple[float, Array]:
        at = problem_at(shape, problem.parts, start, problem.prior, counted=counted)
        at = replace(at, weight=problem.weight)
        found = search(at, start, stage="order of the noise model", most=_FIRST, enough=ROUGH, tick=share)
        n = max(at.n_errors // shape.n_outputs, 2)
        k = shape.n_linear + shape.neurons * shape.n_deep
        # orders are nested, not chosen out of many; all outputs' errors count, as all their numbers do
        price = penalty("bic" if criterion == "ebic" else criterion, k, n, max(k, 1))
        return at.n_errors * log(max(found.cost / at.n_errors, 1e-26)) + price, found.theta

    shape = problem.shape
    value, theta = searched(shape, theta, part_of(tick, 0.0, 0.2))
    tries = iter(portions(part_of(tick, 0.2, 1.0), [1.0] * (2 * MOST_NOISE)))
    for step in (1, -1):
        better = False
        for _ in range(MOST_NOISE):
            ne = shape.ne + step
            if not 0 <= ne <= MOST_NOISE:
                break
            other = shape.with_sizes(ne=ne)
            if not other.n_theta:  # a polynomial without terms: only the noise model is left
                break
            trial_value, trial = searched(other, moved(shape, theta, other), next(tries))
            if not trial_value < value:
                break
            shape, theta, value, better = other, trial, trial_value, True
        if better:
            break
    return shape, theta
