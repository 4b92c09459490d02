"""Measured frequency responses as JSON, schema ``ambid.frf/1``: SI values, numbers only."""

from __future__ import annotations

import json
from typing import Any

from ambid.blackbox.fit_file import fit_to_json
from ambid.blackbox.frequency.measured import Measured
from ambid.estimation.documents import covariance_together, fields_json, plain_json
from ambid.signals.response import FrequencyResponse

SCHEMA = "ambid.frf/1"


def measured_text(measured: Measured) -> str:
    """Return the JSON text of a measured response, one field a line."""
    fields = measured_to_json(measured).items()
    body = ",\n ".join(f"{json.dumps(name)}: {json.dumps(value, allow_nan=False)}" for name, value in fields)
    return f"{{{body}}}\n"


def measured_to_json(measured: Measured) -> dict[str, Any]:
    """Return a measured response in the form of schema ``ambid.frf/1``; numbers that are not finite are null."""
    frf, estimate = measured.response, measured.estimate
    more = {
        "G": _by_pair(frf, frf.G),
        "sd": _by_pair(frf, frf.sd),
        "noise_sd": _by_pair(frf, frf.noise_sd),
        "distortion_sd": _by_pair(frf, measured.distortion_sd),
        "coherence": None if frf.coherence is None else {o: frf.coherence[:, k] for k, o in enumerate(frf.outputs)},
        "covariance": _covariance_json(frf),
        "fit": None if measured.fit is None else fit_to_json(measured.fit),
        "estimate": None if estimate is None else covariance_together(fields_json(estimate, without=("record",))),
    }
    return {
        "schema": SCHEMA,
        **fields_json(measured, without=("response", "fit", "estimate")),
        **fields_json(frf, without=("G", "covariance", "noise_covariance", "coherence")),
        **plain_json(more),
    }


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
