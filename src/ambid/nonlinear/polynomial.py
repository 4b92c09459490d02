"""Terms, products of lagged outputs, inputs and innovations; their function; their choice by orthogonal least squares.

A term is a product of lagged signals (repeated: powers; none: the constant). FROLS takes the candidate that,
orthogonalised, has the largest error reduction ratio (Chen, Billings, Luo 1989; Billings 2013, sec. 3.2), on the Gram
matrix of unit-length candidates from one pass, made again by QR where digits run short; candidates come block by block.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any, ClassVar, Self

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.uncertainty import EXACT, information, penalty
from ambid.nonlinear.lagged import Block, LaggedFunction, Mask, Regressors, Terms, channel_names

MOST_CANDIDATES = 20_000


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


def products(factors: tuple[Factor, ...], degree: int, *, constant: bool = True) -> tuple[Term, ...]:
    """Return all products of the factors up to a degree, by degree: the candidates of a polynomial (thesis eq. 3.4)."""
    out: list[Term] = [()] if constant else []
    for d in range(1, degree + 1):
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


def terms_from_json(document: Any, n_outputs: int, n_inputs: int) -> tuple[tuple[Term, ...], ...]:
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

    out = tuple(tuple(tuple(sorted(factor(f) for f in term)) for term in own) for own in document)
    if len(out) != n_outputs:
        raise ValueError("terms are not those of each output")
    return out


def column_of(f: Factor, n_outputs: int, n_inputs: int) -> int:
    """Return the column of a factor's signal in [outputs, inputs, innovations]."""
    return f.channel + {"y": 0, "u": n_outputs, "e": n_outputs + n_inputs}[f.kind]


def block_of(x: Regressors, owned: Sequence[tuple[int, Term]]) -> Terms:
    """Return terms of regressors as a block; `owned` are output and term."""
    where = {at: k for k, at in enumerate(zip(x.column.tolist(), x.back.tolist(), strict=True))}
    rows = [[where[column_of(f, x.n_outputs, x.n_inputs), f.lag] for f in term] for _, term in owned]
    width = max(map(len, rows), default=0)
    table = np.array([v + [-1] * (width - len(v)) for v in rows], dtype=np.int64).reshape(len(rows), width)
    place = np.array([o for o, _ in owned], dtype=np.int64)
    return Terms(n_outputs=x.n_outputs, terms=table, place=place)


def unit_of(owned: Sequence[tuple[int, Term]], y_scale: Array, u_scale: Array) -> Array:
    """Return what a scaled coefficient of 1 is in SI, shape (n_terms,)."""
    size = {"y": y_scale, "u": u_scale, "e": y_scale}
    return np.array(
        [y_scale[o] / np.prod([size[f.kind][f.channel] for f in x]) for o, x in owned],
        dtype=np.float64,
    )


@dataclass(frozen=True, kw_only=True)
class PolynomialFunction(LaggedFunction):
    """yhat(t), a sum of coefficient times term for each output (thesis eqs 3.1-3.4)."""

    kind: ClassVar[str] = "narmax"
    ellipsoid: ClassVar[bool] = True
    terms: tuple[tuple[Term, ...], ...]  # by output
    m: int  # inputs

    @cached_property
    def owned(self) -> tuple[tuple[int, Term], ...]:
        """Output and term of each coefficient."""
        return tuple((o, x) for o, terms in enumerate(self.terms) for x in terms)

    def with_terms(self, owned: Sequence[tuple[int, Term]]) -> Self:
        """Return the same function of other terms, in the order of `owned`."""
        return replace(self, terms=tuple(tuple(x for q, x in owned if q == o) for o in range(len(self.terms))))

    @cached_property
    def noisy(self) -> Mask:
        """Which terms hold an innovation."""
        return np.array([is_noisy(x) for _, x in self.owned], dtype=np.bool_)

    @cached_property
    def regressors(self) -> Regressors:
        """What its terms look at."""
        p = len(self.terms)
        factors = dict.fromkeys(f for _, x in self.owned for f in x)
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
        """Of the coefficients: their terms."""
        p, channel = len(self.terms), channel_names("y", len(self.terms))
        return tuple((f"{channel[o]}: " if p > 1 else "") + term_name(x, p, self.m) for o, x in self.owned)

    def unit(self, y_scale: Array, u_scale: Array) -> Array:
        """As `LaggedFunction.unit`: coefficients are in SI."""
        return unit_of(self.owned, y_scale, u_scale)

    def as_json(self) -> dict[str, Any]:
        """As `LaggedFunction.as_json`."""
        return {"n_inputs": self.m, "numerators": terms_to_json(self.terms)}

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Self:
        """Read it back."""
        p, m = len(document["numerators"]), int(document["n_inputs"])
        if any(document.get("denominators", ())) or document.get("output", "signed") != "signed":
            raise ValueError("it is rational, or of a sensor without sign")
        return cls(terms=terms_from_json(document["numerators"], p, m), m=m)


_BLOCK = 4096  # rows at a time: a block of some hundred candidates stays in the cache of the second level
_SHORT = 1e-6  # squared length left of a candidate below which its Gram matrix has too few digits to choose it
_SPENT = 1e-10  # the same for the output
_DEPENDENT = 1e-20  # squared length left, by QR, of a candidate that the chosen ones hold already
_ROUNDING = 1e-14  # of an entry of the Gram matrix
_MOST_PASSES = 8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidates:
    """Values of terms over several records, row by row from sample `lag` of each record on."""

    terms: tuple[Term, ...]
    parts: tuple[dict[Factor, Array], ...]  # (n_rows of the record,), lagged signals of each record
    rows: tuple[int, ...]  # of each record

    @property
    def n_rows(self) -> int:
        """Rows over all records."""
        return sum(self.rows)

    def blocks(self, which: Sequence[int] | None = None) -> Iterator[tuple[slice, Array]]:
        """Yield rows block by block, and the values there, contiguous (n_which, n_rows), of some candidates, or all."""
        terms = self.terms if which is None else [self.terms[k] for k in which]
        size, start = max(_BLOCK, 1), 0
        for n, signals in zip(self.rows, self.parts, strict=True):
            for first in range(0, n, size):
                last = min(first + size, n)
                out = np.ones((len(terms), last - first))
                for product, term in zip(out, terms, strict=True):
                    for f in term:
                        product *= signals[f][first:last]
                yield slice(start + first, start + last), out
            start += n

    def columns(self, which: Sequence[int]) -> Array:
        """Return some candidates whole, shape (n_rows, n_which)."""
        out = np.empty((len(which), self.n_rows))
        for rows, values in self.blocks(which):
            out[:, rows] = values
        return out.T


def candidates(
    terms: Sequence[Term],
    records: Sequence[tuple[Array, Array]],
    lag: int,
    innovations: Sequence[Array] | None = None,
) -> Candidates:
    """Return the candidates over several records, rows from sample `lag` of each on."""
    factors = sorted({f for t in terms for f in t})
    parts = []
    for r, (y, u) in enumerate(records):
        kinds, n = {"y": y, "u": u}, y.shape[0]
        if innovations is not None:
            kinds["e"] = innovations[r]
        parts.append(
            {f: np.ascontiguousarray(kinds[f.kind][lag - f.lag : max(n - f.lag, 0), f.channel]) for f in factors}
        )
    rows = tuple(max(y.shape[0] - lag, 0) for y, _ in records)
    return Candidates(terms=tuple(terms), parts=tuple(parts), rows=rows)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Selection:
    """Terms in the order in which they were chosen."""

    # all that were looked at, places in the list of candidates; the first `n_best` of them are the choice
    order: tuple[int, ...]
    err: Array  # (n_order,), error reduction ratio: part of the output's energy that each adds to what is explained
    left: Array  # (n_order + 1,), part of the energy that is not explained by the first 0, 1, ... terms.
    criterion: Array  # (n_order + 1,), information criterion of the first 0, 1, ... terms.
    n_best: int  # where it is least
    passes: int  # how often the candidates were gone through

    @property
    def chosen(self) -> tuple[int, ...]:
        """The choice, in the order of the error reduction ratios."""
        return self.order[: self.n_best]


def select_terms(
    pool: Candidates,
    y: Array,
    *,
    most: int,
    criterion: str = "ebic",
    first: Sequence[int] = (),
    tick: Callable[[float], object] | None = None,
) -> Selection:
    """Choose terms by orthogonal least squares.

    Parameters
    ----------
    pool : Candidates
        The regressors.
    y : ndarray, shape (n_rows,)
        What they have to explain.
    most : int
        Look at so many terms at most.
    criterion : {"ebic", "bic", "mdl", "aic", "aicc", "fpe", "lilc"}, optional
        What ends the choice; ``ebic`` also pays for the number of candidates chosen from (Chen and Chen 2008).
    first : sequence of int, optional
        Candidates that are in the model in any case; they come first.
    tick : callable, optional
        Called now and then with a guess at the share that is over, 0 to 1.

    Returns
    -------
    Selection

    Raises
    ------
    EstimationError
        If the criterion is not known.
    """
    penalty(criterion, 1, 10, 1)
    state = _Gram(pool, np.ascontiguousarray(y, dtype=np.float64), tick)
    n, m = state.y.size, len(pool.terms)
    most = min(max(most, len(first)), m, n - 1)
    err: list[float] = []
    while len(state.order) < most and state.unexplained():
        pick = state.winner(first[len(state.order)] if len(state.order) < len(first) else None)
        if pick is None:
            break
        err.append(state.take(pick))
    left = np.array([1.0, *state.path])
    values = np.array([information(criterion, x, k, n, m) for k, x in enumerate(left)])
    low = min(len(first), len(err))
    return Selection(
        order=tuple(state.order),
        err=np.array(err),
        left=left,
        criterion=values,
        n_best=low + int(np.argmin(values[low:])),
        passes=state.passes,
    )


class _Gram:
    """Scalar products of what is left of candidates and output, orthogonal to those chosen so far."""

    def __init__(self, pool: Candidates, y: Array, tick: Callable[[float], object] | None) -> None:
        self.found, self.y, self.tick = pool, y, tick
        self.order: list[int] = []
        self.path: list[float] = []
        self.passes = 0
        self.energy = float(y @ y)
        self.lengths: Array | None = None
        self.base = 1.0
        self.gram, self.product, self.squared = np.empty((0, 0)), np.empty(0), np.empty(0)
        self.alive = np.ones(len(pool.terms), dtype=bool)
        self.left = 1.0 if self.energy > 0 else 0.0
        self.rows, self.since = np.empty((8, self.alive.size)), 0
        self._measure()

    def unexplained(self) -> bool:
        """Whether something is left to explain, looked at closely where digits have run short."""
        if self.since and self.left <= _SPENT * self.base and self.passes < _MOST_PASSES:
            self._measure()
        return self.left > EXACT

    def winner(self, wanted: int | None) -> int | None:
        """Return the candidate with the largest error reduction ratio; None where none explains anything."""
        for _ in range(2):
            if wanted is not None and not self.alive[wanted]:
                return None
            safe = self.squared > _SHORT
            if wanted is not None:
                pick = wanted
            else:
                hopeful = np.where(
                    self.alive, (np.abs(self.product) + _ROUNDING) ** 2 / np.maximum(self.squared, _ROUNDING), -1.0
                )
                exact = np.where(self.alive & safe, self.product**2 / np.where(safe, self.squared, 1.0), -1.0)
                pick = int(np.argmax(exact))
                rival = int(np.argmax(np.where(safe, -1.0, hopeful)))
                if not safe[rival] and hopeful[rival] > exact[pick]:
                    pick = rival
            if not self.alive[pick]:
                return None
            fresh = not self.since
            if fresh or (safe[pick] and self.left > _SPENT * self.base) or self.passes >= _MOST_PASSES:
                return pick if safe[pick] else None
            self._measure()
        return None

    def take(self, pick: int) -> float:
        """Add a candidate; returns its error reduction ratio."""
        length = np.sqrt(self.squared[pick])
        row = self.gram[pick].copy()
        if self.since:
            done = self.rows[: self.since]
            row -= done[:, pick] @ done
        row /= length
        gain = self.product[pick] / length
        self.squared = self.squared - row**2
        self.product = self.product - gain * row
        if self.since == self.rows.shape[0]:
            self.rows = np.concatenate([self.rows, np.empty_like(self.rows)])
        self.rows[self.since] = row
        self.since += 1
        self.alive[pick] = False
        self.order.append(pick)
        ratio = float(gain**2) * self.base
        self.left = max(self.left - ratio, 0.0)
        self.path.append(self.left)
        return ratio

    def _measure(self) -> None:
        """Make candidates and output orthogonal to the chosen ones, and multiply them with each other."""
        self._tell(0.0)
        m, k = self.alive.size, len(self.order)
        Q = np.linalg.qr(self.found.columns(self.order))[0] if k else np.empty((self.y.size, 0))
        rest = self.y - Q @ (Q.T @ self.y)
        rest -= Q @ (Q.T @ rest)
        C = np.zeros((k, m))
        for rows, values in self.found.blocks() if k else ():
            C += Q[rows].T @ values.T
        gram, product, again = np.zeros((m, m)), np.zeros(m), np.zeros((k, m))
        for rows, values in self.found.blocks():
            self._tell(rows.start / self.y.size)
            if k:
                values -= C.T @ Q[rows].T
                again += Q[rows].T @ values.T
            gram += values @ values.T
            product += values @ rest[rows]
        gram -= again.T @ again
        squared = np.maximum(np.diag(gram), 0.0)
        if self.lengths is None:
            self.lengths = squared.copy()
        self.alive &= squared > _DEPENDENT * np.maximum(self.lengths, 1e-300)
        self.alive[self.order] = False
        scale = np.where(self.alive, 1.0 / np.sqrt(np.where(self.alive, squared, 1.0)), 0.0)
        energy = float(rest @ rest)
        self.base = energy / self.energy if self.energy > 0 else 0.0
        self.left = self.base
        if self.path:
            self.path[-1] = self.base
        self.gram = gram * scale[:, None] * scale
        self.product = product * scale / np.sqrt(energy if energy > 0 else 1.0)
        self.squared = np.where(self.alive, 1.0, 0.0)
        self.rows, self.since = np.empty((8, m)), 0
        self.passes += 1

    def _tell(self, part: float) -> None:
        """Report the share that is over: the first pass is half of all or more, each further one half of the rest."""
        if self.tick is not None:
            self.tick(1.0 - 0.5**self.passes * (1.0 - 0.5 * part))
