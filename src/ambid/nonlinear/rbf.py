"""Networks of radial basis functions: a linear part beside units about centres (thesis eqs 1.13, 1.14; Billings 2013).

Lags, what units see, number and width (where open, by held-out errors, of the free run for simulation) -> centres ->
regularised least squares -> Levenberg-Marquardt -> simulation errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property, partial
from time import perf_counter
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.linear import triangle_of
from ambid.estimation.progress import Tick, portions
from ambid.nonlinear.fit import (
    NO_WEIGHTS,
    LearningCurve,
    NonlinearFit,
    Settings,
    choice,
    number,
    read_settings,
    whole,
)
from ambid.nonlinear.lagged import Block, LaggedFunction, Linear, Radial, Regressors, channel_names, lags
from ambid.nonlinear.lagged_problem import (
    Draft,
    LaggedProblem,
    Size,
    choose_smallest,
    finish,
    lag_sizes,
    laplace,
    linear_start,
    problem_at,
    refine,
    rms_error,
    split,
    train_watched,
)
from ambid.nonlinear.records import Parts, finite, scaled_records

_NEURONS = (2, 4, 8, 16, 32, 48)  # that are compared
_WIDTHS = (0.35, 0.7, 1.4, 2.8, 5.6)
_FIRST = 12  # units with which lags are compared
_MIDDLE = 1.4  # width, where it is not the question
_AS_GOOD = 1.01
_FAR = 1e6  # times as bad as one step ahead: a free run that diverges
_MOST_ROWS = 4000  # on which units are placed
_CANDIDATES = 200  # of the data that may become a centre
_HELD = 0.01  # part of the variance before the data that is left of a number of the linear part
_DEPENDENT = 1e-10  # squared length left of a candidate that the chosen ones hold already
_BLOCK = 4096
_OPEN = 1e-4  # one over the standard deviation of the linear part and the constant before the data: next to no prior
_GRID = 10.0 ** np.arange(-15.0, 4.0, 0.25)  # of sigma^2 / alpha^2, in squared singular values
_BLIND = 1e-12  # part of the largest singular value of the linear part below which a direction is not there
_FLOOR = 1e-14  # least variance of errors, scaled


@dataclass(frozen=True, slots=True, kw_only=True)
class RbfSettings:
    """Settings of a fit of radial basis functions."""

    ny: int | None = whole("lags of the outputs; chosen by held-out error", 0, 50)
    nu: int | None = whole("lags of each input; chosen by held-out error", 0, 50)
    nk: int = whole("smallest lag of the inputs; 1", 0, 1000, 1)
    linear: int = whole("1 for a linear part with the units, 0 for none; 1", 0, 1, 1)
    neurons: int | None = whole("units; chosen by held-out error", 0, 200)
    width: float | None = number("in sizes of the data; chosen by held-out error", 0.01, 100.0)
    held_out: float = number("part at the end of each record that is held out for validation; 0.2", 0.0, 0.5, 0.2)
    prior: float | None = number(
        "prior standard deviation of the units' weights, scaled; by restricted likelihood", 1e-6, 1e9
    )
    trained: str = choice(
        "weights, or all (centres, widths too, by Levenberg-Marquardt); weights",
        "weights", "all",
    )  # fmt: skip
    iterations: int = whole("of Levenberg-Marquardt, at most; 60", 1, 2000, 60)
    focus: str = choice(
        "prediction or simulation: errors that are minimised in the end; prediction", "prediction", "simulation"
    )
    uncertainty: str = choice(
        "laplace, sandwich (errors may be coloured), none; auto: sandwich for simulation errors",
        "auto", "laplace", "sandwich", "none",
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class RbfFunction(LaggedFunction):
    """yhat(t) = L z + c + W phi, z = [y(t-1), .., y(t-ny), u(t-nk), .., u(t-nk-nu+1)], phi as in `blocks.Radial`."""

    kind: ClassVar[str] = "rbf"
    p: int  # outputs
    m: int  # inputs
    ny: int
    nu: int
    nk: int
    linear: bool  # whether there is a linear part L z beside the units; the constant c is always there
    neurons: int
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
        return Radial(n_outputs=self.p, metric=self.metric, neurons=self.neurons)

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

    def activations(self, theta: NDArray[Any], x: Array) -> NDArray[Any]:
        """Return what the units give for regressors `x`, shape (n, neurons)."""
        own = np.split(theta, self.edges[1:-1])[1]
        return np.exp(-0.5 * self.units.squared(own, x @ self.metric.T))

    def features(self, theta: Array, x: Array) -> Array:
        """Return what weights multiply: regressors, if there is a linear part, one, and activations."""
        return np.hstack([x[:, : self.line.width], np.ones((x.shape[0], 1)), self.activations(theta, x)])

    def with_matrix(self, theta: Array, W: Array) -> Array:
        """Return the parameters with other weights."""
        d = self.line.width
        return np.concatenate([W[:, :d].ravel(), W[:, d], W[:, d + 1 :].ravel(), theta[self.n_weights :]])

    def as_json(self) -> dict[str, Any]:
        """As `LaggedFunction.as_json`."""
        sizes = {"n_outputs": self.p, "n_inputs": self.m, "ny": self.ny, "nu": self.nu, "nk": self.nk}
        sizes |= {"neurons": self.neurons, "linear": int(self.linear)}
        return {"sizes": sizes, "unit": "gaussian", "metric": self.metric.tolist()}

    @classmethod
    def from_json(cls, document: dict[str, Any]) -> Self:
        """Read it back."""
        sizes = {k: int(v) for k, v in document["sizes"].items()}
        p, m, linear = sizes.pop("n_outputs"), sizes.pop("n_inputs"), bool(sizes.pop("linear"))
        width = p * sizes["ny"] + m * sizes["nu"]
        metric = finite(document["metric"], np.size(document["metric"]), "metric").reshape(-1, width)
        if document["unit"] != "gaussian":
            raise ValueError(f"units are {document['unit']!r}, not gaussian")
        return cls(p=p, m=m, linear=linear, metric=metric, **sizes)


def rbf_problem(
    function: RbfFunction, parts: Parts, theta: Array, prior: Array, start: Array, *, all_numbers: bool,
    free: bool = False,
) -> LaggedProblem:  # fmt: skip
    """Return the problem with priors for weights (standard deviation `prior`), centres and widths (about `start`)."""
    n, n_w, network = function.n_theta, function.n_weights, function.units
    widths = np.exp(network.parts(function.split(start)[1])[2])
    precision = np.concatenate(
        [np.full(function.n_line, _OPEN), np.repeat(1.0 / prior, function.neurons),
         np.repeat(1.0 / widths, network.n_seen), np.ones(function.neurons)]
    )  # fmt: skip
    mean = np.concatenate([np.zeros(n_w), start[n_w:]])
    live = np.arange(n) < (n if all_numbers else n_w)
    return problem_at(function, parts, theta, precision, mean=mean, live=live, free=free)


@dataclass(slots=True, kw_only=True)
class _Work(Draft[RbfFunction]):
    """A draft with what is known of its units."""

    start: Array  # (n_theta,), where centres and widths were put
    prior: Array  # (n_outputs,), standard deviation of the units' weights before the data
    all_numbers: bool = False  # whether centres and widths are trained
    at_optimum: bool = True  # so that a covariance makes sense
    width: float = float("nan")

    def problem(self, parts: Parts, theta: Array, *, free: bool = False) -> LaggedProblem:
        """Return what is trained, its errors of unit variance at `theta`."""
        return rbf_problem(self.function, parts, theta, self.prior, self.start, all_numbers=self.all_numbers, free=free)


def rbf(records: Sequence[IOData], settings: Settings, *, seed: int = 0, tick: Tick | None = None) -> NonlinearFit:
    """Identify y(t) = L z + c + W phi(z) + e(t), biased under feedback or with coloured noise, as errors are taken as
    white. Standard deviations exist only without units, or with trained centres and widths: what the choice adds cannot
    be told, and intervals without it hold in as few as half of the places. `seed`: of candidates; `tick`:
    called with the stage, may raise KeyboardInterrupt.
    """
    s = read_settings(RbfSettings, "rbf", settings)
    if s.ny == 0 and s.nu == 0:
        raise EstimationError("rbf: ny and nu are both 0, and nothing is left to predict from. Raise one of them")
    if None in (s.ny, s.nu, s.neurons, s.width) and not s.held_out > 0:
        raise EstimationError(
            "rbf: held_out is 0, but open settings are chosen by held-out errors. Raise it, or give ny, nu, "
            "neurons and width"
        )
    data = scaled_records("rbf", records, lag=max(s.ny or 1, s.nk + (s.nu or 1) - 1))
    # a model without units: something to hand over when the very next thing is an interruption
    function = _function(s, data.parts, 1 if s.ny is None else s.ny, 1 if s.nu is None else s.nu, 0)
    theta = linear_start(function, data.parts, function.n_theta)
    work = _Work(
        structure="rbf", records=records, settings=asdict(s), seed=seed, data=data, function=function, theta=theta,
        start=theta, prior=np.ones(function.p),
    )  # fmt: skip
    reason = work.guarded(lambda: _identify(s, work, tick))
    if work.warnings and work.warnings[0].startswith("interrupted"):
        work.at_optimum = False
    return work.failed(reason) if reason else _finish(s, work)


def _function(s: RbfSettings, parts: Parts, ny: int, nu: int, neurons: int, projected: str = "all") -> RbfFunction:
    p, m = parts[0][0].shape[1], parts[0][1].shape[1]
    nu = nu if m else 0
    outputs = np.arange(p * ny + m * nu) < p * ny
    rows = {"all": np.ones_like(outputs), "outputs": outputs, "inputs": ~outputs}[projected]
    return RbfFunction(
        p=p, m=m, ny=ny, nu=nu, nk=s.nk, linear=bool(s.linear), neurons=neurons, metric=np.eye(outputs.size)[rows],
    )  # fmt: skip


def _measured(function: LaggedFunction, parts: Parts) -> tuple[Array, Array]:
    """Regressors and outputs of all parts."""
    rows = [function.rows(y, u) for y, u in parts]
    return np.concatenate([r.x for r in rows]), np.concatenate([r.y for r in rows])


def _identify(s: RbfSettings, work: _Work, tick: Tick | None) -> None:
    free, parts = s.focus == "simulation", work.data.parts
    ticks = portions(tick, (3.0, 0.5, 3.0 * (s.trained == "all"), 10.0 * free))
    if tick is not None:
        tick("start", 0.0)
    with work.stage("choice"):
        function, start = _choose(s, work, ticks[0])
    if s.neurons is not None and function.neurons < s.neurons:
        work.warnings.append(
            f"{function.neurons} units instead of {s.neurons}: the others would coincide in the data, or there are "
            "fewer than two samples for each"
        )
    if ticks[1] is not None:
        ticks[1]("output weights", 0.0)
    with work.stage("output weights"):
        began = perf_counter()
        x, y = _measured(function, parts)
        theta, _, prior, _ = solve_weights(function, start, x, y, s.prior)
        seconds = np.array([0.0, perf_counter() - began])
        work.function, work.theta, work.start, work.prior = function, theta, start, prior
        training = np.array([_rms(y), rms_error(function, theta, parts)])
        method = "linear least squares, output weights"
        work.curves.append(LearningCurve(method=method, seconds=seconds, training=training))
    work.all_numbers = s.trained == "all" and function.neurons > 0
    with work.stage("training"):
        if work.all_numbers:
            train_watched(
                work, work.problem, s.held_out, "Levenberg-Marquardt, all numbers, one-step errors", ticks[2],
                most=s.iterations, n_linear=function.n_weights,
            )  # fmt: skip
    if free:
        with work.stage("simulation errors"):
            refine(work, partial(work.problem, parts, free=True), s.iterations, ticks[3], "units")
            work.at_optimum = work.at_optimum or (work.free and work.status == "converged")


# --- choice of lags and units ----------------------------------------------------------------------------------------


def _choose(s: RbfSettings, work: _Work, tick: Tick | None) -> tuple[RbfFunction, Array]:
    """Choose what is left open, and place the units, weights of zero: the least that do about as well as the best."""
    parts, seed = work.data.parts, work.seed
    tried, counts = list[Size](), _NEURONS if s.neurons is None else (s.neurons,)

    @cache
    def placing(ny: int, nu: int, projected: str) -> tuple[Placing, Parts]:
        function = _function(s, parts, ny, nu, 0, projected)
        training, validation = split(parts, s.held_out, function.lag)
        return Placing(s, function, training, seed, most=max(counts)), validation

    def score(network: Size, tick: Tick | None) -> float:
        del tick
        at, validation = placing(network["ny"], network["nu"], network["seen"])
        function, start = at.start(network["neurons"], network["width"])
        theta = solve_weights(function, start, at.x, at.y, s.prior).theta
        one_step = rms_error(function, theta, validation)
        run = rms_error(function, theta, validation, free=True) if s.focus == "simulation" else one_step
        return run if np.isfinite(run) else _FAR * one_step

    few = {"neurons": min(max(counts), _FIRST), "width": s.width or _MIDDLE, "seen": "all"}
    sizes = [{**x, **few} for x in lag_sizes(s.ny, s.nu, s.nk, parts, s.held_out)]
    lags_tick, units_tick = portions(tick, (0.2, 0.8))
    best = choose_smallest(sizes, score, tried, _AS_GOOD, lags_tick)
    both = best["ny"] > 0 and best["nu"] > 0 and s.held_out > 0
    sizes = [
        {**best, "neurons": h, "seen": projected, "width": width}
        for h in counts
        for projected in (("outputs", "inputs", "all") if both else ("all",))
        for width in (_WIDTHS if s.width is None else (s.width,))
    ]
    best = choose_smallest(sizes, score, tried, _AS_GOOD, units_tick)
    work.width = best["width"]
    work.details.update(seen=best["seen"], tried=tried)
    function = _function(s, parts, best["ny"], best["nu"], best["neurons"], best["seen"])
    return Placing(s, function, parts, seed, most=best["neurons"]).start(best["neurons"], best["width"])


class Placing:
    """Units' places and widths, centres found once a question, on rows `x`, `y`: all, or some spread evenly."""

    def __init__(self, s: RbfSettings, function: RbfFunction, parts: Parts, seed: int, *, most: int) -> None:
        self.s, self.function, self.seed, self.most = s, function, seed, most
        x, y = _measured(function, parts)
        step = -(-x.shape[0] // _MOST_ROWS)
        self.x, self.y = x[::step], y[::step]
        self.seen = self.x @ function.metric.T
        self.size = typical_size(self.seen)
        self.by_ols = cache(self._order)

    def start(self, neurons: int, width: float) -> tuple[RbfFunction, Array]:
        """Return units with weights of zero; fewer than asked for where the data have no place for more."""
        neurons = min(neurons, max((self.x.shape[0] - self.function.n_line) // 2, 0))  # two samples for each
        C = np.empty((0, self.function.units.n_seen))
        if neurons and C.shape[1]:
            C = self.by_ols(width)[:neurons]
        function = replace(self.function, neurons=C.shape[0])
        widths = np.full(C.shape[0], np.log(width * self.size))
        return function, np.concatenate([np.zeros(function.n_weights), C.ravel(), widths])

    def _order(self, width: float) -> Array:
        n, rng = self.x.shape[0], np.random.default_rng([self.seed, 2])
        C = self.seen[np.sort(rng.permutation(n)[: max(_CANDIDATES, 2 * self.most)])]
        squares = np.zeros((n, C.shape[0]))
        for j in range(C.shape[1]):
            squares += (self.seen[:, j, None] - C[:, j]) ** 2
        basis = np.hstack([self.x if self.s.linear else self.x[:, :0], np.ones((n, 1))])
        return C[ols_order(np.exp(-0.5 * squares / (width * self.size) ** 2), basis, self.y, self.most)]


def typical_size(x: Array) -> float:
    """Return the root mean square distance from the middle of the data."""
    size = float(np.sqrt(np.sum(np.var(x, axis=0))))
    return size if size > 0 else 1.0


def ols_order(candidates: Array, basis: Array, y: Array, most: int) -> list[int]:
    """Return the order of regressors by orthogonal least squares over all outputs, beside some in any case (Chen, Cowan
    and Grant 1991), by Gram-Schmidt on the candidates: units overlap, and their Gram matrix has too few digits.
    """
    free = y.shape[0] - basis.shape[1] - 1
    m, d = candidates.shape[1], basis.shape[1]
    R = triangle_of([np.hstack([basis, candidates, y])])  # the same lengths and angles in fewer rows
    length = np.sum(R[:, d : d + m] ** 2, axis=0)
    left, _ = _beyond(R[:, :d], R[:, d:])
    P, rest = left[:, :m], left[:, m:]
    order: list[int] = []
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
    return order


# --- output weights ---------------------------------------------------------------------------------------------------


class Weights(NamedTuple):
    """Weights with what they came from."""

    theta: Array  # (n_theta,), with the centres and widths of the units
    noise: Array  # (n_outputs,), variance of the errors, scaled, sigma^2
    prior: Array  # (n_outputs,), standard deviation of the units' weights before the data, alpha
    effective: Array  # (n_outputs,), numbers that the data determine


def solve_weights(function: RbfFunction, theta: Array, x: Array, y: Array, prior: float | None) -> Weights:
    """Solve min |y - F l - Phi w|^2 / sigma^2 + |w|^2 / alpha^2 for standing units, l without prior, by one QR of [F |
    Phi | y] and singular values. Open sigma, alpha: restricted likelihood, output by output (Patterson and Thompson
    1971; MacKay's evidence 1992), so that Laplace's covariance is honest.
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
    return Weights(function.with_matrix(theta, np.concatenate([line, w]).T), noise, alpha, effective)


def _beyond(basis: Array, others: Array) -> tuple[Array, int]:
    """Return what known columns, some of which may be the same, leave of others, and the rank of the known ones."""
    U, s, _ = np.linalg.svd(basis, full_matrices=False)
    U = U[:, s > _BLIND * max(float(s[0]), 1e-300)]
    for _ in range(2):  # twice is enough
        others = others - U @ (U.T @ others)
    return others, U.shape[1]


def _ratio(squares: Array, products: Array, rest: float, free: int, prior: float | None) -> tuple[float, float]:
    """Return sigma^2 / alpha^2 and sigma^2."""
    top, free = max(float(squares.max(initial=0.0)), 1e-300), max(free, 1)

    def noise(ratio: Array) -> Array:
        left = rest + np.sum(products[:, None] * ratio / (squares[:, None] + ratio), axis=0)
        variance: Array = np.maximum(left / free, _FLOOR)
        return variance

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


def _rms(e: Array) -> float:
    return float(np.sqrt(np.mean(e**2)))


# --- the fit ----------------------------------------------------------------------------------------------------------


def _finish(s: RbfSettings, work: _Work) -> NonlinearFit:
    network = work.function
    work.settings |= {"ny": network.ny, "nu": network.nu, "neurons": network.neurons, "width": work.width}
    work.settings["prior"] = float(np.exp(np.mean(np.log(work.prior))))
    work.settings["focus"] = "simulation" if work.free else "prediction"
    problem = work.problem(work.data.parts, work.theta, free=work.free)
    if not np.isfinite(problem.cost(work.theta)):
        return work.failed(NO_WEIGHTS)
    posterior = laplace(problem, work.theta)
    why_not = ""
    if network.neurons and not work.all_numbers:
        why_not = (
            "no standard deviations: the choice of the units is not covered, and 95 % intervals without it hold in "
            "half to nine tenths of places. Give trained = all"
        )
    elif not work.at_optimum:
        why_not = "no standard deviations: training has not reached an optimum"
    if posterior.covariance is not None and not why_not:  # numbers of the linear part that only the prior holds
        left = np.diag(posterior.covariance) * problem.precision[problem.live] ** 2
        names = [name for name, x in zip(network.names[: network.n_line], left, strict=False) if x > _HELD]
        if names:
            work.warnings.append(
                f"the data do not distinguish these parameters, whose values are meaningless: {', '.join(names)}. Use "
                "fewer lags, or a richer excitation"
            )
    work.details = {
        "condition": posterior.condition,
        "prior_by_output": work.prior.tolist(),
        "stopped_early": work.stopped_early,
        "held_out_rms": work.held_out,
        **work.details,
    }
    return finish(work, problem, posterior, units="units or lags", how=s.uncertainty, why_not=why_not)
