"""Levenberg-Marquardt search for the coefficients of a NARMAX model by prediction or by simulation errors.

Derivatives are those of the recursions, exact; each record's rows are reduced by QR before they are joined.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from ambid.arrays import Array
from ambid.estimation.progress import Tick, guessed
from ambid.nonlinear.narmax.recursion import Tables, predicted, sensitivities

Parts = Sequence[tuple[Array, Array]]
"""Scaled outputs and inputs of each record."""

_USUAL = 6.0  # iterations, about half of those that it takes
_ENOUGH = 1e-3  # gain, in the errors' variance, that ends a search: a step of 0.03 standard deviations
BLIND = 1e-12  # singular values of the scaled Jacobian below this part of the largest are directions nobody sees


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fitted:
    """Where a search ended."""

    theta: Array  # (n_theta,), scaled
    cost: float  # sum of squared weighted errors; infinite where the model diverges
    errors: tuple[Array, ...]  # (n_rows, n_outputs), scaled, by record, from sample `lag` on
    converged: bool
    seconds: tuple[float, ...] = ()  # of each accepted step
    costs: tuple[float, ...] = ()

    @property
    def finite(self) -> bool:
        """Whether the model runs over all records without diverging."""
        return bool(np.isfinite(self.cost))


def evaluated(t: Tables, theta: Array, parts: Parts, weight: Array, *, free: bool) -> Fitted:
    """Return the errors of a model as it stands.

    `theta`: (n_theta,); `weight`: (n_outputs,), of the errors of each output; `free`: errors of the free run instead of
    the predictions.
    """
    errors = tuple(y[t.lag :] - predicted(t, theta, y, u, free=free)[0][t.lag :] for y, u in parts)
    with np.errstate(over="ignore", invalid="ignore"):
        cost = float(sum(np.sum((e * weight) ** 2) for e in errors))
    return Fitted(theta=theta, cost=cost if np.isfinite(cost) else np.inf, errors=errors, converged=False)


def triangle(t: Tables, theta: Array, parts: Parts, weight: Array, *, free: bool) -> Array:
    """Return the triangle of the weighted Jacobian with the weighted errors behind it.

    `theta`: (n_theta,); `weight`: (n_outputs,). Returns (n_theta + 1 at most, n_theta + 1).
    """
    found: list[Array] = []
    for y, u in parts:
        yhat, z = predicted(t, theta, y, u, free=free)
        J = sensitivities(t, theta, z, free=free)[t.lag :] * weight[:, None]
        e = ((y - yhat)[t.lag :] * weight).reshape(-1, 1)
        rows = np.hstack([J.reshape(e.size, -1), e])
        found.append(np.asarray(np.linalg.qr(rows, mode="r")))
    return found[0] if len(found) == 1 else np.asarray(np.linalg.qr(np.concatenate(found), mode="r"))


def search(
    t: Tables,
    theta: Array,
    parts: Parts,
    weight: Array,
    *,
    free: bool,
    most: int = 40,
    tick: Tick | None = None,
    keep: Callable[[Array], None] | None = None,
) -> Fitted:
    """Search for the least sum of squared errors.

    `theta`: (n_theta,), start; `weight`: (n_outputs,); `free`: fit the free run instead of the predictions; `most`:
    iterations; `tick`: called before each iteration; `keep`: given each better vector, shape (n_theta,). Returns the
    start with an infinite cost where the model diverges there.
    """
    began = perf_counter()
    best = evaluated(t, theta, parts, weight, free=free)
    n = sum(x.size for x in best.errors)
    seconds, costs, damping, converged = [perf_counter() - began], [best.cost], 1e-4, False
    if not best.finite or not theta.size:
        return best
    for k in range(most):
        if tick is not None:
            tick("simulation-error search" if free else "prediction-error search", guessed(k, _USUAL))
        R = triangle(t, best.theta, parts, weight, free=free)
        if not np.all(np.isfinite(R)):
            break
        scale = np.maximum(np.linalg.norm(R[:, :-1], axis=0), 1e-150)
        U, s, Vt = np.linalg.svd(R[:, :-1] / scale, full_matrices=False)
        along = U.T @ R[:, -1]
        live = s > BLIND * s[0]
        better = None
        while damping < 1e8:
            gain = np.where(live, s / (s**2 + damping * live), 0.0)
            step = (Vt.T @ (gain * along)) / scale
            trial = evaluated(t, best.theta + step, parts, weight, free=free)
            if trial.cost < best.cost:
                better = trial
                break
            if float(np.sum(along[live] ** 2)) <= 1e-14 * best.cost:
                break
            damping *= 10.0
        if better is None:
            converged = damping < 1e8 or float(np.sum(along[live] ** 2)) <= 1e-6 * best.cost
            break
        gained = best.cost - better.cost
        best, damping = better, max(damping / 10.0, 1e-12)
        if keep is not None:
            keep(best.theta)
        seconds.append(perf_counter() - began)
        costs.append(best.cost)
        if gained <= max(1e-10, _ENOUGH / max(n, 1)) * best.cost or best.cost == 0.0:
            converged = True
            break
    return Fitted(
        theta=best.theta,
        cost=best.cost,
        errors=best.errors,
        converged=converged,
        seconds=tuple(seconds),
        costs=tuple(costs),
    )
