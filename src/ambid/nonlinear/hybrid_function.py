"""The function of a hybrid model, its problem, and random starts of its network (thesis eqs 3.23, 3.24).

yhat(t) = P(y, u) theta + W2 tanh(W1 z + b1) + (C(q^-1) - 1) e(t), z = [y(t-1).., u(t-nk)..], with C the polynomial
1 + C1 q^-1 + .. of `ne` matrices; in the thesis z holds past innovations too, which is an option here.

The hidden layer's weights are N(0, prior^2) before the data (scaled signals), coefficients of the polynomial and of C
have no prior: what the polynomial can do costs nothing, so that it is not left to the network. C keeps its roots inside
the unit circle because a vector with a root outside has an infinite cost: such a step is refused, and a shorter one
tried. With innovations inside the network the roots of C alone say nothing; there only a divergence is refused.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.nonlinear.blocks import Block, Linear, Mask, Table, Tanh
from ambid.nonlinear.lagged import LaggedFunction, Regressors, channel_names, lags
from ambid.nonlinear.lagged_problem import LaggedProblem, problem_at
from ambid.nonlinear.polynomial import (
    Factor,
    Term,
    block_of,
    column_of,
    term_name,
    terms_from_json,
    terms_to_json,
    unit_of,
)
from ambid.nonlinear.records import Parts

_DRAWS = 40  # of a random hidden layer
_DRAWN_ON = 1000  # rows by which they are compared


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
            Linear(n_outputs=self.p, at=slice(d, last), constant=False),
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
    counted: tuple[Mask, ...] | None = None,
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


def random_start(problem: LaggedProblem, rng: np.random.Generator) -> Array:
    """Return numbers with a random hidden layer whose units bend inside the data; polynomial and C are the problem's.

    Of several draws the one is taken whose units explain most of the errors, passed through 1/C as they will be; their
    output weights are those of least squares, and so are coefficients of the polynomial that are searched too.
    """
    of = function_of(problem)
    n_2, n_1, n_b = of.p * of.neurons, of.n_theta - of.n_linear - (of.p + 1) * of.neurons, of.neurons
    place = np.arange(of.n_theta)
    columns = problem.live & ((place < of.n_terms) | ((place >= of.n_linear) & (place < of.n_linear + n_2)))
    prior = np.diag(problem.precision[columns])
    best, least = np.empty(0), np.inf
    for _ in range(_DRAWS):
        hidden = _hidden_layer(n_b, n_1 // n_b, rng)
        theta = np.concatenate([problem.base[: of.n_linear], np.zeros(n_2), hidden])
        A, r = _linear_rows(problem, theta, columns)
        A, r = np.vstack([A, prior]), np.append(r, np.zeros(prior.shape[0]))
        step = np.linalg.lstsq(A, r, rcond=1e-12)[0]
        left = float(np.sum((r - A @ step) ** 2))
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


def _linear_rows(problem: LaggedProblem, theta: Array, columns: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Slopes by some numbers and errors, weighted, over the first rows of each record."""
    few = replace(problem, live=columns, base=theta)
    some = _DRAWN_ON // len(problem.parts)
    found: list[Array] = []
    for k, (rows, lag) in enumerate((r, few.function.lag) for r in problem.rows()):
        part = rows.part(slice(0, some))
        part = replace(part, z=rows.z[: lag + some])
        predicted, part = few.function.predict(theta, part)
        J = few.function.slopes(theta, part, free=False, live=columns)
        counts = problem.counts(k)
        both = np.concatenate([J, (part.y - predicted)[:, :, None]], axis=2)
        both = both if isinstance(counts, slice) else both[counts[:some]]
        found.append(np.matmul(problem.weight, both).reshape(-1, J.shape[2] + 1))
    whole = np.concatenate(found)
    return whole[:, :-1], whole[:, -1]
