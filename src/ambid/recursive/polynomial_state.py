"""What a recursive polynomial estimator carries from sample to sample, packed for the compiled recursion; what is
filtered by what (theory.md 2.5, `plan_of`) is a table in which only coefficients change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.fit import BlackBoxFit, any_structure
from ambid.blackbox.model import PolynomialModel
from ambid.blackbox.polynomial_predictor import Layout
from ambid.errors import EstimationError
from ambid.recursive.estimator import factors_of, root_of, root_of_factors

Table = NDArray[np.int64]
Term = tuple[int, int, int, int]  # source row, first coefficient, how many, lag

ONE, MINUS, FIRST = 0, 1, 2  # places of 1, -1 and the first free coefficient in the vector that the filters take
_Y, _ONES, _U = 0, 1, 2  # rows of the buffer
COUNTED = (3, 4, 5, 6, 7)  # places in `State.count`: used, rejected, waited, projected, held
_OFTEN = 1e-3
_COLUMNS = 512  # samples that the buffer takes before its end becomes the next history
_WORTH = 100.0  # samples, of the noise variance of a fit that does not say how many it saw
_LOOSE = 100.0  # standard deviations of noise at the output: how far the operating point may have moved since
_FIXED = 1e-9  # relative standard deviation of a coefficient that the fit holds fixed


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


def plan_of(layout: Layout) -> tuple[Table, Table, int]:
    """Return the table of a structure's recursion, where its parts begin, and how many signals it has: w = (B/F) u, v =
    A y - sum of w - constant, e = (D/C) v, and gradients, lags of one polynomial being one shifted signal.

    Gradients by a_k -(D/C) y(t-k), by b_k D/(C F) u(t-k), by c_k e(t-k)/C, by d_k -v(t-k)/C, by f_k -D/(C F) w(t-k), by
    the constant D/C. Rows (5,): filters (destination, first coefficient and length of the denominator, first and last
    term), terms, columns of the gradient (row, lag, sign), polynomials kept stable (first coefficient, length).
    """
    n_u, n = layout.n_inputs, layout.free.size + 1
    place: dict[tuple[str, int | None], tuple[int, int]] = {}  # first free coefficient of each polynomial, how many
    first = FIRST
    for key in layout.places:
        place[key] = first, len(layout.free_lags(key))
        first += place[key][1]
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
    # history after which w, v and e can be computed, and then reach back as far as C, D and F want
    reach = max([1, layout.na, *(b + k for b, k in zip(layout.nb, layout.nk, strict=True))])
    longest = reach + max([layout.nc, layout.nd, *layout.nf])
    meta = np.array([n, n_u, longest, *ends, *starts[1:4], len(stable), v, e, first_w], dtype=np.int64)
    return rows, meta, out.n_rows


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class State:
    """Arrays that the compiled recursion works on, in the order of its arguments."""

    plan: Table  # see `plan` and `_kernels`
    meta: Table
    count: Table
    # (5 + n_inputs,), forgetting factor, squared errors and their weight, noise variance of the start, levels that are
    # taken off
    real: Array
    theta: Array  # (n,), estimate: free coefficients, then the constant
    coef: Array  # (2 + n,), 1, -1, then the same, C and F kept stable: what the filters use
    F: Array  # (n, n), factors of P
    S: Array  # (n, n), empty where nothing is forgotten
    limit: Array  # (n,), variances beyond which forgetting rests
    signals: Array  # (n_rows, n_columns)
    work: Array  # (3, 2 + n)

    def arrays(self) -> tuple[Any, ...]:
        """Return all arrays in the order in which the recursion takes them."""
        return tuple(getattr(self, f.name) for f in fields(self))

    @property
    def at(self) -> Array:
        """Estimate with C and F kept stable, shape (n,)."""
        return self.coef[2:]

    @property
    def at_border(self) -> bool:
        """Whether the filters had to stop short of the estimate often, or do so now."""
        return bool(self.count[6] > _OFTEN * self.count[8] or not np.array_equal(self.theta, self.at))

    @property
    def waits(self) -> bool:
        """Whether nothing is predicted for want of history."""
        return bool(self.count[1] < self.meta[2] or self.count[2])

    @property
    def worse(self) -> float:
        """Standard deviation of the innovations over that of the start."""
        return float(np.sqrt(self.real[1] / self.real[2] / self.real[3]))


def new_state(
    layout: Layout,
    *,
    theta: Array,
    P: Array,
    limit: Array,
    noise_variance: float,
    weight: float,
    centre: Array,
    forgetting: float,
) -> State:
    """Return a state with no past signals: `theta` (n,), free coefficients, then the constant; `P` (n, n) over the
    noise variance, worth `weight` samples; `limit` (n,); `centre` (1 + n_inputs,), levels taken off output and inputs.
    """
    from ambid.recursive.polynomial_kernels import follow

    rows, meta, n_signals = plan_of(layout)
    longest = int(meta[2])
    F = factors_of(P)
    count = np.zeros(16, dtype=np.int64)
    count[0] = longest
    sd = np.sqrt(np.diag(P))
    inverse = np.linalg.inv(root_of_factors(F) / sd[:, None]) / sd
    coef, work = np.concatenate([[1.0, -1.0], theta]), np.zeros((3, 2 + theta.size))
    follow(rows, meta, theta, coef, work[2])
    return State(
        plan=rows,
        meta=meta,
        count=count,
        real=np.concatenate([[forgetting, noise_variance * weight, weight, noise_variance], centre]),
        theta=theta.copy(),
        coef=coef,
        F=F,
        S=np.asarray(inverse.T @ inverse) * noise_variance if forgetting < 1.0 else np.empty((0, 0)),
        limit=limit.copy(),
        signals=np.zeros((n_signals, longest + _COLUMNS)),
        work=work,
    )


def covariance_of_state(state: State, *, doubtful: bool = False) -> Array:
    """Return the covariance (n, n) of the coefficients, positive definite by construction: P times the noise variance,
    or, where something is forgotten, P S P, S = sum of (product of forgetting factors)^2 (noise variance then) psi
    psi': a calm changes nothing. It supposes a start near the truth; `doubtful` adds what is not known where it was
    not.
    """
    G = root_of_factors(state.F)
    if state.S.size:
        lower = np.tril(state.S)
        H = G.T @ (lower + np.tril(lower, -1).T) @ G
        G = G @ root_of((H + H.T) / 2, floor=1e-14)
        P = np.asarray(G @ G.T)
    else:
        P = np.asarray(noise_variance_of(state) * (G @ G.T))
    return P + np.diag(np.where(np.isfinite(state.limit), state.limit, 0.0)) if doubtful else P


def noise_variance_of(state: State) -> float:
    """Return the variance of the innovations."""
    return float(state.real[1] / state.real[2])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Identity:
    """Who a fit is about: what the recursion does not change."""

    structure: str
    layout: Layout
    dt: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: dict[str, str]


def identity_of(fit: BlackBoxFit) -> Identity:
    """Return what a fit says of itself. `fit`: of a polynomial structure, one output."""
    model = fit.model
    known = any_structure(fit.structure).prediction_error
    if not known or not isinstance(model, PolynomialModel):
        raise EstimationError(
            f"{fit.structure} is not a prediction-error fit of a polynomial model and cannot be tracked. Fit "
            "armax, for example"
        )
    if model.n_outputs != 1:
        raise EstimationError(
            f"the fit has {model.n_outputs} outputs; the recursion tracks one. Fit and track each output by itself"
        )
    p = model.outputs[0]
    delay = fit.orders.get("nk", 0)
    nk = tuple(int(x) for x in (delay if isinstance(delay, tuple) else (delay,) * len(p.B)))
    layout = Layout(
        na=p.A.size - 1,
        nb=tuple(b.size - k for b, k in zip(p.B, nk, strict=True)),
        nc=p.C.size - 1,
        nd=p.D.size - 1,
        nf=tuple(f.size - 1 for f in p.F),
        nk=nk,
    )
    return Identity(
        structure=fit.structure, layout=layout, dt=fit.dt, inputs=fit.inputs, outputs=fit.outputs, units=dict(fit.units)
    )


def state_from_fit(fit: BlackBoxFit, layout: Layout, forgetting: float, *, samples: int | None = None) -> State:
    """Return a state whose prior information is what the fit knows."""
    noise = float(fit.noise_covariance[0, 0])
    if fit.covariance is None or not noise > 0.0:
        raise EstimationError(
            f"the {fit.structure} fit has {'no covariance' if fit.covariance is None else 'no noise'}; new data cannot "
            "be weighed against it. Start from orders alone"
        )
    full, free = fit.model.theta, layout.free
    n = free.size + 1
    theta, P = np.zeros(n), np.zeros((n, n))
    theta[: free.size] = full[free]
    P[: free.size, : free.size] = fit.covariance[np.ix_(free, free)] / noise
    size = np.ones(full.size)  # of each coefficient: one for A, C, D and F, that of the polynomial for B
    for (letter, _), place in layout.places.items():
        if letter == "B" and place.stop > place.start:
            size[place] = np.max(np.abs(full[place])) or 1.0
    scale = size[free]
    floor = (_FIXED * scale) ** 2 / noise
    k = np.arange(free.size)
    P[k, k] = np.maximum(P[k, k], floor)
    limit = np.full(n, np.inf)
    limit[: free.size] = np.maximum(scale**2, noise * P[k, k])
    p = layout.polynomials(full)
    gain = float(np.clip(abs(p.C.sum()) / max(abs(p.D.sum()), 1e-3), 1e-3, 1e3))
    P[-1, -1] = gain**2 / samples if samples else (_LOOSE * gain) ** 2
    limit[-1] = 4.0 * noise * (_LOOSE * gain) ** 2
    return new_state(
        layout,
        theta=theta,
        P=P,
        limit=limit,
        noise_variance=noise,
        weight=float(samples) if samples else _WORTH,
        centre=np.concatenate([fit.offsets.y, fit.offsets.u]),
        forgetting=forgetting,
    )
