"""The core under every estimator: problem, search, predictor, uncertainty, the estimate."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.estimation.estimate import Estimate as Estimate
    from ambid.estimation.estimate import estimate_from_json as estimate_from_json
    from ambid.estimation.estimate import estimate_to_json as estimate_to_json

__getattr__, __dir__, __all__ = exports(__name__)
