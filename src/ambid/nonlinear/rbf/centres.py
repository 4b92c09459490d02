"""Where units stand and how wide they are: k-means, or orthogonal least squares among the data; nearest neighbours.

Orthogonal least squares (Chen, Cowan, Grant 1991) takes, again and again, that candidate which explains most of what
is left of the outputs. It is done here by Gram-Schmidt on the candidates themselves, for all outputs at once: units
that overlap are nearly dependent, and their Gram matrix has too few digits to tell them apart.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.estimation.linear import triangle_of

_DEPENDENT = 1e-10  # squared length left of a candidate that the chosen ones hold already
_LLOYD = 50  # iterations at most
_BLOCK = 2048


def typical_size(x: Array) -> float:
    """Return the root mean square distance from the middle of the data.

    `x`: (n, n_seen).
    """
    found = float(np.sqrt(np.sum(np.var(x, axis=0))))
    return found if found > 0 else 1.0


def k_means(x: Array, k: int, rng: np.random.Generator) -> Array:
    """Return centres with the least sum of squared distances that Lloyd's iterations find from k-means++.

    `x`: (n, n_seen); `k`: fewer come back where there are fewer different points; `rng`: of the start (Arthur and
    Vassilvitskii 2007). Returns (at most k, n_seen).
    """
    C = _plus_plus(x, k, rng)
    label = np.full(x.shape[0], -1)
    for _ in range(_LLOYD):
        new = _nearest(x, C)
        if np.array_equal(new, label):
            break
        label = new
        counts = np.bincount(label, minlength=C.shape[0])
        sums = np.stack([np.bincount(label, weights=column, minlength=C.shape[0]) for column in x.T], axis=1)
        C = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], C)
    return C


def _plus_plus(x: Array, k: int, rng: np.random.Generator) -> Array:
    chosen = [int(rng.integers(x.shape[0]))]
    away = np.sum((x - x[chosen[0]]) ** 2, axis=1)
    while len(chosen) < k and np.any(away > 0):
        chosen.append(int(rng.choice(x.shape[0], p=away / away.sum())))
        away = np.minimum(away, np.sum((x - x[chosen[-1]]) ** 2, axis=1))
    return x[chosen]


def _nearest(x: Array, C: Array) -> NDArray[np.int64]:
    out = np.empty(x.shape[0], dtype=np.int64)
    for first in range(0, x.shape[0], _BLOCK):
        part = x[first : first + _BLOCK]
        q = np.zeros((part.shape[0], C.shape[0]))
        for j in range(x.shape[1]):
            q += (part[:, j, None] - C[:, j]) ** 2
        out[first : first + _BLOCK] = np.argmin(q, axis=1)
    return out


def ols_order(candidates: Array, known: Array, y: Array, most: int) -> tuple[NDArray[np.int64], Array]:
    """Choose regressors by orthogonal least squares, beside some that are in the model in any case.

    `candidates`: (n, n_candidates); `known`: (n, n_known), always there: the linear part and the constant; `y`: (n,
    n_outputs), what has to be explained; outputs count alike if their variances are; `most`: regressors at most.
    Returns `order`: (at most `most`,), in the order of choice; `err`: error reduction ratio: part of what the known
    regressors leave of the outputs' energy.
    """
    free = y.shape[0] - known.shape[1] - 1
    m, d = candidates.shape[1], known.shape[1]
    R = triangle_of([np.hstack([known, candidates, y])])  # the same lengths and angles in fewer rows
    P, rest = R[:, d : d + m].copy(), R[:, d + m :].copy()
    U, s, _ = np.linalg.svd(R[:, :d], full_matrices=False)
    U = U[:, s > 1e-12 * max(float(s[0]), 1e-300)]
    length = np.sum(P**2, axis=0)
    for _ in range(2):  # twice is enough
        P -= U @ (U.T @ P)
        rest -= U @ (U.T @ rest)
    energy = max(float(np.sum(rest**2)), 1e-300)
    order: list[int] = []
    err: list[float] = []
    alive = np.ones(P.shape[1], dtype=bool)
    while len(order) < min(most, free):
        left = np.sum(P**2, axis=0)
        alive &= left > _DEPENDENT * length
        if not np.any(alive):
            break
        gain = np.where(alive, np.sum((P.T @ rest) ** 2, axis=1) / np.where(alive, left, 1.0), -1.0)
        pick = int(np.argmax(gain))
        w = P[:, pick] / np.sqrt(left[pick])
        P -= np.outer(w, w @ P)
        rest -= np.outer(w, w @ rest)
        alive[pick] = False
        order.append(pick)
        err.append(float(gain[pick]) / energy)
    return np.array(order, dtype=np.int64), np.array(err)


def neighbour_widths(C: Array, among: int, otherwise: float) -> Array:
    """Return the root mean square distance of each centre to its nearest ones (Moody and Darken 1989).

    `C`: (neurons, n_seen); `among`: how many neighbours; `otherwise`: where there is one centre alone. Returns
    (neurons,).
    """
    if C.shape[0] < 2:
        return np.full(C.shape[0], otherwise)
    squares = np.sum((C[:, None, :] - C) ** 2, axis=2)
    near = np.sort(squares, axis=1)[:, 1 : 1 + among]
    found = np.sqrt(np.mean(near, axis=1))
    return np.where(found > 1e-6 * otherwise, found, otherwise)
