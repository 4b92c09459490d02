"""LQG with integral action, in discrete time: a `StateLaw` from a plant, physical weights and noise.

Over a sample x+ = A x + B u + n, y = C x + e (states and delayed commands), q+ = q + T p; u = -K [x̂, q] minimises

Σ p'p/p₁² + i'i/i₁² + q'q/(p₁ τ)² + effort² u'u/u₁²,

K = (R + B'P B)⁻¹ B'P A, x̂ the stationary Kalman filter's (Kwakernaak and Sivan 1972, ch. 6; Franklin, Powell and
Workman 1998, ch. 9). It promises no margins (Doyle 1978): effort and disturbances are set by the worst of many plants.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ambid.arrays import Array
from ambid.control.closed import Plant
from ambid.errors import EstimationError, ModelError
from ambid.physics.law import StateLaw
from ambid.physics.linear_model import delayed
from ambid.physics.loop import Limits, Noise
from ambid.simulation.plant import fed_back, signals_fed_back

RESIDUAL = 1e-8
"""Largest residual of a Riccati equation, over its largest term, that is taken."""
_ROUNDED = 1e-3  # of the largest command: the least noise in it, that of rounding and of what the model leaves out
_HIDDEN = 1e-4  # of the largest signal: the least noise of a sensor


@dataclass(frozen=True, slots=True, kw_only=True)
class Weights:
    """Largest deviations, in which position, current and command are weighed."""

    position: float  # m
    command: float  # V, or what the inputs are
    current: float = math.inf  # A; not weighed where it is infinite
    integral_s: float = 0.05  # time in which a deviation may be integrated away

    @classmethod
    def of(cls, limits: Limits, integral_s: float) -> Weights:
        """Return half of the width of the limits; ModelError where one that is needed is not given."""
        half = {n: (getattr(limits, n)[1] - getattr(limits, n)[0]) / 2.0 for n in ("position", "voltage", "current")}
        for name in ("position", "voltage"):
            if not math.isfinite(half[name]):
                raise ModelError(f"limits.{name} is not given; LQG weighs by it. Give limits.{name}")
        return cls(position=half["position"], command=half["voltage"], current=half["current"], integral_s=integral_s)


@dataclass(frozen=True, kw_only=True, eq=False)
class SampledPlant:
    """A plant over one sample, its states followed by the commands on their way; outputs as a `StateLaw` sees them."""

    A: Array
    B: Array
    E: Array
    C: Array
    plant: Plant

    @classmethod
    def of(cls, plant: Plant) -> SampledPlant:
        """Return the plant with the delay of each input, whole and fraction."""
        d = delayed(plant.space, 1.0 / plant.rate_hz, plant.delays)
        return cls(A=d.A, B=d.B, E=d.E, C=d.C[signals_fed_back(plant.model)], plant=plant)

    @cached_property
    def kinds(self) -> tuple[Array, Array]:
        """Which outputs are positions, and which are currents, of the axes in their order."""
        pairs = fed_back(self.plant.model)
        order = np.cumsum(pairs.ravel() >= 0).reshape(pairs.shape) - 1
        return order[pairs[:, 0] >= 0, 0], order[pairs[:, 1] >= 0, 1]

    def closed(self, law: StateLaw) -> Array:
        """Return the matrix of the closed loop, states of the plant before those of the law."""
        return np.block([[self.A + self.B @ law.D @ self.C, self.B @ law.C], [law.B @ self.C, law.A]])

    def largest_pole(self, law: StateLaw) -> float:
        """Return the largest modulus of the poles of the closed loop."""
        return float(np.max(np.abs(np.linalg.eigvals(self.closed(law)))))

    def sensors(self, noise: Noise) -> Array:
        """Return the standard deviations of the outputs, with those of rounding."""
        sd = np.zeros(self.C.shape[0])
        for rows, kind in zip(self.kinds, ("position", "current"), strict=True):
            sd[rows] = noise.sensor_rms(kind)
        return sd


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lqg:
    """A law, its gains, and how well the equations were solved."""

    law: StateLaw
    regulator: Array  # (n_inputs, n_states + n_axes), K of [x, q]
    filter: Array  # (n_states, n_outputs), M of x̂ + M (y - C x̂)
    residual: float  # of both Riccati equations, over their largest term
    largest_pole: float  # of the closed loop on the plant of the design
    effort: float
    disturbance: float


def lqg(plant: Plant, weights: Weights, noise: Noise, *, effort: float = 1.0, disturbance: float = 1.0) -> Lqg:
    """Return the law for a plant. `effort`: factor on the price of the command, small is fast; `disturbance`: on the
    process noise, large trusts the sensors, small the model. EstimationError where the equations have no good solution.
    """
    sampled = SampledPlant.of(plant)
    scale = scales_of(sampled, weights)
    A, B, C = sampled.A * scale / scale[:, None], sampled.B / scale[:, None], sampled.C * scale
    n, (position, current) = A.shape[0], sampled.kinds
    if position.size == 0:
        raise EstimationError(f"model {plant.model.name!r} has no position to hold. Give one with a position")
    T, axes, p = 1.0 / plant.rate_hz, position.size, C[position] / weights.position
    wide = np.block([[A, np.zeros((n, axes))], [(T / weights.integral_s) * p, np.eye(axes)]])
    Q = np.eye(n + axes)
    Q[:n, :n] = p.T @ p + C[current].T @ C[current] / weights.current**2
    wide_B, R = np.vstack([B, np.zeros((axes, B.shape[1]))]) * weights.command, effort**2 * np.eye(B.shape[1])
    P, first = _riccati(wide, wide_B, Q, R)
    K = weights.command * np.linalg.solve(R + wide_B.T @ P @ wide_B, wide_B.T @ P @ wide)
    M, second = _filter(sampled, A, C, scale, weights, noise, disturbance)
    remainder = np.eye(n) - M @ C
    moved, direct = A - B @ K[:, :n], -K[:, :n] @ M
    total = K[:, n:]
    back = min(T / weights.integral_s, 1.0)
    integrates = np.zeros((axes, C.shape[0]))
    integrates[np.arange(axes), position] = T / (weights.integral_s * weights.position)
    law = StateLaw(
        A=np.block([[moved @ remainder, -B @ total], [np.zeros((axes, n)), np.eye(axes)]]),
        B=np.vstack([moved @ M, integrates]),
        C=np.hstack([-K[:, :n] @ remainder, -total]),
        D=direct,
        G=np.vstack([B, -back * np.linalg.pinv(total)]),
        rate_hz=plant.rate_hz,
    )
    size, residual = sampled.largest_pole(law), max(first, second)
    if not (residual <= RESIDUAL and size < 1.0):
        raise EstimationError(
            f"the Riccati equations of LQG are solved to {residual:.1e} of their terms only and the largest pole is "
            f"{size:.6f}. Change the effort, or give noise and limits that fit the plant"
        )
    units = np.concatenate([scale, np.ones(axes)])
    return Lqg(
        law=law, regulator=K / units, filter=scale[:, None] * M, residual=residual, largest_pole=size, effort=effort,
        disturbance=disturbance,
    )  # fmt: skip


def scales_of(sampled: SampledPlant, weights: Weights) -> Array:
    """Return sizes of the states, powers of two, that make the rows of plant, inputs and outputs alike (Osborne)."""
    from scipy.linalg import matrix_balance

    n, n_u, (position, current) = sampled.A.shape[0], sampled.B.shape[1], sampled.kinds
    rows = [sampled.C[position] / weights.position, *([sampled.C[current] / weights.current] if current.size else [])]
    outputs = np.vstack(rows)
    whole = np.zeros((n + max(n_u, outputs.shape[0]),) * 2)
    whole[:n, :n], whole[:n, n : n + n_u] = sampled.A, sampled.B * weights.command
    whole[n : n + outputs.shape[0], :n] = outputs
    return np.asarray(matrix_balance(whole, permute=False, separate=True)[1][0][:n])


def _riccati(A: Array, B: Array, Q: Array, R: Array) -> tuple[Array, float]:
    """Return P of the discrete Riccati equation, and the residual over its largest term."""
    from scipy.linalg import solve_discrete_are

    try:
        P = solve_discrete_are(A, B, Q, R)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise EstimationError(
            f"a Riccati equation of LQG has no solution ({error}). The inputs do not reach, or the outputs do not "
            "show, a motion that is not stable; or noise or limits do not fit the plant"
        ) from None
    carried = A.T @ P @ A
    terms = (carried, P, A.T @ P @ B @ np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A), Q)
    left = terms[0] - terms[1] - terms[2] + terms[3]
    return P, float(np.max(np.abs(left)) / max(float(np.max(np.abs(t))) for t in terms))


def filter_noise(sampled: SampledPlant, weights: Weights, noise: Noise, disturbance: float) -> tuple[Array, Array]:
    """Return what disturbances of unit size do to the states in a sample, and the sizes of the sensors' noise."""
    force, voltage = noise.held_rms(sampled.plant.rate_hz)
    size = [force if name.rsplit("_", 1)[-1] == "force" else voltage for name in sampled.plant.model.disturbances]
    driven = np.hstack([sampled.E * np.array(size), sampled.B * (_ROUNDED * weights.command)]) * disturbance
    sd = sampled.sensors(noise)
    for rows, largest in zip(sampled.kinds, (weights.position, weights.current), strict=True):
        sd[rows] = np.maximum(sd[rows], _HIDDEN * (largest if math.isfinite(largest) else 0.0))
    if not np.all(sd > 0.0):
        raise ModelError("noise.current is not given; the filter of LQG weighs by it. Give noise.current")
    return driven, sd


def _filter(
    sampled: SampledPlant, A: Array, C: Array, scale: Array, weights: Weights, noise: Noise, disturbance: float
) -> tuple[Array, float]:
    """Return the gain M of the stationary filter, and the residual of its equation, outputs counted in their noise."""
    driven, sd = filter_noise(sampled, weights, noise, disturbance)
    driven = driven / scale[:, None]
    level = float(np.max(np.abs(driven)))
    outputs, driven = C / sd[:, None] * level, driven / level
    P, residual = _riccati(A.T, outputs.T, driven @ driven.T, np.eye(sd.size))
    M = np.linalg.solve(outputs @ P @ outputs.T + np.eye(sd.size), outputs @ P).T
    return M * (level / sd), residual


# Order reduction of a law: balanced truncation of its stable part; integrals and growing modes are kept apart.
#
# With the gramians P = A P A' + B B' and Q = A'Q A + C'C of the stable part, states are ordered by the Hankel singular
# values σ, and the response changes by no more than 2 Σ σ of those left out (Moore 1981; Al-Saggaf and Franklin 1987).

_STABLE = 1e-6  # distance from the unit circle of a mode that is balanced


def reduced(law: StateLaw, order: int, largest: Array, command: float = 1.0) -> tuple[StateLaw, float]:
    """Return a law of lower order, and its response's largest change, from `largest` of each signal, in whose sizes
    errors count, to `command`; ModelError where the kept modes alone are more.
    """
    from scipy.linalg import schur, solve_discrete_lyapunov, solve_sylvester, svd

    inside = 1.0 - _STABLE
    T, Z, n = schur(law.A, sort=lambda re, im: np.hypot(re, im) < inside)
    apart = law.order - n
    if order >= law.order:
        return law, 0.0
    if order < apart:
        raise ModelError(
            f"the law has {apart} integrals and growing modes, which cannot be left out; its order cannot become"
            f" {order}"
        )
    S = np.eye(law.order)
    S[:n, n:] = solve_sylvester(T[:n, :n], -T[n:, n:], -T[:n, n:])  # T S = S diag: no coupling of the two parts
    to = Z @ S
    back = np.linalg.inv(to)
    A, B, G, C = back @ law.A @ to, back @ law.B, back @ law.windup, law.C @ to
    inputs = np.hstack([B[:n] * largest, G[:n] * command])
    P = solve_discrete_lyapunov(A[:n, :n], inputs @ inputs.T)
    Q = solve_discrete_lyapunov(A[:n, :n].T, C[:, :n].T @ C[:, :n] / command**2)
    left, right = _root(P), _root(Q)
    U, sigma, V = svd(right.T @ left)
    r = order - apart
    size = np.sqrt(np.maximum(sigma[:r], 1e-300))
    down, up = (U[:, :r] / size).T @ right.T, left @ V[:r].T / size
    rows, columns = np.zeros((order, law.order)), np.zeros((law.order, order))
    rows[:r, :n], columns[:n, :r] = down, up
    rows[r:, n:] = columns[n:, r:] = np.eye(apart)
    small = replace(law, A=rows @ A @ columns, B=rows @ B, C=C @ columns, G=rows @ G)
    return small, 2.0 * float(np.sum(sigma[r:]))


def _root(P: Array) -> Array:
    """Return L with P = L L', also where P is singular."""
    values, vectors = np.linalg.eigh((P + P.T) / 2.0)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
