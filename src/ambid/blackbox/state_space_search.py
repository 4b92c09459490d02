"""State-space models by prediction error: the maximum of the likelihood, started from a subspace estimate.

Solves min log det (1/N) sum e e' with x+ = A x + B u + K e, y = C x + D u + e over A, B, C, [D,] K, first states and a
constant for every output, for stable and unstable plants, with and without feedback: Levenberg-Marquardt on QR-reduced
whitened rows (Ljung 1999, sec. 7.4, 10.2), in theta = theta_0 + P beta, P orthonormal and orthogonal to a change of
states, (T A - A T, T B, -C T, 0, T K) for every T (McKelvey, Helmersson and Ribarits 2004, Automatica 40, 1629).
Efficient where innovations are white (Ljung 1999, sec. 9.3): the covariance is the inverse of the information matrix.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dtpqrt

from ambid.arrays import Array
from ambid.blackbox.data import IOData, Orders
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.model import StateSpaceModel
from ambid.blackbox.prediction import Sensitivities
from ambid.blackbox.subspace import (
    FirstModel,
    Method,
    Tick,
    build_subspace_fit,
    first_model,
    operating_point,
)
from ambid.blackbox.subspace_projection import Realisation, kalman_gain, radius
from ambid.errors import EstimationError
from ambid.estimation.kernels import state_scan
from ambid.estimation.linear import directions, least_squares, one_thread
from ambid.estimation.search import search

_DOUBLINGS = 24  # samples as a power of two
_FAINT = 1e-10  # Hankel singular value beside the largest below which a state is not scaled further


def tangent(model: StateSpaceModel, *, feedthrough: bool) -> Array:
    """Return orthonormal directions (columns) that change the model, not its states alone; `feedthrough`: whether D
    moves.
    """
    m, n, n_u, n_y = model, model.order, model.n_inputs, model.n_outputs
    eye = np.eye(n)
    exchange = np.vstack(
        [
            np.kron(eye, m.A.T) - np.kron(m.A, eye),
            np.kron(eye, m.B.T),
            -np.kron(m.C, eye),
            np.kron(eye, m.K.T),
        ]
    )
    basis = np.linalg.qr(exchange, mode="complete")[0][:, n * n :]
    before, size = n * n + n * n_u + n_y * n, n_y * n_u
    out = np.zeros((m.theta.size, basis.shape[1] + (size if feedthrough else 0)))
    out[:before, : basis.shape[1]] = basis[:before]
    out[before + size :, : basis.shape[1]] = basis[before:]
    if feedthrough:
        out[before : before + size, basis.shape[1] :] = np.eye(size)
    return out


def linear(model: StateSpaceModel, *, feedthrough: bool) -> Array:
    """Return directions along which predictions are linear: with F = A - K C and C held, in K and in B - K D; in D (if
    `feedthrough`) beside K up to the product of their changes.
    """
    m, n, n_u, n_y = model, model.order, model.n_inputs, model.n_outputs
    ends = np.cumsum([0, n * n, n * n_u, n_y * n, n_y * n_u, n * n_y])
    by_b, by_k = n * n_u, n * n_y
    out = np.zeros((m.theta.size, by_b + by_k + (n_y * n_u if feedthrough else 0)))
    out[ends[1] : ends[2], :by_b] = np.eye(by_b)
    out[ends[4] : ends[5], by_b : by_b + by_k] = np.eye(by_k)
    out[: ends[1], by_b : by_b + by_k] = np.kron(np.eye(n), m.C.T)  # dA = dK C
    out[ends[1] : ends[2], by_b : by_b + by_k] = np.kron(np.eye(n), m.D.T)  # dB = dK D
    if feedthrough:
        out[ends[3] : ends[4], by_b + by_k :] = np.eye(n_y * n_u)
        out[ends[1] : ends[2], by_b + by_k :] = np.kron(m.K, np.eye(n_u))  # dB = K dD
    return out


def balance(model: StateSpaceModel, x0: Array, noise: Array) -> tuple[StateSpaceModel, Array]:
    """Return a stable predictor's model, and x0 (n,), in states that white inputs and outputs drive, and predictions
    show, by equal amounts, errors counted in `noise` (n_outputs, n_outputs); as it was where too near the edge of
    stability.
    """
    m = model
    F, G = m.A - m.K @ m.C, np.hstack([m.B - m.K @ m.D, m.K])
    whitened = np.linalg.solve(np.linalg.cholesky(noise), m.C)
    try:
        left, right = _factor(_gramian(F, G)), _factor(_gramian(F.T, whitened.T))
        U, s, _ = np.linalg.svd(right.T @ left)
        s = np.sqrt(np.maximum(s, _FAINT * s[0]))
        T = (U / s).T @ right.T  # new states = T old states
        back = np.linalg.inv(T)
    except (np.linalg.LinAlgError, ValueError):
        return model, x0
    if not (np.all(np.isfinite(T)) and np.linalg.cond(T) < 1e12):
        return model, x0
    return m.in_states(back), T @ x0


def _gramian(F: Array, G: Array) -> Array:
    """Sum of F^k G G' F'^k, its length doubled until nothing is added: no equation to be ill-conditioned."""
    total, power = G @ G.T, F
    for _ in range(_DOUBLINGS):
        total = total + power @ total @ power.T
        power = power @ power
        if not np.any(np.abs(power) > 1e-18):
            break
    if not np.all(np.isfinite(total)):
        raise np.linalg.LinAlgError("the predictor forgets nothing")
    return np.asarray(total)


def _factor(gramian: Array) -> Array:
    """Return L with L L' = gramian, rounding below zero taken as rounding."""
    values, ways = np.linalg.eigh(0.5 * (gramian + gramian.T))
    if not values[-1] > 0:
        raise np.linalg.LinAlgError("nothing drives the states")
    return np.asarray(ways * np.sqrt(np.maximum(values, 1e-14 * values[-1])))


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


def start_point(model: StateSpaceModel, noise: Array, u: Array, y: Array) -> Point | None:
    """Give a scaled model the first states and constants that suit it best, with `noise` (n_outputs, n_outputs) of the
    innovations, roughly; None where the predictor is not stable, or leaves no errors.
    """
    if radius(model.A - model.K @ model.C) >= 1.0:
        return None
    n, n_y = model.order, model.n_outputs
    rough = Point(model=model, x0=np.zeros(n), constant=np.zeros(n_y), noise=noise, cost=np.inf)
    return _settle(rough, np.zeros((model.theta.size, 0)), u, y)


class Likelihood:
    """The problem that is searched, over first states, constants and coefficients; at every triangle the model is
    balanced, and steps run along its tangent.
    """

    def __init__(self, start: Point, u: Array, y: Array, *, feedthrough: bool) -> None:
        self.point = self._trial = start
        self._seen: Point | None = None  # where the triangle was taken last
        self.ways, self.factor = np.zeros((0, 0)), np.zeros((0, 0))
        self._u, self._y, self._feedthrough = u, y, feedthrough

    @property
    def vector(self) -> Array:
        """First states, constants and coefficients of the last trial."""
        return np.concatenate([self._trial.x0, self._trial.constant, self._trial.model.theta])

    def cost(self, _: Array) -> float:
        """Return N log det of the last trial, which is what is asked for."""
        return self._trial.cost

    def triangle(self, _: Array) -> Array:
        """Return the triangle of first states, constants, directions and errors at the last trial."""
        at = self._trial
        if at is self._seen:
            return self.factor
        self._seen = at
        model, x0 = balance(at.model, at.x0, at.noise)
        self.point = replace(at, model=model, x0=x0)
        self.ways = tangent(model, feedthrough=self._feedthrough)
        self.factor = _triangle(self.point, self.ways, self._u, self._y)
        return self.factor

    @property
    def promise(self) -> float:
        """By how much one more step would lower the cost."""
        return float(np.sum(self.factor[:-1, -1] ** 2))

    def move(self, _: Array, step: Array) -> Array | None:
        """Step from the point of the last triangle, less far where the predictor would get unstable."""
        at, part = self.point, 1.0
        n, k = at.model.order, at.model.order + at.model.n_outputs
        while True:
            model = at.model.with_theta(at.model.theta + self.ways @ (part * step[k:]))
            if radius(model.A - model.K @ model.C) < 1.0:
                break
            part *= 0.5
            if part <= _SHORTEST:
                return None
        near = replace(at, model=model, x0=at.x0 + part * step[:n], constant=at.constant + part * step[n:k])
        trial = _settle(near, linear(model, feedthrough=self._feedthrough), self._u, self._y)
        if trial is None or not trial.cost < at.cost:
            return None
        self._trial = trial
        return self.vector


def _settle(rough: Point, ways: Array, u: Array, y: Array) -> Point | None:
    """Solve for all that the predictions are linear in: the valley of poles that zeros nearly cancel gets straight."""
    n, k = rough.model.order, rough.model.order + rough.model.n_outputs
    factor = _triangle(rough, ways, u, y)
    if not np.all(np.isfinite(factor)):
        return None
    change = least_squares(factor[:-1, :-1], factor[:-1, -1])
    model = rough.model.with_theta(rough.model.theta + ways @ change[k:])
    x0, constant = rough.x0 + change[:n], rough.constant + change[n:k]
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
        regressors = work[:, : n + n_u]
        yield regressors, y[part] - regressors @ out


def _triangle(point: Point, ways: Array, u: Array, y: Array) -> Array:
    """Triangular factor of [first states, constants, directions, errors], rows whitened by the errors' covariance."""
    model, n_y = point.model, y.shape[1]
    d, n = ways.shape[1], model.order
    root = np.linalg.cholesky(point.noise)
    whiten = solve_triangular(root, np.eye(n_y), lower=True)
    along = Sensitivities(model, ways, initial=True)
    width = n + n_y + d + 1
    factor = np.zeros((width, width), order="F")
    for regressors, e in _blocks(model, point.x0, u, y):
        slopes = along.block(np.hstack([regressors, e]))
        m = e.shape[0]
        rows = np.empty((n_y, m, width))
        rows[:, :, :n] = slopes[:, :, d:]
        rows[:, :, n : n + n_y] = np.eye(n_y)[:, None, :]
        rows[:, :, n + n_y : -1] = slopes[:, :, :d]
        rows[:, :, -1] = (e - point.constant).T
        white = (whiten @ rows.reshape(n_y, m * width)).reshape(n_y * m, width)
        factor, _, _, _ = dtpqrt(0, min(_PANEL, width), factor, np.asfortranarray(white), overwrite_a=1, overwrite_b=1)
    return np.triu(factor)


_LOOSE = 1e6  # condition of the scaled information's root from which states are told apart by rounding alone


def sspem(data: IOData, orders: Orders, *, tick: Tick = None) -> BlackBoxFit:
    """Identify a state-space model by prediction error (local coordinates: McKelvey et al. 2004, Automatica 40, 1629),
    of ``n`` states, ``"auto"`` or missing to choose it; input delays count as states. Consistent under feedback as long
    as n states hold plant and noise.
    """
    with one_thread():
        first = first_model("pbsid", data, orders, None, None, tick)
        n, channels = first.full.model.order, first.plan.channels
        u, y = (channels.u - channels.mean_u) / channels.scale_u, (channels.y - channels.mean_y) / channels.scale_y
        numbers = n * (u.shape[1] + 2 * y.shape[1] + 1) + y.shape[1] * (1 + first.plan.feedthrough * u.shape[1])
        if y.size < 2 * numbers:
            raise EstimationError(
                f"sspem: {y.shape[0]} samples for {numbers} parameters; it needs at least {2 * numbers} values. "
                "Lower n, or use a longer record"
            )
        method, start = _start(data, first, orders, u, y, tick)
        problem = Likelihood(start, u, y, feedthrough=first.plan.feedthrough)
        say = None if tick is None else lambda *_: tick()
        done = search(problem, problem.vector, most=_STEPS, tolerance=0.0, settled=_NEAR, move=problem.move, tick=say)
        problem.triangle(done.theta)
    return _result(data, first, problem, len(done.costs) - 1, method, start)


def _start(data: IOData, first: FirstModel, orders: Orders, u: Array, y: Array, tick: Tick) -> tuple[Method, Point]:
    """Take the subspace estimate with the smallest determinant: pbsid, and cva where there is no feedback."""
    n = first.full.model.order
    tried: list[tuple[Method, Realisation]] = [("pbsid", first.full)]
    if data.open_loop or not data.n_inputs:
        try:
            other = first_model("cva", data, {**orders, "n": n}, None, first.plan.feedthrough, tick)
            tried.append(("cva", other.full))
        except EstimationError:  # a record too short for cva may still do for pbsid
            pass
    points = list[tuple[Method, Point]]()
    for method, one in tried:
        m = replace(one.model, dt=data.dt)
        point = start_point(m, one.innovation + 1e-12 * np.eye(y.shape[1]), u, y)
        if point is None:
            K, noise, _ = kalman_gain(m.A, m.C, np.eye(n), np.zeros_like(m.K), np.eye(y.shape[1]))
            point = start_point(replace(m, K=K), noise, u, y)
        if point is not None:
            points.append((method, point))
    if not points:
        raise EstimationError(
            "sspem: no subspace estimate of this order has a stable predictor to start from. Change n"
        )
    return min(points, key=lambda pair: pair[1].cost)


def _result(
    data: IOData, first: FirstModel, problem: Likelihood, iterations: int, method: Method, start: Point
) -> BlackBoxFit:
    """Give the numbers their units and say what has to be said of them."""
    m, plan, channels = problem.point.model, first.plan, first.plan.channels
    n_samples, n_y = channels.y.shape
    # each output has its share of the numbers
    widened = n_samples / (n_samples - (problem.factor.shape[1] - 1) / n_y)
    noise = problem.point.noise * widened
    scaled = Realisation(model=m, innovation=noise, Q=m.K @ noise @ m.K.T, S=m.K @ noise, R=noise)
    k = m.order + n_y
    axes = directions(problem.factor[k:-1, k:-1])  # first states and constants projected out
    condition = min(axes.condition, 1e18)
    warnings = []
    if problem.point.exact:
        warnings.append(
            "the record has no noise: errors and standard deviations are rounding, and the noise model K is meaningless"
        )
    elif condition > _LOOSE:
        warnings.append(
            f"the data do not identify all {m.order} states (condition {condition:.1g}): standard deviations along "
            "unidentifiable directions mean little. Lower n"
        )
    return build_subspace_fit(
        "sspem",
        data,
        plan,
        scaled,
        problem.ways @ axes.inverse() @ problem.ways.T * widened,
        criterion=first.criterion,
        n_estimated=problem.ways.shape[1],
        offsets=operating_point(scaled, channels, problem.point.constant),
        status="converged" if problem.promise < _ROUNDING or problem.point.exact else "stalled",
        warnings=warnings,
        details={
            "start": method,
            "iterations": iterations,
            "gain_nats": 0.5 * (start.cost - problem.point.cost),
            "left_nats": 0.5 * problem.promise,
            "condition_number": condition,
            "covariance": {"kind": "information"},
        },
    )
