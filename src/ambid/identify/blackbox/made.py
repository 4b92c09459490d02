"""One place where estimators hand in their results, so that none forgets what a reader has to know."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.errors import EstimationError
from ambid.identify.blackbox.data import IOData
from ambid.identify.blackbox.fit import BlackBoxFit
from ambid.identify.blackbox.model import BlackBoxModel
from ambid.identify.blackbox.orders import UsedOrders
from ambid.identify.blackbox.response import Offsets
from ambid.identify.blackbox.structures import structure

Array = NDArray[np.float64]


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

    Parameters
    ----------
    name : str
        Structure, as in the register.
    data : IOData
        What it was estimated from.
    orders : Mapping[str, int or tuple of int]
        As used, delays included.
    model : BlackBoxModel
    covariance : ndarray, shape (n_theta, n_theta) or None
    n_estimated : int
    offsets : Offsets
    noise_covariance : ndarray, shape (n_outputs, n_outputs), SI
    status : {"converged", "stalled"}
    warnings : sequence of str
    details : Mapping[str, object], optional

    Returns
    -------
    BlackBoxFit
        With a warning where the structure is biased under feedback and the data are not said to be open loop.

    Raises
    ------
    EstimationError
        If a coefficient or the noise is not a finite number.
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
