"""Guard of a stream: whatever happens to the blocks, only clean samples under their right numbers go on, in order.

Three judgements: is it a block of this stream, where does it belong (order.py), and which rows are sound (rows.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isinf
from operator import index
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.track.stream.block import Block
from ambid.track.stream.clock import SampleClock
from ambid.track.stream.order import BlockOrder
from ambid.track.stream.outcome import Ledger, Part, Passed, RejectionKind, RowKind, Stretch
from ambid.track.stream.rows import Mask, RowCheck, Stuck

_LARGEST = 2**62  # of a sample number
_TOLERANCE = 0.75  # of a sample: a stamp rounded to samples lies within half of one
_WHY: Mapping[RowKind, str] = MappingProxyType(
    {
        "nan": "hold a value that is not finite",
        "range": "are beyond the credible limits",
        "saturated": "lie at a rail",
        "stuck": "repeat the last value of a channel: it is frozen",
    }
)


class StreamGuard:
    """Takes blocks as they come and gives out clean stretches, with a record of everything that it does not give.

    Every sample given out stands under its own number, later than all before. Blocks in wrong order are put right as
    far as `reorder` blocks wait for a missing one. After any damage the stream goes on with the next sound block; only
    an acquisition that sets both its counter and its clock back is taken for a repetition until `patience_s` is over.
    Without stamps a single wrong number is noticed only if it leads by more than one second.

    `limits`: (n_channels,), or float, largest credible magnitude of each channel, SI; `saturation`: (n_channels, 2),
    rails of each channel; NaN for none; `reorder`: blocks that may wait for a missing one; a gap delays as many;
    `counter_bits`: width of a sample counter that wraps around, e.g. 32.

    `n_received`: samples that came.
    """

    def __init__(
        self,
        rate_hz: float,
        n_channels: int,
        *,
        limits: ArrayLike | None = None,
        saturation: ArrayLike | None = None,
        stuck: Stuck = "auto",
        reorder: int = 1,
        clock_tolerance_s: float | None = None,
        counter_bits: int | None = None,
        patience_s: float = 1.0,
    ) -> None:
        if reorder < 0 or not patience_s > 0 or (counter_bits is not None and not 8 <= counter_bits <= 62):
            raise EstimationError(
                f"a guard with reorder = {reorder}, patience_s = {patience_s}, counter_bits = {counter_bits} cannot"
                " work: reorder must not be negative, patience positive, a counter of 8 to 62 bits. Correct it"
            )
        self._rows = RowCheck(n_channels, limits=limits, saturation=saturation, stuck=stuck)
        tolerance = _TOLERANCE / max(rate_hz, 1e-300) if clock_tolerance_s is None else clock_tolerance_s
        self._clock = SampleClock(rate_hz, tolerance)
        self.rate_hz, self.n_channels = rate_hz, n_channels
        self._wrap = None if counter_bits is None else 1 << counter_bits
        self._ledger = Ledger(rate_hz)
        self._order = BlockOrder(
            rate_hz=rate_hz,
            clock=None if isinf(tolerance) else self._clock,
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
    def n_reordered(self) -> int:
        """Number of blocks that had been missed and came in time."""
        return self._order.n_reordered

    @property
    def n_waiting(self) -> int:
        """Number of blocks that wait for a missing or a confirming one."""
        return self._order.n_waiting

    @property
    def drift(self) -> float:
        """Relative deviation of the acquisition's clock from the stated rate."""
        return self._clock.drift

    def take(self, block: Block) -> list[Passed]:
        """Take in a block.

        `block`: possibly damaged; not modified and not kept. Returns in the order of the stream; may be empty while a
        block waits.
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
        number = self._number(block.first)
        if number is None:
            why = f"the block says that it begins at sample {str(block.first)[:40]}"
            self._ledger.reject("number", size, self._order.next, why)
            return None
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

    def _number(self, first: object) -> int | None:
        """Return a block's number in the stream, unwrapped; None if it is none."""
        try:
            number = index(first)  # type: ignore[arg-type]
        except TypeError:
            return None
        if self._wrap is None:
            return number + self._order.offset if -_LARGEST < number < _LARGEST else None
        if not 0 <= number < self._wrap:
            return None
        near = self._order.near
        if near is None:
            return number
        half = self._wrap // 2
        return near + (number + self._order.offset - near + half) % self._wrap - half

    def _judge(self, part: Part) -> None:
        """Give out the sound rows of a part that is next; undecided ones wait for the part after it."""
        if self._undecided is not None and self._undecided.end == part.first:
            whole = np.vstack([self._undecided.values, part.values])
            part = Part(first=self._undecided.first, time_s=part.time_s, values=whole)
            self._undecided = None
        self._drop_undecided()
        found, held = self._rows.judge(part.values)
        n = part.size - held
        if held:
            self._undecided = Part(first=part.first + n, time_s=part.time_s, values=part.values[n:])
        if n:
            self._give(part.first, part.values[:n], {kind: rows[:n] for kind, rows in found.items()})

    def _drop_undecided(self) -> None:
        """Refuse rows that repeat the last value of a channel when nothing follows to tell whether it was frozen."""
        part, self._undecided = self._undecided, None
        if part is not None:
            why = f"{part.size} samples from {part.first} on repeat the last value of a channel up to a gap"
            self._ledger.reject("stuck", part.size, part.first, why)

    def _break(self) -> None:
        """Let the next stretch restart, whatever its number."""
        self._drop_undecided()
        self._restart = True

    def _give(self, first: int, values: Array, found: Mapping[RowKind, Mask]) -> None:
        """Give out each run of sound rows."""
        sound = np.ones(values.shape[0], dtype=bool)
        for kind, rows in found.items():
            count = int(rows.sum())
            if count:
                sound &= ~rows
                at = first + int(np.argmax(rows))
                self._ledger.reject(kind, count, at, f"{count} samples from {at} on {_WHY[kind]}")
        for start, stop in [(0, values.shape[0])] if not found else _runs(sound):
            restart = self._restart or first + start != self._given_to
            self._ledger.give(Stretch(values=values[start:stop], first=first + start, restart=restart))
            self._restart, self._given_to = False, first + stop


def _runs(sound: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return (start, stop) of every run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], sound.astype(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
