"""Degree, form and error model of an LPV fit: candidates fitted and compared, and the search for their numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.estimation.progress import Tick, guessed, portions
from ambid.estimation.search import search
from ambid.nonlinear.fit import LearningCurve
from ambid.nonlinear.lpv.beginning import looks_back
from ambid.nonlinear.lpv.choice import error_orders, information, slowest_mode, slowest_that_does, time_constants
from ambid.nonlinear.lpv.problem import LpvProblem
from ambid.nonlinear.lpv.schedule import Schedule, schedule_over
from ambid.nonlinear.lpv.settings import LpvSettings
from ambid.nonlinear.lpv.shape import LpvShape, Part, part_of, stable_process
from ambid.nonlinear.lpv.start import by_long_regression, from_earlier, least_squares, padded, without_error_model
from ambid.nonlinear.records import Scaled

_DEGREES = (0, 1, 2, 3)
_USUAL = 8.0  # iterations, half of what a search takes
_FEWEST = 20  # predictions that the shortest record has to leave for a form to be tried
_ENOUGH = 0.5  # gain of a candidate's criterion by an iteration below which it is judged


@dataclass(slots=True)
class Work:
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
    tried: list[dict[str, object]] = field(default_factory=list)  # candidates with their criterion
    timing_s: dict[str, float] = field(default_factory=dict)

    def parts(self, shape: LpvShape, schedule: Schedule | None = None) -> tuple[Part, ...]:
        """Return the records, ready for a shape.

        `schedule`: another one than that of the fit.
        """
        of = schedule or self.schedule
        return tuple(
            part_of(shape, y[:, 0], u, of.scaled(of.signal(x.u, x.y, x.dt)))
            for x, (y, u) in zip(self.records, self.data.parts, strict=True)
        )

    def problem(self, shape: LpvShape, weight: float = 1.0) -> LpvProblem:
        """Return what is searched in for a shape.

        `weight`: one over the standard deviation of the errors.
        """
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


def searched(
    work: Work, shape: LpvShape, theta: Array, most: int, tick: Tick | None, stage: str, *, last: bool = False
) -> Candidate:
    """Search from a start.

    `theta`: (n_theta,), scaled; `most`: iterations; `tick`: of this part; `stage`: for it. Returns with infinite cost
    where the predictor is unstable at the start.
    """
    problem = work.problem(shape)
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
            work.theta = found

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
        work.theta, work.status = found.theta, "converged" if found.converged else "stalled"
        work.curves.append(
            LearningCurve(
                method="Levenberg-Marquardt, prediction errors",
                seconds=np.array(found.seconds),
                training=np.sqrt(np.array(found.costs) / problem.n_errors) / weight,
            )
        )
    starts = len(problem.parts) * shape.n_start
    return Candidate(shape=shape, theta=found.theta, cost=found.cost / weight**2, n=problem.n_errors, starts=starts)


def _noted(work: Work, x: Candidate) -> Candidate:
    of, found = x.shape, {k: v if np.isfinite(v := x.value(k)) else None for k in ("aicc", "bic")}
    work.tried.append({"form": of.form, "degree": of.degree, "ar": of.ar, "ma": of.ma, **found})
    return x


def chosen_level(s: LpvSettings, work: Work, tick: Tick | None) -> float:
    """Choose the low-pass of the set point.

    A linear model with moving-average errors says how slow the plant is; pseudo-linear regressions with its errors
    compare what coefficients that follow each set point explain.

    `tick`: of this part. Returns s.
    """
    white = replace(work.shape, degree=0, error_degree=0, ar=0, ma=0)
    shape = replace(white, ma=s.error_order)
    starts: list[Array | None] = [padded(shape, white, least_squares(white, work.parts(white), work.first)[0])]
    if s.error_order:
        starts.append(by_long_regression(shape, work.parts(shape), work.first))
    linear = _from_best(s, work, shape, starts, tick, "set point")
    a = np.concatenate([[1.0], linear.theta[: shape.order]])
    dt, shortest = work.records[0].dt, min(x.n_samples for x in work.records)
    grid = time_constants(slowest_mode(a), shortest, dt)
    degree = 2 if s.degree is None else max(s.degree, 1)
    earlier, values = work.parts(shape), list[float]()
    for tau in grid if len(grid) > 1 and np.isfinite(linear.cost) else ():
        of = schedule_over(work.records, s.schedule, s.column, tau)
        trial = replace(shape, degree=degree)
        found = from_earlier(trial, work.parts(trial, of), work.first, shape, linear.theta, earlier)
        values.append(np.inf if found is None else information("bic", found[1], linear.n, trial.n_theta))
    return slowest_that_does(grid, values) if values and np.isfinite(min(values)) else grid[0]


def by_degree(s: LpvSettings, work: Work, tick: Tick | None) -> Candidate:
    """Fit the equation form with an autoregressive error model, degree by degree.

    `work`: holds on to the best; `tick`: of this part. Returns the best.
    """
    degrees = _DEGREES if s.degree is None else (s.degree,)
    best = None
    for degree, own in zip(degrees, portions(tick, [1.0 + d for d in degrees]), strict=True):
        white = replace(work.shape, degree=degree, ar=0, ma=0)
        shape = replace(white, ar=s.error_order)
        start = padded(shape, white, least_squares(white, work.parts(white), work.first)[0])
        starts: list[Array | None] = [start]
        if best is not None:
            starts.append(padded(shape, best.shape, best.theta))
        found = _noted(work, _from_best(s, work, shape, starts, own, f"degree {degree}"))
        best = _better(work, found, best, s.criterion)
    assert best is not None
    return best


def other_degrees(s: LpvSettings, work: Work, best: Candidate, tick: Tick | None) -> Candidate:
    """Choose the degree once more, now that form and error model are known: a wrong error model may have decided on
    it.

    `work`: holds on to the best; `best`: so far; `tick`: of this part. Returns the best.
    """
    degrees = [d for d in _DEGREES if d != best.shape.degree]
    if s.degree is not None or not np.isfinite(best.cost):
        return best
    for degree, own in zip(degrees, portions(tick, [1.0 + d for d in degrees]), strict=True):
        shape = replace(best.shape, degree=degree)
        start = padded(shape, best.shape, best.theta)
        found = _noted(work, _from_best(s, work, shape, [start], own, f"degree {degree}"))
        best = _better(work, found, best, s.criterion)
    return best


def _better(work: Work, found: Candidate, best: Candidate | None, criterion: str) -> Candidate:
    """The better of two, which is held on to."""
    if best is not None and not found.value(criterion) < best.value(criterion):
        return best
    if np.isfinite(found.cost):
        work.shape, work.theta = found.shape, found.theta
    return found


def _from_best(
    s: LpvSettings, work: Work, shape: LpvShape, starts: Sequence[Array | None], tick: Tick | None, stage: str
) -> Candidate:
    """Search from the start with the least cost."""
    problem = work.problem(shape)
    ranked = sorted(((problem.cost(x), k) for k, x in enumerate(starts) if x is not None), key=lambda x: x[0])
    start = starts[ranked[0][1]]
    assert start is not None
    return searched(work, shape, start, s.iterations, tick, stage)


def wanted_shapes(s: LpvSettings, base: LpvShape) -> list[LpvShape]:
    """Return a shape with the forms and error models that are asked for."""
    return [
        replace(base, form=form, ar=ar, ma=ma)
        for form in (("equation", "output") if s.form == "auto" else (s.form,))
        for ar, ma in error_orders(s.error_form, s.error_order)
    ]


def by_form(s: LpvSettings, work: Work, best: Candidate, tick: Tick | None) -> Candidate:
    """Fit the forms and error models that are asked for.

    `work`: holds on to the best; `best`: what the degree was chosen with; `tick`: of this part. Returns the best.
    """
    shortest = min(x.n_samples for x in work.records)
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
        if shape.form == "output" and s.form == "auto" and not stable_process(earlier[0].shape, earlier[0].theta):
            continue  # earlier[0]: the best of the equation form, or of the output form, which is stable
        parts = work.parts(shape)
        starts: list[Array | None] = [padded(shape, without_error_model(best.shape), _process(best))]
        if shape.form == "equation" and shape.ma and not shape.ar:
            starts.append(by_long_regression(shape, parts, work.first))
        for x in earlier[:2]:
            regression = from_earlier(shape, parts, work.first, x.shape, x.theta)
            starts += [padded(shape, x.shape, x.theta), None if regression is None else regression[0]]
        named = f"{shape.form} form, {_named(shape)}"
        found = known[shape] = _noted(work, _from_best(s, work, shape, starts, own, named))
        if shape in wanted:
            chosen = _better(work, found, chosen, "bic")
    return chosen or best


def _process(x: Candidate) -> Array:
    return x.theta[: x.shape.n_process_theta]


def _named(shape: LpvShape) -> str:
    kinds = [f"{k} {n}" for k, n in (("AR", shape.ar), ("MA", shape.ma)) if n]
    return ", ".join(kinds) + " errors" if kinds else "white errors"
