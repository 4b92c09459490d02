"""Networks of radial basis functions from records: lags, centres, widths, weights, then whatever is trained further.

Scale -> lags, number of units and their width (where left open) -> centres -> output weights by regularised least
squares -> everything by Levenberg-Marquardt, or recursively, or by steepest descent (options) -> simulation errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.progress import Tick, portions
from ambid.estimation.search import Found, search
from ambid.nonlinear.failed import failed_fit
from ambid.nonlinear.fit import LearningCurve, NonlinearFit, Settings
from ambid.nonlinear.rbf.choice import Tried, chosen, error, split
from ambid.nonlinear.rbf.placing import Told, rows_of, shape_of
from ambid.nonlinear.rbf.problem import RbfProblem, problem_at
from ambid.nonlinear.rbf.recursive import DESCENT, GAUSS_NEWTON, Recursion, left_to_gain, without_weights
from ambid.nonlinear.rbf.result import finished
from ambid.nonlinear.rbf.shape import RbfShape
from ambid.nonlinear.rbf.units import UNITS
from ambid.nonlinear.rbf.weights import fitted_weights
from ambid.nonlinear.records import Scaled, scaled_records
from ambid.nonlinear.settings import checked

_RANGES: Mapping[str, tuple[float, float]] = {
    "ny": (0, 50),
    "nu": (0, 50),
    "nk": (0, 1000),
    "linear": (0, 1),
    "neurons": (0, 200),
    "width": (0.01, 100.0),
    "prior": (1e-6, 1e9),
    "held_out": (0.0, 0.5),
    "rate": (0.0, 1e6),
    "bounded": (0, 1),
    "passes": (1, 1000),
    "iterations": (1, 2000),
}
_CHOICES: Mapping[str, tuple[str, ...]] = {
    "unit": UNITS,
    "seen": ("all", "outputs", "inputs"),
    "metric": ("scaled", "whitened"),
    "centres": ("ols", "kmeans"),
    "widths": ("common", "neighbours"),
    "choice": ("held_out", "bic", "aicc", "aic"),
    "training": ("linear", "recursive", "descent"),
    "trained": ("weights", "all"),
    "focus": ("prediction", "simulation"),
    "uncertainty": ("auto", "laplace", "sandwich", "none"),
}
_DEFAULTS: Mapping[str, object] = {
    "nk": 1,
    "linear": 1,
    "unit": "gaussian",
    "metric": "scaled",
    "centres": "ols",
    "choice": "held_out",
    "held_out": 0.2,
    "training": "linear",
    "trained": "weights",
    "bounded": 1,
    "iterations": 60,
    "focus": "prediction",
    "uncertainty": "auto",
}
_ARRIVED = 1.0  # squared standard deviations from the optimum, of all that is trained together


@dataclass(slots=True)
class Work:
    """What a fit has come to, so that an interruption loses nothing."""

    shape: RbfShape
    theta: Array  # (n_theta,)
    start: Array  # (n_theta,), where centres and widths were put
    prior: Array  # (n_outputs,)
    noise: Array | None = None  # (n_outputs,), or None, where the weights' own solution has it
    everything: bool = False  # whether centres and widths are trained
    free: bool = False  # whether `theta` is that of simulation errors
    status: Literal["converged", "stalled"] = "converged"
    arrived: bool = True  # whether `theta` is an optimum, so that a covariance makes sense
    stopped_early: bool = False
    curves: list[LearningCurve] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    timing_s: dict[str, float] = field(default_factory=dict)
    tried: tuple[Tried, ...] = ()
    seen: str = "all"
    held_out: float = float("nan")  # naN without
    width: float = float("nan")


def rbf(records: Sequence[IOData], settings: Settings, *, seed: int = 0, tick: Tick | None = None) -> NonlinearFit:
    """Identify a network of radial basis functions, y(t) = L z + c + W phi(z) + e(t) (thesis eqs 1.13, 1.14).

    Its errors are taken as white: under feedback, or with coloured noise, it is biased. The covariance is that of what
    was trained; centres and widths that were chosen before are taken as given, which a warning says: intervals of the
    weights hold for these units, those of the function are too narrow by what the choice of the units adds.

    `records`: of one bench; `settings`: described in the register of structures; `seed`: of the candidates among the
    data, and of k-means; `tick`: called with the stage and the share that is over; may raise KeyboardInterrupt.
    """
    s: dict[str, Any] = {**_DEFAULTS, **checked("rbf", settings, _RANGES, _CHOICES)}
    s.setdefault("widths", "common" if s["centres"] == "ols" else "neighbours")
    s.setdefault("rate", 0.02 if s["training"] == "descent" else 0.0)
    s.setdefault("passes", 20 if s["training"] == "descent" or s["trained"] == "all" else 1)
    if s.get("ny") == 0 and s.get("nu") == 0:
        raise EstimationError("rbf: ny and nu are both 0; nothing is left to predict from. Raise one of them")
    nothing = {"outputs": s.get("ny") == 0, "inputs": s.get("nu") == 0 or not records or not records[0].n_inputs}
    if nothing.get(str(s.get("seen")), False):
        raise EstimationError(f"rbf: units are to see {s['seen']} alone, and there are none. Say seen = all")
    _consistent(s)
    began = perf_counter()
    data = scaled_records("rbf", records, lag=max(s.get("ny") or 1, s["nk"] + (s.get("nu") or 1) - 1))
    told = _told(s)
    work = _linear(told, data)
    try:
        _identify(s, told, data, work, seed, tick)
    except KeyboardInterrupt:
        work.status, work.arrived = "stalled", False
        work.warnings.insert(0, "interrupted: the best model so far")
    except (np.linalg.LinAlgError, FloatingPointError) as problem:
        work.timing_s["all"] = perf_counter() - began
        return failed_fit("rbf", records, s, seed, f"the training broke down: {problem}", work.timing_s)
    shape = work.shape
    used = {**s, "ny": shape.lags.ny, "nu": shape.lags.nu, "neurons": shape.neurons, "width": work.width}
    used["seen"] = work.seen
    used["prior"] = float(np.exp(np.mean(np.log(work.prior))))
    return finished(records, used, data, work, seed=seed)


def _consistent(s: Mapping[str, Any]) -> None:
    """Refuse settings of which one makes the other void."""
    rate, training = float(s["rate"]), s["training"]
    if training == "recursive" and not rate < 1.0:
        raise EstimationError(
            f"rbf: rate is {rate:g}; recursive training takes the least gain by it, which must be below 1. "
            "Say 0 to count all samples alike"
        )
    if training == "descent" and not rate > 0.0:
        raise EstimationError("rbf: rate is 0, with which steepest descent does not move. Raise it")
    is_open = any(s.get(k) is None for k in ("ny", "nu", "neurons", "width", "seen"))
    if is_open and s["choice"] == "held_out" and not s["held_out"] > 0:
        raise EstimationError(
            "rbf: held_out is 0, and what is left open is to be chosen by held-out errors. Raise it, say choice = bic, "
            "or give ny, nu, neurons, width and seen"
        )


def _told(s: Mapping[str, Any]) -> Told:
    given: dict[str, Any] = {k: s[k] for k in ("nk", "unit", "centres", "widths", "metric", "choice")}
    given |= {k: s.get(k) for k in ("ny", "nu", "neurons", "width", "seen", "prior")}
    return Told(
        **given,
        linear=bool(s["linear"]),
        share=float(s["held_out"]),
        free=s["focus"] == "simulation",
    )


def _linear(told: Told, data: Scaled) -> Work:
    """A model without units: something to hand over when the very next thing is an interruption."""
    shape = shape_of(told, data.parts, 1 if told.ny is None else told.ny, 1 if told.nu is None else told.nu, 0)
    z, y = rows_of(shape, data.parts)
    known = np.hstack([z if told.linear else z[:, :0], np.ones((z.shape[0], 1))])
    found = np.linalg.lstsq(known, y, rcond=1e-12)[0]
    theta = np.concatenate([found[:-1].T.ravel(), found[-1]])
    return Work(shape=shape, theta=theta, start=theta, prior=np.ones(y.shape[1]))


def _identify(s: Mapping[str, Any], told: Told, data: Scaled, work: Work, seed: int, tick: Tick | None) -> None:
    free = s["focus"] == "simulation"
    ticks = portions(tick, (3.0, 0.5, 3.0 if s["training"] != "linear" or s["trained"] == "all" else 0.0, 10.0 * free))
    began = perf_counter()
    if tick is not None:
        tick("start", 0.0)
    found = chosen(told, data.parts, seed, ticks[0])
    work.width, work.seen, work.tried = found.width, found.seen, found.tried
    if told.neurons is not None and found.shape.neurons < told.neurons:
        work.warnings.append(
            f"{found.shape.neurons} units instead of {told.neurons}: more have no place of their own in the data, or "
            "there are fewer than two samples for each"
        )
    work.timing_s["choice"] = perf_counter() - began
    began = perf_counter()
    if ticks[1] is not None:
        ticks[1]("output weights", 0.0)
    solved = _solve(told, found.shape, found.theta, data, work)
    work.timing_s["output weights"] = perf_counter() - began
    began = perf_counter()
    work.everything = s["trained"] == "all" and found.shape.neurons > 0
    if s["training"] != "linear":
        _recur(s, solved, data, work, ticks[2])
    elif work.everything:
        _tune(s, data, work, ticks[2])
    work.timing_s["training"] = perf_counter() - began
    if free:
        began = perf_counter()
        _refine(s, data, work, ticks[3])
        work.timing_s["simulation errors"] = perf_counter() - began


def _solve(told: Told, shape: RbfShape, start: Array, data: Scaled, work: Work) -> Array:
    """Find the output weights; the error on held-out data is that of weights that have not seen them."""
    began = perf_counter()
    z, y = rows_of(shape, data.parts)
    found = fitted_weights(shape, start, z, y, told.prior)
    took = perf_counter() - began
    training, held = split(data.parts, told.share, shape.lags.lag)
    if held:
        part = fitted_weights(shape, start, *rows_of(shape, training), told.prior)
        work.held_out = error(shape, part.theta, held)
    work.shape, work.theta, work.start, work.prior, work.noise = shape, found.theta, start, found.prior, found.noise
    work.curves.append(
        LearningCurve(
            method="linear least squares, output weights",
            seconds=np.array([0.0, took]),
            training=np.array([float(np.sqrt(np.mean(y**2))), error(shape, found.theta, data.parts)]),
        )
    )
    return found.theta


def _problem(data: Scaled, work: Work, theta: Array, *, free: bool = False) -> RbfProblem:
    return problem_at(
        work.shape, data.parts, theta, work.prior, work.start, everything=work.everything, free=free,
        noise=None if free or work.everything else work.noise,
    )  # fmt: skip


def _tune(s: Mapping[str, Any], data: Scaled, work: Work, tick: Tick | None) -> None:
    """Go on with centres and widths as well, watched on held-out data, and end on all data."""
    training, held = split(data.parts, float(s["held_out"]), work.shape.lags.lag)
    shape, watch = work.shape, None
    if held:
        part = fitted_weights(shape, work.start, *rows_of(shape, training), s.get("prior"))
        problem = problem_at(shape, training, part.theta, part.prior, work.start, everything=True)
        ticks = portions(tick, (1.0, 1.0))

        def watch(theta: Array) -> float:
            return error(shape, theta, held)

        found = search(problem, part.theta, stage="training", most=s["iterations"], held_out=watch, tick=ticks[0])
        _note(work, found, problem, "everything, one-step errors")
        work.held_out = watch(found.theta)
        work.stopped_early = found.stopped_early
        if found.stopped_early:  # more would learn the noise
            work.theta = found.theta
            return
        tick = ticks[1]
    _everything(s, data, work, work.theta, tick, note=watch is None)


def _everything(s: Mapping[str, Any], data: Scaled, work: Work, theta: Array, tick: Tick | None, *, note: bool) -> None:
    for round_ in range(2):  # the errors' sizes are known only afterwards
        problem = _problem(data, work, theta)
        found = search(problem, theta, stage="all data", most=s["iterations"], tick=tick)
        work.theta = theta = found.theta
        if note and not round_:
            _note(work, found, problem, "everything, one-step errors")
    work.status = "converged" if found.converged else "stalled"


def _note(work: Work, found: Found, problem: RbfProblem, what: str) -> None:
    weight = float(np.sqrt(np.mean(problem.weight**2)))
    work.curves.append(
        LearningCurve(
            method=f"Levenberg-Marquardt, {what}",
            seconds=np.array(found.seconds),
            training=np.sqrt(np.array(found.costs) / problem.n_errors) / weight,
            held_out=np.array(found.held_out),
        )
    )


def _recur(s: Mapping[str, Any], solved: Array, data: Scaled, work: Work, tick: Tick | None) -> None:
    """Train sample by sample, from weights of zero; beside steepest descent recursive Gauss-Newton is shown too."""
    problem = _problem(data, work, solved)
    begin = without_weights(work.shape, work.start)
    descent = s["training"] == "descent"
    ticks = portions(tick, (float(descent), 1.0))
    told = {"bounded": bool(s["bounded"]), "passes": s["passes"]}
    if descent:
        own = Recursion(problem, begin, method=DESCENT, rate=s["rate"], **told)
        own.run(ticks[0])
        work.curves.append(own.curve())
        work.theta = own.theta
        beside = Recursion(problem, begin, method=GAUSS_NEWTON, rate=0.0, bounded=True, passes=s["passes"])
        beside.run(ticks[1])
        work.curves.append(beside.curve())
    else:
        own = Recursion(problem, begin, method=GAUSS_NEWTON, rate=s["rate"], **told)
        own.run(ticks[1])
        work.curves.append(own.curve())
        work.theta = own.theta
    left = left_to_gain(_problem(data, work, work.theta), work.theta)
    if not left < _ARRIVED:
        work.status, work.arrived = "stalled", False
        work.warnings.append(
            f"{own.method} has not arrived: a batch step would still lower the sum of squares by {left:.3g} times the "
            "errors' variance, and so there are no standard deviations. Give more passes, or training = linear"
        )


def _refine(s: Mapping[str, Any], data: Scaled, work: Work, tick: Tick | None) -> None:
    """Go on with the errors of the free run."""
    n = work.shape.n_theta if work.everything else work.shape.n_weights
    problem = _problem(data, work, work.theta, free=True)
    if not np.isfinite(problem.cost(work.theta[:n])):
        work.status = "stalled"
        work.warnings.append(
            "the free run diverges, so that the weights are those of the one-step errors: fewer units or other lags"
        )
        return
    for part in portions(tick, (1.0, 1.0)):  # the errors' sizes are known only afterwards

        def keep(v: Array) -> None:
            work.theta, work.free = np.concatenate([v, work.theta[n:]]), True

        found = search(problem, work.theta[:n], stage="simulation errors", most=s["iterations"], tick=part, keep=keep)
        keep(found.theta)
        _note(work, found, problem, "simulation errors")
        work.status = "converged" if found.converged else "stalled"
        work.arrived = work.arrived or found.converged  # wherever it came from
        if found.converged and data.y_level.size == 1:
            break
        problem = _problem(data, work, work.theta, free=True)
