"""One Gauss-Newton search for all estimators, on triangles: steps are damped in the lengths of the columns
(Levenberg-Marquardt; More 1978), or bounded in the numbers' own units (Nocedal and Wright 2006, sec. 10.3).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Literal, Protocol

import numpy as np

from ambid.arrays import Array
from ambid.estimation.linear import BLIND, Directions, directions, triangle_of
from ambid.estimation.progress import Tick, guessed

Status = Literal["converged", "stalled", "failed"]

NOT_CONVERGED = "no search converged"
_PREDICTABLE = 0.5  # part of the residuals' variance that a regression may explain before a fit counts as failed
_USUAL = 10.0  # iterations, roughly, of a search
_MOST_DAMPED = 1e9
_NOTHING = 1e-12  # radius of the trust region below which no step is left
_ROUNDING = 1e-15  # singular value, over the largest, below which there is nothing but rounding
_SECULAR = 30  # Newton steps towards the damping that gives a step its length
_PATIENCE = 6  # iterations in a row in which held-out errors may grow


class Problem(Protocol):
    """A criterion and the triangle of [J | r]: a step d lowers the criterion by about |r|² - |r - J d|².

    Of least squares J is the prediction's slope and r = target - prediction, both of unit variance; of a likelihood JᵀJ
    is the information matrix and Jᵀr minus half the gradient. Priors and penalties are rows like others.
    """

    def cost(self, theta: Array) -> float:
        """Return the criterion at `theta` (n_theta,), infinite where the model diverges; of least squares the sum of
        squares.
        """
        ...

    def triangle(self, theta: Array) -> Array:
        """Return the triangle of [J | r], (at most n_theta + 1, n_theta + 1), where `cost` was asked for last, or
        before.
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PhysicalFit:
    """Outcome of a likelihood search for physical numbers."""

    problem: Any  # what was estimated from what; has `n_used`, the values that enter the fit
    vector: Array  # (size,)
    criterion: float  # twice the negative log-likelihood but for constants, with the squared residuals of the priors
    status: Status
    evaluations: int
    # what a global search did where the ordinary starts failed, see `ambid.estimation.global_search.rescued`
    global_search: Mapping[str, object] | None = None


def predictable(part: float) -> str:
    """Return why a fit counts as failed of whose residuals a regression on the past predicts a part; empty if not."""
    return (
        f"a linear regression on past data predicts {100 * part:.0f} % of the residual variance"
        if part > _PREDICTABLE
        else ""
    )


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
    bounded: int = 0,
    judged: int = 0,
    left: float | None = None,
    keep_best: bool = False,
) -> Found:
    """Search for the least criterion from `theta` (n_theta,).

    It is over where a step gains less than `tolerance` (relative) or `enough` (absolute), or a full one promises less
    than `settled`, the squared Newton decrement in the criterion's unit; with `judged`, where a step gains or promises
    at most `enough` and a full one moves none of the first `judged` numbers by more than the root of `settled` in its
    standard deviations; or where none goes down and a full one promises at most `left` (default 1e-6 of a sum of
    squares; a likelihood names it). `damping`: at the beginning, for unit columns; `bounded`: instead, the first so
    many numbers (for logarithms of levels that the data hardly show) keep to a trust region, radius 1 in their units,
    the linear others follow; `upper` (n_theta,): what would go beyond rests; `longest`: change of any number in a step;
    `move`: takes a step by its own rules, None where it cannot; `held_out`: error on other data, which ends training
    where it grows; `keep`: given each better vector; `solved`: sets the first `n_linear` numbers to their best;
    `keep_best`: so a KeyboardInterrupt ends.
    """
    began, converged, interrupted = perf_counter(), False, False
    theta = theta if upper is None else np.minimum(theta, upper)
    if solved is not None:
        theta = solved(theta)
    cost = problem.cost(theta)
    seconds, costs = [0.0], [cost]
    errors = [held_out(theta)] if held_out is not None else []
    best_held, best_theta, worse = (errors[0] if errors else np.inf), theta, 0
    steps = _Steps(
        problem=problem, control=_Region(bounded) if bounded else _Damping(damping), upper=upper, longest=longest,
        move=move, solved=solved, n_linear=n_linear, settled=settled, enough=enough, judged=judged, left=left,
    )  # fmt: skip
    gained = np.inf
    try:
        for k in range(most):
            if tick is not None:
                tick(stage, max(k / most, guessed(k, _USUAL)))
            if not np.isfinite(cost):
                break
            trial, trial_cost, converged = steps.step(theta, cost, gained)
            if trial is None:
                break
            gained = cost - trial_cost
            theta, cost = trial, trial_cost
            if keep is not None:
                keep(theta)
            seconds.append(perf_counter() - began)
            costs.append(cost)
            if held_out is not None:
                errors.append(held_out(theta))
                worse = 0 if errors[-1] < best_held else worse + 1
                if errors[-1] < best_held:
                    best_held, best_theta = errors[-1], theta
            converged = not judged and gained <= max(tolerance * abs(cost), enough)
            if converged or worse >= _PATIENCE:
                break
    except KeyboardInterrupt:
        if not keep_best:
            raise
        interrupted = True
    early = bool(errors) and errors[-1] > (1.0 + slack) * best_held
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
        held_out=tuple(errors),
    )


class _Damping:
    """Levenberg-Marquardt steps, damped in the lengths of the columns."""

    def __init__(self, value: float) -> None:
        self.value = value

    @property
    def exhausted(self) -> bool:
        """Whether no step is left."""
        return self.value >= _MOST_DAMPED

    def step(self, full: Directions, J: Array, r: Array) -> tuple[Array, float]:
        """Return a step, and about the fall of the sum of squares that it promises."""
        del J
        return full.solve(r, self.value), full.explain(r)

    def judge(self, ratio: float) -> None:
        """Move the damping by whether the step was better."""
        self.value = max(self.value / 10.0, 1e-14) if ratio > 0.0 else self.value * 8.0


class _Region:
    """Trust region of the first numbers in their own units; the others follow."""

    def __init__(self, n: int) -> None:
        self.n, self.radius = n, 1.0
        self.length, self.bound = 0.0, False  # of the last step, and whether it was cut

    @property
    def exhausted(self) -> bool:
        """Whether no step is left."""
        return self.radius < _NOTHING

    def step(self, full: Directions, J: Array, r: Array) -> tuple[Array, float]:
        """Return the best step inside the region, and the fall of the sum of squares that it promises."""
        del full
        easy = directions(J[:, self.n :])
        rows = np.column_stack([J[:, : self.n], r])
        rows = rows - easy.U @ (easy.U.T @ rows)
        U, s, Vt = np.linalg.svd(rows[:, :-1], full_matrices=False)
        nonzero = s > _ROUNDING * np.max(s, initial=0.0)
        s, pull = s[nonzero], (U.T @ rows[:, -1])[nonzero]
        damping, along = 0.0, pull / s
        for _ in range(_SECULAR):  # Newton's method on 1 / length, which is nearly linear in the damping
            self.length = float(np.linalg.norm(along))
            if self.length <= 1.1 * self.radius:
                break
            slope = float(along**2 @ (1.0 / (s**2 + damping)))
            damping += self.length**2 / slope * (self.length / self.radius - 1.0)
            along = s * pull / (s**2 + damping)
        self.bound = damping > 0.0
        step = Vt[nonzero].T @ along
        promise = float(2.0 * pull @ (s * along) - np.sum((s * along) ** 2)) + easy.explain(r)
        return np.concatenate([step, easy.solve(r - J[:, : self.n] @ step)]), promise

    def judge(self, ratio: float) -> None:
        """Move the bound by the ratio of the fall that came to the one that was promised."""
        if ratio < 0.25:
            self.radius = 0.25 * self.length
        elif ratio > 0.75 and self.bound:
            self.radius = 2.0 * self.length


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Steps:
    """How steps are taken."""

    problem: Problem
    control: _Damping | _Region
    upper: Array | None
    longest: float
    move: Callable[[Array, Array], Array | None] | None
    solved: Callable[[Array], Array] | None
    n_linear: int
    settled: float
    enough: float
    judged: int
    left: float | None

    def step(self, theta: Array, cost: float, gained: float) -> tuple[Array | None, float, bool]:
        """Return a better vector, None without one, its cost, and whether nothing is to gain; `gained`: by the last
        step.
        """
        R = self.problem.triangle(theta)
        if not np.all(np.isfinite(R)):
            return None, cost, False
        R = R[self.n_linear :, self.n_linear :]  # slopes less what the linear numbers take over
        J, r = R[:, :-1], R[:, -1]
        if self.upper is not None:
            J = J * ~((theta >= self.upper)[self.n_linear :] & (J.T @ r > 0.0))
        if not J.shape[1]:
            return None, cost, True
        full = directions(J)
        to_gain = full.explain(r)
        near = self._settled(full, r) if self.judged else to_gain <= max(self.settled, 1e-13 * abs(cost))
        if near and (not self.judged or gained <= self.enough):
            return None, cost, True
        while not self.control.exhausted:
            step, promise = self.control.step(full, J, r)
            if self.judged and near and promise <= self.enough:
                return None, cost, True
            trial = self._moved(theta, step)
            trial_cost = np.inf if trial is None else self.problem.cost(trial)
            self.control.judge((cost - trial_cost) / promise if trial_cost < cost else -1.0)
            if trial_cost < cost:
                return trial, trial_cost, False
        left = 1e-6 * abs(cost) if self.left is None else self.left  # rounding hides a way down
        return None, cost, not self.judged and to_gain <= left

    def _settled(self, full: Directions, r: Array) -> bool:
        """Whether a full step hardly moves what is judged."""
        half = full.root(BLIND)
        step = np.abs(half @ (full.U.T @ r)) / np.linalg.norm(half, axis=1)
        return bool(np.max(step[: self.judged]) < np.sqrt(self.settled))

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
