"""Samples on their way into an estimator of physical parameters: shapes checked once, for all of them alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.track.physical.numbers import TrackedNumbers


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Samples:
    """Consecutive samples."""

    u: Array  # (n_samples, n_inputs), SI
    y: Array  # (n_samples, n_outputs), SI
    # (n_samples, 2), or None, (speed/top speed)^2 times cosine and sine of the rotor's angle, in the middle of each
    # sample
    forcing: Array | None = None

    def part(self, first: int, last: int | None = None) -> Samples:
        """Return samples `first` <= k < `last`, as views."""
        cut = slice(first, last)
        return Samples(u=self.u[cut], y=self.y[cut], forcing=None if self.forcing is None else self.forcing[cut])


class RecentSamples:
    """The last samples of a stream, in memory that does not grow.

    `capacity`: samples kept at least.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._parts: list[NDArray[np.float64]] = []
        self._room = 2 * capacity
        self._filled = 0
        self.last = 0

    @property
    def first(self) -> int:
        """Number of the oldest sample that is kept."""
        return self.last - self._filled

    def add(self, samples: Samples, last: int) -> None:
        """Keep more samples.

        `samples`: those that follow the ones before; `last`: number of the sample after them.
        """
        columns = [samples.u, samples.y] + ([] if samples.forcing is None else [samples.forcing])
        if not self._parts:
            self._parts = [np.empty((self._room, c.shape[1])) for c in columns]
        n = samples.y.shape[0]
        for a in range(0, n, self._capacity):
            take = min(self._capacity, n - a)
            if self._filled + take > self._room:
                keep = min(self._capacity, self._filled)
                for part in self._parts:
                    part[:keep] = part[self._filled - keep : self._filled]
                self._filled = keep
            for part, column in zip(self._parts, columns, strict=True):
                part[self._filled : self._filled + take] = column[a : a + take]
            self._filled += take
        self.last = last

    def clear(self) -> None:
        """Forget all samples, as after a gap."""
        self._filled = 0

    def since(self, first: int) -> Samples | None:
        """Return the samples from number `first` on, as views that the next `add` may overwrite.

        Returns none where they are no longer, or not yet, there.
        """
        if not self.first <= first < self.last:
            return None
        at = slice(first - self.first, self._filled)
        u, y, *more = (part[at] for part in self._parts)
        return Samples(u=u, y=y, forcing=more[0] if more else None)


def checked(numbers: TrackedNumbers, inputs: ArrayLike, outputs: ArrayLike, forcing: ArrayLike | None) -> Samples:
    """Put one sample or a block into the shape of a block.

    `outputs`: a number, or (n_samples,), where there is one column.
    """
    if forcing is None and not numbers.synchronous:
        # one sample as it mostly comes: the checks below would take as long as its use
        n_u, n_y = numbers.problem.u.shape[1], numbers.problem.y.shape[1]
        if (
            type(inputs) is np.ndarray and type(outputs) is np.ndarray
            and inputs.dtype == np.float64 and outputs.dtype == np.float64
            and inputs.shape == (n_u,) and outputs.shape == (n_y,)
        ):  # fmt: skip
            return Samples(
                u=np.ascontiguousarray(inputs).reshape(1, n_u), y=np.ascontiguousarray(outputs).reshape(1, n_y)
            )
    model = numbers.problem.model
    u, y = _columns(inputs, len(model.inputs)), _columns(outputs, len(model.outputs))
    extra = None if forcing is None else _columns(forcing, 2)
    lengths = {None if a is None else a.shape[0] for a in ((u, y, extra) if numbers.synchronous else (u, y))}
    if u is None or y is None or len(lengths) > 1 or (forcing is None and numbers.synchronous):
        more = " and the unbalance its forcing" if numbers.synchronous else ""
        raise EstimationError(
            f"inputs have shape {np.shape(inputs)}, outputs {np.shape(outputs)}; the model wants {len(model.inputs)}"
            f" and {len(model.outputs)} columns of one length{more}. Check the block"
        )
    return Samples(u=u, y=y, forcing=extra if numbers.synchronous else None)


def _columns(values: ArrayLike, n: int) -> Array | None:
    """Return a block of n columns; None where the shape is neither that nor one sample."""
    a = np.ascontiguousarray(values, dtype=np.float64)
    if np.ndim(values) < 2 and (n == 1 or a.size == n):
        return a.reshape(-1, n)
    return a if np.ndim(values) == 2 and a.shape[1] == n else None
