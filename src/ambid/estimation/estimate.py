"""The estimate: parameters with covariance, model, fit, checks, warnings, timings, provenance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.estimation.documents import (
    check_schema,
    covariance_apart,
    covariance_together,
    fields_json,
    json_text,
    read_as,
    read_whole,
)
from ambid.estimation.parts import Check, Delay, EstimatedParameter, Judged, OutputFit, Parametric
from ambid.physics.models import model


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Continuous:
    """Identified continuous-time plant x' = A x + B u, y = C x in SI units."""

    states: tuple[str, ...]
    A: Array  # (n_states, n_states)
    B: Array  # (n_states, n_inputs)
    C: Array  # (n_outputs, n_states)
    poles: NDArray[np.complex128]  # (n_states,), complex, rad/s


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoiseModel:
    """Noise as the predictor describes it, SI units."""

    # sensor noise alone; disturbance and sensor levels; or a free predictor gain
    form: Literal["sensors", "levels", "gain"]
    gain: Array  # (n_states, n_outputs), predictor gain K of x[k+1] = A x[k] + B u + K e[k]
    innovation_covariance: Array  # (n_outputs, n_outputs)
    disturbance_sd: Mapping[str, float]  # held-over-a-sample disturbances and sensor noise; empty for a free gain
    sensor_sd: Mapping[str, float]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate(Parametric, Judged):
    """Result of the main job.

    Attributes
    ----------
    status : {"converged", "stalled", "failed"}
    model : str
    record : Mapping[str, object]
        ``samples``, ``rate_hz``, ``sha256``, ``file`` and history of the record.
    parameters : tuple of EstimatedParameter
        In the model's order.
    covariance_names : tuple of str
        Estimated parameters, order of `covariance`.
    covariance : ndarray, shape (n, n), SI
        Of the estimated parameters, as used for their standard deviations.
    covariance_method : {"information", "robust"}
    delay : Mapping[str, Delay]
        By input role.
    continuous : Continuous
    noise : NoiseModel
    operating_point : Mapping[str, float]
        Means of the record that were taken off, by role, SI.
    fit : Mapping[str, OutputFit]
        By output role.
    checks : Mapping[str, Check]
    validation : Mapping[str, object] or None
        Results on a second record.
    warnings : tuple of str
    timing_s : Mapping[str, float]
    information : Mapping[str, object]
        Singular values of the scaled information matrix and the weakest direction.
    rig : Mapping[str, object]
        Name and channels of the rig, so that another record can be judged alike.
    global_search : Mapping[str, object] or None
        What a global search did where the ordinary starts failed: ``why``, ``evaluations``, ``seconds``,
        ``criterion_before`` and ``criterion_after`` (per sample; None where there was none), ``taken``,
        ``interrupted``. None: it was not needed.
    """

    status: Literal["converged", "stalled", "failed"]
    model: str
    record: Mapping[str, object]
    parameters: tuple[EstimatedParameter, ...]
    covariance_names: tuple[str, ...]
    covariance: Array
    covariance_method: Literal["information", "robust"]
    delay: Mapping[str, Delay]
    continuous: Continuous
    noise: NoiseModel
    operating_point: Mapping[str, float]
    fit: Mapping[str, OutputFit]
    checks: Mapping[str, Check]
    validation: Mapping[str, object] | None = None
    warnings: tuple[str, ...] = ()
    timing_s: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    information: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    rig: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    global_search: Mapping[str, object] | None = None

    def dumps(self) -> str:
        """Return the estimate as JSON text, schema ``ambid.estimate/1``.

        Returns
        -------
        str
        """
        return estimate_text(self)


SCHEMA = "ambid.estimate/1"


def estimate_text(estimate: Estimate) -> str:
    """Return the JSON text of an estimate."""
    return json_text(estimate_to_json(estimate))


def estimate_to_json(estimate: Estimate) -> dict[str, Any]:
    """Return an estimate in the form of schema ``ambid.estimate/1``: SI values, JSON numbers only.

    Parameters
    ----------
    estimate : Estimate

    Returns
    -------
    dict
    """
    return {"schema": SCHEMA, **covariance_together(fields_json(estimate))}


def estimate_from_json(document: Mapping[str, Any], where: str) -> Estimate:
    """Read an estimate back.

    Parameters
    ----------
    document : Mapping
        Parsed JSON of schema ``ambid.estimate/1``.
    where : str
        Name of the file, for messages.

    Returns
    -------
    Estimate

    Raises
    ------
    EstimationError
        If the document is not an estimate, or lacks an entry.
    """
    check_schema(document, SCHEMA, where, "an estimate", "identify")

    def read() -> Estimate:
        estimate = read_as(Estimate, covariance_apart(document))
        _check_consistent(estimate)
        return estimate

    return read_whole(read, where, "estimate", "identify")


def _check_consistent(estimate: Estimate) -> None:
    """Raise ValueError where the parts do not belong together: an edited file, or one of another program."""
    plant = model(estimate.model)
    specs = {p.name: p for p in plant.parameters}
    n, n_y = len(plant.states), len(plant.outputs)
    if [p.name for p in estimate.parameters] != list(specs):
        raise ValueError(f"the parameters are not those of model {estimate.model!r}")
    for p in estimate.parameters:
        if p.unit != specs[p.name].unit:
            raise ValueError(f"{p.name} is in {p.unit!r} instead of {specs[p.name].unit!r}")
        if not 1e-15 < abs(p.value) < 1e15 and (p.name in ("m", "L") or p.value != 0):
            raise ValueError(f"{p.name} = {p.value:g} is no number that a plant can have")
    if estimate.noise.gain.shape != (n, n_y) or estimate.noise.innovation_covariance.shape != (n_y, n_y):
        raise ValueError("the noise model is not of the model's size")
    size = len(estimate.covariance_names)
    if set(estimate.covariance_names) - set(specs) or estimate.covariance.shape != (size, size):
        raise ValueError("the covariance is not of the parameters")
    if not float(str(estimate.record["rate_hz"])) > 0 or estimate.status not in ("converged", "stalled"):
        raise ValueError("the record's rate or the status is not that of a finished estimate")
    for delay in (estimate.delay[role] for role in plant.inputs):
        if not 0 <= delay.samples < 10**6 or not 0 <= delay.fraction < 1:
            raise ValueError("the delay is not whole samples and a fraction")
