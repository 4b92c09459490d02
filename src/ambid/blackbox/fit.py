"""The result of every black-box estimator, and how an estimator builds it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData, UsedOrders
from ambid.blackbox.model import BlackBoxModel
from ambid.blackbox.response import Offsets
from ambid.blackbox.structures import structure
from ambid.errors import EstimationError
from ambid.estimation.parts import FittedModel


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BlackBoxFit(FittedModel):
    """An identified black-box model, file schema ``ambid.fit/1``.

    Attributes
    ----------
    structure : str
        Name in `ambid.blackbox.structures`.
    orders : Mapping[str, int or tuple of int]
        ``na``, ``nb`` ..., or ``n``; a tuple where inputs differ.
    model : BlackBoxModel
        PolynomialModel, StateSpaceModel or TransferModel, for deviations from `offsets`.
    covariance : ndarray, shape (n_theta, n_theta) or None
        Of ``model.theta``; zeros where a coefficient was not estimated. None where the method has none to give.
    n_estimated : int
        Numbers that were estimated, offsets and initial states not counted.
    offsets : Offsets
        Operating point, SI.
    noise_covariance : ndarray, shape (n_outputs, n_outputs), SI
        Of the innovations.
    inputs, outputs : tuple of str
    units : Mapping[str, str]
    dt : float, s
    record : Mapping[str, object]
    status : {"converged", "stalled"}
    fit : Mapping[str, OutputFit]
        By output.
    criteria : Mapping[str, float]
        ``aic``, ``aicc``, ``bic``, ``mdl``, ``fpe``.
    checks : Mapping[str, Check]
    validation : Mapping[str, object] or None
        By output, on a second record.
    warnings : tuple of str
    timing_s : Mapping[str, float]
    details : Mapping[str, object]
        Further results of the method as JSON-able values (singular values, condition numbers, chosen horizons).
    """

    orders: UsedOrders
    model: BlackBoxModel
    offsets: Offsets
    record: Mapping[str, object]
    status: Literal["converged", "stalled"] = "converged"


def build_fit(
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
