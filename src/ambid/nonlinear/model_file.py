"""Nonlinear models as JSON: which class reads which kind. Numbers survive bit by bit."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from types import MappingProxyType
from typing import Any

from ambid.errors import EstimationError, nearest
from ambid.nonlinear.model import NonlinearModel

MODEL_KINDS: Mapping[str, str] = MappingProxyType(
    {
        "narmax": "ambid.nonlinear.narmax.model:PolynomialNarmax",
        "hybrid": "ambid.nonlinear.hybrid.model:HybridNarmax",
        "rbf": "ambid.nonlinear.rbf.model:RbfNetwork",
        "nn": "ambid.nonlinear.networks.state_model:StateNetwork",
        "nn-magnitude": "ambid.nonlinear.networks.magnitude_model:MagnitudeNetwork",
        "narx": "ambid.nonlinear.networks.narx_model:NeuralNarx",
        "lpv": "ambid.nonlinear.lpv.model:LpvModel",
    }
)
"""``module:class`` by `NonlinearModel.kind`; imported only when a model of that kind is read."""


def model_to_json(model: NonlinearModel) -> dict[str, Any]:
    """Return a model as JSON-able values, its kind beside what the model itself writes.

    Returns ``kind`` and what `NonlinearModel.as_json` returns.
    """
    _home(model.kind)
    return {"kind": model.kind, **model.as_json()}


def model_from_json(found: Mapping[str, Any]) -> NonlinearModel:
    """Read a model back.

    `found`: that `model_to_json` made.
    """
    if not isinstance(found, Mapping) or not isinstance(found.get("kind"), str):
        raise EstimationError("the model has no kind; a file of a nonlinear fit names it. Write the file again")
    module, name = _home(found["kind"]).split(":")
    model: NonlinearModel = getattr(import_module(module), name).from_json(
        {k: v for k, v in found.items() if k != "kind"}
    )
    return model


def _home(kind: str) -> str:
    if kind not in MODEL_KINDS:
        known = ", ".join(MODEL_KINDS)
        raise EstimationError(
            f"models of kind {kind!r} are not known; known: {known}.{nearest(kind, list(MODEL_KINDS))}"
        )
    return MODEL_KINDS[kind]
