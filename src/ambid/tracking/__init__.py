"""On-line identification under supervision: evidence, filter, change detection, gate, stream."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.tracking.lines_file import read_track as read_track

__getattr__, __dir__, __all__ = exports(__name__)
