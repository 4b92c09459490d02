"""Networks of radial basis functions: a linear part beside units about centres (thesis eqs 1.13, 1.14; Billings 2013).

Scale -> lags, what the units see, their number and width (where left open) -> centres -> output weights by regularised
least squares -> all numbers by Levenberg-Marquardt, or recursively, or by steepest descent (options) -> simulation
errors. Lags and units are compared by their error on held-out data, of the free run where the model is to simulate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from time import perf_counter

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.linear import directions
from ambid.estimation.progress import Tick, portions
from ambid.estimation.search import search
from ambid.nonlinear.blocks import UNITS, unit_values
from ambid.nonlinear.fit import NO_WEIGHTS, LearningCurve, NonlinearFit, Settings, failed_fit
from ambid.nonlinear.lagged import LaggedFunction
from ambid.nonlinear.lagged_problem import (
    Draft,
    LaggedProblem,
    finish,
    guarded,
    laplace,
    refine,
    rms_error,
    split,
)
from ambid.nonlinear.rbf_network import (
    DESCENT,
    GAUSS_NEWTON,
    UNBOUNDED,
    RbfFunction,
    k_means,
    neighbour_widths,
    ols_order,
    rbf_problem,
    solve_weights,
    train_by_sample,
    typical_size,
)
from ambid.nonlinear.records import Parts, Scaled, scaled_records
from ambid.nonlinear.settings import choice, number, read_settings, whole

_NEURONS = (2, 4, 8, 16, 32, 48)  # that are compared
_WIDTHS = (0.35, 0.7, 1.4, 2.8, 5.6)
_LAGS = (1, 2, 3, 4, 6)
_FIRST = 12  # units with which lags are compared
_MIDDLE = 1.4  # width, where it is not the question
_AS_GOOD = 1.01
_NEIGHBOURS = 2
_MOST_ROWS = 4000  # on which units are placed
_CANDIDATES = 200  # of the data that may become a centre
_PASSES = 20  # of steepest descent over the records
_NEAR = 1.0  # squared standard deviations from the optimum, of all that is trained together
_HELD = 0.01  # part of the variance before the data that is left of a number of the linear part


@dataclass(frozen=True, slots=True, kw_only=True)
class RbfSettings:
    """Settings of a fit of radial basis functions."""

    ny: int | None = whole("lags of the outputs; chosen by held-out error", 0, 50)
    nu: int | None = whole("lags of each input; chosen by held-out error", 0, 50)
    nk: int = whole("smallest lag of the inputs; 1", 0, 1000, 1)
    linear: int = whole("1 for a linear part beside the units, 0 for none; 1", 0, 1, 1)
    neurons: int | None = whole("units; chosen by held-out error", 0, 200)
    unit: str = choice("gaussian, inverse-multiquadric, thin-plate; gaussian", *UNITS)
    centres: str = choice("ols (orthogonal least squares among the data) or kmeans; ols", "ols", "kmeans")
    width: float | None = number(
        "in sizes of the data, with centres=kmeans in distances of neighbours; chosen by held-out error", 0.01, 100.0
    )
    held_out: float = number("part at the end of each record that is held out for it; 0.2", 0.0, 0.5, 0.2)
    prior: float | None = number(
        "standard deviation of the units' weights before the data, scaled; by restricted likelihood", 1e-6, 1e9
    )
    training: str = choice(
        "linear (least squares), recursive (Gauss-Newton by sample), descent (3.18-3.22); linear",
        "linear", "recursive", "descent",
    )  # fmt: skip
    trained: str = choice(
        "weights, or all (centres, widths too, by Levenberg-Marquardt; with training=linear); weights",
        "weights", "all",
    )  # fmt: skip
    rate: float | None = number(
        "descent: of the steps, 0.02; recursive: least gain, 0 to count all samples alike", 0.0, 1e6
    )
    bounded: int = whole("descent: 1 to bound the rate so that no sample's error grows, 0 as in the thesis; 1", 0, 1, 1)
    iterations: int = whole("of Levenberg-Marquardt, at most; 60", 1, 2000, 60)
    focus: str = choice(
        "prediction or simulation: which errors are made small at last; prediction", "prediction", "simulation"
    )
    uncertainty: str = choice(
        "laplace, sandwich (errors not taken as white), none; auto: sandwich for simulation errors",
        "auto", "laplace", "sandwich", "none",
    )  # fmt: skip


@dataclass(slots=True, kw_only=True)
class _Work(Draft):
    """A draft with what is known of its units."""

    start: Array  # (n_theta,), where centres and widths were put
    prior: Array  # (n_outputs,), standard deviation of the units' weights before the data
    noise: Array | None = None  # (n_outputs,), where the weights' own solution has it
    all_numbers: bool = False  # whether centres and widths are trained
    at_optimum: bool = True  # so that a covariance makes sense
    width: float = float("nan")

    @property
    def network(self) -> RbfFunction:
        """Its function."""
        assert isinstance(self.function, RbfFunction)
        return self.function

    def problem(self, parts: Parts, theta: Array, *, free: bool = False) -> LaggedProblem:
        """Return what is trained, its errors of unit variance at `theta`."""
        found = rbf_problem(self.network, parts, theta, self.prior, self.start, all_numbers=self.all_numbers, free=free)
        if free or self.all_numbers or self.noise is None:
            return found
        return replace(found, weight=found.weight_of(np.diag(self.noise)))


def rbf(records: Sequence[IOData], settings: Settings, *, seed: int = 0, tick: Tick | None = None) -> NonlinearFit:
    """Identify a network of radial basis functions, y(t) = L z + c + W phi(z) + e(t).

    Its errors are taken as white: under feedback, or with coloured noise, it is biased. There are standard deviations
    where centres and widths are trained too, or there are no units: what the choice of units adds cannot be told, and
    intervals without it hold in as few as half of the places. `seed` is that of the candidates among the data, and of
    k-means; `tick` is called with the stage and may raise KeyboardInterrupt.
    """
    s = read_settings(RbfSettings, "rbf", settings)
    if s.rate is None:
        s = replace(s, rate=0.02 if s.training == "descent" else 0.0)
    if s.ny == 0 and s.nu == 0:
        raise EstimationError("rbf: ny and nu are both 0; nothing is left to predict from. Raise one of them")
    _check_consistent(s)
    data = scaled_records("rbf", records, lag=max(s.ny or 1, s.nk + (s.nu or 1) - 1))
    work = _linear(s, data)
    failed = guarded(
        lambda: _identify(s, data, work, seed, tick), work,
        lambda why: failed_fit("rbf", records, asdict(s), seed, why, work.timing_s),
    )  # fmt: skip
    if work.warnings and work.warnings[0].startswith("interrupted"):
        work.at_optimum = False
    return failed or _finish(s, records, data, work, seed)


def _check_consistent(s: RbfSettings) -> None:
    """Refuse settings of which one makes the other void."""
    if s.training == "recursive" and not (s.rate or 0.0) < 1.0:
        raise EstimationError(
            f"rbf: rate is {s.rate:g}; recursive training takes the least gain by it, which must be below 1. "
            "Say 0 to count all samples alike"
        )
    if s.training != "linear" and s.trained == "all":
        raise EstimationError(
            f"rbf: training = {s.training} goes for the output weights alone, but trained = all. Leave one out"
        )
    if s.training == "descent" and not (s.rate or 0.0) > 0.0:
        raise EstimationError("rbf: rate is 0, with which steepest descent does not move. Raise it")
    if None in (s.ny, s.nu, s.neurons, s.width) and not s.held_out > 0:
        raise EstimationError(
            "rbf: held_out is 0, and what is left open is to be chosen by held-out errors. Raise it, or give ny, nu, "
            "neurons and width"
        )


def _function(s: RbfSettings, parts: Parts, ny: int, nu: int, neurons: int, seen: str = "all") -> RbfFunction:
    p, m = parts[0][0].shape[1], parts[0][1].shape[1]
    nu = nu if m else 0
    outputs = np.arange(p * ny + m * nu) < p * ny
    rows = {"all": np.ones_like(outputs), "outputs": outputs, "inputs": ~outputs}[seen]
    return RbfFunction(
        p=p, m=m, ny=ny, nu=nu, nk=s.nk, linear=bool(s.linear), neurons=neurons, unit_name=s.unit,
        metric=np.eye(outputs.size)[rows],
    )  # fmt: skip


def _measured(function: LaggedFunction, parts: Parts) -> tuple[Array, Array]:
    """Regressors and outputs of all parts."""
    rows = [function.rows(y, u) for y, u in parts]
    return np.concatenate([r.x for r in rows]), np.concatenate([r.y for r in rows])


def _linear(s: RbfSettings, data: Scaled) -> _Work:
    """A model without units: something to hand over when the very next thing is an interruption."""
    function = _function(s, data.parts, 1 if s.ny is None else s.ny, 1 if s.nu is None else s.nu, 0)
    x, y = _measured(function, data.parts)
    known = np.hstack([x if s.linear else x[:, :0], np.ones((x.shape[0], 1))])
    found = np.linalg.lstsq(known, y, rcond=1e-12)[0]
    theta = np.concatenate([found[:-1].T.ravel(), found[-1]])
    return _Work(function=function, theta=theta, start=theta, prior=np.ones(y.shape[1]))


def _identify(s: RbfSettings, data: Scaled, work: _Work, seed: int, tick: Tick | None) -> None:
    free = s.focus == "simulation"
    more = s.training != "linear" or s.trained == "all"
    ticks = portions(tick, (3.0, 0.5, 3.0 * more, 10.0 * free))
    began = perf_counter()
    if tick is not None:
        tick("start", 0.0)
    function, start = _choose(s, data.parts, work, seed, ticks[0])
    if s.neurons is not None and function.neurons < s.neurons:
        work.warnings.append(
            f"{function.neurons} units instead of {s.neurons}: more have no place of their own in the data, or there "
            "are fewer than two samples for each"
        )
    began = work.timed("choice", began)
    if ticks[1] is not None:
        ticks[1]("output weights", 0.0)
    _solve(s, function, start, data, work)
    began = work.timed("output weights", began)
    work.all_numbers = s.trained == "all" and function.neurons > 0
    if s.training != "linear":
        _recur(s, data, work, ticks[2])
    elif work.all_numbers:
        _tune(s, data, work, ticks[2])
    began = work.timed("training", began)
    if free:
        refine(work, partial(work.problem, data.parts, free=True), s.iterations, ticks[3], "units")
        work.at_optimum = work.at_optimum or (work.free and work.status == "converged")
        work.timed("simulation errors", began)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Tried:
    """One candidate."""

    ny: int
    nu: int
    neurons: int
    width: float
    seen: str
    score: float  # root mean square error on held-out data, in deviations of the outputs
    one_step: float  # the same of the predictions, where `score` is that of the free run


def _choose(s: RbfSettings, parts: Parts, work: _Work, seed: int, tick: Tick | None) -> tuple[RbfFunction, Array]:
    """Choose what is left open, and place the units, weights of zero: the least that do about as well as the best."""
    ny, nu, tried = _choose_lags(s, parts, seed, tick)
    both = ny > 0 and nu > 0 and parts[0][1].shape[1] > 0
    questions = [
        (seen, width)
        for seen in (("outputs", "inputs", "all") if both else ("all",))
        for width in (_WIDTHS if s.width is None else (s.width,))
    ]
    neurons, width, seen = s.neurons, s.width, questions[0][0]
    if (neurons is None or width is None or both) and s.held_out > 0:
        found: list[_Tried] = []
        for i, (which, w) in enumerate(questions):
            if tick is not None:
                tick("choice of units", 0.2 + 0.8 * i / len(questions))
            found += _scores(s, parts, ny, nu, _NEURONS if neurons is None else (neurons,), w, which, seed)
        tried += found
        one = _least(sorted(found, key=lambda t: t.neurons))
        neurons, width, seen = (one.neurons if neurons is None else neurons), one.width, one.seen
    else:
        seen = "all"
    assert neurons is not None
    assert width is not None
    work.width = width
    work.details.update(seen=seen, tried=[asdict(x) for x in tried])
    placing = Placing(s, _function(s, parts, ny, nu, neurons, seen), parts, seed, most=neurons)
    return placing.start(neurons, width)


def _choose_lags(s: RbfSettings, parts: Parts, seed: int, tick: Tick | None) -> tuple[int, int, list[_Tried]]:
    """Choose the lags with few units of middle width that see all of them."""
    if s.ny is not None and s.nu is not None:
        return s.ny, s.nu, []
    short = min(y.shape[0] for y, _ in parts)
    tries = [k for k in _LAGS if 3 * (k + s.nk) < short * (s.held_out or 0.2)] or [1]
    few, tried = min(_FIRST if s.neurons is None else s.neurons, _FIRST), list[_Tried]()
    for i, k in enumerate(tries):
        if tick is not None:
            tick("choice of lags", 0.2 * i / len(tries))
        ny, nu = (k if s.ny is None else s.ny), (k if s.nu is None else s.nu)
        tried += _scores(s, parts, ny, nu, (few,), s.width or _MIDDLE, "all", seed)
    one = _least(tried)
    return one.ny, one.nu if s.nu is None else s.nu, tried


def _scores(
    s: RbfSettings, parts: Parts, ny: int, nu: int, counts: Sequence[int], width: float, seen: str, seed: int
) -> list[_Tried]:
    function = _function(s, parts, ny, nu, 0, seen)
    training, held = split(parts, s.held_out, function.lag)
    placing, out = Placing(s, function, training, seed, most=max(counts)), list[_Tried]()
    for count in counts:
        at, start = placing.start(count, width)
        theta = solve_weights(at, start, placing.x, placing.y, s.prior).theta
        score = one_step = rms_error(at, theta, held)
        if s.focus == "simulation":
            score = rms_error(at, theta, held, free=True)
        out.append(_Tried(ny=ny, nu=at.nu, neurons=at.neurons, width=width, seen=seen, score=score, one_step=one_step))
    return out


def _least(tried: Sequence[_Tried]) -> _Tried:
    """Return the first that is about as good as the best."""
    scores = [x.score for x in tried]
    if not np.any(np.isfinite(scores)):  # every free run diverges
        scores = [x.one_step for x in tried]
    return tried[next((k for k, x in enumerate(scores) if x <= _AS_GOOD * min(scores)), 0)]


class Placing:
    """Units on some training rows: where they stand and how wide they are; centres are found once for each question.

    `x` and `y` are the rows looked at: all, or some spread evenly over the records where they are many.
    """

    def __init__(self, s: RbfSettings, function: RbfFunction, parts: Parts, seed: int, *, most: int) -> None:
        self.s, self.function, self.seed, self.most = s, function, seed, most
        x, y = _measured(function, parts)
        step = -(-x.shape[0] // _MOST_ROWS)
        self.x, self.y = x[::step], y[::step]
        self.seen = self.x @ function.metric.T
        self.size = typical_size(self.seen)
        self._found: dict[tuple[int, float], Array] = {}

    def start(self, neurons: int, width: float) -> tuple[RbfFunction, Array]:
        """Return units with weights of zero; fewer than asked for where the data have no place for more."""
        C = self._centres(neurons, width)
        function = self.function.with_neurons(C.shape[0])
        widths = np.full(C.shape[0], width * self.size)
        if self.s.centres == "kmeans":
            widths = width * neighbour_widths(C, _NEIGHBOURS, self.size)
        return function, np.concatenate([np.zeros(function.n_weights), C.ravel(), np.log(widths)])

    def _centres(self, neurons: int, width: float) -> Array:
        neurons = min(neurons, max((self.x.shape[0] - self.function.n_line) // 2, 0))  # two samples for each
        if not neurons or not self.function.units.n_seen:
            return np.empty((0, self.function.units.n_seen))
        rng = np.random.default_rng([self.seed, 2])
        if self.s.centres == "kmeans":
            key = (neurons, 0.0)
            if key not in self._found:
                self._found[key] = k_means(self.seen, neurons, rng)
            return self._found[key]
        key = (0, width)
        if key not in self._found:
            self._found[key] = self._by_ols(width, rng)
        return self._found[key][:neurons]

    def _by_ols(self, width: float, rng: np.random.Generator) -> Array:
        n = self.x.shape[0]
        C = self.seen[np.sort(rng.permutation(n)[: max(_CANDIDATES, 2 * self.most)])]
        squares = np.zeros((n, C.shape[0]))
        for j in range(C.shape[1]):
            squares += (self.seen[:, j, None] - C[:, j]) ** 2
        known = np.hstack([self.x if self.s.linear else self.x[:, :0], np.ones((n, 1))])
        order, _ = ols_order(unit_values(self.s.unit, squares / (width * self.size) ** 2), known, self.y, self.most)
        return C[order]


def _solve(s: RbfSettings, function: RbfFunction, start: Array, data: Scaled, work: _Work) -> None:
    """Find the output weights; the error on held-out data is that of weights that have not seen them."""
    began = perf_counter()
    x, y = _measured(function, data.parts)
    found = solve_weights(function, start, x, y, s.prior)
    took = perf_counter() - began
    training, held = split(data.parts, s.held_out, function.lag)
    if held:
        part = solve_weights(function, start, *_measured(function, training), s.prior)
        work.held_out = rms_error(function, part.theta, held)
    work.function, work.theta, work.start, work.prior, work.noise = (
        function, found.theta, start, found.prior, found.noise
    )  # fmt: skip
    training_error = rms_error(function, found.theta, data.parts)
    work.curves.append(
        LearningCurve(
            method="linear least squares, output weights",
            seconds=np.array([0.0, took]),
            training=np.array([float(np.sqrt(np.mean(y**2))), training_error]),
        )
    )


def _tune(s: RbfSettings, data: Scaled, work: _Work, tick: Tick | None) -> None:
    """Go on with centres and widths as well, watched on held-out data, and end on all data."""
    function = work.network
    training, held = split(data.parts, s.held_out, function.lag)
    method = "Levenberg-Marquardt, all numbers, one-step errors"
    if held:
        part = solve_weights(function, work.start, *_measured(function, training), s.prior)
        problem = rbf_problem(function, training, part.theta, part.prior, work.start, all_numbers=True)
        first, tick = portions(tick, (1.0, 1.0))
        watch: Callable[[Array], float] = lambda theta: rms_error(function, theta, held)  # noqa: E731
        found = search(problem, part.theta, stage="training", most=s.iterations, held_out=watch, tick=first)
        work.note(found, problem, method)
        work.held_out, work.stopped_early = watch(found.theta), found.stopped_early
        if found.stopped_early:  # more would learn the noise
            work.theta = found.theta
            return
    for round_ in range(2):  # the errors' sizes are known only afterwards
        problem = work.problem(data.parts, work.theta)
        found = search(problem, work.theta, stage="all data", most=s.iterations, tick=tick)
        work.theta = found.theta
        if not held and not round_:
            work.note(found, problem, method)
    work.status = "converged" if found.converged else "stalled"


def _recur(s: RbfSettings, data: Scaled, work: _Work, tick: Tick | None) -> None:
    """Train sample by sample, from weights of zero; beside steepest descent recursive Gauss-Newton is shown too."""
    problem = work.problem(data.parts, work.theta)
    rate, method = s.rate or 0.0, GAUSS_NEWTON
    if s.training == "descent":
        method = DESCENT if s.bounded else UNBOUNDED
    first, second = portions(tick, (1.0, float(method != GAUSS_NEWTON)))
    theta, curve = train_by_sample(problem, work.theta, method, rate, 1 if method == GAUSS_NEWTON else _PASSES, first)
    work.curves.append(curve)
    if method != GAUSS_NEWTON:
        work.curves.append(train_by_sample(problem, work.theta, GAUSS_NEWTON, 0.0, 1, second)[1])
    work.theta = theta
    R = work.problem(data.parts, theta).triangle(theta[problem.live])
    left = directions(R[:, :-1]).explain(R[:, -1]) if np.all(np.isfinite(R)) else np.inf
    if not left < _NEAR:
        work.status, work.at_optimum = "stalled", False
        work.warnings.append(
            f"{method} has not converged: a batch step would still lower the sum of squares by {left:.3g} times "
            "the errors' variance, and so there are no standard deviations. Say training = linear"
        )


def _finish(s: RbfSettings, records: Sequence[IOData], data: Scaled, work: _Work, seed: int) -> NonlinearFit:
    of = work.network
    used = {**asdict(s), "ny": of.ny, "nu": of.nu, "neurons": of.neurons, "width": work.width}
    used["prior"] = float(np.exp(np.mean(np.log(work.prior))))
    used["focus"] = "simulation" if work.free else "prediction"
    problem = rbf_problem(
        of, data.parts, work.theta, work.prior, work.start, all_numbers=work.all_numbers, free=work.free
    )
    if not np.isfinite(problem.cost(work.theta)):
        return failed_fit("rbf", records, used, seed, NO_WEIGHTS, work.timing_s)
    found = laplace(problem, work.theta)
    why_not = ""
    if of.neurons and not work.all_numbers:
        why_not = (
            "no standard deviations: what the choice of the units adds is not known, and without it intervals of 95 % "
            "for the function hold in half to nine tenths of places. Say trained = all"
        )
    elif not work.at_optimum:
        why_not = "no standard deviations: the training has not come to an optimum"
    work.warnings += _open(problem, None if why_not else found.covariance)
    work.details = {
        "condition": found.condition,
        "prior_by_output": work.prior.tolist(),
        "stopped_early": work.stopped_early,
        "held_out_rms": work.held_out,
        **work.details,
    }
    return finish(
        "rbf", records, used, data, work, problem, found, units="units or lags", how=s.uncertainty, why_not=why_not,
        seed=seed,
    )  # fmt: skip


def _open(problem: LaggedProblem, covariance: Array | None) -> list[str]:
    """Name the numbers of the linear part that only the prior holds, which is next to none."""
    of = problem.function
    assert isinstance(of, RbfFunction)
    if covariance is None:
        return []
    held = np.diag(covariance) * problem.precision[problem.live] ** 2
    names = [name for name, x in zip(of.names[: of.n_line], held, strict=False) if x > _HELD]
    if not names:
        return []
    return [
        f"the data do not tell these numbers apart, their values mean nothing: {', '.join(names)}. Fewer lags, or a "
        "richer excitation"
    ]
