"""The equations of an LPV model on scaled signals, its predictor, the model, and what it is where p stands still.

p is an input column (now), the output (last), or ``level``: the set point, a causal first-order low-pass of the output
before the sample; scaled to -1 ... 1, coefficients are sums of its Legendre polynomials. Equation form: A(q, p) y =
B(q, p) u + c(p) + v; output form: A(q, p) x = B(q, p) u + c(p), y = x + v; both D(q) v = C(q) e. Coefficients at t
stand before shifted signals, (A y)(t) = y(t) + a_1(p(t)) y(t - 1) + ... (Toth 2010, sec. 3.1: static dependence,
shifted form); operators do not commute with p: with p(t - k) it is another model. Output-form states and first
innovations, w, minimise |e(theta, w)|^2 + w' Lambda w, e linear in w, Lambda from their size beside the innovations':
else a zero of C near the unit circle keeps their error alive. Fits project them out (Golub and Pereyra 1973; Jacobian
as in Kaufman 1975).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.model import root_derivative, roots_of, stable
from ambid.errors import EstimationError
from ambid.estimation.estimate import fields_json, read_as
from ambid.estimation.linear import triangle_of
from ambid.nonlinear.records import ScaledModel, read_numbers, scaled, with_head

Complex = NDArray[np.complex128]

LEVEL = "level"
STEP = 1e-3  # of the logarithm of a time constant, for a slope by differences
_EACH = 4  # samples for each number that stands for what was before
_STATES = 0.01  # variance of an innovation over that of what a state differs by
_FAR = 1e6  # times the typical size of the output: a recursion that is beyond has diverged

# --- schedule ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Schedule:
    """A scheduling signal."""

    name: str  # of the column; ``level`` for the set point
    column: int  # which input it is; -1 where it is made of the output
    # of the low-pass; 0 for the last value of the output itself. Without meaning for a column of the inputs.
    time_constant: float = 0.0
    low: float = 0.0  # range in training
    high: float = 0.0

    @property
    def middle(self) -> float:
        """Middle of the range, SI."""
        return 0.5 * (self.low + self.high)

    @property
    def half(self) -> float:
        """Half the range, SI."""
        return 0.5 * (self.high - self.low)

    def share(self, dt: float) -> float:
        """Return the weight of the newest output in the low-pass; 0 for a column of the inputs, which has none."""
        if self.column >= 0:
            return 0.0
        return 1.0 if self.time_constant <= 0 else -math.expm1(-dt / self.time_constant)

    def signal(self, u: Array, y: Array, dt: float) -> Array:
        """Return the scheduling signal (n_samples,) in SI; its low-pass begins as the mean of all samples so far."""
        from scipy.signal import lfilter

        if self.column >= 0:
            return np.ascontiguousarray(u[:, self.column])
        share, level = self.share(dt), np.empty(y.shape[0])
        n = min(y.shape[0], max(int(1.0 / share), 1))
        level[:n] = np.cumsum(y[:n, 0]) / np.arange(1.0, n + 1.0)
        if n < y.shape[0]:
            level[n:] = lfilter([share], [1.0, share - 1.0], y[n:, 0], zi=[(1.0 - share) * level[n - 1]])[0]
        return np.concatenate([y[:1, 0], level[:-1]])

    def over(self, records: Sequence[IOData], time_constant: float) -> Schedule:
        """Return the schedule with a low-pass, and the range that it then has in the records."""
        schedule = replace(self, time_constant=time_constant)
        whole = np.concatenate([schedule.signal(x.u, x.y, x.dt)[1:] for x in records])
        low, high = float(whole.min()), float(whole.max())
        if not high - low > 1e-12 * max(abs(low), abs(high)):
            raise EstimationError(
                f"lpv: the scheduling signal {self.name!r} is constant at {low:g}; the model cannot be "
                "distinguished from a linear one. Give records at several set points, or fit a linear structure "
                "(bj, ararmax)"
            )
        return replace(schedule, low=low, high=high)

    def scaled(self, p: Array | float) -> Array:
        """Return p as the functions of it take it, -1 to 1 in training."""
        return np.asarray((np.asarray(p, dtype=np.float64) - self.middle) / self.half)


def basis_values(s: Array, n: int) -> Array:
    """Return `n` Legendre polynomials (degree + 1) of the scaled scheduling signal, (n_samples, n)."""
    return np.asarray(np.polynomial.legendre.legvander(s, n - 1))


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
    degree: int  # functions of p less one, in A, B, c
    form: str  # whether v enters the difference equation or the output
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
        return self.n_process_theta + self.ar + self.ma

    @property
    def n_states(self) -> int:
        """States of the output form before a record."""
        return self.order if self.form == "output" else 0

    @property
    def n_start(self) -> int:
        """Numbers that stand for what was before a record: states of the output form, first innovations."""
        return self.n_states + self.ma

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
        places = [self.place(k) for k in range(len(self.coefficients))]
        return tuple(
            f"{x}[{j}]" for x, at in zip(self.coefficients, places, strict=True) for j in range(at.stop - at.start)
        )

    def place(self, coefficient: int) -> slice:
        """Return where the parameters of a coefficient stand in theta, by its number in `coefficients`."""
        K, last, over = self.degree + 1, self.n_process_theta, coefficient - self.n_process
        if over < 0:
            return slice(coefficient * K, min((coefficient + 1) * K, last))
        return slice(last + over, last + over + 1)

    def split(self, theta: Array) -> tuple[Array, Array, Array, Array]:
        """Return coefficients by function of p, of A (order, K) and of inputs and constant; and those of D and C."""
        n, K = self.n_process_theta, self.degree + 1
        columns = np.append(theta[:n], np.zeros(self.n_process * K - n)).reshape(-1, K)
        return columns[: self.order], columns[self.order :], theta[n : n + self.ar], theta[n + self.ar :]

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

    def rows(self, part: Part, z: Array, first: int) -> Array:
        """Return the regressors of A (past values of z), B and the constant from sample `first` on."""
        n, phi = z.size, part.phi[first:]
        columns = [-z[first - k : n - k, None] * phi for k in range(1, self.order + 1)]
        columns += [part.W[first:, i, None] * phi for i in range(part.W.shape[1] - 1)]
        return np.hstack([*columns, phi[:, : self.n_offset]])

    def is_stable(self, theta: Array) -> bool:
        """Whether the frozen process part is stable over the range of p."""
        s = np.linspace(-1.0, 1.0, 4 * self.degree + 1)
        rows = basis_values(s, self.degree + 1) @ self.split(theta)[0].T
        return all(stable(np.concatenate([[1.0], row])) for row in rows)

    def is_sound(self, theta: Array) -> bool:
        """Whether C, and in the output form A over the range of p, is stable. A finite run does not say so: the fitted
        past can balance a mode that grows.
        """
        if self.ma and not stable(np.concatenate([[1.0], self.split(theta)[3]])):
            return False
        return self.form == "equation" or self.is_stable(theta)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """One record, ready for a shape."""

    y: Array  # (n_samples,), scaled
    W: Array  # (n_samples, n_w), lagged inputs and ones
    phi: Array  # functions of the scheduling signal

    def head(self, n: int) -> Part:
        """Return the first samples."""
        return Part(y=self.y[:n], W=self.W[:n], phi=self.phi[:n])


def part_of(shape: LpvShape, y: Array, u: Array, s: Array) -> Part:
    """Prepare a scaled record."""
    phi = basis_values(s, shape.degree + 1)
    return Part(y=np.ascontiguousarray(y), W=shape.lagged_inputs(u), phi=phi)


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
    """Run a record through the predictor from `start`, what was before (default zeros); `slopes`: 0 for none, 1 by
    `start`, 2 for all.
    """
    y, m, lag, P = part.y, shape.first, shape.lag, shape.n_theta
    n, n_x, n_p, ma = y.size, shape.n_states, shape.n_process_theta, shape.ma
    start = np.zeros(shape.n_start) if start is None else start
    if n <= lag:
        return Errors(finite=True, x=y, g=np.zeros(n), e=np.zeros(n), J=np.zeros((n, P + shape.n_start)))
    a, b, d, c = shape.split(theta)
    own, x, g, e = -(part.phi[m:] @ a.T), y.copy(), np.zeros(n), np.zeros(n)
    x[m - n_x : m] += start[:n_x][::-1]
    if n_x:
        _pass_on(x[:, None], own, np.sum(part.W[m:] * (part.phi[m:] @ b.T), axis=1)[:, None])
    else:
        x[m:] = shape.rows(part, y, m) @ theta[:n_p]
    v = y - x
    noise = np.concatenate([start[n_x:][::-1], np.empty(n - lag)])  # innovations from `ma` before the first on
    past = sum((d[k] * _back(v, lag, k + 1) for k in range(shape.ar)), np.zeros(n - lag))
    _pass_on(noise[:, None], -c[None], (v[lag:] + past)[:, None])
    e[lag:], g[lag:] = noise[ma:], x[lag:] - past + sum(c[k] * _back(noise, ma, k + 1) for k in range(ma))
    finite = bool(np.all(np.abs(x[m:]) < _FAR) and np.all(np.abs(noise) < _FAR))
    if not slopes or not finite:
        return Errors(finite=finite, x=x, g=g, e=e, J=np.zeros((0, 0)))
    dx, dg = np.zeros((n, P + shape.n_start)), np.zeros((n - lag + ma, P + shape.n_start))
    if slopes == 2:
        dx[m:, :n_p] = shape.rows(part, x if n_x else y, m)
    if n_x:
        dx[m - 1 - np.arange(n_x), P + np.arange(n_x)] = 1.0
        _pass_on(dx, own, dx[m:])
    dg[ma - 1 - np.arange(ma), P + n_x + np.arange(ma)] = -1.0
    dg[ma:] = sum((d[k] * _back(dx, lag, k + 1) for k in range(shape.ar)), dx[lag:])
    if slopes == 2:
        for k in range(shape.ar):
            dg[ma:, n_p + k] = -_back(v, lag, k + 1)
        for k in range(ma):
            dg[ma:, n_p + shape.ar + k] = _back(noise, ma, k + 1)
    _pass_on(dg, -c[None], dg[ma:])
    return Errors(finite=True, x=x, g=g, e=e, J=np.concatenate([np.zeros((lag, dg.shape[1])), dg[ma:]]))


def _back(z: Array, first: int, lag: int) -> Array:
    """The values from sample `first` on, so many samples late."""
    return z[first - lag : z.shape[0] - lag]


def _pass_on(out: Array, gain: Array, rows: Array) -> None:
    """Fill the last rows of `out` with some rows and what is passed on to each, by lag, from those before it."""
    from ambid.nonlinear.kernels import propagate

    first, lags = out.shape[0] - rows.shape[0], np.arange(1, gain.shape[1] + 1)
    out[first:] = rows
    if lags.size:
        propagate(out[:, None], np.ascontiguousarray(gain)[:, None], np.zeros_like(lags), lags, first)


# --- prediction errors ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LpvProblem:
    """What is searched in (a `estimation.search.Problem`)."""

    shape: LpvShape
    parts: tuple[Part, ...]  # by record
    first: int  # errors count from this sample on
    weight: float = 1.0  # one over the standard deviation of the errors
    # by record: the same with set points a little slower and faster, where the logarithm of their time constant counts
    # as one more number
    beside: tuple[tuple[Part, Part], ...] = ()

    @property
    def n_errors(self) -> int:
        """Samples that count."""
        return sum(max(p.y.size - self.first, 0) for p in self.parts)

    @property
    def freedom(self) -> float:
        """Samples less estimated numbers, those of the starts included; at least 1."""
        return max(float(self.n_errors - self.shape.n_theta - len(self.parts) * self.shape.n_start), 1.0)

    def cost(self, theta: Array) -> float:
        """Return the sum of squared weighted innovations; infinite where the predictor is unstable."""
        total = 0.0
        if not self.shape.is_sound(theta):
            return np.inf
        for part in self.parts:
            e = self._project(part, theta)[1]
            if e is None:
                return np.inf
            total += float(e @ e)
        return total * self.weight**2

    def triangle(self, theta: Array) -> Array:
        """Return the triangle of [J | e] without what the starts explain; NaN where the predictor diverges."""
        P, k, rows = self.shape.n_theta, self.shape.n_start, list[Array]()
        for r, part in enumerate(self.parts):
            start, e = self._project(part, theta)
            run = None if e is None else errors(self.shape, part, theta, start, slopes=2)
            if run is None or not run.finite:
                return np.full((P + 1, P + 1 + bool(self.beside)), np.nan)
            J = [run.J[:, P:], run.J[:, :P]]
            for slower, faster in self.beside[r : r + 1]:
                later, sooner = (errors(self.shape, x, theta, start).g for x in (slower, faster))
                J.append((later - sooner)[:, None] / (2.0 * STEP))
            R = triangle_of([np.column_stack([*J, run.e])[self.first :]])
            rows.append(np.asarray(np.linalg.qr(R, mode="r"))[k:, k:])
        return triangle_of(rows) * self.weight

    def _project(self, part: Part, theta: Array) -> tuple[Array, Array | None]:
        """Start that explains most, and the innovations with it."""
        k, P = self.shape.n_start, self.shape.n_theta
        run = errors(self.shape, part, theta, slopes=1 if k else 0)
        if not run.finite:
            return np.zeros(k), None
        e = run.e[self.first :]
        if not k:
            return np.zeros(0), e
        J = run.J[self.first :, P:]
        if not np.all(np.isfinite(J)):
            return np.zeros(k), None
        R = triangle_of([np.column_stack([J, e])])
        start = np.asarray(np.linalg.lstsq(R[:, :-1], R[:, -1], rcond=1e-9)[0], dtype=np.float64)
        return start, e - J @ start


# --- what was before a record -----------------------------------------------------------------------------------------


def settling(shape: LpvShape) -> int:
    """Return the samples, beyond those that a prediction looks back over, from which a beginning is estimated."""
    return _EACH * shape.n_start


def looks_back(shape: LpvShape) -> int:
    """Return the samples of the past that a prediction needs, those of the beginning included."""
    return shape.lag + settling(shape)


def beginning(shape: LpvShape, part: Part, theta: Array, *, slopes: bool = False) -> tuple[Array, Array] | None:
    """Estimate what was before a record, and its derivative by theta (zeros unless asked); None where it diverges."""
    k, P = shape.n_start, shape.n_theta
    last = looks_back(shape)
    if not k or part.y.size < last:
        return np.zeros(k), np.zeros((k, P))
    head = part.head(last)
    run = errors(shape, head, theta, slopes=1)
    if not run.finite:
        return None
    e, J = run.e[shape.lag :], run.J[shape.lag :, P:]
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


# --- where p stands still ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frozen:
    """The linear model y = (B/A) u + offset/A(1) + v at one p; for a p of the output, of movements fast beside its
    low-pass.
    """

    a: Array  # (order + 1,), of q^0, q^-1, ...; the first is 1
    b: Array  # (n_exciting, nb), SI, of q^-nk,
    # (order,), complex, rad/s, log(z)/dt of the roots z of A, largest real part first; -inf for a root at 0
    poles: Complex
    dc_gain: Array  # (n_exciting,), SI, B(1)/A(1); negative behind an unstable pole
    a_sd: Array | None = None  # standard deviations; None without a covariance
    b_sd: Array | None = None
    poles_sd: Complex | None = None  # (order,), complex, rad/s, or None, of real and imaginary part
    dc_gain_sd: Array | None = None  # (n_exciting,), SI, or None

    @property
    def stable(self) -> bool:
        """Whether all poles are in the left half plane."""
        return bool(np.all(self.poles.real < 0))


# --- model ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class LpvModel(ScaledModel):
    """A linear model of one output with scheduled coefficients (an `ambid.nonlinear.fit.NonlinearModel`): `theta`
    weighs the functions of p, the past comes from the first `lag` samples (`beginning`), the cloud is of regressors and
    schedule.
    """

    dt: float  # s
    shape: LpvShape
    schedule: Schedule

    @property
    def kind(self) -> str:
        """Under which files know it."""
        return "lpv"

    @property
    def lag(self) -> int:
        """Samples of the past that a prediction needs."""
        return looks_back(self.shape)

    @property
    def names(self) -> tuple[str, ...]:
        """Coefficient and number of the function of p."""
        return self.shape.names

    @cached_property
    def unit(self) -> Array:
        """What a scaled parameter of 1 is in SI, shape (n_theta,)."""
        shape = self.shape
        out, y = np.ones(shape.n_theta), float(self.y_scale[0])
        for i, column in enumerate(shape.columns):
            for k in range(shape.nb):
                out[shape.place(shape.order + i * shape.nb + k)] = y / self.u_scale[column]
        out[shape.place(shape.n_process - 1)] = y
        return out

    def at(self, p: float, covariance: Array | None = None) -> Frozen:
        """Return the linear model at one p, with deviations by `covariance`; outside ``schedule.low`` to
        ``schedule.high`` the functions of p are continued, which nothing backs.
        """
        shape, s = self.shape, self.schedule.scaled(float(p)).reshape(1)
        na, nb, m = shape.order, shape.nb, len(shape.columns)
        G = np.zeros((shape.n_process - 1, shape.n_theta))
        for k in range(shape.n_process - 1):
            G[k, shape.place(k)] = basis_values(s, shape.degree + 1)[0]
        values = G @ self.theta
        a, b = np.concatenate([[1.0], values[:na]]), values[na:].reshape(m, nb)
        z = roots_of(a)
        with np.errstate(divide="ignore", invalid="ignore"):
            poles = np.where(z == 0, -np.inf, np.log(np.where(z == 0, 1.0, z)) / self.dt)
            gain = b.sum(axis=1) / a.sum()
            slope = root_derivative(a, z)[:, 1:] / (z * self.dt)[:, None]
        turn = np.lexsort((-poles.imag, -poles.real))
        frozen = Frozen(a=a, b=b, poles=poles[turn], dc_gain=gain)
        if covariance is None:
            return frozen
        P = G @ covariance @ G.T
        by_gain = np.hstack([-gain[:, None].repeat(na, axis=1), np.eye(m).repeat(nb, axis=1)]) / a.sum()
        sd = np.sqrt(np.maximum(np.diag(P), 0.0))
        return replace(
            frozen, a_sd=np.concatenate([[0.0], sd[:na]]), b_sd=sd[na:].reshape(m, nb),
            poles_sd=(_spread(slope.real, P[:na, :na]) + 1j * _spread(slope.imag, P[:na, :na]))[turn],
            dc_gain_sd=_spread(by_gain, P),
        )  # fmt: skip

    def predict(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.predict`; NaN everywhere if the predictor diverges."""
        part = self._part(u, y)
        start = beginning(self.shape, part, self.scaled_theta)
        run = None if start is None else errors(self.shape, part, self.scaled_theta, start[0])
        out = np.full((part.y.size, 1), np.nan)
        if run is not None and run.finite:
            out[self.lag :, 0] = run.g[self.lag :]
        predicted: Array = self.y_level + self.y_scale * out
        return predicted

    def jacobian(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.jacobian`."""
        part, P = self._part(u, y), self.theta.size
        start = beginning(self.shape, part, self.scaled_theta, slopes=True)
        run = None if start is None else errors(self.shape, part, self.scaled_theta, start[0], slopes=2)
        J = np.full((part.y.size, P), np.nan)
        if start is not None and run is not None and run.finite:
            J = run.J[:, :P] + run.J[:, P:] @ start[1]
        out = (J * (self.y_scale / self.unit))[:, None, :]
        out[: self.lag] = 0.0
        return np.asarray(out)

    def simulate(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.simulate`."""
        from ambid.nonlinear.kernels import scheduled_run

        whole, head = with_head(self, u, y)
        ys, us = scaled(self, u, whole)
        shape, outputs, column = self.shape, np.ascontiguousarray(ys[:, 0]), self.schedule.column
        s = np.zeros(outputs.size) if column < 0 else self.schedule.scaled(np.asarray(u, dtype=np.float64)[:, column])
        level, size = float(self.y_level[0]), float(self.y_scale[0])
        a, b, _, _ = shape.split(self.scaled_theta)
        scheduled_run(
            outputs, shape.lagged_inputs(us), np.ascontiguousarray(s), head, a, b,
            self.schedule.share(self.dt), (self.schedule.middle - level) / size, self.schedule.half / size,
        )  # fmt: skip
        out: Array = self.y_level + self.y_scale * outputs[:, None]
        out[:head] = whole[:head]
        return out

    def novelty(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.novelty`: the largest of p's, over half its range, and of ellipsoid and hull of the cloud,
        without its holes: between set points an LPV model interpolates.
        """
        ys, us = scaled(self, u, y)
        s = self.scheduling(u, y)
        out = np.full(ys.shape[0], np.nan)
        x = regressors(self.shape, ys[:, 0], us, s)
        away = x[settling(self.shape) :] - self.cloud.mean
        ellipsoid = np.linalg.norm(away @ self.cloud.whitening.T, axis=1)
        hull = np.max(away @ self.cloud.faces.T, axis=1, initial=0.0)
        out[self.lag :] = np.maximum(np.abs(s[self.lag :]), np.maximum(ellipsoid, hull))
        return out

    def scheduling(self, u: Array, y: Array) -> Array:
        """Return the scheduling signal of a record in SI, scaled: -1 to 1 in training."""
        p = self.schedule.signal(np.asarray(u, dtype=np.float64), np.asarray(y, dtype=np.float64), self.dt)
        return self.schedule.scaled(p)

    def _part(self, u: Array, y: Array) -> Part:
        ys, us = scaled(self, u, y)
        return part_of(self.shape, ys[:, 0], us, self.scheduling(u, y))

    def as_json(self) -> dict[str, Any]:
        """As `NonlinearModel.as_json`."""
        parts = {"shape": fields_json(self.shape), "schedule": fields_json(self.schedule)}
        return {"dt_s": self.dt, "n_inputs": self.n_inputs, **parts, **self.numbers_json()}

    @classmethod
    def from_json(cls, document: dict[str, Any]) -> Self:
        """Read it back from what `as_json` made."""
        m, shape = int(document["n_inputs"]), read_as(LpvShape, document["shape"], "shape")
        schedule, columns = read_as(Schedule, document["schedule"], "schedule"), shape.columns
        words = shape.form in ("equation", "output") and shape.offset in ("scheduled", "constant")
        if not words or not schedule.high > schedule.low:
            raise ValueError("form, offset or range of the schedule are invalid")
        sizes = (shape.order, shape.nb, shape.nk, shape.ar, shape.ma, shape.degree)
        if not all(0 <= k < m for k in columns) or not -1 <= schedule.column < m or min(sizes) < 0:
            raise ValueError("columns or orders are invalid")
        numbers = read_numbers(document, shape.n_theta, m, 1, shape.n_process)
        return cls(dt=float(document["dt_s"]), shape=shape, schedule=schedule, **numbers)


def _spread(slopes: Array, P: Array) -> Array:
    """Standard deviations of values with these slopes."""
    sd: Array = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", slopes, P, slopes), 0.0))
    return sd


def regressors(shape: LpvShape, y: Array, u: Array, s: Array) -> Array:
    """Return what predictions depend on, from sample `lag` on: past outputs, inputs, scheduling signal; all scaled."""
    n, lag = y.size, shape.lag
    if n <= lag:
        return np.empty((0, shape.n_process))
    past = [y[lag - k : n - k] for k in range(1, shape.order + 1)]
    return np.column_stack([*past, shape.lagged_inputs(u)[lag:, :-1], s[lag:]])
