"""Progress of a job: the same calls as those of a search, defined there."""

from __future__ import annotations

from ambid.estimation.progress import Tick, silent

__all__ = ["Tick", "silent"]
