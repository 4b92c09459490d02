"""Hybrid NARMAX and network from records, by prediction errors (thesis eqs 3.23, 3.24).

Polynomial and noise terms by orthogonal least squares (`narmax`) -> number of neurons by held-out errors -> network on
what they leave, from several starts -> all numbers together by Levenberg-Marquardt with exact slopes through the
innovations -> terms that no longer pay, order of C -> covariance by Laplace's approximation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from time import perf_counter

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.criteria import CRITERIA
from ambid.estimation.progress import Tick, portions
from ambid.estimation.search import search
from ambid.nonlinear.blocks import Tanh
from ambid.nonlinear.fit import NonlinearFit, Settings, failed_fit
from ambid.nonlinear.hybrid_choice import (
    MOST_NOISE,
    SHARED,
    Candidates,
    Tried,
    choose_neurons,
    choose_noise,
    inflation,
    revise,
    train_network,
)
from ambid.nonlinear.hybrid_function import HybridFunction, hybrid_problem, make_invertible, transfer
from ambid.nonlinear.lagged import LaggedModel
from ambid.nonlinear.lagged_problem import Draft, LaggedProblem, Laplace, cautions, finish, guarded, laplace
from ambid.nonlinear.narmax import narmax
from ambid.nonlinear.polynomial import PolynomialFunction, Term, is_noisy, lagged, products, term_name
from ambid.nonlinear.records import Scaled, scaled_records
from ambid.nonlinear.settings import choice, number, read_settings, whole

_ENOUGH = 1e-4  # gain of the cost, errors of unit variance (squared standard deviations), below which a search is over
_NEAR = 0.98  # magnitude of a root of C from which on its standard deviation is not to be trusted
_DIVERGED = "no one-step predictor that stays finite was found; lower ne, degree or terms, or check the columns"


@dataclass(frozen=True, slots=True, kw_only=True)
class HybridSettings:
    """Settings of a hybrid fit."""

    ny: int = whole("largest lag of the outputs; 2", 0, 50, 2)
    nu: int = whole("number of lags of each input; 2", 0, 50, 2)
    nk: int = whole("smallest lag of the inputs; 1", 0, 1000, 1)
    ne: int | None = whole("order of C; chosen by the criterion, 4 at most", 0, 20)
    degree: int = whole("of the polynomial; 2", 1, 9, 2)
    terms: int = whole(
        "terms of the polynomial that are looked at for each output, at most; 30, fewer on a short record", 1, 2000, 30
    )
    constant: int = whole("1 to let a constant be chosen, 0 for none; 1", 0, 1, 1)
    neurons: int | None = whole("hidden units, 0 for none; chosen by held-out error, 8 at most", 0, 60)
    starts: int = whole("random starts of the network; 3", 1, 50, 3)
    held_out: float = number(
        "part at the end of each record by which the number of neurons is chosen; 0.2", 0.05, 0.5, 0.2
    )
    prior: float = number(
        "standard deviation of the network's weights before the data, scaled signals; 3", 0.01, 1e6, 3.0
    )
    iterations: int = whole("of each training, at most; 60", 1, 2000, 60)
    criterion: str = choice("for terms and ne: ebic, bic, mdl, aic, aicc, fpe, lilc; ebic", *CRITERIA, default="ebic")
    pruning: str = choice(
        "prediction (terms are revised once the network is there), none; prediction",
        "none", "prediction", default="prediction",
    )  # fmt: skip
    selection: str = choice("frols, all (every candidate); frols", "frols", "all")
    innovations: str = choice(
        "linear (through C alone), network (they are its regressors too); linear", "linear", "network"
    )

    @property
    def lag(self) -> int:
        """Samples of the past that a model may look at."""
        ne = MOST_NOISE if self.ne is None else self.ne
        return max(self.ny, self.nk + self.nu - 1 if self.nu else 0, ne, 1)

    @property
    def polynomial(self) -> dict[str, int | float | str | tuple[int, ...]]:
        """Settings of the polynomial's estimator."""
        same = ("ny", "nu", "nk", "degree", "terms", "constant", "criterion", "pruning", "selection")
        return {k: getattr(self, k) for k in same} | {"ne": 2 if self.ne is None else self.ne}


def hybrid_settings(given: Mapping[str, object], *, n_inputs: int) -> HybridSettings:
    """Check settings and complete them; without inputs there are no lags of them."""
    s = read_settings(HybridSettings, "hybrid", given)
    if not n_inputs:
        s = replace(s, nu=0, nk=1)
    if not s.ny and not s.nu:
        raise EstimationError("hybrid: ny and nu are both 0; nothing is left to predict from. Raise one of them")
    if s.innovations == "network" and 0 in (s.ne, s.neurons):
        raise EstimationError(
            "hybrid: innovations = network puts past innovations into the units, and ne or neurons is 0. Raise it, or "
            "say innovations = linear"
        )
    return s


@dataclass(slots=True, kw_only=True)
class _Work(Draft):
    """A draft with what is known of its polynomial."""

    n_candidates: int = 0  # terms that the polynomial's were chosen from
    # error reduction ratios in the choice of the polynomial's terms
    err: Mapping[tuple[str, str], float] = field(default_factory=dict)
    tried: tuple[Tried, ...] = ()
    # terms of the polynomial that pay only beside the network, and that it made superfluous
    added: tuple[str, ...] = ()
    dropped: tuple[str, ...] = ()
    drawn_in: float = 1.0  # by what the roots of the first C were multiplied to make it invertible

    @property
    def model(self) -> HybridFunction:
        """Its function."""
        assert isinstance(self.function, HybridFunction)
        return self.function

    def take(self, function: HybridFunction, theta: Array) -> None:
        """Take over another model."""
        self.function, self.theta = function, theta


def hybrid(records: Sequence[IOData], settings: Settings, *, seed: int = 0, tick: Tick | None = None) -> NonlinearFit:
    """Identify polynomial, network and noise model together, yhat = g(y, u) + (C(q^-1) - 1) e.

    Consistent under feedback as long as polynomial, network and C hold the truth. `seed` is that of the network's
    starts; `tick` is called with the stage and the share that is over and may raise KeyboardInterrupt.
    """
    if not records:
        raise EstimationError("hybrid: no record is given. Pass one at least")
    s = hybrid_settings(settings, n_inputs=records[0].n_inputs)
    data = scaled_records("hybrid", records, lag=s.lag, levels="auto", fewest=10)
    ticks = portions(tick, _costs(s))
    began = perf_counter()
    first = narmax(records, s.polynomial, seed=seed, tick=ticks[0])
    timing = {"polynomial": perf_counter() - began}
    if not isinstance(first.model, LaggedModel):
        return failed_fit("hybrid", records, asdict(s), seed, first.reason, timing)
    work = _polynomial(s, first, first.model)
    work.timing_s.update(timing)
    interrupted = any(w.startswith("interrupted") for w in first.warnings)

    def identify() -> None:
        if interrupted:
            raise KeyboardInterrupt
        _identify(s, data, work, seed, ticks[1:])
        if work.status == "stalled":
            work.warnings.insert(0, "the search did not converge: treat the numbers as a first guess")

    failed = guarded(identify, work, lambda why: failed_fit("hybrid", records, asdict(s), seed, why, work.timing_s))
    return failed or _finish(s, records, data, work, seed)


def _costs(s: HybridSettings) -> tuple[float, ...]:
    """What the parts of a fit are expected to take, of each other: as `_identify` goes through them."""
    h = float(s.neurons if s.neurons is not None else 4)
    return 3.0, 1.0, 100.0 if s.neurons is None else 0.0, 2 + h, 2 + h, 2 + h, 3.0 if s.ne is None else 0.0, 1 + h


def _polynomial(s: HybridSettings, first: NonlinearFit, model: LaggedModel) -> _Work:
    """The polynomial model as a hybrid without neurons, its chosen noise terms in a full C."""
    assert isinstance(model.function, PolynomialFunction)
    terms = tuple(tuple(x for x in one if not is_noisy(x)) for one in model.function.numerators)
    ne = max((f.lag for _, _, x in model.function.owned for f in x if f.kind == "e"), default=0)
    function = HybridFunction(
        terms=terms, ne=ne if s.ne is None else s.ne, p=model.n_outputs, m=model.n_inputs, ny=s.ny, nu=s.nu, nk=s.nk,
        neurons=0, deep=s.innovations == "network",
    )  # fmt: skip
    known = dict(zip(model.names, model.scaled_theta, strict=True))
    start = np.array([known.get(name, 0.0) for name in function.names], dtype=np.float64)
    theta, factor = make_invertible(function, start)
    found = first.details.get("candidates", 0)
    return _Work(
        function=function,
        theta=theta,
        n_candidates=found if isinstance(found, int) else 0,
        err=_ratios(first.details.get("terms")),
        curves=[replace(c, method=f"polynomial: {c.method}") for c in first.curves],
        drawn_in=factor,
    )


def _ratios(terms: object) -> dict[tuple[str, str], float]:
    """Error reduction ratios by output and term, from the details of the polynomial's fit."""
    if not isinstance(terms, Mapping):
        return {}
    return {(out, x["term"]): x["err"] for out, one in terms.items() for x in one if x["err"] is not None}


def _identify(s: HybridSettings, data: Scaled, work: _Work, seed: int, ticks: list[Tick | None]) -> None:
    began = perf_counter()
    lean = _lean(work.model)
    work.function = lean
    _search(s, data, work, "polynomial and noise model", ticks[0])
    full, start = _prepare(s, lean, work.theta)
    neurons = s.neurons
    if neurons is None:
        neurons, work.tried = choose_neurons(full, start, data.parts, s.prior, s.held_out, seed, ticks[1])
        if not neurons:
            why = (
                "predicts held-out data as well as with a network" if work.tried else "is all that so few samples carry"
            )
            work.warnings.append(f"the polynomial alone {why}: no neurons were added")
    began = work.timed("choice of neurons", began)
    if neurons:
        function = replace(full, neurons=neurons)
        theta, found, alone = train_network(function, start, data.parts, s.prior, s.starts, seed, ticks[2])
        work.take(function, theta)
        work.note(found, alone, "network on the residual: Levenberg-Marquardt, prediction errors")
        problem = _search(s, data, work, "all together", ticks[3])
        if s.pruning == "prediction":
            candidates = Candidates(terms=_candidates(s, full), criterion=s.criterion, prior=s.prior)
            revise(problem.at(work.theta), work.theta, candidates, work.take, ticks[4])
            old, new = (x.names[: x.n_terms] for x in (lean, work.model))
            work.added, work.dropped = (tuple(x for x in a if x not in b) for a, b in ((new, old), (old, new)))
    if s.ne is None:
        problem = hybrid_problem(work.model, data.parts, work.theta, s.prior)
        work.take(*choose_noise(problem, work.theta, s.prior, s.criterion, ticks[5]))
        if not neurons:
            function = _lean(work.model)
            work.take(function, transfer(work.model, work.theta, function))
    _search(s, data, work, "all together", ticks[6])
    work.timed("all together", began)


def _prepare(s: HybridSettings, lean: HybridFunction, theta: Array) -> tuple[HybridFunction, Array]:
    """The function that a network joins, all its regressors in the polynomial too: it shall not do what is linear."""
    function = replace(lean, ny=s.ny, nu=s.nu)
    if s.pruning == "none":
        return function, theta
    linear = tuple((f,) for f in lagged(function.p, function.m, ny=s.ny, nu=s.nu, nk=s.nk, ne=0))
    function = replace(function, terms=tuple((*t, *(x for x in linear if x not in t)) for t in function.terms))
    return function, transfer(lean, theta, function)


def _candidates(s: HybridSettings, function: HybridFunction) -> tuple[Term, ...]:
    """What the terms of the polynomial are chosen from."""
    factors = lagged(function.p, function.m, ny=s.ny, nu=s.nu, nk=s.nk, ne=0)
    return products(factors, s.degree, constant=bool(s.constant))


def _lean(function: HybridFunction) -> HybridFunction:
    """Without neurons, no more lags than the polynomial looks at: a model of as little past as there can be."""
    reach = {"y": 0, "u": 0}
    for f in (f for one in function.terms for x in one for f in x):
        reach[f.kind] = max(reach[f.kind], f.lag - (function.nk - 1 if f.kind == "u" else 0))
    return replace(function, ny=reach["y"], nu=reach["u"]) if any(reach.values()) else function


def _search(s: HybridSettings, data: Scaled, work: _Work, stage: str, tick: Tick | None) -> LaggedProblem:
    """Search for all numbers, errors of unit variance."""
    function = work.model
    problem = hybrid_problem(function, data.parts, work.theta, s.prior)
    if tick is not None:
        tick(stage, 0.0)
    found = search(
        problem,
        work.theta,
        stage=stage,
        most=s.iterations,
        tolerance=1e-8 if function.neurons else 1e-10,
        enough=_ENOUGH if function.neurons else 0.0,
        damping=1e-4,
        tick=tick,
        keep=partial(work.take, function),
    )
    work.take(function, found.theta)
    work.note(found, problem, f"{stage}: Levenberg-Marquardt, prediction errors")
    work.status = "converged" if found.converged else "stalled"
    return problem


def _finish(s: HybridSettings, records: Sequence[IOData], data: Scaled, work: _Work, seed: int) -> NonlinearFit:
    of = work.model
    used = {**asdict(s), "ne": of.ne, "neurons": of.neurons}
    problem = hybrid_problem(of, data.parts, work.theta, s.prior)
    if not np.isfinite(problem.cost(work.theta)):
        return failed_fit("hybrid", records, used, seed, _DIVERGED, work.timing_s)
    found = laplace(problem, work.theta)
    if s.ne == 0 and records[0].n_inputs and not all(x.open_loop for x in records):
        work.warnings.append(
            "without a noise model (ne = 0) hybrid is biased under feedback unless the equation error is white: raise "
            "ne, or say --open-loop if there was no feedback"
        )
    work.warnings += [*cautions(work, problem, found, "neurons or terms"), *_cautions(work, found)]
    covariance, spare = found.covariance, _spare_units(of, work.theta, problem, found)
    if covariance is None:
        work.warnings.append(
            "no standard deviations: data and prior do not determine the numbers. Fewer terms or neurons"
        )
    elif spare:
        covariance = None
        work.warnings.append(
            f"no standard deviations: {spare} of {of.neurons} units explain less than their numbers cost, and "
            f"intervals beside units to spare are too narrow. Say neurons = {of.neurons - spare}"
        )
    work.details = _details(records, data, work, problem)
    return finish(
        "hybrid", records, used, data, work, problem, found, covariance=covariance, origin="laplace", seed=seed
    )


def _spare_units(of: HybridFunction, theta: Array, problem: LaggedProblem, found: Laplace) -> int:
    """Units whose output weights' Wald statistic is below Bayes' price of the unit's numbers.

    Beside them coefficients of the polynomial are off by 1.5 to 2 times their deviations: the likelihood is far from
    quadratic in what a unit does that is hardly there.
    """
    if found.covariance is None:
        return 0
    layer = of.blocks[2]
    assert isinstance(layer, Tanh)
    price = (of.p + layer.width + 1) * np.log(problem.n_errors / of.p)
    spare = 0
    for k in range(of.neurons):
        own = of.n_linear + k + of.neurons * np.arange(of.p)
        wald = theta[own] @ np.linalg.solve(found.covariance[np.ix_(own, own)], theta[own])
        spare += bool(wald < price)
    return spare


def _cautions(work: _Work, found: Laplace) -> list[str]:
    of, out = work.model, []
    radius = of.noise_radius(work.theta)
    if not of.deep and radius > _NEAR:
        out.append(
            f"C has a root at {radius:.4g}, nearly on the unit circle, where the search must not cross: its standard "
            "deviation is not to be trusted, and the predictor forgets its beginning slowly. A differenced or "
            "detrended output does this"
        )
    if found.covariance is not None:
        inflated = inflation(found.triangle, found.covariance, of.n_linear)[: of.n_terms]
        names = ", ".join(name for name, x in zip(of.names, inflated, strict=False) if x > SHARED)
        if names:
            out.append(
                f"the network can take over these terms, so that their values are not theirs alone: {names}. Fewer "
                "neurons or a smaller prior"
            )
    return out


def _details(records: Sequence[IOData], data: Scaled, work: _Work, problem: LaggedProblem) -> dict[str, object]:
    of, y_all = work.model, np.concatenate([y for y, _ in data.parts])
    terms: dict[str, list[dict[str, object]]] = {}
    for o, out in enumerate(records[0].outputs):
        named = [term_name(x, of.p, of.m) for x in (*of.terms[o], *of.noise_terms)]
        terms[out] = [{"term": x, "err": work.err.get((out, x))} for x in named]
    layer, own = of.blocks[2], of.split(work.theta)[2]
    assert isinstance(layer, Tanh)
    rows = [of.predict(work.theta, r)[1] for r in problem.rows()]
    hidden = np.concatenate([layer.values(own, r.prepared[2]) for r in rows])
    by_network = np.std(hidden, axis=0) / np.maximum(np.std(y_all, axis=0), 1e-300)
    return {
        "terms": terms,
        "candidates": work.n_candidates,
        "added_beside_the_network": list(work.added),
        "left_out_beside_the_network": list(work.dropped),
        "network_share": dict(zip(records[0].outputs, by_network.tolist(), strict=True)),
        "noise_model": {
            "largest_root": of.noise_radius(work.theta),
            "coefficients": work.theta[of.n_terms : of.n_linear].tolist(),
            "start_drawn_in_by": work.drawn_in,
        },
        "tried": [{"neurons": x.neurons, "held_out_rms": x.held_out} for x in work.tried],
        "levels": data.levels(records[0]),
    }
