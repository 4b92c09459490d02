"""Grey-box estimation of the physical parameters of a linear model (theory.md sec. 2; Ljung 1999, sec. 7.5).

Maximum likelihood in innovations form of parameters, noise (disturbance and sensor levels, or a free predictor gain
where the data ask for it), offsets, initial state and delay (whole samples, then a real number), for unstable plants
and closed loops too. Starts come from the data, or from a global search where they fail (`ambid.bearing.rescue`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from time import perf_counter
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.bearing.columns import POOR, late, refuse_mistaken, refuse_silent
from ambid.bearing.multistart import MAX_DELAY, Candidate, Delay, Signals, starts
from ambid.bearing.rescue import EVALUATIONS, Rescue, rescue
from ambid.errors import EstimationError
from ambid.estimation.estimate import Check
from ambid.estimation.likelihood import (
    STEPS,
    Fit,
    Workspace,
    extend,
    failure,
    promise_of,
    score_statistic,
    search,
    workspace_near,
)
from ambid.estimation.linear import directions, one_thread
from ambid.estimation.predictor import PredictorProblem, assemble, busiest, stable
from ambid.physics.linear_model import LinearModel, Parameter

_LOOK, _LOOKED = 3, 4096  # steps of a search with which another delay is looked at, and samples, the busiest
_TRIED, _AGAIN = 30, 20  # steps of a search for what may not be there, and of one that begins where it would end
_SECOND = np.array([2.0, -5.0, 4.0, -1.0]) / 12.0  # of this sample and those before: second difference over 12
_FAR = 5.0  # standard deviations that the course between samples may move a number by


def greybox(
    model: LinearModel,
    signals: Signals,
    parameters: Sequence[Parameter],
    *,
    delay: Delay = "auto",
    noise: Literal["auto", "levels", "gain"] = "auto",
    tick: Callable[[], None] | None = None,
    evaluations: int = EVALUATIONS,
    seed: int = 0,
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
        Disturbance and sensor noise levels through the Riccati equation; a free predictor gain; or ("auto") the
        simplest that does: sensor noise alone where the plant is stable, levels, or a gain, more numbers only where the
        likelihood rises by more than they cost (BIC).
    tick : callable, optional
        Called after each evaluation; may raise to interrupt.
    evaluations : int, optional
        Of the likelihood in a global search, at most; 0 for none. It is made only where the ordinary starts fail: none
        makes a plant, no search converges, or a linear regression on the past explains much of what the best leaves.
    seed : int, optional
        Of the global search: equal seeds give equal results.

    Returns
    -------
    Fit
        The best found; its status says whether the search converged. `global_search` says whether there was one, and
        what it gained. A KeyboardInterrupt of `tick` within the global search ends in the best so far, ``"stalled"``.

    Raises
    ------
    EstimationError
        If the record is too short, a channel is constant, or no start value makes a predictor.
    """
    _check(model, signals, parameters, delay)
    with one_thread():
        how = Rescue(evaluations=evaluations, seed=seed)
        return _greybox(model, signals, parameters, delay, noise, tick, how)


def _greybox(
    model: LinearModel,
    signals: Signals,
    parameters: Sequence[Parameter],
    delay: Delay,
    noise: Literal["auto", "levels", "gain"],
    tick: Callable[[], None] | None,
    how: Rescue,
) -> Fit:
    """Ordinary starts, and others where those fail."""
    begun = perf_counter()

    def follow(candidates: Sequence[Candidate]) -> Fit:
        return _follow(candidates, tick, noise, search_delay=delay == "auto")

    def tried(candidates: Sequence[Candidate]) -> Fit:
        return _follow(candidates, tick, noise, search_delay=delay == "auto", trial=True)

    refuse_silent(model, signals)
    try:
        candidates = starts(model, signals, parameters, delay, tick=tick)
    except EstimationError as error:
        refuse_mistaken(model, signals, parameters, delay, np.inf, tried)
        fit = rescue(None, str(error), model, signals, parameters, delay, how, follow, tick)
        if fit is None:
            raise
        return fit
    as_is = candidates[0].criterion / candidates[0].problem.n_used
    refuse_mistaken(model, signals, parameters, delay, as_is, tried)
    start_s = perf_counter() - begun
    fit = follow(candidates)
    why = failure(fit) if how.evaluations else ""
    if as_is < POOR and (why or fit.problem.parameters(fit.vector).get("R", 1.0) <= 0.0):
        as_is = fit.criterion / fit.problem.n_used if fit.status != "failed" else np.inf
        refuse_mistaken(model, signals, parameters, delay, as_is, tried, searched=True)
    if why and not late(model, signals):  # no plant explains a channel that lags
        fit = rescue(fit, why, model, signals, parameters, delay, how, follow, tick) or fit
    return replace(fit, start_s=start_s)


def _follow(
    candidates: Sequence[Candidate],
    tick: Callable[[], None] | None,
    noise: Literal["auto", "levels", "gain"],
    *,
    search_delay: bool,
    trial: bool = False,
) -> Fit:
    """The best candidate searched, then delay as a real number, then a free gain, only where the data pay. `trial`:
    give up where no search converges, as those of a wrong record do, in hundreds of steps each.
    """
    fit: Fit | None = None
    for candidate in candidates:
        fit_of_candidate = _search(candidate, tick, with_disturbances=noise != "auto", trial=trial)
        fit = fit_of_candidate if fit is None or fit_of_candidate.criterion < fit.criterion else fit
        if fit_of_candidate.status == "converged":
            break
    assert fit is not None
    if trial and fit.status != "converged":
        return fit
    without_gain = fit.vector if fit.problem.noise == "given" else None  # where a gain promises nothing, see `_search`
    if search_delay:
        fit = _with_fraction(fit, tick)
        if noise == "auto":
            fit = _without_disturbances(fit, tick)
    if noise == "levels" or (noise == "auto" and fit.vector is without_gain):
        return fit
    return _with_gain(fit, tick, force=noise == "gain")


def _search(candidate: Candidate, tick: Callable[[], None] | None, *, with_disturbances: bool, trial: bool) -> Fit:
    """Search with sensor noise alone (output error) where that explains a stable plant, else with disturbances too."""
    if not with_disturbances:
        fit = _quiet(candidate.problem, candidate.vector, tick, candidate.work, _TRIED)
        if fit is not None and fit.status == "converged" and _gain_promise(fit) <= 0:
            return fit
    steps = _TRIED if trial else STEPS
    return search(candidate.problem, candidate.vector, steps=steps, tick=tick, work=candidate.work)


def _quiet(
    problem: PredictorProblem, vector: Array, tick: Callable[[], None] | None, work: Workspace | None, steps: int
) -> Fit | None:
    """Search with sensor noise alone; None for an unstable plant, which needs its states corrected."""
    at = assemble(problem, vector, with_derivatives=False)
    if at is None or not stable(at.A):
        return None
    quiet = replace(problem, noise="given", gain=np.zeros_like(at.gain))
    start = np.zeros(quiet.size)
    for group in ("physical", "fraction", "offset", "initial"):
        start[quiet.slices[group]] = vector[problem.slices[group]]
    return search(quiet, start, steps=steps, tick=tick, work=work)


def _without_disturbances(fit: Fit, tick: Callable[[], None] | None) -> Fit:
    """Drop the disturbances again where a wrong delay was all that they stood for."""
    if fit.problem.noise != "levels":
        return fit
    quiet = _quiet(fit.problem, fit.vector, tick, fit.work, _AGAIN)
    price = (fit.problem.size - (quiet.problem.size if quiet else 0)) * np.log(fit.problem.n_used)
    settled = quiet is not None and (quiet.status == "converged" or fit.status != "converged")
    return quiet if quiet is not None and settled and quiet.criterion - fit.criterion < price else fit


def _gain_promise(fit: Fit) -> float:
    """Fall of the criterion that a free gain promises, less what its numbers cost (BIC)."""
    free = replace(fit.problem, noise="gain")
    price = (free.size - fit.problem.size) * float(np.log(fit.problem.n_used))
    return score_statistic(fit, free, carry(fit, free)) - price


def _check(model: LinearModel, signals: Signals, parameters: Sequence[Parameter], delay: Delay) -> None:
    n_estimated = sum(p.role != "fixed" for p in parameters)
    if n_estimated == 0:
        raise EstimationError("every parameter of the rig is fixed, and none is left to identify. Free at least one")
    least = 10 * (n_estimated + 3 * len(model.states)) + MAX_DELAY
    if signals.y.shape[0] < least:
        raise EstimationError(
            f"the record has {signals.y.shape[0]} samples; identifying {n_estimated} parameters needs at least "
            f"{least}. Record longer, or cut less"
        )
    if delay != "auto" and not 0 <= delay <= signals.y.shape[0] - least:
        raise EstimationError(
            f"the delay is given as {delay:g} samples; in a record of {signals.y.shape[0]} samples at most "
            f"{signals.y.shape[0] - least} leave enough to identify from. Correct channels.<input>.delay"
        )
    for roles, values in ((model.inputs, signals.u), (model.outputs, signals.y)):
        for role, column in zip(roles, values.T, strict=True):
            if np.ptp(column) == 0:
                raise EstimationError(
                    f"channel {role!r} is constant at {column[0]:g} over the whole record; nothing can be identified "
                    "from it. Check the sensor and its wiring, or the column the rig names"
                )
            largest = float(np.max(np.abs(column)))
            if not 1e-100 < largest < 1e100:  # squares overflow or vanish
                raise EstimationError(
                    f"channel {role!r} reaches {largest:.3g} in SI units, which no sensor shows. Correct the export, "
                    "or the gain in the rig"
                )


def carry(fit: Fit, problem: PredictorProblem) -> Array:
    """Write a fit's numbers in the vector of another `problem`, perhaps of another delay (or its freedom) or noise."""
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


def free_delay(fit: Fit) -> tuple[PredictorProblem, Array]:
    """Return a fit's problem with the delay as one number more, and the fit's vector in it."""
    free = replace(fit.problem, fractional=True, lag=0.0)
    return free, carry(fit, free)


def _with_fraction(fit: Fit, tick: Callable[[], None] | None) -> Fit:
    """Estimate the delay as a real number where the score test says that the data show a fraction of a sample."""
    price = np.log(fit.problem.n_used)  # BIC: one number more
    for _ in range(8):
        delay = fit.problem.delay
        free, start = free_delay(fit)
        work = workspace_near(fit, free)
        rows = extend(fit, free, start, work)
        promise = promise_of(rows)
        if delay > 0:  # from the other side of the whole sample the slope differs
            before = start.copy()
            before[free.slices["fraction"]] = -1e-9
            promise = max(promise, promise_of(extend(fit, free, before, work)))
        if promise < price:
            return replace(fit, freed=None if rows is None else rows[0])
        other = _better_delay(fit, tick)
        if other is not None:
            fit = other
            continue
        freed = search(free, start, tick=tick, work=work)
        total = free.delay_samples(freed.vector)
        if freed.status == "failed" or fit.criterion - freed.criterion < price:
            return fit
        nearest = round(total)
        if abs(total - nearest) < 0.1:  # a whole number of samples after all?
            exact = replace(free, fractional=False, delay=nearest, skip=max(free.skip, nearest + 2))
            back = search(exact, carry(freed, exact), tick=tick)
            if back.status == "converged" and back.criterion - freed.criterion < price:
                return back
        whole = int(np.floor(total))
        if whole == delay:
            return freed
        # the neighbour's interval: start again from there, so that delay + fraction is written with 0 <= fraction < 1
        moved = replace(freed.problem, delay=whole, skip=max(free.skip, whole + 2))
        again = search(moved, carry(freed, moved), tick=tick)
        if 0.0 <= moved.delay_samples(again.vector) - whole < 1.0:
            return again
        fit = again
    return fit


def _better_delay(fit: Fit, tick: Callable[[], None] | None) -> Fit | None:
    """The fit at another whole delay, if one is better: under feedback the likelihood has minima far apart."""
    own = fit.problem.delay
    trials = {d: _at_delay(fit, d, tick) for d in range(max(MAX_DELAY, own + 1) + 1)}
    like = trials.pop(own)
    nearest = min(trials.values(), key=_per_sample)
    settled = search(nearest.problem, nearest.vector, tick=tick, work=nearest.work)
    if not _per_sample(settled) < _per_sample(like):
        return None
    problem = replace(fit.problem, delay=nearest.problem.delay, skip=nearest.problem.skip)
    other = search(problem, settled.vector, tick=tick)
    return other if _per_sample(other) < _per_sample(fit) else None


def _at_delay(fit: Fit, delay: int, tick: Callable[[], None] | None) -> Fit:
    """A short search at another whole delay, from the numbers of a fit, over a part of the record."""
    problem = replace(fit.problem, delay=delay, skip=max(fit.problem.skip, delay + 2))
    at = busiest(problem.u, _LOOKED)
    part = replace(problem, u=problem.u[at], y=problem.y[at])
    return search(part, carry(fit, part), steps=_LOOK, tick=tick, work=workspace_near(fit, part))


def _per_sample(fit: Fit) -> float:
    """The criterion per sample, as a longer delay may leave fewer samples."""
    return fit.criterion / fit.problem.n_used


def _with_gain(fit: Fit, tick: Callable[[], None] | None, *, force: bool) -> Fit:
    """Free the predictor gain where the likelihood rises by more than the added numbers cost."""
    free = replace(fit.problem, noise="gain")
    price = (free.size - fit.problem.size) * np.log(fit.problem.n_used)
    if not force and (price <= 0 or _gain_promise(fit) <= 0):
        return fit
    freed = search(free, carry(fit, free), tick=tick, work=workspace_near(fit, free))
    if fit.problem.noise == "levels":
        freed = replace(freed, leveled=fit)
    return freed if force or fit.criterion - freed.criterion > price else fit


def course_left_open(fit: Fit) -> tuple[Fit, Check]:
    """Return a fit on a measured current with what its course between samples leaves open, and the check of that.

    The current is taken as straight between samples, as the voltage of a coil that is held makes it. A smooth one acts
    as if its second difference over 12 were taken off (position, of a force that is held at its mean): how far the
    numbers move then is part of their intervals.
    """
    problem, n = fit.problem, fit.problem.n_physical
    u = np.concatenate([np.repeat(problem.u[:1], 3), problem.u[:, 0]])
    smooth = replace(problem, u=problem.u - np.convolve(u, _SECOND, "valid")[:, None])
    move = (search(smooth, fit.vector, work=workspace_near(fit, smooth)).vector - fit.vector)[:n]
    sd = np.sqrt(np.diag(directions(np.vstack([fit.J, fit.J_prior])).inverse())[:n])
    worst = int(np.argmax(np.abs(move) / sd))
    z = float(abs(move[worst]) / sd[worst])
    more = np.outer(move, move)
    return replace(fit, beside=more if fit.beside is None else fit.beside + more), Check(
        passed=z <= _FAR, values={"z": z}, cause="" if z <= _FAR else "sampling",
        detail=f"a current that is smooth between samples, and not straight, moves {problem.estimated[worst]} by "
        f"{z:.2g} sd of the record: the intervals hold it{'' if z <= _FAR else '. Sample faster'}",
    )  # fmt: skip
