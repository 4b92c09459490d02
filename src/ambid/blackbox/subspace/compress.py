"""A record compressed to small triangular factors, from which every subspace method starts.

Solves: min |H a - b| for every choice of columns of the window matrix H, whose row t is [1, z(t), ..., z(t+L-1)] with
z = [u, y]. H is never held: blocks of rows are folded into a running triangular factor (LAPACK tpqrt), one for each
group of time, so that groups can be left out afterwards. R'R = H'H holds to rounding, as normal equations would not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dtpqrt

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError

_BLOCK_ROWS = 2048  # rows of the window matrix at once: some hundred columns of it stay in the cache
_PANEL = 32  # columns that LAPACK eliminates together


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Channels:
    """Inputs and outputs with what they are centred and divided by before anything is factored."""

    u: Array  # (n_samples, n_inputs), SI, already shifted by known delays
    y: Array  # (n_samples, n_outputs), SI
    mean_u: Array  # (n_inputs,), SI, mean and standard deviation
    scale_u: Array
    mean_y: Array  # (n_outputs,), SI
    scale_y: Array

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return int(self.y.shape[0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Factors:
    """Triangular factors of the window matrix, one for each group of time, for scaled channels."""

    # (n_groups, n_columns, n_columns), upper triangular. Columns: constant, then z = [u, y] of each sample of the
    # window, oldest first.
    groups: Array
    length: int  # samples in a window
    n_rows: int  # windows in the record
    n_inputs: int
    n_outputs: int

    def columns(self, what: str, first: int, last: int) -> list[int]:
        """Return the columns of samples `first` to `last` (not included) of the window.

        Returns sample by sample, oldest first.
        """
        n_z = self.n_inputs + self.n_outputs
        inside = {"u": range(self.n_inputs), "y": range(self.n_inputs, n_z), "z": range(n_z)}[what]
        return [1 + k * n_z + j for k in range(first, last) for j in inside]

    def arranged(self, columns: Sequence[int]) -> Array:
        """Return the groups' factors for the constant followed by `columns`, in that order.

        Returns (n_groups, n_chosen, n_chosen).
        """
        chosen = self.groups[:, :, [0, *columns]]
        return np.stack([triangular(g) for g in chosen])


def channels(data: IOData, delay: Sequence[int]) -> Channels:
    """Shift the inputs by known delays and look at the size of every channel.

    `delay`: samples by which each input is shifted, shape (n_inputs,).
    """
    lost = max(delay, default=0)
    n = data.n_samples - lost
    if n < 1:
        raise EstimationError(f"a delay of {lost} samples leaves nothing of {data.n_samples}. Lower nk")
    shifted = [data.u[lost - d : lost - d + n, j] for j, d in enumerate(delay)]
    u = np.stack(shifted, axis=1) if lost else data.u
    y = data.y[lost:]
    for values, names, what in ((u, data.inputs, "input"), (y, data.outputs, "output")):
        for name, column in zip(names, values.T, strict=True):
            if not np.ptp(column) > 1e-12 * np.max(np.abs(column)):
                raise EstimationError(f"{what} {name!r} is constant; it shows no dynamics. Leave it out, or excite it")
    return Channels(u=u, y=y, mean_u=u.mean(0), scale_u=u.std(0), mean_y=y.mean(0), scale_y=y.std(0))


def compress(given: Channels, length: int, n_groups: int) -> Factors:
    """Fold all windows of a record into triangular factors.

    `length`: samples in a window; `n_groups`: groups of time.
    """
    mean = np.concatenate([given.mean_u, given.mean_y])
    scale = np.concatenate([given.scale_u, given.scale_y])
    n_z = mean.size
    n_rows = given.n_samples - length + 1
    n_columns = 1 + length * n_z
    edges = np.linspace(0, n_rows, n_groups + 1).astype(int)
    groups = np.zeros((n_groups, n_columns, n_columns))
    for g in range(n_groups):
        factor = np.zeros((n_columns, n_columns), order="F")
        for first in range(edges[g], edges[g + 1], _BLOCK_ROWS):
            last = min(first + _BLOCK_ROWS, int(edges[g + 1]))
            part = slice(first, last + length - 1)
            z = np.asfortranarray((np.hstack([given.u[part], given.y[part]]) - mean) / scale)
            block = np.empty((last - first, n_columns), order="F")
            block[:, 0] = 1.0
            for k in range(length):
                block[:, 1 + k * n_z : 1 + (k + 1) * n_z] = z[k : k + last - first]
            panel = min(_PANEL, n_columns)
            factor, _, _, _ = dtpqrt(0, panel, factor, block, overwrite_a=1, overwrite_b=1)
        groups[g] = np.triu(factor)
    return Factors(groups=groups, length=length, n_rows=n_rows, n_inputs=given.mean_u.size, n_outputs=given.mean_y.size)


def triangular(rows: Array) -> Array:
    """Return the square upper triangular factor of a matrix.

    `rows`: (n_rows, n_columns). Returns (n_columns, n_columns), padded with rows of zeros where there are fewer rows
    than columns.
    """
    factor = np.asarray(np.linalg.qr(rows, mode="r"))
    missing = rows.shape[1] - factor.shape[0]
    return np.vstack([factor, np.zeros((missing, rows.shape[1]))]) if missing > 0 else factor


def merged(groups: Array) -> Array:
    """Return the triangular factor of all groups together.

    `groups`: (n_groups, n_columns, n_columns). Returns (n_columns, n_columns).
    """
    total = np.array(groups[0])
    for g in groups[1:]:
        total = triangular(np.vstack([total, g]))
    return total


def each_left_out(groups: Array) -> list[Array]:
    """Return, for each group, the triangular factor of all others.

    `groups`: (n_groups, n_columns, n_columns). Returns (n_columns, n_columns).
    """
    n = groups.shape[0]
    after: list[Array | None] = [None] * n
    for g in range(n - 1, 0, -1):
        later = after[g]
        after[g - 1] = groups[g] if later is None else triangular(np.vstack([groups[g], later]))
    out, before = [], None
    for g in range(n):
        parts = [x for x in (before, after[g]) if x is not None]
        out.append(triangular(np.vstack(parts)))
        before = groups[g] if before is None else triangular(np.vstack([before, groups[g]]))
    return out
