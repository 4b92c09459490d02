"""LPV models scheduled by set point: system model and error model by prediction error, coefficients functions of p.

Scale -> set point (its low-pass, where left open) -> degree in p, form and error model, each by a criterion of
the one-step errors -> Levenberg-Marquardt with exact derivatives. Starts come from least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.errors import EstimationError
from ambid.identify.blackbox.data import IOData
from ambid.identify.lpv.choice import chosen_time_constant, error_orders, information
from ambid.identify.lpv.problem import LpvProblem
from ambid.identify.lpv.result import finished
from ambid.identify.lpv.schedule import Schedule, schedule_over
from ambid.identify.lpv.settings import LpvSettings, lpv_settings
from ambid.identify.lpv.shape import LpvShape, Part, part_of, stable_process
from ambid.identify.lpv.start import from_earlier, least_squares, padded, without_error_model
from ambid.identify.networks.failed import failed_fit
from ambid.identify.networks.records import Scaled, scaled_records
from ambid.identify.networks.search import search
from ambid.identify.nonlinear.fit import LearningCurve, NonlinearFit, Settings
from ambid.identify.nonlinear.progress import Tick, guessed, portions

Array = NDArray[np.float64]

DIVERGED = "no one-step predictor that stays finite was found; lower degree, order or error_order, or check the columns"
UNSTABLE = (
    "the output form cannot be fitted: its process part diverges over the records, as that of an unstable plant does. "
    "Say form = equation"
)

_DEGREES = (0, 1, 2, 3)
_SHORT, _USUAL = 15, 8.0  # iterations of a candidate; half of what a search takes


@dataclass(slots=True)
class Work:
    """What a fit has come to, so that an interruption loses nothing.

    Attributes
    ----------
    data : Scaled
    records : sequence of IOData
    schedule : Schedule
    shape : LpvShape
    theta : ndarray, shape (n_theta,), scaled
    first : int
        Errors count from this sample on.
    status : {"converged", "stalled"}
    curves : list of LearningCurve
    warnings : list of str
    tried : list of dict
        Candidates with their criterion.
    timing_s : dict of str to float
    """

    data: Scaled
    records: Sequence[IOData]
    schedule: Schedule
    shape: LpvShape
    theta: Array
    first: int
    status: Literal["converged", "stalled"] = "converged"
    curves: list[LearningCurve] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    tried: list[dict[str, object]] = field(default_factory=list)
    timing_s: dict[str, float] = field(default_factory=dict)

    def parts(self, shape: LpvShape, schedule: Schedule | None = None) -> tuple[Part, ...]:
        """Return the records, ready for a shape.

        Parameters
        ----------
        shape : LpvShape
        schedule : Schedule, optional
            Another one than that of the fit.

        Returns
        -------
        tuple of Part
        """
        of = schedule or self.schedule
        return tuple(
            part_of(shape, y[:, 0], u, of.scaled(of.signal(x.u, x.y, x.dt)))
            for x, (y, u) in zip(self.records, self.data.parts, strict=True)
        )

    def problem(self, shape: LpvShape, weight: float = 1.0) -> LpvProblem:
        """Return what is searched in for a shape.

        Parameters
        ----------
        shape : LpvShape
        weight : float, optional
            One over the standard deviation of the errors.

        Returns
        -------
        LpvProblem
        """
        return LpvProblem(shape=shape, parts=self.parts(shape), first=self.first, weight=weight)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidate:
    """A fitted shape.

    Attributes
    ----------
    shape : LpvShape
    theta : ndarray, shape (n_theta,), scaled
    cost : float
        Sum of squared one-step errors, scaled; infinite where the predictor is unstable.
    n, starts : int
        Errors, and numbers that stand for what was before the records.
    """

    shape: LpvShape
    theta: Array
    cost: float = np.inf
    n: int = 1
    starts: int = 0

    def value(self, criterion: str) -> float:
        """Return an information criterion.

        Parameters
        ----------
        criterion : {"bic", "aic", "aicc"}

        Returns
        -------
        float
            The smaller the better.
        """
        return information(criterion, self.cost, self.n, self.shape.n_theta, self.starts)


def lpv(records: Sequence[IOData], settings: Settings, *, seed: int = 0, tick: Tick | None = None) -> NonlinearFit:
    """Identify a linear model whose coefficients follow a scheduling signal, with an error model (thesis sec. 1.6).

    Consistent under feedback as long as the error model holds the true one.

    Parameters
    ----------
    records : sequence of IOData
        Of one bench, one output.
    settings : Mapping
        Described in the register of structures.
    seed : int, optional
        Taken for the contract's sake: nothing here is random.
    tick : callable, optional
        Called with the stage; may raise KeyboardInterrupt.

    Returns
    -------
    NonlinearFit

    Raises
    ------
    EstimationError
        If a setting is not known, records do not belong together, are too short, a channel does not move, or the
        scheduling signal is constant.
    """
    if not records:
        raise EstimationError("lpv: no record is given. Pass one at least")
    s = lpv_settings(settings, records[0])
    began = perf_counter()
    work = _begun(s, records)
    reason = ""
    try:
        reason = _identify(s, work, tick)
    except KeyboardInterrupt:
        work.status = "stalled"
        work.warnings.insert(0, "interrupted: the best model so far")
    except np.linalg.LinAlgError as error:
        reason = f"the search broke down: {error}"
    else:
        if work.status == "stalled":
            work.warnings.insert(0, "the search did not converge: treat the numbers as a first guess")
    work.timing_s["all"] = perf_counter() - began
    used = _used(s, work)
    if not reason and not np.isfinite(work.problem(work.shape).cost(work.theta)):
        reason = DIVERGED
    if reason:
        return failed_fit("lpv", records, used, seed, reason, work.timing_s)
    return finished(records, used, work, seed=seed)


def _begun(s: LpvSettings, records: Sequence[IOData]) -> Work:
    """A model by least squares: something to hand over when the very next thing is an interruption."""
    shape = LpvShape(
        columns=s.columns, order=s.order, nb=s.nb, nk=s.nk, ar=0, ma=0, degree=s.degree or 0,
        error_degree=s.error_degree, form="equation", basis=s.basis,
    )  # fmt: skip
    first = shape.first + s.error_order
    for r, x in enumerate(records):  # before it is said that a scheduling column does not excite
        if (x.inputs, x.outputs) != (records[0].inputs, records[0].outputs):
            scaled_records("lpv", records, lag=first)
        if r == 0 and s.column >= 0:
            schedule_over(records, s.schedule, s.column, 0.0)
    data = scaled_records("lpv", records, lag=first)
    tau = 0.0 if s.column >= 0 else (s.time_constant if s.time_constant is not None else 50.0 * records[0].dt)
    work = Work(
        data=data,
        records=records,
        schedule=schedule_over(records, s.schedule, s.column, tau),
        shape=shape,
        theta=np.zeros(shape.n_theta),
        first=first,
    )
    work.theta = least_squares(shape, work.parts(shape), first)[0]
    return work


def _used(s: LpvSettings, work: Work) -> dict[str, object]:
    """Settings with nothing left open."""
    of = work.shape
    form = {(False, False): "white", (True, False): "ar", (False, True): "ma", (True, True): "arma"}
    return {
        **s.as_mapping(),
        "degree": of.degree,
        "time_constant": work.schedule.time_constant,
        "form": of.form,
        "error_form": form[of.ar > 0, of.ma > 0],
    }


def _identify(s: LpvSettings, work: Work, tick: Tick | None) -> str:
    """Choose and fit; returns why there is no model, or nothing."""
    ticks = portions(tick, (1.0, 4.0, 10.0, 5.0))
    began = perf_counter()
    if ticks[0] is not None:
        ticks[0]("set point", 0.0)
    if s.time_constant is None:
        tau = chosen_time_constant(work.shape, work.records, work.data, work.first)
        work.schedule = schedule_over(work.records, s.schedule, s.column, tau)
        work.theta = least_squares(work.shape, work.parts(work.shape), work.first)[0]
    work.timing_s["set point"], began = perf_counter() - began, perf_counter()
    best = _by_degree(s, work, ticks[1])
    work.timing_s["degree"], began = perf_counter() - began, perf_counter()
    best = _by_form(s, work, best, ticks[2])
    work.timing_s["form"], began = perf_counter() - began, perf_counter()
    if not np.isfinite(best.cost):
        return UNSTABLE if s.form == "output" else DIVERGED
    _keep(work, best)
    _searched(work, best.shape, best.theta, s.iterations, ticks[3], "prediction errors", last=True)
    work.timing_s["search"] = perf_counter() - began
    return ""


def _keep(work: Work, x: Candidate) -> None:
    work.shape, work.theta = x.shape, x.theta


def _searched(
    work: Work, shape: LpvShape, theta: Array, most: int, tick: Tick | None, stage: str, *, last: bool = False
) -> Candidate:
    """Search from a start; the last search of a fit writes down its course."""
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

    found = search(problem, theta, stage=stage, most=most, tolerance=1e-9, enough=1e-6, tick=counted, keep=keep)
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
    of, found = x.shape, {k: x.value(k) if np.isfinite(x.cost) else None for k in ("aicc", "bic")}
    work.tried.append({"form": of.form, "degree": of.degree, "ar": of.ar, "ma": of.ma, **found})
    return x


def _by_degree(s: LpvSettings, work: Work, tick: Tick | None) -> Candidate:
    """Equation form with an autoregressive error model, degree by degree."""
    degrees = _DEGREES if s.degree is None else (s.degree,)
    best, worse = None, 0
    for degree, own in zip(degrees, portions(tick, [1.0 + d for d in degrees]), strict=True):
        white = replace(work.shape, degree=degree, ar=0, ma=0)
        shape = replace(white, ar=s.error_order)
        start = padded(shape, white, least_squares(white, work.parts(white), work.first)[0])
        starts: list[Array | None] = [start]
        if best is not None and s.basis == "legendre":
            starts.append(padded(shape, best.shape, best.theta))
        found = _noted(work, _from_best(work, shape, starts, own, f"degree {degree}"))
        if best is None or found.value(s.criterion) < best.value(s.criterion):
            best, worse = found, 0
            if np.isfinite(found.cost):
                _keep(work, found)
        else:
            worse += 1
        if worse == 2:
            break
    assert best is not None
    return best


def _from_best(work: Work, shape: LpvShape, starts: Sequence[Array | None], tick: Tick | None, stage: str) -> Candidate:
    """Search from the start with the least cost."""
    problem = work.problem(shape)
    ranked = sorted(((problem.cost(x), k) for k, x in enumerate(starts) if x is not None), key=lambda x: x[0])
    start = starts[ranked[0][1]]
    assert start is not None
    return _searched(work, shape, start, _SHORT, tick, stage)


def _by_form(s: LpvSettings, work: Work, best: Candidate, tick: Tick | None) -> Candidate:
    """The forms and error models that are asked for, beginning with what the degree was chosen with."""
    wanted = [
        replace(best.shape, form=form, ar=ar, ma=ma)
        for form in (("equation", "output") if s.form == "auto" else (s.form,))
        for ar, ma in error_orders(s.error_form, s.error_order)
    ]
    known = {best.shape: best}
    chosen = best if best.shape in wanted else None
    for shape, own in zip(wanted, portions(tick, [1.0] * len(wanted)), strict=True):
        if shape in known:
            continue
        if shape.form == "output" and s.form == "auto" and not stable_process(best.shape, best.theta):
            continue
        earlier = [x for x in known.values() if np.isfinite(x.cost)]
        earlier.sort(key=lambda x: (x.shape.form != shape.form, x.value("bic")))
        parts = work.parts(shape)
        starts: list[Array | None] = [padded(shape, without_error_model(best.shape), _process(best))]
        for x in earlier[:2]:
            starts += [padded(shape, x.shape, x.theta), from_earlier(shape, parts, work.first, x.shape, x.theta)]
        named = f"{shape.form} form, {_named(shape)}"
        found = known[shape] = _noted(work, _from_best(work, shape, starts, own, named))
        if chosen is None or found.value("bic") < chosen.value("bic"):
            chosen = found
            if np.isfinite(found.cost):
                _keep(work, found)
    return chosen or best


def _process(x: Candidate) -> Array:
    return x.theta[: x.shape.n_process * (x.shape.degree + 1)]


def _named(shape: LpvShape) -> str:
    kinds = [f"{k} {n}" for k, n in (("AR", shape.ar), ("MA", shape.ma)) if n]
    return ", ".join(kinds) + " errors" if kinds else "white errors"
