"""Which terms a NARMAX model can do without: by prediction errors, or by the error of the free run.

A term is taken out with the others readjusted along the linearised least-squares problem, exact for NARX. By
predictions it goes if an information criterion gains by it; by simulation (Piroddi and Spinelli 2003) if the free
run does not pay for it, for terms that predict well for one step may spoil a run of many.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.estimation.criteria import information, penalty
from ambid.estimation.progress import Tick, guessed
from ambid.nonlinear.narmax.choose import Draft
from ambid.nonlinear.narmax.search import evaluated, triangle

Parts = Sequence[tuple[Array, Array]]

_USUAL = 4.0  # terms that are left out, about half of them


_TRIED = 10  # coefficients that are tried before it is said that none can go
_WORSE = 1.2  # times the errors' squares: beyond, leaving one out is far from what the linearised problem says


def pruned_by_prediction(draft: Draft, parts: Parts, weight: Array, criterion: str, *, noise: bool = True) -> Draft:
    """Leave out terms as long as the information criterion of the one-step errors falls.

    `weight`: (n_outputs,), one over the standard deviation of each output's one-step error; `noise`: whether terms with
    innovations may go.
    """
    n = _samples(draft, parts)
    m = max(draft.n_candidates, draft.theta.size)
    while draft.theta.size > len(draft.numerators):
        R = triangle(draft.tables, draft.theta, parts, weight, free=False)
        if not np.all(np.isfinite(R)):
            return draft
        loss, _ = _losses(R, draft.theta)
        may = _may_go(draft) & (noise | ~_noisy(draft))
        if not np.any(may):
            return draft
        saved = penalty(criterion, draft.theta.size, n, m) - penalty(criterion, draft.theta.size - 1, n, m)
        order = np.argsort(np.where(may, loss, np.inf), kind="stable")[:_TRIED]
        fewer = _without_one(draft, [int(k) for k in order if may[k] and loss[k] < saved], R, parts, weight)
        if fewer is None:
            return draft
        draft = fewer
    return draft


def _without_one(draft: Draft, tried: list[int], R: Array, parts: Parts, weight: Array) -> Draft | None:
    """The draft without the first of the coefficients tried that leaves a predictor which does not run away."""
    worst = _WORSE * evaluated(draft.tables, draft.theta, parts, weight, free=False).cost
    for k in tried:
        fewer = draft.without([k], _readjusted(R, draft.theta, k))
        if evaluated(fewer.tables, fewer.theta, parts, weight, free=False).cost < worst:
            return fewer
    return None


def pruned_by_simulation(draft: Draft, parts: Parts, weight: Array, criterion: str, tick: Tick | None) -> Draft:
    """Leave out terms as long as the information criterion of the simulation errors falls.

    `weight`: (n_outputs,).
    """
    n = _samples(draft, parts)
    m = max(draft.n_candidates, draft.theta.size)

    def value(d: Draft) -> float:
        cost = evaluated(d.tables, d.theta, parts, weight, free=True).cost
        return information(criterion, cost / n, d.theta.size, n, m) if np.isfinite(cost) else np.inf

    now, before = value(draft), draft.theta.size
    while draft.theta.size > len(draft.numerators):
        if tick is not None:
            tick("simulation-error pruning", guessed(before - draft.theta.size, _USUAL))
        R = triangle(draft.tables, draft.theta, parts, weight, free=False)
        if not np.all(np.isfinite(R)):
            return draft
        may = [k for k in np.flatnonzero(_may_go(draft)) if not _noisy(draft)[k]]
        trials = [draft.without([int(k)], _readjusted(R, draft.theta, int(k))) for k in may]
        values = [value(d) for d in trials]
        if not values or not min(values) < now:
            return draft
        best = int(np.argmin(values))
        draft, now = trials[best], values[best]
    return draft


def _samples(draft: Draft, parts: Parts) -> int:
    lag = draft.tables.lag
    return max(sum(max(int(y.shape[0]) - lag, 0) for y, _ in parts), 2)


def _losses(R: Array, theta: Array) -> tuple[Array, Array]:
    """How much the sum of squares grows without each coefficient, and the inverse triangle."""
    scale = np.maximum(np.linalg.norm(R[:, :-1], axis=0), 1e-150)
    inverse = np.linalg.pinv(R[: theta.size, :-1] / scale, rcond=1e-13) / scale[:, None]
    variance = np.sum(inverse**2, axis=1)
    return theta**2 / np.maximum(variance, 1e-300), inverse


def _readjusted(R: Array, theta: Array, k: int) -> Array:
    """The other coefficients once coefficient k is zero."""
    _, inverse = _losses(R, theta)
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
