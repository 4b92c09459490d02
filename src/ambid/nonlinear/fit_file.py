"""Nonlinear fits as JSON, schema ``ambid.fit/1`` (contracts.md), written and read back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from operator import attrgetter
from types import MappingProxyType
from typing import Any

from ambid.errors import EstimationError, nearest
from ambid.estimation.estimate import fit_document, json_text, only_outputs, read_as, read_fit
from ambid.nonlinear.fit import NonlinearFit, NonlinearModel
from ambid.nonlinear.structures import nonlinear_structure


def nonlinear_fit_text(fit: NonlinearFit) -> str:
    """Return the JSON text of a nonlinear fit; equal fits give equal text."""
    return json_text(nonlinear_fit_to_json(fit))


def nonlinear_fit_to_json(fit: NonlinearFit) -> dict[str, Any]:
    """Return a nonlinear fit in the form of schema ``ambid.fit/1``.

    ``orders`` and ``settings`` are the same: readers of linear fits look for the former. ``parameters`` lists the
    numbers of ``model`` by name, and ``sd`` has one entry for each of them; all three are null for a failed fit.
    """
    model, noise = fit.model, fit.noise_covariance
    more = {
        "orders": fit.settings,
        "model": None if model is None else model_to_json(model),
        "parameters": None if model is None else {"names": model.names, "values": model.theta},
        "sd": fit.sd,
        "covariance": None if fit.covariance is None else {"from": fit.covariance_from, "matrix": fit.covariance},
        "noise_variance": noise[0, 0] if len(fit.outputs) == 1 else noise,
        "dt_s": fit.dt,
    }
    return fit_document(fit, more, without=("covariance_from",))


def nonlinear_fit_from_json(document: Mapping[str, Any], where: str) -> NonlinearFit:
    """Read a nonlinear fit back; `where` is the name of its file, for messages."""
    return read_fit(_from_json, document, where)


def _from_json(d: Mapping[str, Any]) -> NonlinearFit:
    nonlinear_structure(d["structure"])
    model, spread = None if d["model"] is None else model_from_json(d["model"]), d["covariance"]
    settings = {k: tuple(v) if isinstance(v, list) else v for k, v in d["settings"].items()}
    fit = read_as(
        NonlinearFit,
        {
            **only_outputs(d, tuple(d["outputs"])),
            "model": model,
            "settings": settings,
            "covariance": None if spread is None else spread["matrix"],
            "covariance_from": "" if spread is None else spread["from"],
            "dt": d["dt_s"],
        },
    )
    if (fit.model is None) != (fit.status == "failed"):
        raise ValueError("a failed fit has no model, every other has one")
    return fit


MODEL_KINDS: Mapping[str, str] = MappingProxyType(
    {
        "narmax": "ambid.nonlinear.polynomial:PolynomialFunction.read_model",
        "hybrid": "ambid.nonlinear.hybrid:HybridFunction.read_model",
        "rbf": "ambid.nonlinear.rbf:RbfFunction.read_model",
        "nn": "ambid.nonlinear.state_network:StateNetwork.from_json",
        "nn-magnitude": "ambid.nonlinear.state_network:StateNetwork.from_json",
        "narx": "ambid.nonlinear.narx:NarxFunction.read_model",
        "hammerstein": "ambid.nonlinear.hammerstein:HammersteinFunction.read_model",
        "lpv": "ambid.nonlinear.lpv_model:LpvModel.from_json",
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
    try:
        return read({k: v for k, v in found.items() if k != "kind"})
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise EstimationError(
            f"no model of kind {found['kind']} ({type(error).__name__}: {error}). Write the file again"
        ) from error


def _home(kind: str) -> str:
    if kind not in MODEL_KINDS:
        known = ", ".join(MODEL_KINDS)
        raise EstimationError(f"model kind {kind!r} is unknown; known: {known}.{nearest(kind, list(MODEL_KINDS))}")
    return MODEL_KINDS[kind]
