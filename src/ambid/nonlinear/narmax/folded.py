"""A linear start where only the magnitude of the output is measured, such as the speed of a pulse counter.

The sign is not in the data, and a search from a wrong one ends in a wrong minimum. So linear models of order three (a
real pole, a pair, a delay) are laid on a grid, the gain of each fitted to the magnitude, and the best of them refined.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.signal import lfilter

from ambid.arrays import Array
from ambid.estimation.progress import Tick
from ambid.nonlinear.narmax.choose import Draft
from ambid.nonlinear.narmax.model import OUTPUTS
from ambid.nonlinear.narmax.search import search
from ambid.nonlinear.narmax.settings import NarmaxSettings
from ambid.nonlinear.narmax.terms import Factor, Term

Parts = Sequence[tuple[Array, Array]]

_REAL = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98)
_RADII = (0.6, 0.8, 0.9, 0.95, 0.98)
_ANGLES = np.linspace(0.1, 1.6, 16)  # rad per sample
_REFINED = 25


def linear_folded(s: NarmaxSettings, parts: Parts, tick: Tick | None) -> Draft:
    """Return the best linear model of the magnitude.

    `parts`: one of each. Returns fitted to the free run.
    """
    order = min(s.ny, 3)
    delays = range(max(s.nk, 1), s.nk + s.nu)
    outputs = [Factor("y", 0, k) for k in range(1, order + 1)]
    inputs = [Factor("u", 0, k) for k in delays]
    terms: tuple[Term, ...] = tuple((f,) for f in (*outputs, *inputs))
    one, best, least = np.ones(1), None, np.inf
    starts = _starts(order, delays, parts)
    for k, start in enumerate(starts):
        if tick is not None:
            tick("sign of the output", k / len(starts))
        draft = Draft(numerators=(terms,), denominators=((),), theta=start, n_inputs=1, folded=OUTPUTS.index(s.output))
        found = search(draft.tables, start, parts, one, free=True, most=30)
        if best is None or found.cost < least:
            best, least = draft.with_theta(found.theta), found.cost
    assert best is not None
    return best


def _starts(order: int, delays: range, parts: Parts) -> list[Array]:
    """The best of the grid, coefficients in the order of the terms."""
    scored: list[tuple[float, int, Array]] = []
    y = np.concatenate([p[0][:, 0] for p in parts])
    for A in _denominators(order):
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


def _denominators(order: int) -> list[Array]:
    if order == 0:
        return [np.ones(1)]
    if order == 1:
        return [np.array([1.0, -p]) for p in _REAL]
    pairs = [np.array([1.0, -2 * r * np.cos(w), r * r]) for r in _RADII for w in _ANGLES]
    pairs += [np.convolve([1.0, -p], [1.0, -q]) for p in _REAL for q in _REAL if q >= p]
    return pairs if order == 2 else [np.convolve(p, [1.0, -q]) for p in pairs for q in _REAL]
