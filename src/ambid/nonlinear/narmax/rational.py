"""Denominators, chosen together with numerators from the equation multiplied out (thesis eq. 3.3).

There y(t) stands on the right side too, and its noise would bias the result (Billings and Zhu 1991); a prediction takes
its place, which makes the equation error the innovation itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ambid.arrays import Array
from ambid.estimation.progress import Tick, part_of
from ambid.nonlinear.narmax.candidates import MatrixCandidates, candidates
from ambid.nonlinear.narmax.choose import Draft, chosen_terms, least_squares
from ambid.nonlinear.narmax.settings import NarmaxSettings
from ambid.nonlinear.narmax.terms import Term, lagged, products

Parts = Sequence[tuple[Array, Array]]

_ROUNDS = 4


def rational_terms(s: NarmaxSettings, polynomial: Draft, parts: Parts, tick: Tick | None) -> Draft:
    """Choose numerators and denominators together (thesis eq. 3.3).

    `polynomial`: a polynomial model, whose predictions begin the iteration. Returns with denominators where they pay.
    """
    n_y, n_u = parts[0][0].shape[1], polynomial.n_inputs
    y, u = [p[0] for p in parts], [p[1] for p in parts]
    factors = lagged(n_y, n_u, ny=s.ny, nu=s.nu, nk=s.nk, ne=0)
    up, down = (
        products(factors, s.degree, constant=bool(s.constant), odd=s.symmetry == "odd"),
        products(factors, s.degree, constant=False),
    )
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
        for rounds in range(_ROUNDS):
            both = np.hstack([P, -yhat[:, None] * D])
            begin, each = (o * _ROUNDS + rounds) / (n_y * _ROUNDS), 1.0 / (n_y * _ROUNDS)
            found = chosen_terms(s, MatrixCandidates(matrix=both), target, part_of(tick, begin, begin + each))
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
