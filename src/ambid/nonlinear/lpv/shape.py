"""The equations of an LPV model and its predictor, on scaled signals, and the scheduling signal p behind them.

p is a column among the inputs (its value now), the output (its last value), or ``level``: the set point, as a causal
first-order low-pass of the output before the present sample. It is scaled to -1 ... 1 over the training data; a
coefficient is a sum of Legendre polynomials of it, or of hats (piecewise linear).

Equation form: A(q, p) y = B(q, p) u + c(p) + v; output form: A(q, p) x = B(q, p) u + c(p), y = x + v; both with the
error model D(q, p) v = C(q, p) e. All coefficients at time t are functions of p(t), and stand before the shifted
signals: (A y)(t) = y(t) + a_1(p(t)) y(t - 1) + ... (Toth 2010, sec. 3.1: static dependence, shifted form). Operators do
not commute with p, so that this is another model than one with p(t - k).

States of the output form and first innovations, w, are those that make the innovations of the first samples small:
min |e(theta, w)|^2 + w' Lambda w, with Lambda from their own size beside the innovations'. e is linear in w. Without
it, a zero of C near the unit circle keeps an error of these alive for its time constant.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.roots import stable
from ambid.errors import EstimationError, nearest
from ambid.nonlinear.settings import choice, number, read_settings, text, whole

LEVEL = "level"
BASES = ("legendre", "hats")
_EACH = 4  # samples for each number
_STATES = 0.01  # variance of an innovation over that of what a state differs by
# --- schedule ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Schedule:
    """A scheduling signal."""

    name: str  # of the column; ``level`` for the set point
    column: int  # which input it is; -1 where it is made of the output
    # of the low-pass; 0 for the last value of the output itself. Without meaning for a column of the inputs.
    time_constant: float
    low: float  # range in training
    high: float

    @property
    def middle(self) -> float:
        """Middle of the range, SI."""
        return 0.5 * (self.low + self.high)

    @property
    def half(self) -> float:
        """Half the range, SI."""
        return 0.5 * (self.high - self.low)

    def share(self, dt: float) -> float:
        """Return the weight of the newest output in the low-pass.

        Returns 0 for a column of the inputs, where there is no low-pass.
        """
        if self.column >= 0:
            return 0.0
        return 1.0 if self.time_constant <= 0 else -math.expm1(-dt / self.time_constant)

    def signal(self, u: Array, y: Array, dt: float) -> Array:
        """Return the scheduling signal, (n_samples,), of inputs and outputs; all in SI."""
        return scheduling_signal(u, y, self.column, self.share(dt))

    def scaled(self, p: Array | float) -> Array:
        """Return p as the functions of it take it, -1 to 1 in training."""
        return np.asarray((np.asarray(p, dtype=np.float64) - self.middle) / self.half)


def scheduling_signal(u: Array, y: Array, column: int, share: float) -> Array:
    """Return a column of the inputs, or, for -1, the output low-passed with `share`, the newest value's weight."""
    from ambid.nonlinear.lpv._kernels import set_points

    if column >= 0:
        return np.ascontiguousarray(u[:, column])
    out = np.empty(y.shape[0])
    set_points(np.ascontiguousarray(y[:, 0]), share, out)
    return out


def basis_values(s: Array, n: int, basis: str) -> Array:
    """Return `n` functions (degree + 1) of the scaled scheduling signal, (n_samples, n)."""
    from ambid.nonlinear.lpv._kernels import basis_rows

    out = np.empty((s.size, n))
    basis_rows(np.ascontiguousarray(s), BASES.index(basis), out)
    return out


def schedule_column(name: str, first: IOData) -> int:
    """Return which input a schedule names; -1 where the scheduling signal is made of the output."""
    columns = (*first.inputs, *first.outputs)
    if name == LEVEL:
        if LEVEL in columns:
            raise EstimationError(
                "lpv: schedule = level means the low-passed output, but there is a column of that name. Rename "
                "the column"
            )
        return -1
    if name not in columns:
        raise EstimationError(
            f"lpv: schedule is {name!r}; it must be an input, the output or level: {', '.join((*columns, LEVEL))}. "
            f"Name the column as an input too; it does not excite unless exciting = yes.{nearest(name, list(columns))}"
        )
    return first.inputs.index(name) if name in first.inputs else -1


def schedule_over(records: Sequence[IOData], name: str, column: int, time_constant: float) -> Schedule:
    """Return a schedule with the range that it has in the records."""
    of = Schedule(name=name, column=column, time_constant=time_constant, low=0.0, high=0.0)
    whole = np.concatenate([of.signal(x.u, x.y, x.dt)[1:] for x in records])
    low, high = float(whole.min()), float(whole.max())
    if not high - low > 1e-12 * max(abs(low), abs(high)):
        raise EstimationError(
            f"lpv: the scheduling signal {name!r} is constant at {low:g}; a model that is scheduled by it cannot be "
            "told from a linear one. Give records at several set points, or fit a linear structure (bj, ararmax)"
        )
    return Schedule(name=name, column=column, time_constant=time_constant, low=low, high=high)


# --- equations --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class LpvShape:
    """Orders of an LPV model of one output."""

    columns: tuple[int, ...]  # which inputs excite
    order: int  # of A
    nb: int  # coefficients of each input, and the smallest lag
    nk: int
    ar: int  # orders of D and C
    ma: int
    degree: int  # functions of p less one, in A, B, c and in C, D
    error_degree: int
    form: str  # whether v enters the difference equation or the output
    basis: str
    # whether c is a function of p. Where p is the last output itself c(p) says nothing that a_1(p) y(t - 1) does not.
    offset: str = "scheduled"

    @property
    def first(self) -> int:
        """Samples before the process part can be computed."""
        return max(self.order, self.nk + self.nb - 1 if self.columns else 0, 1)

    @property
    def lag(self) -> int:
        """Samples of the past that a prediction needs."""
        return self.first + self.ar

    @property
    def n_process(self) -> int:
        """Coefficients of A, B and the constant, each a function of p."""
        return self.order + len(self.columns) * self.nb + 1

    @property
    def n_offset(self) -> int:
        """Functions of p in the constant."""
        return 1 if self.offset == "constant" else self.degree + 1

    @property
    def n_process_theta(self) -> int:
        """Number of parameters of A, B and the constant, which are the first ones."""
        return (self.n_process - 1) * (self.degree + 1) + self.n_offset

    @property
    def n_theta(self) -> int:
        """Number of parameters."""
        return self.n_process_theta + (self.ar + self.ma) * (self.error_degree + 1)

    @property
    def n_start(self) -> int:
        """Numbers that stand for what was before a record: states of the output form, first innovations."""
        return (self.order if self.form == "output" else 0) + self.ma

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Names of the coefficients, in the order of theta."""
        out = [f"a{k + 1}" for k in range(self.order)]
        for i in range(len(self.columns)):
            out += [f"b{i + 1}_{self.nk + k}" if len(self.columns) > 1 else f"b{self.nk + k}" for k in range(self.nb)]
        return (*out, "offset", *(f"d{k + 1}" for k in range(self.ar)), *(f"c{k + 1}" for k in range(self.ma)))

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters: coefficient and number of the function of p."""
        found = []
        for k, x in enumerate(self.coefficients):
            where = self.place(k)
            found += [f"{x}[{j}]" for j in range(where.stop - where.start)]
        return tuple(found)

    def place(self, coefficient: int) -> slice:
        """Return where the parameters of a coefficient stand in theta, by its number in `coefficients`."""
        K, Q, n, last = self.degree + 1, self.error_degree + 1, self.n_process, self.n_process_theta
        if coefficient < n:
            return slice(coefficient * K, min((coefficient + 1) * K, last))
        return slice(last + (coefficient - n) * Q, last + (coefficient - n + 1) * Q)

    def lagged_inputs(self, u: Array) -> Array:
        """Return the scaled inputs that each sample depends on, zeros before the record, and a column of ones."""
        n = u.shape[0]
        out = np.zeros((n, len(self.columns) * self.nb + 1))
        out[:, -1] = 1.0
        for i, column in enumerate(self.columns):
            for k in range(self.nb):
                lag = self.nk + k
                out[lag:, i * self.nb + k] = u[: max(n - lag, 0), column]
        return out

    def table(self) -> NDArray[np.int64]:
        """Return the orders as the compiled recursion takes them.

        Returns (6,).
        """
        own = int(self.form == "output")
        return np.array([self.order, self.ar, self.ma, own, self.first, self.n_offset], dtype=np.int64)


def is_stable_process(shape: LpvShape, theta: Array) -> bool:
    """Return whether the frozen process part is stable over the range of p."""
    return _is_stable(shape, theta, range(shape.order), shape.degree)


def is_sound(shape: LpvShape, theta: Array) -> bool:
    """Return whether the frozen predictor is stable over the range of p: C, and A in the output form.

    That a run stays finite does not say so: what was before the record is fitted as well, and can balance a mode that
    grows.
    """
    first = shape.n_process + shape.ar
    if shape.ma and not _is_stable(shape, theta, range(first, first + shape.ma), shape.error_degree):
        return False
    return shape.form == "equation" or is_stable_process(shape, theta)


def _is_stable(shape: LpvShape, theta: Array, coefficients: Sequence[int], degree: int) -> bool:
    values = basis_values(np.linspace(-1.0, 1.0, 4 * degree + 1), degree + 1, shape.basis)
    rows = np.stack([values @ theta[shape.place(k)] for k in coefficients], axis=1)
    return all(stable(np.concatenate([[1.0], row])) for row in rows)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """One record, ready for a shape."""

    y: Array  # (n_samples,), scaled
    W: Array  # (n_samples, n_w), lagged inputs and ones
    phi: Array  # functions of the scheduling signal
    psi: Array


def part_of(shape: LpvShape, y: Array, u: Array, s: Array) -> Part:
    """Prepare a scaled record."""
    phi = basis_values(s, shape.degree + 1, shape.basis)
    same = shape.error_degree == shape.degree
    psi = phi if same else basis_values(s, shape.error_degree + 1, shape.basis)
    return Part(y=np.ascontiguousarray(y), W=shape.lagged_inputs(u), phi=phi, psi=psi)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Errors:
    """A record run through a predictor."""

    finite: bool  # whether nothing diverged; if not, the rest means nothing
    # (n_samples,), scaled, process part, predictions and innovations, the first `lag` of which are not computed
    x: Array
    g: Array
    e: Array
    J: Array  # (n_samples, n_theta + n_start), or (0, 0), derivatives of the prediction


def errors(shape: LpvShape, part: Part, theta: Array, start: Array | None = None, *, slopes: int = 0) -> Errors:
    """Run a record through the predictor, from `start`, what was before it (zeros if left out).

    `slopes`: derivatives: 0 for none, 1 for those by `start` alone, 2 for all.
    """
    from ambid.nonlinear.lpv._kernels import run

    n = part.y.size
    start = np.zeros(shape.n_start) if start is None else start
    x, g, e = np.zeros(n), np.zeros(n), np.zeros(n)
    J = np.zeros((n, shape.n_theta + shape.n_start) if slopes else (1, 1))
    finite = n <= shape.lag or run(
        part.y, part.W, part.phi, part.psi, theta, start, shape.table(), slopes, x, g, e, J
    )  # fmt: skip
    return Errors(finite=bool(finite), x=x, g=g, e=e, J=J)


# --- what was before a record -----------------------------------------------------------------------------------------


def settling(shape: LpvShape) -> int:
    """Return the samples, beyond those that a prediction looks back over, from which a beginning is estimated."""
    return _EACH * shape.n_start


def looks_back(shape: LpvShape) -> int:
    """Return the samples of the past that a prediction needs, those of the beginning included."""
    return shape.lag + settling(shape)


def beginning(shape: LpvShape, part: Part, theta: Array, *, slopes: bool = False) -> tuple[Array, Array] | None:
    """Estimate what was before a record, and its derivative by theta (zeros unless asked for).

    None where the predictor diverges.
    """
    k, P = shape.n_start, shape.n_theta
    last = looks_back(shape)
    if not k or part.y.size < last:
        return np.zeros(k), np.zeros((k, P))
    head = replace(part, y=part.y[:last], W=part.W[:last], phi=part.phi[:last], psi=part.psi[:last])
    found = errors(shape, head, theta, slopes=1)
    if not found.finite:
        return None
    e, J = found.e[shape.lag :], found.J[shape.lag :, P:]
    weight = np.ones(k)
    weight[: k - shape.ma] = _STATES
    H = J.T @ J + np.diag(weight)
    w = np.asarray(np.linalg.solve(H, J.T @ e), dtype=np.float64)
    if not slopes:
        return w, np.zeros((k, P))

    def by_theta(start: Array) -> Array:
        return errors(shape, head, theta, start, slopes=2).J[shape.lag :, :P]

    at, right = by_theta(w), np.empty((k, P))
    rest = e - J @ w
    for i in range(k):  # J is linear in w too, so that a difference over any step is its derivative
        right[i] = rest @ (by_theta(w + np.eye(k)[i]) - at)
    return w, np.asarray(np.linalg.solve(H, right - J.T @ at), dtype=np.float64)


# --- settings ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class LpvOptions:
    """What an LPV fit may be given. None: to be chosen."""

    schedule: str = text(
        "scheduling signal: an input, the output, or level (set point: output, low-passed); level", LEVEL
    )
    time_constant: float | None = number(
        "of the low-pass of level, in s; chosen, at least five of the plant's own", 0.0, 1e9
    )
    exciting: str = choice("yes where the scheduling input acts on the output as well; no", "no", "yes")
    order: int = whole("of the system model; 2", 1, 10, 2)
    nb: int | None = whole("coefficients of each input; order", 0, 50)
    nk: int = whole("smallest lag of the inputs; 1", 0, 1000, 1)
    degree: int | None = whole("of the coefficients in the scheduling signal; chosen, up to 3", 0, 8)
    criterion: str = choice("what chooses the degree: aicc, aic, bic; aicc", "aicc", "aic", "bic")
    basis: str = choice("legendre (polynomials) or hats (piecewise linear, degree pieces); legendre", *BASES)
    form: str = choice(
        "output (noise on the output) or equation (noise in it; unstable plants); chosen by bic",
        *("auto", "equation", "output"),
    )
    error_order: int | None = whole("of the error model, 0 for white noise; 5", 0, 20)
    error_form: str = choice("ar, ma, arma; chosen by bic", "auto", "white", "ar", "ma", "arma")
    error_degree: int = whole("of the error model's coefficients in the scheduling signal; 0", 0, 8, 0)
    iterations: int = whole("of each search, at most; 60", 1, 2000, 60)


@dataclass(frozen=True, slots=True, kw_only=True)
class LpvSettings(LpvOptions):
    """Settings of an LPV fit, completed."""

    nb: int
    error_order: int
    column: int  # which input the schedule names; -1 for the output
    columns: tuple[int, ...]  # which inputs excite

    def as_mapping(self) -> dict[str, object]:
        """Return the settings by the names that the register has for them; those left open are missing."""
        return {f.name: v for f in fields(LpvOptions) if (v := getattr(self, f.name)) is not None}


def lpv_settings(given: Mapping[str, object], first: IOData) -> LpvSettings:
    """Check settings beside one of the records, and complete them."""
    s = read_settings(LpvOptions, "lpv", given)
    if first.n_outputs != 1:
        raise EstimationError(
            f"lpv takes one output, not {', '.join(first.outputs)}; fit them one after the other, with the same "
            "schedule. Name one"
        )
    column = schedule_column(s.schedule, first)
    excites = s.exciting == "yes"
    if excites and column < 0:
        raise EstimationError(
            f"lpv: exciting = yes says that the scheduling input excites, but schedule = {s.schedule} is none. Leave "
            "it out"
        )
    if s.time_constant and s.schedule != LEVEL:
        raise EstimationError(
            f"lpv: time_constant is that of schedule = level; with schedule = {s.schedule} the column is taken as it "
            "is. Leave it out"
        )
    order = s.error_order
    if order is None:
        order = 0 if s.error_form == "white" else 5
    if order > 0 and s.error_form == "white":
        raise EstimationError(f"lpv: error_form = white has no coefficients, but error_order = {order}. Leave one out")
    if order == 0 and s.error_degree:  # any form of order 0 is white noise
        raise EstimationError(
            f"lpv: error_degree = {s.error_degree} is of the error model's coefficients, and error_order = 0 leaves "
            "none. Leave one out"
        )
    completed: dict[str, Any] = {
        **asdict(s),
        "error_order": order,
        "nb": s.order if s.nb is None else s.nb,
        "time_constant": s.time_constant if s.schedule == LEVEL else 0.0,
        "column": column,
        "columns": tuple(k for k in range(first.n_inputs) if k != column or excites),
    }
    return LpvSettings(**completed)
