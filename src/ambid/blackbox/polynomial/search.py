"""Gauss-Newton and Levenberg-Marquardt search for the coefficients of one output.

It minimises the squared residual over the coefficients, initial states and constant taken out exactly (they enter
linearly; Golub & Pereyra 1973). Each step works on the triangle of the rows (predictor.py), so its cost does not grow
with the record: scipy's optimisers would hold and factorise all rows again. Steps that leave the region where the
predictor is stable are shortened, so the result is stable by construction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.polynomial.predictor import Predictor
from ambid.blackbox.polynomial.stability import solved, stable_predictor

Directions = tuple[Array, Array, Array, Array]

_ENOUGH = 1e-6  # squared length of the last step in standard deviations
_NOTHING_LEFT = 1e-24  # squared residual over squared output where the data are matched to rounding
_MOST = 100
BLIND = 1e8  # condition number, columns of unit length, beyond which a direction counts as not seen
_UNSEEN = 1e-11  # singular value, of scaled columns, below which no step is taken along a direction


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fitted:
    """Where a search ended."""

    theta: Array  # (n_theta,), all coefficients of the output, in scaled units
    free: NDArray[np.int64]  # (n_free,), places of the estimated ones
    nuisance: Array  # (n_nuisance,), initial states and constant
    triangle: Array  # (n_free, n_free), R of the free coefficients, nuisance taken out
    directions: Directions  # U, s, Vt and column lengths: `triangle` with columns of unit length is U diag(s) Vt
    cost: float  # squared residual
    n_rows: int
    converged: bool
    at_border: bool  # whether steps had to be shortened to the end to keep the predictor stable
    iterations: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Point:
    theta: Array
    nuisance: Array
    R: Array
    n: int  # nuisance numbers

    @property
    def rest(self) -> float:
        return float(self.R[-1, -1] ** 2)

    @property
    def gradient(self) -> Array:
        return np.asarray(self.R[self.n : -1, -1])

    @property
    def cost(self) -> float:
        e = self.R[self.n :, -1]
        return float(e @ e)


def searched(
    predictor: Predictor,
    y: Array,
    u: Array,
    start: Array,
    *,
    most: int = _MOST,
    tick: Callable[[], None] | None = None,
) -> Fitted:
    """Minimise the squared residual from `start`.

    `y`: (n_samples,), scaled, mean taken off; `u`: (n_inputs, n_samples); `start`: (n_theta,), its C and F must be
    stable; `most`: evaluations; `tick`: called before each evaluation.
    """
    n, free = predictor.n_nuisance, predictor.layout.free

    def evaluated(theta: Array, nuisance: Array) -> _Point:
        if tick is not None:
            tick()
        return _Point(theta=theta, nuisance=nuisance, R=predictor.triangle(y, u, theta, nuisance), n=n)

    n_rows = y.size - predictor.first_row
    floor = _NOTHING_LEFT * float(y @ y)
    at = evaluated(start, np.zeros(n))
    explained = float(np.sum(at.R[:n, -1] ** 2))
    if predictor.n_initial and explained > 1e-3 * at.cost:  # gradients by F and C need the initial states
        at = evaluated(start, at.nuisance + _nuisance_step(at, np.zeros(free.size)))
    damping, converged, shortened, exact, count = 0.0, False, False, False, 1
    while True:
        directions = _directions(at, n)
        U, s, Vt, scale = _seen(*directions)
        spread = max(at.rest / max(n_rows - n - free.size, 1), 1e-300)
        left = float(np.sum((U.T @ at.gradient) ** 2))
        step = _step(U, s, Vt, scale, at.gradient, 0.0)
        if left <= _ENOUGH * spread or at.cost <= floor or _linear(predictor):
            theta = _moved(at.theta, free, step)
            if _linear(predictor) or stable_predictor(predictor.layout, theta):
                at = _finished(at, theta, step, linear=_linear(predictor))
            converged = True
            break
        if count >= most or damping > 1e12:
            # where rounding allows no further descent and less than a hundredth of a standard deviation is left
            converged = damping > 1e12 and left <= 1e-4 * spread
            break
        step = _step(U, s, Vt, scale, at.gradient, damping)
        step, cut = _kept_stable(predictor, at.theta, free, step)
        trial = evaluated(_moved(at.theta, free, step), at.nuisance + _nuisance_step(at, step))
        count += 1
        if trial.cost < at.cost:  # not where it is no number
            expected = at.cost - float(np.sum((at.R[n:-1, n:-1] @ step + at.gradient) ** 2)) - at.rest
            good = at.cost - trial.cost > 0.5 * expected
            damping = (0.0 if damping < 1e-6 else damping * 0.1) if good else max(damping, 1e-6)
            at, shortened, exact = trial, cut, False
        elif not exact:  # gradients at initial states that belong to these coefficients
            at, exact = evaluated(at.theta, at.nuisance + _nuisance_step(at, np.zeros(free.size))), True
            count += 1
        else:
            damping = max(damping * 10.0, 1e-3)
    return Fitted(
        theta=at.theta,
        free=free,
        nuisance=at.nuisance,
        triangle=at.R[n:-1, n:-1],
        directions=directions,
        cost=at.cost,
        n_rows=n_rows,
        converged=converged,
        at_border=shortened,
        iterations=count,
    )


def _linear(predictor: Predictor) -> bool:
    x = predictor.layout
    return not (x.nc or x.nd or any(x.nf))


def _directions(at: _Point, n: int) -> Directions:
    """Singular directions of the scaled triangle."""
    R = at.R[n:-1, n:-1]
    scale = np.maximum(np.sqrt(np.einsum("ij,ij->j", R, R)), 1e-150)
    U, s, Vt = np.linalg.svd(R / scale)
    return U, s, Vt, scale


def _seen(U: Array, s: Array, Vt: Array, scale: Array) -> Directions:
    """Those directions that the data see."""
    seen = s > _UNSEEN * max(s[0] if s.size else 0.0, 1e-300)
    return (U, s, Vt, scale) if seen.all() else (U[:, seen], s[seen], Vt[seen], scale)


def _step(U: Array, s: Array, Vt: Array, scale: Array, gradient: Array, damping: float) -> Array:
    return np.asarray(-(Vt.T @ ((s / (s * s + damping)) * (U.T @ gradient))) / scale)


def _nuisance_step(at: _Point, step: Array) -> Array:
    """Nuisance numbers that go with a step; the smallest where the data do not tell them apart."""
    if not at.n:
        return np.zeros(0)
    return -solved(at.R[: at.n, : at.n], at.R[: at.n, at.n : -1] @ step + at.R[: at.n, -1])


def _moved(theta: Array, free: NDArray[np.int64], step: Array) -> Array:
    out = theta.copy()
    out[free] += step
    return out


def _kept_stable(predictor: Predictor, theta: Array, free: NDArray[np.int64], step: Array) -> tuple[Array, bool]:
    """Halve a step until the predictor stays stable."""
    cut = False
    for _ in range(60):
        if stable_predictor(predictor.layout, _moved(theta, free, step)):
            return step, cut
        step, cut = 0.5 * step, True
    return 0.0 * step, True


def _finished(at: _Point, theta: Array, step: Array, *, linear: bool) -> _Point:
    """Take the last step, too small (or the problem too linear) to need another look at the data."""
    R = at.R
    if linear:
        R = R.copy()
        R[at.n : -1, -1] += R[at.n : -1, at.n : -1] @ step
    return _Point(theta=theta, nuisance=at.nuisance + _nuisance_step(at, step), R=R, n=at.n)
