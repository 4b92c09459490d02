"""Nonlinear fits as JSON, schema ``ambid.fit/1`` (contracts.md), written and read back."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError, ModelError
from ambid.estimation.estimate import OutputFit
from ambid.estimation.json_values import check_from_json, check_json, plain_json
from ambid.nonlinear.fit import LearningCurve, NonlinearFit
from ambid.nonlinear.model_file import model_from_json, model_to_json
from ambid.nonlinear.structures import nonlinear_structure

SCHEMA = "ambid.fit/1"
_STATUSES = ("converged", "stalled", "failed")


def nonlinear_fit_text(fit: NonlinearFit) -> str:
    """Return the JSON text of a nonlinear fit.

    Returns equal fits give equal text.
    """
    return json.dumps(nonlinear_fit_to_json(fit), indent=1, allow_nan=False) + "\n"


def nonlinear_fit_to_json(fit: NonlinearFit) -> dict[str, Any]:
    """Return a nonlinear fit in the form of schema ``ambid.fit/1``.

    ``orders`` and ``settings`` are the same: readers of linear fits look for the former. ``parameters`` lists the
    numbers of ``model`` by name, and ``sd`` has one entry for each of them.

    Returns SI values; numbers that are not finite are null. ``model``, ``parameters`` and ``sd`` are null for a failed
    fit.
    """
    model, one = fit.model, len(fit.outputs) == 1
    settings = {k: list(v) if isinstance(v, tuple) else v for k, v in fit.settings.items()}
    by_output = {
        o: {"one_step": f.one_step, "simulation": f.simulation, "innovation_sd": f.innovation_sd}
        for o, f in fit.fit.items()
    }
    document = {
        "schema": SCHEMA,
        "structure": fit.structure,
        "status": fit.status,
        "reason": fit.reason,
        "orders": settings,
        "settings": settings,
        "model": None if model is None else model_to_json(model),
        "parameters": None if model is None else {"names": model.names, "values": model.theta},
        "sd": fit.sd,
        "covariance": None if fit.covariance is None else {"from": fit.covariance_from, "matrix": fit.covariance},
        "n_estimated": fit.n_estimated,
        "noise_variance": fit.noise_covariance[0, 0] if one else fit.noise_covariance,
        "noise_covariance": fit.noise_covariance,
        "fit": _by_output(by_output),
        "criteria": fit.criteria,
        "rate_hz": 1.0 / fit.dt,
        "dt_s": fit.dt,
        "checks": {name: check_json(c) for name, c in fit.checks.items()},
        "validation": None if fit.validation is None else _by_output(fit.validation),
        "warnings": list(fit.warnings),
        "inputs": list(fit.inputs),
        "outputs": list(fit.outputs),
        "units": fit.units,
        "records": list(fit.records),
        "seed": fit.seed,
        "curves": [
            {"method": c.method, "seconds": c.seconds, "training": c.training, "held_out": c.held_out}
            for c in fit.curves
        ],
        "timing_s": fit.timing_s,
        "details": fit.details,
    }
    return {name: plain_json(value) for name, value in document.items()}


def _by_output(found: Mapping[str, Any]) -> dict[str, Any]:
    """With one output its results stand at the top as well."""
    first = dict(next(iter(found.values()))) if len(found) == 1 else {}
    return {**first, **{o: v for o, v in found.items() if o not in first}}


def nonlinear_fit_from_json(document: Mapping[str, Any], where: str) -> NonlinearFit:
    """Read a nonlinear fit back.

    `document`: parsed JSON of schema ``ambid.fit/1``; `where`: name of the file, for messages.
    """
    if not isinstance(document, Mapping) or document.get("schema") != SCHEMA:
        found = document.get("schema") if isinstance(document, Mapping) else type(document).__name__
        raise EstimationError(
            f"{where} has schema {found!r}; a fit has {SCHEMA!r}. Give a file that 'ambid fit --json' wrote"
        )
    try:
        return _from_json(document)
    except (
        EstimationError, ModelError, AttributeError, ArithmeticError, KeyError, TypeError, ValueError, IndexError,
    ) as error:  # fmt: skip
        raise EstimationError(
            f"{where} is not a whole fit ({type(error).__name__}: {error}). Write it again with 'ambid fit --json'"
        ) from error


def _from_json(d: Mapping[str, Any]) -> NonlinearFit:
    inputs, outputs = tuple(d["inputs"]), tuple(d["outputs"])
    nonlinear_structure(d["structure"])
    if d["status"] not in _STATUSES:
        raise ValueError(f"status {d['status']!r} is none of {', '.join(_STATUSES)}")
    model = None if d["model"] is None else model_from_json(d["model"])
    if (model is None) != (d["status"] == "failed"):
        raise ValueError("a failed fit has no model, every other has one")
    if not isinstance(d["units"], Mapping):
        raise ValueError("the units are not by column")
    noise = _numbers(d["noise_covariance"])
    covariance = None if d["covariance"] is None else _numbers(d["covariance"]["matrix"])
    if noise.shape != (len(outputs),) * 2:
        raise ValueError("the noise covariance is not of the outputs")
    if model is not None:
        if (model.n_inputs, model.n_outputs) != (len(inputs), len(outputs)):
            raise ValueError("inputs, outputs and model are not of the same size")
        if covariance is not None:
            covariance = covariance.reshape(model.theta.size, model.theta.size)
    return NonlinearFit(
        structure=d["structure"],
        settings={k: tuple(v) if isinstance(v, list) else v for k, v in d["settings"].items()},
        model=model,
        covariance=covariance,
        covariance_from="" if covariance is None else d["covariance"]["from"],
        n_estimated=int(d["n_estimated"]),
        noise_covariance=noise,
        inputs=inputs,
        outputs=outputs,
        units=d["units"],
        dt=float(d["dt_s"]),
        records=tuple(d["records"]),
        seed=int(d["seed"]),
        status=d["status"],
        reason=d["reason"],
        curves=tuple(
            LearningCurve(
                method=c["method"],
                seconds=_numbers(c["seconds"]),
                training=_numbers(c["training"]),
                held_out=_numbers(c["held_out"]),
            )
            for c in d["curves"]
        ),
        fit={o: OutputFit(**_output_fit(d["fit"][o])) for o in outputs if o in d["fit"]},
        criteria={k: float("nan") if v is None else v for k, v in d["criteria"].items()},
        checks={name: check_from_json(c) for name, c in d["checks"].items()},
        validation=None if d["validation"] is None else {o: d["validation"][o] for o in outputs},
        warnings=tuple(d["warnings"]),
        timing_s=d["timing_s"],
        details=d["details"],
    )


def _output_fit(f: Mapping[str, Any]) -> dict[str, Any]:
    """Read null as "not a number", but for the simulation, which may be missing."""
    return {k: float("nan") if v is None and k != "simulation" else v for k, v in f.items()}


def _numbers(value: Any) -> Array:
    """Numbers as an array, null as "not a number"; text and truth values are no numbers."""
    found = np.array(value)
    if found.size and found.dtype.kind == "O":
        found = np.array(value, dtype=np.float64)  # None becomes nan; anything else raises
    if found.size and found.dtype.kind not in "iuf":
        raise ValueError("something that should be numbers is not")
    return found.astype(np.float64)
