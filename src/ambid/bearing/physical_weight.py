"""Weights for the points of a response whose covariance has fewer ranks than there are points.

Solves: find w(f) >= 0, smooth, with J' diag(w) J = (J' S^+ J) for the spread S = J P J' of a black box: the signal to
noise ratio by frequency that would have given the black box its covariance. A pseudo-inverse of S as weight projects on
the tangent of the black box, so that curvature along what it hardly knows counts as a misfit of what it knows well, and
it takes rounding and the scatter of an estimated covariance for knowledge. A weight of full rank does neither, and
errors follow from S itself (the sandwich; Ljung 1999, sec. 9.7).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from ambid.arrays import Array

Indices = NDArray[np.intp]

_HATS = 14  # pieces of the weight in equal ratios, and as many in equal steps
_SMOOTH = 0.02  # pull of every piece to zero beside the match of the information


def point_weight(spread: Array, frequency: Indices, channel: Indices, omega: Array) -> Array:
    """Return the weight of every point.

    `spread`: (2 n_points, rank), half factor of the points' covariance, real parts first; full column rank;
    `frequency`: (n_points,), place of each point in `omega`; `channel`: (n_points,), which way from input to output it
    belongs to; `omega`: (n_frequencies,), rad/s, rising. Returns (n_points,), one over the unit of `spread` squared.
    """
    n, rank = spread.shape[0] // 2, spread.shape[1]
    places = [np.linspace(scale[0], scale[-1], _HATS) for scale in (np.log(omega), omega)]
    each = np.vstack(
        [
            [np.interp(scale, knots, one) for one in np.eye(_HATS)]
            for scale, knots in zip((np.log(omega), omega), places, strict=True)
        ]
    )
    hats = np.vstack([each[:, frequency] * (channel == c) for c in np.unique(channel)])
    hats = hats[np.any(hats > 0, axis=1)]
    i, j = np.triu_indices(rank)
    pair = np.where(i == j, 1.0, np.sqrt(2.0))
    points = (spread[:n, i] * spread[:n, j] + spread[n:, i] * spread[n:, j]) * pair
    given = (hats @ points).T
    size = np.linalg.norm(given, axis=0)
    wanted = np.concatenate([(i == j).astype(np.float64), np.zeros(size.size)])
    found = nnls(np.vstack([given / size, _SMOOTH * np.eye(size.size)]), wanted)[0]
    return np.asarray((found / size) @ hats)
