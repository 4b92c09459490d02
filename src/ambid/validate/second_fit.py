"""What a second record says against a black-box or nonlinear fit: errors that have grown, and extrapolation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ambid.blackbox.fit import BlackBoxFit
from ambid.nonlinear.fit import NonlinearFit

GROWN = 1.5
"""Times the errors of identification, as for physical estimates."""
OUTSIDE = 0.1
"""Part of the record outside the training data, as for the nonlinear magnet."""


def objections(fit: BlackBoxFit | NonlinearFit, found: Mapping[str, Any]) -> tuple[str, ...]:
    """Return why a fit does not hold on a second record.

    `found`: by output, as `validate.blackbox.judge.validation` or `validate.nonlinear.validation` give it. Returns one
    line each; empty where its one-step errors are at most 1.5 times those at identification, and at most a tenth of the
    record lies outside the training data (which a linear fit does not know).
    """
    said = []
    for name, sizes in found.items():
        one, usual = sizes["one_step"], fit.fit[name].innovation_sd
        if one is None or not math.isfinite(one["rmse"]):
            said.append(f"no one-step prediction of {name} that stays finite")
        elif one["rmse"] > GROWN * usual:
            said.append(
                f"one-step errors of {name} are {one['rmse'] / usual:.3g} times as large as at identification"
                if usual > 0
                else f"one-step errors of {name} are not zero as they were at identification"
            )
    share = max((float(sizes.get("extrapolated", 0.0)) for sizes in found.values()), default=0.0)
    if share > OUTSIDE:
        said.append(f"{100 * share:.2g} % of it lies outside the training data, where standard deviations say nothing")
    return tuple(said)
