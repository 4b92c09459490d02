"""Continuous-time matrices as products of powers of the parameters, for evaluation in compiled code.

Every entry of the linear models' A, B and E is a number times powers of parameters (k_i/m, -R/L, 1, ...). The
exponents are read off the exact derivatives, theta_j/M dM/dtheta_j, and checked at other points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.physics.linear_model import LinearModel, StateSpace

Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Powers:
    """Entries of [A, B, E] that are not zero, each `size` times parameters to their powers."""

    place: Ints  # (n_entries, 2), row and column
    size: Array  # (n_entries,)
    start: Ints  # (n_entries + 1,), factors of entry i are start[i] <= c < start[i + 1]
    factor: Ints  # (n_factors, 2), place of a parameter, and its exponent

    def matrix(self, values: Array, shape: tuple[int, int]) -> Array:
        """Return [A, B, E] at parameters.

        `values`: (n_parameters,).
        """
        out = np.zeros(shape)
        for i, (row, column) in enumerate(self.place):
            factors = self.factor[self.start[i] : self.start[i + 1]]
            out[row, column] = self.size[i] * np.prod(values[factors[:, 0]] ** factors[:, 1].astype(float))
        return out


def powers_of(model: LinearModel) -> Powers:
    """Return the matrices of a model as products of powers, in SI units and the order of the model's parameters."""
    names = [p.name for p in model.parameters]
    point = np.linspace(1.5, 2.5, len(names))
    here = _joined(model.matrices(dict(zip(names, point, strict=True))))
    slopes = np.array([_joined(model.derivative(dict(zip(names, point, strict=True)), name)) for name in names])
    rows, columns = np.nonzero(here)
    exponents = np.rint(point[:, None] * slopes[:, rows, columns] / here[rows, columns]).astype(np.int64)
    size = here[rows, columns] / np.prod(point[:, None] ** exponents, axis=0)
    counted = [[(j, int(k)) for j, k in enumerate(column) if k] for column in exponents.T]
    found = Powers(
        place=np.column_stack([rows, columns]).astype(np.int64),
        size=size,
        start=np.cumsum([0, *map(len, counted)]).astype(np.int64),
        factor=np.array([pair for entry in counted for pair in entry], dtype=np.int64).reshape(-1, 2),
    )
    for other in (point[::-1].copy(), -0.7 * point, 3.1 * point**2):
        exact = _joined(model.matrices(dict(zip(names, other, strict=True))))
        if not np.allclose(found.matrix(other, here.shape), exact, rtol=1e-12, atol=0.0):
            raise EstimationError(
                f"the matrices of model {model.name!r} are not products of powers of its parameters; the unscented "
                "filter wants that. Use JointEkf"
            )
    return found


def _joined(space: StateSpace) -> Array:
    return np.hstack([space.A, space.B, space.E])
