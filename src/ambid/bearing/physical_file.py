"""Physical parameters from a black box as JSON, beside the fit that they came from."""

from __future__ import annotations

from typing import Any

from ambid.bearing.physical import PhysicalFit
from ambid.estimation.estimate_file import parameter_json
from ambid.estimation.json_values import check_json, delay_json, plain_json


def physical_to_json(found: PhysicalFit) -> dict[str, Any]:
    """Return physical parameters in the words of schema ``ambid.estimate/1``.

    Returns ``model``, ``parameters``, ``covariance``, ``delay``, ``misfit``, ``band_hz``, ``warnings``; SI.
    """
    document = {
        "model": found.model,
        "parameters": {p.name: parameter_json(p) for p in found.parameters},
        "covariance": {"names": found.covariance_names, "matrix": found.covariance},
        "delay": delay_json(found.delay),
        "misfit": check_json(found.misfit),
        "band_hz": found.band_hz,
        "warnings": found.warnings,
    }
    return {name: plain_json(value) for name, value in document.items()}
