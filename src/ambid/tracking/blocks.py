"""Blocks of samples on their way from acquisition to tracking; what a guard gives of them: stretches and rejections."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ambid.arrays import Array


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


RowKind = Literal["nan", "range", "saturated", "stuck"]
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
    # ``empty`` (of the block), ``nan``, ``range``, ``saturated`` and ``stuck`` (of rows)
    kind: RejectionKind
    samples: int  # how many
    t: float  # number of the first of them divided by the rate, s
    why: str  # one line for people


Passed = Stretch | Rejection


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """A block under its number in the stream."""

    first: int  # number of the first sample, with wrap-arounds and new counts taken out
    time_s: float  # its stamp, s; NaN if it has none
    values: Array  # (n_samples, n_channels)

    @property
    def size(self) -> int:
        """Number of samples."""
        return int(self.values.shape[0])

    @property
    def end(self) -> int:
        """Number of the sample after the last."""
        return self.first + int(self.values.shape[0])


class Ledger:
    """Collects what is given in the order of the stream, and counts.

    `rate_hz`: turns sample numbers into times.

    `events`: rejections of each kind, and samples in them; `samples`: rejections of each kind, and samples in them;
    `n_given`: samples in stretches.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate = rate_hz
        self._entries: list[Passed] = []
        self.events: dict[RejectionKind, int] = {}
        self.samples: dict[RejectionKind, int] = {}
        self.n_given = 0

    def reject(self, kind: RejectionKind, samples: int, first: int, why: str) -> None:
        """Enter a rejection.

        `first`: number of the first of them; `why`: one line for people.
        """
        self.events[kind] = self.events.get(kind, 0) + 1
        self.samples[kind] = self.samples.get(kind, 0) + samples
        self._entries.append(Rejection(kind=kind, samples=samples, t=first / self._rate, why=why))

    def give(self, stretch: Stretch) -> None:
        """Enter a stretch."""
        self.n_given += stretch.values.shape[0]
        self._entries.append(stretch)

    def taken(self) -> list[Passed]:
        """Return the entries since the last call."""
        entries, self._entries = self._entries, []
        return entries
