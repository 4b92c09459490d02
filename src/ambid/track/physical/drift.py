"""How fast each tracked number walks, found from the data by maximum likelihood.

Over a window of merged evidence the score of the likelihood by each walk variance w_j is half the difference of
sum(lambda_j^2) and sum(N_jj) of the disturbance smoother (Koopman and Shephard 1992). At the maximum the two agree;
their ratio, raised to a power below one, therefore takes each w_j towards it and keeps it positive.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.track.evidence import Evidence
from ambid.track.physical.parameter_filter import ParameterFilter

CHUNK_S = 0.05  # evidence is merged to this length: the fastest drift that is told from a jump
_WINDOW = 400  # chunks
_FEWEST = 20  # chunks before the first adaptation
_EVERY = 5  # chunks between looks at the recent past
_SELDOM = 20  # chunks between looks at the whole window
_SURE = 6.0  # ratio in the recent past that chance seldom makes; what follows from a false one is a wider interval
_RECENT = (20, 60)  # chunks that alone may show that something has begun to drift
_POWER = 0.5
_SLOWER, _FASTER = 0.5, 10.0  # factors by which one adaptation may change a variance
_ROUNDS = 5  # of raising a variance at one look
_NOTICED = 3.0  # factor of a variance from which the recent past is filtered anew


class DriftRates:
    """Variances per second of the walks.

    `start`: (p,), first variances per second; `floor`, `ceiling`: (p,), bounds; where floor equals ceiling nothing is
    adapted; `block_s`: length of the evidence that will come, s.

    `variance`: (p,), per second; `adapts`: whether the variances are found from the data; `walks`: whether any variance
    is, or may become, positive.
    """

    def __init__(self, start: Array, floor: Array, ceiling: Array, block_s: float) -> None:
        from ambid.track.physical._kernels import gather, walk_score

        p = start.size
        self.variance, self._floor, self._ceiling = start.copy(), floor, ceiling
        self.adapts = bool(np.any(ceiling > floor))
        self.walks = self.adapts or bool(np.any(start > 0.0))
        self._per_chunk = max(1, round(CHUNK_S / block_s))
        self._chunk_s = self._per_chunk * block_s
        room = _WINDOW if self.adapts else 0
        self._J, self._r, self._at = np.zeros((room, p, p)), np.zeros((room, p)), np.zeros((room, p))
        self._q, self._P = np.zeros((room, p)), np.zeros((room, p, p))
        self._scratch = np.zeros((room, p, p)), np.zeros((room, p, 2))
        self._triangle, self._rows = np.zeros((p + 1, p + 1)), np.zeros((p + 1, p))
        self._point = start
        self._parts = self._count = self._next = self._since = self._looks = 0
        self._score, self._gather = walk_score, gather

    def add(self, evidence: Evidence, before: ParameterFilter) -> None:
        """Take in a block.

        `before`: the numbers as they were known before this block.
        """
        if not self.adapts:
            return
        if not self._parts:
            self._q[self._next], self._P[self._next] = before.q, before.covariance
            self._triangle[:], self._point = 0.0, evidence.at
        self._gather(self._triangle, self._rows, evidence.J, evidence.r, evidence.at, self._point)
        self._parts += 1
        if self._parts < self._per_chunk:
            return
        self._parts = 0
        self._J[self._next], self._r[self._next] = self._triangle[:-1, :-1], self._triangle[:-1, -1]
        self._at[self._next] = self._point
        self._next = (self._next + 1) % _WINDOW
        self._count = min(self._count + 1, _WINDOW)
        self._since += 1

    def adapt(self, known: ParameterFilter, noise: float) -> None:
        """Look at the window where a look is due; where something walks faster than thought, filter its end anew.

        `noise`: variance of the evidence's residual.
        """
        if self._parts == 0 and self._count >= _FEWEST and self._since >= _EVERY:
            self._since = 0
            self._adapt(known, noise)

    def restart(self) -> None:
        """Forget the window: a jump in it would pass for drift."""
        self._count = self._next = self._since = self._parts = 0

    def copy(self) -> DriftRates:
        """Return an independent copy in the same state."""
        other = copy.copy(self)
        for name in ("variance", "_J", "_r", "_at", "_q", "_P", "_triangle"):
            setattr(other, name, getattr(self, name).copy())
        return other

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k not in ("_score", "_gather")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        from ambid.track.physical._kernels import gather, walk_score

        self.__dict__.update(state)
        self._score, self._gather = walk_score, gather

    def _adapt(self, known: ParameterFilter, noise: float) -> None:
        active, before = known.active, self.variance
        if self._looks % (_SELDOM // _EVERY) == 0:
            self._raise(self._ratio(self._count, active, noise))
        self._looks += 1
        for length in _RECENT:
            for _ in range(_ROUNDS):
                recent = self._ratio(min(length, self._count), active, noise)
                if not np.any(recent > _SURE):
                    break
                self._raise(np.where(recent > _SURE, recent, 1.0))
        if np.any(self.variance > _NOTICED * before):
            self._catch_up(known, noise)

    def _raise(self, ratio: Array) -> None:
        factor = np.clip(ratio**_POWER, _SLOWER, _FASTER)
        self.variance = np.clip(self.variance * factor, self._floor, self._ceiling)

    def _ratio(self, count: int, active: NDArray[np.bool_], noise: float) -> Array:
        """Sum of lambda_j^2 over sum of N_jj in the last `count` chunks: above 1 where number j walks faster."""
        squares, powers, _, _ = self._run(count, active, noise)
        told = active & (powers > 0.0)
        return np.where(told, squares / np.where(told, powers, 1.0), 1.0)

    def _catch_up(self, known: ParameterFilter, noise: float) -> None:
        """Filter the recent past anew: with the rates as they were, what moved was taken for chance."""
        _, _, q, P = self._run(min(max(_RECENT), self._count), known.active, noise)
        held = ~known.active
        if not (np.all(np.isfinite(q)) and np.all(np.diag(P) > 0.0)):
            return
        q[held] = known.q[held]
        known.set(q, P)

    def _run(self, count: int, active: NDArray[np.bool_], noise: float) -> tuple[Array, Array, Array, Array]:
        step = np.sqrt(np.where(active, self.variance, 0.0) * self._chunk_s)
        first = (self._next - count) % _WINDOW
        found: tuple[Array, Array, Array, Array] = self._score(
            self._J, self._r, self._at, count, first, self._q[first], self._P[first], step, noise,
            *self._scratch,
        )  # fmt: skip
        return found
