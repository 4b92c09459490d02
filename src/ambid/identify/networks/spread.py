"""Covariance of weights from the scores of a fit (slope of each sample's error times the error), where errors are not
taken as white: the sandwich in closed form, and a bootstrap in blocks of time.

Both keep the correlation of the scores over about sqrt(n) samples (Kuensch 1989; Newey and West 1987). The inputs are
what was measured and are never made anew, so that a controller's reaction to the noise stays in: no residual bootstrap
that holds the inputs fixed would be right under feedback.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ambid.identify.networks.search import information_inverse, triangle_of
from ambid.identify.nonlinear.progress import Tick

Array = NDArray[np.float64]

REPEATS = 200
_MANY = 20  # records from which on whole records are drawn
_FEWEST = 8  # blocks of a record


def block_length(n: int) -> int:
    """Return the samples over which scores are taken to hang together.

    Parameters
    ----------
    n : int
        Of a record.

    Returns
    -------
    int
    """
    length: int = max(min(round(float(n) ** 0.5), n // _FEWEST), 1)
    return length


def score_covariance(scores: Sequence[Array], part: float = 0.0) -> Array:
    """Return the covariance of the sum of all scores, from overlapping blocks around the circle of each record.

    Parameters
    ----------
    scores : sequence of ndarray, shape (n_samples, n_theta)
        Of each record.
    part : float, optional
        Of a record that a block has at least: long blocks where scores hang together for long.

    Returns
    -------
    ndarray, shape (n_theta, n_theta)
    """
    if len(scores) >= _MANY:
        sums = np.stack([s.sum(axis=0) for s in scores])
        left = sums - sums.mean(axis=0)
        whole: Array = left.T @ left * (len(scores) / (len(scores) - 1.0))
        return whole
    out = np.zeros((scores[0].shape[1],) * 2)
    for s in scores:
        n = s.shape[0]
        length = max(block_length(n), round(part * n))
        around = np.concatenate([s, s[: length - 1]]) - s.mean(axis=0)
        total = np.cumsum(np.concatenate([np.zeros((1, s.shape[1])), around]), axis=0)
        sums = total[length:] - total[:-length]
        out += sums.T @ sums / length
    return out


def sandwich(R: Array, scores: Sequence[Array], prior: Array | None = None) -> tuple[Array | None, float]:
    """Return the covariance of the estimate, inverse information times score covariance times inverse information.

    Parameters
    ----------
    R : ndarray, shape (n_rows, n_theta)
        Triangle of the slopes, priors included.
    scores : sequence of ndarray, shape (n_samples, n_theta)
        Of each record, without those of priors.
    prior : ndarray, shape (n_theta, n_theta), optional
        Information of the priors, which counts as that much data.

    Returns
    -------
    covariance : ndarray, shape (n_theta, n_theta), or None
        None where a direction is not seen.
    condition : float
    """
    P, condition = information_inverse(R)
    if P is None:
        return None, condition
    middle = score_covariance(scores)
    n = sum(s.shape[0] for s in scores)
    middle *= n / max(n - R.shape[1], 1.0)
    if prior is not None:
        middle += prior
    out: Array = P @ middle @ P
    return (out + out.T) / 2.0, condition


def bootstrapped(
    rows: Sequence[Array], priors: Array, seed: int, tick: Tick | None = None, *, repeats: int = REPEATS
) -> Array:
    """Return the covariance of weights after a Gauss-Newton step on blocks of time drawn with replacement.

    One step from the optimum stays where the network is linear in its weights: whole trainings end in weights that
    differ while the function does not, and their covariance says nothing of the function. The first block of a record
    is always there: it alone shows the first state. Whole records are drawn where there are 20 or more.

    Parameters
    ----------
    rows : sequence of ndarray, shape (n_samples, n_outputs, n_theta + 1)
        Slopes and errors of each record, of unit variance.
    priors : ndarray, shape (n_priors, n_theta + 1)
        Rows that stay as they are.
    seed : int
    tick : callable, optional
    repeats : int, optional

    Returns
    -------
    ndarray, shape (n_theta, n_theta)
    """
    whole = len(rows) >= _MANY
    blocks = [_triangles(r, r.shape[0] if whole else block_length(r.shape[0])) for r in rows]
    rng = np.random.default_rng([seed, 1])
    found = []
    for k in range(repeats):
        if tick is not None:
            tick("bootstrap", k / repeats)
        if whole:
            drawn = [blocks[j][0] for j in rng.integers(0, len(blocks), size=len(blocks))]
        else:
            drawn = []
            for own in blocks:
                times = np.bincount(rng.integers(1, len(own), size=len(own) - 1), minlength=len(own))
                times[0] = 1
                drawn += [np.sqrt(t) * b for t, b in zip(times, own, strict=True) if t]
        R = triangle_of([np.concatenate([*drawn, priors])])
        scale = np.maximum(np.linalg.norm(R[:, :-1], axis=0), 1e-150)
        found.append(np.linalg.lstsq(R[:, :-1] / scale, R[:, -1], rcond=1e-10)[0] / scale)
    return np.atleast_2d(np.cov(np.array(found), rowvar=False))


def _triangles(rows: Array, length: int) -> list[Array]:
    """Each block of time reduced to a triangle; the last one takes what is left over."""
    n, width = rows.shape[0], rows.shape[2]
    edges = [*range(0, n - length + 1, length), n]
    if len(edges) > 2 and edges[-2] + length > n:
        edges.pop(-2)
    if len(edges) < 3 and length < n:
        edges = [0, n // 2, n]
    return [triangle_of([rows[a:b].reshape(-1, width)]) for a, b in pairwise(edges)]
