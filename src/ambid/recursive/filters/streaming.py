"""What all streaming filters of channels share: samples and blocks, missing values, copies, the compiled recursion.

A filter differs from an estimator in what `update` returns: the filtered signal.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from math import isfinite
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import EstimationError

Scan = Callable[[Array, Array, Array, Array], int]


class StreamingFilter:
    """A filter that runs on each of several channels alone, with state.

    Splitting a stream into samples and blocks in another way does not change any number. A value that is not finite is
    missing: the filter runs on over it and counts it.

    `name`: for messages; `state`: (channels, n_state); `constants`: (n_constants,); `scan`: name of the compiled
    recursion.

    `n_samples`: samples (of all channels) that were taken in, and single values that were missing; `n_missing`: samples
    (of all channels) that were taken in, and single values that were missing.
    """

    def __init__(self, name: str, *, channels: int, state: Array, constants: Array, scan: str) -> None:
        from ambid.recursive.filters import _kernels

        self.name = name
        self.channels = channels
        self.n_samples = 0
        self.n_missing = 0
        self._state = np.ascontiguousarray(state, dtype=np.float64)
        self._begun = self._state.copy()
        self._constants = np.ascontiguousarray(constants, dtype=np.float64)
        self._scan: Scan = getattr(_kernels, scan)
        self._one, self._one_out = np.empty((1, channels)), np.empty((1, channels))

    @property
    def state(self) -> Array:
        """A copy of the estimate that is ready for the next sample, shape (channels,)."""
        return self._state[:, 0].copy()

    def update(self, measurement: ArrayLike) -> Array | float:
        """Take in one sample or a block and return it filtered.

        `measurement`: (channels,), or (n_samples, channels) for a block.
        """
        if isinstance(measurement, float) and self.channels == 1:
            self._one[0, 0] = measurement
            self.n_missing += self._scan(self._one, self._one_out, self._state, self._constants)
            self.n_samples += 1
            return float(self._one_out[0, 0])
        given = np.asarray(measurement, dtype=np.float64)
        block = as_block(given, self.channels, self.name)
        out = np.empty(block.shape)
        self.n_missing += self._scan(block, out, self._state, self._constants)
        self.n_samples += block.shape[0]
        return float(out[0, 0]) if given.ndim == 0 else out.reshape(given.shape)

    def run(self, block: Array, out: Array) -> None:
        """Filter a block without looking at its shape or allocating anything.

        `block`, `out`: (n_samples, channels), C order, writeable, measured and, on return, filtered; may be one array.
        """
        self.n_missing += self._scan(block, out, self._state, self._constants)
        self.n_samples += block.shape[0]

    def anew(self, channels: int) -> Self:
        """Return a filter of the same numbers that has seen nothing yet.

        `channels`: all begin as the first channel of this one did.
        """
        other = copy(self)
        other.channels, other.n_samples, other.n_missing = channels, 0, 0
        other._begun = np.tile(self._begun[:1], (channels, 1))
        other._state = other._begun.copy()
        other._one, other._one_out = np.empty((1, channels)), np.empty((1, channels))
        return other

    def copy(self) -> Self:
        """Return an independent filter in the same state."""
        other = copy(self)
        other._state = self._state.copy()
        other._one, other._one_out = self._one.copy(), self._one_out.copy()
        return other


def as_block(given: Array, channels: int, name: str) -> Array:
    """Return one sample or a block as a block that the compiled recursions take: C order, writeable, (n, channels).

    `name`: for the error. Returns (n_samples, channels).
    """
    if given.ndim == 2 and given.shape[1] == channels:
        block = np.ascontiguousarray(given)
    elif given.ndim < 2 and channels == 1:
        block = np.ascontiguousarray(given).reshape(-1, 1)
    elif given.ndim == 1 and given.size == channels:
        block = np.ascontiguousarray(given).reshape(1, channels)
    else:
        raise EstimationError(
            f"{name}: input of shape {given.shape} for {channels} channels; it must be ({channels},) for a sample or "
            f"(n_samples, {channels}) for a block. Reshape it"
        )
    return block if block.flags.writeable else block.copy()


def check_channels(name: str, rate_hz: float, channels: int) -> None:
    """Refuse a rate that is not positive or a number of channels that is none.

    `name`: for the error.
    """
    if not (isfinite(rate_hz) and rate_hz > 0):
        raise EstimationError(f"{name}: the rate is {rate_hz} Hz; it must be positive. Give the sampling rate")
    if isinstance(channels, bool) or not isinstance(channels, int) or channels < 1:
        raise EstimationError(f"{name}: {channels!r} channels; give a whole number from 1 up")
