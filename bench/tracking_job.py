"""One job whose speed is measured, and how its result compares with that of a peer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from peers import Array, Bench

BLOCKS = 1000
N_PEER = 20_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Same:
    """How the two results compare, for people, and as numbers."""

    text: str
    numbers: dict[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Job:
    """One job.

    `feed` makes an estimator and returns what takes samples first <= k < stop; `single` what takes sample k. `ask` has
    the peer do `peer_n` samples, all at once or one by one; `compare` sees what it found.
    """

    name: str
    n: int
    feed: Callable[[], Callable[[int, int], object]]
    single: Callable[[], Callable[[int], object]] | None = None
    peer: str = ""
    peer_n: int = N_PEER
    ask: Callable[[Bench, str], dict[str, Any]] | None = None
    peer_single: bool = False
    compare: Callable[[dict[str, Array]], Same] = lambda _: Same(text="–")


def digits(ours: Array, theirs: Array) -> Same:
    """Say to how many digits two results are the same."""
    off = float(np.max(np.abs(ours - theirs) / np.max(np.abs(ours))))
    text = "equal" if off == 0.0 else f"equal to {-np.log10(off):.0f} digits" if off < 0.1 else f"{off:.1g} apart"
    return Same(text=text, numbers={"largest_relative_difference": off})
