"""Measured frequency responses as JSON, schema ``ambid.frf/1``: SI values, numbers only."""

from __future__ import annotations

import json
from dataclasses import asdict, is_dataclass
from typing import Any

import numpy as np

from ambid.blackbox.fit_file import fit_to_json
from ambid.blackbox.frequency.measured import Measured
from ambid.blackbox.frequency.physical_estimate import FrequencyEstimate
from ambid.estimation.estimate_file import parameter_json
from ambid.estimation.json_values import check_json, delay_json, plain_json
from ambid.signals.frf import FrequencyResponse

SCHEMA = "ambid.frf/1"


def measured_text(measured: Measured) -> str:
    """Return the JSON text of a measured response, one field a line."""
    fields = measured_to_json(measured).items()
    body = ",\n ".join(f"{json.dumps(name)}: {json.dumps(value, allow_nan=False)}" for name, value in fields)
    return f"{{{body}}}\n"


def measured_to_json(measured: Measured) -> dict[str, Any]:
    """Return a measured response in the form of schema ``ambid.frf/1``.

    Returns SI values; numbers that are not finite are null.
    """
    frf = measured.response
    document = {
        "schema": SCHEMA,
        "record": measured.record,
        "inputs": frf.inputs,
        "outputs": frf.outputs,
        "references": measured.references,
        "open_loop": measured.open_loop,
        "units": frf.units,
        "rate_hz": frf.rate_hz,
        "hold": frf.hold,
        "method": frf.method,
        "frequency_hz": frf.frequency_hz,
        "G": _by_pair(frf, frf.G),
        "sd": _by_pair(frf, frf.sd),
        "noise_sd": _by_pair(frf, frf.noise_sd),
        "distortion_sd": _by_pair(frf, measured.distortion_sd),
        "coherence": None if frf.coherence is None else {o: frf.coherence[:, k] for k, o in enumerate(frf.outputs)},
        "covariance": _covariance_json(frf),
        "degrees_of_freedom": frf.degrees_of_freedom,
        "lines_per_independent": frf.lines_per_independent,
        "warnings": frf.warnings,
        "details": {k: asdict(v) if is_dataclass(v) and not isinstance(v, type) else v for k, v in frf.details.items()},
        "fit": None if measured.fit is None else fit_to_json(measured.fit),
        "estimate": None if measured.estimate is None else _estimate_json(measured.estimate),
        "timing_s": measured.timing_s,
    }
    return {name: plain_json(value) for name, value in document.items()}


def _by_pair(frf: FrequencyResponse, values: Any) -> dict[str, dict[str, Any]] | None:
    """``{output: {input: [...]}}``."""
    if values is None:
        return None
    return {o: {i: values[:, j, k] for k, i in enumerate(frf.inputs)} for j, o in enumerate(frf.outputs)}


def _covariance_json(frf: FrequencyResponse) -> dict[str, Any] | None:
    """With one entry `sd` says it all."""
    if frf.n_inputs * frf.n_outputs == 1:
        return None
    return {"entries": [[o, i] for o in frf.outputs for i in frf.inputs], "matrix": frf.covariance}


def _estimate_json(estimate: FrequencyEstimate) -> dict[str, Any]:
    plant = estimate.continuous
    return {
        "status": estimate.status,
        "model": estimate.model,
        "parameters": {p.name: parameter_json(p) for p in estimate.parameters},
        "covariance": {
            "names": estimate.covariance_names,
            "matrix": estimate.covariance,
            "method": estimate.covariance_method,
        },
        "delay": delay_json(estimate.delay),
        "continuous": {
            "states": plant.states,
            "A": plant.A,
            "B": plant.B,
            "C": plant.C,
            "poles": np.asarray(plant.poles),
        },
        "checks": {name: check_json(c) for name, c in estimate.checks.items()},
        "information": estimate.information,
        "warnings": estimate.warnings,
    }
