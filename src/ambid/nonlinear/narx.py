"""Neural NARX: a linear part and one hidden layer of tanh units on lagged outputs and inputs (Billings 2013, sec. 8.2).

Lags and neurons (where open) -> several random starts watched on held-out data -> the best on all -> simulation errors
(option) -> covariance (Laplace, sandwich). Scaled hidden weights are N(0, prior^2): it counts only where the
data do not speak (units alike), and makes the information matrix regular.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from typing import Any, ClassVar, Self

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.progress import Tick, portions
from ambid.estimation.search import Found, search
from ambid.nonlinear.fit import NO_WEIGHTS, NonlinearFit, Settings, choice, number, read_settings, whole
from ambid.nonlinear.lagged import Block, LaggedFunction, Linear, Regressors, Tanh, channel_names, lags
from ambid.nonlinear.lagged_problem import (
    Draft,
    LaggedProblem,
    Size,
    choose_smallest,
    draw_start,
    finish,
    lag_sizes,
    laplace,
    linear_start,
    problem_at,
    refine,
    rms_error,
    solve_linear,
    split,
    train_watched,
)
from ambid.nonlinear.records import Parts, scaled_records

_LINEAR_PRIOR = 1e3  # times that of the hidden layer: next to none
_DRAWS = 5  # of the hidden layer of a start
_ENOUGH = 1e-2  # gain that ends a search: a step of 0.1 standard deviations
_FIRST = 12  # iterations of every start; only the best goes on
_NEURONS = (2, 4, 8, 12)
_FIRST_NEURONS = 4  # with which lags are compared
_AS_GOOD = 1.02
_MOST_ROWS = 6000  # that a comparison looks at
_ITERATIONS = 15  # of a comparison


@dataclass(frozen=True, slots=True, kw_only=True)
class NarxSettings:
    """Settings of a neural NARX fit."""

    ny: int | None = whole("lags of the outputs; chosen by held-out error", 0, 50)
    nu: int | None = whole("lags of each input; chosen by held-out error", 0, 50)
    nk: int = whole("smallest lag of the inputs; 1", 0, 1000, 1)
    neurons: int | None = whole("hidden units; chosen by held-out error", 0, 60)
    starts: int = whole("random starts; 3", 1, 50, 3)
    held_out: float = number("part at the end of each record on which training is monitored; 0.2", 0.0, 0.5, 0.2)
    prior: float = number("prior standard deviation of the hidden layer's weights, scaled signals; 10", 0.01, 1e6, 10.0)
    iterations: int = whole("of each training, at most; 60", 1, 2000, 60)
    focus: str = choice(
        "prediction or simulation: errors that are minimised in the end; prediction", "prediction", "simulation"
    )
    uncertainty: str = choice(
        "laplace, sandwich (coloured errors), none, auto (sandwich for simulation); auto",
        "auto", "laplace", "sandwich", "none",
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class NarxFunction(LaggedFunction):
    """yhat(t) = L z + c + W2 tanh(W1 z + b1), z = [y(t-1), .., y(t-ny), u(t-nk), .., u(t-nk-nu+1)]."""

    kind: ClassVar[str] = "narx"
    p: int  # outputs
    m: int  # inputs
    ny: int
    nu: int
    nk: int
    neurons: int

    @cached_property
    def regressors(self) -> Regressors:
        """What it looks at."""
        return lags(self.p, self.m, ny=self.ny, nu=self.nu, nk=self.nk)

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """What it is the sum of."""
        d = self.regressors.column.size
        linear = Linear.over(self.p, slice(0, d), constant=True)
        return linear, Tanh(n_outputs=self.p, width=d, neurons=self.neurons)

    @property
    def n_linear(self) -> int:
        """Leading numbers that one-step errors are linear in: L, c, W2."""
        return int(self.edges[1]) + self.p * self.neurons

    @property
    def names(self) -> tuple[str, ...]:
        """Of all parameters."""
        z, channel = self.regressors.names, channel_names("y", self.p)
        out = [f"{o}: {x}" for o in channel for x in z] + [f"{o}: 1" for o in channel]
        out += [f"{o}: unit {k + 1}" for o in channel for k in range(self.neurons)]
        out += [f"unit {k + 1}: {x}" for k in range(self.neurons) for x in z]
        return (*out, *(f"unit {k + 1}: 1" for k in range(self.neurons)))

    def precision(self, prior: float) -> Array:
        """Return one over the prior's standard deviation of every number."""
        out = np.full(self.n_theta, 1.0 / prior)
        out[: self.edges[1]] /= _LINEAR_PRIOR
        return out

    def as_json(self) -> dict[str, Any]:
        """As `LaggedFunction.as_json`."""
        sizes = {"ny": self.ny, "nu": self.nu, "nk": self.nk, "neurons": self.neurons}
        return {"sizes": {"n_outputs": self.p, "n_inputs": self.m, **sizes}}

    @classmethod
    def from_json(cls, document: dict[str, Any]) -> Self:
        """Read it back."""
        sizes = {k: int(v) for k, v in document["sizes"].items()}
        return cls(p=sizes.pop("n_outputs"), m=sizes.pop("n_inputs"), **sizes)


def narx(records: Sequence[IOData], settings: Settings, *, seed: int = 0, tick: Tick | None = None) -> NonlinearFit:
    """Identify a neural NARX model, y(t) = L z + c + W2 tanh(W1 z + b1) + e(t), biased under feedback or with coloured
    noise, as errors are taken as white. `seed`: of starts; `tick`: called with the stage, may raise
    KeyboardInterrupt.
    """
    s = read_settings(NarxSettings, "narx", settings)
    if s.ny == 0 and s.nu == 0:
        raise EstimationError("narx: ny and nu are both 0, and nothing is left to predict from. Raise one of them")
    data = scaled_records("narx", records, lag=max(s.ny or 1, s.nk + (s.nu or 1) - 1))
    function = _function(data.parts, 1 if s.ny is None else s.ny, 1 if s.nu is None else s.nu, s.nk, 0)
    draft = Draft(
        structure="narx", records=records, settings=asdict(s), seed=seed, data=data, function=function,
        theta=linear_start(function, data.parts, int(function.edges[1])),  # for an interruption at once
    )  # fmt: skip
    if reason := draft.guarded(lambda: _identify(s, draft, tick)):
        return draft.failed(reason)
    network = draft.function
    draft.settings |= {"ny": network.ny, "nu": network.nu, "neurons": network.neurons}
    draft.settings["focus"] = "simulation" if draft.free else "prediction"
    problem = narx_problem(network, data.parts, draft.theta, s.prior, free=draft.free)
    if not np.isfinite(problem.cost(draft.theta)):
        return draft.failed(NO_WEIGHTS)
    draft.details = {"stopped_early": draft.stopped_early, "held_out_rms": draft.held_out, **draft.details}
    return finish(draft, problem, laplace(problem, draft.theta), units="neurons or lags", how=s.uncertainty)


def _function(parts: Parts, ny: int, nu: int, nk: int, neurons: int) -> NarxFunction:
    p, m = parts[0][0].shape[1], parts[0][1].shape[1]
    return NarxFunction(p=p, m=m, ny=ny, nu=nu if m else 0, nk=nk, neurons=neurons)


def narx_problem(
    function: NarxFunction, parts: Parts, theta: Array, prior: float, *, free: bool = False
) -> LaggedProblem:
    """Return the problem whose errors have unit variance at given weights."""
    return problem_at(function, parts, theta, function.precision(prior), free=free)


def _identify(s: NarxSettings, draft: Draft[NarxFunction], tick: Tick | None) -> None:
    free, parts = s.focus == "simulation", draft.data.parts
    choosing, training, refining = portions(tick, (3.0, 5.0, 8.0 * free))
    with draft.stage("choice"):
        function = _choose_sizes(s, draft, choosing)
    with draft.stage("training"):
        _train_all(s, function, draft, training)
    if free:
        with draft.stage("simulation errors"):
            problem_of = partial(narx_problem, function, parts, prior=s.prior, free=True)
            refine(draft, problem_of, s.iterations, refining, "neurons")


def _choose_sizes(s: NarxSettings, draft: Draft[NarxFunction], tick: Tick | None) -> NarxFunction:
    """Choose what is left open of lags and neurons; each candidate is trained for a while on part of the data."""
    share, tried, parts = s.held_out or 0.2, list[Size](), draft.data.parts
    draft.details["tried"] = tried

    def score(size: Size, tick: Tick | None) -> float:
        function = _function(parts, size["ny"], size["nu"], s.nk, size["neurons"])
        most = max(_MOST_ROWS // len(parts), 4 * function.lag + 40)
        training, validation = split(tuple((y[:most], u[:most]) for y, u in parts), share, function.lag)
        problem = narx_problem(function, training, linear_start(function, training, int(function.edges[1])), s.prior)
        start = _random_start(problem, function, np.random.default_rng(draft.seed))
        watch = partial(_error, function, validation)
        return min(
            _train(problem, function, start, stage="choice", most=_ITERATIONS, held_out=watch, tick=tick).held_out
        )

    few = {"neurons": _FIRST_NEURONS if s.neurons is None else s.neurons}
    sizes = [{**x, **few} for x in lag_sizes(s.ny, s.nu, s.nk, parts, share)]
    lags_tick, units_tick = portions(tick, (1.0, 1.0))
    best = choose_smallest(sizes, score, tried, _AS_GOOD, lags_tick)
    sizes = [{**best, "neurons": h} for h in (_NEURONS if s.neurons is None else (s.neurons,))]
    best = choose_smallest(sizes, score, tried, _AS_GOOD, units_tick)
    return _function(parts, best["ny"], best["nu"], s.nk, best["neurons"])


def _random_start(problem: LaggedProblem, function: NarxFunction, rng: np.random.Generator) -> Array:
    width = function.regressors.column.size
    return draw_start(problem, function.n_linear, problem.base, function.neurons, width, rng, _DRAWS)


def _error(function: NarxFunction, parts: Parts, theta: Array) -> float:
    return rms_error(function, theta, parts)


def _train(problem: LaggedProblem, function: NarxFunction, start: Array, **options: Any) -> Found:
    """Search for a while, everything linear at its best for the hidden layer (Golub and Pereyra 1973)."""
    n = function.n_linear
    return search(problem, start, slack=0.0, solved=partial(solve_linear, problem, n), n_linear=n, **options)


def _train_all(s: NarxSettings, function: NarxFunction, draft: Draft[NarxFunction], tick: Tick | None) -> None:
    """Train from several starts, and go on with the best."""
    training, validation = split(draft.data.parts, s.held_out, function.lag)
    draft.function, draft.theta = function, linear_start(function, training, int(function.edges[1]))
    problem = narx_problem(function, training, draft.theta, s.prior)
    rng, least = np.random.default_rng(draft.seed), np.inf
    watch = partial(_error, function, validation) if validation else None
    starts = s.starts if function.neurons else 1
    first, second = portions(tick, (starts * _FIRST, 2 * _FIRST * (1 + bool(validation))))
    for share in portions(first, (1.0,) * starts):
        start, most = _random_start(problem, function, rng), min(_FIRST, s.iterations)
        ended = _train(problem, function, start, stage="starts", most=most, held_out=watch, tick=share)
        error = min(ended.held_out) if validation else ended.cost
        if error < least:
            least = error
            draft.keep(ended.theta)
    ended = train_watched(
        draft, partial(narx_problem, function, prior=s.prior), s.held_out, "Levenberg-Marquardt, prediction errors",
        second, most=s.iterations, enough=_ENOUGH, n_linear=function.n_linear,
    )  # fmt: skip
    if not ended.converged and len(ended.costs) > s.iterations:  # a valley of networks that differ little
        lately = 50.0 * (1.0 - ended.costs[-1] / ended.costs[-min(11, len(ended.costs))])
        draft.warnings.append(
            f"training was still improving at its limit of {s.iterations} iterations, by {lately:.1g} % over the "
            "last ten: raise iterations if that matters. Standard deviations are those of a linearisation there"
        )
