"""Linear least squares by QR and singular values of scaled columns, with one tolerance for what the data do not see."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex

BLIND = 1e-11  # singular values of the scaled matrix below this part of the largest are directions nobody sees
_ROUNDING = 1e-15  # least singular value, over the largest, that a variance is taken from
_TINY = 1e-150  # length of a column from which it is divided by
_NOTHING = 1e-100  # length that an empty column counts as having where a variance is taken from it
_BLOCK = 4096  # rows that are reduced at once: they stay in the cache


@dataclass(frozen=True, slots=True, eq=False)
class Directions:
    """Singular directions of A with its columns scaled to unit length: A = U diag(s) Vt diag(size)."""

    U: Array  # (n_rows, rank)
    s: Array  # (rank,), largest first
    Vt: Array  # (rank, n_columns)
    size: Array  # (n_columns,), lengths of the columns; 1 for a column of zeros
    empty: NDArray[np.bool_]  # (n_columns,), which columns hold nothing but zeros

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which directions the data see."""
        return np.asarray(self.s > BLIND * max(self.s[0] if self.s.size else 0.0, 1e-300))

    @property
    def condition(self) -> float:
        """Condition number of the scaled matrix."""
        return float(self.s[0] / max(self.s[-1], 1e-300)) if self.s.size else 1.0

    def solve(self, b: Array, damping: float = 0.0) -> Array:
        """Return x of the smallest |A x - b|² + damping |size x|², zero along directions that nobody sees."""
        gain = np.where(self.seen, self.s / (self.s**2 + damping), 0.0) if damping else self._inverse_values()
        return np.asarray(((self.Vt.T * gain) @ (self.U.T @ b)).T / self.size).T

    def explain(self, b: Array) -> float:
        """Return the squared length of b inside the columns' space: by how much a full step lowers |A x - b|²."""
        along = self.U[:, self.seen].T @ b
        return float(np.sum(along**2))

    def root(self, least: float = _ROUNDING) -> Array:
        """Return H with H Hᵀ = (AᵀA)⁻¹, huge but finite along a direction without information: of a singular value
        under `least` of the largest.
        """
        s = np.maximum(self.s, max(least * (self.s[0] if self.s.size else 1.0), 1e-300))
        size = np.where(self.empty, _NOTHING, self.size)
        return np.asarray(self.Vt.T / s / size[:, None])

    def inverse(self, least: float = _ROUNDING) -> Array:
        """Return (AᵀA)⁻¹, see `root`."""
        half = self.root(least)
        return np.asarray(half @ half.T)

    def _inverse_values(self) -> Array:
        visible = self.seen
        return np.where(visible, 1.0 / np.where(visible, self.s, 1.0), 0.0)


def directions(A: Array) -> Directions:
    """Return the singular directions of a matrix with its columns scaled to unit length."""
    size = column_sizes(A)
    U, s, Vt = np.linalg.svd(A / size, full_matrices=False)
    return Directions(U, s, Vt, size, np.linalg.norm(A, axis=0) <= _TINY)


def column_sizes(A: Array) -> Array:
    """Return the lengths of the columns, 1 where there is nothing to scale."""
    size = np.linalg.norm(A, axis=0)
    return np.asarray(np.where(size > _TINY, size, 1.0))


def least_squares(A: Array, b: Array) -> Array:
    """Solve A x = b in least squares, the smallest scaled x where the data do not tell; tall matrices by QR first."""
    n, right = A.shape[1], b.reshape(b.shape[0], -1)
    if A.shape[0] > n + right.shape[1]:
        R = triangle_of([np.hstack([A, right])])
        A, right = R[:, :n], R[:, n:]
    x = directions(A).solve(right)
    return x if b.ndim > 1 else x[:, 0]


def triangle_of(rows: Sequence[Array]) -> Array:
    """Return the triangle (at most n_columns, n_columns) of stacked rows (n_rows, n_columns)."""
    small = [
        part if part.shape[0] <= part.shape[1] else np.asarray(np.linalg.qr(part, mode="r"))
        for block in rows
        for part in (block[k : k + _BLOCK] for k in range(0, block.shape[0], _BLOCK))
    ]
    return small[0] if len(small) == 1 else np.asarray(np.linalg.qr(np.concatenate(small), mode="r"))


def information_inverse(R: Array) -> tuple[Array | None, float]:
    """Return (RᵀR)⁻¹, None where a direction is not seen, and the condition number of the scaled R (n_rows, n), a
    triangle without its last column.
    """
    if R.shape[0] < R.shape[1] or not np.all(np.isfinite(R)) or not np.all(np.linalg.norm(R, axis=0) > _TINY):
        return None, np.inf
    axes = directions(R)
    if axes.condition > 1.0 / BLIND:
        return None, axes.condition
    inverse = axes.inverse()
    return (inverse + inverse.T) / 2.0, axes.condition


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep the linear algebra library to one thread inside a ``with`` block."""
    libraries = _controller("scipy.linalg" in sys.modules)
    if all(x.num_threads == 1 for x in libraries.lib_controllers if x.user_api == "blas"):
        yield  # so already, from the environment or a caller: setting it would take longer than a small fit's algebra
        return
    with libraries.limit(limits=1, user_api="blas"):
        yield


@cache
def _controller(_with_scipy: bool) -> Any:
    """Controller of the linear algebra libraries that are loaded: SciPy brings one of its own."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def periods_near(signal: Array | Complex, k: int) -> float:
    """Return at how many periods over a signal, within one of `k`, its windowed transform is largest."""
    n = signal.size
    turn = 2j * np.pi / n * np.arange(n)
    rest = signal * np.hanning(n) * np.exp(-k * turn)
    length = max(1, n // 256)  # over which a fraction of a period hardly turns
    short = np.add.reduceat(rest, np.arange(0, n, length))
    beside = np.linspace(-0.75, 0.75, 61)
    power = np.abs(np.exp(-np.outer(beside, turn[::length])) @ short)
    j = min(max(int(np.argmax(power)), 1), 59)
    a, b, c = power[j - 1 : j + 2].tolist()
    bend = a - 2.0 * b + c
    return k + float(beside[j] + (beside[1] - beside[0]) * (np.clip(0.5 * (a - c) / bend, -1.0, 1.0) if bend else 0.0))


def waves_at(periods: float, n: int) -> Array:
    """Return cosine and sine of some periods over n samples, and both times a drift from -1 to 1, (n, 4)."""
    turn = 2.0 * np.pi * periods / n * np.arange(n)
    waves = np.column_stack([np.cos(turn), np.sin(turn)])
    return np.hstack([waves, np.linspace(-1.0, 1.0, n)[:, None] * waves])


def without(signals: Array, waves: Array) -> Array:
    """Return signals (n, n_signals) without what waves (n, n_waves) explain of them."""
    return np.asarray(signals - waves @ np.linalg.lstsq(waves, signals, rcond=None)[0])
