"""Which terms a NARMAX model consists of, with first coefficients: process terms, noise terms, denominators.

Process terms come first, from measured signals alone; terms with innovations follow by extended least squares, the
innovations being those of the model before (Billings 2013, sec. 3.5). Denominators are chosen from the equation
multiplied out, y(t) on its right side replaced by a prediction, which its noise would bias (Billings and Zhu 1991).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ambid.identify.narmax.candidates import Candidates, MatrixCandidates, candidates
from ambid.identify.narmax.recursion import Tables, predicted, tables
from ambid.identify.narmax.selection import Selection, select_terms
from ambid.identify.narmax.settings import NarmaxSettings
from ambid.identify.narmax.terms import Term, lagged, noise_terms, products

Array = NDArray[np.float64]
Parts = Sequence[tuple[Array, Array]]
Tick = Callable[[str], object]

_ROUNDS = 12  # of extended least squares
_CHOOSING = 3  # of them, in which the choice of noise terms may still change
_RATIONAL_ROUNDS = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Draft:
    """A model in scaled signals on its way.

    Attributes
    ----------
    numerators, denominators : tuple of tuple of Term
        By output.
    theta : ndarray, shape (n_theta,), scaled
        Output by output, numerator before denominator.
    n_inputs : int
    err : Mapping[(int, Term), float]
        Error reduction ratio, where there is one.
    n_candidates : int
        Of one output, at most.
    passes : int
        Over the data, in the choice of process terms.
    """

    numerators: tuple[tuple[Term, ...], ...]
    denominators: tuple[tuple[Term, ...], ...]
    theta: Array
    n_inputs: int
    err: dict[tuple[int, Term], float] = field(default_factory=dict)
    n_candidates: int = 0
    passes: int = 0

    @property
    def tables(self) -> Tables:
        """For the recursions."""
        return tables(self.numerators, self.denominators, self.n_inputs)

    def with_theta(self, theta: Array) -> Draft:
        """Return the same terms with other coefficients.

        Parameters
        ----------
        theta : ndarray, shape (n_theta,)

        Returns
        -------
        Draft
        """
        return _draft(self.numerators, self.denominators, theta, self)

    def without(self, dropped: Sequence[int], theta: Array) -> Draft:
        """Return a draft with fewer terms.

        Parameters
        ----------
        dropped : sequence of int
            Places in `theta` as it was.
        theta : ndarray, shape (n_theta - n_dropped,)
            Of the terms that stay.

        Returns
        -------
        Draft
        """
        k = 0
        num: list[tuple[Term, ...]] = []
        den: list[tuple[Term, ...]] = []
        for o in range(len(self.numerators)):
            for terms, out in ((self.numerators[o], num), (self.denominators[o], den)):
                out.append(tuple(x for j, x in enumerate(terms) if k + j not in dropped))
                k += len(terms)
        return _draft(tuple(num), tuple(den), theta, self)


def _draft(num: tuple[tuple[Term, ...], ...], den: tuple[tuple[Term, ...], ...], theta: Array, like: Draft) -> Draft:
    return Draft(
        numerators=num,
        denominators=den,
        theta=theta,
        n_inputs=like.n_inputs,
        err=like.err,
        n_candidates=like.n_candidates,
        passes=like.passes,
    )


def process_terms(s: NarmaxSettings, parts: Parts, tick: Tick | None) -> Draft:
    """Choose the terms without innovations by orthogonal least squares.

    Parameters
    ----------
    s : NarmaxSettings
    parts : sequence of (outputs, inputs), scaled
        By record.
    tick : callable or None

    Returns
    -------
    Draft
        Polynomial; coefficients by least squares.
    """
    n_y, n_u = parts[0][0].shape[1], parts[0][1].shape[1]
    terms = products(lagged(n_y, n_u, ny=s.ny, nu=s.nu, nk=s.nk, ne=0), s.degree, constant=bool(s.constant))
    y, u = [p[0] for p in parts], [p[1] for p in parts]
    found = candidates(terms, y, u, None, s.lag)
    num, theta, err, passes = [], [], {}, 0
    for o in range(n_y):
        target = np.concatenate([x[s.lag :, o] for x in y])
        chosen = _chosen(s, found, target, tick)
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


def _chosen(s: NarmaxSettings, found: Candidates | MatrixCandidates, y: Array, tick: Tick | None) -> Selection:
    most = len(found.terms) if s.selection == "all" else min(s.terms, max(y.size // 5, 1))
    return select_terms(
        found, y, most=most, criterion=s.criterion, tick=None if tick is None else lambda: tick("choice of terms")
    )


def least_squares(P: Array, y: Array) -> Array:
    """Return least-squares coefficients, by QR of columns of unit length.

    Parameters
    ----------
    P : ndarray, shape (n_rows, n_terms)
    y : ndarray, shape (n_rows,)

    Returns
    -------
    ndarray, shape (n_terms,)
        The shortest of them (in units of the columns) where several are as good.
    """
    length = np.linalg.norm(P, axis=0)
    length[length == 0] = 1.0
    out: Array = np.linalg.lstsq(P / length, y, rcond=1e-13)[0] / length
    return out


def with_noise_terms(s: NarmaxSettings, draft: Draft, parts: Parts, tick: Tick | None) -> Draft:
    """Add terms with innovations by extended least squares, until coefficients stand still.

    Parameters
    ----------
    s : NarmaxSettings
    draft : Draft
        Of process terms.
    parts : sequence of (outputs, inputs), scaled
    tick : callable or None

    Returns
    -------
    Draft
    """
    n_y, n_u = parts[0][0].shape[1], draft.n_inputs
    extra = noise_terms(n_y, n_u, ny=s.ny, nu=s.nu, nk=s.nk, ne=s.ne, degree=s.noise_degree)
    y, u = [p[0] for p in parts], [p[1] for p in parts]
    errors = innovations(draft, parts)
    if not extra or errors is None:
        return draft
    chosen: list[tuple[Term, ...]] = [()] * n_y
    process, last, best = draft.numerators, draft.theta, draft
    targets = [np.concatenate([x[s.lag :, o] for x in y]) for o in range(n_y)]
    own, below = _denominators(s, draft, parts)
    for rounds in range(_ROUNDS):
        if tick is not None:
            tick("extended least squares")
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
        found = _draft(tuple(num), draft.denominators, np.concatenate(theta), draft)
        new = innovations(found, parts)
        if new is None:
            return best
        errors, best = new, found
        still = found.theta.shape == last.shape and np.allclose(found.theta, last, rtol=1e-4, atol=1e-6)
        last = found.theta
        if still and rounds >= _CHOOSING - 1:
            break
    return best


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


def innovations(draft: Draft, parts: Parts) -> list[Array] | None:
    """Return the one-step errors of each record, zero before the first prediction; None where they diverge.

    Parameters
    ----------
    draft : Draft
    parts : sequence of (outputs, inputs), scaled

    Returns
    -------
    list of ndarray, shape (n_samples, n_outputs), or None
    """
    t, out = draft.tables, []
    for y, u in parts:
        e = y - predicted(t, draft.theta, y, u)[0]
        e[: t.lag] = 0.0
        if not np.all(np.isfinite(e)):
            return None
        out.append(e)
    return out


def rational_terms(s: NarmaxSettings, polynomial: Draft, parts: Parts, tick: Tick | None) -> Draft:
    """Choose numerators and denominators together (thesis eq. 3.3).

    Parameters
    ----------
    s : NarmaxSettings
    polynomial : Draft
        A polynomial model, whose predictions begin the iteration.
    parts : sequence of (outputs, inputs), scaled
    tick : callable or None

    Returns
    -------
    Draft
        With denominators where they pay.
    """
    n_y, n_u = parts[0][0].shape[1], polynomial.n_inputs
    y, u = [p[0] for p in parts], [p[1] for p in parts]
    factors = lagged(n_y, n_u, ny=s.ny, nu=s.nu, nk=s.nk, ne=0)
    up, down = products(factors, s.degree, constant=bool(s.constant)), products(factors, s.degree, constant=False)
    P = candidates(up, y, u, None, s.lag).columns(range(len(up)))
    D = candidates(down, y, u, None, s.lag).columns(range(len(down)))
    num: list[tuple[Term, ...]] = []
    den: list[tuple[Term, ...]] = []
    theta, err, passes = [], {}, 1
    for o in range(n_y):
        target = np.concatenate([x[s.lag :, o] for x in y])
        own = candidates(polynomial.numerators[o], y, u, None, s.lag)
        yhat = own.columns(range(len(own.terms))) @ _own_theta(polynomial, o)
        picks: list[int] = []
        values = np.empty(0)
        for _ in range(_RATIONAL_ROUNDS):
            both = np.hstack([P, -yhat[:, None] * D])
            found = _chosen(s, MatrixCandidates(matrix=both), target, tick)
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
            theta.append(_own_theta(polynomial, o))
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


def _own_theta(draft: Draft, o: int) -> Array:
    """Coefficients of one output of a polynomial draft."""
    first = sum(len(x) for x in draft.numerators[:o])
    return draft.theta[first : first + len(draft.numerators[o])]
