"""Guard of a stream: whatever happens to the blocks, only clean samples under their right numbers go on, in order.

It judges whether a block is this stream's, where it belongs (order.py), and which rows are sound: not NaN, absurd or
frozen. A frozen channel holds one value much longer than it ever did: the run is refused from its first repetition on,
and held back to the next block where a block's end leaves that open.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import index
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError, counted
from ambid.tracking.blocks import Block, Passed, RejectionKind, RowKind, Stretch
from ambid.tracking.order import BlockOrder, Ledger, Part, SampleClock

Mask = NDArray[np.bool_]

ABSURD = 1e15  # no quantity of a bearing in SI units is that large; squares stay far from overflow
_NORMAL_RUN = 20  # a channel with longer runs in normal work (coarse steps, a set point) is not watched
_LEARN = 2000  # samples of normal work before a channel is watched
_SHORTEST = 16  # repetitions below this are never called frozen
_FACTOR = 4  # a frozen run is that many times longer than the longest normal one
_NEVER = np.iinfo(np.int64).max


class RowCheck:
    """Judges rows in order, remembering what each channel last held and how long; `limits`: largest credible
    magnitudes, SI; `watched`: which channels may not freeze, default all.
    """

    def __init__(
        self, n_channels: int, *, limits: ArrayLike | None = None, watched: Sequence[bool] | None = None
    ) -> None:
        if n_channels < 1:
            raise EstimationError(f"the stream has {n_channels} channels; it needs at least one. Correct n_channels")
        try:
            self._limits = np.full(n_channels, ABSURD if limits is None else np.asarray(limits, dtype=np.float64))
        except ValueError:
            self._limits = np.array([np.nan])
        if not (self._limits > 0).all():
            raise EstimationError(
                f"limits does not hold a positive number for each of {n_channels} channels. Correct it"
            )
        self._limits = np.minimum(self._limits, np.finfo(np.float64).max)
        self._widest = float(self._limits.min())
        self._learns = np.ones(n_channels, dtype=bool) if watched is None else np.array(watched, dtype=bool)
        if self._learns.shape != (n_channels,):
            raise EstimationError(f"watched does not hold a word for each of {n_channels} channels. Correct it")
        self._threshold = np.full(n_channels, _NEVER)  # samples
        self._usual = np.ones(n_channels, dtype=np.int64)  # longest run in normal work
        self._moving = np.zeros(n_channels, dtype=np.int64)  # samples of normal work
        self._last = np.full(n_channels, np.nan)
        self._run = np.zeros(n_channels, dtype=np.int64)

    def judge(self, values: Array, *, last: bool = False) -> tuple[dict[RowKind, Mask], int]:
        """Say which of the next rows (n_samples, n_channels) must not be used, by kind, each row in one and no kind
        empty, and how many at the end are undecided and have to be given again before the next.
        """
        refused: dict[RowKind, Mask] = {}
        # The peak is NaN if anything is: one comparison tells that all is well.
        if not np.abs(values).max() <= self._widest:
            _add(refused, "nan", ~np.isfinite(values))
            _add(refused, "range", np.abs(values) > self._limits)
        if not self._learns.any():
            return refused, 0
        stuck, undecided = self._frozen(self._filled(values) if "nan" in refused else values, last)
        if stuck is not None:
            _add(refused, "stuck", stuck[:, None])
        return refused, undecided

    def _filled(self, values: Array) -> Array:
        """Return the values with each one that is not a number replaced by the one before: no frozen run ends there."""
        finite = np.isfinite(values)
        at = np.maximum.accumulate(np.where(finite, np.arange(values.shape[0])[:, None], -1), axis=0)
        return np.where(at >= 0, np.take_along_axis(values, np.maximum(at, 0), axis=0), self._last)

    def _frozen(self, values: Array, last: bool) -> tuple[Mask | None, int]:
        """Return the rows of frozen runs (None without any) and the undecided rows; learn normal runs."""
        n = values.shape[0]
        same = np.empty(values.shape, dtype=bool)
        np.equal(values[0], self._last, out=same[0])
        np.equal(values[1:], values[:-1], out=same[1:])
        if not same.any():
            ended = np.maximum(self._run, 1)  # at most the runs before this block ended
            if (self._learns & (self._moving < _LEARN)).any() or (ended > self._usual).any():
                for learning in np.flatnonzero(self._learns).tolist():
                    self._learn(learning, ended[learning : learning + 1], n, 1)
            self._last[:], self._run[:] = values[-1], 1
            return None, 0
        stuck = np.zeros(n, dtype=bool)
        lengths = np.empty(values.shape, dtype=np.int64)
        undecided = 0
        for j in range(values.shape[1]):
            trailing = self._channel(j, same[:, j], lengths[:, j], stuck)
            undecided = max(undecided, 0 if last else trailing)
        decided = n - undecided
        if decided:
            self._last[:], self._run[:] = values[decided - 1], lengths[decided - 1]
        return (stuck if stuck.any() else None), undecided

    def _channel(self, j: int, same: Mask, lengths: NDArray[np.int64], stuck: Mask) -> int:
        """Fill in the running length of each row's run, mark frozen rows, and return the undecided ones at the end."""
        n = same.size
        rows = np.arange(n)
        change = np.where(same, -1, rows)
        start = np.maximum.accumulate(change)  # -1 while the run of the rows before goes on
        lengths[:] = np.where(start < 0, self._run[j] + rows + 1, rows - start + 1)
        ends = np.flatnonzero(~np.append(same[1:], False))  # the last one may go on in the next block
        total = lengths[ends]
        frozen = total >= self._threshold[j]
        if frozen.any():
            size = np.diff(np.concatenate([[-1], ends]))
            stuck |= np.repeat(frozen, size) & same
        if self._learns[j]:
            self._learn(j, total[:-1], n, int(total[-1]))
        undecided = bool(same[-1]) and not frozen[-1] and self._threshold[j] < _NEVER
        return n - 1 - int(start[-1]) if undecided else 0

    def _learn(self, j: int, finished: NDArray[np.int64], n: int, going: int) -> None:
        """Learn from runs of one channel that ended, and from the one that goes on."""
        below = finished[finished < self._threshold[j]]
        longest = max(int(below.max(initial=1)), int(self._usual[j]))
        if self._threshold[j] == _NEVER and max(longest, going) > _NORMAL_RUN:
            self._usual[j], self._moving[j] = 1, 0
            return
        self._usual[j] = min(longest, _NORMAL_RUN)
        self._moving[j] += n
        if self._moving[j] >= _LEARN:
            self._threshold[j] = max(_SHORTEST, _FACTOR * self._usual[j])


def _add(refused: dict[RowKind, Mask], kind: RowKind, cells: Mask) -> None:
    """Add the rows that hold such a cell and are of no other kind yet."""
    rows = np.asarray(cells.any(axis=1))
    for before in refused.values():
        rows &= ~before
    if rows.any():
        refused[kind] = rows


_LARGEST = 2**62  # of a sample number
_TOLERANCE = 0.75  # of a sample: a stamp rounded to samples lies within half of one
_WHY: Mapping[RowKind, str] = MappingProxyType(
    {
        "nan": "not finite",
        "range": "beyond the credible limits",
        "stuck": "repeating the last value of a channel, which is frozen",
    }
)


class StreamGuard:
    """Takes blocks as they come and gives out clean stretches, later than all before, and a record of what it does not
    give. Up to `reorder` blocks wait for a missing one, and a gap delays as many. After damage the next sound block
    goes on; only counter and clock both set back are taken for a repetition until `patience_s` is over. `limits`:
    largest credible magnitude of each channel, SI; `watched`: as of `RowCheck`; `n_received`: samples that came.
    """

    def __init__(
        self,
        rate_hz: float,
        n_channels: int,
        *,
        limits: ArrayLike | None = None,
        watched: Sequence[bool] | None = None,
        reorder: int = 1,
        patience_s: float = 1.0,
    ) -> None:
        if reorder < 0 or not patience_s > 0:
            raise EstimationError(
                f"a guard with reorder = {reorder}, patience_s = {patience_s} cannot work: reorder must not be"
                " negative, patience positive. Correct it"
            )
        self._rows = RowCheck(n_channels, limits=limits, watched=watched)
        self._clock = SampleClock(rate_hz, _TOLERANCE / max(rate_hz, 1e-300))
        self.rate_hz, self.n_channels = rate_hz, n_channels
        self._ledger = Ledger(rate_hz)
        self._order = BlockOrder(
            rate_hz=rate_hz,
            clock=self._clock,
            depth=reorder,
            patience_s=patience_s,
            ledger=self._ledger,
            place=self._judge,
            broke=self._break,
        )
        self._restart = True
        self._given_to = 0  # end of what was given
        self._undecided: Part | None = None
        self.n_received = 0

    @property
    def events(self) -> Mapping[RejectionKind, int]:
        """Number of rejections of each kind."""
        return MappingProxyType(self._ledger.events)

    @property
    def samples(self) -> Mapping[RejectionKind, int]:
        """Number of samples in the rejections of each kind."""
        return MappingProxyType(self._ledger.samples)

    @property
    def n_given(self) -> int:
        """Number of samples given out."""
        return self._ledger.n_given

    @property
    def n_missing(self) -> int:
        """Number of samples that never came."""
        return self._ledger.samples.get("gap", 0)

    @property
    def n_rejected(self) -> int:
        """Number of samples that came and were not given."""
        return sum(self._ledger.samples.values()) - self.n_missing

    @property
    def n_waiting(self) -> int:
        """Number of blocks that wait for a missing or a confirming one."""
        return self._order.n_waiting

    @property
    def drift(self) -> float:
        """Relative deviation of the acquisition's clock from the stated rate."""
        return self._clock.drift

    def take(self, block: Block) -> list[Passed]:
        """Take in a block, possibly damaged, neither modified nor kept; returns what follows in order, perhaps nothing
        yet.
        """
        part = self._part(block)
        if part is not None:
            self._order.take(part)
        return self._ledger.taken()

    def flush(self) -> list[Passed]:
        """Give out what waits: at the end of the stream."""
        self._order.finish()
        part, self._undecided = self._undecided, None
        if part is not None:
            self._give(part.first, part.values, self._rows.judge(part.values, last=True)[0])
        return self._ledger.taken()

    def _part(self, block: Block) -> Part | None:
        """Return the block under its number in the stream; None, with a rejection, if it is no block of this stream."""
        raw: object = block.values
        size = int(raw.shape[0]) if isinstance(raw, np.ndarray) and raw.ndim else 0
        self.n_received += size
        try:
            number = index(block.first)
        except TypeError:
            number = _LARGEST
        if not -_LARGEST < number < _LARGEST:
            why = f"the block claims to start at sample {str(block.first)[:40]}"
            self._ledger.reject("number", size, self._order.next, why)
            return None
        number += self._order.offset
        try:
            time_s = float(block.time_s)
        except (TypeError, ValueError, OverflowError):
            time_s = float("nan")
        wrong: tuple[RejectionKind, str]
        if not isinstance(raw, np.ndarray) or raw.dtype != np.float64:
            wrong = "type", f"the block holds {getattr(raw, 'dtype', type(raw).__name__)}, not float64"
        elif raw.ndim != 2 or raw.shape[1] != self.n_channels:
            wrong = "shape", f"the block has shape {raw.shape}; the stream has {self.n_channels} channels"
        elif not size:
            wrong = "empty", "the block holds no sample"
        else:
            return Part(first=number, time_s=time_s, values=np.array(raw, dtype=np.float64, order="C"))
        self._ledger.reject(wrong[0], size, self._order.next, wrong[1])
        stamp = Part(first=number, time_s=time_s, values=np.empty((size, 0)))
        if self._order.fits(stamp):
            self._order.pass_over(stamp)
        return None

    def _judge(self, part: Part) -> None:
        """Give out the sound rows of a part that is next; undecided ones wait for the part after it."""
        if self._undecided is not None and self._undecided.end == part.first:
            whole = np.vstack([self._undecided.values, part.values])
            part = Part(first=self._undecided.first, time_s=part.time_s, values=whole)
            self._undecided = None
        self._drop_undecided()
        refused, undecided = self._rows.judge(part.values)
        n = part.size - undecided
        if undecided:
            self._undecided = Part(first=part.first + n, time_s=part.time_s, values=part.values[n:])
        if n:
            self._give(part.first, part.values[:n], {kind: rows[:n] for kind, rows in refused.items()})

    def _drop_undecided(self) -> None:
        """Refuse rows that repeat the last value of a channel when nothing follows to tell whether it was frozen."""
        part, self._undecided = self._undecided, None
        if part is not None:
            why = f"{counted(part.size, 'sample')} from {part.first} on repeat the last value of a channel up to a gap"
            self._ledger.reject("stuck", part.size, part.first, why)

    def _break(self) -> None:
        """Let the next stretch restart, whatever its number."""
        self._drop_undecided()
        self._restart = True

    def _give(self, first: int, values: Array, refused: Mapping[RowKind, Mask]) -> None:
        """Give out each run of sound rows."""
        sound = np.ones(values.shape[0], dtype=bool)
        for kind, rows in refused.items():
            count = int(rows.sum())
            if count:
                sound &= ~rows
                at = first + int(np.argmax(rows))
                self._ledger.reject(kind, count, at, f"{counted(count, 'sample')} from {at} on: {_WHY[kind]}")
        edges = [0, values.shape[0]]
        if refused:
            edges = np.flatnonzero(np.diff(np.concatenate([[0], sound.astype(np.int8), [0]]))).tolist()
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            restart = self._restart or first + start != self._given_to
            self._ledger.give(Stretch(values=values[start:stop], first=first + start, restart=restart))
            self._restart, self._given_to = False, first + stop
