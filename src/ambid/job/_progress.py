"""Progress of a job: the same calls as those of a search, defined there."""

from __future__ import annotations

from ambid.identify.nonlinear.progress import Tick, silent

__all__ = ["Tick", "silent"]
