"""The process terms of a NARMAX model, chosen from measured signals alone, and drafts of models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ambid.arrays import Array
from ambid.estimation.progress import Tick, part_of
from ambid.nonlinear.narmax.candidates import Candidates, MatrixCandidates, candidates
from ambid.nonlinear.narmax.recursion import Tables, tables
from ambid.nonlinear.narmax.selection import Selection, select_terms
from ambid.nonlinear.narmax.settings import NarmaxSettings
from ambid.nonlinear.narmax.terms import Term, lagged, products

Parts = Sequence[tuple[Array, Array]]


_NEARLY_ALL = 0.99  # of the output's energy


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Draft:
    """A model in scaled signals on its way."""

    numerators: tuple[tuple[Term, ...], ...]  # by output
    denominators: tuple[tuple[Term, ...], ...]
    theta: Array  # (n_theta,), scaled, output by output, numerator before denominator
    n_inputs: int
    err: dict[tuple[int, Term], float] = field(default_factory=dict)  # error reduction ratio, where there is one
    n_candidates: int = 0  # of one output, at most
    passes: int = 0  # over the data, in the choice of process terms
    folded: int = 0  # as in `recursion.Tables`

    @property
    def tables(self) -> Tables:
        """For the recursions."""
        return tables(self.numerators, self.denominators, self.n_inputs, folded=self.folded)

    def with_theta(self, theta: Array) -> Draft:
        """Return the same terms with other coefficients.

        `theta`: (n_theta,).
        """
        return redrawn(self.numerators, self.denominators, theta, self)

    def without(self, dropped: Sequence[int], theta: Array) -> Draft:
        """Return a draft with fewer terms.

        `dropped`: places in `theta` as it was; `theta`: (n_theta - n_dropped,), of the terms that stay.
        """
        k = 0
        num: list[tuple[Term, ...]] = []
        den: list[tuple[Term, ...]] = []
        for o in range(len(self.numerators)):
            for terms, out in ((self.numerators[o], num), (self.denominators[o], den)):
                out.append(tuple(x for j, x in enumerate(terms) if k + j not in dropped))
                k += len(terms)
        return redrawn(tuple(num), tuple(den), theta, self)


def redrawn(num: tuple[tuple[Term, ...], ...], den: tuple[tuple[Term, ...], ...], theta: Array, like: Draft) -> Draft:
    """Return a draft with other terms.

    `num`, `den`: numerators and denominators by output; `theta`: (n_theta,), scaled; `like`: what the rest is taken
    from.
    """
    return replace(like, numerators=num, denominators=den, theta=theta)


def process_terms(s: NarmaxSettings, parts: Parts, tick: Tick | None) -> Draft:
    """Choose the terms without innovations by orthogonal least squares.

    `parts`: by record. Returns polynomial; coefficients by least squares.
    """
    n_y, n_u = parts[0][0].shape[1], parts[0][1].shape[1]
    terms = products(
        lagged(n_y, n_u, ny=s.ny, nu=s.nu, nk=s.nk, ne=0), s.degree, constant=bool(s.constant), odd=s.symmetry == "odd"
    )
    y, u = [p[0] for p in parts], [p[1] for p in parts]
    found = candidates(terms, y, u, None, s.lag)
    num, theta, err, passes = [], [], {}, 0
    for o in range(n_y):
        target = np.concatenate([x[s.lag :, o] for x in y])
        chosen = chosen_terms(s, found, target, part_of(tick, o / n_y, (o + 1) / n_y))
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


def sampled_fast(draft: Draft) -> bool:
    """Say whether an output's last value takes so much of an error reduction ratio that the ratios say little.

    `draft`: chosen by the ratios.
    """
    return any(
        len(x) == 1 and x[0].kind == "y" and (x[0].channel, x[0].lag) == (o, 1) and ratio > _NEARLY_ALL
        for (o, x), ratio in draft.err.items()
    )


def chosen_terms(s: NarmaxSettings, found: Candidates | MatrixCandidates, y: Array, tick: Tick | None) -> Selection:
    """Choose as the settings say.

    `y`: (n_rows,).
    """
    most = len(found.terms) if s.selection == "all" else min(s.terms, max(y.size // 5, 1))
    return select_terms(
        found,
        y,
        most=most,
        criterion=s.criterion,
        tick=None if tick is None else lambda done: tick("choice of terms", done),
    )


def least_squares(P: Array, y: Array) -> Array:
    """Return least-squares coefficients, by QR of columns of unit length.

    `P`: (n_rows, n_terms); `y`: (n_rows,). Returns (n_terms,), the shortest of them (in units of the columns) where
    several are as good.
    """
    length = np.linalg.norm(P, axis=0)
    length[length == 0] = 1.0
    out: Array = np.linalg.lstsq(P / length, y, rcond=1e-13)[0] / length
    return out
