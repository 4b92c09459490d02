"""Two monitors of the evidence: which parameters the recent data inform, and whether the model error is acceptable.

Without information there is no update, and what is published is marked stale. The triangles of recent blocks are
gathered in an exponential window by QR; the standard deviation that this window alone would give each number, all
others unknown, says how much the data tell of it now. The error has a level with hysteresis (thesis figs 3.1 and 5.8).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError, counted, nearest
from ambid.recursive.lines import Event
from ambid.recursive.square_root_kernels import deviations
from ambid.tracking.evidence import Evidence
from ambid.tracking.rpem_kernels import absorb, fold


class ErrorLevel:
    """Root mean square of the normalised innovations over recent blocks, and whether it is too large.

    `limit`, `release`: too large from `limit` on, until it has come down to `release`; `window_blocks`: blocks in the
    mean; nothing is judged before that many.

    `above`: whether the error is too large; `n_blocks`: blocks used.
    """

    def __init__(self, limit: float, release: float, window_blocks: int) -> None:
        if not (0 < release <= limit and window_blocks >= 1):
            raise EstimationError(
                f"error level: 0 < release <= limit, a window of a block or more; got release {release:g}, limit "
                f"{limit:g}, {counted(window_blocks, 'block')}. Correct them"
            )
        self.limit, self.release = limit, release
        self.above, self.n_blocks = False, 0
        self._squares, self._weights = [0.0] * window_blocks, [0.0] * window_blocks
        self._square = self._weight = 0.0

    @property
    def error(self) -> float:
        """Present level, 1 as at identification; NaN before the first block."""
        return math.sqrt(max(self._square, 0.0) / self._weight) if self._weight else math.nan

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


_RIDGE = 1e-3  # the numbers are of order one: one that nothing shows has a standard deviation of a thousand
_WORSE = 1.5  # accuracy over `enough` at which a number is no longer fresh: hysteresis
_NOTHING = 1e-100  # entries of a triangle under this become zero: the smallest numbers take long to compute with
_FILLED = 0.5  # part of the window that has to be filled before anything is judged


class ExcitationMonitor:
    """Tell fresh parameters from frozen ones.

    A parameter's information rate is 1/(sd² window), with sd the marginal standard deviation (relative, as all numbers
    are of order one) that the exponential window alone would give, offsets and all other numbers unknown. It freezes
    below `freeze` and thaws above `thaw` times the rate at identification, unless the window alone gives it better than
    `enough`: then it is fresh.

    `names`: all numbers of the evidence; `block_s`: duration of a block, s; `window_s`: time constant of the window, s;
    `freeze`, `thaw`: parts of the reference; `enough`: relative standard deviation.

    `fresh`: of each parameter; all are at the start; `sd`: (p,), relative standard deviation that the window alone
    gives each number (about a thousand: nothing); `duration_s`: of the data in the window.
    """

    def __init__(
        self,
        names: Sequence[str],
        *,
        reference_rate: Mapping[str, float],
        held: Sequence[str] = (),
        block_s: float,
        window_s: float = 1.0,
        freeze: float = 0.02,
        thaw: float = 0.05,
        enough: float = 0.01,
    ) -> None:
        self.names, p = tuple(names), len(names)
        for name in (*reference_rate, *held):
            if name not in self.names:
                raise EstimationError(f"excitation: {name!r} is not tracked.{nearest(name, self.names)}")
        for name, value in reference_rate.items():
            if not (value >= 0 and math.isfinite(value)):
                raise EstimationError(
                    f"reference_rate of {name} is {value:g}; it is an information rate. Give 0 or more"
                )
        if not (0 < block_s < window_s and 0 < freeze <= thaw and enough >= 0):
            raise EstimationError("excitation: 0 < block_s < window_s, 0 < freeze <= thaw, enough >= 0. Correct them")
        self._judged = tuple(name for name in self.names if name in reference_rate)
        self._held = np.array([self.names.index(name) for name in held], dtype=np.int64)
        self._at = tuple(self.names.index(name) for name in self._judged)
        self._parameter = np.array([name in reference_rate for name in self.names])
        self._reference = np.array([reference_rate.get(name, 0.0) for name in self.names])
        known = np.inf if enough == 0.0 else enough**-2.0
        # information, and rate of it, below both of which a frozen number stays so, and a fresh one freezes
        self._limits = (known, thaw * self._reference), (known / _WORSE**2, freeze * self._reference)
        self._block, self._window, self._decay = block_s, window_s, math.exp(-block_s / window_s)
        self._keep = math.sqrt(self._decay)
        self.duration_s = 0.0
        self._R, self._rows = np.zeros((p, p)), np.zeros((p, p))
        # the ridge stands for what would be known otherwise, with all numbers free to move
        self._ridge, self._F, self._none = np.eye(p) / _RIDGE**2, np.empty((p, p)), np.zeros(p)
        self._scratch = np.ones(p, dtype=np.bool_), np.zeros(p, dtype=np.bool_), 1.0, np.zeros((p + 2, p))
        self._fresh = np.ones(p, dtype=np.bool_)
        self._known, self._rate = self._limits[1]
        self.sd = np.full(p, 1.0 / _RIDGE)

    @property
    def fresh(self) -> Mapping[str, bool]:  # noqa: D102
        return MappingProxyType({n: bool(self._fresh[i]) for n, i in zip(self._judged, self._at, strict=True)})

    def update(self, evidence: Evidence, t: float) -> tuple[Event, ...]:
        """Take in a block.

        `t`: its end, s of record. Returns ``frozen`` and ``thawed``, with the reason.
        """
        J, duration = evidence.J, self.duration_s * self._decay + self._block
        if J.shape != self._R.shape or not math.isfinite(J.sum()):
            raise EstimationError(
                f"the block at sample {evidence.first} is not finite or has other parameters. Omit it"
            )
        self._rows[:] = J.T
        if self._held.size:
            self._rows[self._held] = 0.0
        self._R *= self._keep
        self._R[np.abs(self._R) < _NOTHING] = 0.0
        fold(self._R, self._rows, len(self.names), 1)
        self._F[:] = self._ridge
        absorb(self._none, self._F, self._R, self._none, self._none, *self._scratch)
        deviations(self._F, self.sd)
        self.duration_s = duration
        if duration < _FILLED * self._window:
            return ()
        low = 1.0 / (self.sd * self.sd) < np.minimum(self._known, self._rate * duration)
        changed = self._parameter & (low == self._fresh)
        return self._events(t, changed) if changed.any() else ()

    def _events(self, t: float, changed: NDArray[np.bool_]) -> tuple[Event, ...]:
        """Turn the flags that change, and say why."""
        events = []
        for j in np.flatnonzero(changed):
            name, thawed = self.names[j], not self._fresh[j]
            sd, reference = float(self.sd[j]), float(self._reference[j])
            rate = 1.0 / (sd * sd * self.duration_s)
            part = rate / reference if reference > 0 else math.inf
            seen = f"the last {self._window:g} s alone determine {name} to {100 * sd:.3g} %"
            if sd > 0.5 / _RIDGE:
                seen = f"the last {self._window:g} s contain no information on {name}"
            events.append(
                Event(
                    kind="thawed" if thawed else "frozen",
                    t=t,
                    why=f"{seen}, {100 * part:.2g} % of the information rate at identification",
                    parameter=name,
                    values={"sd": sd, "rate": rate, "reference_rate": reference},
                )
            )
        self._fresh = self._fresh ^ changed
        self._known, self._rate = (np.where(self._fresh, b, a) for a, b in zip(*self._limits, strict=True))
        return tuple(events)
