"""Terms chosen by what they do for the free run: orthogonal least squares on the slopes of the simulation.

From a linear model on, each candidate not in the model is looked at as a coefficient that is still zero: the slope of
the free run by it, an exact sensitivity, is its column, and the simulation error what the columns have to explain. The
one with the largest error reduction ratio enters, all coefficients are searched anew by simulation error, terms that
have become useless go. The aim is that of Piroddi and Spinelli (2003), who try every candidate in a run of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.criteria import information
from ambid.estimation.progress import Tick, guessed, part_of
from ambid.nonlinear.narmax.choose import Draft, process_terms
from ambid.nonlinear.narmax.folded import linear_folded
from ambid.nonlinear.narmax.recursion import predicted, sensitivities, tables
from ambid.nonlinear.narmax.search import evaluated, search, triangle
from ambid.nonlinear.narmax.settings import NarmaxSettings
from ambid.nonlinear.narmax.terms import Term, lagged, products

Parts = Sequence[tuple[Array, Array]]

_TRIED = 4  # candidates that are tried before it is said that none pays
_USUAL = 8.0  # trials, about half of those that it takes
_ONE = np.ones(1)


def terms_by_simulation(s: NarmaxSettings, parts: Parts, tick: Tick | None, keep: Callable[[Draft], None]) -> Draft:
    """Choose process terms by the error of the free run.

    `keep`: given each better model. Returns coefficients by simulation errors; those of a one-step fit where no free
    run stays finite.
    """
    n_u = parts[0][1].shape[1]
    if parts[0][0].shape[1] > 1:
        raise EstimationError("narmax: selection = simulation is for one output. Use frols, and pruning = simulation")
    terms = products(
        lagged(1, n_u, ny=s.ny, nu=s.nu, nk=s.nk, ne=0), s.degree, constant=bool(s.constant), odd=s.symmetry == "odd"
    )
    n = sum(max(p[0].shape[0] - s.lag, 1) for p in parts)
    most = min(s.terms, max(n // 5, 1), len(terms))

    def value(d: Draft) -> float:
        cost = evaluated(d.tables, d.theta, parts, _ONE, free=True).cost / n
        return information(s.criterion, cost, d.theta.size, n, len(terms)) if np.isfinite(cost) else np.inf

    draft = replace(_start(s, parts, part_of(tick, 0.0, 0.3)), n_candidates=len(terms))
    choice, tried = part_of(tick, 0.3, 1.0), 0
    now = value(draft)
    if not np.isfinite(now):
        return draft
    keep(draft)
    while draft.theta.size < most:
        better = None
        for term in _promising(draft, terms, parts)[:_TRIED]:
            if choice is not None:
                choice("choice of terms by simulation", guessed(tried, _USUAL))
            tried += 1
            trial = _pruned(_searched(_with(draft, term), parts), parts, value)
            if value(trial) < now:
                better = trial
                break
        if better is None:
            break
        draft, now = better, value(better)
        keep(draft)
    return draft


def _start(s: NarmaxSettings, parts: Parts, tick: Tick | None) -> Draft:
    """A linear model by simulation errors."""
    if s.output != "signed":
        return linear_folded(s, parts, tick)
    draft = process_terms(replace(s, degree=1, selection="all", ne=0), parts, None)
    return _searched(draft, parts)


def _searched(draft: Draft, parts: Parts) -> Draft:
    return draft.with_theta(search(draft.tables, draft.theta, parts, _ONE, free=True, most=25).theta)


def _with(draft: Draft, term: Term) -> Draft:
    return replace(draft, numerators=((*draft.numerators[0], term),), theta=np.append(draft.theta, 0.0))


def _promising(draft: Draft, terms: Sequence[Term], parts: Parts) -> list[Term]:
    """Candidates outside the model, the largest error reduction ratio beside its terms first."""
    inside = draft.numerators[0]
    outside = [x for x in terms if x not in set(inside)]
    if not outside:
        return []
    t = tables(((*inside, *outside),), ((),), draft.n_inputs, folded=draft.folded)
    theta = np.concatenate([draft.theta, np.zeros(len(outside))])
    rows, errors = [], []
    for y, u in parts:
        yhat, z = predicted(t, theta, y, u, free=True)
        rows.append(sensitivities(t, theta, z, free=True)[t.lag :, 0])
        errors.append((y - yhat)[t.lag :, 0])
    J, e = np.concatenate(rows), np.concatenate(errors)
    if not (np.all(np.isfinite(J)) and np.all(np.isfinite(e))):
        return []
    k = len(inside)
    Q = np.linalg.qr(J[:, :k])[0]
    rest, left = e - Q @ (Q.T @ e), J[:, k:] - Q @ (Q.T @ J[:, k:])
    squared = np.sum(left**2, axis=0)
    live = squared > 1e-12 * np.sum(J[:, k:] ** 2, axis=0)
    ratio = np.where(live, (left.T @ rest) ** 2 / np.where(live, squared, 1.0), -1.0)
    return [outside[int(i)] for i in np.argsort(-ratio, kind="stable") if ratio[i] > 0]


def _pruned(draft: Draft, parts: Parts, value: Callable[[Draft], float]) -> Draft:
    """Leave out terms, the least significant first, as long as the criterion gains by it."""
    now = value(draft)
    while draft.theta.size > 2 and np.isfinite(now):
        R = triangle(draft.tables, draft.theta, parts, _ONE, free=True)
        if not np.all(np.isfinite(R)):
            return draft
        scale = np.maximum(np.linalg.norm(R[:, :-1], axis=0), 1e-150)
        inverse = np.linalg.pinv(R[:, :-1] / scale, rcond=1e-13) / scale[:, None]
        k = int(np.argmin(draft.theta**2 / np.maximum(np.sum(inverse**2, axis=1), 1e-300)))
        fewer = _searched(draft.without([k], np.delete(draft.theta, k)), parts)
        then = value(fewer)
        if not then < now:
            return draft
        draft, now = fewer, then
    return draft
