"""Terms chosen by what they do for the free run: orthogonal least squares on the slopes of the simulation.

From a linear model on, each candidate not in the model is looked at as a coefficient that is still zero: the slope of
the free run by it, an exact sensitivity, is its column, and the simulation error what the columns have to explain. The
one with the largest error reduction ratio enters, all coefficients are searched anew by simulation error, terms that
have become useless go. The aim is that of Piroddi and Spinelli (2003), who try every candidate in a run of its own.

Where only the magnitude of the output is measured, such as the speed of a pulse counter, the sign is not in the data,
and a search from a wrong one ends in a wrong minimum. So linear models of order three (a real pole, a pair, a delay)
are laid on a grid, the gain of each fitted to the magnitude, and the best of them refined.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.criteria import information
from ambid.estimation.progress import Tick, guessed, part_of
from ambid.nonlinear.narmax.choice import process_candidates, process_terms
from ambid.nonlinear.narmax.model import OUTPUTS, Draft
from ambid.nonlinear.narmax.settings import NarmaxSettings
from ambid.nonlinear.narmax.terms import Factor, Term
from ambid.nonlinear.nn_magnitude import pole_grid
from ambid.nonlinear.records import Parts

_TRIED = 4  # candidates that are tried before it is said that none pays
_USUAL = 8.0  # trials, about half of those that it takes
_REFINED = 25  # models of the grid that are searched from


def choose_by_simulation(s: NarmaxSettings, parts: Parts, tick: Tick | None, keep: Callable[[Draft], None]) -> Draft:
    """Choose process terms by the error of the free run; `keep` is given each better model.

    Coefficients are those of a one-step fit where no free run stays finite.
    """
    n_u = parts[0][1].shape[1]
    if parts[0][0].shape[1] > 1:
        raise EstimationError("narmax: selection = simulation is for one output. Use frols, and pruning = simulation")
    terms = process_candidates(s, 1, n_u)
    n = sum(max(p[0].shape[0] - s.lag, 1) for p in parts)
    most = min(s.terms, max(n // 5, 1), len(terms))

    def value(d: Draft) -> float:
        cost = d.cost(parts, free=True) / n
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
            trial = _prune(_search(_add(draft, term), parts), parts, value)
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
        return start_of_magnitude(s, parts, tick)
    draft = process_terms(replace(s, degree=1, selection="all", ne=0), parts, None)
    return _search(draft, parts)


def _search(draft: Draft, parts: Parts) -> Draft:
    return draft.with_theta(draft.search(parts, free=True, most=25).theta)


def _add(draft: Draft, term: Term) -> Draft:
    return replace(draft, numerators=((*draft.numerators[0], term),), theta=np.append(draft.theta, 0.0))


def _promising(draft: Draft, terms: Sequence[Term], parts: Parts) -> list[Term]:
    """Candidates outside the model, the largest error reduction ratio beside its terms first."""
    inside = draft.numerators[0]
    outside = [x for x in terms if x not in set(inside)]
    if not outside:
        return []
    theta = np.concatenate([draft.theta, np.zeros(len(outside))])
    wide = replace(draft, numerators=((*inside, *outside),), theta=theta)
    rows = np.concatenate([x[:, 0] for x in wide.problem(parts, free=True).rows(theta)])
    J, e = rows[:, :-1], rows[:, -1]
    if not (np.all(np.isfinite(J)) and np.all(np.isfinite(e))):
        return []
    k = len(inside)
    Q = np.linalg.qr(J[:, :k])[0]
    rest, left = e - Q @ (Q.T @ e), J[:, k:] - Q @ (Q.T @ J[:, k:])
    squared = np.sum(left**2, axis=0)
    live = squared > 1e-12 * np.sum(J[:, k:] ** 2, axis=0)
    ratio = np.where(live, (left.T @ rest) ** 2 / np.where(live, squared, 1.0), -1.0)
    return [outside[int(i)] for i in np.argsort(-ratio, kind="stable") if ratio[i] > 0]


def _prune(draft: Draft, parts: Parts, value: Callable[[Draft], float]) -> Draft:
    """Leave out terms, the least significant first, as long as the criterion gains by it."""
    now = value(draft)
    while draft.theta.size > 2 and np.isfinite(now):
        R = draft.problem(parts, free=True).triangle(draft.theta)
        if not np.all(np.isfinite(R)):
            return draft
        scale = np.maximum(np.linalg.norm(R[:, :-1], axis=0), 1e-150)
        inverse = np.linalg.pinv(R[:, :-1] / scale, rcond=1e-13) / scale[:, None]
        k = int(np.argmin(draft.theta**2 / np.maximum(np.sum(inverse**2, axis=1), 1e-300)))
        fewer = _search(draft.without([k], np.delete(draft.theta, k)), parts)
        then = value(fewer)
        if not then < now:
            return draft
        draft, now = fewer, then
    return draft


def start_of_magnitude(s: NarmaxSettings, parts: Parts, tick: Tick | None) -> Draft:
    """Return the best linear model of the magnitude, fitted to the free run."""
    order = min(s.ny, 3)
    delays = range(max(s.nk, 1), s.nk + s.nu)
    outputs = [Factor("y", 0, k) for k in range(1, order + 1)]
    inputs = [Factor("u", 0, k) for k in delays]
    terms: tuple[Term, ...] = tuple((f,) for f in (*outputs, *inputs))
    best, least = None, np.inf
    starts = _starts(order, delays, parts)
    for k, start in enumerate(starts):
        if tick is not None:
            tick("sign of the output", k / len(starts))
        draft = Draft(numerators=(terms,), denominators=((),), theta=start, n_inputs=1, folded=OUTPUTS.index(s.output))
        found = draft.search(parts, free=True, most=30)
        if best is None or found.cost < least:
            best, least = draft.with_theta(found.theta), found.cost
    assert best is not None
    return best


def _starts(order: int, delays: range, parts: Parts) -> list[Array]:
    """The best of the grid, coefficients in the order of the terms."""
    scored: list[tuple[float, int, Array]] = []
    y = np.concatenate([p[0][:, 0] for p in parts])
    for A in pole_grid(order):
        runs = [lfilter([1.0], A, p[1][:, 0]) for p in parts]
        for d in delays:
            x = np.abs(np.concatenate([np.concatenate([np.zeros(d), r[: r.size - d]]) for r in runs]))
            size = float(x @ x)
            if not (np.isfinite(size) and size > 0):
                continue
            gain = float(x @ y) / size
            b = np.zeros(len(delays))
            b[d - delays.start] = gain
            scored.append((float(np.sum((gain * x - y) ** 2)), len(scored), np.concatenate([-A[1:], b])))
    scored.sort(key=lambda found: found[:2])
    return [theta for _, _, theta in scored[:_REFINED]]
