"""One place where estimators hand in their results, so that none forgets what a reader has to know."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.model import BlackBoxModel
from ambid.blackbox.orders import UsedOrders
from ambid.blackbox.response import Offsets
from ambid.blackbox.structures import structure
from ambid.errors import EstimationError


def made(
    name: str,
    data: IOData,
    *,
    orders: UsedOrders,
    model: BlackBoxModel,
    covariance: Array | None,
    n_estimated: int,
    offsets: Offsets,
    noise_covariance: Array,
    status: Literal["converged", "stalled"] = "converged",
    warnings: Sequence[str] = (),
    details: Mapping[str, object] | None = None,
) -> BlackBoxFit:
    """Put the result of an estimator together.

    `name`: structure, as in the register; `data`: what it was estimated from; `orders`: as used, delays included;
    `noise_covariance`: (n_outputs, n_outputs), SI. Returns with a warning where the structure is biased under feedback
    and the data are not said to be open loop.
    """
    if not np.all(np.isfinite(model.theta)) or not np.all(np.isfinite(noise_covariance)):
        raise EstimationError(f"{name}: no finite coefficients fit this record. Lower the orders, or check the columns")
    found = list(warnings)
    if status != "converged":
        found.insert(0, "the search did not converge: treat the numbers as a first guess")
    if structure(name).feedback == "biased" and data.n_inputs and not data.open_loop:
        found.append(
            f"{name} is biased where a controller was at work, and nothing says that this record is open loop: "
            "use bj, armax or pbsid, or say --open-loop if there was no feedback"
        )
    return BlackBoxFit(
        structure=name,
        orders=dict(orders),
        model=model,
        covariance=covariance,
        n_estimated=n_estimated,
        offsets=offsets,
        noise_covariance=np.asarray(noise_covariance, dtype=np.float64),
        inputs=data.inputs,
        outputs=data.outputs,
        units=dict(data.units),
        dt=data.dt,
        record=dict(data.record),
        status=status,
        warnings=tuple(found),
        details={} if details is None else dict(details),
    )
