"""Degree, form and error model of an LPV fit: candidates started, fitted and compared.

Starts come from least squares without an error model, and from the pseudo-linear regression of extended least squares
(Ljung 1999, sec. 10.1): with v and e of an earlier fit in place of the true ones, the predictor is linear in all
coefficients. Innovations are linear in what was before a record (states of the output form, first innovations), so that
for each theta these numbers are solved for, and their columns projected out (Golub and Pereyra 1973; Jacobian as in
Kaufman 1975).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.roots import reflect, roots_of
from ambid.estimation.linear import triangle_of
from ambid.estimation.progress import Tick, guessed, portions
from ambid.estimation.search import search
from ambid.nonlinear.fit import LearningCurve
from ambid.nonlinear.lpv.shape import (
    LpvSettings,
    LpvShape,
    Part,
    Schedule,
    basis_values,
    errors,
    is_sound,
    is_stable_process,
    looks_back,
    part_of,
    schedule_over,
)
from ambid.nonlinear.records import Scaled

_SLOWER = 5.0  # times the slowest time constant of the linear model: what is frozen may be taken as standing still
_LEAST, _MOST = 10.0, 0.2  # low-pass: samples at least, part of the shortest record at most
_GRID = 3.0
_CLEAR = 10.0  # difference of the criterion from which a faster set point is taken
_BLIND = 1e-10
_LONG, _ROWS = 4, 20  # lags of the long regression, times the order of C; samples for each of its numbers
_DEGREES = (0, 1, 2, 3)
_USUAL = 8.0  # iterations, half of what a search takes
_FEWEST = 20  # predictions that the shortest record has to leave for a form to be tried
_ENOUGH = 0.5  # gain of a candidate's criterion by an iteration below which it is judged

# --- what is chosen where nothing is said -----------------------------------------------------------------------------


def information(criterion: str, cost: float, n: int, k: int, starts: int = 0) -> float:
    """Return an information criterion of `k` numbers from `n` samples, infinite where these fit anything."""
    if not np.isfinite(cost) or cost < 0 or n <= k + starts + 1:
        return math.inf
    each = math.log(n) if criterion == "bic" else 2.0
    if criterion == "aicc":
        each *= n / (n - k - 1)
    return n * math.log(max(cost / n, 1e-300)) + k * each + 2.0 * starts


def error_orders(form: str, order: int) -> tuple[tuple[int, int], ...]:
    """Return orders of D and C to try."""
    if order == 0:
        return ((0, 0),)
    found = {"ar": (order, 0), "ma": (0, order), "arma": (order, order)}
    return tuple(found.values()) if form == "auto" else (found[form],)


def time_constants(slowest: float, shortest: int, dt: float) -> list[float]:
    """Return low-passes of the set point to try, in s: so slow that it stands still beside the plant's movements.

    `slowest`, the largest time constant of the linear model, and `shortest`, of the records, are in samples.
    """
    top = max(_MOST * shortest, _LEAST)
    low = min(max(_SLOWER * slowest, _LEAST), top)
    return [dt * low * _GRID**k for k in range(12) if low * _GRID**k <= top]


def slowest_that_does(grid: Sequence[float], values: Sequence[float]) -> float:
    """Return the slowest set point that explains the data about as well as the best, by the criterion of each."""
    least = min(values)
    return max(x for x, value in zip(grid, values, strict=True) if not value > least + _CLEAR)


def slowest_mode(a: Array) -> float:
    """Return the largest time constant, in samples, of a polynomial in q^-1, stable or not."""
    z = roots_of(a)
    size = np.abs(np.log(np.where(z == 0, 1e-6, z)))
    return float(1.0 / max(float(size.min()), 1e-6))


# --- prediction errors ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LpvProblem:
    """What is searched in (a `estimation.search.Problem`)."""

    shape: LpvShape
    parts: tuple[Part, ...]  # by record
    first: int  # errors count from this sample on
    weight: float = 1.0  # one over the standard deviation of the errors

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
        if not is_sound(self.shape, theta):
            return np.inf
        for part in self.parts:
            e = self._solve(part, theta)[1]
            if e is None:
                return np.inf
            total += float(e @ e)
        return total * self.weight**2

    def triangle(self, theta: Array) -> Array:
        """Return the triangle of [J | e] without what the starts explain; NaN where the predictor diverges."""
        P, k, rows = self.shape.n_theta, self.shape.n_start, list[Array]()
        for part in self.parts:
            start, e = self._solve(part, theta)
            found = None if e is None else errors(self.shape, part, theta, start, slopes=2)
            if found is None or not found.finite:
                return np.full((P + 1, P + 1), np.nan)
            J = found.J[self.first :]
            R = triangle_of([np.column_stack([J[:, P:], J[:, :P], found.e[self.first :]])])
            rows.append(np.asarray(np.linalg.qr(R, mode="r"))[k:, k:])
        return triangle_of(rows) * self.weight

    def _solve(self, part: Part, theta: Array) -> tuple[Array, Array | None]:
        """Start that explains most, and the innovations with it."""
        k, P = self.shape.n_start, self.shape.n_theta
        found = errors(self.shape, part, theta, slopes=1 if k else 0)
        if not found.finite:
            return np.zeros(k), None
        e = found.e[self.first :]
        if not k:
            return np.zeros(0), e
        J = found.J[self.first :, P:]
        if not np.all(np.isfinite(J)):
            return np.zeros(k), None
        R = triangle_of([np.column_stack([J, e])])
        start = np.asarray(np.linalg.lstsq(R[:, :-1], R[:, -1], rcond=1e-9)[0], dtype=np.float64)
        return start, e - J @ start


# --- starts by least squares ------------------------------------------------------------------------------------------


def least_squares(shape: LpvShape, parts: Sequence[Part], first: int) -> tuple[Array, float]:
    """Fit A y = B u + c + e, all coefficients functions of p, by equations from sample `first` on.

    Returns all parameters, those of the error model zero, and the sum of squared errors.
    """
    n = shape.n_process_theta
    found, cost = _solve([_process_rows(shape, p, p.y, first) for p in parts], [p.y[first:] for p in parts])
    theta = np.zeros(shape.n_theta)
    theta[:n] = found
    return theta, cost


def from_earlier(
    shape: LpvShape,
    parts: Sequence[Part],
    first: int,
    old: LpvShape,
    theta: Array,
    earlier: Sequence[Part] | None = None,
) -> tuple[Array, float] | None:
    """Fit all coefficients with errors and innovations of an earlier model in place of the true ones.

    `earlier` are the records made for that model, where its functions of p are others. Returns parameters and the sum
    of squared errors of this regression; None where the earlier model diverges.
    """
    rows, targets = [], []
    for part, before in zip(parts, earlier or parts, strict=True):
        found = errors(old, before, theta)
        if not found.finite:
            return None
        v = part.y - found.x
        n = part.y.size
        by = [_process_rows(shape, part, found.x if shape.form == "output" else part.y, first)]
        for signal, size in ((-v, shape.ar), (found.e, shape.ma)):
            by += [signal[first - k : n - k, None] * part.psi[first:] for k in range(1, size + 1)]
        rows.append(np.hstack(by))
        targets.append(part.y[first:])
    return _solve(rows, targets)


def by_long_regression(shape: LpvShape, parts: Sequence[Part], first: int) -> Array:
    """Fit an equation with moving-average errors: innovations by a long regression, then one with their lags.

    Zeros of C outside the unit circle are reflected where C does not depend on p (Hannan and Rissanen 1982).
    """
    n, inputs = sum(p.y.size for p in parts), len(shape.columns)
    spare = min(p.y.size for p in parts) - first - shape.ma
    if spare < 1:
        return np.zeros(shape.n_theta)
    lags = min(_LONG * shape.ma, n // (_ROWS * (1 + inputs) * (shape.degree + 1)), spare // 4)
    rows, targets = [], []
    for p in parts:
        begin, end = first + lags, p.y.size
        by = [-p.y[begin - k : end - k, None] * p.phi[begin:] for k in range(1, shape.order + lags + 1)]
        for i in range(inputs):  # the first lag of each input, put back further
            newest = p.W[:, i * shape.nb, None]
            by += [newest[begin - k : end - k] * p.phi[begin:] for k in range(shape.nb + lags)]
        rows.append(np.hstack([*by, p.phi[begin:, : shape.n_offset]]))
        targets.append(p.y[begin:])
    long = _solve(rows, targets)[0]
    again, goal = [], []
    for p, X, t in zip(parts, rows, targets, strict=True):
        e, begin = t - X @ long, first + lags
        by = [e[shape.ma - k : e.size - k, None] * p.psi[begin + shape.ma :] for k in range(1, shape.ma + 1)]
        again.append(np.hstack([_process_rows(shape, p, p.y, begin + shape.ma), *by]))
        goal.append(t[shape.ma :])
    theta = _solve(again, goal)[0]
    if not shape.error_degree:
        theta[-shape.ma :] = reflect(np.concatenate([[1.0], theta[-shape.ma :]]))[1:]
    return theta


def carry_over(shape: LpvShape, old: LpvShape, theta: Array) -> Array:
    """Carry a model over to one with other functions of p, or with another error model.

    Coefficients are as near as can be over the range of p; zeros where the old model has none.
    """
    grid = np.linspace(-1.0, 1.0, 33)

    def carried(values: Array, n: int) -> Array:
        before, after = (basis_values(grid, k, shape.basis) for k in (values.size, n))
        return np.asarray(np.linalg.lstsq(after, before @ values, rcond=None)[0], dtype=np.float64)

    out = np.zeros(shape.n_theta)
    known = {name: k for k, name in enumerate(old.coefficients)}
    for k, name in enumerate(shape.coefficients):
        if name in known:
            source, target = theta[old.place(known[name])], shape.place(k)
            n = target.stop - target.start
            out[target] = source if n == source.size else carried(source, n)
    return out


def without_error_model(shape: LpvShape) -> LpvShape:
    """Return the same equation with white errors."""
    return replace(shape, ar=0, ma=0, form="equation")


def _process_rows(shape: LpvShape, part: Part, z: Array, first: int) -> Array:
    """Regressors of A, B and the constant from sample `first` on."""
    n = part.y.size
    phi = part.phi[first:]
    by = [-z[first - k : n - k, None] * phi for k in range(1, shape.order + 1)]
    by += [part.W[first:, i, None] * phi for i in range(part.W.shape[1] - 1)]
    return np.hstack([*by, phi[:, : shape.n_offset]])


def _solve(rows: Sequence[Array], targets: Sequence[Array]) -> tuple[Array, float]:
    """Least squares on columns of unit length, by QR and singular values."""
    R = triangle_of([np.column_stack([X, t]) for X, t in zip(rows, targets, strict=True)])
    if not np.all(np.isfinite(R)):
        return np.zeros(R.shape[1] - 1), np.inf
    size = np.maximum(np.linalg.norm(R[:, :-1], axis=0), 1e-150)
    found = np.linalg.lstsq(R[:, :-1] / size, R[:, -1], rcond=_BLIND)[0]
    rest = R[:, -1] - (R[:, :-1] / size) @ found
    return found / size, float(rest @ rest)


# --- candidates -------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class Fitting:
    """What a fit has come to, so that an interruption loses nothing."""

    data: Scaled
    records: Sequence[IOData]
    schedule: Schedule
    shape: LpvShape
    theta: Array  # (n_theta,), scaled
    first: int  # errors count from this sample on
    status: Literal["converged", "stalled"] = "converged"
    curves: list[LearningCurve] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    tried: list[Candidate] = field(default_factory=list)
    timing_s: dict[str, float] = field(default_factory=dict)

    def parts(self, shape: LpvShape, schedule: Schedule | None = None) -> tuple[Part, ...]:
        """Return the records, ready for a shape, with the schedule of the fit or another."""
        of = schedule or self.schedule
        return tuple(
            part_of(shape, y[:, 0], u, of.scaled(of.signal(x.u, x.y, x.dt)))
            for x, (y, u) in zip(self.records, self.data.parts, strict=True)
        )

    def problem(self, shape: LpvShape, weight: float = 1.0) -> LpvProblem:
        """Return what is searched in for a shape; `weight` is one over the standard deviation of the errors."""
        return LpvProblem(shape=shape, parts=self.parts(shape), first=self.first, weight=weight)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidate:
    """A fitted shape."""

    shape: LpvShape
    theta: Array  # (n_theta,), scaled
    cost: float = np.inf  # sum of squared one-step errors, scaled; infinite where the predictor is unstable
    n: int = 1  # errors, and numbers that stand for what was before the records
    starts: int = 0

    def value(self, criterion: str) -> float:
        """Return an information criterion.

        Returns the smaller the better.
        """
        return information(criterion, self.cost, self.n, self.shape.n_theta, self.starts)

    def summary(self) -> dict[str, object]:
        """Return what it is and how good, for the details of a fit."""
        of, found = self.shape, {k: v if np.isfinite(v := self.value(k)) else None for k in ("aicc", "bic")}
        return {"form": of.form, "degree": of.degree, "ar": of.ar, "ma": of.ma, **found}


def search_from(
    fitting: Fitting, shape: LpvShape, theta: Array, most: int, tick: Tick | None, stage: str, *, last: bool = False
) -> Candidate:
    """Search from a start; the cost is infinite where the predictor is unstable there."""
    problem = fitting.problem(shape)
    cost = problem.cost(theta)
    if not np.isfinite(cost):
        return Candidate(shape=shape, theta=theta)
    weight = 1.0 / max(np.sqrt(cost / max(problem.n_errors, 1)), 1e-12)
    problem = replace(problem, weight=float(weight))
    count = 0

    def counted(_: str, done: float | None = None, /) -> None:
        nonlocal count
        del done
        if tick is not None:
            tick(stage, guessed(count, _USUAL))
        count += 1

    def keep(found: Array) -> None:
        if last:
            fitting.theta = found

    found = search(
        problem,
        theta,
        stage=stage,
        most=most,
        tolerance=1e-9,
        enough=1e-4 if last else _ENOUGH,
        tick=counted,
        keep=keep,
    )
    if last:
        fitting.theta, fitting.status = found.theta, "converged" if found.converged else "stalled"
        fitting.curves.append(
            LearningCurve(
                method="Levenberg-Marquardt, prediction errors",
                seconds=np.array(found.seconds),
                training=np.sqrt(np.array(found.costs) / problem.n_errors) / weight,
            )
        )
    starts = len(problem.parts) * shape.n_start
    return Candidate(shape=shape, theta=found.theta, cost=found.cost / weight**2, n=problem.n_errors, starts=starts)


def _note(fitting: Fitting, x: Candidate) -> Candidate:
    fitting.tried.append(x)
    return x


def choose_level(s: LpvSettings, fitting: Fitting, tick: Tick | None) -> float:
    """Choose the low-pass of the set point, in s.

    A linear model with moving-average errors says how slow the plant is; pseudo-linear regressions with its errors
    compare what coefficients that follow each set point explain.
    """
    white = replace(fitting.shape, degree=0, error_degree=0, ar=0, ma=0)
    shape = replace(white, ma=s.error_order)
    starts: list[Array | None] = [
        carry_over(shape, white, least_squares(white, fitting.parts(white), fitting.first)[0])
    ]
    if s.error_order:
        starts.append(by_long_regression(shape, fitting.parts(shape), fitting.first))
    linear = _from_best(s, fitting, shape, starts, tick, "set point")
    a = np.concatenate([[1.0], linear.theta[: shape.order]])
    dt, shortest = fitting.records[0].dt, min(x.n_samples for x in fitting.records)
    grid = time_constants(slowest_mode(a), shortest, dt)
    degree = 2 if s.degree is None else max(s.degree, 1)
    earlier, values = fitting.parts(shape), list[float]()
    for tau in grid if len(grid) > 1 and np.isfinite(linear.cost) else ():
        of = schedule_over(fitting.records, s.schedule, s.column, tau)
        trial = replace(shape, degree=degree)
        found = from_earlier(trial, fitting.parts(trial, of), fitting.first, shape, linear.theta, earlier)
        values.append(np.inf if found is None else information("bic", found[1], linear.n, trial.n_theta))
    return slowest_that_does(grid, values) if values and np.isfinite(min(values)) else grid[0]


def by_degree(s: LpvSettings, fitting: Fitting, tick: Tick | None) -> Candidate:
    """Fit the equation form with an autoregressive error model, degree by degree; return the best."""
    degrees = _DEGREES if s.degree is None else (s.degree,)
    best = None
    for degree, own in zip(degrees, portions(tick, [1.0 + d for d in degrees]), strict=True):
        white = replace(fitting.shape, degree=degree, ar=0, ma=0)
        shape = replace(white, ar=s.error_order)
        start = carry_over(shape, white, least_squares(white, fitting.parts(white), fitting.first)[0])
        starts: list[Array | None] = [start]
        if best is not None:
            starts.append(carry_over(shape, best.shape, best.theta))
        found = _note(fitting, _from_best(s, fitting, shape, starts, own, f"degree {degree}"))
        best = _better(fitting, found, best, s.criterion)
    assert best is not None
    return best


def other_degrees(s: LpvSettings, fitting: Fitting, best: Candidate, tick: Tick | None) -> Candidate:
    """Choose the degree once more, now that form and error model are known, of which a wrong one may have decided on
    it.
    """
    degrees = [d for d in _DEGREES if d != best.shape.degree]
    if s.degree is not None or not np.isfinite(best.cost):
        return best
    for degree, own in zip(degrees, portions(tick, [1.0 + d for d in degrees]), strict=True):
        shape = replace(best.shape, degree=degree)
        start = carry_over(shape, best.shape, best.theta)
        found = _note(fitting, _from_best(s, fitting, shape, [start], own, f"degree {degree}"))
        best = _better(fitting, found, best, s.criterion)
    return best


def _better(fitting: Fitting, found: Candidate, best: Candidate | None, criterion: str) -> Candidate:
    """The better of two, which is held on to."""
    if best is not None and not found.value(criterion) < best.value(criterion):
        return best
    if np.isfinite(found.cost):
        fitting.shape, fitting.theta = found.shape, found.theta
    return found


def _from_best(
    s: LpvSettings, fitting: Fitting, shape: LpvShape, starts: Sequence[Array | None], tick: Tick | None, stage: str
) -> Candidate:
    """Search from the start with the least cost."""
    problem = fitting.problem(shape)
    ranked = sorted(((problem.cost(x), k) for k, x in enumerate(starts) if x is not None), key=lambda x: x[0])
    start = starts[ranked[0][1]]
    assert start is not None
    return search_from(fitting, shape, start, s.iterations, tick, stage)


def wanted_shapes(s: LpvSettings, base: LpvShape) -> list[LpvShape]:
    """Return a shape with the forms and error models that are asked for."""
    return [
        replace(base, form=form, ar=ar, ma=ma)
        for form in (("equation", "output") if s.form == "auto" else (s.form,))
        for ar, ma in error_orders(s.error_form, s.error_order)
    ]


def by_form(s: LpvSettings, fitting: Fitting, best: Candidate, tick: Tick | None) -> Candidate:
    """Fit the forms and error models that are asked for, with the degree of the best so far; return the best."""
    shortest = min(x.n_samples for x in fitting.records)
    wanted = [x for x in wanted_shapes(s, best.shape) if looks_back(x) + _FEWEST <= shortest]
    steps = [  # on the way to both, each alone: from there the search does not end in a poor optimum
        replace(x, ar=ar, ma=ma)
        for x in wanted
        for ar, ma in ([(x.ar, 0), (0, x.ma)] if x.ar and x.ma else []) + [(x.ar, x.ma)]
    ]
    steps = list(dict.fromkeys(steps))
    known = {best.shape: best}
    chosen = best if best.shape in wanted else None
    for shape, own in zip(steps, portions(tick, [1.0] * len(steps)), strict=True):
        if shape in known:
            continue
        earlier = [x for x in known.values() if np.isfinite(x.cost)]
        earlier.sort(key=lambda x: (x.shape.form != shape.form, x.value("bic")))
        if shape.form == "output" and s.form == "auto" and not is_stable_process(earlier[0].shape, earlier[0].theta):
            continue  # earlier[0]: the best of the equation form, or of the output form, which is stable
        parts = fitting.parts(shape)
        starts: list[Array | None] = [carry_over(shape, without_error_model(best.shape), _process(best))]
        if shape.form == "equation" and shape.ma and not shape.ar:
            starts.append(by_long_regression(shape, parts, fitting.first))
        for x in earlier[:2]:
            regression = from_earlier(shape, parts, fitting.first, x.shape, x.theta)
            starts += [carry_over(shape, x.shape, x.theta), None if regression is None else regression[0]]
        named = f"{shape.form} form, {_named(shape)}"
        found = known[shape] = _note(fitting, _from_best(s, fitting, shape, starts, own, named))
        if shape in wanted:
            chosen = _better(fitting, found, chosen, "bic")
    return chosen or best


def _process(x: Candidate) -> Array:
    return x.theta[: x.shape.n_process_theta]


def _named(shape: LpvShape) -> str:
    kinds = [f"{k} {n}" for k, n in (("AR", shape.ar), ("MA", shape.ma)) if n]
    return ", ".join(kinds) + " errors" if kinds else "white errors"
