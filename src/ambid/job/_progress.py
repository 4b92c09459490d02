"""Progress of a job: the name of its present stage, for whoever wants to know."""

from __future__ import annotations

from collections.abc import Callable

Tick = Callable[[str], None]


def silent(stage: str) -> None:
    """Report no progress."""
    del stage
