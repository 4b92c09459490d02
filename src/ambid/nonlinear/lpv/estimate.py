"""LPV models scheduled by set point: system model and error model by prediction error, coefficients functions of p.

Scale -> set point (its low-pass, where left open) -> degree in p, form and error model, each by a criterion of
the one-step errors -> Levenberg-Marquardt with exact derivatives. Starts come from least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter

import numpy as np

from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.progress import Tick, portions
from ambid.nonlinear.failed import failed_fit
from ambid.nonlinear.fit import NonlinearFit, Settings
from ambid.nonlinear.lpv.beginning import looks_back
from ambid.nonlinear.lpv.candidates import (
    Work,
    by_degree,
    by_form,
    chosen_level,
    other_degrees,
    searched,
    wanted_shapes,
)
from ambid.nonlinear.lpv.result import finished
from ambid.nonlinear.lpv.schedule import Schedule, schedule_over
from ambid.nonlinear.lpv.settings import LpvSettings, lpv_settings
from ambid.nonlinear.lpv.shape import LpvShape
from ambid.nonlinear.lpv.start import least_squares
from ambid.nonlinear.records import scaled_records

DIVERGED = "no one-step predictor that stays finite was found; lower degree, order or error_order, or check the columns"
UNSTABLE = (
    "the output form cannot be fitted: its process part diverges over the records, as that of an unstable plant does. "
    "Say form = equation"
)


def lpv(records: Sequence[IOData], settings: Settings, *, seed: int = 0, tick: Tick | None = None) -> NonlinearFit:
    """Identify a linear model whose coefficients follow a scheduling signal, with an error model (thesis sec. 1.6).

    Consistent under feedback as long as the error model holds the true one. Standard deviations take degree, form and
    set point for given: chosen on a few hundred samples, 95 % intervals hold the truth about 92 times in 100.

    `records`: of one bench, one output; `settings`: described in the register of structures; `seed`: taken for the
    contract's sake: nothing here is random; `tick`: called with the stage; may raise KeyboardInterrupt.
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
    tau = 0.0 if s.column >= 0 else (s.time_constant if s.time_constant is not None else 50.0 * records[0].dt)
    last = Schedule(name=s.schedule, column=s.column, time_constant=tau, low=0.0, high=0.0).share(records[0].dt) == 1.0
    shape = LpvShape(
        columns=s.columns, order=s.order, nb=s.nb, nk=s.nk, ar=0, ma=0, degree=s.degree or 0,
        error_degree=s.error_degree, form="equation", basis=s.basis, offset="constant" if last else "scheduled",
    )  # fmt: skip
    first = shape.first + s.error_order
    for r, x in enumerate(records):  # before it is said that a scheduling column does not excite
        if (x.inputs, x.outputs) != (records[0].inputs, records[0].outputs):
            scaled_records("lpv", records, lag=first)
        if r == 0 and s.column >= 0:
            schedule_over(records, s.schedule, s.column, 0.0)
    data = scaled_records("lpv", records, lag=max(first, min(looks_back(x) for x in wanted_shapes(s, shape))))
    _long_enough(s, shape, sum(x.n_samples - first for x in records))
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


def _long_enough(s: LpvSettings, shape: LpvShape, n: int) -> None:
    """Refuse records that have no more samples than the numbers asked for: those fit anything."""
    k = shape.n_theta + s.error_order * (s.error_degree + 1) * (2 if s.error_form == "arma" else 1)
    if n <= k + 1:
        raise EstimationError(
            f"lpv: {n} samples are left after lags for {k} numbers. Give longer records, or lower "
            f"{'order or error_order' if s.degree is None else 'degree, order or error_order'}"
        )


def _used(s: LpvSettings, work: Work) -> dict[str, object]:
    """Settings with nothing left open."""
    of = work.shape
    form = {(False, False): "white", (True, False): "ar", (False, True): "ma", (True, True): "arma"}
    return {
        **s.as_mapping(),
        "degree": of.degree,
        "time_constant": work.schedule.time_constant,
        "error_order": max(of.ar, of.ma),
        "form": of.form,
        "error_form": form[of.ar > 0, of.ma > 0],
    }


def _identify(s: LpvSettings, work: Work, tick: Tick | None) -> str:
    """Choose and fit; returns why there is no model, or nothing."""
    ticks = portions(tick, (1.0, 4.0, 10.0, 0.0 if s.degree is not None else 6.0, 10.0))
    began = perf_counter()
    if ticks[0] is not None:
        ticks[0]("set point", 0.0)
    if s.time_constant is None:
        tau = chosen_level(s, work, ticks[0])
        work.schedule = schedule_over(work.records, s.schedule, s.column, tau)
        work.theta = least_squares(work.shape, work.parts(work.shape), work.first)[0]
    work.timing_s["set point"], began = perf_counter() - began, perf_counter()
    best = by_degree(s, work, ticks[1])
    work.timing_s["degree"], began = perf_counter() - began, perf_counter()
    best = other_degrees(s, work, by_form(s, work, best, ticks[2]), ticks[3])
    work.timing_s["form"], began = perf_counter() - began, perf_counter()
    if not np.isfinite(best.cost):
        return UNSTABLE if s.form == "output" else DIVERGED
    work.shape, work.theta = best.shape, best.theta
    searched(work, best.shape, best.theta, s.iterations, ticks[4], "prediction errors", last=True)
    work.timing_s["search"] = perf_counter() - began
    return ""
