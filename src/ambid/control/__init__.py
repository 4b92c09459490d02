"""The loop as it is: its controller, sensitivity, margins and compliance."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.control.acceptance import Acceptance as Acceptance
    from ambid.control.design import Design as Design
    from ambid.control.experiment import Experiment as Experiment
    from ambid.control.margins import Margins as Margins

__getattr__, __dir__, __all__ = exports(__name__)
