"""Orders, data and predictor of A y = (B/F) u + (C/D) e for one output, with its exact gradients (thesis eq. 3.12).

Residual: e = (D/C) (A y - sum_i (B_i/F_i) u_i - kappa), kappa the constant that offsets leave. Gradients are filtered
signals, shifted: de/da_k = (D/C) y(t-k), de/db_k = -D/(C F) u(t-k), de/dc_k = -(1/C) e(t-k), de/dd_k = (1/C) v(t-k)
with v = A y - (B/F) u - kappa, de/df_k = (D B)/(C F^2) u(t-k). Filters start at rest at sample 0, residuals count from
`first_row` on, and impulses there of estimated size stand for what was before; from rest, no impulses and no constant.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import (
    IOData,
    Orders,
    UsedOrders,
    check_order_names,
    compact_order,
    left_open,
    order_per_input,
    single_order,
)
from ambid.blackbox.fit import structure
from ambid.blackbox.model import PolynomialModel, Polynomials
from ambid.errors import EstimationError, choices

Key = tuple[str, int | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Orders of one output, and which of its coefficients are free."""

    na: int
    nb: tuple[int, ...]  # one for each input
    nc: int
    nd: int
    nf: tuple[int, ...]
    nk: tuple[int, ...]
    fixed: tuple[int, ...] = ()  # places of coefficients that the user fixed
    # everything was zero before the first sample: no initial states, no constant, and all samples count
    at_rest: bool = False
    # where each polynomial stands among all coefficients, in the order of `PolynomialModel.theta`
    places: Mapping[Key, slice] = field(init=False, repr=False, compare=False)
    # (n_free,), places of the estimated coefficients
    free: NDArray[np.int64] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        sizes: list[tuple[Key, int]] = [(("A", None), self.na + 1)]
        sizes += [(("B", i), b + k) for i, (b, k) in enumerate(zip(self.nb, self.nk, strict=True))]
        sizes += [(("C", None), self.nc + 1), (("D", None), self.nd + 1)]
        sizes += [(("F", i), f + 1) for i, f in enumerate(self.nf)]
        first, out = 0, {}
        for key, size in sizes:
            out[key] = slice(first, first + size)
            first += size
        object.__setattr__(self, "places", out)
        object.__setattr__(self, "free", _free(self))

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return len(self.nb)

    @property
    def n_theta(self) -> int:
        """Number of all coefficients, leading ones and zeros included."""
        return self.na + sum(self.nb) + sum(self.nk) + self.nc + self.nd + sum(self.nf) + 3 + self.n_inputs

    @property
    def first_row(self) -> int:
        """First sample whose regressors lie in the record, or are known to be zero."""
        if self.at_rest:
            return 0
        return max([self.na, *(b + k - 1 for b, k in zip(self.nb, self.nk, strict=True))])

    def free_lags(self, key: Key) -> tuple[int, ...]:
        """Return the lags of the estimated coefficients of polynomial `key`, letter and input."""
        place = self.places[key]
        first = self.nk[key[1]] if key[0] == "B" and key[1] is not None else 1
        return tuple(k for k in range(first, place.stop - place.start) if place.start + k not in self.fixed)

    def start(self) -> Array:
        """Return coefficients of a model that is zero: leading ones alone, shape (n_theta,)."""
        theta = np.zeros(self.n_theta)
        for (letter, _), place in self.places.items():
            theta[place.start] = float(letter != "B")
        return theta

    def coefficients(
        self,
        A: Array | None = None,
        B: Sequence[Array] = (),
        C: Array | None = None,
        D: Array | None = None,
        F: Sequence[Array] = (),
    ) -> Array:
        """Return the coefficients of polynomials; what is not given is 1, B zero."""
        theta = self.start()
        for letter, p in (("A", A), ("C", C), ("D", D)):
            if p is not None:
                theta[self.places[letter, None]] = p
        for letter, several in (("B", B), ("F", F)):
            for i, p in enumerate(several):
                theta[self.places[letter, i]] = p
        return theta

    def polynomials(self, theta: Array) -> Polynomials:
        """Return the polynomials that `theta` (n_theta,) holds."""
        p = self.places
        per_input = range(self.n_inputs)
        return Polynomials(
            A=theta[p["A", None]],
            B=tuple(theta[p["B", i]] for i in per_input),
            C=theta[p["C", None]],
            D=theta[p["D", None]],
            F=tuple(theta[p["F", i]] for i in per_input),
        )


def arx_layout(na: int, nb: tuple[int, ...], nk: tuple[int, ...], *, at_rest: bool = False) -> Layout:
    """Return the layout of A y = B u + e."""
    return Layout(na=na, nb=nb, nc=0, nd=0, nf=(0,) * len(nb), nk=nk, at_rest=at_rest)


def _free(layout: Layout) -> NDArray[np.int64]:
    lags = [p.start + k for key, p in layout.places.items() for k in layout.free_lags(key)]
    out = np.array(lags, dtype=np.int64)
    out.flags.writeable = False
    return out


def read_orders(name: str, data: IOData, orders: Orders, *, at_rest: bool = False) -> tuple[Layout, bool]:
    """Check a structure's orders against the data; return the layout, and whether the delay is left open (nk is then
    0).
    """
    letters, n_u = structure(name).orders, data.n_inputs
    wants = structure(name).inputs
    if wants and not data.n_inputs:
        raise EstimationError(f"{name} needs an input and the data have none. Name one, or use arma")
    if not wants and data.n_inputs:
        raise EstimationError(
            f"{name} takes no inputs and the data have {data.n_inputs} ({', '.join(data.inputs)}). Omit them, or "
            "use armax"
        )
    check_order_names(name, orders, letters, [key for key in letters if key != "nk"])
    free_delay = "nk" in letters and left_open(orders, "nk")

    def one(key: str) -> int:
        return single_order(name, orders, key, 0) if key in letters else 0

    def each(key: str, least: int = 0) -> tuple[int, ...]:
        return order_per_input(name, orders, key, least, n_u) if key in letters else (0,) * n_u

    layout = Layout(
        na=one("na"),
        nb=each("nb", 1),
        nc=one("nc"),
        nd=one("nd"),
        nf=each("nf"),
        nk=(0,) * n_u if free_delay else each("nk"),
        at_rest=at_rest,
    )
    if not layout.free.size:
        raise EstimationError(f"{name}: all orders are 0, and nothing is left to estimate. Raise one")
    return layout, free_delay


def compact_orders(name: str, layout: Layout) -> UsedOrders:
    """Return the orders as a result prints them: a number where all inputs agree."""
    out: dict[str, int | tuple[int, ...]] = {}
    for key in structure(name).orders:
        value = getattr(layout, key)
        out[key] = compact_order(value) if isinstance(value, tuple) else value
    return out


def fixed_places(name: str, layouts: tuple[Layout, ...], fixed: Mapping[str, float]) -> list[dict[int, float]]:
    """Return place and value, for each output, of the coefficients `fixed` by the names of `PolynomialModel.names`."""
    if not fixed:
        return [{} for _ in layouts]
    outputs = tuple(layout.polynomials(layout.start()) for layout in layouts)
    names = PolynomialModel(outputs=outputs, dt=1.0).names
    free = {}
    first = 0
    for o, layout in enumerate(layouts):
        free.update({names[first + p]: (o, int(p)) for p in layout.free})
        first += layout.n_theta
    places: list[dict[int, float]] = [{} for _ in layouts]
    for key, value in fixed.items():
        if key not in free:
            raise EstimationError(f"{name}: no coefficient {key!r} can be fixed; there are {choices(key, free)}")
        if not np.isfinite(value):
            raise EstimationError(f"{name}: coefficient {key} is fixed at {value}; it must be a finite number")
        o, place = free[key]
        places[o][place] = float(value)
    return places


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScaledData:
    """Data without means, in units of their standard deviations."""

    u: Array  # (n_inputs, n_samples), (n_outputs, n_samples)
    y: Array
    u_mean: Array  # (n_inputs,)
    u_scale: Array
    y_mean: Array  # (n_outputs,)
    y_scale: Array
    at_rest: bool = False  # whether the user says that everything was zero before the first sample


def scale_data(name: str, data: IOData, *, at_rest: bool = False) -> ScaledData:
    """Take off means and divide by standard deviations."""
    out = []
    for values, names in ((data.u, data.inputs), (data.y, data.outputs)):
        mean = np.zeros(len(names)) if at_rest else np.mean(values, axis=0)
        centred = np.subtract(values.T, mean[:, None], order="C")
        scale = np.sqrt(np.array([x @ x for x in centred]) / max(values.shape[0], 1))
        for k, channel in enumerate(names):
            if not scale[k] > 1e-13 * abs(mean[k]):
                raise EstimationError(
                    f"{name}: {channel!r} is constant at {values[0, k]:g} and carries no information. Excite it, "
                    "or omit it"
                )
        centred /= scale[:, None]
        out.append((centred, mean, scale))
    (u, u_mean, u_scale), (y, y_mean, y_scale) = out
    return ScaledData(u=u, y=y, u_mean=u_mean, u_scale=u_scale, y_mean=y_mean, y_scale=y_scale, at_rest=at_rest)


def coefficient_units(layout: Layout, scaled: ScaledData, o: int) -> Array:
    """Return what one scaled coefficient of output `o` is worth in SI, shape (n_theta,)."""
    out = np.ones(layout.n_theta)
    for i in range(layout.n_inputs):
        out[layout.places["B", i]] = scaled.y_scale[o] / scaled.u_scale[i]
    return out


def liveliest_part(u: Array, size: int = 8192) -> slice:
    """Return the piece of `size` samples in which the inputs (n_inputs, n_samples) move most, for a start or a first
    choice; records up to twice as long are taken whole.
    """
    n = u.shape[1]
    if n <= 2 * size:
        return slice(0, n)
    energy = np.add.reduceat(np.sum(u * u, axis=0), np.arange(0, n - size + 1, size))
    first = int(np.argmax(energy[:-1])) * size
    return slice(first, first + size)


Table = NDArray[np.int64]

_BLOCK = 1024  # samples: signals and rows of a small model stay in the cache
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
        """Return what the filters take, (3 + n_theta + n_initial,); `nuisance`: initial states, then the constant."""
        constant = nuisance[self.n_initial :] if self.n_nuisance > self.n_initial else np.zeros(1)
        return np.concatenate([[1.0, -1.0], -constant, theta, nuisance[: self.n_initial]])

    def triangle(self, y: Array, u: Array, theta: Array, nuisance: Array) -> Array:
        """Return R of the QR of [initial states, constant, free coefficients, residual]; `u`: (n_inputs, n_samples)."""
        from ambid.blackbox.polynomial_kernels import add_rows

        R = np.zeros((self.columns.shape[0],) * 2)
        for rows, n, ringing in self._blocks(y, u, self.coefficients(theta, nuisance), max(_BLOCK, self.pad + 1)):
            # responses to the impulse are left out once they have died away
            add_rows(R, rows, n, 0 if ringing else self.n_initial)
        return R

    def blocks(self, y: Array, u: Array, theta: Array, nuisance: Array) -> Iterator[tuple[int, Array]]:
        """Yield first sample and rows [gradients, residual] block by block, good until the next; `u`: (n_inputs,
        n_samples).
        """
        m = max(_BLOCK, self.pad + 1)
        for k, (w, n, _) in enumerate(self._blocks(y, u, self.coefficients(theta, nuisance), m)):
            yield max(k * m, self.first_row), w[:, :n]

    def rows(self, y: Array, u: Array, theta: Array, nuisance: Array) -> Array:
        """Return the gradients and, last, the residual from `first_row` on."""
        w, n, _ = next(self._blocks(y, u, self.coefficients(theta, nuisance), y.size))
        return w[:, :n]

    def _blocks(self, y: Array, u: Array, coef: Array, m: int) -> Iterator[tuple[Array, int, int]]:
        """Yield rows (n_columns, m), how many of their samples count, and whether the impulses still ring."""
        from ambid.blackbox.polynomial_kernels import block_rows

        y, u = np.require(y, requirements=["C", "W"]), np.require(u, requirements=["C", "W"])  # one kernel for all
        m = min(m, y.size)
        s = np.zeros((self.n_signals, self.pad + m), dtype=coef.dtype)
        w = np.empty((self.columns.shape[0], m), dtype=coef.dtype)
        tables, places, ringing = (self.filters, self.terms, self.columns), (self.first_row, self.impulse_row), 1
        for first in range(0, y.size, m):
            n, ringing = block_rows(y, u, *tables, coef, s, w, self.pad, *places, first, ringing)
            yield w, n, ringing


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
    """Write down the predictor of one output; at rest it has no initial states and no constant."""
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


def filter_signal(num: Array, den: Array, x: Array) -> Array:
    """Return (num / den) x from rest, den beginning with 1: a predictor of one filter, nothing else to compile."""
    from ambid.blackbox.polynomial_kernels import block_rows

    pad = 2 + max(num.size, den.size)
    signals, out = np.zeros((4, pad + x.size)), np.empty((1, x.size))  # x, a constant, an impulse, the result
    filters = np.array([[3, num.size + 1, den.size - 1, 0, 1, 0]])
    tables = (filters, np.array([[0, 0, num.size, 0]]), np.array([[3, 0, 1]]))
    coef = np.concatenate([num, den])
    block_rows(x, np.empty((0, x.size)), *tables, coef, signals, out, pad, 0, 2, 0, 1)
    return np.asarray(out[0])
