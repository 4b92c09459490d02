"""Blocks of samples on their way from acquisition to tracking, and records as streams of them, with all their damage.

Numbers come from the time column where there is one: a stamp k periods after the one before has a number larger by k;
one that runs back means repeated samples (same rows), late ones (they fill a gap), or else a clock set back.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ambid.arrays import Array
from ambid.errors import RecordError
from ambid.record import Record


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Block:
    """Consecutive samples of all channels."""

    first: int  # number of the first sample since acquisition began: what the controller counts
    time_s: float  # time of the first sample by the acquisition's clock, s
    values: Array  # (n_samples, n_channels), SI, in the order of the stream's channels; may hold NaN


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """A block with the time at which it was there."""

    block: Block
    # when its last sample was there, by `time.perf_counter`, which all processes of a machine share, s
    arrived_s: float


RowKind = Literal["nan", "range", "stuck"]
RejectionKind = (
    Literal["gap", "repeated", "overlap", "contradiction", "clock", "number", "shape", "type", "empty"] | RowKind
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stretch:
    """Clean consecutive samples."""

    values: Array  # (n_samples, n_channels), SI, finite, within the limits
    first: int  # number of the first sample
    restart: bool  # whether it does not follow on the last stretch: a memory of the signals must start anew


@dataclass(frozen=True, slots=True, kw_only=True)
class Rejection:
    """What was not given out, or what happened to the stream."""

    # ``gap`` (numbers that never came), ``repeated`` and ``overlap`` (numbers that had been given or passed over),
    # ``contradiction`` (an overlap that differs from what was given), ``clock`` and ``number`` (the block does not fit
    # the stream; without samples: the clock or the counter jumped and the stream goes on), ``shape``, ``type`` and
    # ``empty`` (of the block), ``nan``, ``range`` and ``stuck`` (of rows)
    kind: RejectionKind
    samples: int  # how many
    t: float  # number of the first of them divided by the rate, s
    why: str  # one line for people


Passed = Stretch | Rejection


_LONGEST_GAP_S = 60.0  # or ten times the record: a stamp that leads by more is a clock that was set
_EQUAL = 0.05  # of a period: stamps that are as close are the same
_COARSE = 0.1  # of the rows: so many different ones under equal stamps are no accident
_REMEMBERED = 256  # runs of rows that one that runs back is compared with
_LONGEST_PAUSE_S = 1.0  # a gap in the numbers takes its time, up to this


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Replay:
    """Rows of a record that come as blocks of consecutive numbers. Can be iterated again, and sent to another
    process.
    """

    values: Array  # (n_rows, n_channels), SI, may hold NaN
    numbers: NDArray[np.int64]  # (n_rows,), int64, sample number of each row
    time_s: Array  # (n_rows,), s, stamp of each row
    rate_hz: float
    block_samples: int  # a block is shorter where the numbers do not follow on each other, and at the end

    def since(self, first: int) -> Replay:
        """Return the rows whose numbers are `first` or more, in the order in which they come."""
        rows = self.numbers >= first
        if rows.all():
            return self
        return replace(self, values=self.values[rows], numbers=self.numbers[rows], time_s=self.time_s[rows])

    def __iter__(self) -> Iterator[Block]:
        steps = np.diff(self.numbers)
        jumps = np.abs(np.diff(self.time_s) * self.rate_hz - steps) > 0.5  # of the clock alone
        breaks = np.flatnonzero((steps != 1) | jumps) + 1
        for start, stop in pairwise([0, *breaks.tolist(), self.numbers.size]):
            for k in range(start, stop, self.block_samples):
                end = min(k + self.block_samples, stop)
                yield Block(first=int(self.numbers[k]), time_s=float(self.time_s[k]), values=self.values[k:end])


def blocks_of(
    record: Record,
    block_samples: int,
    *,
    channels: Sequence[str] | None = None,
    time_s: ArrayLike | None = None,
) -> Replay:
    """Return a record, rows as they were written (perhaps NaN), as a stream numbered from 0 at the first row;
    `block_samples`: samples of a block; `channels`: which, in which order, default all; `time_s`: (n_samples,).
    """
    if block_samples < 1:
        raise RecordError(f"a block of {block_samples} samples holds nothing; it must have at least one. Correct it")
    names = record.names if channels is None else tuple(channels)
    values = np.column_stack([record[name].values for name in names])
    if time_s is None:
        numbers, stamps = np.arange(record.n_samples, dtype=np.int64), record.time_s
    else:
        stamps = np.array(time_s, dtype=np.float64)
        if stamps.shape != (record.n_samples,):
            raise RecordError(
                f"{stamps.size} time stamps do not fit {record.n_samples} samples; each row has one. Correct time_s"
            )
        numbers, placed = numbers_from_time(stamps, values, record.rate_hz)
        values[~placed] = np.nan
        stamped = np.flatnonzero(np.isfinite(stamps))
        last = stamped[np.maximum(np.searchsorted(stamped, np.arange(stamps.size), side="right") - 1, 0)]
        stamps = np.where(np.isfinite(stamps), stamps, stamps[last] + (numbers - numbers[last]) / record.rate_hz)
    values.flags.writeable = False
    return Replay(
        values=values,
        numbers=numbers,
        time_s=stamps,
        rate_hz=record.rate_hz,
        block_samples=block_samples,
    )


def numbers_from_time(time_s: Array, values: Array, rate_hz: float) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Number the rows of a damaged record by their stamps; `values` tell repeated rows from a clock that was set back.
    Returns int64 `numbers`, 0 for the first row, those without a stamp following the one before; bool `placed`, false
    where it stays open which samples these are.
    """
    stamped = np.flatnonzero(np.isfinite(time_s))
    rows = np.diff(stamped)
    advance = np.diff(time_s[stamped]) * rate_hz
    if stamped.size < 2 or (np.abs(advance / rows - 1) <= 0.05).sum() * 2 < rows.size:
        raise RecordError(
            f"less than half of the time stamps are one period of {rate_hz:g} Hz apart; samples cannot be numbered."
            " Print time with more digits, or correct the rate"
        )
    equal = stamped[1:][(rows == 1) & (np.abs(advance) <= _EQUAL)]
    coarse = int((values[equal] != values[equal - 1]).any(axis=1).sum())
    if coarse > _COARSE * rows.size:
        raise RecordError(
            f"{coarse} of {time_s.size} rows repeat the time stamp of the row before with other values; at "
            f"{rate_hz:g} Hz they are not separate samples. Print time with more digits, or correct the rate"
        )
    longest = max(_LONGEST_GAP_S * rate_hz, 10.0 * time_s.size)
    whole = np.rint(np.clip(advance, -(2.0**53), 2.0**53)).astype(np.int64)
    whole = np.where(whole > longest, rows, whole)  # the clock was set: nobody waits so long within a record
    placed = np.zeros(time_s.size, dtype=bool)
    placed[stamped] = True
    for k in np.flatnonzero((rows > 1) & (whole == rows)):
        placed[stamped[k] : stamped[k + 1]] = True
    steps = np.ones(time_s.size - 1, dtype=np.int64)
    steps[stamped[1:] - 1] = whole - (rows - 1)
    return _counted(steps, values), placed


def _counted(steps: NDArray[np.int64], values: Array) -> NDArray[np.int64]:
    """Add up the steps; one that runs back counts only if its rows came before, or fill a gap that was left."""
    numbers = np.arange(steps.size + 1, dtype=np.int64)
    runs: deque[tuple[int, int, int]] = deque(maxlen=_REMEMBERED)  # first row, first number, number after the last
    row = number = 0
    for k in (np.flatnonzero(steps != 1) + 1).tolist():
        after = number + k - row
        numbers[row:k] = np.arange(number, after)
        runs.append((row, number, after))
        target = after - 1 + int(steps[k - 1])
        if target < after and not _known(values, k, target, runs):
            target = after  # the clock was set back
        row, number = k, target
    numbers[row:] = np.arange(number, number + numbers.size - row)
    return numbers


def _known(values: Array, k: int, target: int, runs: Sequence[tuple[int, int, int]]) -> bool:
    """Tell whether row k is sample `target` again, or one that was left out after others."""
    for row, first, stop in runs:
        if first <= target < stop:
            before = row + target - first
            n = min(stop - target, values.shape[0] - k, 8)
            if np.array_equal(values[k : k + n], values[before : before + n], equal_nan=True):
                return True
    lowest = min(first for _, first, _ in runs)
    return target > lowest and not any(first <= target < stop for _, first, stop in runs)


def paced(blocks: Iterable[Block], rate_hz: float, *, stopped: Callable[[], bool] = lambda: False) -> Iterator[Frame]:
    """Yield blocks, with the time at which they were due, when an acquisition would have them, until `stopped`, asked
    while waiting, is True. A gap takes its time, at most one second; numbers that run back none but that of their
    samples.
    """
    due, after = time.perf_counter(), None
    for block in blocks:
        n = len(block.values) if np.ndim(block.values) else 0
        first = block.first if isinstance(block.first, int) else None
        gap = (first - after) / rate_hz if first is not None and after is not None else 0.0
        due += n / rate_hz + min(max(gap, 0.0), _LONGEST_PAUSE_S)
        after = first + n if first is not None else after
        while (left := due - time.perf_counter()) > 0:
            if stopped():
                return
            time.sleep(min(left, 0.05))
        yield Frame(block=block, arrived_s=due)
