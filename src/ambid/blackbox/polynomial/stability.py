"""Stability of predictors, and triangles solved whether or not their columns depend on each other."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dtrtrs

from ambid.arrays import Array
from ambid.blackbox.polynomial.orders import Layout
from ambid.blackbox.roots import stable


def stable_predictor(layout: Layout, theta: Array) -> bool:
    """Return whether C and every F are stable.

    `theta`: (n_theta,).
    """
    places = layout.places
    return all(stable(theta[p]) for (letter, _), p in places.items() if letter in "CF")


def solved(R: Array, right: Array) -> Array:
    """Solve R x = right for a triangle R; the shortest x where R leaves some of it open.

    `R`: (n, n), upper triangular.
    """
    if not R.size:
        return np.zeros(right.shape)
    scale = np.sqrt(np.einsum("ij,ij->j", R, R))
    scale[scale == 0.0] = 1.0
    S = R / scale
    # back substitution by LAPACK itself: numpy's solve would factorise the triangle again
    x = dtrtrs(S, right)[0] if np.abs(S.diagonal()).min() > 1e-8 else np.linalg.lstsq(S, right, rcond=1e-10)[0]
    return np.asarray((x.T / scale).T)
