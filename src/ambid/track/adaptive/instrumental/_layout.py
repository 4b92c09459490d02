"""Where the numbers of recursive instrumental variables lie in their one array.

[head | estimate p | R m (m + p + 1) | T p p | long-run covariance m m | ring lags m | its sum m | prior p | size
of the instruments m | work]. R is the upper part of the triangle of the weighted rows [ζᵀ φᵀ y]; T is that of its columns
of φ.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

(
    SIZE,  # p
    INSTRUMENTS,  # m
    USED,
    REJECTED,
    SINGULAR,
    FACTOR,
    FACTOR_NOW,
    EVERY,
    LIMIT,
    MEMORY,
    RATE,  # of forgetting of the noise
    NOISE_SUM,
    NOISE_WEIGHT,
    LAGS,
    SUM_OF_SQUARES,  # of the weights of the samples
    PRIOR_LEFT,  # squared weight that the prior still has
) = range(16)
HEAD = 20


def allocate(p: int, m: int, lags: int) -> Array:
    """Return an array of zeros with its sizes entered.

    Parameters
    ----------
    p, m : int
        Coefficients and instruments.
    lags : int

    Returns
    -------
    ndarray, shape (n,)
    """
    s = np.zeros(HEAD + first_work(p, m, lags) + m * (p + 1) + m + 3 * p + 1)
    s[SIZE], s[INSTRUMENTS], s[LAGS] = p, m, lags
    return s


def first_work(p: int, m: int, lags: int) -> int:
    """Return how many numbers lie between the head and the work space.

    Parameters
    ----------
    p, m, lags : int

    Returns
    -------
    int
    """
    return p + m * (m + p + 1) + p * p + m * m + lags * m + m + p + m
