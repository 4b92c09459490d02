"""What the linear grey box does where its starts fail: tell that they did, search globally, take the better fit.

A fit has failed if no search converged, or if a linear regression on past innovations and inputs explains much of its
innovations: a predictor of high order then does much better than the physics at this place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from ambid.arrays import Array
from ambid.bearing.global_start import Rescue, candidates_at, global_candidates, likelihood_cost
from ambid.bearing.multistart import FARTHEST, Candidate, Delay, Signals, busiest, raced
from ambid.estimation.likelihood import Fit, search
from ambid.estimation.sensitivity import innovations
from ambid.physics.linear_model import LinearModel
from ambid.physics.parameters import Parameter

EVALUATIONS = 1200  # of the likelihood, unless the caller says otherwise: 1 to 2 s, and as much for local searches
FAR = 0.5  # part of the innovations' variance that a linear regression may explain before a fit counts as failed
_PAST = 10  # samples of innovations that it looks at
_INPUTS = FARTHEST + 4  # and of inputs: a delay that was missed shows there
_LOOKED = 2048  # samples that it looks at
_BETTER = 0.5  # of the criterion, its numbers paid for (BIC), by which a fit must be better


def reason(fit: Fit) -> str:
    """Return why a fit counts as failed.

    Returns empty where it did not.
    """
    if fit.status != "converged":
        return "no search converged"
    part = unexplained(fit)
    return f"a linear regression on the past explains {100 * part:.0f} % of the errors' variance" if part > FAR else ""


def unexplained(fit: Fit) -> float:
    """Return the part of the innovations' variance that a linear regression on past innovations and inputs explains.

    About 0 where a search ended well: a linear model of high order predicts no better. Corrected for chance.

    Returns at most 1; 1 where there is no predictor.
    """
    e = None if fit.status == "failed" else innovations(fit.problem, fit.vector)
    if e is None:
        return 1.0
    at = busiest(fit.problem.u[fit.problem.skip :], _LOOKED)
    e, u = e[at], fit.problem.u[fit.problem.skip :][at]
    n, first = e.shape[0], max(_PAST, _INPUTS)
    if n < 4 * (first + _PAST * e.shape[1] + _INPUTS * u.shape[1]):
        return 0.0
    past = [x[first - k : n - k] for x, depth in ((e, _PAST), (u, _INPUTS)) for k in range(1, depth + 1)]
    Z = np.hstack([*past, np.ones((n - first, 1))])
    Z, E = Z / np.maximum(np.linalg.norm(Z, axis=0), 1e-300), e[first:]
    left = E - Z @ np.linalg.lstsq(Z, E, rcond=1e-10)[0]
    before, after = E.T @ E / E.shape[0], left.T @ left / (E.shape[0] - Z.shape[1])
    gained = float(np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1])
    return 1.0 - float(np.exp(gained / E.shape[1])) if np.isfinite(gained) else 0.0


def rescued(
    before: Fit | None,
    why: str,
    model: LinearModel,
    signals: Signals,
    parameters: Sequence[Parameter],
    delay: Delay,
    how: Rescue,
    followed: Callable[[Sequence[Candidate]], Fit],
    tick: Callable[[], None] | None,
) -> Fit | None:
    """Search globally, and locally from what was found.

    `before`: what the ordinary starts led to; `why`: why that is not enough; `followed`: the local search from several
    candidates; `tick`: a KeyboardInterrupt ends in the best so far, where there is any. Returns the better of both,
    `global_search` filled in: ``why``, ``evaluations``, ``seconds``, ``criterion_before`` and ``criterion_after`` (per
    sample, null where there is none), ``taken``, ``interrupted``. None where nothing was found at all.
    """
    cost = likelihood_cost(model, signals, parameters, delay) if how.evaluations else None
    if cost is None:
        return before
    began, run, after, interrupted = perf_counter(), _Seen(), None, False

    def told(stage: str, done: float | None = None, /) -> None:
        del stage, done
        run.evaluations += 1
        if tick is not None:
            tick()

    try:
        candidates = global_candidates(cost, signals, how, tick=told, keep=run.keep)
        candidates = sorted((raced(c, tick) for c in candidates), key=lambda c: c.criterion)
        after = followed(candidates[:1]) if candidates else None
    except KeyboardInterrupt:
        interrupted = True
        candidates = [] if run.vector is None else candidates_at(cost, signals, [run.vector])
        if candidates:  # not a step further: what was found, with its information
            after = search(candidates[0].problem, candidates[0].vector, most=0)
        if before is None and (after is None or after.status == "failed"):
            raise
    taken = _better(after, before)
    fit = after if taken else before
    if fit is None:
        return None
    report = {
        "why": why, "evaluations": run.evaluations, "seconds": perf_counter() - began,
        "criterion_before": _per_sample(before), "criterion_after": _per_sample(after), "taken": taken,
        "interrupted": interrupted,
    }  # fmt: skip
    return replace(fit, global_search=report)


def told(report: Mapping[str, object]) -> str:
    """Return what a global search did, in one sentence for people.

    `report`: `global_search` of a fit.
    """
    before, after = report["criterion_before"], report["criterion_after"]
    out = f"the ordinary start values failed ({report['why']}): "
    if report["interrupted"]:
        out += "a global search was interrupted, and the best so far is kept; "
    else:
        out += f"a global search by differential evolution was made ({report['evaluations']} evaluations); "
    if not report["taken"]:
        return out + "it found nothing better. Check columns, signs and units, delay and excitation"
    if before is None:
        return out + "the fit comes from there"
    fall = float(str(before)) - float(str(after))
    return out + f"the fit comes from there, its likelihood criterion lies {fall:.2g} per sample lower"


@dataclass(slots=True)
class _Seen:
    """What an interruption must not lose."""

    vector: Array | None = None
    value: float = np.inf
    evaluations: int = 0

    def keep(self, vector: Array, value: float) -> None:
        if value < self.value:
            self.vector, self.value = vector, value


def _per_sample(fit: Fit | None) -> float | None:
    return None if fit is None or fit.status == "failed" else fit.criterion / fit.problem.n_used


def _better(after: Fit | None, before: Fit | None) -> bool:
    """Whether the later fit says more of the data than its numbers cost, or as much and has converged."""
    if after is None or after.status == "failed":
        return False
    if before is None or before.status == "failed":
        return True
    # compared per sample, because a longer delay may leave fewer samples
    n = before.problem.n_used
    gain = n * (before.criterion / n - after.criterion / after.problem.n_used)
    gain += (before.problem.size - after.problem.size) * float(np.log(n))
    return gain > _BETTER or (gain > -_BETTER and after.status == "converged" != before.status)
