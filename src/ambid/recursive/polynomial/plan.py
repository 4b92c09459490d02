"""What is filtered by what, sample by sample, for one structure (theory.md 2.5).

Signals: w = (B/F) u, v = A y - sum of w - constant, e = (D/C) v. Gradients of the prediction, all lags of one
polynomial being one signal, shifted: by a_k -(D/C) y(t-k), by b_k D/(C F) u(t-k), by c_k e(t-k)/C, by d_k -v(t-k)/C, by
f_k -D/(C F) w(t-k), by the constant D/C. The filters run with the coefficients of the moment, so they are written as a
table in which only coefficients change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ambid.blackbox.polynomial.orders import Layout

Table = NDArray[np.int64]
Term = tuple[int, int, int, int]  # source row, first coefficient, how many, lag

ONE, MINUS, FIRST = 0, 1, 2  # places of 1, -1 and the first free coefficient in the vector that the filters take
_Y, _ONES, _U = 0, 1, 2  # rows of the buffer


@dataclass(slots=True, kw_only=True)
class _Writer:
    n_rows: int
    filters: list[tuple[int, int, int, int, int]] = field(default_factory=list)
    terms: list[Term] = field(default_factory=list)

    def filtered(self, terms: list[Term], over: tuple[int, int]) -> int:
        """Note a filter (sum of terms) / (1 + `over`) and return its row; the source itself where it does nothing."""
        if not over[1] and len(terms) == 1 and terms[0][1:] == (ONE, 1, 0):
            return terms[0][0]
        first = len(self.terms)
        self.terms += terms
        self.filters.append((self.n_rows, over[0], over[1], first, len(self.terms)))
        self.n_rows += 1
        return self.n_rows - 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plan:
    """Tables that the compiled recursion follows."""

    # (n_filters + n_terms + n_columns + n_polynomials, 5), filters (destination, first coefficient and length of the
    # denominator, first and last term), terms, columns of the gradient (row, lag, sign), polynomials that have to be
    # stable (first coefficient, length)
    rows: Table
    meta: Table  # see `_kernels`
    n_signals: int


def plan_of(layout: Layout) -> Plan:
    """Write down the recursion of a structure."""
    n_u, place, n = layout.n_inputs, _coefficients(layout), layout.free.size + 1
    A, C, D, none = place["A", None], place["C", None], place["D", None], (0, 0)
    B, F = [place["B", i] for i in range(n_u)], [place["F", i] for i in range(n_u)]
    out = _Writer(n_rows=_U + n_u)

    def monic(row: int, p: tuple[int, int]) -> list[Term]:
        return [(row, ONE, 1, 0)] + ([(row, *p, 1)] if p[1] else [])

    def plain(row: int) -> list[Term]:
        return [(row, ONE, 1, 0)]

    uf = [out.filtered(plain(out.filtered(monic(_U + i, D), C)), F[i]) for i in range(n_u)]
    ones = out.filtered(monic(_ONES, D), C)
    ends = [len(out.filters)]
    w = [out.filtered([(_U + i, *B[i], layout.nk[i])], F[i]) for i in range(n_u)]
    constant = [(_ONES, FIRST + n - 1, 1, 0)]
    minus = out.filtered(constant, none)
    v = out.filtered(monic(_Y, A) + [(x, MINUS, 1, 0) for x in (*w, minus)], none)
    e = out.filtered(monic(v, D), C)
    ends.append(len(out.filters))
    yf = out.filtered(monic(_Y, D), C) if A[1] else _Y
    ef = out.filtered(plain(e), C)
    vf = out.filtered(plain(v), C) if D[1] else v
    wf = [out.filtered([(uf[i], *B[i], layout.nk[i])], F[i]) if F[i][1] else w[i] for i in range(n_u)]
    ends.append(len(out.filters))
    rings = [out.filtered([], F[i]) for i in range(n_u) if F[i][1]]
    if C[1]:
        out.filtered([(x, ONE, 1, 0) for x in rings], C)
    ends.append(len(out.filters))

    columns = [(yf, 1 + k, -1) for k in range(A[1])]
    columns += [(uf[i], layout.nk[i] + k, 1) for i in range(n_u) for k in range(B[i][1])]
    columns += [(ef, 1 + k, 1) for k in range(C[1])] + [(vf, 1 + k, -1) for k in range(D[1])]
    columns += [(wf[i], 1 + k, -1) for i in range(n_u) for k in range(F[i][1])] + [(ones, 0, 1)]
    stable = [p for p in (C, *F) if p[1]]
    first_w = next((w[i] for i in range(n_u) if F[i][1]), -1)
    parts: tuple[Sequence[tuple[int, ...]], ...] = (out.filters, out.terms, columns, stable)
    starts = np.cumsum([0, *(len(p) for p in parts)])
    rows = np.zeros((int(starts[-1]), 5), dtype=np.int64)
    for first, part in zip(starts, parts, strict=False):
        for k, row in enumerate(part):
            rows[first + k, : len(row)] = row
    meta = np.array([n, n_u, _longest(layout), *ends, *starts[1:4], len(stable), v, e, first_w], dtype=np.int64)
    return Plan(rows=rows, meta=meta, n_signals=out.n_rows)


def _coefficients(layout: Layout) -> dict[tuple[str, int | None], tuple[int, int]]:
    """First free coefficient of every polynomial, and how many it has."""
    out, first = {}, FIRST
    for key in layout.places:
        n = len(layout.free_lags(key))
        out[key] = (first, n)
        first += n
    return out


def _longest(layout: Layout) -> int:
    """Samples of history after which w, v and e can be computed, and then reach back as far as C, D and F want."""
    reach = max([1, layout.na, *(b + k for b, k in zip(layout.nb, layout.nk, strict=True))])
    return int(reach + max([layout.nc, layout.nd, *layout.nf]))
