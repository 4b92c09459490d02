"""Terms chosen by what they do for the free run (Piroddi and Spinelli 2003, simulation error minimisation).

At each step those candidates that orthogonal least squares finds most promising are tried; that one is taken with
which the model, its coefficients by least squares, simulates best. After each step terms that have become useless
are taken out again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ambid.errors import EstimationError
from ambid.identify.narmax.candidates import Candidates, candidates
from ambid.identify.narmax.choose import Draft, least_squares
from ambid.identify.narmax.recursion import tables
from ambid.identify.narmax.search import evaluated
from ambid.identify.narmax.selection import information, select_terms
from ambid.identify.narmax.settings import NarmaxSettings
from ambid.identify.narmax.terms import Term, lagged, products

Array = NDArray[np.float64]
Parts = Sequence[tuple[Array, Array]]
Tick = Callable[[str], object]

_TRIED = 40  # candidates at each step
_MOST_STEPS = 200


def terms_by_simulation(s: NarmaxSettings, parts: Parts, tick: Tick | None) -> Draft:
    """Choose process terms by the error of the free run.

    Parameters
    ----------
    s : NarmaxSettings
    parts : sequence of (outputs, inputs), scaled
    tick : callable or None

    Returns
    -------
    Draft

    Raises
    ------
    EstimationError
        With several outputs.
    """
    if parts[0][0].shape[1] > 1:
        raise EstimationError("narmax: selection = simulation is for one output. Use frols, and pruning = simulation")
    n_u = parts[0][1].shape[1]
    terms = products(lagged(1, n_u, ny=s.ny, nu=s.nu, nk=s.nk, ne=0), s.degree, constant=bool(s.constant))
    found = candidates(terms, [p[0] for p in parts], [p[1] for p in parts], None, s.lag)
    y = np.concatenate([p[0][s.lag :, 0] for p in parts])
    n, m = y.size, len(terms)
    most = min(s.terms, max(n // 5, 1), m)

    def tried(picks: tuple[int, ...]) -> tuple[float, Array]:
        """Information criterion of the free run, and the coefficients."""
        theta = least_squares(found.columns(picks), y)
        t = tables((tuple(terms[k] for k in picks),), ((),), n_u)
        cost = evaluated(t, theta, parts, np.ones(1), free=True).cost / n
        return (information(s.criterion, cost, len(picks), n, m) if np.isfinite(cost) else np.inf), theta

    now: tuple[int, ...] = ()
    value, theta = float("inf"), np.empty(0)
    for _ in range(_MOST_STEPS):
        if tick is not None:
            tick("choice of terms by simulation")
        if len(now) >= most:
            break
        trials = [(*now, k) for k in _promising(found, y, now)]
        scored = [(tried(x)[0], x) for x in trials]
        best, picks = min(scored, default=(float("inf"), now))
        if not best < value:
            break
        value, now = best, picks
        while len(now) > 2:
            fewer = min((tried(x)[0], x) for x in (now[:k] + now[k + 1 :] for k in range(len(now))))
            if not fewer[0] < value:
                break
            value, now = fewer
    if not now:
        now = select_terms(found, y, most=most, criterion=s.criterion).chosen
    _, theta = tried(now)
    chosen: tuple[Term, ...] = tuple(terms[k] for k in now)
    return Draft(numerators=(chosen,), denominators=((),), theta=theta, n_inputs=n_u, n_candidates=m)


def _promising(found: Candidates, y: Array, now: tuple[int, ...]) -> list[int]:
    """Candidates with the largest error reduction ratios beside those chosen."""
    P = found.columns(range(len(found.terms)))
    Q = np.linalg.qr(P[:, now])[0] if now else np.empty((y.size, 0))
    rest, left = y - Q @ (Q.T @ y), P - Q @ (Q.T @ P)
    squared = np.sum(left**2, axis=0)
    live = squared > 1e-18 * np.sum(P**2, axis=0)
    live[list(now)] = False
    ratio = np.where(live, (left.T @ rest) ** 2 / np.where(live, squared, 1.0), -1.0)
    order = np.argsort(-ratio, kind="stable")[:_TRIED]
    return [int(k) for k in order if ratio[k] >= 0]
