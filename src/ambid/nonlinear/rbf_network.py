"""The function of a network of radial basis functions, its problem, where units stand, and their output weights.

Weights follow from least squares, all at once or sample by sample. Recursive Gauss-Newton is
R <- R + mu (phi phi' - R), w <- w + mu R^-1 phi e, with R kept as its triangle, to which blocks of rows are joined by
orthogonal rotations; with mu = 1/(t + 1) and R_0 the prior's it is recursive least squares, and ends at the solution of
all samples. Steepest descent is w <- w + rate phi e (thesis eq. 3.22, printed as W <- W eta e Phi', its plus sign
lost). One sample's error after a step is (1 - rate |phi|^2) e, so that it grows where the rate is over 2/|phi|^2; a
bounded rate is kept at 1/|phi|^2 at most, as in NLMS.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from time import perf_counter
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.linear import triangle_of
from ambid.estimation.progress import Tick
from ambid.nonlinear.blocks import UNITS, Block, Linear, Radial, unit_values
from ambid.nonlinear.fit import LearningCurve
from ambid.nonlinear.lagged import LaggedFunction, LaggedModel, Regressors, channel_names, lags
from ambid.nonlinear.lagged_problem import LaggedProblem, problem_at
from ambid.nonlinear.records import Parts, finite

_DEPENDENT = 1e-10  # squared length left of a candidate that the chosen ones hold already
_BLOCK = 4096
_OPEN = 1e-4  # one over the standard deviation of the linear part and the constant before the data: next to no prior
_GRID = 10.0 ** np.arange(-15.0, 4.0, 0.25)  # of sigma^2 / alpha^2, in squared singular values
_BLIND = 1e-12  # part of the largest singular value of the linear part below which a direction is not there
_CHUNKS = 8  # of a pass, after each of which the error is looked at
_FLOOR = 1e-14  # least variance of errors, scaled


@dataclass(frozen=True, kw_only=True, eq=False)
class RbfFunction(LaggedFunction):
    """yhat(t) = L z + c + W phi, z = [y(t-1), .., y(t-ny), u(t-nk), .., u(t-nk-nu+1)], phi as in `lagged.Radial`."""

    kind: ClassVar[str] = "rbf"
    p: int  # outputs
    m: int  # inputs
    ny: int
    nu: int
    nk: int
    linear: bool  # whether there is a linear part L z beside the units; the constant c is always there
    neurons: int
    unit_name: str
    metric: Array  # (n_seen, n_regressors), which regressors the units see

    @cached_property
    def regressors(self) -> Regressors:
        """What it looks at."""
        return lags(self.p, self.m, ny=self.ny, nu=self.nu, nk=self.nk)

    @cached_property
    def line(self) -> Linear:
        """The linear part."""
        width = self.regressors.column.size if self.linear else 0
        return Linear.over(self.p, slice(0, width), constant=True)

    @cached_property
    def units(self) -> Radial:
        """The units."""
        return Radial(n_outputs=self.p, metric=self.metric, neurons=self.neurons, unit=self.unit_name)

    @property
    def blocks(self) -> tuple[Block, ...]:
        """What it is the sum of."""
        return self.line, self.units

    @property
    def n_line(self) -> int:
        """Numbers of the linear part."""
        return self.line.n_theta

    @property
    def n_weights(self) -> int:
        """Numbers in L, c and W: those in which the function is linear. They come first."""
        return self.n_line + self.units.sizes[0]

    @property
    def names(self) -> tuple[str, ...]:
        """Of all parameters."""
        channel, h = channel_names("y", self.p), self.neurons
        out = [f"{o}: {x}" for o in channel for x in self.regressors.names if self.linear]
        out += [f"{o}: 1" for o in channel] + [f"{o}: unit {k + 1}" for o in channel for k in range(h)]
        out += [f"unit {k + 1}: centre {j + 1}" for k in range(h) for j in range(self.units.n_seen)]
        return (*out, *(f"unit {k + 1}: log width" for k in range(h)))

    def with_neurons(self, neurons: int) -> Self:
        """Return the same with another number of units."""
        return replace(self, neurons=neurons)

    def activations(self, theta: NDArray[Any], x: Array) -> NDArray[Any]:
        """Return what the units give for regressors `x`, shape (n, neurons)."""
        own = np.split(theta, self.edges[1:-1])[1]
        return unit_values(self.unit_name, self.units.squared(own, x @ self.metric.T))

    def features(self, theta: Array, x: Array) -> Array:
        """Return what weights multiply: regressors, if there is a linear part, one, and activations."""
        return np.hstack([x[:, : self.line.width], np.ones((x.shape[0], 1)), self.activations(theta, x)])

    def matrix(self, theta: Array) -> Array:
        """Return the weights, (n_outputs, n_features)."""
        (L, c), W = self.line.parts(theta[: self.n_line]), theta[self.n_line : self.n_weights].reshape(self.p, -1)
        return np.hstack([L, c[:, None], W])

    def with_matrix(self, theta: Array, W: Array) -> Array:
        """Return the parameters with other weights."""
        d = self.line.width
        return np.concatenate([W[:, :d].ravel(), W[:, d], W[:, d + 1 :].ravel(), theta[self.n_weights :]])

    def as_json(self) -> dict[str, Any]:
        """As `LaggedFunction.as_json`."""
        sizes = {"n_outputs": self.p, "n_inputs": self.m, "ny": self.ny, "nu": self.nu, "nk": self.nk}
        sizes |= {"neurons": self.neurons, "linear": int(self.linear)}
        return {"sizes": sizes, "unit": self.unit_name, "metric": self.metric.tolist()}

    @classmethod
    def from_json(cls, found: dict[str, Any]) -> Self:
        """Read it back."""
        sizes = {k: int(v) for k, v in found["sizes"].items()}
        p, m, linear = sizes.pop("n_outputs"), sizes.pop("n_inputs"), bool(sizes.pop("linear"))
        width = p * sizes["ny"] + m * sizes["nu"]
        metric = finite(found["metric"], np.size(found["metric"]), "metric").reshape(-1, width)
        return cls(p=p, m=m, linear=linear, unit_name=UNITS[UNITS.index(found["unit"])], metric=metric, **sizes)


def read_model(found: dict[str, Any]) -> LaggedModel:
    """Read a network of radial basis functions back."""
    try:
        return RbfFunction.from_json(found).model_from_json(found)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise EstimationError(
            f"no network of radial basis functions ({type(error).__name__}: {error}). Write it again"
        ) from error


def rbf_problem(
    function: RbfFunction, parts: Parts, theta: Array, prior: Array, start: Array, *, all_numbers: bool,
    free: bool = False,
) -> LaggedProblem:  # fmt: skip
    """Return the problem with priors for weights (standard deviation `prior`), centres and widths (about `start`)."""
    n, n_w, of = function.n_theta, function.n_weights, function.units
    widths = np.exp(of.parts(function.split(start)[1])[2])
    precision = np.concatenate(
        [np.full(function.n_line, _OPEN), np.repeat(1.0 / prior, function.neurons),
         np.repeat(1.0 / widths, of.n_seen), np.ones(function.neurons)]
    )  # fmt: skip
    mean = np.concatenate([np.zeros(n_w), start[n_w:]])
    live = np.arange(n) < (n if all_numbers else n_w)
    return problem_at(function, parts, theta, precision, mean=mean, live=live, free=free)


def typical_size(x: Array) -> float:
    """Return the root mean square distance from the middle of the data."""
    found = float(np.sqrt(np.sum(np.var(x, axis=0))))
    return found if found > 0 else 1.0


def k_means(x: Array, k: int, rng: np.random.Generator) -> Array:
    """Return at most `k` centres by k-means++ and Lloyd's iterations; fewer where there are fewer different points."""
    from scipy.cluster.vq import kmeans2

    k = min(k, np.unique(x, axis=0).shape[0])
    with warnings.catch_warnings():  # an empty cluster keeps its centre
        warnings.simplefilter("ignore", UserWarning)
        return np.asarray(kmeans2(x, k, iter=50, minit="++", seed=rng)[0])


def ols_order(candidates: Array, known: Array, y: Array, most: int) -> tuple[NDArray[np.int64], Array]:
    """Choose regressors by orthogonal least squares, beside some that are in the model in any case.

    It takes, again and again, that candidate which explains most of what is left of all outputs (Chen, Cowan and Grant
    1991), by Gram-Schmidt on the candidates themselves: units that overlap are nearly dependent, and their Gram matrix
    has too few digits to tell them apart. Returns their order, and the part of what the known regressors leave of the
    outputs' energy that each explains.
    """
    free = y.shape[0] - known.shape[1] - 1
    m, d = candidates.shape[1], known.shape[1]
    R = triangle_of([np.hstack([known, candidates, y])])  # the same lengths and angles in fewer rows
    length = np.sum(R[:, d : d + m] ** 2, axis=0)
    left, _ = _beyond(R[:, :d], R[:, d:])
    P, rest = left[:, :m], left[:, m:]
    energy = max(float(np.sum(rest**2)), 1e-300)
    order: list[int] = []
    err: list[float] = []
    alive = np.ones(P.shape[1], dtype=bool)
    while len(order) < min(most, free):
        squared = np.sum(P**2, axis=0)
        alive &= squared > _DEPENDENT * length
        if not np.any(alive):
            break
        gain = np.where(alive, np.sum((P.T @ rest) ** 2, axis=1) / np.where(alive, squared, 1.0), -1.0)
        pick = int(np.argmax(gain))
        w = P[:, pick] / np.sqrt(squared[pick])
        P -= np.outer(w, w @ P)
        rest -= np.outer(w, w @ rest)
        alive[pick] = False
        order.append(pick)
        err.append(float(gain[pick]) / energy)
    return np.array(order, dtype=np.int64), np.array(err)


def neighbour_widths(C: Array, among: int, otherwise: float) -> Array:
    """Return the root mean square distance of each centre to its nearest ones (Moody and Darken 1989)."""
    if C.shape[0] < 2:
        return np.full(C.shape[0], otherwise)
    squares = np.sum((C[:, None, :] - C) ** 2, axis=2)
    near = np.sort(squares, axis=1)[:, 1 : 1 + among]
    found = np.sqrt(np.mean(near, axis=1))
    return np.where(found > 1e-6 * otherwise, found, otherwise)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Weights:
    """Weights with what they came from."""

    theta: Array  # (n_theta,), with the centres and widths that were given
    noise: Array  # (n_outputs,), variance of the errors, scaled
    prior: Array  # (n_outputs,), standard deviation of the units' weights before the data, alpha
    effective: Array  # (n_outputs,), numbers that the data determine


def solve_weights(function: RbfFunction, theta: Array, x: Array, y: Array, prior: float | None) -> Weights:
    """Solve for the output weights of units that stand, min |y - F l - Phi w|^2 / sigma^2 + |w|^2 / alpha^2.

    The linear part l has no prior. One QR of [F | Phi | y], then singular values of what F leaves of Phi: every prior
    costs a line. Left open, sigma and alpha are those of the restricted likelihood, output by output (Patterson and
    Thompson 1971; MacKay's evidence 1992), so that Laplace's covariance is honest.
    """
    n, p, h = y.shape[0], function.p, function.neurons
    d = 1 + function.line.width

    def columns(k: int) -> Array:
        part = slice(k, k + _BLOCK)
        return np.hstack([function.features(theta, x[part]), y[part]])

    R = np.zeros((d + h + p, d + h + p))
    with np.errstate(over="ignore", invalid="ignore"):
        small = triangle_of([columns(k) for k in range(0, n, _BLOCK)])
    if not np.all(np.isfinite(small)):
        raise np.linalg.LinAlgError("regressors are not finite")
    R[: small.shape[0]] = small
    left, rank = _beyond(R[:, :d], R[:, d:])
    U, s, Vt = np.linalg.svd(left[:, :h], full_matrices=False)
    g = U.T @ left[:, h:]
    rest = np.sum((left[:, h:] - U @ g) ** 2, axis=0)
    w, noise, alpha, effective = np.zeros((h, p)), np.empty(p), np.empty(p), np.empty(p)
    for o in range(p):
        ratio, noise[o] = _ratio(s**2, g[:, o] ** 2, float(rest[o]), n - rank, prior)
        w[:, o] = Vt.T @ (s / (s**2 + ratio) * g[:, o])
        alpha[o] = np.sqrt(noise[o] / ratio)
        effective[o] = rank + np.sum(s**2 / (s**2 + ratio))
    line = np.linalg.lstsq(R[:, :d], R[:, d + h :] - R[:, d : d + h] @ w, rcond=_BLIND)[0]
    found = function.with_matrix(theta, np.concatenate([line, w]).T)
    return Weights(theta=found, noise=noise, prior=alpha, effective=effective)


def _beyond(known: Array, others: Array) -> tuple[Array, int]:
    """Return what known columns, some of which may be the same, leave of others, and the rank of the known ones."""
    U, s, _ = np.linalg.svd(known, full_matrices=False)
    U = U[:, s > _BLIND * max(float(s[0]), 1e-300)]
    for _ in range(2):  # twice is enough
        others = others - U @ (U.T @ others)
    return others, U.shape[1]


def _ratio(squares: Array, products: Array, rest: float, free: int, prior: float | None) -> tuple[float, float]:
    """Return sigma^2 / alpha^2 and sigma^2."""
    top, free = max(float(squares.max(initial=0.0)), 1e-300), max(free, 1)

    def noise(ratio: Array) -> Array:
        left = rest + np.sum(products[:, None] * ratio / (squares[:, None] + ratio), axis=0)
        found: Array = np.maximum(left / free, _FLOOR)
        return found

    if squares.size == 0:
        sigma2 = float(noise(np.ones(1))[0])
        return sigma2 if prior is None else sigma2 / prior**2, sigma2
    if prior is not None:
        ratio = np.array([_FLOOR])
        for _ in range(30):
            ratio = noise(ratio) / prior**2
        return float(ratio[0]), float(noise(ratio)[0])
    grid = _GRID * top
    for _ in range(3):
        minus_log = free * np.log(noise(grid)) + np.sum(np.log1p(squares[:, None] / grid), axis=0)
        at = int(np.argmin(minus_log))
        low, high = grid[max(at - 1, 0)], grid[min(at + 1, grid.size - 1)]
        best = grid[at]
        grid = np.geomspace(low, high, 21)
    return float(best), float(noise(np.array([best]))[0])


# --- sample by sample -------------------------------------------------------------------------------------------------


GAUSS_NEWTON = "recursive Gauss-Newton, bounded rate"
DESCENT = "steepest descent, bounded rate"
UNBOUNDED = "steepest descent, rate not bounded"


def train_by_sample(
    problem: LaggedProblem, theta: Array, method: str, rate: float, passes: int, tick: Tick | None
) -> tuple[Array, LearningCurve]:
    """Train the weights, from zero, by one of the recursions; `rate` is that of the descent, or the least gain mu."""
    from ambid.nonlinear.lagged_kernels import descent_pass

    of, rows = problem.function, problem.rows()
    assert isinstance(of, RbfFunction)
    y = np.concatenate([r.y for r in rows])
    F = np.ascontiguousarray(of.features(theta, np.concatenate([r.x for r in rows])))
    (N, d), W = F.shape, np.zeros((of.p, F.shape[1]))
    edges = np.unique(np.linspace(0, N, _CHUNKS + 1).astype(np.int64)).tolist()
    descent_pass(F[:0], y[:0], rate, 1, W)  # loads the compiled loop, which is no part of the training
    scale = np.diag(problem.weight)
    prior = [of.matrix(problem.precision)[o] / scale[o] for o in range(of.p)]
    R = [np.hstack([np.diag(own), np.zeros((d, 1))]) for own in prior]
    began, seconds, errors = perf_counter(), [0.0], [_rms(y)]
    for k in range(passes):
        for first, last in pairwise(edges):
            part = slice(first, last)
            if tick is not None:
                tick(method, (k + first / N) / passes)
            if method == GAUSS_NEWTON:
                gain = np.maximum(1.0 / (k * N + np.arange(first, last) + 2.0), rate)
                kept = np.cumprod((1.0 - gain)[::-1])[::-1]
                weight = np.sqrt(gain * np.append(kept[1:], 1.0))[:, None]
                for o in range(of.p):
                    R[o] = triangle_of([np.sqrt(kept[0]) * R[o], weight * np.column_stack([F[part], y[part, o]])])
                    W[o] = np.linalg.solve(R[o][:d, :d], R[o][:d, d])
                at = -1
            else:
                at = int(descent_pass(F[part], y[part], rate, int(method == DESCENT), W))
            if at >= 0 or not np.all(np.isfinite(W)):
                raise FloatingPointError(
                    f"{method} diverged in pass {k + 1} near sample {first + max(at, 0)}: say bounded = 1, or a lower "
                    "rate"
                )
            seconds.append(perf_counter() - began)
            with np.errstate(over="ignore"):
                errors.append(_rms(y - F @ W.T))
    curve = LearningCurve(method=method, seconds=np.array(seconds), training=np.array(errors))
    return of.with_matrix(theta, W), curve


def _rms(e: Array) -> float:
    return float(np.sqrt(np.mean(e**2)))
