"""Levenberg-Marquardt search for the weights of a network, on triangles: rows are reduced by QR before they are joined.

A problem gives its errors and, at a vector, the triangle of [J | r], r = target - prediction, J the slope of the
prediction, both weighted to unit variance; priors and penalties are rows like others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Protocol

import numpy as np

from ambid.arrays import Array
from ambid.estimation.progress import Tick, guessed

_USUAL = 10.0  # iterations, roughly, of a search
_BLOCK = 4096  # rows that are reduced at once: they stay in the cache
BLIND = 1e-11  # singular values of the scaled Jacobian below this part of the largest are directions nobody sees


class Problem(Protocol):
    """What is searched in."""

    def cost(self, theta: Array) -> float:
        """Return the sum of squared rows.

        `theta`: (n_theta,). Returns infinite where the model diverges.
        """
        ...

    def triangle(self, theta: Array) -> Array:
        """Return the triangle of [J | r].

        `theta`: (n_theta,). Returns (n_theta + 1, n_theta + 1).
        """
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Found:
    """Where a search ended."""

    theta: Array  # (n_theta,), with the least cost, or with the least held-out error where training went on beyond it
    cost: float  # of `theta`; infinite where the start already diverges
    converged: bool
    stopped_early: bool  # whether `theta` is that of the least held-out error, the training having gone beyond it
    seconds: tuple[float, ...]  # of each accepted step
    costs: tuple[float, ...]
    held_out: tuple[float, ...]


def triangle_of(rows: Sequence[Array]) -> Array:
    """Return the triangle of stacked rows.

    `rows`: (n_rows, n_columns). Returns (at most n_columns, n_columns).
    """
    small = [
        part if part.shape[0] <= part.shape[1] else np.asarray(np.linalg.qr(part, mode="r"))
        for block in rows
        for part in (block[k : k + _BLOCK] for k in range(0, block.shape[0], _BLOCK))
    ]
    return small[0] if len(small) == 1 else np.asarray(np.linalg.qr(np.concatenate(small), mode="r"))


def search(
    problem: Problem,
    theta: Array,
    *,
    stage: str,
    most: int = 50,
    tolerance: float = 1e-8,
    enough: float = 0.0,
    damping: float = 1e-3,
    held_out: Callable[[Array], float] | None = None,
    slack: float = 0.02,
    tick: Tick | None = None,
    keep: Callable[[Array], None] | None = None,
    solved: Callable[[Array], Array] | None = None,
    n_linear: int = 0,
) -> Found:
    """Search for the least sum of squares.

    `theta`: (n_theta,), start; `stage`: for `tick`; `most`: iterations; `tolerance`: relative gain below which the
    search is over; `damping`: at the beginning, for columns of unit length; small where the start is good; `tick`:
    called before each iteration, with the share of this search that is over; `keep`: given each better vector, shape
    (n_theta,).
    """
    began, converged = perf_counter(), False
    if solved is not None:
        theta = solved(theta)
    cost = problem.cost(theta)
    seconds, costs = [0.0], [cost]
    held = [held_out(theta)] if held_out is not None else []
    best_held, best_theta, worse = (held[0] if held else np.inf), theta, 0
    for k in range(most):
        if tick is not None:
            tick(stage, max(k / most, guessed(k, _USUAL)))
        if not np.isfinite(cost):
            break
        trial, trial_cost, damping, over = _step(problem, theta, cost, damping, solved, n_linear)
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
        converged = gained <= max(tolerance * cost, enough)
        if converged or worse >= 6:
            break
    early = bool(held) and held[-1] > (1.0 + slack) * best_held
    if early:
        theta, cost, converged = best_theta, problem.cost(best_theta), True
    return Found(
        theta=theta,
        cost=cost,
        converged=converged,
        stopped_early=early,
        seconds=tuple(seconds),
        costs=tuple(costs),
        held_out=tuple(held),
    )


def _step(
    problem: Problem,
    theta: Array,
    cost: float,
    damping: float,
    solved: Callable[[Array], Array] | None,
    n_linear: int,
) -> tuple[Array | None, float, float, bool]:
    """Return a better vector (None without one), its cost, the next damping, and whether there is nothing to gain."""
    R = problem.triangle(theta)
    if not np.all(np.isfinite(R)):
        return None, cost, damping, False
    R = R[n_linear:, n_linear:]  # slopes less what the linear numbers take over
    if R.shape[1] < 2:
        return None, cost, damping, True
    scale = np.linalg.norm(R[:, :-1], axis=0)
    scale = np.where(scale > 1e-150, scale, 1.0)
    U, s, Vt = np.linalg.svd(R[:, :-1] / scale, full_matrices=False)
    along = U.T @ R[:, -1]
    live = s > BLIND * max(s[0], 1e-300)
    to_gain = float(np.sum(along[live] ** 2))
    if to_gain <= 1e-13 * cost:
        return None, cost, damping, True
    while damping < 1e9:
        trial = theta.copy()
        trial[n_linear:] += (Vt.T @ (np.where(live, s / (s**2 + damping), 0.0) * along)) / scale
        if solved is not None:
            trial = solved(trial)
        found = problem.cost(trial)
        if found < cost:
            return trial, found, max(damping / 10.0, 1e-14), False
        damping *= 8.0
    return None, cost, damping, to_gain <= 1e-6 * cost


def information_inverse(R: Array) -> tuple[Array | None, float]:
    """Return the inverse of R'R by singular values, and the condition number of the scaled R.

    `R`: (n_rows, n_theta), triangle without its last column. Returns `inverse`: (n_theta, n_theta), or None, none where
    a direction is not seen at all.
    """
    if R.shape[0] < R.shape[1] or not np.all(np.isfinite(R)):
        return None, np.inf
    scale = np.linalg.norm(R, axis=0)
    if not np.all(scale > 1e-150):
        return None, np.inf
    _, s, Vt = np.linalg.svd(R / scale, full_matrices=False)
    condition = float(s[0] / max(s[-1], 1e-300))
    if condition > 1.0 / BLIND:
        return None, condition
    half = (Vt.T / s) / scale[:, None]
    inverse: Array = half @ half.T
    return (inverse + inverse.T) / 2.0, condition
