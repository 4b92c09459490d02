"""Starts for hard cases, and a look whether a better minimum was missed: C and D given, A and B follow.

With C and D known, e = A (D/C) y - B (D/C) u is linear in A and B (variable projection; Golub & Pereyra 1973): one
triangle gives the best loss for a whole candidate. Fast sampling puts the roots of C near 1, where an ARX model of
moderate length, and all starts from it, cannot see them; repeated roots span such long memories with few numbers
(Laguerre models; Wahlberg 1991).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.special import fdtrc

from ambid.arrays import Array
from ambid.blackbox.polynomial._kernels import filtered
from ambid.blackbox.polynomial.orders import Layout
from ambid.blackbox.polynomial.predictor import predictor
from ambid.blackbox.polynomial.scaled import Scaled, liveliest
from ambid.blackbox.polynomial.search import Fitted
from ambid.blackbox.polynomial.stability import solved

SMOOTH = 12  # evaluations; a longer way hints at a second minimum
_GRID = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98)  # roots of C: how long the predictor remembers
_D_GRID = (-0.6, 0.0, 0.6, 0.9)
_WINDOW = 8192  # samples that rank the candidates
_MOST = 3  # candidates to search from
_MORE = 6  # coefficients that a look for a better minimum adds to A and to each B
_LEVEL = 1e-3  # of fits that found their minimum, so many are flagged


def separable_starts(layout: Layout, y: Array, u: Array) -> Iterator[Array]:
    """Yield starts with C and D from a grid, those first that leave least; none for structures with F.

    `y`: (n_samples,), scaled; `u`: (n_inputs, n_samples). Returns (n_theta,).
    """
    if any(layout.nf) or not (layout.nc or layout.nd):
        return
    part = liveliest(u, _WINDOW)
    free = replace(layout, fixed=(), at_rest=layout.at_rest and not part.start)
    found: list[tuple[float, int, Array]] = []
    for C in _candidates(layout.nc, _GRID, mixed=not layout.nd):
        for D in _candidates(layout.nd, _D_GRID, mixed=False):
            loss, theta = _given(free, C, D, y[part], u[:, part])
            found.append((loss, len(found), theta))
    yield from (theta for _, _, theta in sorted(found)[:_MOST])


def missed_minimum(layouts: Sequence[Layout], fits: Sequence[Fitted], scaled: Scaled) -> list[str]:
    """Return a warning for each output whose search went a long way and left what a longer model explains.

    A and B get more coefficients; by how much the next Gauss-Newton step lowers the squared residual is F distributed
    where the search ended in the minimum of the right model (score test; Söderström & Stoica 1989, sec. 11.5).

    `fits`: one for each output.
    """
    found = []
    for o, (layout, fit) in enumerate(zip(layouts, fits, strict=True)):
        if any(layout.nf) or not (layout.nc or layout.nd) or (fit.converged and fit.iterations <= SMOOTH):
            continue
        p, less = _longer_model(layout, fit, scaled.y[o], scaled.u)
        if p < _LEVEL:
            found.append(
                f"{f'output {o}: ' if len(fits) > 1 else ''}a longer model explains significantly more ({less:.1%} of "
                f"the squared residual, p = {p:.0g}) and the search was hard: it may have missed a better minimum, or "
                "the orders are too low. Try pbsid or sspem, or raise the orders"
            )
    return found


def _candidates(n: int, grid: Sequence[float], *, mixed: bool) -> Iterator[Array]:
    """Polynomials with one root of multiplicity n, or two, one of them single."""
    if not n:
        yield np.ones(1)
        return
    for r in grid:
        yield _with_roots([r] * n)
    for r, s in combinations(grid, 2) if mixed else ():
        for k in {1, n - 1} - {0, n}:
            yield _with_roots([r] * (n - k) + [s] * k)


def _with_roots(roots: list[float]) -> Array:
    return np.asarray(np.poly(roots), dtype=np.float64)


def _given(layout: Layout, C: Array, D: Array, y: Array, u: Array) -> tuple[float, Array]:
    """Best loss for C and D, and the coefficients that have it."""
    arx = replace(layout, nc=0, nd=0)
    p, found = predictor(arx), arx.start()
    fu = np.array([filtered(D, C, x) for x in u]).reshape(u.shape)
    R = p.triangle(filtered(D, C, y), fu, found, np.zeros(p.n_nuisance))
    found[arx.free] -= solved(R[:-1, :-1], R[:-1, -1])[p.n_nuisance :]
    theta, places = layout.start(), layout.places
    for letter, i in places:
        theta[places[letter, i]] = {"C": C, "D": D}.get(letter, found[arx.places[letter, i]])
    return float(R[-1, -1] ** 2), theta


def _longer_model(layout: Layout, fit: Fitted, y: Array, u: Array) -> tuple[float, float]:
    """Probability of so large a fall by chance, and the fall as a part of the squared residual (score test)."""
    part = liveliest(u, _WINDOW)
    y, u = y[part], np.ascontiguousarray(u[:, part])
    bare = replace(layout, fixed=(), at_rest=False)
    longer = replace(bare, na=layout.na + _MORE, nb=tuple(n + _MORE for n in layout.nb))
    theta = longer.start()
    for key, place in bare.places.items():
        first = longer.places[key].start
        theta[first : first + place.stop - place.start] = fit.theta[place]
    skip = longer.first_row - bare.first_row  # both on the same rows
    few, many = predictor(bare), predictor(longer)
    freedom = y.size - longer.first_row - many.columns.shape[0] + 1
    if freedom < 1:
        return 1.0, 0.0
    late = np.ascontiguousarray(u[:, skip:])
    before = float(few.triangle(y[skip:], late, fit.theta, np.zeros(few.n_nuisance))[-1, -1] ** 2)
    after = float(many.triangle(y, u, theta, np.zeros(many.n_nuisance))[-1, -1] ** 2)
    if before <= 1e-20 * y.size:
        return 1.0, 0.0
    ratio = max(before - after, 0.0) / (longer.free.size - bare.free.size) / max(after / freedom, 1e-300)
    return float(fdtrc(longer.free.size - bare.free.size, freedom, ratio)), 1.0 - after / before
