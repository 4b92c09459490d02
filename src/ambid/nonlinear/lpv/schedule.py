"""Where the scheduling signal p comes from, and the functions of it that coefficients are made of.

p is a column among the inputs (its value now), the output (its last value), or ``level``: the set point, as a causal
first-order low-pass of the output before the present sample. It is scaled to -1 ... 1 over the training data; a
coefficient is a sum of Legendre polynomials of it, or of hats (piecewise linear).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError, nearest

LEVEL = "level"
BASES = ("legendre", "hats")


@dataclass(frozen=True, slots=True, kw_only=True)
class Schedule:
    """A scheduling signal."""

    name: str  # of the column; ``level`` for the set point
    column: int  # which input it is; -1 where it is made of the output
    # of the low-pass; 0 for the last value of the output itself. Without meaning for a column of the inputs.
    time_constant: float
    low: float  # range in training
    high: float

    @property
    def middle(self) -> float:
        """Middle of the range, SI."""
        return 0.5 * (self.low + self.high)

    @property
    def half(self) -> float:
        """Half the range, SI."""
        return 0.5 * (self.high - self.low)

    def share(self, dt: float) -> float:
        """Return the weight of the newest output in the low-pass.

        Returns 0 for a column of the inputs, where there is no low-pass.
        """
        if self.column >= 0:
            return 0.0
        return 1.0 if self.time_constant <= 0 else -math.expm1(-dt / self.time_constant)

    def signal(self, u: Array, y: Array, dt: float) -> Array:
        """Return the scheduling signal.

        `u`: (n_samples, n_inputs), SI; `y`: (n_samples, 1), SI. Returns (n_samples,), SI.
        """
        return scheduling_signal(u, y, self.column, self.share(dt))

    def scaled(self, p: Array | float) -> Array:
        """Return p as the functions of it take it, -1 to 1 in training.

        `p`: (n_samples,), or float, SI.
        """
        return np.asarray((np.asarray(p, dtype=np.float64) - self.middle) / self.half)


def scheduling_signal(u: Array, y: Array, column: int, share: float) -> Array:
    """Return a column of the inputs, or the low-passed output.

    `u`: (n_samples, n_inputs), SI; `y`: (n_samples, 1), SI; `column`: -1 for the output; `share`: weight of the newest
    output in the low-pass. Returns (n_samples,), SI.
    """
    from ambid.nonlinear.lpv._kernels import set_points

    if column >= 0:
        return np.ascontiguousarray(u[:, column])
    out = np.empty(y.shape[0])
    set_points(np.ascontiguousarray(y[:, 0]), share, out)
    return out


def basis_values(s: Array, n: int, basis: str) -> Array:
    """Return the functions of the scaled scheduling signal.

    `s`: (n_samples,); `n`: how many: degree + 1. Returns (n_samples, n).
    """
    from ambid.nonlinear.lpv._kernels import basis_rows

    out = np.empty((s.size, n))
    basis_rows(np.ascontiguousarray(s), BASES.index(basis), out)
    return out


def schedule_column(name: str, first: IOData) -> int:
    """Return which input a schedule names.

    `name`: ``level``, an input, or the output; `first`: one of the records. Returns -1 where the scheduling signal is
    made of the output.
    """
    columns = (*first.inputs, *first.outputs)
    if name == LEVEL:
        if LEVEL in columns:
            raise EstimationError(
                "lpv: schedule = level means the low-passed output, but there is a column of that name. Rename "
                "the column"
            )
        return -1
    if name not in columns:
        raise EstimationError(
            f"lpv: schedule is {name!r}; it must be an input, the output or level: {', '.join((*columns, LEVEL))}. "
            f"Name the column as an input too; it does not excite unless exciting = yes.{nearest(name, list(columns))}"
        )
    return first.inputs.index(name) if name in first.inputs else -1


def schedule_over(records: Sequence[IOData], name: str, column: int, time_constant: float) -> Schedule:
    """Return a schedule with the range that it has in the records.

    `column`: as `schedule_column` says.
    """
    of = Schedule(name=name, column=column, time_constant=time_constant, low=0.0, high=0.0)
    whole = np.concatenate([of.signal(x.u, x.y, x.dt)[1:] for x in records])
    low, high = float(whole.min()), float(whole.max())
    if not high - low > 1e-12 * max(abs(low), abs(high)):
        raise EstimationError(
            f"lpv: the scheduling signal {name!r} is constant at {low:g}; a model that is scheduled by it cannot be "
            "told from a linear one. Give records at several set points, or fit a linear structure (bj, ararmax)"
        )
    return Schedule(name=name, column=column, time_constant=time_constant, low=low, high=high)
