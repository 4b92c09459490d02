"""The estimate as JSON, schema ``ambid.estimate/1`` (contracts.md): SI values, units named, numbers only."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from ambid.errors import EstimationError, ModelError
from ambid.estimation.estimate import (
    Continuous,
    Delay,
    Estimate,
    EstimatedParameter,
    NoiseModel,
    OutputFit,
)
from ambid.estimation.json_values import check_from_json, check_json, delay_json, plain_json
from ambid.physics.models import model

SCHEMA = "ambid.estimate/1"


def estimate_text(estimate: Estimate) -> str:
    """Return the JSON text of an estimate."""
    return json.dumps(estimate_to_json(estimate), indent=1, allow_nan=False) + "\n"


def estimate_to_json(estimate: Estimate) -> dict[str, Any]:
    """Return an estimate in the form of schema ``ambid.estimate/1``: SI values, JSON numbers only.

    Parameters
    ----------
    estimate : Estimate

    Returns
    -------
    dict
    """
    poles = estimate.continuous.poles
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "status": estimate.status,
        "record": dict(estimate.record),
        "model": estimate.model,
        "parameters": {p.name: parameter_json(p) for p in estimate.parameters},
        "covariance": {
            "names": list(estimate.covariance_names),
            "matrix": estimate.covariance.tolist(),
            "method": estimate.covariance_method,
        },
        "delay": {role: delay_json(d) for role, d in estimate.delay.items()},
        "continuous": {
            "states": list(estimate.continuous.states),
            "A": estimate.continuous.A.tolist(),
            "B": estimate.continuous.B.tolist(),
            "C": estimate.continuous.C.tolist(),
            "poles": [[float(p.real), float(p.imag)] for p in poles],
        },
        "noise": {
            "form": estimate.noise.form,
            "gain": estimate.noise.gain.tolist(),
            "innovation_covariance": estimate.noise.innovation_covariance.tolist(),
            "disturbance_sd": dict(estimate.noise.disturbance_sd),
            "sensor_sd": dict(estimate.noise.sensor_sd),
        },
        "operating_point": dict(estimate.operating_point),
        "fit": {
            role: {"one_step": f.one_step, "simulation": f.simulation, "innovation_sd": f.innovation_sd}
            for role, f in estimate.fit.items()
        },
        "checks": {name: check_json(c) for name, c in estimate.checks.items()},
        "information": dict(estimate.information),
        "validation": None if estimate.validation is None else dict(estimate.validation),
        "warnings": list(estimate.warnings),
        "timing_s": dict(estimate.timing_s),
        "rig": dict(estimate.rig),
        "global_search": None if estimate.global_search is None else dict(estimate.global_search),
    }
    return {name: plain_json(value) for name, value in document.items()}


def parameter_json(p: EstimatedParameter) -> dict[str, Any]:
    """Return an estimated parameter in the form of schema ``ambid.estimate/1``.

    Returns ``value``, ``sd``, ``ci95``, ``unit``, ``role``, ``identifiable``; for a prior also ``data_share``.
    """
    share = {} if p.data_share is None else {"data_share": p.data_share}
    return {
        "value": p.value,
        "sd": p.sd,
        "ci95": list(p.ci95),
        "unit": p.unit,
        "role": p.role,
        "identifiable": p.identifiable,
        **share,
    }


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
    if not isinstance(document, Mapping) or document.get("schema") != SCHEMA:
        found = document.get("schema") if isinstance(document, Mapping) else type(document).__name__
        raise EstimationError(
            f"{where} has schema {found!r}; an estimate has {SCHEMA!r}. Give a file that 'ambid identify --json' wrote"
        )
    try:
        estimate = _from_json(document)
        _consistent(estimate)
        return estimate
    except (ModelError, AttributeError, ArithmeticError, KeyError, TypeError, ValueError, IndexError) as error:
        raise EstimationError(
            f"{where} is not a whole estimate ({type(error).__name__}: {error}). "
            "Write it again with 'ambid identify --json'"
        ) from error


def _consistent(estimate: Estimate) -> None:
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
    if (
        set(estimate.covariance_names) - set(specs)
        or estimate.covariance.shape != (len(estimate.covariance_names),) * 2
    ):
        raise ValueError("the covariance is not of the parameters")
    if not float(str(estimate.record["rate_hz"])) > 0 or estimate.status not in ("converged", "stalled"):
        raise ValueError("the record's rate or the status is not that of a finished estimate")
    for delay in (estimate.delay[role] for role in plant.inputs):
        if not 0 <= delay.samples < 10**6 or not 0 <= delay.fraction < 1:
            raise ValueError("the delay is not whole samples and a fraction")


def _from_json(d: Mapping[str, Any]) -> Estimate:
    plant, noise, cov = d["continuous"], d["noise"], d["covariance"]
    return Estimate(
        status=d["status"],
        model=d["model"],
        record=d["record"],
        parameters=tuple(
            EstimatedParameter(
                name=name,
                unit=p["unit"],
                value=float(p["value"]),
                sd=float(p["sd"]),
                ci95=(p["ci95"][0], p["ci95"][1]),
                role=p["role"],
                identifiable=bool(p["identifiable"]),
                data_share=p.get("data_share"),
            )
            for name, p in d["parameters"].items()
        ),
        covariance_names=tuple(cov["names"]),
        covariance=np.array(cov["matrix"], dtype=np.float64),
        covariance_method=cov["method"],
        delay={
            role: Delay(samples=int(x["samples"]), fraction=float(x["fraction"]), sd=x["sd"], how=x["how"])
            for role, x in d["delay"].items()
        },
        continuous=Continuous(
            states=tuple(plant["states"]),
            A=np.array(plant["A"], dtype=np.float64),
            B=np.array(plant["B"], dtype=np.float64),
            C=np.array(plant["C"], dtype=np.float64),
            poles=np.array([complex(*p) for p in plant["poles"]]),
        ),
        noise=NoiseModel(
            form=noise["form"],
            gain=np.array(noise["gain"], dtype=np.float64),
            innovation_covariance=np.array(noise["innovation_covariance"], dtype=np.float64),
            disturbance_sd=noise["disturbance_sd"],
            sensor_sd=noise["sensor_sd"],
        ),
        operating_point=d["operating_point"],
        fit={role: OutputFit(**f) for role, f in d["fit"].items()},
        checks={
            name: check_from_json(c) for name, c in d["checks"].items()
        },
        validation=d["validation"],
        warnings=tuple(d["warnings"]),
        timing_s=d["timing_s"],
        information=d["information"],
        rig=d["rig"],
        global_search=d.get("global_search"),
    )  # fmt: skip
