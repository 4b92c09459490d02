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

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.roots import reflect, roots_of
from ambid.estimation.criteria import information
from ambid.estimation.linear import least_squares as solve
from ambid.estimation.linear import triangle_of
from ambid.estimation.progress import Tick, portions
from ambid.estimation.search import search
from ambid.nonlinear.fit import Attempt, LearningCurve
from ambid.nonlinear.lpv_model import LpvShape, Part, Schedule, basis_values, errors, looks_back, part_of
from ambid.nonlinear.records import Scaled

_SLOWER = 5.0  # times the slowest time constant of the linear model: what is frozen may be taken as standing still
_LEAST, _MOST = 10.0, 0.2  # low-pass: samples at least, part of the shortest record at most
_GRID = 3.0
_CLEAR = 10.0  # difference of the criterion from which a faster set point is taken
_STEP = 1e-3  # of a logarithm, for a slope by differences
_EVEN = np.linspace(-1.0, 1.0, 33)
DEGREES = (0, 1, 2, 3)
_FEWEST = 20  # predictions that the shortest record has to leave for a form to be tried
_ENOUGH = 0.5  # gain of a candidate's criterion by an iteration below which it is compared

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
            found = None if e is None else errors(self.shape, part, theta, start, slopes=2)
            if found is None or not found.finite:
                return np.full((P + 1, P + 1 + bool(self.beside)), np.nan)
            J = [found.J[:, P:], found.J[:, :P]]
            for slower, faster in self.beside[r : r + 1]:
                later, sooner = (errors(self.shape, x, theta, start).g for x in (slower, faster))
                J.append((later - sooner)[:, None] / (2.0 * _STEP))
            R = triangle_of([np.column_stack([*J, found.e])[self.first :]])
            rows.append(np.asarray(np.linalg.qr(R, mode="r"))[k:, k:])
        return triangle_of(rows) * self.weight

    def _project(self, part: Part, theta: Array) -> tuple[Array, Array | None]:
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LevelProblem:
    """The same with the logarithm of the set point's time constant as the last number; the range of p stays."""

    fitting: Fitting
    shape: LpvShape
    weight: float

    def cost(self, v: Array) -> float:
        """As `LpvProblem.cost`."""
        return self._at(v).cost(v[:-1])

    def triangle(self, v: Array) -> Array:
        """As `LpvProblem.triangle`."""
        return self._at(v).triangle(v[:-1])

    def move(self, v: Array, step: Array) -> Array:
        """Take a step, within the limits of the time constant."""
        v = v + step
        low, high = (math.log(x) for x in self.fitting.limits)
        v[-1] = min(max(v[-1], low), high)
        return v

    def _at(self, v: Array) -> LpvProblem:
        of = replace(self.fitting.schedule, time_constant=float(np.exp(v[-1])))
        return replace(self.fitting.problem(self.shape, of, beside=True), weight=self.weight)


# --- starts by least squares ------------------------------------------------------------------------------------------


def least_squares(shape: LpvShape, parts: Sequence[Part], first: int) -> Array:
    """Fit A y = B u + c + e, all coefficients functions of p, from sample `first` on; D and C stay zero."""
    found = _solve([shape.rows(p, p.y, first) for p in parts], [p.y[first:] for p in parts])[0]
    return np.concatenate([found, np.zeros(shape.ar + shape.ma)])


def from_earlier(
    shape: LpvShape,
    parts: Sequence[Part],
    first: int,
    old: LpvShape,
    theta: Array,
    earlier: Sequence[Part] | None = None,
) -> tuple[Array, float] | None:
    """Fit all coefficients with errors and innovations of an earlier model in place of the true ones.

    `earlier` are the records made for that model, where its functions of p are others. Returns parameters, zeros of C
    outside the unit circle reflected, and the sum of squared errors of this regression; None where the earlier model
    diverges.
    """
    rows, targets = [], []
    for part, before in zip(parts, earlier or parts, strict=True):
        found = errors(old, before, theta)
        if not found.finite:
            return None
        n = part.y.size
        by = [shape.rows(part, found.x if shape.form == "output" else part.y, first)]
        for signal, size in ((found.x - part.y, shape.ar), (found.e, shape.ma)):
            by += [signal[first - k : n - k, None] for k in range(1, size + 1)]
        rows.append(np.hstack(by))
        targets.append(part.y[first:])
    start, cost = _solve(rows, targets)
    if shape.ma:
        start[-shape.ma :] = reflect(np.concatenate([[1.0], start[-shape.ma :]]))[1:]
    return start, cost


def carry_over(shape: LpvShape, old: LpvShape, theta: Array, at: Array = _EVEN, earlier: Array = _EVEN) -> Array:
    """Carry a model over to one with other functions of p, or with another error model.

    Coefficients are as near as can be over the range of p; zeros where the old model has none. `at` are scaled values
    of p, and `earlier` those that the old model has for them.
    """

    def carried(values: Array, n: int) -> Array:
        before, after = basis_values(earlier, values.size), basis_values(at, n)
        return np.asarray(np.linalg.lstsq(after, before @ values, rcond=None)[0], dtype=np.float64)

    out = np.zeros(shape.n_theta)
    known = {name: k for k, name in enumerate(old.coefficients)}
    for k, name in enumerate(shape.coefficients):
        if name in known:
            source, target = theta[old.place(known[name])], shape.place(k)
            n = target.stop - target.start
            out[target] = source if n == source.size and at is earlier else carried(source, n)
    return out


def _solve(rows: Sequence[Array], targets: Sequence[Array]) -> tuple[Array, float]:
    """Solution and sum of squared errors of least squares over records; infinite where rows are not finite."""
    R = triangle_of([np.column_stack([X, t]) for X, t in zip(rows, targets, strict=True)])
    if not np.all(np.isfinite(R)):
        return np.zeros(R.shape[1] - 1), np.inf
    found = solve(R[:, :-1], R[:, -1])
    return found, float(np.sum((R[:, -1] - R[:, :-1] @ found) ** 2))


# --- candidates -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidate:
    """A fitted shape."""

    shape: LpvShape
    theta: Array  # (n_theta,), scaled
    cost: float = np.inf  # sum of squared one-step errors, scaled; infinite where the predictor is unstable
    n: int = 1  # errors, and numbers that stand for what was before the records
    starts: int = 0

    def value(self, criterion: str) -> float:
        """Return an information criterion, the smaller the better; infinite where the numbers fit anything."""
        k = self.shape.n_theta
        if not np.isfinite(self.cost) or self.n <= k + self.starts + 1:
            return math.inf
        return information(criterion, self.cost / self.n, k, self.n, k) + 2.0 * self.starts

    def summary(self) -> dict[str, object]:
        """Return what it is and how good, for the details of a fit."""
        of, found = self.shape, {k: v if np.isfinite(v := self.value(k)) else None for k in ("aicc", "bic")}
        return {"form": of.form, "degree": of.degree, "ar": of.ar, "ma": of.ma, **found}


@dataclass(slots=True, kw_only=True)
class Fitting(Attempt):
    """What a fit has come to."""

    data: Scaled
    records: Sequence[IOData]
    schedule: Schedule
    shape: LpvShape
    theta: Array  # (n_theta,), scaled
    first: int  # errors count from this sample on
    most: int  # iterations of a search
    limits: tuple[float, float] = (0.0, 0.0)  # of the set point's time constant, s, where it is estimated
    tried: list[Candidate] = field(default_factory=list)
    reason: str = ""  # why there is no model

    def parts(self, shape: LpvShape, schedule: Schedule | None = None) -> tuple[Part, ...]:
        """Return the records, ready for a shape, with the schedule of the fit or another."""
        of = schedule or self.schedule
        return tuple(
            part_of(shape, y[:, 0], u, of.scaled(of.signal(x.u, x.y, x.dt)))
            for x, (y, u) in zip(self.records, self.data.parts, strict=True)
        )

    def problem(self, shape: LpvShape, schedule: Schedule | None = None, *, beside: bool = False) -> LpvProblem:
        """Return what is searched in for a shape; with slopes by the set point's time constant if `beside`."""
        of = schedule or self.schedule
        near = [
            self.parts(shape, replace(of, time_constant=of.time_constant * np.exp(x)))
            for x in (_STEP, -_STEP)
            if beside
        ]
        parts = self.parts(shape, of)
        return LpvProblem(shape=shape, parts=parts, first=self.first, beside=tuple(zip(*near, strict=True)))

    def refine_level(self, best: Candidate, tick: Tick | None) -> Array:
        """Estimate the set point's time constant with everything else, and return the parameters for its range of p."""
        weight = float(np.sqrt(best.n / best.cost))
        problem = LevelProblem(fitting=self, shape=best.shape, weight=weight)
        start = np.append(best.theta, np.log(self.schedule.time_constant))
        found = search(
            problem, start, stage="set point", most=self.most, tolerance=1e-9, enough=0.01, move=problem.move, tick=tick
        ).theta
        old, self.schedule = self.schedule, self.schedule.over(self.records, float(np.exp(found[-1])))
        earlier = old.scaled(self.schedule.middle + self.schedule.half * _EVEN)
        self.tried = [replace(x, theta=carry_over(x.shape, x.shape, x.theta, _EVEN, earlier)) for x in self.tried]
        return carry_over(best.shape, best.shape, found[:-1], _EVEN, earlier)

    @property
    def level_counts(self) -> bool:
        """Whether the set point's time constant was estimated, and is within its limits."""
        return self.shape.degree > 0 and self.limits[0] < self.schedule.time_constant < self.limits[1]

    def by_equations(self, shape: LpvShape) -> Array:
        """Return the start of a shape without an error model, by least squares."""
        return least_squares(shape, self.parts(shape), self.first)

    def search(
        self, shape: LpvShape, starts: Sequence[Array | None], tick: Tick | None, stage: str, *, last: bool = False
    ) -> Candidate:
        """Search from the start with the least cost, which is infinite where the predictor is unstable there.

        The `last` search goes on to the end, and what it finds is held on to.
        """
        problem = self.problem(shape)
        costs = [(problem.cost(x), k) for k, x in enumerate(starts) if x is not None]
        cost, k = min(costs, key=lambda x: x[0])
        start = starts[k]
        assert start is not None
        if not np.isfinite(cost):
            return Candidate(shape=shape, theta=start)
        weight = 1.0 / max(np.sqrt(cost / max(problem.n_errors, 1)), 1e-12)

        def keep(found: Array) -> None:
            if last:
                self.theta = found

        found = search(
            replace(problem, weight=weight), start, stage=stage, most=self.most, tolerance=1e-9,
            enough=1e-8 if last else _ENOUGH, tick=tick, keep=keep,
        )  # fmt: skip
        if last:
            self.theta, self.status = found.theta, "converged" if found.converged else "stalled"
            self.curves.append(
                LearningCurve(
                    method="Levenberg-Marquardt, prediction errors",
                    seconds=np.array(found.seconds),
                    training=np.sqrt(np.array(found.costs) / problem.n_errors) / weight,
                )
            )
        n, starts_n = problem.n_errors, len(problem.parts) * shape.n_start
        return Candidate(shape=shape, theta=found.theta, cost=found.cost / weight**2, n=n, starts=starts_n)

    def better(self, found: Candidate, best: Candidate | None, criterion: str) -> Candidate:
        """Return the better of two, which is held on to."""
        if best is not None and not found.value(criterion) < best.value(criterion):
            return best
        if np.isfinite(found.cost):
            self.shape, self.theta = found.shape, found.theta
        return found


# --- what is chosen where nothing is said -----------------------------------------------------------------------------


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


def choose_level(fitting: Fitting, order: int, degree: int | None, tick: Tick | None) -> Schedule:
    """Choose the low-pass of the set point.

    A linear model with autoregressive errors of some `order` says how slow the plant is; pseudo-linear regressions with
    its errors compare what coefficients that follow each set point explain.
    """
    white = replace(fitting.shape, degree=0)
    shape = replace(white, ar=order)
    model = fitting.search(shape, [carry_over(shape, white, fitting.by_equations(white))], tick, "set point")
    a = np.concatenate([[1.0], model.theta[: shape.order]])
    dt, shortest = fitting.records[0].dt, min(x.n_samples for x in fitting.records)
    grid = time_constants(slowest_mode(a), shortest, dt)
    earlier, values = fitting.parts(shape), list[float]()
    trial = replace(shape, degree=2 if degree is None else max(degree, 1))
    tried = [fitting.schedule.over(fitting.records, tau) for tau in grid]
    for of in tried if len(grid) > 1 and np.isfinite(model.cost) else ():
        found = from_earlier(trial, fitting.parts(trial, of), fitting.first, shape, model.theta, earlier)
        cost = np.inf if found is None else found[1]
        values.append(Candidate(shape=trial, theta=model.theta, cost=cost, n=model.n).value("bic"))
    fitting.limits = grid[0], max(dt * _MOST * shortest, grid[-1])
    chosen = slowest_that_does(grid, values) if values and np.isfinite(min(values)) else grid[0]
    return tried[grid.index(chosen)]


def by_degree(
    fitting: Fitting, degrees: Sequence[int], base: Candidate | LpvShape, criterion: str, tick: Tick | None
) -> Candidate:
    """Fit a shape with other degrees; return the best of these and of the candidate that it comes from, if any."""
    best = base if isinstance(base, Candidate) else None
    shape = base if isinstance(base, LpvShape) else base.shape
    for degree, own in zip(degrees, portions(tick, [1.0 + d for d in degrees]), strict=True):
        trial = replace(shape, degree=degree)
        starts: list[Array | None] = [None if best is None else carry_over(trial, best.shape, best.theta)]
        if isinstance(base, LpvShape):
            white = replace(trial, ar=0, ma=0)
            starts.insert(0, carry_over(trial, white, fitting.by_equations(white)))
        found = fitting.search(trial, starts, own, f"degree {degree}")
        fitting.tried.append(found)
        best = fitting.better(found, best, criterion)
    assert best is not None
    return best


def wanted_shapes(base: LpvShape, form: str, orders: Sequence[tuple[int, int]]) -> list[LpvShape]:
    """Return a shape with the forms and orders of D and C that are asked for."""
    forms = ("equation", "output") if form == "auto" else (form,)
    return [replace(base, form=form, ar=ar, ma=ma) for form in forms for ar, ma in orders]


def by_form(fitting: Fitting, wanted: Sequence[LpvShape], best: Candidate, tick: Tick | None) -> Candidate:
    """Fit the forms and error models that are asked for, with the degree of the best so far; return the best."""
    shortest = min(x.n_samples for x in fitting.records)
    both = len({x.form for x in wanted}) > 1
    wanted = [x for x in wanted if looks_back(x) + _FEWEST <= shortest]
    steps = [  # on the way to both, each alone: from there the search does not end in a poor optimum
        replace(x, ar=ar, ma=ma)
        for x in wanted
        for ar, ma in ([(x.ar, 0), (0, x.ma)] if x.ar and x.ma else []) + [(x.ar, x.ma)]
    ]
    steps = list(dict.fromkeys(steps))
    known = {best.shape: best}
    chosen = best if best.shape in wanted else None
    white = replace(best.shape, ar=0, ma=0, form="equation")
    process = best.theta[: white.n_theta]
    for shape, own in zip(steps, portions(tick, [1.0] * len(steps)), strict=True):
        if shape in known:
            continue
        earlier = [x for x in known.values() if np.isfinite(x.cost)]
        earlier.sort(key=lambda x: (x.shape.form != shape.form, x.value("bic")))
        if shape.form == "output" and both and not earlier[0].shape.is_stable(earlier[0].theta):
            continue  # earlier[0]: the best of the equation form, or of the output form, which is stable
        starts: list[Array | None] = [carry_over(shape, white, process)]
        for x in earlier[:2]:
            regression = from_earlier(shape, fitting.parts(shape), fitting.first, x.shape, x.theta)
            starts += [carry_over(shape, x.shape, x.theta), None if regression is None else regression[0]]
        kinds = [f"{k} {n}" for k, n in (("AR", shape.ar), ("MA", shape.ma)) if n]
        found = fitting.search(shape, starts, own, f"{shape.form} form, {', '.join(kinds) or 'white'} errors")
        fitting.tried.append(found)
        known[shape] = found
        if shape in wanted:
            chosen = fitting.better(found, chosen, "bic")
    return chosen or best
