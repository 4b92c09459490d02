"""Grey-box estimation of the physical parameters of a linear model (theory.md sec. 2; Ljung 1999, sec. 7.5).

Innovations form: physical parameters, noise description, offsets, initial state and delay by maximum likelihood, for stable and
unstable plants, in open and closed loop. Start values come from the data; the delay is searched, in whole samples and then as a
real number; noise is described by disturbance and sensor levels, or by a free predictor gain where the data ask for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.errors import EstimationError
from ambid.identify import start as weak_form
from ambid.identify.likelihood import Fit, evaluate, score_statistic, search
from ambid.identify.predictor import assemble
from ambid.identify.problem import PredictorProblem
from ambid.identify.scaling import noise_floor, scales_for
from ambid.physics.models import LinearModel
from ambid.physics.parameters import Parameter

Array = NDArray[np.float64]
Delay = float | Literal["auto"]

_MAX_DELAY = 6  # samples, searched when the delay is "auto"
_LEVELS = (
    -4.0,
    -8.0,
    -1.5,
)  # log disturbance levels tried at the start, relative to what one sample's sensor noise hides
_STRETCH = 8192  # samples on which start values are first compared
_RACE = 3  # candidates that are searched before the best goes on


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Signals:
    """What the estimator sees of a record.

    Attributes
    ----------
    u : ndarray, shape (n_samples, n_inputs), SI
        Inputs in the order of the model's, held over a sample.
    y : ndarray, shape (n_samples, n_outputs), SI
    rate_hz : float
    """

    u: Array
    y: Array
    rate_hz: float


def greybox(
    model: LinearModel,
    signals: Signals,
    parameters: Sequence[Parameter],
    *,
    delay: Delay = "auto",
    noise: Literal["auto", "levels", "gain"] = "auto",
    tick: Callable[[], None] | None = None,
) -> Fit:
    """Estimate the physical parameters of `model` from one record.

    Parameters
    ----------
    model : LinearModel
    signals : Signals
        At least 10 samples for every estimated number.
    parameters : Sequence of Parameter
        One for each of the model's: free (a value is used as one more start), fixed, or with a prior.
    delay : float or "auto"
        Delay of the inputs in samples; "auto": searched from 0 to 6 samples, in fractions where the data show one.
    noise : {"auto", "levels", "gain"}
        Disturbance and sensor noise levels through the Riccati equation, a free predictor gain, or the levels unless the
        likelihood favours the gain by more than its numbers cost (BIC).
    tick : callable, optional
        Called after each evaluation; may raise to interrupt.

    Returns
    -------
    Fit
        The best found; its status says whether the search converged.

    Raises
    ------
    EstimationError
        If the record is too short, a channel is constant, or no start value makes a predictor.
    """
    _check(model, signals, parameters)
    fit = _from_starts(model, signals, parameters, delay, tick)
    if delay == "auto":
        fit = _with_fraction(fit, tick)
    if noise != "levels":
        fit = _with_gain(fit, tick, force=noise == "gain")
    return fit


def _check(model: LinearModel, signals: Signals, parameters: Sequence[Parameter]) -> None:
    n_estimated = sum(p.role != "fixed" for p in parameters)
    if n_estimated == 0:
        raise EstimationError("every parameter of the rig is fixed; nothing is left to identify. Free at least one")
    least = 10 * (n_estimated + 3 * len(model.states)) + _MAX_DELAY
    if signals.y.shape[0] < least:
        raise EstimationError(
            f"the record has {signals.y.shape[0]} samples; identifying {n_estimated} parameters wants at least {least}. "
            "Record longer, or cut less"
        )
    for roles, values in ((model.inputs, signals.u), (model.outputs, signals.y)):
        for role, column in zip(roles, values.T, strict=True):
            if np.ptp(column) == 0:
                raise EstimationError(
                    f"channel {role!r} is constant at {column[0]:g} over the whole record; nothing can be identified from it. "
                    "Check the sensor and its wiring, or the column the rig names"
                )


def _from_starts(
    model: LinearModel, signals: Signals, parameters: Sequence[Parameter], delay: Delay, tick: Callable[[], None] | None
) -> Fit:
    """Score all start values by the likelihood, race the best few, search on from the winner."""
    scored = sorted(_scored(model, signals, parameters, delay), key=lambda c: c[0])
    if not scored:
        raise EstimationError(
            "no start values make a physical plant (positive m and L) with this record; it holds too little excitation, or "
            "voltage, current and position are not what the rig says. Check columns and signs, or give start values"
        )
    best, n_used = scored[0][0], scored[0][1].n_used
    racers = [c for c in scored if c[0] <= best + 0.5 * n_used][:_RACE]
    fits = [search(p, v, rounds=1, evaluations=6, tick=tick) for _, p, v in racers] if len(racers) > 1 else []
    order = sorted(fits, key=lambda f: f.criterion)
    tries = [(f.problem, f.vector) for f in order if f.status != "failed"] or [(p, v) for _, p, v in racers]
    found = None
    for problem, vector in tries:
        fit = search(problem, vector, tick=tick)
        found = fit if found is None or fit.criterion < found.criterion else found
        if fit.status == "converged":
            break
    assert found is not None
    return found


def _scored(
    model: LinearModel, signals: Signals, parameters: Sequence[Parameter], delay: Delay
) -> Iterator[tuple[float, PredictorProblem, Array]]:
    """Yield criterion, problem and vector of every start value that makes a predictor."""
    given = {p.name: p.value for p in parameters if p.value is not None}
    anchored = {p.name: p.value for p in parameters if p.value is not None and p.role != "free"}
    delays = [float(d) for d in range(_MAX_DELAY + 1)] if delay == "auto" else [float(delay)]
    skip = int(max(delays)) + 2
    u, y = signals.u - signals.u.mean(axis=0), signals.y - signals.y.mean(axis=0)
    columns = {**dict(zip(model.inputs, u.T, strict=True)), **dict(zip(model.outputs, y.T, strict=True))}
    m = weak_form.moments(columns, model.inputs, signals.rate_hz)
    noise = dict(zip(model.outputs, noise_floor(y), strict=True))
    busy = _busiest(u)
    coarse: list[tuple[float, PredictorProblem, dict[str, float]]] = []
    for d in delays:
        sets = list(weak_form.candidates(model.name, m, noise, d, signals.rate_hz, anchored))
        if given != anchored:
            sets += [{**s, **given} for s in sets[:1]]
        for values in sets:
            if not _possible(model, values):
                continue
            problem = _problem(model, signals, (u, y), parameters, values, d, skip)
            part = replace(problem, u=problem.u[busy], y=problem.y[busy])
            value, _ = evaluate(part, _vector(part, values, _LEVELS[0]))
            coarse.append((value, problem, values))
    coarse.sort(key=lambda c: c[0])
    for _, problem, values in coarse[: 2 * _RACE]:
        for level in _LEVELS:
            vector = _vector(problem, values, level)
            value, _ = evaluate(problem, vector)
            if np.isfinite(value):
                yield value, problem, vector


def _busiest(u: Array) -> slice:
    """The stretch of at most `_STRETCH` samples in which the inputs move most."""
    n = u.shape[0]
    if n <= _STRETCH:
        return slice(0, n)
    power = np.cumsum(np.r_[0.0, np.sum((u / np.std(u, axis=0)) ** 2, axis=1)])
    first = int(np.argmax(power[_STRETCH:] - power[:-_STRETCH]))
    return slice(first, first + _STRETCH)


def _possible(model: LinearModel, values: Mapping[str, float]) -> bool:
    """Whether start values make a plant at all: finite, and positive where physics wants it (a small negative R may be mended)."""
    return all(np.isfinite(v) for v in values.values()) and all(
        values[p.name] > 0 for p in model.parameters if p.name in ("m", "L")
    )


def _problem(
    model: LinearModel,
    signals: Signals,
    centred: tuple[Array, Array],
    parameters: Sequence[Parameter],
    values: Mapping[str, float],
    delay: float,
    skip: int,
) -> PredictorProblem:
    """Scale a problem around start values."""
    u, y = centred
    estimated = [p for p in parameters if p.role != "fixed"]
    reference = model.references(values)
    magnitude = np.array([max(abs(values[p.name]), 1e-3 * reference.get(p.name, 0.0), 1e-300) for p in estimated])
    return PredictorProblem(
        model=model,
        rate_hz=signals.rate_hz,
        u=u,
        y=y,
        estimated=tuple(p.name for p in estimated),
        known={p.name: float(p.value) for p in parameters if p.role == "fixed" and p.value is not None},
        magnitude=magnitude,
        prior_mean=np.array([p.value if p.role == "prior" and p.value is not None else 0.0 for p in estimated]),
        prior_sd=np.array([p.sd if p.sd is not None else np.inf for p in estimated]),
        scales=scales_for(model, values, u, y, signals.rate_hz),
        delay=int(delay),
        lag=delay - int(delay),
        skip=skip,
        noise_center=np.r_[np.full(len(model.disturbances), _LEVELS[0]), np.zeros(len(model.outputs) - 1)],
    )


def _vector(problem: PredictorProblem, values: Mapping[str, float], level: float) -> Array:
    """Write start values as a vector: outputs at the first sample for the state, nothing known of offsets."""
    vector, sl, model = np.zeros(problem.size), problem.slices, problem.model
    vector[sl["physical"]] = np.array([values[k] for k in problem.estimated]) / problem.magnitude
    vector[sl["noise"]][: len(model.disturbances)] = level
    first = problem.y[problem.skip]
    for j, state in enumerate(model.states):
        if state in model.outputs:
            vector[sl["initial"]][j] = first[model.outputs.index(state)] / problem.scales.state[j]
    return vector


def carry(fit: Fit, problem: PredictorProblem) -> Array:
    """Write a fit's numbers in the vector of another problem of the same model and scales.

    Parameters
    ----------
    fit : Fit
    problem : PredictorProblem
        May differ in delay, noise form and whether the delay is estimated.

    Returns
    -------
    ndarray, shape (problem.size,)
    """
    old, vector = fit.problem, np.zeros(problem.size)
    for group in ("physical", "offset", "initial"):
        vector[problem.slices[group]] = fit.vector[old.slices[group]]
    if problem.fractional:
        vector[problem.slices["fraction"]] = old.delay_samples(fit.vector) - problem.delay
    if problem.noise == old.noise:
        vector[problem.slices["noise"]] = fit.vector[old.slices["noise"]]
    elif problem.noise == "gain":
        predictor = assemble(old, fit.vector, with_derivatives=False)
        assert predictor is not None
        vector[problem.slices["noise"]] = predictor.gain.ravel()
    return vector


def _with_fraction(fit: Fit, tick: Callable[[], None] | None) -> Fit:
    """Estimate the delay as a real number where the score test says that the data show a fraction of a sample."""
    price = np.log(fit.problem.n_used)  # BIC: one number more
    for _ in range(3):
        delay = fit.problem.delay
        free = replace(fit.problem, fractional=True, lag=0.0, skip=max(fit.problem.skip, delay + 2))
        start = carry(fit, free)
        promise = score_statistic(free, start, fit.covariance)
        before = start.copy()
        if delay > 0:  # from the other side of the whole sample the slope differs
            before[free.slices["fraction"]] = -1e-9
            promise = max(promise, score_statistic(free, before, fit.covariance))
        if promise < price:
            return fit
        found = search(free, start, tick=tick)
        total = free.delay_samples(found.vector)
        if found.status == "failed" or fit.criterion - found.criterion < price:
            return fit
        whole = int(np.floor(total + 1e-6))
        if whole == delay:
            return found
        # the neighbour's interval: start again from there, so that delay + fraction is written with 0 <= fraction < 1
        moved = replace(found.problem, delay=whole, skip=max(free.skip, whole + 2))
        again = search(moved, carry(found, moved), tick=tick)
        if 0.0 <= moved.delay_samples(again.vector) - whole < 1.0:
            return again
        fit = again
    return fit


def _with_gain(fit: Fit, tick: Callable[[], None] | None, *, force: bool) -> Fit:
    """Free the predictor gain where the likelihood rises by more than the added numbers cost."""
    free = replace(fit.problem, noise="gain")
    price = (free.size - fit.problem.size) * np.log(fit.problem.n_used)
    if price <= 0 and not force:
        return fit
    start = carry(fit, free)
    if not force and score_statistic(free, start, fit.covariance) < price:
        return fit
    found = search(free, start, tick=tick)
    return found if force or fit.criterion - found.criterion > price else fit
