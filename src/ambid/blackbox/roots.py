"""Roots of polynomials in q^-1 (or s): whether they are stable, where they are, how they move with the coefficients."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array

Complex = NDArray[np.complex128]

_ROUNDING = 1e-13


def stable(p: Array) -> bool:
    """Return whether all roots in z are inside the unit circle, by more than rounding may move them out again.

    `p`: (n + 1,), coefficients of q^0, q^-1, ..., the first is 1.
    """
    c = [float(x) for x in p]
    while len(c) > 1:
        k = c[-1]
        if not abs(k) < 1.0 - _ROUNDING:
            return False
        rest = 1.0 - k * k
        c = [(a - k * b) / rest for a, b in zip(c[:-1], c[:0:-1], strict=True)]
    return True


def reflect(p: Array, radius: float = 0.98) -> Array:
    """Return the polynomial with roots outside the unit circle reflected, for a start alone.

    `p`: (n + 1,); `radius`: roots are drawn in to at most this. Returns (n + 1,).
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


def roots_of(p: Array) -> NDArray[np.complex128]:
    """Return the roots in z; the formula serves for up to two, which are most.

    `p`: (n + 1,), the first is not 0; none at all have no roots. Returns (n,), complex.
    """
    if p.size < 2:
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


def root_derivative(coefficients: Array, roots: Complex) -> Complex:
    """Return the derivative of polynomial roots by its coefficients.

    `coefficients`: (n + 1,), of z^n ... z^0; `roots`: (n_roots,). Returns (n_roots, n + 1), complex, from P(r) = 0:
    dr/dp_k = -r^(n-k) / P'(r). Infinite at a multiple root.
    """
    n = coefficients.size - 1
    if n < 1:
        return np.zeros((roots.size, n + 1), dtype=np.complex128)
    far = np.abs(roots) > 1.0  # there by powers of 1/r, numerator and slope both over r^(n-1), as r^n may overflow
    x = np.where(far, 1.0 / np.where(far, roots, 1.0), roots)
    falling = np.polynomial.polynomial.polyvander(x, n)  # 1, x ... x^n
    inside, outside = falling[:, ::-1], np.column_stack([np.where(far, roots, 1.0), falling[:, :-1]])
    slope_terms = np.arange(n, 0, -1) * coefficients[:-1]  # of z^(n-1) ... z^0
    slope = np.where(far, falling[:, :-1] @ slope_terms, falling[:, :-1] @ slope_terms[::-1])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(-np.where(far[:, None], outside, inside) / slope[:, None])


def used_part(theta: Array, place: slice) -> slice:
    """Return where a polynomial begins behind leading zeros: a delay has no roots.

    `theta`: (n_theta,); `place`: of the polynomial.
    """
    used = np.nonzero(theta[place])[0]
    return slice(place.start + int(used[0]) if used.size else place.stop, place.stop)


def roots_at(theta: Array, *places: slice) -> tuple[Complex, Complex]:
    """Return the roots of some of a model's polynomials, and their derivatives by all its coefficients.

    `theta`: (n_theta,); `places`: of the polynomials; leading zeros are a delay. Returns `roots`: (n_roots,), complex;
    `derivatives`: (n_roots, n_theta), complex.
    """
    found, rows = [np.empty(0, dtype=np.complex128)], [np.zeros((0, theta.size), dtype=np.complex128)]
    for place in places:
        used = used_part(theta, place)
        found.append(roots_of(theta[used]))
        rows.append(np.zeros((found[-1].size, theta.size), dtype=np.complex128))
        if found[-1].size:
            rows[-1][:, used] = root_derivative(theta[used], found[-1])
    return np.concatenate(found), np.vstack(rows)
