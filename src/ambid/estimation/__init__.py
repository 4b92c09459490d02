"""The core under every estimator: problem, search, predictor, uncertainty, the estimate."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.estimation.estimate import Estimate as Estimate
    from ambid.estimation.estimate import estimate_from_json as estimate_from_json
    from ambid.estimation.estimate import estimate_to_json as estimate_to_json
    from ambid.estimation.result import Linear as Linear
    from ambid.estimation.result import Predicting as Predicting
    from ambid.estimation.result import Result as Result
    from ambid.estimation.result import Simulating as Simulating

__getattr__, __dir__, __all__ = exports(__name__)
