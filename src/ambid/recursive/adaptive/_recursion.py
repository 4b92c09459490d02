"""What all recursions of this package share: one array of state, checks of shapes, a cheap way for single samples."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import EstimationError

Kernel = Callable[[Array, Array, Array, Array], None]

_SMALLEST_VARIANCE = 1e-200  # exact data; a variance of 0 would not be positive definite
VAGUE = 1e22  # variance of a coefficient of which nothing is known, whatever its unit
ENOUGH = 0.5  # samples' worth of noise, before which its variance is not known
_FLOAT = np.dtype(np.float64)


class Recursion:
    """State and interface of a recursion; its kernel is the only thing that differs.

    `estimate`: (p,); `noise_variance`: tracked or given variance of e; the square of `noise_start` until one degree of
    freedom has shown it.
    """

    _kernel = "least_squares"

    def __init__(
        self,
        names: tuple[str, ...],
        width: int,
        size: int,
        start: ArrayLike | None,
        noise_sd: float | None,
        guess: float,
    ) -> None:
        p = len(names)
        self._names, self._shape = names, (width,)
        self._prepare()
        self._s = np.zeros(self._at.HEAD + size)
        self._s[self._at.SIZE] = p
        self._known_noise = None if noise_sd is None else positive("noise_sd", noise_sd) ** 2
        self._guess = positive("noise_start", guess) ** 2
        self._s[self._at.HEAD :][:p] = numbers("start", 0.0 if start is None else start, p)

    def _kernels(self) -> ModuleType:
        """Return the module of compiled loops, which also knows where the numbers lie."""
        from ambid.recursive.adaptive import _kernels

        return _kernels

    def _prepare(self) -> None:
        """Make what is not state: work space and the compiled kernel."""
        self._at: Any = self._kernels()
        self._run: Kernel = getattr(self._at, self._kernel)
        self._row, self._y, self._e = np.zeros((1, *self._shape)), np.zeros(1), np.zeros(1)
        self._error = self._e.reshape(())

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what `_prepare` makes."""
        made = {"_at", "_run", "_row", "_y", "_e", "_error"}
        return {key: value for key, value in self.__dict__.items() if key not in made}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._prepare()

    @property
    def names(self) -> tuple[str, ...]:
        """The coefficients."""
        return self._names

    @property
    def estimate(self) -> Array:
        """A copy, shape (p,)."""
        return self._s[self._at.HEAD :][: len(self._names)].copy()

    @property
    def n_used(self) -> int:
        """Samples that were used."""
        return int(self._s[self._at.USED])

    @property
    def n_rejected(self) -> int:
        """Samples that were not, for a number that is not finite or leads beyond 1e200."""
        return int(self._s[self._at.REJECTED])

    @property
    def noise_variance(self) -> float:
        """Variance of e, in squared units of the output."""
        if self._known_noise is not None:
            return self._known_noise
        if self._s[self._at.NOISE_WEIGHT] < ENOUGH:
            return self._guess
        return max(float(self._s[self._at.NOISE_SUM] / self._s[self._at.NOISE_WEIGHT]), _SMALLEST_VARIANCE)

    def update(self, phi: ArrayLike, y: ArrayLike) -> Array:
        """Take in one sample or a block.

        `phi`: (p,), or (n_samples, p) for a block, regressors; `y`: (), or (n_samples,) or (n_samples, 1) for a block.
        Returns y - φᵀθ with the θ from before each sample; NaN where the sample was rejected.
        """
        if isinstance(y, float) and type(phi) is np.ndarray and phi.shape == self._shape and phi.dtype is _FLOAT:
            self._row[0] = phi
            self._y[0] = y
            self._run(self._s, self._row, self._y, self._e)
            return self._error.copy()
        rows, values, shape = samples(phi, y, self._shape[0])
        out = np.empty(values.size)
        self._run(self._s, rows, values, out)
        return out.reshape(shape)

    def copy(self) -> Self:
        """Return an independent estimator in the same state."""
        return copy.deepcopy(self)


class Factored(Recursion):
    """A recursion with P in U-D factors, and a companion of it."""

    def __init__(
        self, names: Sequence[str] | int, start: ArrayLike | None, noise_sd: float | None, guess: float
    ) -> None:
        found = coefficient_names(names)
        p = len(found)
        super().__init__(found, p, 10 * p + 4 * p * p, start, noise_sd, guess)

    def _factors(self, which: int) -> tuple[Array, Array]:
        """Return D (p,) and V (p, p) of P (0), of its companion (1), or of both at the start (2, 3)."""
        p = len(self._names)
        first = self._at.HEAD + p + which * (p + p * p)
        return self._s[first : first + p], self._s[first + p : first + p + p * p].reshape(p, p)

    def _set_factors(self, which: int, matrix: Array) -> None:
        for place, value in zip(self._factors(which), factors(matrix), strict=True):
            place[...] = value


def samples(phi: ArrayLike, y: ArrayLike, p: int) -> tuple[Array, Array, tuple[int, ...]]:
    """Return regressors (n, p) and outputs (n,) as the kernels want them, and the shape of `y`.

    `y`: (), (1,), (n_samples,) or (n_samples, 1). Returns `rows`: (n_samples, p); `values`: (n_samples,).
    """
    rows, values = np.asarray(phi), np.asarray(y)
    if rows.dtype.kind not in "fiub" or values.dtype.kind not in "fiub":
        raise EstimationError(f"regressor ({rows.dtype}) and output ({values.dtype}) must be real numbers")
    shape = values.shape
    n = values.size
    one = shape in ((), (1,)) and rows.shape in (((p,), ()) if p == 1 else ((p,),))
    block = shape in ((n,), (n, 1)) and rows.shape in (((n, 1), (n,)) if p == 1 else ((n, p),))
    if not (one or block):
        raise EstimationError(
            f"regressors of shape {rows.shape} with outputs of shape {shape} do not fit {p} coefficients. "
            f"Give ({p},) with a number, or (n, {p}) with (n,)"
        )
    # a writable array in C order: for others the kernels would be compiled anew
    rows = np.require(rows.reshape(n, p), np.float64, ["C", "W"])
    return rows, np.require(values.reshape(n), np.float64, ["C", "W"]), shape


def coefficient_names(names: Sequence[str] | int) -> tuple[str, ...]:
    """Return the names of the coefficients, ``theta1``, ... where only their number is given."""
    found = tuple(f"theta{i + 1}" for i in range(names)) if isinstance(names, int) else tuple(names)
    if not found or len(set(found)) < len(found):
        raise EstimationError(f"names is {names!r}; give at least one coefficient, each name once")
    return found


def positive(name: str, value: float) -> float:
    """Return `value` where it is positive and finite.

    `name`: for the message.
    """
    if not (np.isfinite(value) and value > 0):
        raise EstimationError(f"{name} is {value!r}; it must be positive and finite")
    return float(value)


def count(name: str, value: int) -> int:
    """Return `value` where it is a whole number of samples, one or more.

    `name`: for the message.
    """
    if value != int(value) or value < 1:
        raise EstimationError(f"{name} is {value!r}; it must be a whole number of samples, 1 or more")
    return int(value)


def numbers(name: str, value: ArrayLike, p: int) -> Array:
    """Return `value` as p finite numbers, a single one for all.

    `name`: for the message. Returns (p,).
    """
    found = np.asarray(value, dtype=np.float64)
    if found.shape not in ((), (p,)) or not np.isfinite(found).all():
        raise EstimationError(f"{name} must be a finite number or {p} of them, not {value!r}")
    return np.full(p, found) if found.ndim == 0 else found.copy()


def covariance_of(name: str, value: ArrayLike, p: int) -> Array:
    """Return `value`, a variance, p variances or a matrix, as a positive definite matrix.

    `name`: for the message; `value`: (), (p,) or (p, p). Returns (p, p).
    """
    found = np.asarray(value, dtype=np.float64)
    matrix = found if found.shape == (p, p) else np.diag(numbers(name, found, p))
    sd = np.sqrt(np.diag(matrix)) if (np.diag(matrix) > 0).all() and np.isfinite(matrix).all() else np.zeros(p)
    if not sd.all() or not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0):
        raise EstimationError(f"{name} must be symmetric with positive variances")
    if np.linalg.eigvalsh(matrix / np.outer(sd, sd))[0] < 1e-12:
        raise EstimationError(f"{name} must be positive definite; a combination of its coefficients has no variance")
    return matrix


def forgetting_factor(factor: float | None, memory: float | None) -> float:
    """Return the factor of forgetting, 1 where neither is given.

    `factor`: 0 < factor < 1; `memory`: time constant, samples.
    """
    if factor is not None and memory is not None:
        raise EstimationError("factor and memory say the same thing. Give one of them")
    if factor is not None and not 0 < factor < 1:
        raise EstimationError(f"factor is {factor!r}; it must lie between 0 and 1. Leave it out to forget nothing")
    if memory is not None and not memory > 1:
        raise EstimationError(f"memory is {memory!r}; it must be longer than one sample")
    return 1.0 - 1.0 / memory if memory is not None else 1.0 if factor is None else float(factor)


def factors(covariance: Array) -> tuple[Array, Array]:
    """Factor a positive definite matrix.

    `covariance`: (p, p). Returns `D`: (p,); `V`: (p, p), unit lower triangle: the matrix is V^T diag(D) V.
    """
    scale = np.sqrt(np.diag(covariance))
    L = np.linalg.cholesky((covariance / np.outer(scale, scale))[::-1, ::-1])[::-1, ::-1]  # upper: P = L L^T
    L = L * scale[:, None]
    d = np.diag(L)
    return d**2, np.ascontiguousarray((L / d).T)


def product(D: Array, V: Array) -> Array:
    """Return V^T diag(D) V.

    `D`: (p,); `V`: (p, p). Returns (p, p), symmetric to the last bit.
    """
    half = np.sqrt(D)[:, None] * V
    return np.asarray(half.T @ half)
