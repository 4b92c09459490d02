"""One place where fits to a frequency response hand in their results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.frequency.lines import Lines
from ambid.blackbox.model import BlackBoxModel
from ambid.blackbox.orders import UsedOrders
from ambid.blackbox.response import Offsets
from ambid.errors import EstimationError
from ambid.signals.response import FrequencyResponse


def made_from_lines(
    name: str,
    frf: FrequencyResponse,
    checked: Lines,
    *,
    orders: UsedOrders,
    model: BlackBoxModel,
    covariance: Array,
    cost: float,
    n_estimated: int,
    offsets: Offsets,
    converged: bool = True,
    best: bool = True,
    details: Mapping[str, object] | None = None,
    warnings: Sequence[str] = (),
) -> BlackBoxFit:
    """Put the result of a fit to a frequency response together.

    Such a fit has no innovations: `noise_covariance` is zero, and nothing is said of a predictor. What the noise does
    stands in the covariance of the response, and from there in that of the coefficients.

    `name`: structure; `covariance`: (n_theta, n_theta); `cost`: sum of e^H C^-1 e at the model. Returns with the check
    ``cost``; a warning where it fails.
    """
    if not np.all(np.isfinite(model.theta)) or not np.all(np.isfinite(covariance)):
        raise EstimationError(
            f"{name}: no finite coefficients fit these lines. Lower the orders, or check the response"
        )
    check = checked.verdict(cost, n_estimated)
    found = [*warnings, *frf.warnings]
    if not converged:
        found.insert(0, "the search did not converge: treat the numbers as a first guess")
    if not check.passed:
        say = "standard deviations hold for noise alone" if best else "or only the start of a search: refine it"
        found.insert(0, f"{name}: {check.detail}; {say}")
    return BlackBoxFit(
        structure=name,
        orders=dict(orders),
        model=model,
        covariance=covariance,
        n_estimated=n_estimated,
        offsets=offsets,
        noise_covariance=np.zeros((frf.n_outputs, frf.n_outputs)),
        inputs=frf.inputs,
        outputs=frf.outputs,
        units=dict(frf.units),
        dt=checked.dt,
        record={"lines": checked.n_lines, "rate_hz": frf.rate_hz, "method": frf.method, "hold": frf.hold},
        status="converged" if converged else "stalled",
        checks={"cost": check},
        warnings=tuple(found),
        details={**dict(check.values), "p": check.p, **({} if details is None else dict(details))},
    )
