"""The function of a hybrid model, and what is left open of it: neurons, the order of C, terms beside units.

yhat(t) = P(y, u) theta + W2 tanh(W1 z + b1) + (C(q^-1) - 1) e(t), z = [y(t-1).., u(t-nk)..], with C the polynomial
1 + C1 q^-1 + .. of `ne` matrices (thesis eqs 3.23, 3.24); there z holds past innovations too, an option here.

The hidden layer's weights are N(0, prior^2) before the data (scaled signals), coefficients of the polynomial and of C
have no prior: what the polynomial can do costs nothing, so that it is not left to the network. C keeps its roots inside
the unit circle because a vector with a root outside has an infinite cost: such a step is refused, and a shorter one
tried. With innovations inside the network the roots of C alone say nothing; there only a divergence is refused.

Terms were chosen before there was a network, so that some only imitate it, and others were hidden by what it does. One
at a time, the term goes or comes that the information criterion gains most by; each step searches all numbers anew, and
the criterion falls with every step. A term that the network could take over stays as it is: otherwise units that are to
spare would swallow it, and what can be read would become what cannot.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import log
from typing import Any, ClassVar, Self

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.criteria import CRITERIA, penalty
from ambid.estimation.linear import information_inverse
from ambid.estimation.progress import Tick, guessed, part_of, portions
from ambid.estimation.search import Found, search
from ambid.nonlinear.blocks import Block, Linear, Mask, Table, Tanh
from ambid.nonlinear.lagged import LaggedFunction, Regressors, channel_names, lags
from ambid.nonlinear.lagged_problem import LaggedProblem, column_gains, problem_at
from ambid.nonlinear.polynomial import (
    Factor,
    Term,
    block_of,
    column_of,
    lagged,
    products,
    term_name,
    terms_from_json,
    terms_to_json,
    unit_of,
)
from ambid.nonlinear.records import Parts
from ambid.nonlinear.settings import choice, number, read_settings, whole

Counted = tuple[Mask, ...]

MOST_NOISE = 4  # largest order of C that is tried where it is left open
SHARED = 10.0  # times a standard deviation grows by the network, from which on a term's value is not its own
_NEURONS = (0, 1, 2, 4, 8)
_DRAWS = 40  # of a random hidden layer
_DRAWN_ON = 1000  # rows by which they are compared
_STARTED_ON = 12000  # rows from which starts are trained
_MOST_ROWS = 6000  # that a comparison looks at, all stretches together
_BATCHES = 20  # of held-out data, over which squared errors are compared
_SURE = 2.0  # standard errors by which a larger network has to be better
_ROUGH: dict[str, Any] = {"most": 12, "enough": 0.01}  # iterations, and a gain of the cost that no choice depends on
_MOST_STEPS = 40  # of a revision
_MOST_CANDIDATES = 400  # beyond, nothing is added: slopes by all of them at once would be too many


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


@dataclass(frozen=True, kw_only=True)
class HybridFunction(LaggedFunction):
    """Terms and sizes of a hybrid model."""

    kind: ClassVar[str] = "hybrid"
    title: ClassVar[str] = "hybrid"
    terms: tuple[tuple[Term, ...], ...]  # of the polynomial, by output, without innovations
    ne: int  # order of C
    p: int  # outputs
    m: int  # inputs
    ny: int  # lags of every output and of every input, and the first lag of the inputs, that the hidden layer sees
    nu: int
    nk: int
    neurons: int
    deep: bool = False  # whether past innovations are regressors of the hidden layer too

    @cached_property
    def seen(self) -> Regressors:
        """What the hidden layer sees, without innovations."""
        return lags(self.p, self.m, ny=self.ny, nu=self.nu, nk=self.nk)

    @cached_property
    def regressors(self) -> Regressors:
        """What the network sees, innovations, then whatever else the terms look at."""
        x = lags(self.p, self.m, ny=self.ny, nu=self.nu, nk=self.nk, ne=self.ne)
        known = set(zip(x.column.tolist(), x.back.tolist(), strict=True))
        factors = {(column_of(f, self.p, self.m), f.lag) for _, _, term in self.owned for f in term}
        more = np.array(sorted(factors - known), dtype=np.int64).reshape(-1, 2)
        column, back = np.append(x.column, more[:, 0]), np.append(x.back, more[:, 1])
        return Regressors(n_outputs=self.p, n_inputs=self.m, column=column, back=back)

    @property
    def owned(self) -> tuple[tuple[int, int, Term], ...]:
        """Output, 0, and term of each coefficient of the polynomial."""
        return tuple((o, 0, term) for o, one in enumerate(self.terms) for term in one)

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """Polynomial, C, hidden layer."""
        d = self.seen.column.size
        last = d + self.p * self.ne
        return (
            block_of(self.regressors, self.owned),
            Linear.over(self.p, slice(d, last), constant=False),
            Tanh(n_outputs=self.p, width=last if self.deep else d, neurons=self.neurons),
        )

    @property
    def in_cloud(self) -> slice | Table:
        """What the hidden layer sees, without innovations."""
        return slice(0, self.seen.column.size)

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
        found = [before[o] + term_name(x, self.p, self.m) for o in range(self.p) for x in self.terms[o]]
        found += [before[o] + term_name(x, self.p, self.m) for o in range(self.p) for x in self.noise_terms]
        z = self.regressors.names[: self.seen.column.size + (self.p * self.ne if self.deep else 0)]
        found += [f"{name}: unit {k + 1}" for name in out for k in range(self.neurons)]
        found += [f"unit {k + 1}: {x}" for k in range(self.neurons) for x in z]
        return (*found, *(f"unit {k + 1}: 1" for k in range(self.neurons)))

    def unit(self, y_scale: Array, u_scale: Array) -> Array:
        """Coefficients of the polynomial and of C are in SI; weights of the network stay scaled."""
        owned = (*self.owned, *((o, 0, x) for o in range(self.p) for x in self.noise_terms))
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
        return self.deep or self.noise_radius(theta) < 1.0

    def precision(self, prior: float) -> Array:
        """Return one over the prior's standard deviation of every number; 0 for the polynomial and C."""
        return np.where(np.arange(self.n_theta) < self.n_linear, 0.0, 1.0 / prior)

    def as_json(self) -> dict[str, Any]:
        """As `LaggedFunction.as_json`."""
        sizes = {"n_outputs": self.p, "n_inputs": self.m, "ny": self.ny, "nu": self.nu, "nk": self.nk}
        return {
            "terms": terms_to_json(self.terms),
            "ne": self.ne,
            "sizes": {**sizes, "neurons": self.neurons},
            "innovations": "network" if self.deep else "linear",
        }

    @classmethod
    def from_json(cls, found: dict[str, Any]) -> Self:
        """Read it back."""
        sizes = {k: int(v) for k, v in found["sizes"].items()}
        p, m = sizes.pop("n_outputs"), sizes.pop("n_inputs")
        terms = terms_from_json(found["terms"], p, m)
        innovations, ne = found["innovations"], found["ne"]
        if innovations not in ("linear", "network") or not isinstance(ne, int) or ne < 0:
            raise ValueError("innovations or ne are none")
        return cls(terms=terms, ne=ne, p=p, m=m, deep=innovations == "network", **sizes)


def hybrid_problem(
    function: HybridFunction,
    parts: Parts,
    theta: Array,
    prior: float,
    *,
    live: Mask | None = None,
    counted: Counted | None = None,
) -> LaggedProblem:
    """Return the problem whose errors have unit covariance at given numbers."""
    return problem_at(function, parts, theta, function.precision(prior), live=live, joint=True, counted=counted)


def function_of(problem: LaggedProblem) -> HybridFunction:
    """Return the hybrid function of a problem."""
    assert isinstance(problem.function, HybridFunction)
    return problem.function


def transfer(old: HybridFunction, theta: Array, new: HybridFunction) -> Array:
    """Return the numbers of another function: those with the same names are taken over, new ones are zero.

    C is drawn towards zero where it would not be invertible.
    """
    known = dict(zip(old.names, theta, strict=True))
    out = np.array([known.get(name, 0.0) for name in new.names], dtype=np.float64)
    return make_invertible(new, out)[0]


def make_invertible(function: HybridFunction, theta: Array) -> tuple[Array, float]:
    """Return numbers with an invertible C to start from, all its roots drawn in by one factor, and this factor.

    They are the same, and the factor 1, where C is invertible.
    """
    if function.is_stable(theta):
        return theta, 1.0
    radius, p, out = function.noise_radius(theta), function.p, theta.copy()
    factor = 0.95 / radius if np.isfinite(radius) else 0.0
    C = theta[function.n_terms : function.n_linear].reshape(p, -1).copy()
    for k in range(function.ne):
        C[:, k * p : (k + 1) * p] *= factor ** (k + 1)
    out[function.n_terms : function.n_linear] = np.where(np.isfinite(C), C, 0.0).ravel()
    return out, factor


# --- network ---------------------------------------------------------------------------------------------------------


def _first(parts: Parts, counted: Counted | None, most: int) -> tuple[Parts, Counted | None]:
    """The first samples of each record."""
    return tuple((y[:most], u[:most]) for y, u in parts), counted and tuple(x[:most] for x in counted)


def _random_start(problem: LaggedProblem, rng: np.random.Generator) -> Array:
    """Return numbers with a random hidden layer whose units bend inside the data; polynomial and C are the problem's.

    Of several draws the one is taken whose units explain most of the errors, passed through 1/C as they will be; their
    output weights are those of least squares, and so are coefficients of the polynomial that are searched too.
    """
    of, place = function_of(problem), np.arange(problem.base.size)
    h, last = of.neurons, of.n_linear + of.p * of.neurons
    width = (of.n_theta - last - h) // max(h, 1)
    columns = problem.live & ((place < of.n_terms) | ((place >= of.n_linear) & (place < last)))
    parts, counted = _first(problem.parts, problem.counted, of.lag + _DRAWN_ON // len(problem.parts))
    few = replace(problem, parts=parts, counted=counted, live=columns, _rows=[])
    best, least = np.empty(0), np.inf
    for _ in range(_DRAWS):
        hidden = _hidden_layer(h, width, rng)
        theta = np.concatenate([problem.base[: of.n_linear], np.zeros(last - of.n_linear), hidden])
        R = replace(few, base=theta).triangle(theta[columns])
        step = np.linalg.lstsq(R[:, :-1], R[:, -1], rcond=1e-12)[0]
        left = float(np.sum((R[:, -1] - R[:, :-1] @ step) ** 2))
        theta[columns] += step
        if not best.size or left < least:
            best, least = theta, left
    return best


def _hidden_layer(h: int, d: int, rng: np.random.Generator) -> Array:
    """Weights and offsets of units that look at some regressors each and bend gently or hard."""
    W1 = rng.standard_normal((h, d)) * (rng.random((h, d)) < rng.uniform(0.2, 1.0, (h, 1)))
    empty = np.flatnonzero(~np.any(W1, axis=1))
    W1[empty, rng.integers(0, d, empty.size)] = 1.0
    W1 *= rng.uniform(0.7, 3.0, (h, 1)) / np.linalg.norm(W1, axis=1, keepdims=True)
    return np.concatenate([W1.ravel(), rng.standard_normal(h)])


def train_network(
    s: HybridSettings,
    function: HybridFunction,
    linear: Array,
    parts: Parts,
    seed: int,
    tick: Tick | None,
    counted: Counted | None = None,
) -> tuple[Array, Found, LaggedProblem]:
    """Train a network on what polynomial and C (`linear`) leave, then all numbers for a while, from random starts.

    Only the beginning of a long record is looked at. Every other start takes C as 1 and the polynomial as free: what
    this could not do alone has coloured the errors, and gone into the first C. Returns the numbers of the best start,
    and its search with the network alone.
    """
    parts, counted = _first(parts, counted, max(_STARTED_ON // len(parts), 10 * function.lag + 60))
    place = np.arange(function.n_theta)
    level = np.concatenate([linear, np.zeros(function.n_theta - linear.size)])
    coloured = hybrid_problem(function, parts, level, s.prior, live=place >= function.n_linear, counted=counted)
    in_c = (place >= function.n_terms) & (place < function.n_linear)
    white = coloured.at(np.where(in_c, 0.0, level), ~in_c)
    every = replace(coloured, live=np.ones(function.n_theta, dtype=np.bool_))  # one weight for all
    rng, best, least = np.random.default_rng(seed), None, np.inf
    for k in range(s.starts):
        alone = white if k % 2 else coloured
        start, share = _random_start(alone, rng), part_of(tick, k / s.starts, (k + 1) / s.starts)
        if share is not None:
            share("network on the residual", 0.0)
        first, second = part_of(share, 0.0, 0.5), part_of(share, 0.5, 1.0)
        found = search(alone, start[alone.live], stage="network on the residual", tick=first, **_ROUGH)
        both = search(every, alone.whole(found.theta), stage="starts of all together", tick=second, **_ROUGH)
        if best is None or both.cost < least:
            best, least = (both.theta, found, alone), both.cost
    assert best is not None
    return best


def choose_neurons(
    s: HybridSettings, function: HybridFunction, linear: Array, parts: Parts, seed: int, tick: Tick | None
) -> tuple[int, list[dict[str, float]]]:
    """Choose the number of hidden units by one-step errors on held-out stretches of each record.

    The smallest whose squared errors are not above those of the best by more than two standard errors of the
    difference, taken over batches of time; 0 where no network does better. A long record holds out its end, a short
    one each stretch in turn. The predictor runs through what is held out; only its errors do not count.
    """
    parts, _ = _first(parts, None, max(_MOST_ROWS // len(parts), 10 * function.lag + 60))
    n = sum(y.shape[0] - function.lag for y, _ in parts)
    folds = int(np.clip(_MOST_ROWS // max(n, 1), 1, round(1.0 / s.held_out)))
    if n * s.held_out * folds < 2 * _BATCHES:
        return 0, []
    squares: list[Array] = []
    ticks = iter(portions(tick, [1.0] * (len(_NEURONS) * folds)))
    for k, h in enumerate(_NEURONS):
        one, found = replace(function, neurons=h), []
        for j in range(folds):
            held = tuple(_stretch(y.shape[0], function.lag, s.held_out, j) for y, _ in parts)
            found.append(_held_out_squares(s, one, linear, parts, held, seed, next(ticks)))
        squares.append(np.concatenate(found))
        if k >= 3 and not any(_is_better(squares[j], squares[k - 2]) for j in (k, k - 1)):
            break
    errors = [float(np.sqrt(np.mean(x))) for x in squares]
    best = int(np.argmin(errors))
    fits = next(k for k, x in enumerate(squares) if k == best or not _is_better(squares[best], x))
    return _NEURONS[fits], [{"neurons": h, "held_out_rms": e} for h, e in zip(_NEURONS, errors, strict=False)]


def _stretch(n: int, lag: int, share: float, which: int) -> Mask:
    """Samples of a record that are held out: its end, or a stretch of that length before."""
    length = (n - lag) * share
    t = np.arange(n)
    return np.asarray((t >= max(n - (which + 1) * length, lag)) & (t < n - which * length))


def _held_out_squares(
    s: HybridSettings,
    function: HybridFunction,
    linear: Array,
    parts: Parts,
    held: Counted,
    seed: int,
    tick: Tick | None,
) -> Array:
    """Squared errors of held-out samples after training on the others; infinite where a model diverges."""
    training, theta = tuple(~x for x in held), linear
    if function.neurons:
        two = replace(s, starts=2)
        theta = train_network(two, function, linear, parts, seed, part_of(tick, 0.0, 0.8), training)[0]
    problem = hybrid_problem(function, parts, theta, s.prior, counted=training)
    theta = search(problem, theta, stage="choice of neurons", tick=part_of(tick, 0.8, 1.0), **_ROUGH).theta
    errors = np.concatenate(replace(problem, counted=held).errors(theta))
    out = np.sum(errors**2, axis=1)
    return np.where(np.isfinite(out), out, np.inf)


def _is_better(one: Array, other: Array) -> bool:
    """Whether squared errors are surely below others."""
    if not (np.all(np.isfinite(one)) and np.all(np.isfinite(other))):
        return bool(np.all(np.isfinite(one)))
    batches = min(_BATCHES, one.size)
    gains = np.array([np.mean(x) for x in np.array_split(other - one, batches)])
    return bool(np.mean(gains) > _SURE * np.std(gains, ddof=1) / np.sqrt(batches))


# --- noise model and terms -------------------------------------------------------------------------------------------


def choose_noise(
    problem: LaggedProblem, theta: Array, prior: float, criterion: str, tick: Tick | None
) -> tuple[HybridFunction, Array]:
    """Choose the order of C by an information criterion of the one-step errors, all numbers searched anew for each.

    `theta` is the optimum for the order there is; returned is that for the chosen one.
    """
    function = function_of(problem)
    first = max(function.lag, MOST_NOISE)  # for all orders the same errors
    counted = tuple(np.arange(y.shape[0]) >= first for y, _ in problem.parts)

    def value_of(of: HybridFunction, start: Array, share: Tick | None) -> tuple[float, Array]:
        at = replace(hybrid_problem(of, problem.parts, start, prior, counted=counted), weight=problem.weight)
        found = search(at, start, stage="order of the noise model", tick=share, **_ROUGH)
        n = max(at.n_errors // of.p, 2)
        k = of.n_linear + of.neurons * of.p * of.ne * of.deep
        # orders are nested, not chosen out of many; all outputs' errors count, as all their numbers do
        price = penalty("bic" if criterion == "ebic" else criterion, k, n, max(k, 1))
        return at.n_errors * log(max(found.cost / at.n_errors, 1e-26)) + price, found.theta

    value, theta = value_of(function, theta, part_of(tick, 0.0, 0.2))
    tries = iter(portions(part_of(tick, 0.2, 1.0), [1.0] * (2 * MOST_NOISE)))
    for step in (1, -1):
        better = False
        while 0 <= function.ne + step <= MOST_NOISE:
            other = replace(function, ne=function.ne + step)
            if not other.n_theta:  # a polynomial without terms: only the noise model is left
                break
            trial_value, trial = value_of(other, transfer(function, theta, other), next(tries))
            if not trial_value < value:
                break
            function, theta, value, better = other, trial, trial_value, True
        if better:
            break
    return function, theta


def revise(
    s: HybridSettings,
    problem: LaggedProblem,
    theta: Array,
    keep: Callable[[HybridFunction, Array], None],
    tick: Tick | None,
) -> None:
    """Revise the terms of the polynomial until the criterion gains by none; `keep` is given each better model.

    `theta` is the optimum, where the problem's errors have unit variance.
    """
    of = function_of(problem)
    factors = lagged(of.p, of.m, ny=s.ny, nu=s.nu, nk=s.nk)
    candidates = products(factors, s.degree, constant=bool(s.constant))
    n = max(problem.n_errors // of.p, 2)

    def price(count: int) -> float:
        """What the last of `count` numbers of polynomial and C costs, in squared errors of unit variance."""
        m = max(of.p * len(candidates), count)
        return penalty(s.criterion, count, n, m) - penalty(s.criterion, count - 1, n, m)

    for k in range(_MOST_STEPS):
        if tick is not None:
            tick("terms beside the network", guessed(k, 4.0))
        cost, count, better = problem.cost(theta), function_of(problem).n_linear, None
        for gain, step in ((-price(count), _without_one), (price(count + 1), _with_one)):
            terms = step(problem, theta, candidates, abs(gain), s.prior)
            if terms is None:
                continue
            at = _with_terms(problem, theta, terms, s.prior)
            found = search(at, at.base, stage="", damping=1e-4, **_ROUGH)
            if cost - found.cost > gain:
                better = at, found.theta
                break
        if better is None:
            return
        problem, theta = better
        keep(function_of(problem), theta)


AllTerms = tuple[tuple[Term, ...], ...]


def _with_terms(problem: LaggedProblem, theta: Array, terms: AllTerms, prior: float) -> LaggedProblem:
    """The same errors, equally weighted, of a function with other terms."""
    old = function_of(problem)
    new = replace(old, terms=terms)
    found = hybrid_problem(new, problem.parts, transfer(old, theta, new), prior, counted=problem.counted)
    return replace(found, weight=problem.weight)


def inflation(R: Array, P: Array, n_linear: int) -> Array:
    """Return by what the network multiplies the standard deviations of polynomial and C, the first `n_linear` numbers.

    `R` is the triangle of the slopes, `P` the inverse of R'R. Ones where they are not determined at all.
    """
    alone, _ = information_inverse(R[:, :n_linear])
    if alone is None:
        return np.ones(n_linear)
    out: Array = np.sqrt(np.diag(P)[:n_linear] / np.diag(alone))
    return out


def _without_one(
    problem: LaggedProblem, theta: Array, candidates: tuple[Term, ...], price: float, prior: float
) -> AllTerms | None:
    """Terms without the one that is missed least, if it does not pay and the network could not take it over."""
    del candidates, prior
    function, R = function_of(problem), problem.triangle(theta)[:, :-1]
    P, _ = information_inverse(R)
    if P is None or not function.n_terms:
        return None
    shared = inflation(R, P, function.n_linear)[: function.n_terms] > SHARED
    alone = np.array([len(function.terms[o]) == 1 for o, _, _ in function.owned])
    loss = np.where(shared | alone, np.inf, (theta**2 / np.diag(P))[: function.n_terms])
    worst = int(np.argmin(loss))
    if not loss[worst] < price:
        return None
    o, _, term = function.owned[worst]
    return tuple(tuple(x for x in t if (q, x) != (o, term)) for q, t in enumerate(function.terms))


def _with_one(
    problem: LaggedProblem, theta: Array, candidates: tuple[Term, ...], price: float, prior: float
) -> AllTerms | None:
    """Terms with the one whose slope, orthogonal to all there are, explains most of the errors, if it pays."""
    function = function_of(problem)
    more = [(o, x) for o, t in enumerate(function.terms) for x in candidates if x not in t]
    if not more or len(more) > _MOST_CANDIDATES:
        return None
    richer = tuple((*t, *(x for q, x in more if q == o)) for o, t in enumerate(function.terms))
    wide = _with_terms(problem, theta, richer, prior)
    known = set(function.names)
    gain = column_gains(wide.triangle(wide.base), np.array([name in known for name in wide.function.names]))
    best = int(np.argmax(gain))
    if not gain[best] > price:
        return None
    return tuple((*t, more[best][1]) if more[best][0] == o else t for o, t in enumerate(function.terms))
