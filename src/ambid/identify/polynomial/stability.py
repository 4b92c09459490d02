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
    if stable(p / radius ** np.arange(p.size)):
        return p
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


def roots_of(p: Array) -> NDArray[np.complex128]:
    """Return the roots in z; the formula serves for up to two, which are most.

    Parameters
    ----------
    p : ndarray, shape (n + 1,)
        The first is not 0.

    Returns
    -------
    ndarray, shape (n,), complex
    """
    if p.size == 1:
        return np.empty(0, dtype=np.complex128)
    if p.size == 2:
        return np.array([-p[1] / p[0]], dtype=np.complex128)
    if p.size == 3:
        half, product = -0.5 * float(p[1] / p[0]), float(p[2] / p[0])
        d = half * half - product
        if d < 0:
            return np.array([complex(half, (-d) ** 0.5), complex(half, -((-d) ** 0.5))])
        far = half + (d**0.5 if half >= 0 else -(d**0.5))
        return np.array([far, product / far if far else 0.0], dtype=np.complex128)
    return np.asarray(np.roots(p), dtype=np.complex128)


def solved(R: Array, right: Array) -> Array:
    """Solve R x = right for a triangle R; the shortest x where R leaves some of it open.

    Parameters
    ----------
    R : ndarray, shape (n, n)
        Upper triangular.
    right : ndarray, shape (n,) or (n, k)

    Returns
    -------
    ndarray, shape of `right`
    """
    if not R.size:
        return np.zeros(right.shape)
    scale = np.sqrt(np.einsum("ij,ij->j", R, R))
    scale[scale == 0.0] = 1.0
    S = R / scale
    diagonal = np.abs(S.diagonal())
    x = np.linalg.solve(S, right) if np.min(diagonal) > 1e-8 else np.linalg.lstsq(S, right, rcond=1e-10)[0]
    return np.asarray((x.T / scale).T)
