"""Candidate regressors, made block by block from lagged signals: a long record needs no matrix of all candidates."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.nonlinear.narmax.terms import Factor, Term

_BLOCK = 4096  # rows at a time: a block of some hundred candidates stays in the cache of the second level


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
        """Yield rows in order, a block at a time.

        `which`: candidates; all of them without. Returns `values`: (n_which, n_rows of the block), one candidate a row,
        contiguous.
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
        """Return some candidates whole.

        Returns (n_rows, n_which).
        """
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
    y: Sequence[Array],
    u: Sequence[Array],
    e: Sequence[Array] | None,
    lag: int,
    weight: tuple[Array, ...] | None = None,
) -> Candidates:
    """Return the candidates over several records.

    `y`, `u`: (n_samples, n_channels), by record; `e`: (n_samples, n_outputs), or None, innovations; may be left out
    where no term holds one; `lag`: first sample of every record that becomes a row; `weight`: (n_rows of the record,),
    what the values of each row are multiplied with.
    """
    factors = sorted({f for t in terms for f in t})
    parts = []
    for r in range(len(y)):
        of = {"y": y[r], "u": u[r]} if e is None else {"y": y[r], "u": u[r], "e": e[r]}
        n = y[r].shape[0]
        parts.append({f: np.ascontiguousarray(of[f.kind][lag - f.lag : max(n - f.lag, 0), f.channel]) for f in factors})
    return Candidates(
        terms=tuple(terms), parts=tuple(parts), rows=tuple(max(x.shape[0] - lag, 0) for x in y), weight=weight
    )


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
        """Yield rows in order, as `Candidates.blocks` does.

        Returns `values`: (n_which, n_rows of the block).
        """
        chosen = self.matrix if which is None else self.matrix[:, list(which)]
        for first in range(0, self.n_rows, _BLOCK):
            last = min(first + _BLOCK, self.n_rows)
            yield slice(first, last), np.array(chosen[first:last].T, order="C")

    def columns(self, which: Sequence[int]) -> Array:
        """Return some candidates whole.

        Returns (n_rows, n_which).
        """
        return self.matrix[:, list(which)]
