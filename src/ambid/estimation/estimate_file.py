"""The estimate as JSON, schema ``ambid.estimate/1`` (contracts.md): SI values, units named, numbers only."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ambid.estimation.documents import (
    check_schema,
    covariance_apart,
    covariance_together,
    fields_json,
    json_text,
    read_as,
    read_whole,
)
from ambid.estimation.estimate import Estimate
from ambid.physics.models import model

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
