"""Search for the innovations form with the smallest determinant of its one-step errors, from a model that is near.

Solves: min log det (1/N) sum e e' over A, B, C, [D,] K, first states and a constant for every output, by
Levenberg-Marquardt in local coordinates on QR-reduced rows whitened by the errors' covariance (Ljung 1999, sec. 7.4 and
10.2). SciPy's least squares wants all rows of the Jacobian at once; here a record of any length takes one block.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dtpqrt

from ambid.arrays import Array
from ambid.blackbox.gradient import Sensitivities
from ambid.blackbox.state_space import StateSpaceModel
from ambid.blackbox.subspace.local import balanced, linear, moved, tangent
from ambid.blackbox.subspace.realisation import radius
from ambid.estimation.kernels import state_scan

Tick = Callable[[], None] | None

_BLOCK = 2048  # samples at once
_PANEL = 32
_STEPS = 100
_NEAR = 1e-7  # fall of N log det that one more step promises, below which the search is done
_ROUNDING = 1e-3  # the same, below which a step that does not succeed is rounding
_EXACT = 1e-12  # errors beside outputs of unit deviation from which they are rounding
_SHORTEST = 2.0**-30  # part of a step below which no stable predictor lies that way


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Point:
    """A model with what belongs to this record; scaled channels."""

    model: StateSpaceModel
    x0: Array  # (n,), states at the first sample
    constant: Array  # (n_outputs,), mean of the errors of the predictor that knows of no constant
    noise: Array  # (n_outputs, n_outputs), covariance of the errors, no degrees of freedom taken off
    cost: float  # N log det of it

    @property
    def exact(self) -> bool:
        """Whether the errors are rounding, with no noise to be seen."""
        return bool(np.trace(self.noise) < 1.5 * _EXACT**2 * self.noise.shape[0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Found:
    """Where the search ended."""

    point: Point
    tangent: Array  # (n_theta, n_directions)
    # (n_directions, n_directions), triangular root of the information along the tangent, first states and constants
    # projected out
    information: Array
    n_numbers: int  # directions, first states and constants
    iterations: int
    converged: bool
    promise: float  # fall of N log det that one more step promises


def started(model: StateSpaceModel, noise: Array, u: Array, y: Array) -> Point | None:
    """Give a model the first states and constants that suit it best.

    `model`: scaled; `noise`: (n_outputs, n_outputs), of the innovations, roughly; `u`: (n_samples, n_inputs); `y`:
    (n_samples, n_outputs). Returns none where the predictor is not stable, or leaves no errors.
    """
    if radius(model.A - model.K @ model.C) >= 1.0:
        return None
    n, n_y = model.order, model.n_outputs
    rough = Point(model=model, x0=np.zeros(n), constant=np.zeros(n_y), noise=noise, cost=np.inf)
    return _settled(rough, np.zeros((model.theta.size, 0)), u, y)


def searched(start: Point, u: Array, y: Array, *, feedthrough: bool, tick: Tick = None) -> Found:
    """Search from a start.

    `u`: (n_samples, n_inputs), scaled; `y`: (n_samples, n_outputs); `feedthrough`: whether D is estimated; `tick`:
    called before each step.
    """
    point, damping, iterations = start, 1e-3, 0
    k = start.model.order + start.model.n_outputs
    while True:
        if tick is not None:
            tick()
        model, x0 = balanced(point.model, point.x0, point.noise)
        point = replace(point, model=model, x0=x0)
        ways = tangent(model, feedthrough=feedthrough)
        factor = _reduced(point, ways, u, y)
        promise = float(np.sum(factor[:-1, -1] ** 2))
        better = None
        if promise > _NEAR and not point.exact and iterations < _STEPS:
            better, damping = _step(point, ways, factor, damping, u, y, feedthrough=feedthrough)
        if better is None:
            break
        point, iterations = better, iterations + 1
    return Found(
        point=point,
        tangent=ways,
        information=factor[k:-1, k:-1],
        n_numbers=factor.shape[1] - 1,
        iterations=iterations,
        converged=promise < _ROUNDING or point.exact,
        promise=promise,
    )


def _step(
    point: Point, ways: Array, factor: Array, damping: float, u: Array, y: Array, *, feedthrough: bool
) -> tuple[Point | None, float]:
    """Find a better point: more damping after failure, a shorter step where the predictor gets unstable."""
    n, k = point.model.order, point.model.order + point.model.n_outputs
    size = np.maximum(np.linalg.norm(factor[:-1, :-1], axis=0), 1e-150)
    rows, right = factor[:-1, :-1] / size, factor[:-1, -1]
    U, s, Vt = np.linalg.svd(rows)
    s = np.maximum(s, 1e-300)
    along = U.T @ right
    while damping < 1e10:
        scaled = Vt.T @ (along * s / (s**2 + damping))
        change, part = scaled / size, 1.0
        model = moved(point.model, ways @ change[k:])
        while radius(model.A - model.K @ model.C) >= 1.0 and part > _SHORTEST:
            part *= 0.5
            model = moved(point.model, ways @ (part * change[k:]))
        trial = None
        if part > _SHORTEST:
            near = replace(
                point, model=model, x0=point.x0 + part * change[:n], constant=point.constant + part * change[n:k]
            )
            trial = _settled(near, linear(model, feedthrough=feedthrough), u, y)
        left = right - part * rows @ scaled
        promised = float(right @ right - left @ left)
        if trial is not None and point.cost - trial.cost > 1e-3 * promised > 0:
            good = point.cost - trial.cost > 0.5 * promised and part == 1.0
            return trial, max(damping / 20, 1e-14) if good else damping
        damping = max(damping, 1e-10) * 8
    return None, damping


def _settled(rough: Point, ways: Array, u: Array, y: Array) -> Point | None:
    """Solve for all that the predictions are linear in: the valley of poles that zeros nearly cancel gets straight."""
    n, k = rough.model.order, rough.model.order + rough.model.n_outputs
    factor = _reduced(rough, ways, u, y)
    if not np.all(np.isfinite(factor)):
        return None
    size = np.maximum(np.linalg.norm(factor[:-1, :-1], axis=0), 1e-150)
    solved = np.linalg.lstsq(factor[:-1, :-1] / size, factor[:-1, -1], rcond=1e-10)[0]
    change = np.asarray(solved / size, dtype=np.float64)
    model = moved(rough.model, ways @ change[k:])
    return _judged(model, rough.x0 + change[:n], rough.constant + change[n:k], u, y)


def _judged(model: StateSpaceModel, x0: Array, constant: Array, u: Array, y: Array) -> Point | None:
    """Run the record through; None where the errors are not finite, or some outputs' alone are rounding."""
    triangle = np.zeros((y.shape[1], y.shape[1]))
    for _, e in _blocks(model, x0, u, y):
        if not np.all(np.isfinite(e)):
            return None
        triangle = np.asarray(np.linalg.qr(np.vstack([triangle, e - constant]), mode="r"))
    size, least = np.abs(np.diag(triangle)), _EXACT * np.sqrt(y.shape[0])
    if np.all(size <= least):  # no noise: errors are rounding, and count as this much
        size, triangle = np.full(size.size, least), least * np.eye(size.size)
    if not np.all(size >= least):
        return None
    noise = triangle.T @ triangle / y.shape[0]
    cost = float(y.shape[0] * (2 * np.sum(np.log(size)) - size.size * np.log(y.shape[0])))
    return Point(model=model, x0=x0, constant=constant, noise=noise, cost=cost)


def _blocks(model: StateSpaceModel, x0: Array, u: Array, y: Array) -> Iterator[tuple[Array, Array]]:
    """States and inputs, and errors without a constant taken off, block by block."""
    n, n_u = model.order, model.n_inputs
    step = np.ascontiguousarray(np.hstack([model.A - model.K @ model.C, model.B - model.K @ model.D, model.K]))
    out, x = np.hstack([model.C, model.D]).T, np.array(x0)
    for first in range(0, y.shape[0], _BLOCK):
        part = slice(first, first + _BLOCK)
        work = np.hstack([np.zeros((y[part].shape[0], n)), u[part], y[part]])
        state_scan(step, work, x)
        known = work[:, : n + n_u]
        yield known, y[part] - known @ out


def _reduced(point: Point, ways: Array, u: Array, y: Array) -> Array:
    """Triangular factor of [first states, constants, directions, errors], rows whitened by the errors' covariance."""
    model, n_y = point.model, y.shape[1]
    d, n = ways.shape[1], model.order
    root = np.linalg.cholesky(point.noise)
    whiten = solve_triangular(root, np.eye(n_y), lower=True)
    along = Sensitivities(model, ways, initial=True)
    width = n + n_y + d + 1
    factor = np.zeros((width, width), order="F")
    for known, e in _blocks(model, point.x0, u, y):
        slopes = along.block(np.hstack([known, e]))
        m = e.shape[0]
        rows = np.empty((n_y, m, width))
        rows[:, :, :n] = slopes[:, :, d:]
        rows[:, :, n : n + n_y] = np.eye(n_y)[:, None, :]
        rows[:, :, n + n_y : -1] = slopes[:, :, :d]
        rows[:, :, -1] = (e - point.constant).T
        white = (whiten @ rows.reshape(n_y, m * width)).reshape(n_y * m, width)
        factor, _, _, _ = dtpqrt(0, min(_PANEL, width), factor, np.asfortranarray(white), overwrite_a=1, overwrite_b=1)
    return np.triu(factor)
