"""Model error against an acceptable level, with hysteresis (thesis figs 3.1 and 5.8)."""

from __future__ import annotations

import math

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.track.evidence import Evidence


class ErrorLevel:
    """Root mean square of the normalised innovations over recent blocks, and whether it is too large.

    `limit`, `release`: too large from `limit` on, until it has come down to `release`; `window_blocks`: blocks in the
    mean; nothing is judged before that many; `usual`: level at identification, by which the error is divided.

    `above`: whether the error is too large; `n_blocks`: blocks used.
    """

    def __init__(self, limit: float, release: float, window_blocks: int, *, usual: float = 1.0) -> None:
        if not (0 < release <= limit and window_blocks >= 1 and usual > 0):
            raise EstimationError(
                f"error level: 0 < release <= limit, a window of a block or more, usual > 0; got release "
                f"{release:g}, limit {limit:g}, {window_blocks} blocks, usual {usual:g}. Mend them"
            )
        self.limit, self.release = limit, release
        self.above, self.n_blocks = False, 0
        self._squares, self._weights, self._usual = [0.0] * window_blocks, [0.0] * window_blocks, usual * usual
        self._square = self._weight = 0.0

    @property
    def error(self) -> float:
        """Present level, 1 as at identification; NaN before the first block."""
        return math.sqrt(max(self._square, 0.0) / (self._weight * self._usual)) if self._weight else math.nan

    def update(self, evidence: Evidence, estimate: Array) -> float:
        """Take in a block.

        `estimate`: (p,), numbers whose error is watched: those in use. Returns the level over the window. A block that
        is not finite changes nothing.
        """
        square, weight = evidence.loss(estimate), evidence.n_samples * evidence.n_outputs
        if not math.isfinite(square) or weight <= 0:
            return self.error
        at = self.n_blocks % len(self._squares)
        self._square += square - self._squares[at]
        self._weight += weight - self._weights[at]
        self._squares[at], self._weights[at] = square, float(weight)
        self.n_blocks += 1
        if at + 1 == len(self._squares):  # differences of sums gather rounding: sum anew once a window
            self._square, self._weight = math.fsum(self._squares), math.fsum(self._weights)
        level = self.error
        if self.n_blocks >= len(self._squares):
            self.above = level > self.release if self.above else level >= self.limit
        return level

    def restart(self) -> None:
        """Forget the blocks, as after the numbers in use were changed."""
        n = len(self._squares)
        self._squares, self._weights = [0.0] * n, [0.0] * n
        self._square = self._weight = 0.0
        self.above, self.n_blocks = False, 0
