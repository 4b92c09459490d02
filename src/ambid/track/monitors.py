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

from ambid.arrays import Array
from ambid.errors import EstimationError, nearest
from ambid.recursive.lines import Event
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


_RIDGE = 1e-3  # the numbers are of order one: one that nothing shows has a standard deviation of a thousand
_WORSE = 1.5  # accuracy over `enough` at which a number is no longer fresh: hysteresis
_FILLED = 0.5  # part of the window that has to be filled before anything is judged


class ExcitationMonitor:
    """Tell fresh parameters from frozen ones.

    A parameter's information rate is 1/(sd² window), with sd the marginal standard deviation (relative, as all numbers
    are of order one) that the exponential window alone would give, offsets and all other numbers unknown. It freezes
    below `freeze` and thaws above `thaw` times the rate at identification, unless the window alone gives it better than
    `enough`: then it is fresh.

    `names`: all numbers of the evidence; `block_s`: duration of a block, s; `window_s`: time constant of the window, s;
    `freeze`, `thaw`: parts of the reference; `enough`: relative standard deviation.

    `fresh`: of each parameter; all are at the start; `sd`: what the window alone gives each parameter: relative
    standard deviation (about a thousand: nothing), and information rate, 1/s; `rate`: what the window alone gives each
    parameter: relative standard deviation (about a thousand: nothing), and information rate, 1/s.
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
        from ambid.track.supervise_kernels import inform

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
            raise EstimationError("excitation: 0 < block_s < window_s, 0 < freeze <= thaw, enough >= 0. Mend them")
        self._inform, self._judged = inform, tuple(name for name in self.names if name in reference_rate)
        self._held = np.array([self.names.index(name) for name in held], dtype=np.int64)
        self._at = tuple(self.names.index(name) for name in self._judged)
        self._reference = np.array([reference_rate.get(name, -1.0) for name in self.names])
        self._limits = np.array([freeze, thaw, enough, _WORSE, _RIDGE])
        self._block, self._window, self._decay = block_s, window_s, math.exp(-block_s / window_s)
        self._duration = 0.0
        self._R, self._J, self._work = np.zeros((p, p)), np.zeros((p, p)), np.zeros((3, p, p))
        self._fresh, self._out = np.ones(p, dtype=np.int64), np.zeros((2, p))
        self._before = self._fresh.copy()
        self._out[0] = 1.0 / _RIDGE

    @property
    def fresh(self) -> Mapping[str, bool]:  # noqa: D102
        return MappingProxyType({n: bool(self._fresh[i]) for n, i in zip(self._judged, self._at, strict=True)})

    @property
    def sd(self) -> Mapping[str, float]:  # noqa: D102
        return MappingProxyType({n: float(self._out[0, i]) for n, i in zip(self._judged, self._at, strict=True)})

    @property
    def rate(self) -> Mapping[str, float]:  # noqa: D102
        return MappingProxyType({n: float(self._out[1, i]) for n, i in zip(self._judged, self._at, strict=True)})

    def update(self, evidence: Evidence, t: float) -> tuple[Event, ...]:
        """Take in a block.

        `t`: its end, s of record. Returns ``frozen`` and ``thawed``, with the reason.
        """
        J = evidence.J
        if J.shape != self._J.shape or not math.isfinite(J.sum()):
            raise EstimationError(
                f"the block at sample {evidence.first} is not finite or of other numbers. Leave it out"
            )
        self._J[:] = J
        if self._held.size:
            self._J[:, self._held] = 0.0
        self._duration = self._duration * self._decay + self._block
        enough = self._duration >= _FILLED * self._window
        changed = self._inform(
            self._R, self._J, self._decay, self._duration if enough else -self._duration, self._limits,
            self._reference, self._fresh, self._out, self._work,
        )  # fmt: skip
        return self._events(t) if changed else ()

    def _events(self, t: float) -> tuple[Event, ...]:
        """Say which flags changed, and why."""
        events = []
        for j in np.flatnonzero(self._fresh != self._before):
            name, thawed = self.names[j], bool(self._fresh[j])
            sd, rate, reference = float(self._out[0, j]), float(self._out[1, j]), float(self._reference[j])
            part = rate / reference if reference > 0 else math.inf
            seen = f"the last {self._window:g} s alone would give {name} to {100 * sd:.3g} %"
            if sd > 0.5 / _RIDGE:
                seen = f"the last {self._window:g} s tell nothing of {name}"
            events.append(
                Event(
                    kind="thawed" if thawed else "frozen",
                    t=t,
                    why=f"{seen}, {100 * part:.2g} % of the information rate at identification",
                    parameter=name,
                    values={"sd": sd, "rate": rate, "reference_rate": reference},
                )
            )
        self._before = self._fresh.copy()
        return tuple(events)
