"""What the nonlinear bearing does where its start values fail: search globally, and keep the better fit."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from time import perf_counter

import numpy as np

from ambid.bearing.magnet.global_start import bearing_cost, failure, global_problems
from ambid.bearing.magnet.likelihood import BearingFit, criterion, search
from ambid.bearing.magnet.problem import BearingProblem, BearingRecord
from ambid.estimation.global_search import STAGE
from ambid.estimation.progress import Tick

_TRIED = 15  # iterations from each place found
_CHOICE = 2.0  # numbers' worth (BIC) by which a fit must be better: in noisy records delays and places nearly tie
_EVEN = 0.5  # of the criterion: a fit with the same delay that has converged is taken where it is no worse


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RescuedFit(BearingFit):
    """A fit whose ordinary start values failed."""

    # ``why``, ``evaluations``, ``seconds``, ``criterion_before`` and ``criterion_after`` (per measured value, None
    # where there is none), ``taken``, ``interrupted``
    global_search: Mapping[str, object]


def rescued(
    before: BearingFit,
    records: Sequence[BearingRecord],
    finish: Callable[[BearingFit], BearingFit],
    *,
    search_delay: bool,
    seed: int,
    evaluations: int,
    tick: Tick | None,
) -> BearingFit:
    """Return the fit, or a better one from a global search where its start values failed.

    `before`: of all records, at the end of the ordinary way; `finish`: what follows a search over all records; `seed`:
    equal seeds give equal results; `evaluations`: of the likelihood in the global search, at most; 0 for none; `tick`:
    a KeyboardInterrupt ends in the best so far. Returns a `RescuedFit` where there was a global search.
    """
    why = failure(before) if evaluations else ""
    if not why:
        return before
    count, after, interrupted = 0, None, False

    def told(stage: str, done: float | None = None, /) -> None:
        nonlocal count
        count += stage == STAGE and done is not None
        if tick is not None:
            tick(stage, None)

    try:
        if tick is not None:
            tick(STAGE, None)
    except KeyboardInterrupt:  # before it began: the fit has not failed, it was ended
        return before
    began, cost = perf_counter(), bearing_cost(before, search_delay=search_delay)
    try:
        places = global_problems(cost, seed=seed, evaluations=evaluations, tick=told)
        fits = [search(p, p.start(), iterations=_TRIED, tick=told) for p in places]
        fits = [f for f in fits if f.status != "failed"]
        if fits:
            nearest = min(fits, key=lambda f: f.criterion)
            after = finish(search(_whole(nearest.problem, records, before.problem.skip), nearest.vector, tick=told))
    except KeyboardInterrupt:
        interrupted = True
        places = cost.found()
        if places:  # not a step further: what was found, with its information
            whole = _whole(places[0], records, before.problem.skip)
            after = search(whole, whole.start(), iterations=0)
    taken = _better(after, before)
    fit = after if taken and after is not None else before
    report = {
        "why": why, "evaluations": count, "seconds": perf_counter() - began, "criterion_before": _per_value(before),
        "criterion_after": _per_value(after), "taken": taken, "interrupted": interrupted,
    }  # fmt: skip
    return RescuedFit(**{f.name: getattr(fit, f.name) for f in fields(BearingFit)}, global_search=report)


def _whole(problem: BearingProblem, records: Sequence[BearingRecord], skip: int) -> BearingProblem:
    """The problem of all records, from the sample on from which the first fit saw them, where the delay lets it."""
    return replace(problem, records=tuple(records), skip=max(skip, int(max(problem.delays.values())) + 8))


def _per_value(fit: BearingFit | None) -> float | None:
    return None if fit is None or fit.status == "failed" else fit.criterion / fit.problem.n_used


def _better(after: BearingFit | None, before: BearingFit) -> bool:
    """Whether the later fit says more of the data than its numbers cost, or as much and has converged."""
    if after is None or after.status == "failed":
        return False
    if before.status == "failed":
        return True
    same = replace(before.problem, skip=after.problem.skip)  # the samples that both have: a longer delay leaves fewer
    n, gain = same.n_used, criterion(same, before.vector) - after.criterion
    gain += (before.problem.size - after.problem.size) * float(np.log(n))
    if gain > _CHOICE * np.log(n):
        return True
    return (
        gain > -_EVEN and after.problem.delays == before.problem.delays and after.status == "converged" != before.status
    )
