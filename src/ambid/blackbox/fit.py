"""The result of every black-box estimator: model, covariance, fit, criteria, checks, warnings, provenance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.model import BlackBoxModel
from ambid.blackbox.orders import UsedOrders
from ambid.blackbox.response import Offsets
from ambid.estimation.estimate import Check, OutputFit


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BlackBoxFit:
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

    structure: str
    orders: UsedOrders
    model: BlackBoxModel
    covariance: Array | None
    n_estimated: int
    offsets: Offsets
    noise_covariance: Array
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: Mapping[str, str]
    dt: float
    record: Mapping[str, object]
    status: Literal["converged", "stalled"] = "converged"
    fit: Mapping[str, OutputFit] = field(default_factory=lambda: MappingProxyType({}))
    criteria: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    checks: Mapping[str, Check] = field(default_factory=lambda: MappingProxyType({}))
    validation: Mapping[str, object] | None = None
    warnings: tuple[str, ...] = ()
    timing_s: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    details: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def sd(self) -> Array | None:
        """Standard deviation of ``model.theta``, shape (n_theta,), or None."""
        return None if self.covariance is None else np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def passed(self) -> bool:
        """Whether the search converged and every check passed."""
        return self.status == "converged" and all(c.passed for c in self.checks.values())
