"""Nonlinear models as JSON: who reads which kind. Numbers survive bit by bit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from operator import attrgetter
from types import MappingProxyType
from typing import Any

from ambid.errors import EstimationError, nearest
from ambid.nonlinear.model import NonlinearModel

MODEL_KINDS: Mapping[str, str] = MappingProxyType(
    {
        "narmax": "ambid.nonlinear.narmax.model:PolynomialNarmax.from_json",
        "hybrid": "ambid.nonlinear.hybrid_function:read_model",
        "rbf": "ambid.nonlinear.rbf_network:read_model",
        "nn": "ambid.nonlinear.state_network:StateNetwork.from_json",
        "nn-magnitude": "ambid.nonlinear.state_network:StateNetwork.from_json",
        "narx": "ambid.nonlinear.narx:read_model",
        "hammerstein": "ambid.nonlinear.hammerstein:read_model",
        "lpv": "ambid.nonlinear.lpv.model:LpvModel.from_json",
    }
)
"""Who reads a model, ``module:function`` by `NonlinearModel.kind`; imported only when one of that kind is read."""


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
    read: Callable[[dict[str, Any]], NonlinearModel] = attrgetter(name)(import_module(module))
    return read({k: v for k, v in found.items() if k != "kind"})


def _home(kind: str) -> str:
    if kind not in MODEL_KINDS:
        known = ", ".join(MODEL_KINDS)
        raise EstimationError(
            f"models of kind {kind!r} are not known; known: {known}.{nearest(kind, list(MODEL_KINDS))}"
        )
    return MODEL_KINDS[kind]
