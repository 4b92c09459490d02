"""The innovations-form predictor of a linear model as a function of one vector of estimated numbers.

The vector holds, in this order: free and prior physical parameters (over their scales), the fraction of a sample of delay where
it is estimated, the noise description (log noise levels, or the gain itself), constant disturbances (offsets), initial state.
States, inputs and outputs are scaled to order one before anything is factorised.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.identify.innovations import Innovations, gain_derivatives, predictor_gain, stable, stack
from ambid.physics.discretise import DiscreteSpace, discretise
from ambid.physics.models import LinearModel, StateSpace

Array = NDArray[np.float64]
NoiseForm = Literal["levels", "gain"]

_BLOCK = 2048  # samples: sensitivities of one block stay in the second-level cache
_QR_ROWS = 512  # rows of one small QR: below the size at which the linear algebra library starts threads


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scales:
    """Units in which the predictor works.

    Attributes
    ----------
    state : ndarray, shape (n_states,)
    input : ndarray, shape (n_inputs,)
    output : ndarray, shape (n_outputs,)
        About the sensor noise of each output.
    disturbance : ndarray, shape (n_disturbances,)
        Level at which a disturbance moves an output by about its noise within a few samples.
    """

    state: Array
    input: Array
    output: Array
    disturbance: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictorProblem:
    """Data, model and what is to be estimated.

    Attributes
    ----------
    model : LinearModel
    rate_hz : float
    u : ndarray, shape (n_samples, n_inputs), deviations from the operating point, SI
    y : ndarray, shape (n_samples, n_outputs), deviations from the operating point, SI
    estimated : tuple of str
        Physical parameters in the vector.
    known : Mapping[str, float]
        The others, SI.
    magnitude : ndarray, shape (n_estimated,)
        Scale of each estimated physical parameter, SI.
    prior_mean, prior_sd : ndarray, shape (n_estimated,), SI
        Standard deviation infinite where there is no prior.
    scales : Scales
    delay : int
        Whole samples of delay on all inputs.
    lag : float
        Fraction of a sample of delay on top, 0 <= lag < 1, where it is not estimated.
    fractional : bool
        Whether the delay is estimated as a real number near `delay`: delay - 1 < total < delay + 2.
    skip : int
        Samples left out at the start, so that fits with different delays see the same data; at least ``delay + 2``.
    noise : {"levels", "gain"}
        Noise as disturbance and sensor levels through the Riccati equation, or as a free predictor gain.
    noise_center : ndarray
        Centre of the weak prior on the log noise levels.
    """

    model: LinearModel
    rate_hz: float
    u: Array
    y: Array
    estimated: tuple[str, ...]
    known: Mapping[str, float]
    magnitude: Array
    prior_mean: Array
    prior_sd: Array
    scales: Scales
    delay: int = 0
    lag: float = 0.0
    fractional: bool = False
    skip: int = 2
    noise: NoiseForm = "levels"
    noise_center: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def n_physical(self) -> int:
        """Number of estimated physical parameters."""
        return len(self.estimated)

    @property
    def slices(self) -> dict[str, slice]:
        """Places of the groups in the vector."""
        n, n_y, n_d = len(self.model.states), len(self.model.outputs), len(self.model.disturbances)
        sizes = {
            "physical": self.n_physical,
            "fraction": int(self.fractional),
            "noise": n_d + n_y - 1 if self.noise == "levels" else n * n_y,
            "offset": n_d,
            "initial": n,
        }
        edges = np.cumsum([0, *sizes.values()])
        return {name: slice(int(a), int(b)) for name, a, b in zip(sizes, edges[:-1], edges[1:], strict=True)}

    @property
    def taps(self) -> tuple[int, ...]:
        """Lags beyond `delay`, in samples, at which the input enters the recursion."""
        if self.fractional:
            return (-1, 0, 1, 2)
        return (0, 1) if self.lag else (0,)

    @property
    def size(self) -> int:
        """Length of the vector."""
        return self.slices["initial"].stop

    @property
    def n_used(self) -> int:
        """Samples that enter the fit."""
        return self.y.shape[0] - self.skip

    def parameters(self, vector: Array) -> dict[str, float]:
        """Return all physical parameters in SI at `vector`.

        Parameters
        ----------
        vector : ndarray, shape (size,)

        Returns
        -------
        dict of str to float
        """
        values = vector[self.slices["physical"]] * self.magnitude
        return {**self.known, **dict(zip(self.estimated, values.tolist(), strict=True))}

    def delay_samples(self, vector: Array) -> float:
        """Return the whole delay at `vector` in samples, with its fraction where that is estimated."""
        return self.delay + self.lag_at(vector)

    def lag_at(self, vector: Array) -> float:
        """Return the delay in samples beyond `delay` at `vector`."""
        return float(vector[self.slices["fraction"]][0]) if self.fractional else self.lag


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Predictor:
    """The assembled recursion at one vector, in scaled units.

    Attributes
    ----------
    M : ndarray, shape (n, n + n_z)
        [F, B.., K, offset]: x+ = M [x; u(k-d+1) .. u(k-d-2); y; 1].
    dM : ndarray, shape (n, n + n_z, size)
        Exact derivative by every estimated number.
    C : ndarray, shape (n_y, n)
    x0 : ndarray, shape (n,)
    discrete : DiscreteSpace
        Scaled discrete plant.
    gain : ndarray, shape (n, n_y)
    innovations : Innovations or None
        Riccati solution, where the noise is described by levels.
    """

    M: Array
    dM: Array
    C: Array
    x0: Array
    discrete: DiscreteSpace
    gain: Array
    innovations: Innovations | None


class Workspace:
    """What repeated evaluations of one problem share: scaled data, buffers, and the last gain as a start for the next Riccati solve.

    Parameters
    ----------
    problem : PredictorProblem

    Attributes
    ----------
    y : ndarray, shape (n_used, n_outputs)
        Scaled outputs.
    w : ndarray, shape (n_used, n_states + n_taps n_inputs + n_outputs + 1)
        Columns: predictor state (filled by each run), inputs at the lags of `taps`, y(k), 1.
    gain : ndarray or None
    """

    def __init__(self, problem: PredictorProblem) -> None:
        first, last, d, n = problem.skip, problem.y.shape[0], problem.delay, len(problem.model.states)
        if first <= d + 1 or last - first < 1:
            raise ValueError(f"skip {first} must exceed the delay {d} by two and leave samples of the {last}")
        self.y = np.ascontiguousarray(problem.y[first:] / problem.scales.output)
        # the sample after the last one does not exist; it would matter only after the end of the record
        u = np.vstack([problem.u, problem.u[-1:]]) / problem.scales.input
        lagged = [u[first - d - t : last - d - t] for t in problem.taps]
        one = np.ones((self.y.shape[0], 1))
        self.w = np.hstack([np.zeros((self.y.shape[0], n)), *lagged, self.y, one])
        self.gain: Array | None = None


def assemble(
    problem: PredictorProblem, vector: Array, *, work: Workspace | None = None, with_derivatives: bool = True
) -> Predictor | None:
    """Build the predictor and its derivatives at `vector`.

    Parameters
    ----------
    problem : PredictorProblem
    vector : ndarray, shape (size,)
    work : Workspace, optional
        Its last gain starts the Riccati solve, and is replaced.
    with_derivatives : bool
        Leave the derivatives out where only innovations are wanted.

    Returns
    -------
    Predictor or None
        None where the vector makes no stable predictor or no physical plant (mass or inductance not positive).
    """
    model, sc, sl = problem.model, problem.scales, problem.slices
    theta = problem.parameters(vector)
    if not np.all(np.isfinite(vector)) or any(theta[p.name] <= 0 for p in model.parameters if p.name in ("m", "L")):
        return None
    lag = problem.lag_at(vector)
    if not (-1.0 < lag < 2.0 and problem.delay + lag >= 0.0):
        return None
    whole = int(np.floor(lag))
    directions = (
        [
            _scaled(model.derivative(theta, name), sc, h)
            for name, h in zip(problem.estimated, problem.magnitude, strict=True)
        ]
        if with_derivatives
        else []
    )
    fraction = lag - whole if len(problem.taps) > 1 else None
    try:
        plant, slopes = discretise(
            _scaled(model.matrices(theta), sc), 1.0 / problem.rate_hz, fraction=fraction, derivatives=directions
        )
        slopes = slopes[: problem.slices["fraction"].stop]
        K, dK, inner = _gain(problem, vector, plant, slopes if with_derivatives else None, work)
    except (np.linalg.LinAlgError, ValueError):
        return None
    F = plant.A - K @ plant.C
    if not stable(F):
        return None
    offset = vector[sl["offset"]]
    place = problem.taps.index(whole)

    def inputs(now: Array, late: Array) -> Array:
        """Put the two input matrices at their lags."""
        spread = np.zeros((now.shape[0], len(problem.taps), now.shape[1]))
        spread[:, place] = now
        if fraction is not None:
            spread[:, place + 1] = late
        return spread.reshape(now.shape[0], -1)

    M = np.hstack([F, inputs(plant.B, plant.B_late), K, (plant.E @ offset)[:, None]])
    dM = np.zeros((*M.shape, problem.size if with_derivatives else 0))
    if with_derivatives:
        for q, d in enumerate(slopes):  # physical parameters, then the fraction
            dM[:, :, q] = np.hstack([d.A, inputs(d.B, d.B_late), np.zeros_like(K), (d.E @ offset)[:, None]])
        n, first_y = F.shape[0], M.shape[1] - 1 - K.shape[1]
        # dK holds physical parameters, fraction and noise in the order of the vector
        dM[:, :n, : len(dK)] -= np.moveaxis(dK @ plant.C, 0, 2)
        dM[:, first_y:-1, : len(dK)] += np.moveaxis(dK, 0, 2)
        dM[:, -1, sl["offset"]] = plant.E
    return Predictor(
        M=M,
        dM=dM,
        C=np.ascontiguousarray(plant.C),
        x0=vector[sl["initial"]].copy(),
        discrete=plant,
        gain=K,
        innovations=inner,
    )


def _scaled(space: StateSpace, sc: Scales, factor: float = 1.0) -> StateSpace:
    """Scale states, inputs, outputs and disturbances; `factor` turns a derivative by a parameter into one by its scaled value."""
    return StateSpace(
        A=factor * space.A * sc.state / sc.state[:, None],
        B=factor * space.B * sc.input / sc.state[:, None],
        E=factor * space.E * sc.disturbance / sc.state[:, None],
        C=factor * space.C * sc.state / sc.output[:, None],
    )


def _gain(
    problem: PredictorProblem,
    vector: Array,
    plant: DiscreteSpace,
    slopes: tuple[DiscreteSpace, ...] | None,
    work: Workspace | None,
) -> tuple[Array, Array, Innovations | None]:
    """Predictor gain and its derivatives by physical parameters, fraction and noise numbers."""
    (n, n_d), n_y = plant.E.shape, plant.C.shape[0]
    noise = vector[problem.slices["noise"]]
    n_slopes = 0 if slopes is None else len(slopes)
    size = n_slopes + noise.size
    if problem.noise == "gain":
        dK = np.zeros((size, n, n_y))
        dK[n_slopes:] = np.eye(n * n_y).reshape(n * n_y, n, n_y)
        return noise.reshape(n, n_y), dK, None
    variance = np.exp(2 * noise[:n_d])
    sensor = np.r_[1.0, np.exp(2 * noise[n_d:])]
    near = None if work is None else work.gain
    at = predictor_gain(plant.A, plant.C, (plant.E * variance) @ plant.E.T, np.diag(sensor), near=near)
    if work is not None:
        work.gain = at.K
    if slopes is None:
        return at.K, np.zeros((0, n, n_y)), at
    dA = np.concatenate([stack([d.A for d in slopes], (n, n)), np.zeros((noise.size, n, n))])
    dQ, dR = np.zeros((size, n, n)), np.zeros((size, n_y, n_y))
    for q, d in enumerate(slopes):
        half = (d.E * variance) @ plant.E.T
        dQ[q] = half + half.T
    for j in range(noise.size):
        if j < n_d:
            dQ[n_slopes + j] = 2 * variance[j] * np.outer(plant.E[:, j], plant.E[:, j])
        else:
            dR[n_slopes + j, j - n_d + 1, j - n_d + 1] = 2 * sensor[j - n_d + 1]
    return at.K, gain_derivatives(plant.A, plant.C, at, dA, dQ, dR), at


def innovations(problem: PredictorProblem, vector: Array, work: Workspace | None = None) -> Array | None:
    """Return the innovations in scaled output units.

    Parameters
    ----------
    problem : PredictorProblem
    vector : ndarray, shape (size,)
    work : Workspace, optional
        Of this problem, to save making it again.

    Returns
    -------
    ndarray, shape (n_used, n_outputs), or None where there is no predictor at `vector`
    """
    from ambid.identify._kernels import innovations_block

    work = work or Workspace(problem)
    predictor = assemble(problem, vector, work=work, with_derivatives=False)
    if predictor is None:
        return None
    e = np.empty_like(work.y)
    innovations_block(predictor.M, predictor.C, work.y, work.w, predictor.x0, e)
    return e if np.all(np.isfinite(e[-1])) else None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearisation:
    """Weighted innovations and Jacobian at one vector, compressed by QR.

    Attributes
    ----------
    r : ndarray, shape (size + 1,)
    J : ndarray, shape (size + 1, size)
        Same norm, gradient and singular values as the full residual and Jacobian: they differ by an orthogonal matrix.
    covariance : ndarray, shape (n_outputs, n_outputs)
        Mean of e e^T, scaled output units.
    """

    r: Array
    J: Array
    covariance: Array


def linearise(
    problem: PredictorProblem, vector: Array, weight: Array, work: Workspace | None = None
) -> Linearisation | None:
    """Return the compressed weighted residual and its exact Jacobian.

    Parameters
    ----------
    problem : PredictorProblem
    vector : ndarray, shape (size,)
    weight : ndarray, shape (n_outputs, n_outputs)
        Lower triangular W with W^T W the inverse innovation covariance (scaled).
    work : Workspace, optional
        Of this problem.

    Returns
    -------
    Linearisation or None where there is no predictor at `vector`
    """
    work = work or Workspace(problem)
    p, factors, moment = problem.size, list[Array](), np.zeros_like(weight)
    for e, rows in residual_blocks(problem, vector, weight, work):
        moment += e.T @ e
        whole = rows.shape[0] // _QR_ROWS * _QR_ROWS
        if whole:
            factors.append(np.linalg.qr(rows[:whole].reshape(-1, _QR_ROWS, p + 1), mode="r").reshape(-1, p + 1))
        factors.append(rows[whole:])
    if not factors or not np.all(np.isfinite(moment)):
        return None
    reduced = np.linalg.qr(np.vstack(factors), mode="r")
    full = np.zeros((p + 1, p + 1))
    full[: reduced.shape[0]] = reduced
    return Linearisation(r=full[:, p].copy(), J=full[:, :p].copy(), covariance=moment / (problem.n_used))


def residual_blocks(
    problem: PredictorProblem, vector: Array, weight: Array, work: Workspace
) -> Iterator[tuple[Array, Array]]:
    """Yield innovations and rows [W de/dq, W e] block after block, so that memory does not grow with the record.

    Parameters
    ----------
    problem : PredictorProblem
    vector : ndarray, shape (size,)
    weight : ndarray, shape (n_outputs, n_outputs)
    work : Workspace

    Yields
    ------
    e : ndarray, shape (block, n_outputs)
        Innovations, scaled, unweighted.
    rows : ndarray, shape (block * n_outputs, size + 1)
        Time runs slowest. Nothing is yielded where there is no predictor at `vector`.
    """
    from ambid.identify._kernels import innovations_block, sensitivity_scan

    predictor = assemble(problem, vector, work=work)
    if predictor is None:
        return
    n, p, n_y, n_used = predictor.x0.size, problem.size, work.y.shape[1], work.y.shape[0]
    # a state basis in which the weighted outputs are the first n_y states: sensitivities are then read off, not multiplied
    whitened = weight @ predictor.C
    basis = np.vstack([whitened, null_space(whitened)])
    inverse = np.linalg.inv(basis)
    n_l = predictor.M.shape[1]
    forcing = np.zeros((n_l, n, p + 1))
    forcing[:, :, :p] = np.einsum("ab,blq->laq", basis, predictor.dM)
    forcing = forcing.reshape(n_l, -1)
    F = basis @ predictor.M[:, :n] @ inverse
    s = np.zeros((min(_BLOCK, n_used) + 1, n, p + 1))
    s[0, :, problem.slices["initial"]] = basis
    x = predictor.x0
    for a in range(0, n_used, _BLOCK):
        b = min(a + _BLOCK, n_used)
        e, block = np.empty((b - a, n_y)), s[: b - a + 1]
        innovations_block(predictor.M, predictor.C, work.y[a:b], work.w[a:b], x, e)
        np.matmul(work.w[a:b], forcing, out=block[1:].reshape(b - a, -1))
        sensitivity_scan(F, block)
        rows = -block[:-1, :n_y]
        rows[:, :, p] = e @ weight.T
        yield e, rows.reshape(-1, p + 1)
        s[0] = block[-1]


def null_space(a: Array) -> Array:
    """Return orthonormal rows that complete the row space of a full-rank wide matrix.

    Parameters
    ----------
    a : ndarray, shape (r, n), r <= n

    Returns
    -------
    ndarray, shape (n - r, n)
    """
    q, _ = np.linalg.qr(a.T, mode="complete")
    return np.ascontiguousarray(q[:, a.shape[0] :].T)
