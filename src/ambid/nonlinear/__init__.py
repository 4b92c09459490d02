"""Nonlinear models: lagged models and the state-space network."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.nonlinear.fit import NonlinearFit as NonlinearFit
    from ambid.nonlinear.fit import NonlinearModel as NonlinearModel
    from ambid.nonlinear.polynomial import select_terms as select_terms

__getattr__, __dir__, __all__ = exports(__name__)
