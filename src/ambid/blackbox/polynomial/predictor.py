"""The predictor of A y = (B/F) u + (C/D) e for one output, and its five exact gradients (thesis eq. 3.12).

Residual: e = (D/C) (A y - sum_i (B_i/F_i) u_i - kappa), kappa the constant that offsets leave.
Gradients: all lags of one polynomial are one filtered signal, shifted: de/da_k = (D/C) y(t-k),
de/db_k = -D/(C F) u(t-k), de/dc_k = -(1/C) e(t-k), de/dd_k = (1/C) v(t-k) with v = A y - (B/F) u - kappa,
de/df_k = (D B)/(C F^2) u(t-k). Filters start at rest at sample 0; residuals count from `first_row` on, and what came
before is replaced by impulses at that row whose sizes are estimated (as many as there are initial states). From rest
nothing came before: all residuals count, and there are neither impulses nor a constant.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.polynomial._kernels import block_rows, predictor_rows, predictor_triangle
from ambid.blackbox.polynomial.orders import Layout

Table = NDArray[np.int64]

_BLOCK = 512  # samples: signals and rows of a small model stay in the fast cache
_ONE, _MINUS, _CONSTANT, _THETA = 0, 1, 2, 3  # places in the vector of all coefficients


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Predictor:
    """What is filtered by what, for one structure."""

    layout: Layout
    filters: Table  # (n_filters, 6), (n_terms, 4), see `_kernels`
    terms: Table
    columns: Table  # (n_columns, 3), signal, lag and sign of every gradient and, last, of the residual
    n_signals: int
    pad: int
    first_row: int
    impulse_row: int
    n_initial: int  # initial states, the first columns; the constant, if any, follows, then the free coefficients
    n_nuisance: int  # initial states and constant

    def coefficients(self, theta: Array, nuisance: Array) -> Array:
        """Return what the filters take.

        `theta`: (n_theta,), all coefficients of the output; `nuisance`: (n_nuisance,), initial states, then the
        constant. Returns (3 + n_theta + n_initial,).
        """
        constant = nuisance[self.n_initial :] if self.n_nuisance > self.n_initial else np.zeros(1)
        return np.concatenate([[1.0, -1.0], -constant, theta, nuisance[: self.n_initial]])

    def triangle(self, y: Array, u: Array, theta: Array, nuisance: Array) -> Array:
        """Return R of the QR decomposition of [initial states, constant, free coefficients, residual].

        `y`: (n_samples,); `u`: (n_inputs, n_samples); `theta`: (n_theta,); `nuisance`: (n_nuisance,). Returns
        (n_columns, n_columns).
        """
        R: Array = predictor_triangle(
            y,
            u,
            self.filters,
            self.terms,
            self.columns,
            self.coefficients(theta, nuisance),
            self.n_signals,
            self.pad,
            self.first_row,
            self.impulse_row,
            self.n_initial,
            max(_BLOCK, self.pad + 1),
        )
        return R

    def blocks(self, y: Array, u: Array, theta: Array, nuisance: Array) -> Iterator[tuple[int, Array]]:
        """Yield the rows [gradients, residual] block by block.

        `y`: (n_samples,); `u`: (n_inputs, n_samples); `theta`: (n_theta,); `nuisance`: (n_nuisance,). Returns
        (n_columns, n_rows), first sample, and rows, which are good until the next block is asked for.
        """
        coef, m = self.coefficients(theta, nuisance), max(_BLOCK, self.pad + 1)
        s, w = np.zeros((self.n_signals, self.pad + m)), np.empty((self.columns.shape[0], m))
        ringing = 1
        for first in range(0, y.size, m):
            n, ringing = block_rows(
                y,
                u,
                self.filters,
                self.terms,
                self.columns,
                coef,
                s,
                w,
                self.pad,
                self.first_row,
                self.impulse_row,
                first,
                ringing,
            )
            yield max(first, self.first_row), w[:, :n]

    def rows(self, y: Array, u: Array, theta: Array, nuisance: Array) -> Array:
        """Return the gradients and, last, the residual; complex where the coefficients are.

        `y`: (n_samples,); `u`: (n_inputs, n_samples); `theta`: (n_theta,); `nuisance`: (n_nuisance,). Returns
        (n_columns, n_samples - first_row).
        """
        return self._rows(y, u, theta, nuisance, self.columns)

    def residual(self, y: Array, u: Array, theta: Array, nuisance: Array) -> Array:
        """Return the residual; complex where the coefficients are.

        `y`: (n_samples,); `u`: (n_inputs, n_samples); `theta`: (n_theta,); `nuisance`: (n_nuisance,). Returns
        (n_samples - first_row,).
        """
        return np.asarray(self._rows(y, u, theta, nuisance, self.columns[-1:])[0])

    def _rows(self, y: Array, u: Array, theta: Array, nuisance: Array, columns: Table) -> Array:
        coef = self.coefficients(theta, nuisance)
        s = np.zeros((self.n_signals, self.pad + y.size), dtype=coef.dtype)
        out: Array = predictor_rows(
            y, u, self.filters, self.terms, columns, coef, s, self.pad, self.first_row, self.impulse_row
        )
        return out


@dataclass(slots=True)
class _Plan:
    """Filters, terms and columns while they are being written down."""

    n_signals: int
    filters: list[tuple[int, ...]] = field(default_factory=list)
    terms: list[tuple[int, int, int, int]] = field(default_factory=list)
    columns: list[tuple[int, int, int]] = field(default_factory=list)
    known: dict[tuple[object, int, int], int] = field(default_factory=dict)

    def filtered(self, terms: list[tuple[int, int, int, int]], over: slice, *, impulse: bool = False) -> int:
        """Add the signal sum(terms) / polynomial `over`, and return its row; terms: (row, place, size, lag)."""
        n_over = over.stop - over.start - 1
        if not n_over and len(terms) == 1 and terms[0][1:] == (_ONE, 1, 0):
            return terms[0][0]
        key = (tuple(terms), over.start, over.stop)
        if key in self.known:
            return self.known[key]
        first = len(self.terms)
        self.terms += terms
        row = self.known[key] = self.n_signals
        self.filters.append((row, over.start + 1, n_over, first, len(self.terms), int(impulse)))
        self.n_signals += 1
        return row


@lru_cache(maxsize=256)
def predictor(layout: Layout) -> Predictor:
    """Write down the predictor of one output.

    `layout`: at rest: without initial states and without the constant that offsets leave.
    """
    n_u, free = layout.n_inputs, not layout.at_rest
    place = {key: slice(p.start + _THETA, p.stop + _THETA) for key, p in layout.places.items()}
    A, C, D = (place[x, None] for x in "ACD")
    one, impulse = 1 + n_u, 2 + n_u
    plan = _Plan(n_signals=3 + n_u)
    nothing = slice(0, 1)
    n_noise = max(layout.nc, layout.nd)
    states = layout.n_theta + _THETA  # initial states: of every F, then of C and D
    initial: list[tuple[int, int, int]] = []

    def through_noise(row: int, *, rings: bool = False) -> int:  # (D/C) x
        whole = D.stop - D.start == 1
        term = (row, _ONE, 1, 0) if whole else (row, D.start, D.stop - D.start, 0)
        return plan.filtered([term], C, impulse=rings)

    v_terms = [(0, A.start, A.stop - A.start, 0)]
    w, F = [], []
    for i in range(n_u):
        b, f = place["B", i], place["F", i]
        terms = [(1 + i, b.start + layout.nk[i], layout.nb[i], layout.nk[i])]
        if layout.nf[i] and free:
            terms.append((impulse, states, layout.nf[i], 0))
            states += layout.nf[i]
        w.append(plan.filtered(terms, f))
        F.append(f)
        v_terms.append((w[i], _MINUS, 1, 0))
    if free:
        v_terms.append((one, _CONSTANT, 1, 0))
    v = plan.filtered(v_terms, nothing)
    e_terms = [(v, _ONE, 1, 0) if not layout.nd else (v, D.start, layout.nd + 1, 0)]
    if n_noise and free:
        e_terms.append((impulse, states, n_noise, 0))
    e = plan.filtered(e_terms, C)
    for i in range(n_u):
        if layout.nf[i] and free:
            row = plan.filtered([(through_noise(impulse, rings=True), _ONE, 1, 0)], F[i], impulse=True)
            initial += [(row, j, -1) for j in range(layout.nf[i])]
    if n_noise and free:
        row = plan.filtered([(impulse, _ONE, 1, 0)], C, impulse=True)
        initial += [(row, j, 1) for j in range(n_noise)]
    plan.columns += initial
    if free:
        plan.columns.append((through_noise(one), 0, -1))
    n_nuisance = len(plan.columns)

    def gradient(key: tuple[str, int | None], row: int, sign: int) -> None:
        plan.columns += [(row, k, sign) for k in layout.free_lags(key)]

    if layout.free_lags(("A", None)):
        gradient(("A", None), through_noise(0), 1)
    for i in range(n_u):
        if layout.free_lags(("B", i)):
            gradient(("B", i), plan.filtered([(through_noise(1 + i), _ONE, 1, 0)], F[i]), -1)
    if layout.free_lags(("C", None)):
        gradient(("C", None), plan.filtered([(e, _ONE, 1, 0)], C), -1)
    if layout.free_lags(("D", None)):
        gradient(("D", None), plan.filtered([(v, _ONE, 1, 0)], C), 1)
    for i in range(n_u):
        if layout.free_lags(("F", i)):
            gradient(("F", i), plan.filtered([(through_noise(w[i]), _ONE, 1, 0)], F[i]), 1)
    plan.columns.append((e, 0, 1))
    return Predictor(
        layout=layout,
        filters=np.array(plan.filters, dtype=np.int64).reshape(-1, 6),
        terms=np.array(plan.terms, dtype=np.int64).reshape(-1, 4),
        columns=np.array(plan.columns, dtype=np.int64),
        n_signals=plan.n_signals,
        pad=2
        + max(max(t[2] + t[3] for t in plan.terms), max(c[1] for c in plan.columns), *(f[2] for f in plan.filters)),
        first_row=layout.first_row,
        impulse_row=impulse,
        n_initial=len(initial),
        n_nuisance=n_nuisance,
    )
