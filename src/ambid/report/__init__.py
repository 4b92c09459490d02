"""Tables, figures and pages: what people look at."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.report.drawing import save as save
    from ambid.report.track_figures import track_figure as track_figure

__getattr__, __dir__, __all__ = exports(__name__)
