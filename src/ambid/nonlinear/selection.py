"""Forward regression with orthogonal least squares (FROLS): which terms explain the output, in the order they do.

Step by step that candidate is taken which, orthogonalised against those chosen before, has the largest error reduction
ratio (Chen, Billings, Luo 1989; Billings 2013, sec. 3.2). One pass over the data makes the Gram matrix of candidates of
unit length; steps then cost nothing beside. Where digits run short the candidates are made orthogonal to the chosen
ones explicitly, by QR, and the Gram matrix again. Candidates are made block by block from lagged signals: a long record
needs no matrix of all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.estimation.uncertainty import EXACT, information, penalty
from ambid.nonlinear.polynomial import Factor, Term

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
    # (n_rows of the record,), or None, what every value of a row is multiplied with
    weight: tuple[Array, ...] | None = None

    @property
    def n_rows(self) -> int:
        """Rows over all records."""
        return sum(self.rows)

    def blocks(self, which: Sequence[int] | None = None) -> Iterator[tuple[slice, Array]]:
        """Yield rows in order, a block at a time, and values of some candidates, or of all, there.

        Values are of shape (n_which, n_rows of the block), contiguous.
        """
        terms = self.terms if which is None else [self.terms[k] for k in which]
        size, start = max(_BLOCK, 1), 0
        for r, (n, signals) in enumerate(zip(self.rows, self.parts, strict=True)):
            for first in range(0, n, size):
                last = min(first + size, n)
                out = np.empty((len(terms), last - first))
                for k, term in enumerate(terms):
                    _product(term, signals, first, last, out[k])
                if self.weight is not None:
                    out *= self.weight[r][first:last]
                yield slice(start + first, start + last), out
            start += n

    def columns(self, which: Sequence[int]) -> Array:
        """Return some candidates whole, shape (n_rows, n_which)."""
        out = np.empty((len(which), self.n_rows))
        for rows, values in self.blocks(which):
            out[:, rows] = values
        return out.T


def _product(term: Term, signals: dict[Factor, Array], first: int, last: int, out: Array) -> None:
    if not term:
        out[:] = 1.0
        return
    out[:] = signals[term[0]][first:last]
    for f in term[1:]:
        out *= signals[f][first:last]


def candidates(
    terms: Sequence[Term],
    records: Sequence[tuple[Array, Array]],
    lag: int,
    innovations: Sequence[Array] | None = None,
    weight: tuple[Array, ...] | None = None,
) -> Candidates:
    """Return the candidates over several records, rows from sample `lag` of each on; `weight` multiplies each row."""
    factors = sorted({f for t in terms for f in t})
    parts = []
    for r, (y, u) in enumerate(records):
        of, n = {"y": y, "u": u}, y.shape[0]
        if innovations is not None:
            of["e"] = innovations[r]
        parts.append({f: np.ascontiguousarray(of[f.kind][lag - f.lag : max(n - f.lag, 0), f.channel]) for f in factors})
    rows = tuple(max(y.shape[0] - lag, 0) for y, _ in records)
    return Candidates(terms=tuple(terms), parts=tuple(parts), rows=rows, weight=weight)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatrixCandidates:
    """Candidates that exist as a matrix already."""

    matrix: Array  # (n_rows, n_candidates)

    @property
    def n_rows(self) -> int:
        """Rows."""
        return int(self.matrix.shape[0])

    @property
    def terms(self) -> range:
        """Numbers of the candidates."""
        return range(self.matrix.shape[1])

    def blocks(self, which: Sequence[int] | None = None) -> Iterator[tuple[slice, Array]]:
        """As `Candidates.blocks`."""
        chosen = self.matrix if which is None else self.matrix[:, list(which)]
        for first in range(0, self.n_rows, _BLOCK):
            last = min(first + _BLOCK, self.n_rows)
            yield slice(first, last), np.array(chosen[first:last].T, order="C")

    def columns(self, which: Sequence[int]) -> Array:
        """Return some candidates whole, shape (n_rows, n_which)."""
        return self.matrix[:, list(which)]


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
    found: Candidates | MatrixCandidates,
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
    found : Candidates or MatrixCandidates
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
    state = _Gram(found, np.ascontiguousarray(y, dtype=np.float64), tick)
    n, m = state.y.size, len(found.terms)
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

    def __init__(self, found: Candidates | MatrixCandidates, y: Array, tick: Callable[[float], object] | None) -> None:
        self.found, self.y, self.tick = found, y, tick
        self.order: list[int] = []
        self.path: list[float] = []
        self.passes = 0
        self.energy = float(y @ y)
        self.lengths: Array | None = None
        self.base = 1.0
        self.gram, self.product, self.squared = np.empty((0, 0)), np.empty(0), np.empty(0)
        self.alive = np.ones(len(found.terms), dtype=bool)
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
