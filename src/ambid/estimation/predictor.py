"""The innovations-form predictor of a linear model at one vector of estimated numbers, with its exact derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.estimation.innovations import Innovations, gain_derivatives, predictor_gain, predictor_gains, stable, stack
from ambid.estimation.problem import PredictorProblem
from ambid.physics.discretise import DiscreteSpace, discretise
from ambid.physics.linear_model import StateSpace


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Predictor:
    """The assembled recursion at one vector, in scaled units."""

    # (n, n + n_lags n_inputs + n_outputs + 1), [F, B.., K, offset]: x+ = M [x; inputs at the problem's lags; y; 1], F
    # = A - K C
    M: Array
    dM: Array  # (*M.shape, size), exact derivative by every estimated number; size 0 where it was not asked for
    A: Array  # (n, n), transition matrix of the plant over one step (`stride` samples)
    E: Array  # (n, n_disturbances), what constant disturbances do over one step
    dE: Array  # (n, n_disturbances, size), exact derivative of `E`
    C: Array  # (n_outputs, n)
    x0: Array  # (n,)
    gain: Array  # (n, n_outputs)
    innovations: Innovations | None  # Riccati solution, where the noise is described by levels


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """Plant over one step of the recursion."""

    A: Array  # (n, n)
    inputs: Array  # (n, n_lags n_inputs), input matrices at the problem's lags
    E: Array  # (n, n_disturbances)


def assemble(
    problem: PredictorProblem, vector: Array, *, near: Array | None = None, with_derivatives: bool = True
) -> Predictor | None:
    """Build the predictor and its derivatives at `vector`.

    `vector`: (size,); `near`: (n_states, n_outputs), a gain near the one looked for: it starts the Riccati solve;
    `with_derivatives`: leave the derivatives out where only innovations are wanted. Returns none where the vector makes
    no stable predictor or no physical plant (mass or inductance not positive).
    """
    sl = problem.slices
    theta, lag = problem.parameters(vector), problem.lag_at(vector)
    possible = np.all(np.isfinite(vector)) and all(theta.get(name, 1.0) > 0 for name in ("m", "L"))
    if not possible or not -1.0 < lag < 2.0 or problem.delay + lag < 0.0:
        return None
    try:
        plant, slopes = _discrete(problem, theta, lag, with_derivatives=with_derivatives)
        K, dK, inner = _gain(problem, vector[sl["noise"]], plant, slopes, near, with_derivatives=with_derivatives)
    except (np.linalg.LinAlgError, ValueError, ArithmeticError):
        return None
    return _recursion(problem, vector, lag, plant, K, inner, slopes, dK)


def assemble_all(problems: Sequence[PredictorProblem], vectors: Sequence[Array]) -> list[Predictor | None]:
    """Build the predictors of several problems, without derivatives: together, as small matrices cost less in stacks.

    `problems`: of one model, noise described by levels, delays equal but for whole samples; `vectors`: (size,) each.
    """
    first, sl = problems[0], problems[0].slices
    lag, pairs = first.lag, list(zip(problems, vectors, strict=True))
    try:
        C = first.model.matrices(first.parameters(vectors[0])).C * first.scales.state / first.scales.output[:, None]
        plants = _discrete_all(pairs, C, lag if len(first.taps) > 1 else None)
        noise, n_d = np.array([v[sl["noise"]] for v in vectors]), plants.E.shape[-1]
        Q = (plants.E * np.exp(2 * noise[:, None, :n_d])) @ np.swapaxes(plants.E, 1, 2)
        sensor = np.exp(2 * np.hstack([np.zeros((len(pairs), 1)), noise[:, n_d:]]))
        gains, found = predictor_gains(plants.A, C, Q, sensor[:, :, None] * np.eye(C.shape[0]))
    except (np.linalg.LinAlgError, ValueError, ArithmeticError):
        return [assemble(p, v, with_derivatives=False) for p, v in pairs]
    out = list[Predictor | None]()
    for k, (problem, vector) in enumerate(pairs):
        if found[k]:
            plant = DiscreteSpace(A=plants.A[k], B=plants.B[k], B_late=plants.B_late[k], E=plants.E[k], C=C)
            out.append(_recursion(problem, vector, lag, plant, gains[k]))
        else:
            out.append(assemble(problem, vector, with_derivatives=False))
    return out


def _recursion(
    problem: PredictorProblem,
    vector: Array,
    lag: float,
    plant: DiscreteSpace,
    K: Array,
    inner: Innovations | None = None,
    slopes: Sequence[DiscreteSpace] = (),
    dK: Array | None = None,
) -> Predictor | None:
    """Put the recursion together from a plant and its gain, with derivatives where there are those of the gain."""
    sl = problem.slices
    step, step_slopes = _stepped(problem, lag, plant, slopes)
    F, offset = step.A - K @ plant.C, vector[sl["offset"]]
    if not stable(F):
        return None
    M = np.hstack([F, step.inputs, K, (step.E @ offset)[:, None]])
    dM = np.zeros((*M.shape, 0 if dK is None else problem.size))
    dE = np.zeros((*step.E.shape, dM.shape[2]))
    if dK is not None:
        n, first_y = F.shape[0], M.shape[1] - 1 - K.shape[1]
        for q, d in enumerate(step_slopes):  # physical parameters, then the delay
            dM[:, :n, q], dM[:, n:first_y, q], dM[:, -1, q] = d.A, d.inputs, d.E @ offset
            dE[:, :, q] = d.E
        # dK holds physical parameters, delay and noise in the order of the vector
        dM[:, :n, : len(dK)] -= np.moveaxis(dK @ plant.C, 0, 2)
        dM[:, first_y:-1, : len(dK)] += np.moveaxis(dK, 0, 2)
        dM[:, -1, sl["offset"]] = step.E
    return Predictor(
        M=M,
        dM=dM,
        A=step.A,
        E=step.E,
        dE=dE,
        C=np.ascontiguousarray(plant.C),
        x0=vector[sl["initial"]].copy(),
        gain=K,
        innovations=inner,
    )


def _discrete(
    problem: PredictorProblem, theta: dict[str, float], lag: float, *, with_derivatives: bool
) -> tuple[DiscreteSpace, tuple[DiscreteSpace, ...]]:
    """Scaled discrete plant, and its derivatives by the physical parameters and the delay."""
    model, sc = problem.model, problem.scales
    names = problem.estimated if with_derivatives else ()
    spaces = [model.matrices(theta), *(model.derivative(theta, name) for name in names)]
    # a derivative by a parameter becomes one by its scaled value
    factor = np.concatenate([[1.0], problem.magnitude[: len(names)]])[:, None, None]
    A, B, E = (
        factor * np.array(stacked) * size / sc.state[:, None]
        for stacked, size in (
            ([x.A for x in spaces], sc.state),
            ([x.B for x in spaces], sc.input),
            ([x.E for x in spaces], sc.disturbance),
        )
    )
    C = spaces[0].C * sc.state / sc.output[:, None]
    scaled = [StateSpace(A=a, B=b, E=e, C=C) for a, b, e in zip(A, B, E, strict=True)]
    fraction = lag - np.floor(lag) if len(problem.taps) > 1 else None
    plant, slopes = discretise(scaled[0], 1.0 / problem.rate_hz, fraction=fraction, derivatives=scaled[1:])
    return plant, slopes[: problem.slices["fraction"].stop] if with_derivatives else ()


def _discrete_all(pairs: Sequence[tuple[PredictorProblem, Array]], C: Array, fraction: float | None) -> DiscreteSpace:
    """Scaled discrete plants of several problems, stacked."""
    spaces = [p.model.matrices(p.parameters(v)) for p, v in pairs]
    state, into, push = (np.array([getattr(p.scales, k) for p, _ in pairs]) for k in ("state", "input", "disturbance"))
    A, B, E = (
        np.array(matrices) * size[:, None, :] / state[:, :, None]
        for matrices, size in (
            ([s.A for s in spaces], state),
            ([s.B for s in spaces], into),
            ([s.E for s in spaces], push),
        )
    )
    return discretise(StateSpace(A=A, B=B, E=E, C=C), 1.0 / pairs[0][0].rate_hz, fraction=fraction)[0]


def _gain(
    problem: PredictorProblem,
    noise: Array,
    plant: DiscreteSpace,
    slopes: Sequence[DiscreteSpace],
    near: Array | None,
    *,
    with_derivatives: bool,
) -> tuple[Array, Array | None, Innovations | None]:
    """Predictor gain and its derivatives by physical parameters, delay and noise numbers."""
    (n, n_d), n_y, n_slopes = plant.E.shape, plant.C.shape[0], len(slopes)
    size = n_slopes + noise.size
    if problem.noise != "levels":
        K = noise.reshape(n, n_y) if problem.noise == "gain" else problem.gain
        dK = np.zeros((size, n, n_y))
        dK[n_slopes:] = np.eye(n * n_y).reshape(n * n_y, n, n_y)[: noise.size]
        return K, dK if with_derivatives else None, None
    variance, sensor = np.exp(2 * noise[:n_d]), np.concatenate([[1.0], np.exp(2 * noise[n_d:])])
    at = predictor_gain(plant.A, plant.C, (plant.E * variance) @ plant.E.T, np.diag(sensor), near=near)
    if not with_derivatives:
        return at.K, None, at
    dA, dQ, dR = np.zeros((size, n, n)), np.zeros((size, n, n)), np.zeros((size, n_y, n_y))
    dA[:n_slopes] = stack([d.A for d in slopes], (n, n))
    half = (stack([d.E for d in slopes], (n, n_d)) * variance) @ plant.E.T
    dQ[:n_slopes] = half + np.swapaxes(half, 1, 2)
    for j in range(noise.size):
        if j < n_d:
            dQ[n_slopes + j] = 2 * variance[j] * np.outer(plant.E[:, j], plant.E[:, j])
        else:
            dR[n_slopes + j, j - n_d + 1, j - n_d + 1] = 2 * sensor[j - n_d + 1]
    return at.K, gain_derivatives(plant.A, plant.C, at, dA, dQ, dR), at


def _stepped(
    problem: PredictorProblem, lag: float, plant: DiscreteSpace, slopes: Sequence[DiscreteSpace]
) -> tuple[Step, list[Step]]:
    """Put the inputs at their lags and take the plant over `stride` samples, with derivatives by the product rule."""
    if problem.lags == (0,):
        return Step(A=plant.A, inputs=plant.B, E=plant.E), [Step(A=d.A, inputs=d.B, E=d.E) for d in slopes]
    n, n_u = plant.B.shape
    place = problem.taps.index(int(np.floor(lag)))

    def spread(now: Array, late: Array, powers: Sequence[Array]) -> Array:
        out = np.zeros((n, len(problem.lags), n_u))
        for j, power in enumerate(powers):  # the input j samples into the step acts through powers[j]
            at = place + problem.stride - 1 - j
            out[:, at] += power @ now
            if len(problem.taps) > 1:
                out[:, at + 1] += power @ late
        return out.reshape(n, -1)

    one = np.eye(n)
    if problem.stride == 1:
        first = Step(A=plant.A, inputs=spread(plant.B, plant.B_late, [one]), E=plant.E)
        return first, [Step(A=d.A, inputs=spread(d.B, d.B_late, [one]), E=d.E) for d in slopes]
    powers = [one]
    for _ in range(problem.stride):
        powers.insert(0, plant.A @ powers[0])
    whole, steps = powers[0], powers[1:]
    sums = np.sum(steps, axis=0)
    result = []
    for d in slopes:
        slopes_of_powers = [np.zeros((n, n))]
        for power in reversed(steps):
            slopes_of_powers.insert(0, d.A @ power + plant.A @ slopes_of_powers[0])
        d_whole, d_steps = slopes_of_powers[0], slopes_of_powers[1:]
        inputs = spread(d.B, d.B_late, steps) + spread(plant.B, plant.B_late, d_steps)
        result.append(Step(A=d_whole, inputs=inputs, E=sums @ d.E + np.sum(d_steps, axis=0) @ plant.E))
    return Step(A=whole, inputs=spread(plant.B, plant.B_late, steps), E=sums @ plant.E), result
