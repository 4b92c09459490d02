"""Where the numbers of a recursion lie in its one array: a call from Python costs by the number of arrays.

[head | estimate p | factors | factors at the start | walk p | prior variance p | work 3 p], factors being the diagonal
and the unit triangle of P, then those of its companion: D p, V p p, E p, W p p. A symmetric matrix is V^T diag(D) V,
V lower triangular with unit diagonal: row j of V is column j of the U of U D U^T, so that inner loops run along memory.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

(
    SIZE,  # p
    USED,
    REJECTED,
    KIND,
    FACTOR,  # of forgetting, as asked for
    FACTOR_NOW,  # the same, nearer to 1 where P is about to pass its limit
    EVERY,  # samples between two looks at the limit
    LIMIT,  # of the mean of P_ii over prior variance
    RESET_EVERY,  # samples; 0 for never
    MEMORY,  # of the estimate, samples
    NOISE_RATE,  # of forgetting of the noise variance
    NOISE_SUM,
    NOISE_WEIGHT,
    TYPICAL,  # a tenth of the usual φᵀPφ
    STEP,
    SMALL,
    LIMITED,  # samples whose step was limited
) = range(17)
HEAD = 20

LEAST_SQUARES, DIRECTIONAL, WALK, LMS, NLMS = range(5)


def allocate(p: int) -> Array:
    """Return the array of a recursion of `p` coefficients, zeros but for its size; shape (20 + 10 p + 4 p p,)."""
    s = np.zeros(HEAD + 10 * p + 4 * p * p)
    s[SIZE] = p
    return s


def factors(covariance: Array) -> tuple[Array, Array]:
    """Factor a positive definite matrix.

    Parameters
    ----------
    covariance : ndarray, shape (p, p)

    Returns
    -------
    D : ndarray, shape (p,)
    V : ndarray, shape (p, p)
        Unit lower triangle: the matrix is V^T diag(D) V.
    """
    scale = np.sqrt(np.diag(covariance))
    L = np.linalg.cholesky((covariance / np.outer(scale, scale))[::-1, ::-1])[::-1, ::-1]  # upper: P = L L^T
    L = L * scale[:, None]
    d = np.diag(L)
    return d**2, np.ascontiguousarray((L / d).T)


def product(D: Array, V: Array) -> Array:
    """Return V^T diag(D) V.

    Parameters
    ----------
    D : ndarray, shape (p,)
    V : ndarray, shape (p, p)

    Returns
    -------
    ndarray, shape (p, p)
        Symmetric to the last bit.
    """
    half = np.sqrt(D)[:, None] * V
    return np.asarray(half.T @ half)
