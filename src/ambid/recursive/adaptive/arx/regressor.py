"""The regressor of an ARX model from signals that come sample by sample or in blocks.

φ(t) = [-y(t-1) ... -y(t-na), u(t-nk) ... u(t-nk-nb+1), 1]: A(q) y = B(q) u + e + constant (Ljung 1999, eq. 4.7).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import EstimationError

_NO_MODEL = np.zeros(0)


class Regressor:
    """A tapped delay line.

    Past signals are unknown at first: rows that need them are NaN, as are those that need a sample that is not
    finite, and the row of such a sample itself. Recursive estimators reject them.

    `na`: past outputs; `nb`, `nk`: coefficients and delay of each input; a single delay is for all; `offset`: whether a
    column of ones stands at the end.

    `names`: ``a1``, ...; ``b1``, ..., numbered by their lag, ``b1.0`` for the first of several inputs; ``offset``.
    """

    def __init__(self, na: int, nb: int | Sequence[int], nk: int | Sequence[int] = 1, *, offset: bool = False) -> None:
        orders = [nb] if isinstance(nb, int) else list(nb)
        delays = [nk] * len(orders) if isinstance(nk, int) else list(nk)
        columns, names = columns_of(na, orders, delays, offset=offset)
        self.names: tuple[str, ...] = tuple(names)
        self.n_inputs = len(orders)
        self._lines = DelayLines(columns, 1 + self.n_inputs)

    def rows(self, u: ArrayLike, y: ArrayLike) -> Array:
        """Return the regressors of the next samples.

        `u`: (n_inputs,), or (n_samples, n_inputs) for a block, a number, or (n_samples,), where there is one input;
        `y`: (), or (n_samples,) for a block.
        """
        x, _, shape = signals(u, y, self.n_inputs)
        rows = self._lines.rows(x)
        return rows[0] if shape == () else rows

    def copy(self) -> Self:
        """Return an independent delay line in the same state."""
        return copy.deepcopy(self)


class DelayLines:
    """Columns of delayed channels, compiled.

    `columns`: channel -1 is the constant 1.
    """

    def __init__(self, columns: Sequence[tuple[int, int, int]], n_channels: int) -> None:
        self._table = np.array(columns, dtype=np.int64).reshape(-1, 3)
        self._past = np.full((max(1, int(self._table[:, 1].max())), n_channels), np.nan)
        self._prepare()

    def _prepare(self) -> None:
        from ambid.recursive.adaptive.arx._kernels import tapped

        self._run = tapped

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "_run"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._prepare()

    def rows(self, x: Array, theta: Array = _NO_MODEL, first: int = 0) -> Array:
        """Return the columns for the next samples.

        `x`: (n_samples, n_channels), its last channel is filled in where `theta` is given; `theta`: (p,), coefficients
        of a model without noise whose output is the last channel; `first`: column at which the regressor of that model
        begins. Returns (n_samples, n_columns).
        """
        rows = np.empty((x.shape[0], self._table.shape[0]))
        self._run(self._past, self._table, x, rows, theta, first)
        return rows

    def silence(self, channel: int) -> None:
        """Begin a channel with zeros instead of unknown numbers."""
        self._past[:, channel] = 0.0

    def scale(self, channel: int, factor: float) -> None:
        """Change the unit of what is remembered of a channel."""
        self._past[:, channel] *= factor


def columns_of(
    na: int, nb: Sequence[int], nk: Sequence[int], *, offset: bool, output: int = 0
) -> tuple[list[tuple[int, int, int]], list[str]]:
    """Return columns (channel, lag, sign) and their names; channel 0 is the output, then come the inputs.

    `output`: channel that stands for the output.
    """
    if na < 0 or len(nb) != len(nk) or any(n < 0 for n in (*nb, *nk)) or na + sum(nb) == 0:
        raise EstimationError(
            f"na={na}, nb={list(nb)}, nk={list(nk)}: give orders that are not negative, and not all 0"
        )
    columns, names = [(output, lag, -1) for lag in range(1, na + 1)], [f"a{lag}" for lag in range(1, na + 1)]
    for i, (order, delay) in enumerate(zip(nb, nk, strict=True), start=1):
        for lag in range(delay, delay + order):
            columns.append((i, lag, 1))
            names.append(f"b{lag}" if len(nb) == 1 else f"b{lag}.{i - 1}")
    if offset:
        columns.append((-1, 0, 1))
        names.append("offset")
    return columns, names


def signals(u: ArrayLike, y: ArrayLike, n_inputs: int, spare: int = 0) -> tuple[Array, Array, tuple[int, ...]]:
    """Return channels [y, u] and `spare` columns of zeros, the outputs and the shape of `y`.

    `u`: a number, or (n_samples,), where there is one input; `y`: (), (n_samples,) or (n_samples, 1). Returns `x`:
    (n_samples, 1 + n_inputs + spare); `outputs`: (n_samples,).
    """
    if isinstance(y, float) and isinstance(u, float) and n_inputs == 1 and spare == 0:  # one sample, quickly
        return np.array([[y, u]]), np.array([y]), ()
    inputs, outputs = np.asarray(u), np.asarray(y)
    if inputs.dtype.kind not in "fiub" or outputs.dtype.kind not in "fiub":
        raise EstimationError(f"input ({inputs.dtype}) and output ({outputs.dtype}) must be real numbers")
    shape, n, c = outputs.shape, outputs.size, n_inputs
    one = shape in ((), (1,)) and inputs.shape in (((c,), ()) if c == 1 else ((c,),))
    block = shape in ((n,), (n, 1)) and inputs.shape in (((n, 1), (n,)) if c == 1 else ((n, c),))
    if not (one or block):
        raise EstimationError(
            f"inputs of shape {inputs.shape} with outputs of shape {shape} do not fit {c} input(s). "
            f"Give ({c},) with a number, or (n, {c}) with (n,)"
        )
    x = np.zeros((n, 1 + c + spare))
    x[:, 0] = outputs.reshape(n)
    x[:, 1 : 1 + c] = inputs.reshape(n, c)
    return x, x[:, 0].copy(), shape
