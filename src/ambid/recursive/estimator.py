"""What every recursive estimator promises: the same numbers from single samples and blocks, and a way back; and float64
signals in C order, writable, and U-D factors (`square_root_kernels`) of covariances.
"""

from __future__ import annotations

from copy import deepcopy
from functools import cache
from importlib import import_module
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError

_FLOOR = 1e-14  # smallest eigenvalue of a correlation matrix that is more than rounding


class RecursiveEstimator(Protocol):
    """A stateful estimator that is fed samples as they come.

    Splitting a stream into calls of `update` differently does not change any number: work that is done once for
    several samples is done at fixed counts of samples, not at the ends of blocks. A sample that holds a number that is
    not finite is rejected: it changes no estimate, is counted, and an estimator with a memory of past signals starts
    that memory again. Memory does not grow with the number of samples.

    Attributes
    ----------
    names : tuple of str
        The estimated numbers.
    estimate : ndarray, shape (p,)
        A copy of their present values, in the units of the signals.
    covariance : ndarray, shape (p, p)
        A copy; symmetric, positive definite.
    n_used, n_rejected : int
        Samples that were used, and those that were not because they held a number that is not finite.
    """

    @property
    def names(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def estimate(self) -> Array: ...  # noqa: D102
    @property
    def covariance(self) -> Array: ...  # noqa: D102
    @property
    def n_used(self) -> int: ...  # noqa: D102
    @property
    def n_rejected(self) -> int: ...  # noqa: D102

    def update(self, inputs: ArrayLike, outputs: ArrayLike) -> Array:
        """Take in one sample or a block.

        Parameters
        ----------
        inputs : array_like, shape (n_inputs,), or (n_samples, n_inputs) for a block
            A number, or (n_samples,), where there is one input. A regression takes regressors.
        outputs : array_like, shape (n_outputs,), or (n_samples, n_outputs) for a block
            A number, or (n_samples,), where there is one output.

        Returns
        -------
        ndarray, shape of `outputs`
            Errors of prediction made before each sample was used; NaN where nothing was predicted.

        Raises
        ------
        EstimationError
            If the shapes do not fit.
        """
        ...

    def copy(self) -> Self:
        """Return an independent estimator in the same state: what a rollback returns to.

        Returns
        -------
        RecursiveEstimator
        """
        ...


class Copied:
    """What may be copied as it stands."""

    def copy(self) -> Self:
        """Return an independent one in the same state."""
        return deepcopy(self)


@cache
def kernels(name: str) -> Any:
    """Return a module of compiled loops of this room; the first one loads Numba. No estimator keeps it: they pickle."""
    return import_module(f"ambid.recursive.{name}_kernels")


def as_blocks(
    name: str, inputs: ArrayLike, outputs: ArrayLike, n_inputs: int, n_outputs: int = 1
) -> tuple[Array, Array, tuple[int, ...]]:
    """Return inputs (n, n_inputs) and outputs (n, n_outputs) of one sample or a block, and the shape of `outputs`."""
    u, y = np.asarray(inputs), np.asarray(outputs)
    if u.dtype.kind not in "fiub" or y.dtype.kind not in "fiub":
        raise EstimationError(f"{name}: inputs ({u.dtype}) and outputs ({y.dtype}) must be real numbers")
    n = y.shape[0] if y.ndim == 2 or (y.ndim == 1 and n_outputs == 1) else 1
    if not (_fits(y, n, n_outputs) and _fits(u, n, n_inputs)):
        raise EstimationError(
            f"{name}: inputs of shape {u.shape} and outputs of shape {y.shape}; a sample is ({n_inputs},) and "
            f"({n_outputs},), a block (n, {n_inputs}) and (n, {n_outputs}), where an axis of length 1 may be "
            "omitted. Reshape them"
        )
    return _rows(u, n, n_inputs), _rows(y, n, n_outputs), y.shape


def as_block(given: Array, channels: int) -> Array:
    """Return one sample or a block of `channels` signals as a block (n_samples, channels)."""
    n = given.shape[0] if given.ndim == 2 or (given.ndim == 1 and channels == 1) else 1
    if not _fits(given, n, channels):
        raise EstimationError(
            f"Kalman filter: input of shape {given.shape} for {channels} channels; it must be ({channels},) for a "
            f"sample or (n_samples, {channels}) for a block. Reshape it"
        )
    return _rows(given, n, channels)


def _fits(values: Array, n: int, width: int) -> bool:
    """Whether values are a block (n, width), or one that leaves out an axis of length one."""
    alone = values.shape == (width,) and n == 1
    return values.shape == (n, width) or alone or (width == 1 and values.shape in ((n,), () if n == 1 else (n,)))


def _rows(values: Array, n: int, width: int) -> Array:
    """Return values as (n, width): for arrays of another kind the recursions would be compiled again."""
    rows = values.reshape(n, width)
    if rows.dtype == np.float64 and rows.flags.carray:  # what follows takes as long as the use of one sample
        return rows
    return np.require(rows, np.float64, ["C", "W"])


def positive(name: str, value: float) -> float:
    """Return `value` where it is positive and finite."""
    if not (np.isfinite(value) and value > 0):
        raise EstimationError(f"{name} is {value!r}; it must be positive and finite")
    return float(value)


def numbers(name: str, value: ArrayLike, p: int) -> Array:
    """Return `value` as p finite numbers (p,), a single one for all."""
    found = np.asarray(value, dtype=np.float64)
    if found.shape not in ((), (p,)) or not np.isfinite(found).all():
        raise EstimationError(f"{name} must be a finite number or {p} of them, not {value!r}")
    return np.full(p, found) if found.ndim == 0 else found.copy()


def prior_of(value: ArrayLike, p: int) -> Array:
    """Return `value`, a prior variance, p variances or a matrix, as a positive definite matrix (p, p)."""
    found = np.asarray(value, dtype=np.float64)
    matrix = found if found.shape == (p, p) else np.diag(numbers("prior", found, p))
    sd = np.sqrt(np.diag(matrix)) if (np.diag(matrix) > 0).all() and np.isfinite(matrix).all() else np.zeros(p)
    if not sd.all() or not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0):
        raise EstimationError("prior must be symmetric with positive variances")
    if np.linalg.eigvalsh(matrix / np.outer(sd, sd))[0] < 1e-12:
        raise EstimationError("prior must be positive definite; a combination of its coefficients has no variance")
    return matrix


def forgetting_factor(factor: float | None, memory: float | None) -> float:
    """Return the factor of forgetting, or that of a time constant in samples; 1 where neither is given."""
    if factor is not None and memory is not None:
        raise EstimationError("factor and memory mean the same. Give one of them")
    if factor is not None and not 0 < factor < 1:
        raise EstimationError(f"factor is {factor!r}; it must lie between 0 and 1. Omit it to forget nothing")
    if memory is not None and not memory > 1:
        raise EstimationError(f"memory is {memory!r}; it must be longer than one sample")
    return 1.0 - 1.0 / memory if memory is not None else 1.0 if factor is None else float(factor)


def factors_of(P: Array) -> Array:
    """Return the factors F (n, n) of a covariance: column j of U before the diagonal of row j, D_j on it. Where
    rounding has left no Cholesky factor, the smallest eigenvalues are raised to rounding.
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
