"""Covariances in U-D factors, as `ambid.recursive.square_root_kernels` carries them, to and from matrices."""

from __future__ import annotations

import numpy as np

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
    half = root_of_factors(F)
    return np.asarray(half @ half.T)


def root_of_factors(F: Array) -> Array:
    """Return the triangular root U √D."""
    d = np.diag(F)
    U = np.tril(F, -1).T
    np.fill_diagonal(U, 1.0)
    return np.asarray(U * np.sqrt(d))


def root_of(P: Array, floor: float = 0.0) -> Array:
    """Return a square root of a semidefinite matrix; eigenvalues under `floor` times the largest are raised to it."""
    values, vectors = np.linalg.eigh(P)
    return np.asarray(vectors * np.sqrt(np.maximum(values, floor * max(values[-1], 0.0))))
