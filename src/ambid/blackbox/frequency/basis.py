"""Polynomials that are orthogonal on weighted lines, by Arnoldi's recurrence, with real coefficients.

Powers of a variable are nearly parallel on a band of lines; these are not, at any order, and their recurrence gives the
powers back (Forsythe 1957; Rolain et al. 1995; Brubeck, Nakatsukasa and Trefethen 2021).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array

Complex = NDArray[np.complex128]


def orthogonal_polynomials(points: Complex, weight: Array, degree: int) -> tuple[Complex, Array]:
    """Return orthogonal polynomials on points and their coefficients.

    Orthonormal for Re sum_f weight_f^2 conj(a_f) b_f, which is the sum over the lines and their conjugates.

    `points`: (n_frequencies,), complex, of order one (s over a frequency of the band, or z); `weight`:
    (n_frequencies,), positive. Returns `values`: (n_frequencies, degree + 1), complex; `powers`: (degree + 1, degree +
    1), column k holds the coefficients of polynomial k, lowest power first.
    """
    n = points.size
    q = np.empty((n, degree + 1), dtype=np.complex128)
    powers = np.zeros((degree + 1, degree + 1))
    first = float(np.linalg.norm(weight))
    q[:, 0], powers[0, 0] = weight / first, 1.0 / first
    for k in range(degree):
        v, c = points * q[:, k], np.concatenate([[0.0], powers[:-1, k]])
        for _ in range(2):  # once more, against round-off
            h = np.real(q[:, : k + 1].conj().T @ v)
            v, c = v - q[:, : k + 1] @ h, c - powers[:, : k + 1] @ h
        size = max(float(np.linalg.norm(v)), 1e-300)
        q[:, k + 1], powers[:, k + 1] = v / size, c / size
    return q / weight[:, None], powers
