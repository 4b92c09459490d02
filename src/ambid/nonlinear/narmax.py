"""NARMAX from records: terms by orthogonal least squares, coefficients by prediction (or simulation) errors.

Deviations are those of the chosen terms; where a term was a close call they are too small, as it was chosen from the
same data (Leeb and Poetscher 2005).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from time import perf_counter

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.progress import Tick, part_of, portions
from ambid.nonlinear.fit import NonlinearFit, Settings
from ambid.nonlinear.lagged_problem import Draft, finish, laplace
from ambid.nonlinear.narmax_choice import (
    Choice,
    NarmaxSettings,
    add_all_noise,
    add_noise_terms,
    is_sampled_fast,
    narmax_settings,
    process_terms,
    prune_by_prediction,
    prune_by_simulation,
    samples,
)
from ambid.nonlinear.polynomial import PolynomialFunction, term_name
from ambid.nonlinear.records import Parts, scaled_records

_CLEAR = 10.0  # of the information criterion, which all candidates have to gain over those of the ratios
_MOST_AT_ONCE = 60  # candidates of an output: searches and prunings of more take minutes
_PRUNINGS = 6
_ITERATIONS, _ROUGHLY = 60, 12  # of a search at most; of one between, with terms too many, which creeps
DIVERGED = "no finite one-step predictor was found; lower ne, degree or terms, or check the columns"


@dataclass(slots=True, kw_only=True)
class _Fitting(Draft[PolynomialFunction]):
    """The best model so far that runs, and how its terms were chosen."""

    choice: Choice

    def take(self, choice: Choice, *, free: bool) -> None:
        """Take over another model; `free`: whether its coefficients are fitted to the free run."""
        self.choice, self.function, self.theta, self.free = choice, choice.function, choice.theta, free


def narmax(records: Sequence[IOData], settings: Settings, *, seed: int = 0, tick: Tick | None = None) -> NonlinearFit:
    """Identify a polynomial NARMAX model (thesis eqs 3.1-3.4), not random; consistent
    under feedback as long as the terms hold the true ones and ``focus`` is ``prediction``.
    """
    if not records:
        raise EstimationError("narmax: no record was given. Pass at least one")
    s = narmax_settings(settings, n_inputs=records[0].n_inputs)
    data = scaled_records("narmax", records, lag=s.lag, levels="auto", fewest=10)
    # a linear model: something to hand over when the very next thing is an interruption
    linear = process_terms(replace(s, degree=1, ne=0, selection="frols"), data.parts, None)
    fitting = _Fitting(
        structure="narmax", records=records, settings=asdict(s), seed=seed, data=data, choice=linear,
        function=linear.function, theta=linear.theta,
    )  # fmt: skip

    def identify() -> None:
        _fit_terms(s, data.parts, fitting, tick)
        if fitting.status == "stalled":
            fitting.warnings.insert(0, "the search did not converge: treat the values as a first guess")

    reason = fitting.guarded(identify)
    if reason or not np.isfinite(fitting.choice.cost(data.parts)):
        return fitting.failed(reason or DIVERGED)
    return _finish(s, fitting)


def _fit_terms(s: NarmaxSettings, parts: Parts, fitting: _Fitting, tick: Tick | None) -> None:
    if tick is not None:
        tick("start", 0.0)
    if s.selection != "auto":
        _run_stages(s, parts, fitting, tick)
        return
    by_ratio, every = replace(s, selection="frols"), replace(s, selection="all")
    first = process_terms(by_ratio, parts, None)
    few = first.n_candidates <= min(_MOST_AT_ONCE, samples(parts, s.lag) // 20)  # all can be in a model at once
    if not (few and is_sampled_fast(first)):
        _run_stages(by_ratio, parts, fitting, tick)
        return
    _run_stages(by_ratio, parts, fitting, part_of(tick, 0.0, 0.2))
    one, status, curves, free = fitting.choice, fitting.status, len(fitting.curves), fitting.free
    weight = _weight(one, parts)
    _run_stages(every, parts, fitting, part_of(tick, 0.2, 1.0))
    gained = _value(s, parts, one, weight) - _value(s, parts, fitting.choice, weight)
    if gained > _CLEAR and fitting.free == free:
        fitting.warnings.append(
            "sampled so fast that the last output takes nearly all of an error reduction ratio and hides what "
            "drives the plant: terms were selected from all candidates (selection = all), which predicts better "
            "than selection by ratios"
        )
        return
    fitting.take(one, free=free)
    fitting.status = status
    del fitting.curves[curves:]


def _run_stages(s: NarmaxSettings, parts: Parts, fitting: _Fitting, tick: Tick | None) -> None:
    """All stages, one after the other; their shares of the time are a guess, right within a factor of some."""
    free = s.focus == "simulation"
    choosing, noise, pruning, last = portions(tick, (0.2, 1.0 * bool(s.ne), 1.5, 1.0 * free))
    began = perf_counter()
    choice = process_terms(s, parts, choosing)
    _keep(fitting, parts, choice)
    began = fitting.timed("terms", began)
    if s.ne:
        choice = add_noise_terms(s, choice, parts, part_of(noise, 0.0, 0.4))
        choice = _search(parts, choice, fitting, part_of(noise, 0.4, 1.0))
    began = fitting.timed("noise terms", began)
    choice = _prune(s, parts, choice, fitting, pruning)
    began = fitting.timed("pruning", began)
    if free:
        choice = choice.without_noise()
        if np.isfinite(choice.cost(parts, free=True)):
            _search(parts, choice, fitting, last, free=True)
        else:
            fitting.status = "stalled"
            fitting.warnings.append(
                "the simulation of the chosen terms diverges, so that their coefficients are those of the one-step "
                "errors: give pruning = simulation, or lower degree"
            )
        fitting.timed("simulation errors", began)


def _weight(choice: Choice, parts: Parts, *, free: bool = False) -> Array:
    """What gives the errors of a choice unit variance."""
    problem = choice.problem(parts, free=free)
    return problem.weight_for(np.concatenate(problem.errors(choice.theta)))


def _keep(fitting: _Fitting, parts: Parts, choice: Choice) -> None:
    """Keep a choice if it runs."""
    if np.isfinite(choice.cost(parts)):
        fitting.take(choice, free=False)


def _search(
    parts: Parts, choice: Choice, fitting: _Fitting, tick: Tick | None, *, free: bool = False, most: int = _ITERATIONS
) -> Choice:
    """Search for coefficients; a model that is linear in them and has no innovations is where it should be already."""
    if not free and not np.any(choice.function.noisy):
        _keep(fitting, parts, choice)
        return choice
    weight = _weight(choice, parts, free=free)

    def keep(theta: Array) -> None:
        fitting.take(choice.with_theta(theta), free=free)

    ended = choice.search(parts, weight=weight, free=free, most=most, tick=tick, keep=keep)
    if not np.isfinite(ended.cost):
        return choice
    problem = choice.problem(parts, free=free, weight=weight)
    fitting.settle(ended, problem, f"Levenberg-Marquardt, {'simulation' if free else 'prediction'} errors")
    keep(ended.theta)
    return choice.with_theta(ended.theta)


def _prune(s: NarmaxSettings, parts: Parts, choice: Choice, fitting: _Fitting, tick: Tick | None) -> Choice:
    if s.pruning == "none":
        return choice
    if s.pruning == "simulation":
        n = samples(parts, choice.function.lag)
        fewer = prune_by_simulation(
            choice, parts, lambda x: x.value(s.criterion, parts, n, free=True), part_of(tick, 0.0, 0.6)
        )
        return choice if fewer is choice else _search(parts, fewer, fitting, part_of(tick, 0.6, 1.0))
    weight = _weight(choice, parts)

    def prune(x: Choice, share: float, *, noise: bool = True, most: int = _ITERATIONS) -> Choice:
        for k in range(_PRUNINGS):  # a search between, for what may go is judged where the rest is at its best
            fewer = prune_by_prediction(x, parts, weight, s.criterion, noise=noise)
            same, begin = fewer.theta.size == x.theta.size, share + 0.25 * k / _PRUNINGS
            x = _search(parts, fewer, fitting, part_of(tick, begin, begin + 0.25 / _PRUNINGS), most=most)
            if same:
                break
        return x

    best = prune(choice, 0.0)
    ended = fitting.status
    richer = add_all_noise(s, choice)
    if richer is not choice and np.any(choice.function.noisy):
        # An equation multiplied by a polynomial in q^-1 predicts as well, with other noise terms: only where all of
        # these are there can the surplus process terms go one by one.
        other = _search(parts, richer, fitting, part_of(tick, 0.25, 0.5), most=_ROUGHLY)
        other = prune(prune(other, 0.5, noise=False, most=_ROUGHLY), 0.75)
        if _value(s, parts, other, weight) < _value(s, parts, best, weight):
            best, ended = other, fitting.status
    fitting.status = ended
    _keep(fitting, parts, best)
    return best


def _value(s: NarmaxSettings, parts: Parts, choice: Choice, weight: Array) -> float:
    """Information criterion of the one-step errors of all outputs."""
    n = samples(parts, choice.function.lag) * choice.function.n_outputs
    return choice.value(s.criterion, parts, n, weight=weight)


def _finish(s: NarmaxSettings, fitting: _Fitting) -> NonlinearFit:
    """Return the fit of a model that runs."""
    function, theta, first = fitting.function, fitting.theta, fitting.records[0]
    problem = fitting.choice.problem(fitting.data.parts, free=fitting.free).at(theta)
    posterior = laplace(problem, theta)
    terms = {
        first.outputs[o]: [
            {"term": term_name(x, function.n_outputs, function.m), "err": fitting.choice.err.get((o, x))} for x in own
        ]
        for o, own in enumerate(function.terms)
    }
    fitting.details = {
        "terms": terms, "candidates": fitting.choice.n_candidates, "passes": fitting.choice.passes,
        "levels": fitting.data.levels(first),
    }  # fmt: skip
    fitting.settings["focus"] = "simulation" if fitting.free else "prediction"
    return finish(
        fitting, problem, posterior, units="terms", noise=s.ne > 0 and not fitting.free,
        instead="Give focus = prediction" if fitting.free else "Raise ne",
    )  # fmt: skip
