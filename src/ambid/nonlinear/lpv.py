"""LPV models scheduled by set point: system model and error model by prediction error, coefficients functions of p.

Set point (its low-pass, where open) -> degree in p, form and error model by a criterion of one-step errors ->
Levenberg-Marquardt, an open time constant included. Starts: least squares without an error model, and extended least
squares (Ljung 1999, sec. 10.1), linear with v and e of an earlier fit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from time import perf_counter

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.model import reflect, roots_of
from ambid.errors import EstimationError, nearest
from ambid.estimation.estimate import plain_json
from ambid.estimation.linear import information_inverse, triangle_of
from ambid.estimation.linear import least_squares as solve
from ambid.estimation.progress import Tick, portions
from ambid.estimation.search import search
from ambid.estimation.uncertainty import information
from ambid.nonlinear.fit import Attempt, NonlinearFit, Settings, choice, number, read_settings, text, whole
from ambid.nonlinear.lpv_model import (
    LEVEL,
    STEP,
    LpvModel,
    LpvProblem,
    LpvShape,
    Part,
    Schedule,
    basis_values,
    errors,
    looks_back,
    part_of,
    regressors,
)
from ambid.nonlinear.records import Scaled, cloud_of, scaled_records
from ambid.settings.caller import setting

DIVERGED = "no finite one-step predictor was found; lower degree, order or error_order, or check the columns"
UNSTABLE = (
    "the output form cannot be fitted: its process part diverges over the records, as for an unstable plant. Give "
    "form = equation"
)
_CRITERION = "aicc"  # what chooses the degree
_SLOWER = 5.0  # times the slowest time constant of the linear model: what is frozen may be taken as standing still
_LEAST, _MOST = 10.0, 0.2  # low-pass: samples at least, part of the shortest record at most
_GRID = 3.0
_CLEAR = 10.0  # difference of the criterion from which a faster set point is taken
_EVEN = np.linspace(-1.0, 1.0, 33)
DEGREES = (0, 1, 2, 3)
_FEWEST = 20  # predictions that the shortest record has to leave for a form to be tried
_ENOUGH = 0.5  # gain of a candidate's criterion by an iteration below which it is compared
_POINTS = 9  # of the table over the range of p
_CLOSE = 2.0  # difference of Akaike's criterion that says nothing (Burnham and Anderson 2002, sec. 2.6)

# --- settings ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class LpvSettings:
    """What an LPV fit may be given. None: to be chosen."""

    schedule: str = text(
        "scheduling signal: an input, the output, or level (set point: output, low-passed); level", LEVEL
    )
    time_constant: float | None = number(
        "of the low-pass of level, in s; chosen, at least five of the plant's own", 0.0, 1e9
    )
    order: int = whole("of the system model; 2", 1, 10, 2)
    nb: int | None = whole("coefficients of each input; order", 0, 50)
    nk: int = whole("smallest lag of the inputs; 1", 0, 1000, 1)
    degree: int | None = whole("of the coefficients in the scheduling signal; chosen, up to 3", 0, 8)
    form: str = choice(
        "output (noise on the output) or equation (noise in it; unstable plants); chosen by bic",
        *("auto", "equation", "output"),
    )
    error_order: int = whole("of the error model, 0 for white noise; 5", 0, 20, 5)
    error_form: str = choice("ar, ma, arma; chosen by bic", "auto", "ar", "ma", "arma")
    iterations: int = whole("of each search, at most; 60", 1, 2000, 60)


def lpv_settings(settings: Settings, first: IOData) -> tuple[LpvSettings, Schedule, tuple[int, ...]]:
    """Check settings beside one of the records, and complete them; with schedule and inputs that excite."""
    s = read_settings(LpvSettings, "lpv", settings)
    if first.n_outputs != 1:
        raise EstimationError(
            f"lpv takes one output, not {', '.join(first.outputs)}; fit them separately, with the same schedule. "
            "Name one"
        )
    column = _schedule_column(s.schedule, first)
    if s.time_constant and s.schedule != LEVEL:
        raise EstimationError(
            f"lpv: time_constant is for schedule = level; with schedule = {s.schedule} the column is used "
            "unfiltered. Omit it"
        )
    tau = s.time_constant if s.schedule == LEVEL else 0.0
    s = replace(s, nb=s.order if s.nb is None else s.nb, time_constant=tau)
    columns = tuple(k for k in range(first.n_inputs) if k != column)
    return s, Schedule(name=s.schedule, column=column), columns


def _schedule_column(name: str, first: IOData) -> int:
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
            f"Name the column as an input too; it need not excite.{nearest(name, list(columns))}"
        )
    return first.inputs.index(name) if name in first.inputs else -1


# --- stages -----------------------------------------------------------------------------------------------------------


def lpv(records: Sequence[IOData], settings: Settings, *, seed: int = 0, tick: Tick | None = None) -> NonlinearFit:
    """Identify a linear model whose coefficients follow a scheduling signal, with an error model (thesis sec. 1.6),
    consistent under feedback as long as that is true. Deviations take the form for given, and count a chosen degree and
    time constant: 95 % intervals hold the truth about 92 times in 100 on a few hundred samples. Nothing is random,
    whatever `seed`.
    """
    if not records:
        raise EstimationError("lpv: no record was given. Pass at least one")
    s, schedule, columns = lpv_settings(settings, records[0])
    fitting, began = _begin(s, records, schedule, columns, seed), perf_counter()

    def identify() -> None:
        _identify(s, fitting, tick)
        if fitting.status == "stalled":
            fitting.warnings.insert(0, "the search did not converge: treat the values as a first guess")

    reason = fitting.guarded(identify)
    fitting.timed("all", began)
    shape = fitting.shape
    form = {(False, False): s.error_form, (True, False): "ar", (False, True): "ma", (True, True): "arma"}
    fitting.settings |= {
        "degree": shape.degree, "time_constant": fitting.schedule.time_constant, "error_order": max(shape.ar, shape.ma),
        "form": shape.form, "error_form": form[shape.ar > 0, shape.ma > 0],
    }  # fmt: skip
    if reason or fitting.reason or not np.isfinite(fitting.problem(shape).cost(fitting.theta)):
        return fitting.failed(reason or fitting.reason or DIVERGED)
    return _finish(fitting)


def _begin(
    s: LpvSettings, records: Sequence[IOData], schedule: Schedule, columns: tuple[int, ...], seed: int
) -> Fitting:
    """A model by least squares: something to hand over when the very next thing is an interruption."""
    assert s.nb is not None
    tau = 50.0 * records[0].dt if s.time_constant is None else s.time_constant
    last = replace(schedule, time_constant=tau).share(records[0].dt) == 1.0
    shape = LpvShape(
        columns=columns, order=s.order, nb=s.nb, nk=s.nk, ar=0, ma=0, degree=s.degree or 0, form="equation",
        offset="constant" if last else "scheduled",
    )  # fmt: skip
    first = shape.first + s.error_order
    for r, x in enumerate(records):  # before it is said that a scheduling column does not excite
        if (x.inputs, x.outputs) != (records[0].inputs, records[0].outputs):
            scaled_records("lpv", records, lag=first)
        if r == 0 and schedule.column >= 0:
            schedule.over(records, 0.0)
    least = min(looks_back(x) for x in wanted_shapes(s, shape))
    data = scaled_records("lpv", records, lag=max(first, least))
    n, k = sum(x.n_samples - first for x in records), shape.n_theta + s.error_order * (1 + (s.error_form == "arma"))
    if n <= k + 1:  # these fit anything
        raise EstimationError(
            f"lpv: {n} samples remain after lags for {k} parameters. Give longer records, or lower "
            f"{'order or error_order' if s.degree is None else 'degree, order or error_order'}"
        )
    fitting = Fitting(
        structure="lpv", records=records, settings=asdict(s), seed=seed, data=data,
        schedule=schedule.over(records, tau), shape=shape, theta=np.zeros(shape.n_theta), first=first,
        most=s.iterations,
    )  # fmt: skip
    fitting.theta = fitting.by_equations(shape)
    return fitting


def _identify(s: LpvSettings, fitting: Fitting, tick: Tick | None) -> None:
    """Choose and fit, or say why there is no model."""
    ticks = portions(tick, (1.0, 4.0, 10.0, 0.0 if s.degree is not None else 6.0, 10.0))
    began = perf_counter()
    if ticks[0] is not None:
        ticks[0]("set point", 0.0)
    if s.time_constant is None:
        fitting.schedule = choose_level(fitting, s.error_order, s.degree, ticks[0])
        fitting.theta = fitting.by_equations(fitting.shape)
    began = fitting.timed("set point", began)
    degrees = DEGREES if s.degree is None else (s.degree,)
    first = Candidate(shape=replace(fitting.shape, ar=s.error_order), theta=fitting.theta)
    best = by_degree(fitting, degrees, first, _CRITERION, ticks[1])
    began = fitting.timed("degree", began)
    best = by_form(fitting, wanted_shapes(s, best.shape), best, ticks[2])
    if s.degree is None and np.isfinite(best.cost):  # a wrong form or error model may have decided on the degree
        others = [d for d in DEGREES if d != best.shape.degree]
        best = by_degree(fitting, others, best, _CRITERION, ticks[3])
    began = fitting.timed("form", began)
    if not np.isfinite(best.cost):
        fitting.reason = UNSTABLE if s.form == "output" else DIVERGED
        return
    fitting.shape, fitting.theta = best.shape, best.theta
    start = fitting.refine_level(best, None) if fitting.limits[1] and best.shape.degree else best.theta
    fitting.search(best.shape, [start], ticks[4], "prediction errors", last=True)
    fitting.timed("search", began)


# --- problems and starts ----------------------------------------------------------------------------------------------


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
        schedule = replace(self.fitting.schedule, time_constant=float(np.exp(v[-1])))
        return replace(self.fitting.problem(self.shape, schedule, beside=True), weight=self.weight)


# --- starts by least squares ------------------------------------------------------------------------------------------


def least_squares(shape: LpvShape, parts: Sequence[Part], first: int) -> Array:
    """Fit A y = B u + c + e, all coefficients functions of p, from sample `first` on; D and C stay zero."""
    theta = _solve([shape.rows(p, p.y, first) for p in parts], [p.y[first:] for p in parts])[0]
    return np.concatenate([theta, np.zeros(shape.ar + shape.ma)])


def from_earlier(
    shape: LpvShape,
    parts: Sequence[Part],
    first: int,
    old: LpvShape,
    theta: Array,
    earlier: Sequence[Part] | None = None,
) -> tuple[Array, float] | None:
    """Fit all coefficients with errors and innovations of an earlier model, whose functions of p (`earlier`: records
    for it) may differ: parameters, zeros of C reflected into the unit circle, and the sum of squared errors; None where
    it diverges.
    """
    rows, targets = [], []
    for part, before in zip(parts, earlier or parts, strict=True):
        run = errors(old, before, theta)
        if not run.finite:
            return None
        n = part.y.size
        columns = [shape.rows(part, run.x if shape.form == "output" else part.y, first)]
        for signal, size in ((run.x - part.y, shape.ar), (run.e, shape.ma)):
            columns += [signal[first - k : n - k, None] for k in range(1, size + 1)]
        rows.append(np.hstack(columns))
        targets.append(part.y[first:])
    start, cost = _solve(rows, targets)
    if shape.ma:
        start[-shape.ma :] = reflect(np.concatenate([[1.0], start[-shape.ma :]]))[1:]
    return start, cost


def carry_over(shape: LpvShape, old: LpvShape, theta: Array, at: Array = _EVEN, earlier: Array = _EVEN) -> Array:
    """Carry a model over to other functions of p or another error model, coefficients as near as can be, zeros for new
    ones; `at`: scaled p, `earlier`: the old model's values there.
    """

    def carried(values: Array, n: int) -> Array:
        before, after = basis_values(earlier, values.size), basis_values(at, n)
        return np.asarray(np.linalg.lstsq(after, before @ values, rcond=None)[0], dtype=np.float64)

    out = np.zeros(shape.n_theta)
    places = {name: k for k, name in enumerate(old.coefficients)}
    for k, name in enumerate(shape.coefficients):
        if name in places:
            source, target = theta[old.place(places[name])], shape.place(k)
            n = target.stop - target.start
            out[target] = source if n == source.size and at is earlier else carried(source, n)
    return out


def _solve(rows: Sequence[Array], targets: Sequence[Array]) -> tuple[Array, float]:
    """Solution and sum of squared errors of least squares over records; infinite where rows are not finite."""
    R = triangle_of([np.column_stack([X, t]) for X, t in zip(rows, targets, strict=True)])
    if not np.all(np.isfinite(R)):
        return np.zeros(R.shape[1] - 1), np.inf
    solution = solve(R[:, :-1], R[:, -1])
    return solution, float(np.sum((R[:, -1] - R[:, :-1] @ solution) ** 2))


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
        shape, criteria = self.shape, {k: v if np.isfinite(v := self.value(k)) else None for k in ("aicc", "bic")}
        return {"form": shape.form, "degree": shape.degree, "ar": shape.ar, "ma": shape.ma, **criteria}


@dataclass(slots=True, kw_only=True)
class Fitting(Attempt):
    """What a fit has come to."""

    data: Scaled
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
        chosen = schedule or self.schedule
        return tuple(
            part_of(shape, y[:, 0], u, chosen.scaled(chosen.signal(x.u, x.y, x.dt)))
            for x, (y, u) in zip(self.records, self.data.parts, strict=True)
        )

    def problem(self, shape: LpvShape, schedule: Schedule | None = None, *, beside: bool = False) -> LpvProblem:
        """Return what is searched in for a shape; with slopes by the set point's time constant if `beside`."""
        chosen = schedule or self.schedule
        near = [
            self.parts(shape, replace(chosen, time_constant=chosen.time_constant * np.exp(x)))
            for x in (STEP, -STEP)
            if beside
        ]
        parts = self.parts(shape, chosen)
        return LpvProblem(shape=shape, parts=parts, first=self.first, beside=tuple(zip(*near, strict=True)))

    def refine_level(self, best: Candidate, tick: Tick | None) -> Array:
        """Estimate the set point's time constant with everything else, and return the parameters for its range of p."""
        weight = float(np.sqrt(best.n / best.cost))
        problem = LevelProblem(fitting=self, shape=best.shape, weight=weight)
        start = np.append(best.theta, np.log(self.schedule.time_constant))
        vector = search(
            problem, start, stage="set point", most=self.most, tolerance=1e-9, enough=0.01, move=problem.move, tick=tick
        ).theta
        old, self.schedule = self.schedule, self.schedule.over(self.records, float(np.exp(vector[-1])))
        earlier = old.scaled(self.schedule.middle + self.schedule.half * _EVEN)
        self.tried = [replace(x, theta=carry_over(x.shape, x.shape, x.theta, _EVEN, earlier)) for x in self.tried]
        return carry_over(best.shape, best.shape, vector[:-1], _EVEN, earlier)

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
        """Search from the start of least cost (infinite if unstable); the `last` search goes on to the end and is held
        on to.
        """
        problem = self.problem(shape)
        costs = [(problem.cost(x), k) for k, x in enumerate(starts) if x is not None]
        cost, k = min(costs, key=lambda x: x[0])
        start = starts[k]
        assert start is not None
        if not np.isfinite(cost):
            return Candidate(shape=shape, theta=start)
        weight = 1.0 / max(np.sqrt(cost / max(problem.n_errors, 1)), 1e-12)

        def keep(theta: Array) -> None:
            if last:
                self.theta = theta

        ended = search(
            replace(problem, weight=weight), start, stage=stage, most=self.most, tolerance=1e-9,
            enough=1e-8 if last else _ENOUGH, tick=tick, keep=keep,
        )  # fmt: skip
        if last:
            self.theta, self.status = ended.theta, "converged" if ended.converged else "stalled"
            self.note_curve(ended, "Levenberg-Marquardt, prediction errors", problem.n_errors, 1.0 / weight)
        n, starts_n = problem.n_errors, len(problem.parts) * shape.n_start
        return Candidate(shape=shape, theta=ended.theta, cost=ended.cost / weight**2, n=n, starts=starts_n)

    def better(self, candidate: Candidate, best: Candidate | None, criterion: str) -> Candidate:
        """Return the better of two, which is held on to."""
        if best is not None and np.isfinite(best.cost) and not candidate.value(criterion) < best.value(criterion):
            return best
        if np.isfinite(candidate.cost):
            self.shape, self.theta = candidate.shape, candidate.theta
        return candidate


# --- what is chosen where nothing is said -----------------------------------------------------------------------------


def time_constants(slowest: float, shortest: int, dt: float) -> list[float]:
    """Return set-point low-passes to try, in s, slow beside the plant; `slowest` of the linear model and `shortest` of
    the records, in samples.
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
    """Choose the set point's low-pass: a linear model with autoregressive errors of some `order` says how slow the
    plant is; pseudo-linear regressions with its errors compare set points.
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
    for schedule in tried if len(grid) > 1 and np.isfinite(model.cost) else ():
        candidate = from_earlier(trial, fitting.parts(trial, schedule), fitting.first, shape, model.theta, earlier)
        cost = np.inf if candidate is None else candidate[1]
        values.append(Candidate(shape=trial, theta=model.theta, cost=cost, n=model.n).value("bic"))
    fitting.limits = grid[0], max(dt * _MOST * shortest, grid[-1])
    chosen = slowest_that_does(grid, values) if values and np.isfinite(min(values)) else grid[0]
    return tried[grid.index(chosen)]


def by_degree(
    fitting: Fitting, degrees: Sequence[int], best: Candidate, criterion: str, tick: Tick | None
) -> Candidate:
    """Fit a shape with other degrees, with starts from a candidate; return the best of these and of the candidate."""
    base = best.shape
    for degree, own in zip(degrees, portions(tick, [1.0 + d for d in degrees]), strict=True):
        trial = replace(base, degree=degree)
        white = replace(trial, ar=0, ma=0, form="equation")
        starts = [carry_over(trial, white, fitting.by_equations(white))]
        if np.isfinite(best.cost):
            starts.append(carry_over(trial, best.shape, best.theta))
        candidate = fitting.search(trial, starts, own, f"degree {degree}")
        fitting.tried.append(candidate)
        best = fitting.better(candidate, best, criterion)
    return best


def wanted_shapes(s: LpvSettings, base: LpvShape) -> list[LpvShape]:
    """Return a shape with the forms and orders of D and C that are asked for."""
    forms = ("equation", "output") if s.form == "auto" else (s.form,)
    orders = {"ar": (s.error_order, 0), "ma": (0, s.error_order), "arma": (s.error_order, s.error_order)}
    tried = dict.fromkeys(orders.values() if s.error_form == "auto" else [orders[s.error_form]])
    return [replace(base, form=form, ar=ar, ma=ma) for form in forms for ar, ma in tried]


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
    fitted = {best.shape: best}
    chosen = best if best.shape in wanted else None
    white = replace(best.shape, ar=0, ma=0, form="equation")
    process = best.theta[: white.n_theta]
    for shape, own in zip(steps, portions(tick, [1.0] * len(steps)), strict=True):
        if shape in fitted:
            continue
        earlier = [x for x in fitted.values() if np.isfinite(x.cost)]
        earlier.sort(key=lambda x: (x.shape.form != shape.form, x.value("bic")))
        if shape.form == "output" and both and not earlier[0].shape.is_stable(earlier[0].theta):
            continue  # earlier[0]: the best of the equation form, or of the output form, which is stable
        starts: list[Array | None] = [carry_over(shape, white, process)]
        for x in earlier[:2]:
            regression = from_earlier(shape, fitting.parts(shape), fitting.first, x.shape, x.theta)
            starts += [carry_over(shape, x.shape, x.theta), None if regression is None else regression[0]]
        kinds = [f"{k} {n}" for k, n in (("AR", shape.ar), ("MA", shape.ma)) if n]
        candidate = fitting.search(shape, starts, own, f"{shape.form} form, {', '.join(kinds) or 'white'} errors")
        fitting.tried.append(candidate)
        fitted[shape] = candidate
        if shape in wanted:
            chosen = fitting.better(candidate, chosen, "bic")
    return chosen or best


# --- the fit ----------------------------------------------------------------------------------------------------------


def _finish(fitting: Fitting) -> NonlinearFit:
    """Return the fit of a model that runs."""
    records = fitting.records
    problem, theta, level, d = fitting.problem(fitting.shape), fitting.theta, fitting.schedule, fitting.data
    noise = problem.cost(theta) / problem.freedom
    R = fitting.problem(fitting.shape, beside=fitting.level_counts).triangle(theta)
    inverse, condition = information_inverse(R[:, :-1]) if np.all(np.isfinite(R)) else (None, np.inf)
    near = [
        regressors(fitting.shape, y[:, 0], u, level.scaled(level.signal(x.u, x.y, x.dt)))
        for x, (y, u) in zip(records, d.parts, strict=True)
    ]
    model = LpvModel(
        dt=records[0].dt, shape=fitting.shape, schedule=level, theta=theta,
        u_level=d.u_level, u_scale=d.u_scale, y_level=d.y_level, y_scale=d.y_scale,
        cloud=cloud_of(np.concatenate(near)),
    )  # fmt: skip
    model = model.with_theta(theta * model.unit)
    fitting.warnings += _cautions(records, fitting)
    covariance = None
    if inverse is None:
        fitting.warnings.append(
            "no standard deviations: the data do not determine the coefficients (condition number "
            f"{condition:.1e}). Lower degree or error_order, or give records at more set points"
        )
    else:
        covariance = (
            (noise * inverse[: theta.size, : theta.size] + _disagreement(fitting)) * model.unit[:, None] * model.unit
        )
    column = records[0].outputs[0] if level.column < 0 else level.name
    fitting.details = {
        "schedule": {
            "signal": level.name, "low": level.low, "high": level.high, "time_constant_s": level.time_constant,
            "unit": records[0].units[column],
        },
        "condition": condition, "frozen": _frozen_table(model, covariance, records[0].inputs),
        "tried": [x.summary() for x in fitting.tried],
    }  # fmt: skip
    return fitting.result(
        model=model, covariance=covariance,
        covariance_from="" if covariance is None else "information", n_estimated=int(theta.size),
        noise_covariance=np.array([[noise * float(d.y_scale[0]) ** 2]]),
    )  # fmt: skip


def _frozen_table(model: LpvModel, covariance: Array | None, inputs: Sequence[str]) -> list[dict[str, object]]:
    """Return ``poles_rad_s`` (real, imaginary part, deviations) and ``dc_gain`` (value, deviation by input; None where
    there is none), by value of p over its range.
    """
    out = list[dict[str, object]]()
    for p in np.linspace(model.schedule.low, model.schedule.high, _POINTS):
        at = model.at(float(p), covariance)
        poles_sd = np.full(at.poles.size, np.nan + 1j * np.nan) if at.poles_sd is None else at.poles_sd
        gain_sd = np.full(at.dc_gain.size, np.nan) if at.dc_gain_sd is None else at.dc_gain_sd
        poles = [(z.real, z.imag, sd.real, sd.imag) for z, sd in zip(at.poles, poles_sd, strict=True)]
        gains = {
            inputs[column]: (g, sd) for column, g, sd in zip(model.shape.columns, at.dc_gain, gain_sd, strict=True)
        }
        out.append({"p": p, "poles_rad_s": poles, "dc_gain": gains})
    table: list[dict[str, object]] = plain_json(out)
    return table


def _cautions(records: Sequence[IOData], fitting: Fitting) -> list[str]:
    cautions, shape = list[str](), fitting.shape
    if shape.columns and not (shape.ar or shape.ma) and not all(x.open_loop for x in records):
        what = "noise is white" if shape.form == "output" else "equation errors are white"
        cautions.append(
            f"without an error model (error_order = 0) lpv is biased by feedback unless its {what}. Raise "
            f"error_order, or give {setting('open_loop', True)} if the records are open loop"
        )
    if not shape.columns and records[0].n_inputs:
        cautions.append(
            f"no input acts on the output: {fitting.schedule.name!r}, the only one, changes coefficients only. "
            "Name the input that does"
        )
    if shape.degree == 0:
        cautions.append(
            f"no coefficient depends on the scheduling signal {fitting.schedule.name!r} (degree 0"
            f"{'' if not fitting.tried or len(fitting.tried) < 2 else ', by the criterion'}): this is a linear model"
        )
    close = [str(x.shape.degree) for x, worse in _other_degrees(fitting) if abs(worse) < _CLOSE]
    if close:
        cautions.append(
            f"the choice of degree {shape.degree} is not clear: degree {' and '.join(close)} fits about as well. The "
            "standard deviations include their difference. Give the degree if you know it"
        )
    return cautions


def _other_degrees(fitting: Fitting) -> list[tuple[Candidate, float]]:
    """Candidates of other degrees, everything else alike, and by how much Akaike's criterion is worse of each."""
    shape = fitting.shape
    alike = {
        x.shape.degree: x
        for x in fitting.tried
        if replace(x.shape, degree=shape.degree) == shape and np.isfinite(x.cost)
    }
    own = alike.pop(shape.degree, None)
    return [] if own is None else [(x, x.value("aicc") - own.value("aicc")) for x in alike.values()]


def _disagreement(fitting: Fitting) -> Array:
    """Scaled covariance by which degree the model might have had (Burnham and Anderson 2002, sec. 4.3, unconditional):
    each other degree by its Akaike weight with the squared difference over the range of p.
    """
    shape, theta = fitting.shape, fitting.theta
    others = [
        (np.exp(-max(worse, 0.0) / 2.0), carry_over(shape, x.shape, x.theta) - theta)
        for x, worse in _other_degrees(fitting)
    ]
    total = 1.0 + sum(w for w, _ in others)
    out: Array = sum((w / total * np.outer(d, d) for w, d in others), np.zeros((theta.size, theta.size)))
    return out
