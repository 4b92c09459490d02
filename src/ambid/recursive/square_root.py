"""Covariances in U-D factors, as `ambid.recursive.square_root_kernels` carries them, to and from matrices."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array

_FLOOR = 1e-14  # smallest eigenvalue of a correlation matrix that is more than rounding


def factors_of(P: Array) -> Array:
    """Return the factors F (n, n) of a covariance: column j of U before the diagonal of row j, D_j on it.

    Where rounding has left the matrix without a Cholesky factor, its smallest eigenvalues are raised to rounding.
    """
    sd = np.sqrt(np.diag(P))
    unit = P / np.outer(sd, sd)
    try:
        root = np.linalg.cholesky(unit[::-1, ::-1])[::-1, ::-1]
    except np.linalg.LinAlgError:
        half = root_of((unit + unit.T) / 2, floor=_FLOOR)
        root = np.asarray(np.linalg.qr(half.T[:, ::-1], mode="r")).T[::-1, ::-1]
    diagonal = np.diag(root)
    F = np.ascontiguousarray((sd[:, None] * root / (diagonal * sd)).T)
    np.fill_diagonal(F, (sd * diagonal) ** 2)
    return F


def covariance_of(F: Array) -> Array:
    """Return the covariance U D Uᵀ, symmetric to the last bit."""
    half = root_of_factors(F).T
    return np.asarray(half.T @ half)


def root_of_factors(F: Array) -> Array:
    """Return the triangular root U √D."""
    below, unit = _unit_triangle(F.shape[0])
    return np.asarray((np.where(below, F, unit) * np.sqrt(F.diagonal())[:, None]).T)


@cache
def _unit_triangle(n: int) -> tuple[NDArray[np.bool_], Array]:
    return np.tri(n, k=-1, dtype=np.bool_), np.eye(n)


def root_of(P: Array, floor: float = 0.0) -> Array:
    """Return a square root of a semidefinite matrix; eigenvalues under `floor` times the largest are raised to it."""
    values, vectors = np.linalg.eigh(P)
    return np.ascontiguousarray(vectors * np.sqrt(np.maximum(values, floor * max(values[-1], 0.0))))
