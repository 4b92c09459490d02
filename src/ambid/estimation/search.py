"""One damped Gauss-Newton (Levenberg-Marquardt) search for all estimators, on triangles (More 1978; Nocedal and Wright
2006, sec. 10.3).

A problem gives its criterion at a vector, and there the triangle of [J | r]: a step d lowers the criterion by about
|r|² - |r - J d|². For least squares J is the slope of the prediction and r = target - prediction, both weighted to
unit variance; for a likelihood JᵀJ is the information matrix and Jᵀr minus half the gradient. Priors and penalties are
rows like others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Literal, Protocol

import numpy as np

from ambid.arrays import Array
from ambid.estimation.linear import directions, triangle_of
from ambid.estimation.progress import Tick, guessed

Status = Literal["converged", "stalled", "failed"]

_USUAL = 10.0  # iterations, roughly, of a search
_MOST_DAMPED = 1e9
_PATIENCE = 6  # iterations in a row in which held-out errors may grow


class Problem(Protocol):
    """What is searched in."""

    def cost(self, theta: Array) -> float:
        """Return the criterion, infinite where the model diverges.

        `theta`: (n_theta,). For least squares the sum of squared rows.
        """
        ...

    def triangle(self, theta: Array) -> Array:
        """Return the triangle of [J | r], (at most n_theta + 1, n_theta + 1).

        `theta`: (n_theta,); where `cost` was asked for last, or before.
        """
        ...


class Rows:
    """A problem of least squares whose rows are few enough to be held: residual e(theta) and its slope."""

    def __init__(self, residual: Callable[[Array], Array], slope: Callable[[Array], Array]) -> None:
        self.residual, self.slope = residual, slope

    def cost(self, theta: Array) -> float:
        """Return the sum of squares."""
        with np.errstate(over="ignore", invalid="ignore"):
            e = self.residual(theta)
            cost = float(e @ e)
        return cost if np.isfinite(cost) else np.inf

    def triangle(self, theta: Array) -> Array:
        """Return the triangle of the slope and the residual, its sign turned."""
        return triangle_of([np.column_stack([self.slope(theta), -self.residual(theta)])])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Found:
    """Where a search ended."""

    theta: Array  # (n_theta,), with the least cost, or with the least held-out error where training went on beyond it
    cost: float  # of `theta`; infinite where the start already diverges
    converged: bool
    stopped_early: bool  # whether `theta` is that of the least held-out error, the training having gone beyond it
    interrupted: bool  # by KeyboardInterrupt, where the search was asked to keep its best
    seconds: tuple[float, ...]  # of each accepted step
    costs: tuple[float, ...]
    held_out: tuple[float, ...]

    @property
    def status(self) -> Status:
        """How it ended."""
        return "converged" if self.converged else "stalled" if np.isfinite(self.cost) else "failed"


def search(
    problem: Problem,
    theta: Array,
    *,
    stage: str = "search",
    most: int = 50,
    tolerance: float = 1e-8,
    enough: float = 0.0,
    settled: float = 0.0,
    damping: float = 1e-3,
    upper: Array | None = None,
    longest: float = np.inf,
    move: Callable[[Array, Array], Array | None] | None = None,
    held_out: Callable[[Array], float] | None = None,
    slack: float = 0.02,
    tick: Tick | None = None,
    keep: Callable[[Array], None] | None = None,
    solved: Callable[[Array], Array] | None = None,
    n_linear: int = 0,
    keep_best: bool = False,
) -> Found:
    """Search for the least criterion.

    `theta`: (n_theta,), start; `stage`: for `tick`; `most`: iterations; `tolerance`, `enough`: relative and absolute
    gain of a step below which the search is over; `settled`: what a full step promises below which it is over, in the
    criterion's unit (squared Newton decrement: the step's squared length in standard deviations);
    `damping`: at the beginning, for columns of unit length; small where the start is
    good; `upper`: (n_theta,), bounds; what stands at its bound and would go beyond rests; `longest`: change of any
    number in one step; `move`: takes a step along J's columns from a vector, by its own rules (shortened, projected, in
    a tangent space), None where it cannot; `held_out`: error on other data; training ends where it grows; `tick`:
    called before each iteration, with the share of this search that is over; `keep`: given each better vector;
    `solved`: sets the first `n_linear` numbers, which enter linearly, to their best; `keep_best`: a KeyboardInterrupt
    ends in the best so far.
    """
    began, converged, interrupted = perf_counter(), False, False
    theta = theta if upper is None else np.minimum(theta, upper)
    if solved is not None:
        theta = solved(theta)
    cost = problem.cost(theta)
    seconds, costs = [0.0], [cost]
    held = [held_out(theta)] if held_out is not None else []
    best_held, best_theta, worse = (held[0] if held else np.inf), theta, 0
    how = _How(
        problem=problem,
        upper=upper,
        longest=longest,
        move=move,
        solved=solved,
        n_linear=n_linear,
        settled=settled,
    )
    try:
        for k in range(most):
            if tick is not None:
                tick(stage, max(k / most, guessed(k, _USUAL)))
            if not np.isfinite(cost):
                break
            trial, trial_cost, damping, over = how.step(theta, cost, damping)
            if trial is None:
                converged = over
                break
            gained = cost - trial_cost
            theta, cost = trial, trial_cost
            if keep is not None:
                keep(theta)
            seconds.append(perf_counter() - began)
            costs.append(cost)
            if held_out is not None:
                held.append(held_out(theta))
                worse = 0 if held[-1] < best_held else worse + 1
                if held[-1] < best_held:
                    best_held, best_theta = held[-1], theta
            converged = gained <= max(tolerance * abs(cost), enough)
            if converged or worse >= _PATIENCE:
                break
    except KeyboardInterrupt:
        if not keep_best:
            raise
        interrupted = True
    early = bool(held) and held[-1] > (1.0 + slack) * best_held
    if early:
        theta, cost, converged = best_theta, problem.cost(best_theta), True
    return Found(
        theta=theta,
        cost=cost,
        converged=converged,
        stopped_early=early,
        interrupted=interrupted,
        seconds=tuple(seconds),
        costs=tuple(costs),
        held_out=tuple(held),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _How:
    """How one step is made."""

    problem: Problem
    upper: Array | None
    longest: float
    move: Callable[[Array, Array], Array | None] | None
    solved: Callable[[Array], Array] | None
    n_linear: int
    settled: float

    def step(self, theta: Array, cost: float, damping: float) -> tuple[Array | None, float, float, bool]:
        """Return a better vector (None without one), its cost, the next damping, and whether there is nothing to
        gain.
        """
        R = self.problem.triangle(theta)
        if not np.all(np.isfinite(R)):
            return None, cost, damping, False
        R = R[self.n_linear :, self.n_linear :]  # slopes less what the linear numbers take over
        J, r = R[:, :-1], R[:, -1]
        if self.upper is not None:
            J = J * ~((theta >= self.upper)[self.n_linear :] & (J.T @ r > 0.0))
        if not J.shape[1]:
            return None, cost, damping, True
        found = directions(J)
        to_gain = found.explain(r)
        if to_gain <= max(self.settled, 1e-13 * abs(cost)):
            return None, cost, damping, True
        while damping < _MOST_DAMPED:
            trial = self._moved(theta, found.solve(r, damping))
            trial_cost = np.inf if trial is None else self.problem.cost(trial)
            if trial_cost < cost:
                return trial, trial_cost, max(damping / 10.0, 1e-14), False
            damping *= 8.0
        return None, cost, damping, to_gain <= 1e-6 * abs(cost)

    def _moved(self, theta: Array, step: Array) -> Array | None:
        """The vector after a step, None where there is none."""
        size = float(np.max(np.abs(step))) if step.size else 0.0
        if size > self.longest:
            step = step * (self.longest / size)
        if self.move is not None:
            trial = self.move(theta, step)
        else:
            trial = theta.copy()
            trial[self.n_linear :] += step
        if trial is None:
            return None
        trial = trial if self.upper is None else np.minimum(trial, self.upper)
        return trial if self.solved is None else self.solved(trial)
