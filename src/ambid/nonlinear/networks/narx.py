"""Neural NARX from records: sizes by held-out error, several starts, Levenberg-Marquardt, early stopping, covariance.

Scale -> lags and neurons (where left open) -> training from several random starts, each watched on held-out data -> the
best, once more on all data -> simulation errors (option) -> covariance by Laplace's approximation, or bootstrap.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.progress import Tick, part_of, portions
from ambid.estimation.search import Found, search
from ambid.estimation.uncertainty import bootstrapped
from ambid.nonlinear.failed import failed_fit
from ambid.nonlinear.fit import LearningCurve, NonlinearFit, Settings
from ambid.nonlinear.networks.narx_choice import Tried, chosen_sizes, held_out_error, problem_at, split
from ambid.nonlinear.networks.narx_function import NarxShape
from ambid.nonlinear.networks.narx_result import finished
from ambid.nonlinear.networks.narx_train import linear_start, random_start
from ambid.nonlinear.records import Scaled, scaled_records
from ambid.nonlinear.settings import checked

_RANGES: Mapping[str, tuple[float, float]] = {
    "ny": (0, 50),
    "nu": (0, 50),
    "nk": (0, 1000),
    "neurons": (0, 60),
    "starts": (1, 50),
    "held_out": (0.0, 0.5),
    "prior": (0.01, 1e6),
    "iterations": (1, 2000),
}
_CHOICES: Mapping[str, tuple[str, ...]] = {
    "focus": ("prediction", "simulation"),
    "uncertainty": ("auto", "laplace", "sandwich", "bootstrap", "none"),
}
_DEFAULTS: Mapping[str, object] = {
    "nk": 1,
    "starts": 3,
    "held_out": 0.2,
    "prior": 10.0,
    "iterations": 60,
    "focus": "prediction",
    "uncertainty": "auto",
}
_ENOUGH = 1e-2  # gain that ends a search: a step of 0.1 standard deviations
_FIRST = 12  # iterations of every start; only the best goes on


@dataclass(slots=True)
class Work:
    """What a fit has come to, so that an interruption loses nothing."""

    shape: NarxShape
    theta: Array  # (n_theta,)
    free: bool = False  # whether `theta` is that of simulation errors
    status: Literal["converged", "stalled"] = "converged"
    stopped_early: bool = False
    curves: list[LearningCurve] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    timing_s: dict[str, float] = field(default_factory=dict)
    tried: tuple[Tried, ...] = ()
    held_out: float = float("nan")  # of the chosen weights; NaN without
    covariance: Array | None = None  # (n_theta, n_theta), or None, by bootstrap


def narx(records: Sequence[IOData], settings: Settings, *, seed: int = 0, tick: Tick | None = None) -> NonlinearFit:
    """Identify a neural NARX model, y(t) = L z + c + W2 tanh(W1 z + b1) + e(t) (Billings 2013, sec. 8.2).

    Its errors are taken as white: under feedback, or with coloured noise, it is biased.

    `records`: of one bench; `settings`: described in the register of structures; `seed`: of the starts and the
    bootstrap; `tick`: called with the stage; may raise KeyboardInterrupt.
    """
    s = {**_DEFAULTS, **checked("narx", settings, _RANGES, _CHOICES, auto=("ny", "nu", "neurons"))}
    if s.get("ny") == 0 and s.get("nu") == 0:
        raise EstimationError("narx: ny and nu are both 0; nothing is left to predict from. Raise one of them")
    began = perf_counter()
    least = max(int(s.get("ny") or 1), int(s["nk"]) + int(s.get("nu") or 1) - 1)  # type: ignore[call-overload]
    data = scaled_records("narx", records, lag=least)
    work = _linear(s, data)
    try:
        _identify(s, data, work, seed, tick)
    except KeyboardInterrupt:
        work.status = "stalled"
        work.warnings.insert(0, "interrupted: the best model so far")
    except np.linalg.LinAlgError as error:
        work.timing_s["all"] = perf_counter() - began
        return failed_fit("narx", records, s, seed, f"the training broke down: {error}", work.timing_s)
    used = {**s, "ny": work.shape.ny, "nu": work.shape.nu, "neurons": work.shape.neurons}
    return finished(records, used, data, work, seed=seed)


def _linear(s: Mapping[str, object], data: Scaled) -> Work:
    """A linear model: something to hand over when the very next thing is an interruption."""
    y, u = data.parts[0]
    ny, nu = s.get("ny", 1), s.get("nu", 1)
    shape = NarxShape(
        n_outputs=y.shape[1], n_inputs=u.shape[1], ny=ny, nu=nu if u.shape[1] else 0, nk=s["nk"], neurons=0,  # type: ignore[arg-type]
    )  # fmt: skip
    return Work(shape=shape, theta=linear_start(shape, data.parts))


def _identify(s: Mapping[str, object], data: Scaled, work: Work, seed: int, tick: Tick | None) -> None:
    free, many = s["focus"] == "simulation", s["uncertainty"] == "bootstrap"
    choice, training, refining, last = portions(tick, (3.0, 5.0, 8.0 * free, 4.0 * many))
    share, prior = float(s["held_out"]), float(s["prior"])  # type: ignore[arg-type]
    began = perf_counter()
    ny, nu, neurons, work.tried = chosen_sizes(
        data.parts,
        (s.get("ny"), s.get("nu"), s.get("neurons")),  # type: ignore[arg-type]
        nk=int(s["nk"]),  # type: ignore[call-overload]
        share=share or 0.2,
        prior=prior,
        seed=seed,
        tick=choice,
    )
    y, u = data.parts[0]
    shape = NarxShape(n_outputs=y.shape[1], n_inputs=u.shape[1], ny=ny, nu=nu, nk=int(s["nk"]), neurons=neurons)  # type: ignore[call-overload]
    work.timing_s["choice"] = perf_counter() - began
    began = perf_counter()
    _train(s, shape, data, work, seed, training)
    work.timing_s["training"] = perf_counter() - began
    if s["focus"] == "simulation":
        began = perf_counter()
        _refine(s, data, work, refining)
        work.timing_s["simulation errors"] = perf_counter() - began
    if s["uncertainty"] == "bootstrap":
        began = perf_counter()
        problem = problem_at(work.shape, data.parts, work.theta, prior, free=work.free)
        work.covariance = bootstrapped(problem.sample_rows(work.theta), problem.prior_rows(work.theta), seed, last)
        work.timing_s["bootstrap"] = perf_counter() - began


def _train(s: Mapping[str, object], shape: NarxShape, data: Scaled, work: Work, seed: int, tick: Tick | None) -> None:
    """Train from several starts, go on with the best, and end on all data."""
    share, prior, most = float(s["held_out"]), float(s["prior"]), int(s["iterations"])  # type: ignore[arg-type, call-overload]
    training, held = split(data.parts, share, shape.lag)
    linear = linear_start(shape, training)
    _keep(work, shape, linear)
    rng = np.random.default_rng(seed)
    watch = (lambda t: held_out_error(shape, held, t)) if held else None
    best, best_error = linear, np.inf
    starts = int(s["starts"]) if shape.neurons else 1  # type: ignore[call-overload]
    first, second, third = portions(tick, (starts * _FIRST, 2 * _FIRST, 2 * _FIRST * bool(held)))
    for k in range(starts):
        start = random_start(shape, linear, rng)
        problem = problem_at(shape, training, start, prior)
        found = search(
            problem,
            start,
            stage="starts",
            most=min(_FIRST, most),
            held_out=watch,
            slack=0.0,
            tick=part_of(first, k / starts, (k + 1) / starts),
            solved=problem.solved,
            n_linear=problem.n_linear,
        )
        error = min(found.held_out) if held else found.cost
        if error < best_error:
            best, best_error = found.theta, error
            _keep(work, shape, best)
    problem = problem_at(shape, training, best, prior)
    found = search(
        problem, best, stage="training", most=most, held_out=watch, tick=second, keep=lambda t: _keep(work, shape, t),
        solved=problem.solved, n_linear=problem.n_linear, enough=_ENOUGH,
    )  # fmt: skip
    _keep(work, shape, found.theta)
    _note(work, found, problem.n_errors, float(np.sqrt(np.mean(problem.weight**2))), "prediction")
    work.stopped_early = found.stopped_early
    work.held_out = held_out_error(shape, held, found.theta) if held else float("nan")
    if held and not found.stopped_early:  # nothing is overfitted: the held-out part may teach as well
        problem = problem_at(shape, data.parts, found.theta, prior)
        found = search(
            problem, found.theta, stage="all data", most=most, tick=third, solved=problem.solved,
            n_linear=problem.n_linear, enough=_ENOUGH,
        )  # fmt: skip
        _keep(work, shape, found.theta)
    work.status = "converged" if found.converged else "stalled"
    if not found.converged and len(found.costs) > most:  # a valley of networks that differ little: no fault of the data
        lately = 50.0 * (1.0 - found.costs[-1] / found.costs[-min(11, len(found.costs))])
        work.warnings.append(
            f"the training was still improving at its limit of {most} iterations, the errors by {lately:.1g} % over "
            "the last ten: raise iterations if that matters. Standard deviations are those of a linearisation there"
        )


def _keep(work: Work, shape: NarxShape, theta: Array) -> None:
    work.shape, work.theta = shape, theta


def _note(work: Work, found: Found, n: int, weight: float, what: str) -> None:
    work.curves.append(
        LearningCurve(
            method=f"Levenberg-Marquardt, {what} errors",
            seconds=np.array(found.seconds),
            training=np.sqrt(np.array(found.costs) / n) / weight,
            held_out=np.array(found.held_out),
        )
    )


def _refine(s: Mapping[str, object], data: Scaled, work: Work, tick: Tick | None) -> None:
    """Go on with the errors of the free run."""
    prior, most = float(s["prior"]), int(s["iterations"])  # type: ignore[arg-type, call-overload]
    problem = problem_at(work.shape, data.parts, work.theta, prior, free=True)
    if not np.isfinite(problem.cost(work.theta)):
        work.status = "stalled"
        work.warnings.append(
            "the free run diverges, so that the weights are those of the one-step errors: fewer neurons or other lags"
        )
        return
    for k in range(2):  # the errors' sizes are known only afterwards

        def keep(theta: Array) -> None:
            work.theta, work.free = theta, True

        own = part_of(tick, 0.5 * k, 0.5 * (k + 1))
        found = search(problem, work.theta, stage="simulation errors", most=most, tick=own, keep=keep)
        keep(found.theta)
        _note(work, found, problem.n_errors, float(np.sqrt(np.mean(problem.weight**2))), "simulation")
        work.status = "converged" if found.converged else "stalled"
        if data.y_level.size == 1 or found.converged:
            break
        problem = problem_at(work.shape, data.parts, work.theta, prior, free=True)
