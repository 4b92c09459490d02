"""What is left open of a hybrid model: neurons by held-out errors, terms and the order of C by a criterion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ambid.identify.hybrid.function import HybridShape
from ambid.identify.hybrid.settings import MOST_NOISE
from ambid.identify.hybrid.train import HybridProblem, Parts, problem_at, random_start
from ambid.identify.narmax.selection import information, penalty
from ambid.identify.networks.search import Found, information_inverse, search
from ambid.identify.nonlinear.progress import Tick, part_of

Array = NDArray[np.float64]

NEURONS = (0, 1, 2, 4, 8)
_MOST_ROWS = 8000  # that a comparison looks at
_BATCHES = 20  # of held-out data, over which squared errors are compared
_SURE = 2.0  # standard errors by which a larger network has to be better
_FIRST = 12  # iterations of every start, with the network alone and then with all numbers


@dataclass(frozen=True, slots=True, kw_only=True)
class Tried:
    """One candidate.

    Attributes
    ----------
    neurons : int
    held_out : float
        Root mean square one-step error on held-out data, scaled.
    """

    neurons: int
    held_out: float


def moved(old: HybridShape, theta: Array, new: HybridShape) -> Array:
    """Return the numbers of another shape: those with the same names are taken over, new ones are zero.

    Parameters
    ----------
    old : HybridShape
    theta : ndarray, shape (n_theta of the old one,)
    new : HybridShape

    Returns
    -------
    ndarray, shape (n_theta of the new one,)
        C is drawn towards zero, its roots all by the same factor, where it would not be invertible.
    """
    known = dict(zip(old.names, theta, strict=True))
    out = np.array([known.get(name, 0.0) for name in new.names], dtype=np.float64)
    return inverted(new, out)[0]


def inverted(shape: HybridShape, theta: Array) -> tuple[Array, float]:
    """Return numbers with an invertible C to start from: all its roots drawn in by one factor where one is outside.

    Parameters
    ----------
    shape : HybridShape
    theta : ndarray, shape (n_theta,)

    Returns
    -------
    theta : ndarray, shape (n_theta,)
        The same where C is invertible.
    factor : float
        1 where nothing was done.
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
    shape: HybridShape, linear: Array, parts: Parts, prior: float, starts: int, seed: int, tick: Tick | None
) -> tuple[Array, Found]:
    """Train a network on what polynomial and C leave, then all numbers for a while, from several random starts.

    Parameters
    ----------
    shape : HybridShape
    linear : ndarray, shape (n_linear,)
        Polynomial and C.
    parts : Parts
    prior : float
    starts : int
    seed : int
    tick : callable or None

    Returns
    -------
    theta : ndarray, shape (n_theta,)
        Of the best start.
    found : Found
        Its search with the network alone.
    """
    rng, best, best_cost, curve = np.random.default_rng(seed), None, np.inf, None
    network = np.arange(shape.n_theta) >= shape.n_linear
    level = np.concatenate([linear, np.zeros(shape.n_theta - linear.size)])
    alone = problem_at(shape, parts, level, prior, live=network)
    every = replace(alone, live=np.ones(shape.n_theta, dtype=np.bool_))  # one set of regressors, one weight for all
    for k in range(starts):
        start = random_start(shape, linear, rng)
        share = part_of(tick, k / starts, (k + 1) / starts)
        if share is not None:
            share("network on the residual", 0.0)
        found = search(
            alone, start[network], stage="network on the residual", most=_FIRST, tick=part_of(share, 0.0, 0.5)
        )
        both = search(
            every, alone.whole(found.theta), stage="starts of all together", most=_FIRST, tick=part_of(share, 0.5, 1.0)
        )
        if best is None or both.cost < best_cost:
            best, best_cost, curve = both.theta, both.cost, found
    assert best is not None
    assert curve is not None
    return best, curve


def chosen_neurons(
    shape: HybridShape, linear: Array, parts: Parts, prior: float, share: float, seed: int, tick: Tick | None
) -> tuple[int, tuple[Tried, ...]]:
    """Choose the number of hidden units by one-step errors on the held-out end of each record.

    The smallest whose squared errors are not above those of the best by more than two standard errors of the
    difference, taken over batches of time; 0 where no network does better.

    Parameters
    ----------
    shape : HybridShape
        Its number of units does not count.
    linear : ndarray, shape (n_linear,)
        Polynomial and C.
    parts : Parts
    prior : float
    share : float
        Held out of each record.
    seed : int
    tick : callable or None

    Returns
    -------
    neurons : int
    tried : tuple of Tried
    """
    most = max(_MOST_ROWS // len(parts), 10 * shape.lag + 60)
    parts = tuple((y[:most], u[:most]) for y, u in parts)
    cuts = [max(round(y.shape[0] * (1.0 - share)), shape.lag + 5) for y, _ in parts]
    training = tuple((y[:c], u[:c]) for (y, u), c in zip(parts, cuts, strict=True))
    if sum(max(y.shape[0] - c, 0) for (y, _), c in zip(parts, cuts, strict=True)) < 2 * _BATCHES:
        return 0, ()
    squares: list[Array] = []
    tried: list[Tried] = []
    for k, h in enumerate(NEURONS):
        now = part_of(tick, k / len(NEURONS), (k + 1) / len(NEURONS))
        one = shape.with_sizes(neurons=h)
        theta = linear
        if h:
            theta, _ = trained(one, linear, training, prior, 2, seed, now)
        problem = problem_at(one, training, theta, prior)
        theta = search(problem, theta, stage="choice of neurons", most=_FIRST, tick=now).theta
        squares.append(_held_out(one, parts, cuts, theta))
        tried.append(Tried(neurons=h, held_out=float(np.sqrt(np.mean(squares[-1])))))
        if k >= 3 and not any(_better(squares[j], squares[i]) for j in (k, k - 1) for i in [k - 2]):
            break
    best = int(np.argmin([x.held_out for x in tried]))
    for x, errors in zip(tried, squares, strict=True):
        if not _better(squares[best], errors):
            return x.neurons, tuple(tried)
    return tried[best].neurons, tuple(tried)


def _held_out(shape: HybridShape, parts: Parts, cuts: list[int], theta: Array) -> Array:
    """Squared errors behind the cuts, in multiples of each output's mean square; infinite where a model diverges."""
    found = []
    for part, cut in zip(parts, cuts, strict=True):
        e = problem_at(shape, (part,), theta, 1.0, first=cut).errors(theta)[0]
        found.append(np.sum(e**2, axis=1))
    out = np.concatenate(found)
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


def pruned(
    problem: HybridProblem, theta: Array, criterion: str, n_candidates: int, keep: Callable[[HybridShape, Array], None]
) -> tuple[HybridProblem, Array, list[str]]:
    """Leave out terms of the polynomial that no longer pay once the network is there.

    Parameters
    ----------
    problem : HybridProblem
        Around `theta`, its errors of unit variance.
    theta : ndarray, shape (n_theta,)
        At the optimum.
    criterion : str
    n_candidates : int
        That the terms were chosen from.
    keep : callable
        Given each smaller model and its numbers, shape (n_theta,).

    Returns
    -------
    problem : HybridProblem
    theta : ndarray, shape (n_theta,)
    dropped : list of str
        Names.
    """
    dropped: list[str] = []
    n = max(problem.n_errors // problem.shape.n_outputs, 2)
    while True:
        shape = problem.shape
        P, _ = information_inverse(problem.triangle(theta)[:, :-1])
        owner = [(o, k) for o, terms in enumerate(shape.terms) for k in range(len(terms)) if len(terms) > 1]
        if P is None or not owner:
            return problem, theta, dropped
        place = {x: j for j, x in enumerate((o, k) for o, t in enumerate(shape.terms) for k in range(len(t)))}
        loss = [theta[place[x]] ** 2 / P[place[x], place[x]] for x in owner]
        o, k = owner[int(np.argmin(loss))]
        count, m = shape.n_linear, max(n_candidates, shape.n_linear)
        if not min(loss) < penalty(criterion, count, n, m) - penalty(criterion, count - 1, n, m):
            return problem, theta, dropped
        terms = tuple(
            tuple(x for j, x in enumerate(t) if (q, j) != (o, k)) for q, t in enumerate(shape.terms)
        )  # fmt: skip
        smaller = replace(shape, terms=terms)
        start = moved(shape, theta, smaller)
        trial = problem_at(smaller, problem.parts, start, problem.prior, first=problem.first)
        trial = replace(trial, weight=problem.weight)
        found = search(trial, start, stage="pruning", most=_FIRST)
        if not found.cost - problem.cost(theta) < penalty(criterion, count, n, m) - penalty(criterion, count - 1, n, m):
            return problem, theta, dropped
        dropped.append(shape.names[place[(o, k)]])
        problem, theta = trial, found.theta
        keep(smaller, theta)


def chosen_noise(problem: HybridProblem, theta: Array, criterion: str, tick: Tick | None) -> tuple[HybridShape, Array]:
    """Choose the order of C by an information criterion of the one-step errors, all numbers searched anew for each.

    Parameters
    ----------
    problem : HybridProblem
    theta : ndarray, shape (n_theta,)
        At the optimum for the order there is.
    criterion : str
    tick : callable or None

    Returns
    -------
    shape : HybridShape
    theta : ndarray, shape (n_theta,)
    """
    first = max(problem.shape.lag, MOST_NOISE)

    def searched(shape: HybridShape, start: Array, share: Tick | None) -> tuple[float, Array]:
        at = problem_at(shape, problem.parts, start, problem.prior, first=first)
        at = replace(at, weight=problem.weight)
        found = search(at, start, stage="order of the noise model", most=_FIRST, tick=share)
        n = max(at.n_errors // shape.n_outputs, 2)
        k = shape.n_linear
        return information(criterion, found.cost / at.n_errors, k, n, max(k, 1)), found.theta

    shape = problem.shape
    value, theta = searched(shape, theta, part_of(tick, 0.0, 0.2))
    for step in (1, -1):
        better = False
        for _ in range(MOST_NOISE):
            ne = shape.ne + step
            if not 0 <= ne <= MOST_NOISE:
                break
            other = shape.with_sizes(ne=ne)
            trial_value, trial = searched(other, moved(shape, theta, other), part_of(tick, 0.2, 1.0))
            if not trial_value < value:
                break
            shape, theta, value, better = other, trial, trial_value, True
        if better:
            break
    return shape, theta
