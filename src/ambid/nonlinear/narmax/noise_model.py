"""Terms with innovations, by extended least squares: those of the model before stand for the unknown ones.

Process terms stay as they are (Billings 2013, sec. 3.5); the rounds end when coefficients stand still. Their last
digits come from the prediction-error search, whose innovations are those of the model itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ambid.arrays import Array
from ambid.estimation.progress import Tick, guessed
from ambid.nonlinear.narmax.candidates import Candidates, candidates
from ambid.nonlinear.narmax.choose import Draft, least_squares, redrawn
from ambid.nonlinear.narmax.recursion import predicted
from ambid.nonlinear.narmax.selection import select_terms
from ambid.nonlinear.narmax.settings import NarmaxSettings
from ambid.nonlinear.narmax.terms import Term, lagged, noise_terms

Parts = Sequence[tuple[Array, Array]]

_LONG = 20  # lags of the model whose errors begin
_LESS = 0.95  # part of the errors' variance that it must leave
_ROUNDS = 12
_USUAL = 3.0  # rounds, about half of those that it takes
_CHOOSING = 3  # rounds in which the choice of noise terms may still change


def with_noise_terms(s: NarmaxSettings, draft: Draft, parts: Parts, tick: Tick | None) -> Draft:
    """Add terms with innovations by extended least squares, until coefficients stand still.

    `draft`: of process terms.
    """
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
            tick("extended least squares", guessed(rounds, _USUAL))
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
        found = redrawn(tuple(num), draft.denominators, np.concatenate(theta), draft)
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
    found = innovations(redrawn(tuple(num), draft.denominators, np.concatenate(theta), draft), parts)
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


def with_all_noise(s: NarmaxSettings, draft: Draft) -> Draft:
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
    return redrawn(tuple(num), draft.denominators, np.concatenate(theta), draft) if new else draft


def innovations(draft: Draft, parts: Parts) -> list[Array] | None:
    """Return the one-step errors of each record, zero before the first prediction; None where they diverge.

    Returns (n_samples, n_outputs), or None.
    """
    t, out = draft.tables, []
    for y, u in parts:
        e = y - predicted(t, draft.theta, y, u)[0]
        e[: t.lag] = 0.0
        if not np.all(np.isfinite(e)):
            return None
        out.append(e)
    return out
