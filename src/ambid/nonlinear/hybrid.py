"""Hybrid NARMAX and network from records, by prediction errors (thesis eqs 3.23, 3.24).

yhat(t) = P(y, u) theta + W2 tanh(W1 z + b1) + (C(q^-1) - 1) e(t), z = [y(t-1).., u(t-nk)..], C = 1 + C1 q^-1 + .. of
`ne` matrices. Terms by orthogonal least squares (`narmax`) -> neurons by held-out errors -> network on what they leave,
from several starts -> all by Levenberg-Marquardt -> terms that no longer pay, order of C -> Laplace's covariance.
Scaled hidden weights are N(0, prior^2), polynomial and C have no prior: what the polynomial can do costs nothing. A
root of C outside the unit circle has an infinite cost: a shorter step is tried.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from time import perf_counter
from typing import Any, ClassVar, Self

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.linear import information_inverse
from ambid.estimation.progress import Tick, guessed, part_of, portions
from ambid.estimation.search import search
from ambid.estimation.uncertainty import penalty
from ambid.nonlinear.fit import Attempt, NonlinearFit, Settings, number, read_settings, whole
from ambid.nonlinear.lagged import (
    Block,
    LaggedFunction,
    LaggedModel,
    Linear,
    Regressors,
    Table,
    Tanh,
    channel_names,
    lags,
)
from ambid.nonlinear.lagged_problem import (
    Draft,
    LaggedProblem,
    Laplace,
    choose_smallest,
    draw_start,
    finish,
    laplace,
    problem_at,
    rms_error,
    solve_linear,
    split,
)
from ambid.nonlinear.narmax import DIVERGED, narmax
from ambid.nonlinear.polynomial import (
    Factor,
    PolynomialFunction,
    Term,
    block_of,
    column_of,
    is_noisy,
    lagged,
    products,
    term_name,
    terms_from_json,
    terms_to_json,
    unit_of,
)
from ambid.nonlinear.records import Parts, scaled_records

MOST_NOISE = 4  # largest order of C that is tried where it is left open
_NEURONS = (0, 1, 2, 4, 8)
_AS_GOOD = 1.02
_FOLDS = 3  # ends of a short record that are held out
_FEWEST = 20  # held-out samples by which neurons are chosen
_MOST_ROWS = 6000  # that the choice of neurons looks at
_DRAWS = 20  # of the hidden layer of a start
_STARTED_ON = 12000  # rows from which starts are trained
_ROUGH: dict[str, Any] = {"most": 12, "enough": 0.01}  # iterations, and a gain of the cost that no choice depends on
_ENOUGH = 1e-4  # gain of the cost, errors of unit variance (squared standard deviations), below which a search is over
_FEW = 20  # candidates, all of which can stand beside the network
_SHARED = 10.0  # times a standard deviation grows by the network, from which on a term's value is not its own
_NEAR = 0.98  # magnitude of a root of C from which on its standard deviation is not to be trusted


@dataclass(frozen=True, slots=True, kw_only=True)
class HybridSettings:
    """Settings of a hybrid fit."""

    ny: int = whole("largest lag of the outputs; 2", 0, 50, 2)
    nu: int = whole("number of lags of each input; 2", 0, 50, 2)
    nk: int = whole("smallest lag of the inputs; 1", 0, 1000, 1)
    ne: int | None = whole("order of C; chosen by ebic, 4 at most", 0, 20)
    degree: int = whole("of the polynomial; 2", 1, 9, 2)
    neurons: int | None = whole("hidden units, 0 for none; chosen by held-out error, 8 at most", 0, 60)
    starts: int = whole("random starts of the network; 3", 1, 50, 3)
    held_out: float = number("part at the end of each record that chooses the number of neurons; 0.2", 0.05, 0.5, 0.2)
    prior: float = number("prior standard deviation of the network's weights, scaled signals; 3", 0.01, 1e6, 3.0)
    iterations: int = whole("of each training, at most; 60", 1, 2000, 60)

    @property
    def lag(self) -> int:
        """Samples of the past that a model may look at."""
        ne = MOST_NOISE if self.ne is None else self.ne
        return max(self.ny, self.nk + self.nu - 1 if self.nu else 0, ne, 1)

    @property
    def polynomial(self) -> dict[str, int | float | str | tuple[int, ...]]:
        """Settings of the polynomial's estimator."""
        same = {k: getattr(self, k) for k in ("ny", "nu", "nk", "degree")}
        return {**same, "ne": 2 if self.ne is None else self.ne, "selection": "frols"}


@dataclass(frozen=True, kw_only=True)
class HybridFunction(LaggedFunction):
    """Terms and sizes of a hybrid model."""

    kind: ClassVar[str] = "hybrid"
    terms: tuple[tuple[Term, ...], ...]  # of the polynomial, by output, without innovations
    ne: int  # order of C
    p: int  # outputs
    m: int  # inputs
    ny: int  # lags of every output and of every input, and the first lag of the inputs, that the hidden layer sees
    nu: int
    nk: int
    neurons: int

    @cached_property
    def width(self) -> int:
        """Regressors that the hidden layer sees, which come first."""
        return self.p * self.ny + self.m * self.nu

    @cached_property
    def regressors(self) -> Regressors:
        """What the network sees, innovations, then whatever else the terms look at."""
        x = lags(self.p, self.m, ny=self.ny, nu=self.nu, nk=self.nk, ne=self.ne)
        pairs = set(zip(x.column.tolist(), x.back.tolist(), strict=True))
        factors = {(column_of(f, self.p, self.m), f.lag) for _, term in self.owned for f in term}
        more = np.array(sorted(factors - pairs), dtype=np.int64).reshape(-1, 2)
        column, back = np.append(x.column, more[:, 0]), np.append(x.back, more[:, 1])
        return Regressors(n_outputs=self.p, n_inputs=self.m, column=column, back=back)

    @property
    def owned(self) -> tuple[tuple[int, Term], ...]:
        """Output and term of each coefficient of the polynomial."""
        return tuple((o, term) for o, one in enumerate(self.terms) for term in one)

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """Polynomial, C, hidden layer."""
        return (
            block_of(self.regressors, self.owned),
            Linear.over(self.p, slice(self.width, self.width + self.p * self.ne), constant=False),
            Tanh(n_outputs=self.p, width=self.width, neurons=self.neurons),
        )

    @property
    def in_cloud(self) -> slice | Table:
        """What the hidden layer sees."""
        return slice(0, self.width)

    @property
    def n_terms(self) -> int:
        """Numbers of the polynomial, which come first."""
        return int(self.edges[1])

    @property
    def n_linear(self) -> int:
        """Numbers of the polynomial and of C."""
        return int(self.edges[2])

    @property
    def noise_terms(self) -> tuple[Term, ...]:
        """Past innovations as terms, in the order of the columns of C."""
        return tuple((Factor("e", q, k),) for k in range(1, self.ne + 1) for q in range(self.p))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of all parameters."""
        out = channel_names("y", self.p)
        before = [f"{name}: " if self.p > 1 else "" for name in out]
        names = [before[o] + term_name(x, self.p, self.m) for o in range(self.p) for x in self.terms[o]]
        names += [before[o] + term_name(x, self.p, self.m) for o in range(self.p) for x in self.noise_terms]
        z = self.regressors.names[: self.width]
        names += [f"{name}: unit {k + 1}" for name in out for k in range(self.neurons)]
        names += [f"unit {k + 1}: {x}" for k in range(self.neurons) for x in z]
        return (*names, *(f"unit {k + 1}: 1" for k in range(self.neurons)))

    def unit(self, y_scale: Array, u_scale: Array) -> Array:
        """Coefficients of the polynomial and of C are in SI; weights of the network stay scaled."""
        owned = (*self.owned, *((o, x) for o in range(self.p) for x in self.noise_terms))
        return np.concatenate([unit_of(owned, y_scale, u_scale), np.ones(self.n_theta - self.n_linear)])

    def noise_radius(self, theta: Array) -> float:
        """Return the largest magnitude of a root of C: below 1 the predictor forgets how it began."""
        p, m = self.p, self.p * self.ne
        if not m:
            return 0.0
        F = np.zeros((m, m))
        F[:p] = -theta[self.n_terms : self.n_linear].reshape(p, m)
        F[p:, : m - p] = np.eye(m - p)
        return float(np.max(np.abs(np.linalg.eigvals(F)))) if np.all(np.isfinite(F)) else float("inf")

    def is_stable(self, theta: Array) -> bool:
        """Whether the roots of C are inside the unit circle."""
        return self.noise_radius(theta) < 1.0

    def make_invertible(self, theta: Array) -> Array:
        """Return numbers whose C is invertible: where it is not, all its roots are drawn in by one factor."""
        if self.is_stable(theta):
            return theta
        radius, out = self.noise_radius(theta), theta.copy()
        C = theta[self.n_terms : self.n_linear].reshape(self.p, -1)
        factor = (0.95 / radius) ** (1 + np.arange(C.shape[1]) // self.p) if np.isfinite(radius) else 0.0
        out[self.n_terms : self.n_linear] = np.where(np.isfinite(C), C, 0.0).ravel() * np.tile(factor, self.p)
        return out

    def precision(self, prior: float) -> Array:
        """Return one over the prior's standard deviation of every number; 0 for the polynomial and C."""
        return np.where(np.arange(self.n_theta) < self.n_linear, 0.0, 1.0 / prior)

    def as_json(self) -> dict[str, Any]:
        """As `LaggedFunction.as_json`."""
        sizes = {"n_outputs": self.p, "n_inputs": self.m, "ny": self.ny, "nu": self.nu, "nk": self.nk}
        return {"terms": terms_to_json(self.terms), "ne": self.ne, "sizes": {**sizes, "neurons": self.neurons}}

    @classmethod
    def from_json(cls, document: dict[str, Any]) -> Self:
        """Read it back."""
        sizes = {k: int(v) for k, v in document["sizes"].items()}
        p, m, ne = sizes.pop("n_outputs"), sizes.pop("n_inputs"), document["ne"]
        if not isinstance(ne, int) or ne < 0:
            raise ValueError("ne is no order")
        return cls(terms=terms_from_json(document["terms"], p, m), ne=ne, p=p, m=m, **sizes)


@dataclass(slots=True, kw_only=True)
class _Hybrid(Draft[HybridFunction]):
    """A draft with what is known of its terms."""

    err: Mapping[tuple[str, str], float]  # error reduction ratios in the choice of the polynomial, by output and term

    def take(self, function: HybridFunction, theta: Array) -> None:
        """Take over another model."""
        self.function, self.theta = function, theta


def hybrid(records: Sequence[IOData], settings: Settings, *, seed: int = 0, tick: Tick | None = None) -> NonlinearFit:
    """Identify polynomial, network and noise model together, yhat = g(y, u) + (C(q^-1) - 1) e, consistent under
    feedback as long as they hold the truth. `seed`: of the network's starts; `tick`: called with stage and share that
    is over; may raise KeyboardInterrupt.
    """
    if not records:
        raise EstimationError("hybrid: no record was given. Pass at least one")
    s = read_settings(HybridSettings, "hybrid", settings)
    if not records[0].n_inputs:
        s = replace(s, nu=0, nk=1)
    if not s.ny and not s.nu:
        raise EstimationError("hybrid: ny and nu are both 0, and nothing is left to predict from. Raise one of them")
    data = scaled_records("hybrid", records, lag=s.lag, levels="auto", fewest=10)
    h = float(s.neurons if s.neurons is not None else 4)
    choice, order = 100.0 * (s.neurons is None), 3.0 * (s.ne is None)
    ticks = portions(tick, (3.0, 1.0, choice, 2 + h, 2 + h, 2 + h, order, 1 + h))
    began = perf_counter()
    first = narmax(records, s.polynomial, seed=seed, tick=ticks[0])
    timing = {"polynomial": perf_counter() - began}
    attempt: dict[str, Any] = {
        "structure": "hybrid", "records": records, "settings": asdict(s), "seed": seed, "timing_s": timing
    }  # fmt: skip
    if not isinstance(first.model, LaggedModel):
        return Attempt(**attempt).failed(first.reason)
    function, theta = _polynomial(s, first.model)
    chosen: Any = first.details["terms"]
    draft = _Hybrid(
        **attempt, data=data, function=function, theta=theta,
        err={(out, x["term"]): x["err"] for out, own in chosen.items() for x in own},
        curves=[replace(c, method=f"polynomial: {c.method}") for c in first.curves],
        details={"candidates": first.details["candidates"], "tried": []},
    )  # fmt: skip

    def identify() -> None:
        if any(w.startswith("interrupted") for w in first.warnings):
            raise KeyboardInterrupt
        _identify(s, draft, ticks[1:])
        if draft.status == "stalled":
            draft.warnings.insert(0, "the search did not converge: treat the values as a first guess")

    reason = draft.guarded(identify)
    return draft.failed(reason) if reason else _finish(s, draft)


def _polynomial(s: HybridSettings, model: LaggedModel) -> tuple[HybridFunction, Array]:
    """The polynomial model as a hybrid without neurons, its chosen noise terms in a full C."""
    assert isinstance(model.function, PolynomialFunction)
    terms = tuple(tuple(x for x in one if not is_noisy(x)) for one in model.function.terms)
    ne = max((f.lag for _, x in model.function.owned for f in x if f.kind == "e"), default=0)
    function = HybridFunction(
        terms=terms, ne=ne if s.ne is None else s.ne, p=model.n_outputs, m=model.n_inputs, ny=s.ny, nu=s.nu, nk=s.nk,
        neurons=0,
    )  # fmt: skip
    values = dict(zip(model.names, model.scaled_theta, strict=True))
    start = np.array([values.get(name, 0.0) for name in function.names], dtype=np.float64)
    return function, function.make_invertible(start)


def _identify(s: HybridSettings, draft: _Hybrid, ticks: list[Tick | None]) -> None:
    began, parts = perf_counter(), draft.data.parts
    lean = _lean(draft.function)
    draft.function = lean
    _search(s, draft, "polynomial and noise model", ticks[0])
    # all regressors of the network are in the polynomial too: it shall not do what is linear, nor hide a term
    factors = lagged(lean.p, lean.m, ny=s.ny, nu=s.nu, nk=s.nk)
    few = draft.details["candidates"] <= _FEW
    more = products(factors, s.degree if few else 1, constant=few)
    full = replace(lean, ny=s.ny, nu=s.nu, terms=tuple((*t, *(x for x in more if x not in t)) for t in lean.terms))
    start = transfer(lean, draft.theta, full)
    neurons = s.neurons
    if neurons is None:
        neurons = _choose_neurons(s, full, start, draft, ticks[1])
        if not neurons:
            few, as_well = "is all that so few samples allow", "predicts held-out data as well as with a network"
            draft.warnings.append(
                f"the polynomial alone {as_well if draft.details['tried'] else few}: no neurons were added"
            )
    began = draft.timed("choice of neurons", began)
    if neurons:
        function = replace(full, neurons=neurons)
        theta = train(s, function, start, parts, draft.seed, s.starts, ticks[2], draft)
        draft.take(function, theta)
        problem = _search(s, draft, "all together", ticks[3])
        _revise(s, problem.at(draft.theta), draft, ticks[4])
    if s.ne is None:
        problem = hybrid_problem(draft.function, parts, draft.theta, s.prior)
        draft.take(*choose_noise(problem, draft.theta, s.prior, ticks[5]))
        if not neurons:
            function = _lean(draft.function)
            draft.take(function, transfer(draft.function, draft.theta, function))
    _search(s, draft, "all together", ticks[6])
    draft.timed("all together", began)


def _lean(function: HybridFunction) -> HybridFunction:
    """Without neurons, no more lags than the polynomial looks at: a model of as little past as there can be."""
    reach = {"y": 0, "u": 0}
    for f in (f for one in function.terms for x in one for f in x):
        reach[f.kind] = max(reach[f.kind], f.lag - (function.nk - 1 if f.kind == "u" else 0))
    return replace(function, ny=reach["y"], nu=reach["u"]) if any(reach.values()) else function


def hybrid_problem(function: HybridFunction, parts: Parts, theta: Array, prior: float) -> LaggedProblem:
    """Return the problem whose errors have unit covariance at given numbers."""
    return problem_at(function, parts, theta, function.precision(prior), joint=True)


def transfer(old: HybridFunction, theta: Array, new: HybridFunction) -> Array:
    """Return another function's numbers, those of the same name taken over, new ones zero, C made invertible."""
    values = dict(zip(old.names, theta, strict=True))
    return new.make_invertible(np.array([values.get(name, 0.0) for name in new.names], dtype=np.float64))


def _search(s: HybridSettings, draft: _Hybrid, stage: str, tick: Tick | None) -> LaggedProblem:
    """Search for all numbers, errors of unit variance."""
    function = draft.function
    problem = hybrid_problem(function, draft.data.parts, draft.theta, s.prior)
    if tick is not None:
        tick(stage, 0.0)
    ended = search(
        problem,
        draft.theta,
        stage=stage,
        most=s.iterations,
        tolerance=1e-8 if function.neurons else 1e-10,
        enough=_ENOUGH if function.neurons else 0.0,
        damping=1e-4,
        tick=tick,
        keep=partial(draft.take, function),
    )
    draft.take(function, ended.theta)
    draft.settle(ended, problem, f"{stage}: Levenberg-Marquardt, prediction errors")
    return problem


# --- network ----------------------------------------------------------------------------------------------------------


def train(
    s: HybridSettings, function: HybridFunction, linear: Array, parts: Parts, seed: int, starts: int,
    tick: Tick | None, draft: _Hybrid | None = None,
) -> Array:  # fmt: skip
    """Train a network on what polynomial and C (`linear`) leave, noted in `draft`, then all numbers a while, on the
    beginning of a long record; the best of the starts. Every other takes C as 1, as what the polynomial could not do
    alone has coloured the first C.
    """
    most = max(_STARTED_ON // len(parts), 10 * function.lag + 60)
    level = np.concatenate([linear, np.zeros(function.n_theta - linear.size)])
    every = hybrid_problem(function, tuple((y[:most], u[:most]) for y, u in parts), level, s.prior)
    live = np.ones(function.n_theta, dtype=np.bool_)
    live[function.n_terms : function.n_linear] = False  # C
    rng, n, best, least = np.random.default_rng(seed), function.n_terms + function.p * function.neurons, level, np.inf
    shares = portions(tick, (1.0,) * (2 * starts))
    for k in range(starts):
        alone = every.at(level if k % 2 else np.where(live, level, 0.0), live)
        start = draw_start(alone, n, alone.base[live], function.neurons, function.width, rng, _DRAWS)
        ended = search(
            alone, start, stage="network on the residual", tick=shares[2 * k], n_linear=n,
            solved=partial(solve_linear, alone, n), **_ROUGH,
        )  # fmt: skip
        both = search(every, alone.whole(ended.theta), stage="starts of all together", tick=shares[2 * k + 1], **_ROUGH)
        if not k and draft is not None:
            draft.note(ended, alone, "network on the residual: Levenberg-Marquardt, prediction errors")
        if both.cost < least:
            best, least = both.theta, both.cost
    return best


def _choose_neurons(
    s: HybridSettings, function: HybridFunction, linear: Array, draft: _Hybrid, tick: Tick | None
) -> int:
    """Choose the number of hidden units by one-step errors behind the trained parts of records, of a short one at
    several ends.
    """
    most = max(_MOST_ROWS // len(draft.data.parts), 10 * function.lag + 60)
    parts, share = tuple((y[:most], u[:most]) for y, u in draft.data.parts), s.held_out
    n = sum(y.shape[0] - function.lag for y, _ in parts)
    if n * share < _FEWEST:
        return 0
    ends = [1.0 - share * j for j in range(int(np.clip(_MOST_ROWS // n, 1, min(_FOLDS, 0.6 / share))))]

    def score(size: dict[str, Any], tick: Tick | None) -> float:
        one, squares = replace(function, neurons=size["neurons"]), 0.0
        for end, own in zip(ends, portions(tick, ends), strict=True):
            some = tuple((y[: round(end * y.shape[0])], u[: round(end * y.shape[0])]) for y, u in parts)
            training, validation = split(some, share / end, function.lag)
            theta = train(s, one, linear, training, draft.seed, 2, part_of(own, 0.0, 0.8)) if one.neurons else linear
            problem = hybrid_problem(one, training, theta, s.prior)
            theta = search(problem, theta, stage="choice of neurons", tick=part_of(own, 0.8, 1.0), **_ROUGH).theta
            squares += rms_error(one, theta, validation) ** 2
        return float(np.sqrt(squares / len(ends)))

    sizes = [{"neurons": h} for h in _NEURONS]
    best = choose_smallest(sizes, score, draft.details["tried"], _AS_GOOD, tick)
    return int(best["neurons"])


# --- noise model and terms --------------------------------------------------------------------------------------------


def choose_noise(problem: LaggedProblem, theta: Array, prior: float, tick: Tick | None) -> tuple[HybridFunction, Array]:
    """Choose the order of C by an information criterion of one-step errors of all outputs, all numbers searched again,
    from `theta`, the optimum for the order there is. Orders are nested, not chosen out of many.
    """
    old = problem.function
    assert isinstance(old, HybridFunction)
    first, trials = max(old.lag, MOST_NOISE), list[tuple[float, HybridFunction, Array]]()
    for ne, share in enumerate(portions(tick, (1.0,) * (MOST_NOISE + 1))):
        trial = replace(old, ne=ne)
        if not trial.n_theta:  # a polynomial without terms: only the noise model is left
            continue
        parts = tuple(
            (y[first - trial.lag :], u[first - trial.lag :]) for y, u in problem.parts
        )  # for all the same errors
        at = replace(hybrid_problem(trial, parts, transfer(old, theta, trial), prior), weight=problem.weight)
        ended = search(at, at.base, stage="order of the noise model", tick=share, **_ROUGH)
        value = at.n_errors * np.log(max(ended.cost / at.n_errors, 1e-26))
        trials.append((value + penalty("bic", trial.n_linear, max(at.n_errors // trial.p, 2), 1), trial, ended.theta))
    return min(trials, key=lambda x: x[0])[1:]


def _revise(s: HybridSettings, problem: LaggedProblem, draft: _Hybrid, tick: Tick | None) -> None:
    """Leave out terms one at a time, all numbers searched again, while the criterion gains: some only imitate the
    network. One that the network could take over stays, or spare units would swallow what can be read.
    """
    n = max(problem.n_errors // draft.function.p, 2)
    for k in range(draft.function.n_terms):
        if tick is not None:
            tick("terms beside the network", guessed(k, 4.0))
        function, theta = draft.function, draft.theta
        R = problem.triangle(theta)[:, :-1]
        P, _ = information_inverse(R)
        if P is None:
            return
        m = max(draft.details["candidates"] * function.p, function.n_linear)
        price = penalty("ebic", function.n_linear, n, m) - penalty("ebic", function.n_linear - 1, n, m)
        shared = _inflation(R, P, function.n_linear)[: function.n_terms] > _SHARED
        alone = np.array([len(function.terms[o]) == 1 for o, _ in function.owned])
        loss = np.where(shared | alone, np.inf, (theta**2 / np.diag(P))[: function.n_terms])
        worst = int(np.argmin(loss))
        if not loss[worst] < price:
            return
        o, term = function.owned[worst]
        fewer = replace(
            function, terms=tuple(tuple(x for x in t if (q, x) != (o, term)) for q, t in enumerate(function.terms))
        )
        at = replace(
            hybrid_problem(fewer, problem.parts, transfer(function, theta, fewer), s.prior), weight=problem.weight
        )
        ended = search(at, at.base, stage="", damping=1e-4, **_ROUGH)
        if not ended.cost - problem.cost(theta) < price:
            return
        problem = at
        draft.take(fewer, ended.theta)


def _inflation(R: Array, P: Array, n_linear: int) -> Array:
    """By what the network multiplies deviations of polynomial and C, the first `n_linear`; ones where not determined.
    `R`: triangle of the slopes; `P`: inverse of R'R.
    """
    alone, _ = information_inverse(R[:, :n_linear])
    return np.ones(n_linear) if alone is None else np.sqrt(np.diag(P)[:n_linear] / np.diag(alone))


# --- the fit ----------------------------------------------------------------------------------------------------------


def _finish(s: HybridSettings, draft: _Hybrid) -> NonlinearFit:
    function, records = draft.function, draft.records
    draft.settings |= {"ne": function.ne, "neurons": function.neurons}
    problem = hybrid_problem(function, draft.data.parts, draft.theta, s.prior)
    if not np.isfinite(problem.cost(draft.theta)):
        return draft.failed(DIVERGED)
    posterior = laplace(problem, draft.theta)
    radius = function.noise_radius(draft.theta)
    if radius > _NEAR:
        draft.warnings.append(
            f"C has a root at {radius:.4g}, close to the unit circle, which the search must not cross: its "
            "standard deviation is unreliable, and the predictor forgets its start slowly. A differenced or "
            "detrended output causes this"
        )
    if posterior.covariance is not None:
        inflated = _inflation(posterior.triangle, posterior.covariance, function.n_linear)[: function.n_terms]
        names = ", ".join(name for name, x in zip(function.names, inflated, strict=False) if x > _SHARED)
        if names:
            draft.warnings.append(
                f"the network can replace these terms, so that their values are not unique: {names}. Use fewer "
                "neurons or a smaller prior"
            )
    spare = _spare_units(function, draft.theta, problem, posterior)
    terms: dict[str, list[dict[str, object]]] = {}
    for o, out in enumerate(records[0].outputs):
        names_of = [term_name(x, function.p, function.m) for x in (*function.terms[o], *function.noise_terms)]
        terms[out] = [{"term": x, "err": draft.err.get((out, x))} for x in names_of]
    draft.details |= {"terms": terms, "levels": draft.data.levels(records[0])}
    why_not = (
        f"no standard deviations: {spare} of {function.neurons} units improve the fit by less than their parameters "
        f"cost, and intervals would be too narrow. Give neurons = {function.neurons - spare}"
    )
    return finish(
        draft, problem, posterior, units="neurons or terms", how="laplace", why_not=why_not if spare else "",
        noise=s.ne != 0, instead="Raise ne",
    )  # fmt: skip


def _spare_units(function: HybridFunction, theta: Array, problem: LaggedProblem, posterior: Laplace) -> int:
    """Units whose output weights' Wald statistic is below Bayes' price of their numbers: beside them the polynomial is
    off by 1.5 to 2 deviations, the likelihood being far from quadratic.
    """
    if posterior.covariance is None:
        return 0
    price = (function.p + function.width + 1) * np.log(problem.n_errors / function.p)
    spare = 0
    for k in range(function.neurons):
        own = function.n_linear + k + function.neurons * np.arange(function.p)
        wald = theta[own] @ np.linalg.solve(posterior.covariance[np.ix_(own, own)], theta[own])
        spare += bool(wald < price)
    return spare
