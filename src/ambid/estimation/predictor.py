"""The innovations-form predictor of a linear model with exact derivatives: what is estimated, its gain, and it. States,
inputs and outputs are scaled to order one before anything is factorised.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.physics.linear_model import DiscreteSpace, LinearModel, StateSpace, discretise

_BLOCK = 8192  # rows that are looked at at once: they stay in the cache
NoiseForm = Literal["levels", "gain", "given"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scales:
    """Units in which the predictor works."""

    state: Array  # (n_states,)
    input: Array  # (n_inputs,)
    output: Array  # (n_outputs,), about the sensor noise of each output
    # (n_disturbances,), level at which a disturbance moves an output by about its noise within a few samples
    disturbance: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictorProblem:
    """Data, model and what is estimated, a vector in this order: free and prior physical parameters (over their
    magnitudes), the delay if estimated, noise (log levels, or the gain itself), constant disturbances (offsets),
    initial state.
    """

    model: LinearModel
    rate_hz: float
    u: Array  # (n_samples, n_inputs), deviations from the operating point, SI
    y: Array  # (n_samples, n_outputs), deviations from the operating point, SI
    estimated: tuple[str, ...]  # physical parameters in the vector
    known: Mapping[str, float]  # the others, SI
    magnitude: Array  # (n_estimated,), scale of each estimated physical parameter, SI
    prior_mean: Array  # (n_estimated,), SI, standard deviation infinite where there is no prior
    prior_sd: Array
    scales: Scales
    delay: int = 0  # whole samples of delay on all inputs
    # fraction of a sample of delay on top, 0 <= lag < 1, where it is not estimated; one for all inputs, or (n_inputs,)
    lag: float | Array = 0.0
    # whether the delay is estimated as a real number near `delay`: delay - 1 < total < delay + 2
    fractional: bool = False
    late: tuple[int, ...] = (0,)  # inputs of which it is estimated, each on its own
    # samples left out at the start, so that fits with different delays see the same data; at least ``delay + 2``
    skip: int = 2
    # the predictor sees every stride-th output (all inputs act); more than 1 only with noise "gain" or "given"
    stride: int = 1
    # noise as disturbance and sensor levels through the Riccati equation, as a free predictor gain, or as `gain`
    noise: NoiseForm = "levels"
    # (n_noise,), centre of the weak prior on the log noise levels
    noise_center: Array = field(default_factory=lambda: np.zeros(0))
    # (n_states, n_outputs), predictor gain in scaled units, for noise "given"
    gain: Array = field(default_factory=lambda: np.zeros((0, 0)))
    # slopes (n, n_estimated) and residuals (n,) of priors at the estimated physical parameters (n_estimated,), over
    # their standard deviations, where they are not each of one parameter
    joint_priors: Callable[[Array], tuple[Array, Array]] | None = None
    extra: Array | None = None  # (n_samples, n_disturbances), known disturbances from each sample to the next, SI
    unsteady: int = 0  # disturbances, the last ones, that have no constant part

    slices: Mapping[str, slice] = field(init=False)  # places of the groups in the vector
    taps: tuple[int, ...] = field(init=False)  # lags beyond `delay`, in samples, at which the input acts over one
    # lags beyond `delay` at which the input enters one step of the recursion, which is `stride` samples long
    lags: tuple[int, ...] = field(init=False)

    def __post_init__(self) -> None:
        if self.skip < self.delay + 2 or self.y.shape[0] <= self.skip:
            raise ValueError(f"skip {self.skip} must exceed the delay {self.delay} by two and leave samples")
        if self.stride > 1 and self.noise == "levels":
            raise ValueError("a stride above 1 needs the noise as a gain")
        n, n_y, n_d = len(self.model.states), len(self.model.outputs), len(self.model.disturbances)
        sizes = {
            "physical": self.n_physical,
            "fraction": len(self.late) if self.fractional else 0,
            "noise": {"levels": n_d + n_y - 1, "gain": n * n_y, "given": 0}[self.noise],
            "offset": n_d - self.unsteady,
            "initial": n,
        }
        ends = list(accumulate(sizes.values(), initial=0))
        object.__setattr__(self, "slices", {name: slice(*ends[j : j + 2]) for j, name in enumerate(sizes)})
        taps = (-1, 0, 1, 2) if self.fractional else (0, 1) if np.any(self.lag) else (0,)
        object.__setattr__(self, "taps", taps)
        object.__setattr__(self, "lags", tuple(range(taps[0] - (self.stride - 1), taps[-1] + 1)))

    @property
    def n_physical(self) -> int:
        """Number of estimated physical parameters."""
        return len(self.estimated)

    @property
    def size(self) -> int:
        """Length of the vector."""
        return int(self.slices["initial"].stop)

    @property
    def n_used(self) -> int:
        """Samples of each output that enter the fit."""
        return int(-(-(self.y.shape[0] - self.skip) // self.stride))

    def parameters(self, vector: Array) -> dict[str, float]:
        """Return all physical parameters in SI at `vector` (size,)."""
        values = vector[self.slices["physical"]] * self.magnitude
        return {**self.known, **dict(zip(self.estimated, values.tolist(), strict=True))}

    def lags_at(self, vector: Array) -> Array:
        """Return the delay of each input in samples beyond `delay` at a vector (size,), (n_inputs,)."""
        out = np.empty(self.u.shape[1])
        out[:] = self.lag
        if self.fractional:
            out[list(self.late)] = vector[self.slices["fraction"]]
        return out

    def delay_samples(self, vector: Array) -> float:
        """Return the whole delay of the first input in samples at a vector (size,)."""
        return self.delay + float(self.lags_at(vector)[0])


def noise_floor(y: Array) -> Array:
    """Return about the white noise of each output (n_outputs,), positive, by third differences of (n_samples,
    n_outputs): they remove smooth motion and amplify white noise by sqrt(1 + 9 + 9 + 1).
    """
    squares, rows = np.zeros(y.shape[1]), max(y.shape[0] - 3, 1)
    for first in range(0, y.shape[0] - 3, _BLOCK):
        part = y[first : first + _BLOCK + 3]
        third = part[3:] - part[:-3] - 3.0 * (part[2:-1] - part[1:-2])
        squares += np.einsum("ij,ij->j", third, third)
    floor = np.sqrt(squares / rows / 20)
    return np.asarray(np.maximum(floor, 1e-9 * np.std(y, axis=0)))


def busiest(u: Array, length: int) -> slice:
    """Return the stretch of at most `length` samples in which inputs (n_samples, n_inputs) move most."""
    n = u.shape[0]
    if n <= length:
        return slice(0, n)
    power = np.cumsum(np.concatenate([[0.0], np.sum((u / np.std(u, axis=0)) ** 2, axis=1)]))
    first = int(np.argmax(power[length:] - power[:-length]))
    return slice(first, first + length)


def scales_for(
    model: LinearModel, values: Mapping[str, float], inputs: Array, outputs: Array, rate_hz: float
) -> Scales:
    """Return a predictor's scales from rough parameters, standard deviations of `inputs` and the noise of `outputs`,
    SI, see `noise_floor`: sensor noise for outputs and states; for disturbances, what moves outputs by that within two
    samples.
    """
    return all_scales(model, [values], inputs, outputs, rate_hz)[0]


def all_scales(
    model: LinearModel, places: Sequence[Mapping[str, float]], inputs: Array, outputs: Array, rate_hz: float
) -> list[Scales]:
    """Return the scales of predictors at several places, see `scales_for`."""
    spaces = [model.matrices(values) for values in places]
    A, B, E = (np.array(matrices) for matrices in zip(*((s.A, s.B, s.E) for s in spaces), strict=True))
    discrete, _ = discretise(StateSpace(A=A, B=B, E=E, C=spaces[0].C), 1.0 / rate_hz)
    reach = np.maximum(np.abs(discrete.C @ discrete.E), np.abs(discrete.C @ discrete.A @ discrete.E))
    state = np.array([outputs[model.outputs.index(s)] if s in model.outputs else 0.0 for s in model.states])
    state[state == 0] = outputs[0] * rate_hz / 20  # velocity, the only state that is not measured
    return [
        Scales(state=state, input=inputs, output=outputs, disturbance=disturbance)
        for disturbance in 1 / np.max(reach / outputs[:, None], axis=1)
    ]


_KRONECKER = 6  # states up to which a Lyapunov equation is solved as a linear one: small systems are quicker so
_DOUBLINGS = 60
_ROUNDING = 1e-16
_HUGE = 1e100  # of a covariance in scaled units, whose products would overflow: a pole of the plant runs away
_STEP = 1e-7  # of a Newton step, relative: convergence is quadratic, which leaves an error of about 1e-14


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Innovations:
    """Stationary Kalman predictor."""

    K: Array  # (n_states, n_outputs), predictor gain, x[k+1|k] = A x[k|k-1] + ... + K e[k].
    P: Array  # (n_states, n_states), covariance of the prediction error of the state
    S: Array  # (n_outputs, n_outputs), covariance of the innovation


def predictor_gain(A: Array, C: Array, Q: Array, R: Array, *, near: Array | None = None) -> Innovations:
    """Solve P = A P A^T - A P C^T (C P C^T + R)^-1 C P A^T + Q; return the gain K, P and S, A - K C stable. By Newton
    steps from a gain `near`, the stable subspace of the symplectic matrix, or SciPy's solution; R is positive definite.
    """
    K = near if near is not None and stable(A - near @ C) else None
    P = None if K is None else _newton(A, C, Q, R, K)
    if P is None:
        rough = _stable_subspace(A, C, Q, R)
        K = None if rough is None or np.abs(rough).max() > _HUGE else _gain_of(A, C, rough, R)
        P = None if K is None or not stable(A - K @ C) else _newton(A, C, Q, R, K, rough)
    if P is None:
        from scipy.linalg import solve_discrete_are

        with np.errstate(invalid="ignore", over="ignore"):
            P = solve_discrete_are(A.T, C.T, Q, R)
        # the general solver's accuracy suffers where poles crowd at one; Newton takes it to rounding
        P = _newton(A, C, Q, R, _gain_of(A, C, P, R))
        if P is None:
            raise np.linalg.LinAlgError("the Riccati equation has no stabilising solution")
    S = C @ P @ C.T + R
    return Innovations(K=_gain_of(A, C, P, R), P=P, S=S)


def predictor_gains(A: Array, C: Array, Q: Array, R: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the predictor gains (n_plants, n_states, n_outputs) of several plants `A`, `Q`, `R` with one `C`, and for
    which of them the quick way leads to one.
    """
    gains, settled = np.zeros((*A.shape[:-1], C.shape[0])), np.zeros(A.shape[0], dtype=bool)
    P = _stable_subspace(A, C, Q, R)
    if P is None:
        return gains, settled
    led = np.flatnonzero(np.abs(P).max(axis=(1, 2)) < _HUGE)
    K = _gain_of(A[led], C, P[led], R[led])
    start = np.abs(np.linalg.eigvals(A[led] - K @ C)).max(axis=-1) < 1.0
    led, K = led[start], K[start]
    A, Q, R, P, near = A[led], Q[led], R[led], P[led], np.zeros(led.size, dtype=bool)
    for _ in range(8):
        if np.all(near):
            break
        before, P = P, solve_lyapunov(A - K @ C, Q + K @ R @ _turned(K))
        K = _gain_of(A, C, P, R)
        near = np.abs(P - before).max(axis=(1, 2)) <= _STEP * np.abs(P).max(axis=(1, 2))
    gains[led], settled[led] = K, near
    return gains, settled


def _turned(a: NDArray[Any]) -> NDArray[Any]:
    """Transpose of one or several stacked matrices."""
    return np.swapaxes(a, -1, -2)


def _stable_subspace(A: Array, C: Array, Q: Array, R: Array) -> Array | None:
    """P of one plant or several from eigenvectors of the symplectic matrix (Vaughan 1970): quick, rough where poles
    crowd; None where that is impossible for one.
    """
    n = A.shape[-1]
    try:
        back = _turned(np.linalg.inv(A))
        left = back @ C.T @ np.linalg.solve(R, C)
        values, vectors = np.linalg.eig(
            np.concatenate([np.concatenate([back, left], -1), np.concatenate([Q @ back, A + Q @ left], -1)], -2)
        )
        chosen = np.take_along_axis(vectors, np.argsort(np.abs(values))[..., None, n:], -1)
        P = np.real(_turned(np.linalg.solve(_turned(chosen[..., :n, :]), _turned(chosen[..., n:, :]))))
    except np.linalg.LinAlgError:
        return None
    return 0.5 * (P + _turned(P)) if np.all(np.isfinite(P)) else None


def _newton(A: Array, C: Array, Q: Array, R: Array, K: Array, before: Array | None = None) -> Array | None:
    """Iterate Newton-Kleinman from a stabilising gain; None where it does not settle in a few steps."""
    with np.errstate(over="ignore", invalid="ignore"):  # a start that is far off runs away, and does not settle
        for _ in range(8):
            P = solve_lyapunov(A - K @ C, Q + K @ R @ K.T)
            if before is not None and np.abs(P - before).max() <= _STEP * np.abs(P).max():
                return P
            K, before = _gain_of(A, C, P, R), P
    return None


def _gain_of(A: Array, C: Array, P: Array, R: Array) -> Array:
    """Predictor gain A P C^T (C P C^T + R)^-1."""
    CP = C @ P
    return np.asarray(_turned(np.linalg.solve(CP @ C.T + R, CP @ _turned(A))), dtype=np.float64)


def solve_lyapunov(F: Array, Q: Array) -> Array:
    """Solve P = F P F^T + Q, F (n, n) stable, for symmetric right-hand sides, or (n_plants, n, n) for one each."""
    n = F.shape[-1]
    if n > _KRONECKER:
        return _doubled(F, Q)
    kronecker = (F[..., :, None, :, None] * F[..., None, :, None, :]).reshape(*F.shape[:-2], n * n, n * n)
    right = Q.reshape(-1, n * n).T if F.ndim == 2 else Q.reshape(-1, n * n, 1)
    P = _turned(np.linalg.solve(np.eye(n * n) - kronecker, right)).reshape(Q.shape)
    return np.asarray(0.5 * (P + _turned(P)), dtype=np.float64)


def _doubled(F: Array, Q: Array) -> Array:
    """Sum F^k Q (F^k)^T by doubling the number of terms (Smith 1968): n^3 work a step, where n^2 equations cost n^6."""
    P = Q
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_DOUBLINGS):
            more = F @ P @ _turned(F)
            P, F = P + more, F @ F
            if not np.abs(more).max() > _ROUNDING * np.abs(P).max():
                break
    return np.asarray(0.5 * (P + _turned(P)), dtype=np.float64)


def gain_derivatives(
    A: Array, C: Array, at: Innovations, dA: Array, dQ: Array, dR: Array, dC: Array | None = None
) -> Array:
    """Return dK (p, n_states, n_outputs) along p directions `dA`, `dQ`, `dR`, `dC` (None where C stays) at a solution.

    dK = (dF P C^T + F dP C^T + F P dC^T - K dR) S^-1 with F = A - K C, dF = dA - K dC and the Lyapunov equation dP = F
    dP F^T + dA P F^T + F P dA^T + dQ + K dR K^T, as the gain is stationary in P.
    """
    F, dF = A - at.K @ C, dA if dC is None else dA - at.K @ dC
    cross = dF @ at.P @ F.T
    dP = solve_lyapunov(F, cross + np.swapaxes(cross, 1, 2) + dQ + at.K @ dR @ at.K.T)
    right = dF @ at.P @ C.T + F @ dP @ C.T - at.K @ dR
    if dC is not None:
        right = right + F @ at.P @ np.swapaxes(dC, 1, 2)
    return np.swapaxes(np.linalg.solve(at.S, np.swapaxes(right, 1, 2)), 1, 2)


def stable(F: Array) -> bool:
    """Return whether all eigenvalues of `F` (n, n) lie inside the unit circle."""
    return bool(np.abs(np.linalg.eigvals(F)).max() < 1.0)


def stack(matrices: Sequence[Array], shape: tuple[int, ...]) -> Array:
    """Stack matrices along a new first axis, (p, *shape), keeping the shape where there is none."""
    return np.array(matrices) if matrices else np.zeros((0, *shape))


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
    dC: Array  # (n_outputs, n, size), size 0 where no number moves C
    x0: Array  # (n,)
    gain: Array  # (n, n_outputs)
    innovations: Innovations | None  # Riccati solution, where the noise is described by levels


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """Plant over one step of the recursion."""

    A: Array  # (n, n)
    inputs: Array  # (n, n_lags n_inputs), input matrices at the problem's lags
    E: Array  # (n, n_disturbances)
    known: Array  # (n, stride n_disturbances), of disturbances that are known at each sample of the step


def assemble(
    problem: PredictorProblem, vector: Array, *, near: Array | None = None, with_derivatives: bool = True
) -> Predictor | None:
    """Build the predictor and, if wanted, its derivatives at `vector` (size,); None where it is not stable or the plant
    not physical (mass or inductance not positive). `near` (n_states, n_outputs): a gain to start the Riccati solve.
    """
    sl = problem.slices
    theta, lag = problem.parameters(vector), problem.lags_at(vector)
    positive = (p.name for p in problem.model.parameters if p.name in ("m", "L"))  # a rotor's are logarithms, no specs
    possible = np.all(np.isfinite(vector)) and all(theta.get(name, 1.0) > 0 for name in positive)
    if not possible or not np.all((lag > -1.0) & (lag < 2.0) & (problem.delay + lag >= 0.0)):
        return None
    try:
        plant, slopes = _discrete(problem, theta, lag, with_derivatives=with_derivatives)
        K, dK, inner = _gain(problem, vector[sl["noise"]], plant, slopes, near, with_derivatives=with_derivatives)
    except (np.linalg.LinAlgError, ValueError, ArithmeticError):
        return None
    return _recursion(problem, vector, lag, plant, K, inner, slopes, dK)


def assemble_all(problems: Sequence[PredictorProblem], vectors: Sequence[Array]) -> list[Predictor | None]:
    """Build the predictors of several problems of one model at vectors (size,), without derivatives: stacks of small
    matrices cost less. Noise is described by levels; delays are equal but for whole samples.
    """
    first, sl = problems[0], problems[0].slices
    lag, pairs = first.lags_at(vectors[0]), list(zip(problems, vectors, strict=True))
    try:
        C = first.model.matrices(first.parameters(vectors[0])).C * first.scales.state / first.scales.output[:, None]
        plants = _discrete_all(pairs, C, lag if len(first.taps) > 1 else None)
        noise, n_d = np.array([v[sl["noise"]] for v in vectors]), plants.E.shape[-1]
        Q = (plants.E * np.exp(2 * noise[:, None, :n_d])) @ np.swapaxes(plants.E, 1, 2)
        sensor = np.exp(2 * np.hstack([np.zeros((len(pairs), 1)), noise[:, n_d:]]))
        gains, settled = predictor_gains(plants.A, C, Q, sensor[:, :, None] * np.eye(C.shape[0]))
    except (np.linalg.LinAlgError, ValueError, ArithmeticError):
        return [assemble(p, v, with_derivatives=False) for p, v in pairs]
    out = list[Predictor | None]()
    for k, (problem, vector) in enumerate(pairs):
        if settled[k]:
            plant = DiscreteSpace(A=plants.A[k], B=plants.B[k], B_late=plants.B_late[k], E=plants.E[k], C=C)
            out.append(_recursion(problem, vector, lag, plant, gains[k]))
        else:
            out.append(assemble(problem, vector, with_derivatives=False))
    return out


def _recursion(
    problem: PredictorProblem,
    vector: Array,
    lag: Array,
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
    extra = problem.extra is not None
    n_o = offset.size
    M = np.hstack([F, step.inputs, *([step.known] if extra else []), K, (step.E[:, :n_o] @ offset)[:, None]])
    dM = np.zeros((*M.shape, 0 if dK is None else problem.size))
    dE, dC = np.zeros((*step.E.shape, dM.shape[2])), None
    if dK is not None:
        n, first_y = F.shape[0], M.shape[1] - 1 - K.shape[1]
        for q, d in enumerate(step_slopes):  # physical parameters, then the delay
            dM[:, :n, q], dM[:, -1, q] = d.A, d.E[:, :n_o] @ offset
            dM[:, n:first_y, q] = np.hstack([d.inputs, d.known]) if extra else d.inputs
            dE[:, :, q] = d.E
        dC = _slopes_of_C(slopes, plant.C)
        if dC is not None:
            dM[:, :n, : len(dC)] -= np.moveaxis(K @ dC, 0, 2)
        # dK holds physical parameters, delay and noise in the order of the vector
        dM[:, :n, : len(dK)] -= np.moveaxis(dK @ plant.C, 0, 2)
        dM[:, first_y:-1, : len(dK)] += np.moveaxis(dK, 0, 2)
        dM[:, -1, sl["offset"]] = step.E[:, :n_o]
    return Predictor(
        M=M,
        dM=dM,
        A=step.A,
        E=step.E,
        dE=dE,
        C=np.ascontiguousarray(plant.C),
        dC=np.zeros((*plant.C.shape, 0)) if dC is None else np.moveaxis(dC, 0, 2),
        x0=vector[sl["initial"]].copy(),
        gain=K,
        innovations=inner,
    )


def _slopes_of_C(slopes: Sequence[DiscreteSpace], C: Array) -> Array | None:
    """Derivatives of C, (n_slopes, n_outputs, n), none where all vanish."""
    return stack([d.C for d in slopes], C.shape) if any(np.any(d.C) for d in slopes) else None


def _discrete(
    problem: PredictorProblem, theta: dict[str, float], lag: Array, *, with_derivatives: bool
) -> tuple[DiscreteSpace, tuple[DiscreteSpace, ...]]:
    """Scaled discrete plant, and its derivatives by the physical parameters and the delay."""
    model, sc = problem.model, problem.scales
    names = problem.estimated if with_derivatives else ()
    spaces = [model.matrices(theta), *(model.derivative(theta, name) for name in names)]
    # a derivative by a parameter becomes one by its scaled value
    factor = np.concatenate([[1.0], problem.magnitude[: len(names)]])[:, None, None]
    A, B, E, C = (
        factor * np.array(stacked) * size / over[:, None]
        for stacked, size, over in (
            ([x.A for x in spaces], sc.state, sc.state),
            ([x.B for x in spaces], sc.input, sc.state),
            ([x.E for x in spaces], sc.disturbance, sc.state),
            ([x.C for x in spaces], sc.state, sc.output),
        )
    )
    scaled = [StateSpace(A=a, B=b, E=e, C=c) for a, b, e, c in zip(A, B, E, C, strict=True)]
    fraction = lag - np.floor(lag) if len(problem.taps) > 1 else None
    plant, slopes = _sampled(scaled[0], problem, fraction, scaled[1:])
    return plant, slopes[: problem.slices["fraction"].stop] if with_derivatives else ()


def _discrete_all(pairs: Sequence[tuple[PredictorProblem, Array]], C: Array, fraction: Array | None) -> DiscreteSpace:
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
    return _sampled(StateSpace(A=A, B=B, E=E, C=C), pairs[0][0], fraction)[0]


def _sampled(
    space: StateSpace, problem: PredictorProblem, fraction: Array | None, derivatives: Sequence[StateSpace] = ()
) -> tuple[DiscreteSpace, tuple[DiscreteSpace, ...]]:
    """Discretise a plant of a trial step, slopes by the delays last, or raise LinAlgError where it passes all numbers
    within a sample; `fraction` (n_inputs,).
    """
    period = 1.0 / problem.rate_hz
    with np.errstate(over="ignore", invalid="ignore"):
        if fraction is None:
            plant, slopes = discretise(space, period, derivatives=derivatives)
        else:
            pairs = {f: discretise(space, period, fraction=f, derivatives=derivatives) for f in set(fraction.tolist())}
            plant, slopes = pairs[fraction[0]]
            if len(pairs) > 1:
                each = [(p, *d) for p, d in (pairs[f] for f in fraction.tolist())]
                plant, *more = (_by_input(same) for same in zip(*each, strict=True))
                slopes = tuple(more)
            slopes = (*slopes[:-1], *(_alone(slopes[-1], j) for j in problem.late))
    if not all(np.isfinite(x).all() for of in (plant, *slopes) for x in (of.A, of.B, of.B_late, of.E)):
        raise np.linalg.LinAlgError("the plant passes all numbers within a sample")
    return plant, slopes


def _by_input(plants: Sequence[DiscreteSpace]) -> DiscreteSpace:
    """The plant whose input j is that of the j-th."""
    B, late = (np.stack([getattr(p, x)[..., j] for j, p in enumerate(plants)], -1) for x in ("B", "B_late"))
    return replace(plants[0], B=B, B_late=late)


def _alone(plant: DiscreteSpace, j: int) -> DiscreteSpace:
    """The plant with input j alone."""
    one = np.zeros(plant.B.shape[-1])
    one[j] = 1.0
    return replace(plant, B=plant.B * one, B_late=plant.B_late * one)


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
    moved, dC = _slopes_of_C(slopes, plant.C), None
    if moved is not None:
        dC = np.zeros((size, n_y, n))
        dC[:n_slopes] = moved
    return at.K, gain_derivatives(plant.A, plant.C, at, dA, dQ, dR, dC), at


def _stepped(
    problem: PredictorProblem, lag: Array, plant: DiscreteSpace, slopes: Sequence[DiscreteSpace]
) -> tuple[Step, list[Step]]:
    """Put the inputs at their lags and take the plant over `stride` samples, with derivatives by the product rule."""

    def single(inputs: Array, moved: Sequence[Array]) -> tuple[Step, list[Step]]:
        of_slopes = [Step(A=d.A, inputs=b, E=d.E, known=d.E) for d, b in zip(slopes, moved, strict=True)]
        return Step(A=plant.A, inputs=inputs, E=plant.E, known=plant.E), of_slopes

    if problem.lags == (0,):
        return single(plant.B, [d.B for d in slopes])
    n, n_u = plant.B.shape
    place, columns = np.floor(lag).astype(int) - problem.taps[0], np.arange(n_u)

    def spread(now: Array, late: Array, powers: Sequence[Array]) -> Array:
        out = np.zeros((n, len(problem.lags), n_u))
        for j, power in enumerate(powers):  # the input j samples into the step acts through powers[j]
            at = place + problem.stride - 1 - j
            out[:, at, columns] += power @ now
            if len(problem.taps) > 1:
                out[:, at + 1, columns] += power @ late
        return out.reshape(n, -1)

    one = np.eye(n)
    if problem.stride == 1:
        now = spread(plant.B, plant.B_late, [one])
        return single(now, [spread(d.B, d.B_late, [one]) for d in slopes])
    powers = [one]
    for _ in range(problem.stride):
        powers.insert(0, plant.A @ powers[0])
    whole, steps = powers[0], powers[1:]
    result = []
    for d in slopes:
        slopes_of_powers = [np.zeros((n, n))]
        for power in reversed(steps):
            slopes_of_powers.insert(0, d.A @ power + plant.A @ slopes_of_powers[0])
        d_whole, d_steps = slopes_of_powers[0], slopes_of_powers[1:]
        inputs = spread(d.B, d.B_late, steps) + spread(plant.B, plant.B_late, d_steps)
        known = [power @ d.E + slope @ plant.E for power, slope in zip(steps, d_steps, strict=True)]
        result.append(Step(A=d_whole, inputs=inputs, E=np.sum(known, axis=0), known=np.hstack(known)))
    known = [power @ plant.E for power in steps]
    inputs = spread(plant.B, plant.B_late, steps)
    return Step(A=whole, inputs=inputs, E=np.sum(known, axis=0), known=np.hstack(known)), result
