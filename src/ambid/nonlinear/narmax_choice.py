"""Which terms a NARMAX model has: process terms, noise terms, and which of them can go again.

Process terms come by orthogonal least squares; noise terms by extended least squares, process terms held (Billings
2013, sec. 3.5). A term goes, others readjusted along the linearised
problem (exact for NARX), if a criterion gains by predictions, or the free run does not pay: what predicts well may
spoil a run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.linear import least_squares
from ambid.estimation.progress import Tick, guessed, part_of
from ambid.estimation.search import Found, search
from ambid.estimation.uncertainty import CRITERIA, information, penalty
from ambid.nonlinear.fit import choice, read_settings, whole
from ambid.nonlinear.lagged_problem import LaggedProblem, problem_at
from ambid.nonlinear.polynomial import (
    Candidates,
    Factor,
    PolynomialFunction,
    Selection,
    Term,
    candidates,
    lagged,
    products,
    select_terms,
)
from ambid.nonlinear.records import Parts

_ENOUGH = 1e-3  # gain, in the errors' variance, that ends a search: a step of 0.03 standard deviations
_NEARLY_ALL = 0.99  # of the output's energy
_LONG = 20  # lags of the model whose errors begin
_LESS = 0.95  # part of the errors' variance that it must leave
_ROUNDS = 12  # of extended least squares
_USUAL_ROUNDS = 3.0  # about half of those that it takes
_CHOOSING = 3  # rounds in which the choice of noise terms may still change
_USUAL_PRUNED = 4.0  # about half of the terms that are left out
_PRUNED = 10  # coefficients that are tried before it is said that none can go
_WORSE = 1.2  # times the errors' squares: beyond, leaving one out is far from what the linearised problem says


@dataclass(frozen=True, slots=True, kw_only=True)
class NarmaxSettings:
    """Settings of a NARMAX fit."""

    ny: int = whole("largest lag of the outputs; 2", 0, 100, 2)
    nu: int = whole("number of lags of each input; 2", 0, 100, 2)
    nk: int = whole("smallest lag of the inputs; 1", 0, 1000, 1)
    ne: int = whole("largest lag of the innovations, 0 for NARX; 2", 0, 100, 2)
    degree: int = whole("of the polynomial; 2", 1, 9, 2)
    terms: int = whole("largest number of process terms for each output; 30, fewer on a short record", 1, 2000, 30)
    constant: int = whole("1 to let a constant be chosen, 0 for none; 1", 0, 1, 1)
    criterion: str = choice(
        "criterion that ends the choice of terms: ebic, bic, mdl, aic, aicc, fpe, lilc; ebic", *CRITERIA
    )
    pruning: str = choice(
        "criterion that removes terms again: prediction, simulation, none; prediction",
        *("prediction", "simulation", "none"),
    )
    selection: str = choice(
        "frols (by ratios), all (every candidate), auto (frols; all if a plant is sampled so fast that the ratios "
        "say little, and all predict better); auto",
        *("auto", "frols", "all"),
    )
    focus: str = choice(
        "prediction or simulation: errors that are minimised in the end; prediction",
        *("prediction", "simulation"),
    )

    @property
    def lag(self) -> int:
        """Samples of the past that a candidate may look at."""
        return max(self.ny, self.nk + self.nu - 1 if self.nu else 0, self.ne)


def narmax_settings(settings: Mapping[str, object], *, n_inputs: int) -> NarmaxSettings:
    """Check settings and complete them; without inputs there are no lags of them."""
    s = read_settings(NarmaxSettings, "narmax", settings)
    if not n_inputs:
        s = replace(s, nu=0, nk=1)
    if not s.ny and not s.nu:
        raise EstimationError("narmax: ny and nu are both 0, and nothing is left to predict from. Raise one of them")
    return s


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Choice:
    """Terms with their coefficients, in scaled signals, and how they were chosen."""

    function: PolynomialFunction
    theta: Array
    err: Mapping[tuple[int, Term], float] = field(default_factory=dict)  # error reduction ratio, where there is one
    n_candidates: int = 0  # of one output, at most
    passes: int = 0  # over the data, in the choice of process terms

    def with_theta(self, theta: Array) -> Choice:
        """Return the same terms with other coefficients."""
        return replace(self, theta=theta)

    def with_terms(self, terms: list[tuple[Term, ...]], coefficients: list[Array]) -> Choice:
        """Return other terms with coefficients, by output."""
        return replace(self, function=replace(self.function, terms=tuple(terms)), theta=np.concatenate(coefficients))

    def coefficients(self, output: int) -> Array:
        """Return the coefficients of an output."""
        return self.theta[[o == output for o, _ in self.function.owned]]

    def without(self, k: int, theta: Array) -> Choice:
        """Return a choice without term k; `theta` is of those that stay."""
        owned = self.function.owned
        return replace(self, function=self.function.with_terms((*owned[:k], *owned[k + 1 :])), theta=theta)

    def without_noise(self) -> Choice:
        """Return the process part."""
        stays = ~self.function.noisy
        owned = [x for x, stay in zip(self.function.owned, stays, strict=True) if stay]
        return replace(self, function=self.function.with_terms(owned), theta=self.theta[stays])

    def problem(self, parts: Parts, *, free: bool = False, weight: Array | None = None) -> LaggedProblem:
        """Return the problem of its coefficients; errors count alike without a `weight`."""
        weight = np.eye(self.function.n_outputs) if weight is None else weight
        return problem_at(self.function, parts, self.theta, free=free, weight=weight)

    def cost(self, parts: Parts, *, free: bool = False, weight: Array | None = None) -> float:
        """Return the sum of squared weighted errors; infinite where it diverges."""
        return self.problem(parts, free=free, weight=weight).cost(self.theta)

    def value(self, criterion: str, parts: Parts, n: int, *, free: bool = False, weight: Array | None = None) -> float:
        """Return an information criterion of its errors, `n` in number."""
        cost, m = self.cost(parts, free=free, weight=weight), max(self.n_candidates, self.theta.size)
        return information(criterion, cost / n, self.theta.size, n, m) if np.isfinite(cost) else np.inf

    def search(
        self,
        parts: Parts,
        *,
        free: bool,
        weight: Array | None = None,
        most: int = 40,
        tick: Tick | None = None,
        keep: Callable[[Array], None] | None = None,
    ) -> Found:
        """Search for the coefficients of the least sum of squared errors."""
        problem = self.problem(parts, free=free, weight=weight)
        return search(
            problem, self.theta, stage="simulation-error search" if free else "prediction-error search", most=most,
            tolerance=max(1e-10, _ENOUGH / max(problem.n_errors, 1)), damping=1e-4, tick=tick, keep=keep,
        )  # fmt: skip


def samples(parts: Parts, lag: int) -> int:
    """Return how many samples of one output can be predicted."""
    return max(sum(max(int(y.shape[0]) - lag, 0) for y, _ in parts), 2)


# --- process terms ---------------------------------------------------------------------------------------------------


def process_terms(s: NarmaxSettings, parts: Parts, tick: Tick | None) -> Choice:
    """Choose the terms without innovations by orthogonal least squares, and their coefficients by least squares."""
    p, m = parts[0][0].shape[1], parts[0][1].shape[1]
    terms = process_candidates(s, p, m)
    rows = candidates(terms, parts, s.lag)
    num, theta, err, passes = [], [], {}, 0
    for o in range(p):
        target = np.concatenate([y[s.lag :, o] for y, _ in parts])
        chosen = _choose(s, rows, target, part_of(tick, o / p, (o + 1) / p))
        n_best = len(chosen.order) if s.selection == "all" else max(chosen.n_best, 1)  # no model without a term
        picks = chosen.order[:n_best] or (0,)
        err.update({(o, terms[k]): float(x) for k, x in zip(picks, chosen.err, strict=False)})
        num.append(tuple(terms[k] for k in picks))
        theta.append(least_squares(rows.columns(picks), target))
        passes = max(passes, chosen.passes)
    function = PolynomialFunction(terms=tuple(num), m=m)
    return Choice(function=function, theta=np.concatenate(theta), err=err, n_candidates=len(terms), passes=passes)


def process_candidates(s: NarmaxSettings, n_outputs: int, n_inputs: int) -> tuple[Term, ...]:
    """Return all products of lagged outputs and inputs that the settings allow."""
    factors = lagged(n_outputs, n_inputs, ny=s.ny, nu=s.nu, nk=s.nk)
    return products(factors, s.degree, constant=bool(s.constant))


def is_sampled_fast(model: Choice) -> bool:
    """Return whether an output's last value takes so much of an error reduction ratio that the ratios say little."""
    return any(x == (Factor("y", o, 1),) and ratio > _NEARLY_ALL for (o, x), ratio in model.err.items())


def _choose(s: NarmaxSettings, pool: Candidates, y: Array, tick: Tick | None) -> Selection:
    """Choose as the settings say."""
    most = len(pool.terms) if s.selection == "all" else min(s.terms, max(y.size // 5, 1))
    tell = None if tick is None else lambda done: tick("choice of terms", done)
    return select_terms(pool, y, most=most, criterion=s.criterion, tick=tell)


# --- noise terms ------------------------------------------------------------------------------------------------------


def add_noise_terms(s: NarmaxSettings, process: Choice, parts: Parts, tick: Tick | None) -> Choice:
    """Add innovations to process terms by extended least squares, until coefficients stand still."""
    p, m = parts[0][0].shape[1], parts[0][1].shape[1]
    extra = tuple((f,) for f in lagged(p, m, ny=0, nu=0, nk=1, ne=s.ne))
    errors = innovations(process, parts)
    if not extra or errors is None:
        return process
    errors = _innovations_of_long_model(process, parts, errors)
    own, last, best = process.function.terms, process.theta, process
    chosen: list[tuple[Term, ...]] = [()] * p
    targets = [np.concatenate([y[s.lag :, o] for y, _ in parts]) for o in range(p)]
    for rounds in range(_ROUNDS):
        if tick is not None:
            tick("extended least squares", guessed(rounds, _USUAL_ROUNDS))
        num, theta = [], []
        for o in range(p):
            if rounds < _CHOOSING:  # process terms are in the regression, not in the choice
                rows, first = candidates((*own[o], *extra), parts, s.lag, errors), range(len(own[o]))
                most = len(first) + s.terms
                selection = select_terms(rows, targets[o], most=most, criterion=s.criterion, first=first)
                chosen[o] = tuple(rows.terms[k] for k in selection.chosen if k >= len(first))
            num.append((*own[o], *chosen[o]))
            rows = candidates(num[o], parts, s.lag, errors)
            theta.append(least_squares(rows.columns(range(len(num[o]))), targets[o]))
        trial = process.with_terms(num, theta)
        fresh = innovations(trial, parts)
        if fresh is None:
            return best
        errors, best = fresh, trial
        still = trial.theta.shape == last.shape and np.allclose(trial.theta, last, rtol=1e-4, atol=1e-6)
        last = trial.theta
        if still and rounds >= _CHOOSING - 1:
            break
    return best


def _innovations_of_long_model(process: Choice, parts: Parts, errors: list[Array]) -> list[Array]:
    """First innovations, if less, from many linear lags beside the process terms (Hannan and Rissanen 1982): with
    fast-sampled output noise the errors of least squares are nearly white, and biased so that no noise term pays.
    """
    n, function = min(int(y.shape[0]) for y, _ in parts), process.function
    most = min(_LONG, n // (10 * (function.n_outputs + function.m)))
    if most <= function.lag:
        return errors
    linear = [(f,) for f in lagged(function.n_outputs, function.m, ny=most, nu=most, nk=1)]
    num, theta = [], []
    for o, terms in enumerate(function.terms):
        num.append((*terms, *(x for x in linear if x not in terms)))
        rows = candidates(num[o], parts, most)
        theta.append(least_squares(rows.columns(range(len(num[o]))), np.concatenate([y[most:, o] for y, _ in parts])))
    improved = innovations(process.with_terms(num, theta), parts)
    if improved is None:
        return errors
    size = [np.mean(np.concatenate([x[most:] for x in e]) ** 2, axis=0) for e in (errors, improved)]
    return improved if np.any(size[1] < _LESS * size[0]) else errors


def add_all_noise(s: NarmaxSettings, model: Choice) -> Choice:
    """Return the choice with every innovation that it may have, those that are new at zero; the same if none is."""
    function = model.function
    extra = [(f,) for f in lagged(function.n_outputs, function.m, ny=0, nu=0, nk=1, ne=s.ne)]
    more = [[x for x in extra if x not in terms] for terms in function.terms]
    if not any(more):
        return model
    num = [(*terms, *new) for terms, new in zip(function.terms, more, strict=True)]
    return model.with_terms(num, [np.append(model.coefficients(o), np.zeros(len(x))) for o, x in enumerate(more)])


def innovations(model: Choice, parts: Parts) -> list[Array] | None:
    """Return the one-step errors of each record, zero before the first prediction; None where they diverge."""
    errors, lag = model.problem(parts).errors(model.theta), model.function.lag
    if not all(np.all(np.isfinite(e)) for e in errors):
        return None
    return [np.concatenate([np.zeros((lag, e.shape[1])), e]) for e in errors]


# --- pruning ----------------------------------------------------------------------------------------------------------


def prune_by_prediction(model: Choice, parts: Parts, weight: Array, criterion: str, *, noise: bool = True) -> Choice:
    """Leave out terms as long as the information criterion of the one-step errors falls; `noise`: innovations too."""
    n = samples(parts, model.function.lag)
    m = max(model.n_candidates, model.theta.size)
    while model.theta.size > model.function.n_outputs:
        R, cost = model.problem(parts, weight=weight).triangle(model.theta), model.cost(parts, weight=weight)
        if not np.all(np.isfinite(R)):
            break
        loss, inverse = _find_losses(R, model.theta)
        saved = penalty(criterion, model.theta.size, n, m) - penalty(criterion, model.theta.size - 1, n, m)
        may = _may_go(model, noise=noise)
        order = np.argsort(np.where(may, loss, np.inf), kind="stable")[:_PRUNED]
        trials = (_readjust(model, inverse, int(k)) for k in order if may[k] and loss[k] < saved)
        fewer = next((x for x in trials if x.cost(parts, weight=weight) < _WORSE * cost), None)
        if fewer is None:
            break
        model = fewer
    return model


def prune_by_simulation(
    model: Choice, parts: Parts, value: Callable[[Choice], float], tick: Tick | None = None
) -> Choice:
    """Leave out process terms while `value`, an information criterion of simulation errors, falls."""
    now, before = value(model), model.theta.size
    while model.theta.size > model.function.n_outputs and np.isfinite(now):
        if tick is not None:
            tick("simulation-error pruning", guessed(before - model.theta.size, _USUAL_PRUNED))
        R = model.problem(parts).triangle(model.theta)
        if not np.all(np.isfinite(R)):
            break
        _, inverse = _find_losses(R, model.theta)
        trials = [_readjust(model, inverse, int(k)) for k in np.flatnonzero(_may_go(model, noise=False))]
        values = [value(x) for x in trials]
        if not values or not min(values) < now:
            break
        best = int(np.argmin(values))
        model, now = trials[best], values[best]
    return model


def _find_losses(R: Array, theta: Array) -> tuple[Array, Array]:
    """How much the sum of squares grows without each coefficient, and the inverse triangle."""
    scale = np.maximum(np.linalg.norm(R[:, :-1], axis=0), 1e-150)
    inverse = np.linalg.pinv(R[: theta.size, :-1] / scale, rcond=1e-13) / scale[:, None]
    variance = np.sum(inverse**2, axis=1)
    return theta**2 / np.maximum(variance, 1e-300), inverse


def _readjust(model: Choice, inverse: Array, k: int) -> Choice:
    """The choice without term k, the other coefficients adjusted."""
    covariance = inverse @ inverse[k]
    return model.without(k, np.delete(model.theta - covariance * (model.theta[k] / max(covariance[k], 1e-300)), k))


def _may_go(model: Choice, *, noise: bool) -> np.ndarray:
    """Whether a term may be left out: an output keeps one term at least, innovations go only with `noise`."""
    function = model.function
    alone = np.array([len(function.terms[o]) == 1 for o, _ in function.owned])
    return np.asarray(~alone & (noise | ~function.noisy))
