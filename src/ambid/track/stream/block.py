"""A block of samples on its way from acquisition to tracking."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Block:
    """Consecutive samples of all channels.

    Attributes
    ----------
    first : int
        Number of the first sample since acquisition began: what the controller counts.
    time_s : float
        Time of the first sample by the acquisition's clock, s.
    values : ndarray, shape (n_samples, n_channels), SI
        In the order of the stream's channels; may hold NaN.
    """

    first: int
    time_s: float
    values: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """A block with the time at which it was there.

    Attributes
    ----------
    block : Block
    arrived_s : float
        When its last sample was there, by `time.perf_counter`, which all processes of a machine share, s.
    """

    block: Block
    arrived_s: float
