"""Whether a change stands out of slow wander: generalised least squares with errors that are white and, in part, follow
an Ornstein-Uhlenbeck process, whose share and time constant the data choose with and without the change.
"""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array

_BLOCKS = 64  # into which longer histories are averaged
_TIMES = (2.0, 5.0, 12.0, 30.0, 80.0, 200.0)  # time constants, in usual times between two values
_SHARES = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)  # variances of the wander over that of a block
_PRIOR = 4.0  # values' worth of belief that the standard deviations said are right


def beyond_wander(t: Array, y: Array, w: Array, shape: Array) -> tuple[float, float]:
    """Return twice the logarithm of the ratio of likelihoods with a change of some `shape` and without, and by what the
    variance of its size exceeds that of weighted least squares, at least 1.

    `t`, `y`, `shape`: time, value and the change's course, each (n,); `w`: reciprocal variances.
    """
    first = np.unique(np.linspace(0, y.size, min(y.size, _BLOCKS) + 1).astype(int)[:-1])
    W = np.add.reduceat(w, first)
    at, mean, course = (np.add.reduceat(w * x, first) / W for x in (t, y, shape))
    usual = float(np.median(np.diff(t)[np.diff(t) > 0.0]))
    lag = np.abs(at[:, None] - at) / usual
    taus = np.array([tau for tau in _TIMES if tau <= y.size])
    K = np.exp(-lag / taus[:, None, None])
    wander = (np.array(_SHARES)[:, None, None, None] * K * float(np.mean(1.0 / W))).reshape(-1, *lag.shape)
    C = np.concatenate([np.zeros_like(K[:1]), wander]) + np.diag(1.0 / W)
    L = np.linalg.cholesky(C)
    U = np.linalg.solve(L, np.broadcast_to(np.column_stack([np.ones_like(at), course, mean]), (*C.shape[:2], 3)))
    G = np.swapaxes(U, 1, 2) @ U
    spread = 2.0 * np.log(np.diagonal(L, axis1=1, axis2=2)).sum(axis=1)
    own_level = G - G[:, :, :1] * G[:, :1, :] / G[:, :1, :1]  # with a level taken out
    level = own_level[:, 2, 2]
    changed = level - own_level[:, 1, 2] ** 2 / own_level[:, 1, 1]
    n = first.size + _PRIOR
    without, with_it = (n * np.log((_PRIOR + np.maximum(rss, 0.0)) / n) + spread for rss in (level, changed))
    best, curvature = float(with_it.min()), own_level[:, 1, 1]
    chance = np.exp(-0.5 * (with_it - best)) / np.sqrt(curvature)  # of each wander, the size being any
    chance *= np.concatenate(
        [[1.0], np.tile(np.sqrt(_TIMES[0] / taus), len(_SHARES))]
    )  # long ones are held less likely
    chance /= chance.sum()
    size = own_level[:, 1, 2] / curvature
    variance = chance @ ((_PRIOR + np.maximum(changed, 0.0)) / (n - 2.0) / curvature + (size - chance @ size) ** 2)
    plain = 1.0 / float(w @ (shape - np.average(shape, weights=w)) ** 2)
    return float(without.min()) - best, max(1.0, float(variance) / plain)
