"""What is left open of a hybrid model: neurons by held-out errors, the order of C by a criterion, terms beside units.

Terms were chosen before there was a network, so that some only imitate it, and others were hidden by what it does. One
at a time, the term goes or comes that the information criterion gains most by; each step searches all numbers anew, and
the criterion falls with every step. A term that the network could take over stays as it is: otherwise units that are to
spare would swallow it, and what can be read would become what cannot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import log
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.estimation.criteria import penalty
from ambid.estimation.linear import information_inverse
from ambid.estimation.progress import Tick, guessed, part_of, portions
from ambid.estimation.search import Found, search
from ambid.nonlinear.blocks import Mask
from ambid.nonlinear.hybrid_function import (
    HybridFunction,
    function_of,
    hybrid_problem,
    random_start,
    transfer,
)
from ambid.nonlinear.lagged_problem import LaggedProblem
from ambid.nonlinear.polynomial import Term
from ambid.nonlinear.records import Parts

Counted = tuple[Mask, ...]
Keep = Callable[[HybridFunction, Array], None]

MOST_NOISE = 4  # largest order of C that is tried where it is left open
SHARED = 10.0  # times a standard deviation grows by the network, from which on a term's value is not its own
_NEURONS = (0, 1, 2, 4, 8)
_STARTED_ON = 12000  # rows from which starts are trained
_MOST_ROWS = 6000  # that a comparison looks at, all stretches together
_BATCHES = 20  # of held-out data, over which squared errors are compared
_SURE = 2.0  # standard errors by which a larger network has to be better
_ROUGH = 0.01  # gain of the cost, errors of unit variance, that no choice depends on
_FIRST = 12  # iterations of every start, with the network alone and then with all numbers
_MOST_STEPS = 40  # of a revision
_MOST_CANDIDATES = 400  # beyond, nothing is added: slopes by all of them at once would be too many


def train_network(
    function: HybridFunction,
    linear: Array,
    parts: Parts,
    prior: float,
    starts: int,
    seed: int,
    tick: Tick | None,
    counted: Counted | None = None,
) -> tuple[Array, Found, LaggedProblem]:
    """Train a network on what polynomial and C (`linear`) leave, then all numbers for a while, from random starts.

    Only the beginning of a long record is looked at. Every other start takes C as 1 and the polynomial as free: what
    this could not do alone has coloured the errors, and gone into the first C. Returns the numbers of the best start,
    and its search with the network alone.
    """
    most = max(_STARTED_ON // len(parts), 10 * function.lag + 60)
    parts = tuple((y[:most], u[:most]) for y, u in parts)
    counted = None if counted is None else tuple(x[:most] for x in counted)
    place = np.arange(function.n_theta)
    level = np.concatenate([linear, np.zeros(function.n_theta - linear.size)])
    coloured = hybrid_problem(function, parts, level, prior, live=place >= function.n_linear, counted=counted)
    in_c = (place >= function.n_terms) & (place < function.n_linear)
    white = coloured.at(np.where(in_c, 0.0, level), ~in_c)
    every = replace(coloured, live=np.ones(function.n_theta, dtype=np.bool_))  # one weight for all
    rng, best, least = np.random.default_rng(seed), None, np.inf
    for k in range(starts):
        alone = white if k % 2 else coloured
        start = random_start(alone, rng)
        share = part_of(tick, k / starts, (k + 1) / starts)
        if share is not None:
            share("network on the residual", 0.0)
        options: dict[str, Any] = {"most": _FIRST, "enough": _ROUGH}
        first, second = part_of(share, 0.0, 0.5), part_of(share, 0.5, 1.0)
        found = search(alone, start[alone.live], stage="network on the residual", tick=first, **options)
        both = search(every, alone.whole(found.theta), stage="starts of all together", tick=second, **options)
        if best is None or both.cost < least:
            best, least = (both.theta, found, alone), both.cost
    assert best is not None
    return best


@dataclass(frozen=True, slots=True, kw_only=True)
class Tried:
    """One candidate."""

    neurons: int
    held_out: float  # root mean square one-step error on held-out data, scaled


def choose_neurons(
    function: HybridFunction, linear: Array, parts: Parts, prior: float, share: float, seed: int, tick: Tick | None
) -> tuple[int, tuple[Tried, ...]]:
    """Choose the number of hidden units by one-step errors on held-out stretches of each record.

    The smallest whose squared errors are not above those of the best by more than two standard errors of the
    difference, taken over batches of time; 0 where no network does better. A long record holds out its end, a short
    one each stretch in turn. The predictor runs through what is held out; only its errors do not count.
    """
    most = max(_MOST_ROWS // len(parts), 10 * function.lag + 60)
    parts = tuple((y[:most], u[:most]) for y, u in parts)
    n = sum(y.shape[0] - function.lag for y, _ in parts)
    folds = int(np.clip(_MOST_ROWS // max(n, 1), 1, round(1.0 / share)))
    if n * share * folds < 2 * _BATCHES:
        return 0, ()
    squares: list[Array] = []
    tried: list[Tried] = []
    for k, h in enumerate(_NEURONS):
        one, found = replace(function, neurons=h), []
        for j in range(folds):
            now = part_of(tick, (k + j / folds) / len(_NEURONS), (k + (j + 1) / folds) / len(_NEURONS))
            held = tuple(_stretch(y.shape[0], function.lag, share, j) for y, _ in parts)
            found.append(_held_out(one, linear, parts, prior, held, seed, now))
        squares.append(np.concatenate(found))
        tried.append(Tried(neurons=h, held_out=float(np.sqrt(np.mean(squares[-1])))))
        if k >= 3 and not any(_better(squares[j], squares[k - 2]) for j in (k, k - 1)):
            break
    best = int(np.argmin([x.held_out for x in tried]))
    fits = next(x for x, e in zip(tried, squares, strict=True) if x is tried[best] or not _better(squares[best], e))
    return fits.neurons, tuple(tried)


def _stretch(n: int, lag: int, share: float, which: int) -> Mask:
    """Samples of a record that are held out: its end, or a stretch of that length before."""
    length = (n - lag) * share
    t = np.arange(n)
    return np.asarray((t >= max(n - (which + 1) * length, lag)) & (t < n - which * length))


def _held_out(
    function: HybridFunction, linear: Array, parts: Parts, prior: float, held: Counted, seed: int, tick: Tick | None
) -> Array:
    """Squared errors of held-out samples after training on the others; infinite where a model diverges."""
    training = tuple(~x for x in held)
    theta = linear
    if function.neurons:
        theta = train_network(function, linear, parts, prior, 2, seed, part_of(tick, 0.0, 0.8), training)[0]
    problem = hybrid_problem(function, parts, theta, prior, counted=training)
    share = part_of(tick, 0.8, 1.0)
    theta = search(problem, theta, stage="choice of neurons", most=_FIRST, enough=_ROUGH, tick=share).theta
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


def choose_noise(
    problem: LaggedProblem, theta: Array, prior: float, criterion: str, tick: Tick | None
) -> tuple[HybridFunction, Array]:
    """Choose the order of C by an information criterion of the one-step errors, all numbers searched anew for each.

    `theta` is the optimum for the order there is; returned is that for the chosen one.
    """
    function = function_of(problem)
    first = max(function.lag, MOST_NOISE)  # for all orders the same errors
    counted = tuple(np.arange(y.shape[0]) >= first for y, _ in problem.parts)

    def value_of(of: HybridFunction, start: Array, share: Tick | None) -> tuple[float, Array]:
        at = replace(hybrid_problem(of, problem.parts, start, prior, counted=counted), weight=problem.weight)
        found = search(at, start, stage="order of the noise model", most=_FIRST, enough=_ROUGH, tick=share)
        n = max(at.n_errors // of.p, 2)
        k = of.n_linear + of.neurons * of.p * of.ne * of.deep
        # orders are nested, not chosen out of many; all outputs' errors count, as all their numbers do
        price = penalty("bic" if criterion == "ebic" else criterion, k, n, max(k, 1))
        return at.n_errors * log(max(found.cost / at.n_errors, 1e-26)) + price, found.theta

    value, theta = value_of(function, theta, part_of(tick, 0.0, 0.2))
    tries = iter(portions(part_of(tick, 0.2, 1.0), [1.0] * (2 * MOST_NOISE)))
    for step in (1, -1):
        better = False
        for _ in range(MOST_NOISE):
            ne = function.ne + step
            if not 0 <= ne <= MOST_NOISE:
                break
            other = replace(function, ne=ne)
            if not other.n_theta:  # a polynomial without terms: only the noise model is left
                break
            trial_value, trial = value_of(other, transfer(function, theta, other), next(tries))
            if not trial_value < value:
                break
            function, theta, value, better = other, trial, trial_value, True
        if better:
            break
    return function, theta


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidates:
    """What terms are chosen from, and how."""

    terms: tuple[Term, ...]
    criterion: str
    prior: float  # of the network's weights

    def price(self, problem: LaggedProblem, count: int) -> float:
        """Return what the last of `count` numbers of polynomial and C costs, in squared errors of unit variance."""
        p = problem.function.n_outputs
        n, m = max(problem.n_errors // p, 2), max(p * len(self.terms), count)
        return penalty(self.criterion, count, n, m) - penalty(self.criterion, count - 1, n, m)

    def search(
        self, problem: LaggedProblem, theta: Array, function: HybridFunction
    ) -> tuple[LaggedProblem, Array, float]:
        """Search all numbers of another function, errors weighted as they were."""
        at = self.at(problem, theta, function)
        found = search(at, at.base, stage="", most=_FIRST, enough=_ROUGH, damping=1e-4)
        return at, found.theta, found.cost

    def at(self, problem: LaggedProblem, theta: Array, function: HybridFunction) -> LaggedProblem:
        """Return the same errors, equally weighted, of another function."""
        start = transfer(function_of(problem), theta, function)
        found = hybrid_problem(function, problem.parts, start, self.prior, counted=problem.counted)
        return replace(found, weight=problem.weight)


def revise(problem: LaggedProblem, theta: Array, candidates: Candidates, keep: Keep, tick: Tick | None) -> None:
    """Revise the terms of the polynomial until the criterion gains by none; `keep` is given each better model.

    `theta` is the optimum, where the problem's errors have unit variance.
    """
    for k in range(_MOST_STEPS):
        if tick is not None:
            tick("terms beside the network", guessed(k, 4.0))
        better = _without_one(problem, theta, candidates) or _with_one(problem, theta, candidates)
        if better is None:
            break
        problem, theta = better
        keep(function_of(problem), theta)


def inflation(R: Array, P: Array, n_linear: int) -> Array:
    """Return by what the network multiplies the standard deviations of polynomial and C, the first `n_linear` numbers.

    `R` is the triangle of the slopes, `P` the inverse of R'R. Ones where they are not determined at all.
    """
    alone, _ = information_inverse(R[:, :n_linear])
    if alone is None:
        return np.ones(n_linear)
    out: Array = np.sqrt(np.diag(P)[:n_linear] / np.diag(alone))
    return out


def _without_one(problem: LaggedProblem, theta: Array, candidates: Candidates) -> tuple[LaggedProblem, Array] | None:
    """Leave out the term that is missed least, if it does not pay and the network could not take it over."""
    function = function_of(problem)
    R = problem.triangle(theta)[:, :-1]
    P, _ = information_inverse(R)
    if P is None:
        return None
    owner = [(o, x) for o, terms in enumerate(function.terms) for x in terms]
    shared = inflation(R, P, function.n_linear) > SHARED
    loss = [
        np.inf if shared[j] or len(function.terms[o]) == 1 else theta[j] ** 2 / P[j, j]
        for j, (o, _) in enumerate(owner)
    ]
    at = int(np.argmin(loss)) if loss else 0
    price = candidates.price(problem, function.n_linear)
    if not loss or not loss[at] < price:
        return None
    o, term = owner[at]
    terms = tuple(tuple(x for x in t if (q, x) != (o, term)) for q, t in enumerate(function.terms))
    smaller, found, cost = candidates.search(problem, theta, replace(function, terms=terms))
    return (smaller, found) if cost - problem.cost(theta) < price else None


def _with_one(problem: LaggedProblem, theta: Array, candidates: Candidates) -> tuple[LaggedProblem, Array] | None:
    """Add the term whose slope, orthogonal to all there are, explains most of the errors, if it pays."""
    function = function_of(problem)
    more = tuple(tuple(x for x in candidates.terms if x not in t) for t in function.terms)
    if not sum(map(len, more)) or sum(map(len, more)) > _MOST_CANDIDATES:
        return None
    richer = replace(function, terms=tuple((*t, *x) for t, x in zip(function.terms, more, strict=True)))
    wide = candidates.at(problem, theta, richer)
    R = wide.triangle(transfer(function, theta, richer))
    known = set(function.names)
    inside = np.array([name in known for name in richer.names])
    Q = np.linalg.qr(R[:, :-1][:, inside])[0]
    rest, left = R[:, -1] - Q @ (Q.T @ R[:, -1]), R[:, :-1][:, ~inside]
    size = np.sum(left**2, axis=0)
    left = left - Q @ (Q.T @ left)
    squared = np.sum(left**2, axis=0)
    alive = squared > 1e-8 * size
    gain = np.where(alive, (left.T @ rest) ** 2 / np.where(alive, squared, 1.0), 0.0)
    price = candidates.price(problem, function.n_linear + 1)
    at = int(np.argmax(gain))
    if not gain[at] > price:
        return None
    o, term = [(o, x) for o, one in enumerate(more) for x in one][at]
    terms = tuple((*t, term) if q == o else t for q, t in enumerate(function.terms))
    larger, found, cost = candidates.search(problem, theta, replace(function, terms=terms))
    return (larger, found) if problem.cost(theta) - cost > price else None
