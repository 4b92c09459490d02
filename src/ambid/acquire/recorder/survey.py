"""What a journal holds: the first of two passes over it, in constant memory."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ambid.acquire.recorder.header import Event
from ambid.acquire.recorder.reader import Damage, JournalReader


@dataclass(slots=True, kw_only=True)
class Survey:
    """What a journal holds."""

    blocks: int = 0  # blocks, and rows of them that have a place in the record
    samples: int = 0
    first: int = 0  # number of the first sample, and of the one behind the last
    end: int = 0
    start_s: float = 0.0  # time of the first sample, s
    gaps: int = 0  # places where samples are missing, and how many
    gap_samples: int = 0
    misplaced: int = 0  # rows whose numbers were there before
    # largest difference between a block's time and that of its number at the rate of the header, s
    stamp_error_s: float = 0.0
    events: list[Event] = field(default_factory=list)
    damage: Damage = field(default_factory=Damage)

    @property
    def rows(self) -> int:
        """Rows of the record, those of NaN included."""
        return self.end - self.first


def survey(reader: JournalReader) -> Survey:
    """Look through a journal."""
    found = Survey()
    rate = reader.header.rate_hz
    for item in reader.items():
        if isinstance(item, Event):
            found.events.append(item)
            continue
        n = len(item.values)
        if found.blocks == 0:
            found.first = found.end = item.first
            found.start_s = item.time_s if np.isfinite(item.time_s) else item.first / rate
        found.blocks += 1
        if item.first > found.end:
            found.gaps += 1
            found.gap_samples += item.first - found.end
        old = min(max(found.end - item.first, 0), n)
        found.misplaced += old
        found.samples += n - old
        found.end = max(found.end, item.first + n)
        if not old and np.isfinite(item.time_s):
            due = found.start_s + (item.first - found.first) / rate
            found.stamp_error_s = max(found.stamp_error_s, abs(item.time_s - due))
    found.damage = reader.damage
    return found
