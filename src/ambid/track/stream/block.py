"""A block of samples on its way from acquisition to tracking."""

from __future__ import annotations

from dataclasses import dataclass

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
