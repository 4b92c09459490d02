"""Which terms a NARMAX model has: process terms, denominators, noise terms, and which of them can go again.

Process terms are chosen from measured signals alone, by orthogonal least squares. Denominators are chosen together with
numerators from the equation multiplied out (thesis eq. 3.3); there y(t) stands on the right side too, and its noise
would bias the result (Billings and Zhu 1991): a prediction takes its place, which makes the equation error the
innovation itself. Terms with innovations follow by extended least squares: those of the model before stand for the
unknown ones, process terms stay as they are (Billings 2013, sec. 3.5).

A term is taken out with the others readjusted along the linearised least-squares problem, exact for NARX. By
predictions it goes if an information criterion gains by it; by simulation (Piroddi and Spinelli 2003) if the free run
does not pay for it, for terms that predict well for one step may spoil a run of many.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.estimation.criteria import information, penalty
from ambid.estimation.linear import least_squares
from ambid.estimation.progress import Tick, guessed, part_of
from ambid.nonlinear.narmax.model import Draft, predict
from ambid.nonlinear.narmax.selection import Candidates, MatrixCandidates, Selection, candidates, select_terms
from ambid.nonlinear.narmax.settings import NarmaxSettings
from ambid.nonlinear.narmax.terms import Term, lagged, noise_terms, products
from ambid.nonlinear.records import Parts

_NEARLY_ALL = 0.99  # of the output's energy
_RATIONAL_ROUNDS = 4
_LONG = 20  # lags of the model whose errors begin
_LESS = 0.95  # part of the errors' variance that it must leave
_ROUNDS = 12  # of extended least squares
_USUAL_ROUNDS = 3.0  # about half of those that it takes
_CHOOSING = 3  # rounds in which the choice of noise terms may still change
_USUAL = 4.0  # terms that are left out, about half of them
_TRIED = 10  # coefficients that are tried before it is said that none can go
_WORSE = 1.2  # times the errors' squares: beyond, leaving one out is far from what the linearised problem says

# --- process terms ---------------------------------------------------------------------------------------------------


def process_terms(s: NarmaxSettings, parts: Parts, tick: Tick | None) -> Draft:
    """Choose the terms without innovations by orthogonal least squares, and their coefficients by least squares."""
    n_y, n_u = parts[0][0].shape[1], parts[0][1].shape[1]
    terms = process_candidates(s, n_y, n_u)
    y, u = [p[0] for p in parts], [p[1] for p in parts]
    found = candidates(terms, y, u, None, s.lag)
    num, theta, err, passes = [], [], {}, 0
    for o in range(n_y):
        target = np.concatenate([x[s.lag :, o] for x in y])
        chosen = _choose(s, found, target, part_of(tick, o / n_y, (o + 1) / n_y))
        n_best = len(chosen.order) if s.selection == "all" else max(chosen.n_best, 1)  # no model without a term
        picks = chosen.order[:n_best] or (0,)
        err.update({(o, terms[k]): float(x) for k, x in zip(picks, chosen.err, strict=False)})
        num.append(tuple(terms[k] for k in picks))
        theta.append(least_squares(found.columns(picks), target))
        passes = max(passes, chosen.passes)
    return Draft(
        numerators=tuple(num),
        denominators=((),) * n_y,
        theta=np.concatenate(theta),
        n_inputs=n_u,
        err=err,
        n_candidates=len(terms),
        passes=passes,
    )


def process_candidates(s: NarmaxSettings, n_outputs: int, n_inputs: int) -> tuple[Term, ...]:
    """Return all products of lagged outputs and inputs that the settings allow."""
    factors = lagged(n_outputs, n_inputs, ny=s.ny, nu=s.nu, nk=s.nk, ne=0)
    return products(factors, s.degree, constant=bool(s.constant), odd=s.symmetry == "odd")


def is_sampled_fast(draft: Draft) -> bool:
    """Return whether an output's last value takes so much of an error reduction ratio that the ratios say little."""
    return any(
        len(x) == 1 and x[0].kind == "y" and (x[0].channel, x[0].lag) == (o, 1) and ratio > _NEARLY_ALL
        for (o, x), ratio in draft.err.items()
    )


def _choose(s: NarmaxSettings, found: Candidates | MatrixCandidates, y: Array, tick: Tick | None) -> Selection:
    """Choose as the settings say."""
    most = len(found.terms) if s.selection == "all" else min(s.terms, max(y.size // 5, 1))
    return select_terms(
        found,
        y,
        most=most,
        criterion=s.criterion,
        tick=None if tick is None else lambda done: tick("choice of terms", done),
    )


# --- denominators -----------------------------------------------------------------------------------------------------


def rational_terms(s: NarmaxSettings, polynomial: Draft, parts: Parts, tick: Tick | None) -> Draft:
    """Choose numerators and denominators together; the predictions of a `polynomial` model begin the iteration."""
    n_y, n_u = parts[0][0].shape[1], polynomial.n_inputs
    y, u = [p[0] for p in parts], [p[1] for p in parts]
    up = process_candidates(s, n_y, n_u)
    down = process_candidates(replace(s, constant=0, symmetry="none"), n_y, n_u)
    P = candidates(up, y, u, None, s.lag).columns(range(len(up)))
    D = candidates(down, y, u, None, s.lag).columns(range(len(down)))
    num: list[tuple[Term, ...]] = []
    den: list[tuple[Term, ...]] = []
    theta, err, passes = [], {}, 1
    for o in range(n_y):
        target = np.concatenate([x[s.lag :, o] for x in y])
        own = candidates(polynomial.numerators[o], y, u, None, s.lag)
        first = sum(len(x) for x in polynomial.numerators[:o])
        own_theta = polynomial.theta[first : first + len(own.terms)]
        yhat = own.columns(range(len(own.terms))) @ own_theta
        picks: list[int] = []
        values = np.empty(0)
        for rounds in range(_RATIONAL_ROUNDS):
            both = np.hstack([P, -yhat[:, None] * D])
            begin, each = (o * _RATIONAL_ROUNDS + rounds) / (n_y * _RATIONAL_ROUNDS), 1.0 / (n_y * _RATIONAL_ROUNDS)
            found = _choose(s, MatrixCandidates(matrix=both), target, part_of(tick, begin, begin + each))
            trial = list(found.chosen)
            new = least_squares(both[:, trial], target)
            below = [k - len(up) for k in trial if k >= len(up)]
            over = [k for k in trial if k < len(up)]
            c_over = new[[k < len(up) for k in trial]]
            c_below = new[[k >= len(up) for k in trial]]
            fresh = 1.0 + D[:, below] @ c_below
            if not np.all(fresh > 1e-3):
                break
            picks, values = [*over, *(k + len(up) for k in below)], np.concatenate([c_over, c_below])
            yhat = (P[:, over] @ c_over) / fresh
            err.update({(o, up[k]): float(found.err[i]) for i, k in enumerate(found.chosen) if k < len(up)})
            passes = max(passes, found.passes)
        if not picks:
            num.append(polynomial.numerators[o])
            den.append(())
            theta.append(own_theta)
            continue
        num.append(tuple(up[k] for k in picks if k < len(up)))
        den.append(tuple(down[k - len(up)] for k in picks if k >= len(up)))
        theta.append(values)
    return Draft(
        numerators=tuple(num),
        denominators=tuple(den),
        theta=np.concatenate(theta),
        n_inputs=n_u,
        err=err,
        n_candidates=len(up) + len(down),
        passes=passes,
    )


# --- noise terms ------------------------------------------------------------------------------------------------------


def add_noise_terms(s: NarmaxSettings, draft: Draft, parts: Parts, tick: Tick | None) -> Draft:
    """Add terms with innovations to process terms by extended least squares, until coefficients stand still."""
    n_y, n_u = parts[0][0].shape[1], draft.n_inputs
    extra = noise_terms(n_y, n_u, ny=s.ny, nu=s.nu, nk=s.nk, ne=s.ne, degree=s.noise_degree)
    y, u = [p[0] for p in parts], [p[1] for p in parts]
    errors = innovations(draft, parts)
    if not extra or errors is None:
        return draft
    errors = _of_a_long_model(draft, parts, errors)
    chosen: list[tuple[Term, ...]] = [()] * n_y
    process, last, best = draft.numerators, draft.theta, draft
    targets = [np.concatenate([x[s.lag :, o] for x in y]) for o in range(n_y)]
    own, below = _denominators(s, draft, parts)
    for rounds in range(_ROUNDS):
        if tick is not None:
            tick("extended least squares", guessed(rounds, _USUAL_ROUNDS))
        num, theta = [], []
        for o in range(n_y):
            over = below[o]
            if rounds < _CHOOSING:
                rows = candidates((*process[o], *extra), y, u, errors, s.lag, over)
                chosen[o] = _noise_choice(s, rows, len(process[o]), targets[o])
            terms = (*process[o], *chosen[o])
            rows = candidates(terms, y, u, errors, s.lag, over)
            num.append(terms)
            theta += [least_squares(rows.columns(range(len(terms))), targets[o]), own[o]]
        found = replace(draft, numerators=tuple(num), theta=np.concatenate(theta))
        new = innovations(found, parts)
        if new is None:
            return best
        errors, best = new, found
        still = found.theta.shape == last.shape and np.allclose(found.theta, last, rtol=1e-4, atol=1e-6)
        last = found.theta
        if still and rounds >= _CHOOSING - 1:
            break
    return best


def _of_a_long_model(draft: Draft, parts: Parts, errors: list[Array]) -> list[Array]:
    """First innovations from many linear lags beside the process terms (Hannan and Rissanen 1982), if they are less.

    Where noise on the output is sampled fast, least squares without noise terms is so biased that its errors are nearly
    white, and no noise term pays beside them.
    """
    n = min(int(y.shape[0]) for y, _ in parts)
    n_y, n_u = len(draft.numerators), draft.n_inputs
    most = min(_LONG, n // (10 * (n_y + n_u)))
    if any(draft.denominators) or most <= draft.tables.lag:
        return errors
    linear = [(f,) for f in lagged(n_y, n_u, ny=most, nu=most, nk=1, ne=0)]
    num, theta = [], []
    for o, terms in enumerate(draft.numerators):
        all_terms = (*terms, *(x for x in linear if x not in terms))
        rows = candidates(all_terms, [p[0] for p in parts], [p[1] for p in parts], None, most)
        target = np.concatenate([y[most:, o] for y, _ in parts])
        num.append(all_terms)
        theta.append(least_squares(rows.columns(range(len(all_terms))), target))
    found = innovations(replace(draft, numerators=tuple(num), theta=np.concatenate(theta)), parts)
    if found is None:
        return errors
    size = [np.mean(np.concatenate([x[most:] for x in e]) ** 2, axis=0) for e in (errors, found)]
    return found if np.any(size[1] < _LESS * size[0]) else errors


def _denominators(s: NarmaxSettings, draft: Draft, parts: Parts) -> tuple[list[Array], list[tuple[Array, ...] | None]]:
    """Coefficients of each output's denominator, and one over its values in each record."""
    first, own, below = 0, [], []
    for num, den in zip(draft.numerators, draft.denominators, strict=True):
        first += len(num)
        theta = draft.theta[first : first + len(den)]
        first += len(den)
        rows = candidates(den, [p[0] for p in parts], [p[1] for p in parts], None, s.lag)
        a = 1.0 + rows.columns(range(len(den))) @ theta if len(den) else None
        own.append(theta)
        below.append(None if a is None else tuple(np.split(1.0 / a, np.cumsum(rows.rows)[:-1])))
    return own, below


def _noise_choice(s: NarmaxSettings, rows: Candidates, n_process: int, target: Array) -> tuple[Term, ...]:
    """Noise terms that pay beside the process terms; these are in the regression, not in the choice."""
    found = select_terms(rows, target, most=n_process + s.terms, criterion=s.criterion, first=range(n_process))
    return tuple(rows.terms[k] for k in found.chosen if k >= n_process)


def add_all_noise(s: NarmaxSettings, draft: Draft) -> Draft:
    """Return a draft with every linear term in the innovations that it may have, those that are new at zero.

    Returns the same one where nothing is new.
    """
    n_y, k, new = len(draft.numerators), 0, False
    extra = noise_terms(n_y, draft.n_inputs, ny=0, nu=0, nk=1, ne=s.ne, degree=1)
    num, theta = [], []
    for up, down in zip(draft.numerators, draft.denominators, strict=True):
        more = tuple(x for x in extra if x not in up)
        new = new or bool(more)
        num.append((*up, *more))
        theta += [draft.theta[k : k + len(up)], np.zeros(len(more)), draft.theta[k + len(up) : k + len(up) + len(down)]]
        k += len(up) + len(down)
    return replace(draft, numerators=tuple(num), theta=np.concatenate(theta)) if new else draft


def innovations(draft: Draft, parts: Parts) -> list[Array] | None:
    """Return the one-step errors of each record, zero before the first prediction; None where they diverge.

    Returns (n_samples, n_outputs), or None.
    """
    t, out = draft.tables, []
    for y, u in parts:
        e = y - predict(t, draft.theta, y, u)[0]
        e[: t.lag] = 0.0
        if not np.all(np.isfinite(e)):
            return None
        out.append(e)
    return out


# --- pruning ----------------------------------------------------------------------------------------------------------


def prune_by_prediction(draft: Draft, parts: Parts, weight: Array, criterion: str, *, noise: bool = True) -> Draft:
    """Leave out terms as long as the information criterion of the one-step errors falls.

    `noise`: whether terms with innovations may go.
    """
    n = _samples(draft, parts)
    m = max(draft.n_candidates, draft.theta.size)
    while draft.theta.size > len(draft.numerators):
        R = draft.problem(parts, weight=weight, free=False).triangle(draft.theta)
        if not np.all(np.isfinite(R)):
            return draft
        loss, _ = _find_losses(R, draft.theta)
        may = _may_go(draft) & (noise | ~_noisy(draft))
        if not np.any(may):
            return draft
        saved = penalty(criterion, draft.theta.size, n, m) - penalty(criterion, draft.theta.size - 1, n, m)
        order = np.argsort(np.where(may, loss, np.inf), kind="stable")[:_TRIED]
        fewer = _drop_one(draft, [int(k) for k in order if may[k] and loss[k] < saved], R, parts, weight)
        if fewer is None:
            return draft
        draft = fewer
    return draft


def _drop_one(draft: Draft, tried: list[int], R: Array, parts: Parts, weight: Array) -> Draft | None:
    """The draft without the first of the coefficients tried that leaves a predictor which does not run away."""
    worst = _WORSE * draft.cost(parts, weight=weight, free=False)
    for k in tried:
        fewer = draft.without([k], _readjust(R, draft.theta, k))
        if fewer.cost(parts, weight=weight, free=False) < worst:
            return fewer
    return None


def prune_by_simulation(draft: Draft, parts: Parts, criterion: str, tick: Tick | None) -> Draft:
    """Leave out terms as long as the information criterion of the simulation errors falls."""
    n = _samples(draft, parts)
    m = max(draft.n_candidates, draft.theta.size)

    def value(d: Draft) -> float:
        cost = d.cost(parts, free=True)
        return information(criterion, cost / n, d.theta.size, n, m) if np.isfinite(cost) else np.inf

    now, before = value(draft), draft.theta.size
    while draft.theta.size > len(draft.numerators):
        if tick is not None:
            tick("simulation-error pruning", guessed(before - draft.theta.size, _USUAL))
        R = draft.problem(parts, free=False).triangle(draft.theta)
        if not np.all(np.isfinite(R)):
            return draft
        may = [k for k in np.flatnonzero(_may_go(draft)) if not _noisy(draft)[k]]
        trials = [draft.without([int(k)], _readjust(R, draft.theta, int(k))) for k in may]
        values = [value(d) for d in trials]
        if not values or not min(values) < now:
            return draft
        best = int(np.argmin(values))
        draft, now = trials[best], values[best]
    return draft


def _samples(draft: Draft, parts: Parts) -> int:
    lag = draft.tables.lag
    return max(sum(max(int(y.shape[0]) - lag, 0) for y, _ in parts), 2)


def _find_losses(R: Array, theta: Array) -> tuple[Array, Array]:
    """How much the sum of squares grows without each coefficient, and the inverse triangle."""
    scale = np.maximum(np.linalg.norm(R[:, :-1], axis=0), 1e-150)
    inverse = np.linalg.pinv(R[: theta.size, :-1] / scale, rcond=1e-13) / scale[:, None]
    variance = np.sum(inverse**2, axis=1)
    return theta**2 / np.maximum(variance, 1e-300), inverse


def _readjust(R: Array, theta: Array, k: int) -> Array:
    """The other coefficients once coefficient k is zero."""
    _, inverse = _find_losses(R, theta)
    covariance = inverse @ inverse[k]
    out: Array = np.delete(theta - covariance * (theta[k] / max(covariance[k], 1e-300)), k)
    return out


def _may_go(draft: Draft) -> NDArray[np.bool_]:
    """Whether a term may be left out: an output keeps one term at least."""
    out: list[bool] = []
    for num, den in zip(draft.numerators, draft.denominators, strict=True):
        out += [len(num) > 1] * len(num) + [True] * len(den)
    return np.array(out)


def _noisy(draft: Draft) -> NDArray[np.bool_]:
    """Whether a term holds an innovation."""
    out: list[bool] = []
    for num, den in zip(draft.numerators, draft.denominators, strict=True):
        out += [any(f.kind == "e" for f in x) for x in (*num, *den)]
    return np.array(out)
