"""Hybrid NARMAX and network from records, by prediction errors (thesis eqs 3.23, 3.24).

Polynomial and noise terms by orthogonal least squares (`narmax`) -> number of neurons by held-out errors -> network on
what they leave, from several starts -> all numbers together by Levenberg-Marquardt with exact slopes through the
innovations -> terms that no longer pay, order of C -> covariance by Laplace's approximation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.progress import Tick, portions
from ambid.estimation.search import search
from ambid.nonlinear.blocks import Tanh
from ambid.nonlinear.fit import NonlinearFit, Settings, failed_fit
from ambid.nonlinear.hybrid_choice import (
    SHARED,
    HybridFunction,
    HybridSettings,
    choose_neurons,
    choose_noise,
    hybrid_problem,
    hybrid_settings,
    inflation,
    make_invertible,
    revise,
    train_network,
    transfer,
)
from ambid.nonlinear.lagged import LaggedModel
from ambid.nonlinear.lagged_problem import Draft, LaggedProblem, Laplace, finish, guarded, laplace
from ambid.nonlinear.narmax import narmax
from ambid.nonlinear.polynomial import PolynomialFunction, is_noisy, lagged, term_name
from ambid.nonlinear.records import Scaled, scaled_records

_ENOUGH = 1e-4  # gain of the cost, errors of unit variance (squared standard deviations), below which a search is over
_NEAR = 0.98  # magnitude of a root of C from which on its standard deviation is not to be trusted
_DIVERGED = "no one-step predictor that stays finite was found; lower ne, degree or terms, or check the columns"


@dataclass(slots=True, kw_only=True)
class _Hybrid(Draft):
    """A draft whose function is a hybrid one."""

    err: Mapping[tuple[str, str], float]  # error reduction ratios in the choice of the polynomial, by output and term

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
    draft = _polynomial(s, first, first.model)
    draft.timing_s.update(timing)
    interrupted = any(w.startswith("interrupted") for w in first.warnings)

    def identify() -> None:
        if interrupted:
            raise KeyboardInterrupt
        _identify(s, data, draft, seed, ticks[1:])
        if draft.status == "stalled":
            draft.warnings.insert(0, "the search did not converge: treat the numbers as a first guess")

    failed = guarded(identify, draft, lambda why: failed_fit("hybrid", records, asdict(s), seed, why, draft.timing_s))
    return failed or _finish(s, records, data, draft, seed)


def _costs(s: HybridSettings) -> tuple[float, ...]:
    """What the parts of a fit are expected to take, of each other: as `_identify` goes through them."""
    h = float(s.neurons if s.neurons is not None else 4)
    return 3.0, 1.0, 100.0 if s.neurons is None else 0.0, 2 + h, 2 + h, 2 + h, 3.0 if s.ne is None else 0.0, 1 + h


def _polynomial(s: HybridSettings, first: NonlinearFit, model: LaggedModel) -> _Hybrid:
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
    chosen: Any = first.details["terms"]
    return _Hybrid(
        function=function,
        theta=theta,
        err={(out, x["term"]): x["err"] for out, own in chosen.items() for x in own},
        curves=[replace(c, method=f"polynomial: {c.method}") for c in first.curves],
        details={
            "candidates": first.details["candidates"], "added_beside_the_network": [],
            "left_out_beside_the_network": [], "tried": [], "drawn_in": factor,
        },
    )  # fmt: skip


def _identify(s: HybridSettings, data: Scaled, draft: _Hybrid, seed: int, ticks: list[Tick | None]) -> None:
    began = perf_counter()
    lean = _lean(draft.model)
    draft.function = lean
    _search(s, data, draft, "polynomial and noise model", ticks[0])
    full, start = _prepare(s, lean, draft.theta)
    neurons = s.neurons
    if neurons is None:
        neurons, tried = choose_neurons(s, full, start, data.parts, seed, ticks[1])
        draft.details["tried"] = tried
        if not neurons:
            why = "predicts held-out data as well as with a network" if tried else "is all that so few samples carry"
            draft.warnings.append(f"the polynomial alone {why}: no neurons were added")
    began = draft.timed("choice of neurons", began)
    if neurons:
        function = replace(full, neurons=neurons)
        theta, found, alone = train_network(s, function, start, data.parts, seed, ticks[2])
        draft.take(function, theta)
        draft.note(found, alone, "network on the residual: Levenberg-Marquardt, prediction errors")
        problem = _search(s, data, draft, "all together", ticks[3])
        if s.pruning == "prediction":
            revise(s, problem.at(draft.theta), draft.theta, draft.take, ticks[4])
            old, new = (x.names[: x.n_terms] for x in (lean, draft.model))
            draft.details["added_beside_the_network"] = [x for x in new if x not in old]
            draft.details["left_out_beside_the_network"] = [x for x in old if x not in new]
    if s.ne is None:
        problem = hybrid_problem(draft.model, data.parts, draft.theta, s.prior)
        draft.take(*choose_noise(problem, draft.theta, s.prior, s.criterion, ticks[5]))
        if not neurons:
            function = _lean(draft.model)
            draft.take(function, transfer(draft.model, draft.theta, function))
    _search(s, data, draft, "all together", ticks[6])
    draft.timed("all together", began)


def _prepare(s: HybridSettings, lean: HybridFunction, theta: Array) -> tuple[HybridFunction, Array]:
    """The function that a network joins, all its regressors in the polynomial too: it shall not do what is linear."""
    function = replace(lean, ny=s.ny, nu=s.nu)
    if s.pruning == "none":
        return function, theta
    linear = tuple((f,) for f in lagged(function.p, function.m, ny=s.ny, nu=s.nu, nk=s.nk, ne=0))
    function = replace(function, terms=tuple((*t, *(x for x in linear if x not in t)) for t in function.terms))
    return function, transfer(lean, theta, function)


def _lean(function: HybridFunction) -> HybridFunction:
    """Without neurons, no more lags than the polynomial looks at: a model of as little past as there can be."""
    reach = {"y": 0, "u": 0}
    for f in (f for one in function.terms for x in one for f in x):
        reach[f.kind] = max(reach[f.kind], f.lag - (function.nk - 1 if f.kind == "u" else 0))
    return replace(function, ny=reach["y"], nu=reach["u"]) if any(reach.values()) else function


def _search(s: HybridSettings, data: Scaled, draft: _Hybrid, stage: str, tick: Tick | None) -> LaggedProblem:
    """Search for all numbers, errors of unit variance."""
    function = draft.model
    problem = hybrid_problem(function, data.parts, draft.theta, s.prior)
    if tick is not None:
        tick(stage, 0.0)
    found = search(
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
    draft.take(function, found.theta)
    draft.note(found, problem, f"{stage}: Levenberg-Marquardt, prediction errors")
    draft.status = "converged" if found.converged else "stalled"
    return problem


def _finish(s: HybridSettings, records: Sequence[IOData], data: Scaled, draft: _Hybrid, seed: int) -> NonlinearFit:
    of = draft.model
    used = {**asdict(s), "ne": of.ne, "neurons": of.neurons}
    problem = hybrid_problem(of, data.parts, draft.theta, s.prior)
    if not np.isfinite(problem.cost(draft.theta)):
        return failed_fit("hybrid", records, used, seed, _DIVERGED, draft.timing_s)
    found = laplace(problem, draft.theta)
    draft.warnings += _cautions(draft, found)
    spare = _spare_units(of, draft.theta, problem, found)
    draft.details |= _details(records, data, draft, problem)
    why_not = (
        f"no standard deviations: {spare} of {of.neurons} units explain less than their numbers cost, and intervals "
        f"beside units to spare are too narrow. Say neurons = {of.neurons - spare}"
    )
    return finish(
        "hybrid", records, used, data, draft, problem, found, units="neurons or terms", how="laplace",
        why_not=why_not if spare else "", noise=s.ne != 0, instead="Raise ne", seed=seed,
    )  # fmt: skip


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


def _cautions(draft: _Hybrid, found: Laplace) -> list[str]:
    of, out = draft.model, []
    radius = of.noise_radius(draft.theta)
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


def _details(records: Sequence[IOData], data: Scaled, draft: _Hybrid, problem: LaggedProblem) -> dict[str, object]:
    of, y_all = draft.model, np.concatenate([y for y, _ in data.parts])
    terms: dict[str, list[dict[str, object]]] = {}
    for o, out in enumerate(records[0].outputs):
        named = [term_name(x, of.p, of.m) for x in (*of.terms[o], *of.noise_terms)]
        terms[out] = [{"term": x, "err": draft.err.get((out, x))} for x in named]
    layer, own = of.blocks[2], of.split(draft.theta)[2]
    assert isinstance(layer, Tanh)
    rows = [of.predict(draft.theta, r)[1] for r in problem.rows()]
    hidden = np.concatenate([layer.values(own, r.prepared[2]) for r in rows])
    by_netdraft = np.std(hidden, axis=0) / np.maximum(np.std(y_all, axis=0), 1e-300)
    return {
        "terms": terms,
        "network_share": dict(zip(records[0].outputs, by_netdraft.tolist(), strict=True)),
        "noise_model": {
            "largest_root": of.noise_radius(draft.theta),
            "coefficients": draft.theta[of.n_terms : of.n_linear].tolist(),
            "start_drawn_in_by": draft.details.pop("drawn_in"),
        },
        "levels": data.levels(records[0]),
    }
