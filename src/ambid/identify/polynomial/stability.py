"""Stability of polynomials in q^-1, without their roots (Schur-Cohn; Jury 1962)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.identify.polynomial.orders import Layout

Array = NDArray[np.float64]


def stable(p: Array) -> bool:
    """Return whether all roots in z are inside the unit circle.

    Parameters
    ----------
    p : ndarray, shape (n + 1,)
        Coefficients of q^0, q^-1, ..., the first is 1.

    Returns
    -------
    bool
    """
    c = [float(x) for x in p]
    while len(c) > 1:
        k = c[-1]
        if not abs(k) < 1.0:
            return False
        rest = 1.0 - k * k
        c = [(a - k * b) / rest for a, b in zip(c[:-1], c[:0:-1], strict=True)]
    return True


def reflected(p: Array, radius: float = 0.98) -> Array:
    """Return the polynomial with roots outside the unit circle reflected, for a start alone.

    Parameters
    ----------
    p : ndarray, shape (n + 1,)
    radius : float, optional
        Roots are drawn in to at most this.

    Returns
    -------
    ndarray, shape (n + 1,)
    """
    if p.size < 2 or not np.all(np.isfinite(p)):
        return np.asarray(np.eye(1, p.size)[0])
    roots = np.roots(p)
    size = np.abs(roots)
    outside = size > 1.0
    roots[outside] /= size[outside] ** 2
    size = np.abs(roots)
    far = size > radius
    roots[far] *= radius / size[far]
    return np.asarray(np.real(np.poly(roots)))


def stable_predictor(layout: Layout, theta: Array) -> bool:
    """Return whether C and every F are stable.

    Parameters
    ----------
    layout : Layout
    theta : ndarray, shape (n_theta,)

    Returns
    -------
    bool
    """
    places = layout.places
    return all(stable(theta[p]) for (letter, _), p in places.items() if letter in "CF")


def largest_root(p: Array) -> float:
    """Return the largest magnitude of the roots in z.

    Parameters
    ----------
    p : ndarray, shape (n + 1,)

    Returns
    -------
    float
        0 for a constant.
    """
    used = np.trim_zeros(p, "b")
    return float(np.max(np.abs(np.roots(used)))) if used.size > 1 else 0.0
