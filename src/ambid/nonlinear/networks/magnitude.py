"""State-space network of a plant whose sensor sees no sign, such as a pulse counter (nn with output=magnitude).

Grid of linear starts -> Levenberg-Marquardt on the free run -> number of states by Bayes' criterion -> number of odd
hidden units by how the run goes on behind parts of the records -> training on all. The plant is taken for odd, the same
the other way round: a sign that is not measured leaves nothing to tell the directions apart by.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any, Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.linear import information_inverse
from ambid.estimation.progress import Tick, part_of, portions
from ambid.estimation.search import Found, search
from ambid.nonlinear.cloud import cloud_of
from ambid.nonlinear.failed import failed_fit, provenance
from ambid.nonlinear.fit import LearningCurve, NonlinearFit
from ambid.nonlinear.networks.magnitude_model import MagnitudeNetwork
from ambid.nonlinear.networks.magnitude_problem import FoldedLayout, FoldedProblem, Parts, states
from ambid.nonlinear.networks.magnitude_start import MOST_STATES, folded_starts
from ambid.nonlinear.records import scaled_records

USED = ("output", "states", "neurons", "prior", "starts", "iterations")
_REFINED = 8  # linear starts that are searched from
_CLEAR = (
    10.0  # of Bayes' criterion, which a larger model has to gain (Kass and Raftery 1995): errors are not white here
)
_MOST_UNITS = 3
_FOLDS = (0.5, 0.625, 0.75)  # of each record are trained on in the choice of units ..
_AHEAD = 0.25  # .. and so much behind is run on
_BETTER = 0.95  # part of the held-out error to which further units have to bring it
DEFAULTS: Mapping[str, object] = {"output": "magnitude", "prior": 1.0, "starts": 20, "iterations": 50}
_ALLOWED: Mapping[str, tuple[object, ...]] = {"form": ("auto", "free"), "noise": ("auto", "output")}
_FIRST = 3  # iterations for what units put out, before what they see is searched for
_LAST = 10  # times as many iterations for the best start
_ROUNDS = 3  # of weighting: the errors' size is known only afterwards
_LEAST = 1e-7  # deviation of errors, in that of the output: less is rounding


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Trained:
    """A network with its first states, its errors' size, and how it came about."""

    layout: FoldedLayout
    theta: Array
    x0: Array
    noise: float
    found: Found | None = None

    @property
    def vector(self) -> Array:
        return np.concatenate([self.theta, self.x0.ravel()])


@dataclass(slots=True)
class _Work:
    """What a fit has come to, so that an interruption loses nothing."""

    best: _Trained | None = None
    status: Literal["converged", "stalled"] = "converged"
    curves: list[LearningCurve] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    timing_s: dict[str, float] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)


def nn_of_magnitude(
    records: Sequence[IOData], given: Mapping[str, object], seed: int, tick: Tick | None
) -> NonlinearFit:
    """Train a state-space network whose output is measured without sign.

    `given`: settings as the user gave them, checked: those that mean nothing here are refused; `seed`: of the hidden
    layer's starts.
    """
    _check(records, given)
    settings: dict[str, Any] = {**DEFAULTS, **given}
    data = scaled_records("nn", records, lag=40)
    u_scale = np.hypot(data.u_level, data.u_scale)
    y_scale = np.hypot(data.y_level, data.y_scale)
    parts = tuple((x.y[:, 0] / y_scale[0], x.u / u_scale) for x in records)
    work, reason = _Work(), ""
    try:
        _identify(settings, parts, work, seed, tick)
    except KeyboardInterrupt:
        work.status = "stalled"
        work.warnings.insert(0, "interrupted: the best model so far")
        reason = "interrupted before there was a first model"
    used: dict[str, Any] = {k: settings[k] for k in USED if k in settings} | {"form": "free", "noise": "output"}
    if work.best is None:
        why = reason or "no first network stays finite on these records: check the columns for their size and for jumps"
        return failed_fit("nn", records, {"states": 0, "neurons": 0, **used}, seed, why, work.timing_s)
    used |= {"states": work.best.layout.n, "neurons": work.best.layout.neurons}
    return _finished(records, used, parts, (u_scale, y_scale), work, seed)


def _check(records: Sequence[IOData], given: Mapping[str, object]) -> None:
    for name, value in given.items():
        if name not in USED and value not in _ALLOWED.get(name, ()):
            raise EstimationError(
                f"nn: {name} = {value!r} means nothing with output = magnitude; what does: {', '.join(USED)}. Leave it "
                "out"
            )
    states_asked = given.get("states")
    if isinstance(states_asked, int) and states_asked > MOST_STATES:
        raise EstimationError(f"nn: states = {states_asked} with output = magnitude; at most {MOST_STATES}. Lower it")
    for r, x in enumerate(records):
        if x.n_outputs != 1 or not x.n_inputs:
            raise EstimationError("nn: output = magnitude is for one output and one input or more. Choose them")
        if np.min(x.y) < 0:
            raise EstimationError(
                f"nn: output {x.outputs[0]!r} of record {r + 1} is negative at sample {int(np.argmin(x.y))}; a "
                "magnitude is not. Use output = signed"
            )


def _identify(s: Mapping[str, Any], parts: Parts, work: _Work, seed: int, tick: Tick | None) -> None:
    began = perf_counter()
    chosen = range(_MOST_UNITS + 1) if s.get("neurons") is None else (int(s["neurons"]),)
    linear, choice, last = portions(
        tick, (4.0, len(_FOLDS) * sum(chosen) * int(s["starts"]) * (len(chosen) > 1), chosen[-1] * int(s["starts"]))
    )
    asked = s.get("states")
    work.best = _linear(range(1, MOST_STATES + 1) if asked is None else (int(asked),), parts, s, work, linear)
    work.timing_s["linear"] = perf_counter() - began
    began = perf_counter()
    if work.best is None:
        return
    neurons = _units(s, parts, work, work.best, seed, choice) if len(chosen) > 1 else chosen[0]
    work.timing_s["choice of units"] = perf_counter() - began
    began, base = perf_counter(), work.best
    if neurons:
        for k in range(int(s["starts"])):
            begin, each = k / int(s["starts"]), 1 / int(s["starts"])
            here = part_of(last, begin, begin + each)
            _keep(work, _trained(_with_units(base, neurons, [seed, neurons, k]), parts, s, here))
        if work.best is not base:  # the best start to the very end
            _keep(work, _trained(work.best, parts, {**s, "iterations": _LAST * int(s["iterations"])}, None))
        if work.best.found is not None and work.best is not base:
            work.curves.append(_curve(work.best, work.best.found, parts))
    work.timing_s["training"] = perf_counter() - began


def _keep(work: _Work, found: _Trained | None) -> None:
    if found is None or found.found is None:
        return
    assert work.best is not None
    if found.layout.neurons != work.best.layout.neurons or found.noise <= work.best.noise:
        work.best = found
        work.status = "converged" if found.found.converged else "stalled"


def _linear(
    tried: Sequence[int], parts: Parts, s: Mapping[str, Any], work: _Work, tick: Tick | None
) -> _Trained | None:
    """The best linear network of each size; Bayes' criterion chooses among sizes."""
    best, least, values = None, np.inf, []
    n_rows = sum(y.size for y, _ in parts)
    for k, n in enumerate(tried):
        of_size: _Trained | None = None
        for layout, theta in folded_starts(parts, n, _REFINED):
            start = _Trained(layout=layout, theta=theta, x0=_at_rest(layout, parts), noise=1.0)
            found = _trained(start, parts, s, part_of(tick, k / len(tried), (k + 1) / len(tried)))
            if found is not None and (of_size is None or found.noise < of_size.noise):
                of_size = found
        if of_size is None:
            continue
        bic = 2 * n_rows * float(np.log(of_size.noise)) + of_size.vector.size * float(np.log(n_rows))
        values.append({"states": n, "bic": bic})
        if bic < least - _CLEAR * (best is not None):
            best, least = of_size, bic
    if best is not None and best.found is not None:
        work.details["tried_states"] = values
        work.curves.append(_curve(best, best.found, parts))
        work.status = "converged" if best.found.converged else "stalled"
    return best


def _at_rest(layout: FoldedLayout, parts: Parts) -> Array:
    x0 = np.zeros((len(parts), layout.n + 1))
    x0[:, -1] = [y[0] for y, _ in parts]
    return x0


def _with_units(base: _Trained, neurons: int, seed: list[int]) -> _Trained:
    """Hidden units without effect yet, their directions random."""
    layout = replace(base.layout, neurons=neurons)
    theta = np.zeros(layout.n_theta)
    k, width = layout.n_linear, neurons * (layout.n + layout.n_inputs)
    theta[:k] = base.theta[:k]
    theta[k : k + width] = np.random.default_rng(seed).standard_normal(width)
    return replace(base, layout=layout, theta=theta)


def _units(s: Mapping[str, Any], parts: Parts, work: _Work, linear: _Trained, seed: int, tick: Tick | None) -> int:
    """Number of hidden units by the runs that go on behind the parts of the records that are trained on."""
    starts, squares = int(s["starts"]), np.zeros(_MOST_UNITS + 1)
    whole = len(_FOLDS) * sum(range(_MOST_UNITS + 1))
    done = 0
    for share in _FOLDS:
        cut = [round(share * y.size) for y, _ in parts]
        fewer = tuple((y[:k], u[:k]) for (y, u), k in zip(parts, cut, strict=True))
        base = _trained(linear, fewer, s, None) or linear
        squares[0] += _ahead(base, parts, cut) ** 2
        for neurons in range(1, _MOST_UNITS + 1):
            best: _Trained | None = None
            for k in range(starts):
                here = part_of(tick, (done + k / starts * neurons) / whole, (done + (k + 1) / starts * neurons) / whole)
                found = _trained(_with_units(base, neurons, [seed, neurons, k]), fewer, s, here)
                if found is not None and (best is None or found.noise < best.noise):
                    best = found
            squares[neurons] += np.inf if best is None else _ahead(best, parts, cut) ** 2
            done += neurons
    errors = np.sqrt(squares / len(_FOLDS))
    work.details["held_out"] = [{"neurons": k, "error": float(e)} for k, e in enumerate(errors) if np.isfinite(e)]
    chosen = 0
    for k in range(1, errors.size):
        if errors[k] < _BETTER * errors[chosen]:
            chosen = k
    return chosen


def _ahead(at: _Trained, parts: Parts, cut: list[int]) -> float:
    """Error of the run that goes on behind what was trained on, scaled."""
    left = []
    for (y, u), x, k in zip(parts, at.x0, cut, strict=True):
        end = min(k + round(_AHEAD * y.size), y.size)
        left.append((y[:end] - states(at.layout, at.theta, u[:end], x)[:-1, -1])[k:])
    size = float(np.sqrt(np.mean(np.concatenate(left) ** 2)))
    return size if np.isfinite(size) else np.inf


def _trained(start: _Trained, parts: Parts, s: Mapping[str, Any], tick: Tick | None) -> _Trained | None:
    """Search; the errors' size, which the prior is weighed against, is found on the way. None where it diverges."""
    at, prior = start, float(s["prior"])
    stage, most = ("hidden layer" if start.layout.neurons else "linear part"), int(s["iterations"])
    if at.layout.neurons and not np.any(at.layout.split(at.theta)[-1]):
        problem = FoldedProblem(layout=at.layout, parts=parts, noise=at.noise, prior=prior, held=True)
        theta, x0 = problem.split(search(problem, at.vector, stage=stage, most=_FIRST, damping=1e-2).theta)
        at = replace(at, theta=theta, x0=x0)
    for k in range(_ROUNDS if start.layout.neurons else 1):

        def told(stage: str, done: float | None = None, /, before: int = k) -> None:
            if tick is not None:
                tick(stage, (before + (done or 0.0)) / _ROUNDS)

        problem = FoldedProblem(layout=at.layout, parts=parts, noise=at.noise, prior=prior)
        found = search(problem, at.vector, stage=stage, most=most, tolerance=1e-6, damping=1e-2, tick=told)
        if not np.isfinite(found.cost):
            return None
        theta, x0 = problem.split(found.theta)
        e = np.concatenate(problem.errors(found.theta))
        noise, before = max(float(np.sqrt(np.mean(e**2))), _LEAST), at.noise
        at = replace(at, theta=theta, x0=x0, noise=noise, found=found)
        if abs(np.log(noise / before)) < 0.02:
            break
    return at


def _curve(at: _Trained, found: Found, parts: Parts) -> LearningCurve:
    y = np.concatenate([part[0] for part in parts])
    costs = np.array(found.costs)
    end = at.noise / max(float(np.std(y)), 1e-300)
    return LearningCurve(
        method="Levenberg-Marquardt, simulation errors",
        seconds=np.array(found.seconds),
        training=end * np.sqrt(costs / max(float(costs[-1]), 1e-300)),
    )


def _finished(
    records: Sequence[IOData],
    used: Mapping[str, Any],
    parts: Parts,
    scales: tuple[Array, Array],
    work: _Work,
    seed: int,
) -> NonlinearFit:
    assert work.best is not None
    best, (u_scale, y_scale) = work.best, scales
    runs = [states(best.layout, best.theta, u, x)[:-1] for (_, u), x in zip(parts, best.x0, strict=True)]
    cloud = cloud_of(np.hstack([np.concatenate(runs), np.concatenate([u for _, u in parts])]))
    model = MagnitudeNetwork(
        layout=best.layout, theta=best.theta, dt=records[0].dt, u_scale=u_scale, y_scale=y_scale, cloud=cloud
    )
    problem = FoldedProblem(layout=best.layout, parts=parts, noise=best.noise, prior=float(used["prior"]))
    inverse, condition = information_inverse(problem.triangle(best.vector)[:, :-1])
    P = best.layout.n_theta
    warnings = [*work.warnings]
    if not all(x.open_loop for x in records):
        warnings.append(
            "trained on free runs, nn is biased where a controller was at work, and nothing says that these records "
            "are open loop: say --open-loop if there was no feedback"
        )
    if inverse is None:
        warnings.append(
            f"no standard deviations: the data do not determine all weights (condition number {condition:.1e}). "
            "Fewer states or neurons, or more excitation"
        )
    work.timing_s["all"] = sum(work.timing_s.values())
    rows = sum(y.size for y, _ in parts)
    return NonlinearFit(
        structure="nn",
        settings=dict(used),
        model=model,
        covariance=None if inverse is None else inverse[:P, :P],
        covariance_from="" if inverse is None else "laplace" if best.layout.neurons else "information",
        n_estimated=P,
        noise_covariance=np.array([[(best.noise * y_scale[0]) ** 2 * rows / max(rows - P, 1)]]),
        seed=seed,
        status=work.status,
        curves=tuple(work.curves),
        warnings=tuple(warnings),
        timing_s=dict(work.timing_s),
        details={**work.details, "condition": condition, "poles": _poles(best)},
        **provenance(records),
    )


def _poles(best: _Trained) -> list[list[float]]:
    """Of the linear part, of a sample, real and imaginary."""
    return [[float(p.real), float(p.imag)] for p in np.linalg.eigvals(best.layout.A(best.theta))]
