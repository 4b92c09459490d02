"""The polynomial's terms revised beside the network: terms that stood in for what it does now go, missing ones come.

The terms were chosen before there was a network, so that some only imitate it, and others were hidden by what it does.
One at a time, the term goes or comes that the information criterion gains most by; each step searches all numbers
anew, and the criterion falls with every step. A term that the network could take over stays as it is: otherwise units
that are to spare would swallow it, and what can be read would become what cannot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array
from ambid.estimation.criteria import penalty
from ambid.estimation.linear import information_inverse
from ambid.estimation.progress import Tick, guessed
from ambid.estimation.search import search
from ambid.nonlinear.hybrid.choice import ROUGH, moved
from ambid.nonlinear.hybrid.function import HybridShape
from ambid.nonlinear.hybrid.train import HybridProblem, problem_at
from ambid.nonlinear.narmax.terms import Term

Keep = Callable[[HybridShape, Array], None]

SHARED = 10.0  # times a standard deviation grows by the network, from which on a term's value is not its own
_ITERATIONS = 12
_MOST_STEPS = 40
_MOST_CANDIDATES = 400  # beyond, nothing is added: slopes by all of them at once would be too many


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidates:
    """What terms are chosen from, and how."""

    terms: tuple[Term, ...]
    criterion: str

    def price(self, problem: HybridProblem, count: int) -> float:
        """Return what the last of several numbers costs.

        `count`: numbers of the polynomial and of C. Returns in squared errors of unit variance.
        """
        p = problem.shape.n_outputs
        n, m = max(problem.n_errors // p, 2), max(p * len(self.terms), count)
        return penalty(self.criterion, count, n, m) - penalty(self.criterion, count - 1, n, m)


def revised(problem: HybridProblem, theta: Array, candidates: Candidates, keep: Keep, tick: Tick | None) -> None:
    """Revise the terms of the polynomial until the criterion gains by none.

    `problem`: its errors of unit variance at `theta`; `theta`: (n_theta,), at the optimum; `keep`: given each better
    model and its numbers, shape (n_theta,).
    """
    for k in range(_MOST_STEPS):
        if tick is not None:
            tick("terms beside the network", guessed(k, 4.0))
        better = _without_one(problem, theta, candidates) or _with_one(problem, theta, candidates)
        if better is None:
            break
        problem, theta = better
        keep(problem.shape, theta)


def inflation(R: Array, P: Array, n_linear: int) -> Array:
    """Return by what the network multiplies the standard deviations of polynomial and C.

    `R`: (n_theta + 1 at most, n_theta), triangle without its last column; `P`: (n_theta, n_theta), inverse of R'R;
    `n_linear`: numbers of the polynomial and of C, which come first. Returns (n_linear,), ones where they are not
    determined at all.
    """
    alone, _ = information_inverse(R[:, :n_linear])
    if alone is None:
        return np.ones(n_linear)
    out: Array = np.sqrt(np.diag(P)[:n_linear] / np.diag(alone))
    return out


def _without_one(problem: HybridProblem, theta: Array, candidates: Candidates) -> tuple[HybridProblem, Array] | None:
    """Leave out the term that is missed least, if it does not pay and the network could not take it over."""
    shape = problem.shape
    R = problem.triangle(theta)[:, :-1]
    P, _ = information_inverse(R)
    if P is None:
        return None
    owner = [(o, x) for o, terms in enumerate(shape.terms) for x in terms]
    shared = inflation(R, P, shape.n_linear) > SHARED
    loss = [
        np.inf if shared[j] or len(shape.terms[o]) == 1 else theta[j] ** 2 / P[j, j] for j, (o, _) in enumerate(owner)
    ]
    at = int(np.argmin(loss)) if loss else 0
    price = candidates.price(problem, shape.n_linear)
    if not loss or not loss[at] < price:
        return None
    o, term = owner[at]
    terms = tuple(tuple(x for x in t if (q, x) != (o, term)) for q, t in enumerate(shape.terms))
    smaller, found, cost = _searched(problem, theta, replace(shape, terms=terms))
    return (smaller, found) if cost - problem.cost(theta) < price else None


def _with_one(problem: HybridProblem, theta: Array, candidates: Candidates) -> tuple[HybridProblem, Array] | None:
    """Add the term whose slope, orthogonal to all there are, explains most of the errors, if it pays."""
    shape = problem.shape
    more = tuple(tuple(x for x in candidates.terms if x not in t) for t in shape.terms)
    if not sum(map(len, more)) or sum(map(len, more)) > _MOST_CANDIDATES:
        return None
    richer = replace(shape, terms=tuple((*t, *x) for t, x in zip(shape.terms, more, strict=True)))
    wide = _other(problem, theta, richer)
    R = wide.triangle(moved(shape, theta, richer))
    known = set(shape.names)
    inside = np.array([name in known for name in richer.names])
    Q = np.linalg.qr(R[:, :-1][:, inside])[0]
    rest, left = R[:, -1] - Q @ (Q.T @ R[:, -1]), R[:, :-1][:, ~inside]
    size = np.sum(left**2, axis=0)
    left = left - Q @ (Q.T @ left)
    squared = np.sum(left**2, axis=0)
    alive = squared > 1e-8 * size
    gain = np.where(alive, (left.T @ rest) ** 2 / np.where(alive, squared, 1.0), 0.0)
    price = candidates.price(problem, shape.n_linear + 1)
    at = int(np.argmax(gain))
    if not gain[at] > price:
        return None
    o, term = [(o, x) for o, one in enumerate(more) for x in one][at]
    terms = tuple((*t, term) if q == o else t for q, t in enumerate(shape.terms))
    larger, found, cost = _searched(problem, theta, replace(shape, terms=terms))
    return (larger, found) if problem.cost(theta) - cost > price else None


def _other(problem: HybridProblem, theta: Array, shape: HybridShape) -> HybridProblem:
    """The same errors, equally weighted, of another shape."""
    start = moved(problem.shape, theta, shape)
    return replace(
        problem_at(shape, problem.parts, start, problem.prior, counted=problem.counted), weight=problem.weight
    )


def _searched(problem: HybridProblem, theta: Array, shape: HybridShape) -> tuple[HybridProblem, Array, float]:
    at = _other(problem, theta, shape)
    found = search(at, at.base, stage="", most=_ITERATIONS, enough=ROUGH, damping=1e-4)
    return at, found.theta, found.cost
