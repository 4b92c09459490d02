"""Matrices of a plant whose parameters change: stretches of equal parameters, with exact discretisation.

Stretches lie on a grid of the record, not of the call, so that the numbers do not depend on how a record is cut up.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.physics.discretise import discretise
from ambid.physics.linear_model import LinearModel
from ambid.simulate.schedule import Schedule

Integers = NDArray[np.int64]

_DEGREE = 14  # at a norm of 0.5 the Taylor polynomial of the exponential is right to 3e-17
_NODE = 20  # cells from one exact discretisation to the next


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pieces:
    """What the loop needs for some samples: `edges` (n_pieces + 1,), and matrices and values for each piece."""

    edges: Integers
    A: Array
    B: Array
    B_late: Array
    E: Array
    gains: Array
    theta: Mapping[str, Array]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Part:
    middles: Array
    matrices: tuple[Array, Array, Array, Array]


class Tables:
    """Cuts a record into stretches, and gives their matrices."""

    def __init__(
        self,
        of: LinearModel,
        fixed: Mapping[str, float],
        parameters: Mapping[str, Schedule],
        gains: Mapping[str, Schedule],
        rate_hz: float,
        fraction: float,
        grid: int,
    ) -> None:
        self._of, self._fixed, self._rate, self._fraction, self._grid = of, dict(fixed), rate_hz, fraction, grid
        self._schedules = {**parameters, **{f"gain_{name}": s for name, s in gains.items()}}
        knots = [s.knots(rate_hz) for s in self._schedules.values()]
        inside = np.unique(np.concatenate([np.zeros(1), *knots]))
        self._corners = inside[inside >= 0.0].astype(np.int64)
        self._moving = [self._moves(j) for j in range(self._corners.size)]
        self._halvings = max(0, math.ceil(math.log2(max(self._norm(), 1e-9) / 0.5)))
        self._known: dict[tuple[float, ...], tuple[Array, Array, Array, Array]] = {}

    @property
    def corners(self) -> Integers:
        """Samples at which anything begins or ends to change, shape (n_corners,), the first of them 0."""
        return self._corners

    def _moves(self, j: int) -> bool:
        if j + 1 == self._corners.size:
            return False
        near = self._corners[j] + np.array([0.25, 0.75]) * (self._corners[j + 1] - self._corners[j])
        values = [s.at(near, self._rate) for s in self._schedules.values()]
        return any(v[0] != v[1] for v in values)

    def pieces(self, first: int, stop: int) -> Pieces:
        """Return the stretches of samples `first` to `stop`, counted from `first`."""
        edges: list[int] = [first]
        parts: list[_Part] = []
        j = int(np.searchsorted(self._corners, first, side="right")) - 1
        while edges[-1] < stop:
            begin = int(self._corners[j])
            end = int(self._corners[j + 1]) if j + 1 < self._corners.size else max(stop, begin + 1)
            if self._moving[j]:
                part, ends = self._drifting(begin, end, edges[-1], min(end, stop))
                edges.extend(ends)
            else:
                part = self._still(begin)
                edges.append(min(end, stop))
            parts.append(part)
            j += 1
        middles = np.concatenate([p.middles for p in parts])
        a, b, late, e = (
            np.ascontiguousarray(np.concatenate(m)) for m in zip(*(p.matrices for p in parts), strict=True)
        )
        theta = {name: s.at(middles, self._rate) for name, s in self._schedules.items()}
        one = np.ones(middles.size)
        gains = np.ascontiguousarray(np.column_stack([theta.get(f"gain_{o}", one) for o in self._of.outputs]))
        return Pieces(
            edges=np.array(edges, dtype=np.int64) - first, A=a, B=b, B_late=late, E=e, gains=gains, theta=theta
        )

    def _still(self, begin: int) -> _Part:
        """Return one stretch, with matrices to the last bit as `Standing.matrices` has them."""
        middle = np.array([begin + 0.5])
        (theta,) = self._parameters(middle)
        key = tuple(theta.values())
        if key not in self._known:
            d, _ = discretise(self._of.matrices(theta), 1.0 / self._rate, fraction=self._fraction)
            self._known[key] = (d.A[None], d.B[None, :, 0], d.B_late[None, :, 0], d.E[None])
        return _Part(middles=middle, matrices=self._known[key])

    def _drifting(self, begin: int, end: int, first: int, stop: int) -> tuple[_Part, list[int]]:
        """Return the cells of an interval in which something moves, and where each ends.

        Matrices are exact at nodes, every `_NODE` cells, and linear between them: right to second order in the change
        from node to node, where held ones are right to first order in the change over a cell.
        """
        cells = np.arange((first - begin) // self._grid, -((begin - stop) // self._grid))
        starts = begin + cells * self._grid
        ends = np.minimum(starts + self._grid, end)
        middles = np.asarray(0.5 * (starts + ends), dtype=np.float64)
        stride = _NODE * self._grid
        numbers = np.arange(cells[0] // _NODE, cells[-1] // _NODE + 2)
        nodes = np.minimum(begin + numbers * stride, end).astype(np.float64)
        at = cells // _NODE - numbers[0]
        weight = (middles - nodes[at]) / (nodes[at + 1] - nodes[at])
        exact = self._exact(self._parameters(nodes, before=nodes > begin))
        matrices = [m[at] + weight.reshape(-1, *[1] * (m.ndim - 1)) * (m[at + 1] - m[at]) for m in exact]
        part = _Part(middles=middles, matrices=(matrices[0], matrices[1], matrices[2], matrices[3]))
        return part, np.minimum(ends, stop).tolist()

    def _parameters(self, samples: Array, before: NDArray[np.bool_] | None = None) -> list[dict[str, float]]:
        """Return all parameters of the model at sample numbers; where `before`, the value ahead of a jump."""
        values = {name: s.at(samples, self._rate) for name, s in self._schedules.items() if name in self._fixed}
        if before is not None:
            ahead = {name: self._schedules[name].at(samples, self._rate, before=True) for name in values}
            values = {name: np.where(before, ahead[name], v) for name, v in values.items()}
        rows = zip(*(v.tolist() for v in values.values()), strict=True) if values else [()] * samples.size
        return [{**self._fixed, **dict(zip(values, row, strict=True))} for row in rows]

    def _exact(self, thetas: list[dict[str, float]]) -> tuple[Array, Array, Array, Array]:
        """Discretise many at once: exp([[A, B, E], [0, 0, 0]] T) holds all three (Van Loan 1978)."""
        stack = self._stacked(thetas)
        n, inside = len(self._of.states), slice(0, len(self._of.states))
        full = exponentials(stack, self._halvings)
        now = full if self._fraction == 0.0 else exponentials(stack * (1.0 - self._fraction), self._halvings)
        return full[:, inside, :n], now[:, inside, n], full[:, inside, n] - now[:, inside, n], full[:, inside, n + 1 :]

    def _stacked(self, thetas: list[dict[str, float]]) -> Array:
        spaces = [self._of.matrices(theta) for theta in thetas]
        n, nd = spaces[0].E.shape
        stack = np.zeros((len(spaces), n + 1 + nd, n + 1 + nd))
        stack[:, :n, :n] = [s.A for s in spaces]
        stack[:, :n, n] = [s.B[:, 0] for s in spaces]
        stack[:, :n, n + 1 :] = [s.E for s in spaces]
        return np.asarray(stack / self._rate)

    def _norm(self) -> float:
        """Return the largest 1-norm at the corners: in between the parameters, and about so the norm, are smaller."""
        at = self._corners.astype(np.float64)
        thetas = self._parameters(at) + self._parameters(at, before=np.ones(at.size, dtype=np.bool_))
        return float(np.abs(self._stacked(thetas)).sum(axis=1).max())


def exponentials(stack: Array, halvings: int) -> Array:
    """Return exp of each matrix by a Taylor polynomial of 2^-halvings times it, squared as often.

    `stack` is (n_matrices, n, n). SciPy's expm solves equations on the threads of the linear algebra library, which on
    a busy machine takes a hundred times as long for matrices as small as these; products stay on this thread.
    """
    x = stack * 0.5**halvings
    unit = np.eye(x.shape[1])
    found = unit + x / _DEGREE
    for k in range(_DEGREE - 1, 0, -1):
        found = unit + np.matmul(x, found) / k
    for _ in range(halvings):
        found = np.matmul(found, found)
    return np.asarray(found)
