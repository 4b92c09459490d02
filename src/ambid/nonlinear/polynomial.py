"""Terms, products of lagged outputs, inputs and innovations, and the polynomial or rational function that they make.

A factor is one lagged signal, a term the product of its factors (repeated ones are powers; none makes the constant).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any, ClassVar, Self

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.nonlinear.blocks import Block, Mask, Terms
from ambid.nonlinear.lagged import LaggedFunction, Regressors, channel_names

MOST_CANDIDATES = 20_000
OUTPUTS = ("signed", "magnitude")


@dataclass(frozen=True, slots=True, order=True)
class Factor:
    """One lagged signal."""

    kind: str  # output, input, innovation: y, u, e
    channel: int  # column
    lag: int  # samples back; at least 1 for outputs and innovations


Term = tuple[Factor, ...]
"""Product of its factors, sorted; the empty product is the constant."""


def lagged(n_outputs: int, n_inputs: int, *, ny: int, nu: int, nk: int, ne: int = 0) -> tuple[Factor, ...]:
    """Return all lagged signals that terms are made of, up to the largest lags of each kind."""
    out = [Factor("y", c, lag) for c in range(n_outputs) for lag in range(1, ny + 1)]
    out += [Factor("u", c, lag) for c in range(n_inputs) for lag in range(nk, nk + nu)]
    out += [Factor("e", c, lag) for c in range(n_outputs) for lag in range(1, ne + 1)]
    return tuple(out)


def products(factors: tuple[Factor, ...], degree: int, *, constant: bool = True, odd: bool = False) -> tuple[Term, ...]:
    """Return all products of the factors up to a degree, by degree: the candidates of a polynomial (thesis eq. 3.4)."""
    out: list[Term] = [()] if constant and not odd else []
    for d in range(1, degree + 1, 2 if odd else 1):
        for term in combinations_with_replacement(factors, d):
            out.append(tuple(sorted(term)))
            if len(out) > MOST_CANDIDATES:
                raise EstimationError(
                    f"{len(factors)} lagged signals to degree {degree} make more than {MOST_CANDIDATES} candidate "
                    "terms. Lower ny, nu or degree"
                )
    return tuple(out)


def is_noisy(term: Term) -> bool:
    """Whether a term holds an innovation."""
    return any(f.kind == "e" for f in term)


def term_name(term: Term, n_outputs: int, n_inputs: int) -> str:
    """Return how a term is written, such as ``y(t-1)^2*u(t-3)``; several channels carry numbers, from 1."""
    if not term:
        return "1"
    parts = []
    for f in dict.fromkeys(term):
        several = (n_inputs if f.kind == "u" else n_outputs) > 1
        at = f"t-{f.lag}" if f.lag else "t"
        power = f"^{term.count(f)}" if term.count(f) > 1 else ""
        parts.append(f"{f.kind}{f.channel + 1 if several else ''}({at}){power}")
    return "*".join(parts)


def terms_to_json(terms: Sequence[Sequence[Term]]) -> list[list[list[list[Any]]]]:
    """Return the terms of each output as JSON-able values."""
    return [[[[f.kind, f.channel, f.lag] for f in term] for term in own] for own in terms]


def terms_from_json(found: Any, n_outputs: int, n_inputs: int) -> tuple[tuple[Term, ...], ...]:
    """Read the terms of each output back."""
    channels = {"y": n_outputs, "u": n_inputs, "e": n_outputs}

    def factor(f: Any) -> Factor:
        kind, channel, lag = f
        whole = all(isinstance(x, int) and not isinstance(x, bool) and x >= 0 for x in (channel, lag))
        if kind not in channels or not whole or (kind != "u" and lag < 1):
            raise EstimationError(f"{f!r} is not a factor of a term; a factor is [y, u or e, channel, lag]")
        if channel >= channels[kind]:
            raise ValueError("terms name channels that the model does not have")
        return Factor(kind, channel, lag)

    out = tuple(tuple(tuple(sorted(factor(f) for f in term)) for term in own) for own in found)
    if len(out) != n_outputs:
        raise ValueError("terms are not those of each output")
    return out


def column_of(f: Factor, n_outputs: int, n_inputs: int) -> int:
    """Return the column of a factor's signal in [outputs, inputs, innovations]."""
    return f.channel + {"y": 0, "u": n_outputs, "e": n_outputs + n_inputs}[f.kind]


def block_of(x: Regressors, owned: Sequence[tuple[int, int, Term]]) -> Terms:
    """Return terms of regressors as a block; `owned` are output, 1 for a denominator, term."""
    where = {at: k for k, at in enumerate(zip(x.column.tolist(), x.back.tolist(), strict=True))}
    rows = [[where[column_of(f, x.n_outputs, x.n_inputs), f.lag] for f in term] for _, _, term in owned]
    width = max(map(len, rows), default=0)
    table = np.array([v + [-1] * (width - len(v)) for v in rows], dtype=np.int64).reshape(len(rows), width)
    place = np.array([(o, below) for o, below, _ in owned], dtype=np.int64).reshape(-1, 2)
    return Terms(n_outputs=x.n_outputs, terms=table, place=place)


def unit_of(owned: Sequence[tuple[int, int, Term]], y_scale: Array, u_scale: Array) -> Array:
    """Return what a scaled coefficient of 1 is in SI, shape (n_terms,)."""
    size = {"y": y_scale, "u": u_scale, "e": y_scale}
    return np.array(
        [(1.0 if below else y_scale[o]) / np.prod([size[f.kind][f.channel] for f in x]) for o, below, x in owned],
        dtype=np.float64,
    )


@dataclass(frozen=True, kw_only=True)
class PolynomialFunction(LaggedFunction):
    """yhat(t) = b / (1 + a), b and a sums of coefficient times term (thesis eqs 3.1-3.4).

    Coefficients stand output by output, numerator before denominator; denominators are empty for a polynomial.
    """

    kind: ClassVar[str] = "narmax"
    ellipsoid: ClassVar[bool] = True
    numerators: tuple[tuple[Term, ...], ...]  # by output
    denominators: tuple[tuple[Term, ...], ...]
    m: int  # inputs
    folded: bool = False

    @cached_property
    def owned(self) -> tuple[tuple[int, int, Term], ...]:
        """Output, 1 for the denominator, and term of each coefficient."""
        both = enumerate(zip(self.numerators, self.denominators, strict=True))
        return tuple((o, below, x) for o, pair in both for below, terms in enumerate(pair) for x in terms)

    def with_terms(self, owned: Sequence[tuple[int, int, Term]]) -> Self:
        """Return the same function of other terms, in the order of `owned`."""
        num, den = (
            tuple(tuple(x for q, b, x in owned if (q, b) == (o, below)) for o in range(len(self.numerators)))
            for below in (0, 1)
        )
        return replace(self, numerators=num, denominators=den)

    @cached_property
    def is_rational(self) -> bool:
        """Whether there is a denominator."""
        return any(self.denominators)

    @cached_property
    def noisy(self) -> Mask:
        """Which terms hold an innovation."""
        return np.array([is_noisy(x) for _, _, x in self.owned], dtype=np.bool_)

    @cached_property
    def regressors(self) -> Regressors:
        """What its terms look at."""
        p = len(self.numerators)
        factors = dict.fromkeys(f for _, _, x in self.owned for f in x)
        column = np.array([column_of(f, p, self.m) for f in factors], dtype=np.int64)
        back = np.array([f.lag for f in factors], dtype=np.int64)
        return Regressors(n_outputs=p, n_inputs=self.m, column=column, back=back)

    @cached_property
    def terms_block(self) -> Terms:
        """Its terms as a block."""
        return block_of(self.regressors, self.owned)

    @property
    def blocks(self) -> tuple[Block, ...]:
        """What it is the sum of."""
        return (self.terms_block,)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the coefficients: their terms; denominators in the form ``1/(...)``."""
        p, channel = len(self.numerators), channel_names("y", len(self.numerators))
        named = [(o, below, term_name(x, p, self.m)) for o, below, x in self.owned]
        return tuple((f"{channel[o]}: " if p > 1 else "") + (f"1/({x})" if below else x) for o, below, x in named)

    @cached_property
    def _linear(self) -> Array:
        """Which terms are single signals, a row for each column of the signals."""
        out = np.zeros((2 * len(self.numerators) + self.m, len(self.owned)))
        for k, (_, below, x) in enumerate(self.owned):
            if len(x) == 1 and not below:
                out[column_of(x[0], len(self.numerators), self.m), k] = 1.0
        return out

    def first_sign(self, theta: Array, z: Array) -> float:
        """As `LaggedFunction.first_sign`: where the linear part is driven to at first."""
        gains = self._linear @ theta
        driven = gains[1 : 1 + self.m] @ np.mean(z[: self.lag, 1 : 1 + self.m], axis=0)
        return -1.0 if driven * (1.0 - gains[0]) < 0 else 1.0

    def unit(self, y_scale: Array, u_scale: Array) -> Array:
        """As `LaggedFunction.unit`: coefficients are in SI."""
        return unit_of(self.owned, y_scale, u_scale)

    def as_json(self) -> dict[str, Any]:
        """As `LaggedFunction.as_json`."""
        return {
            "n_inputs": self.m,
            "output": OUTPUTS[self.folded],
            "numerators": terms_to_json(self.numerators),
            "denominators": terms_to_json(self.denominators),
        }

    @classmethod
    def from_json(cls, found: Mapping[str, Any]) -> Self:
        """Read it back."""
        p, m = len(found["numerators"]), int(found["n_inputs"])
        num, den = (terms_from_json(found[k], p, m) for k in ("numerators", "denominators"))
        if found["output"] not in OUTPUTS:
            raise ValueError(f"output is none of {', '.join(OUTPUTS)}")
        return cls(numerators=num, denominators=den, m=m, folded=found["output"] == "magnitude")
