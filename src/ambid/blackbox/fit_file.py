"""Black-box fits as JSON, schema ``ambid.fit/1`` (contracts.md), written and read back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.fit import RESPONSE_STRUCTURES, BlackBoxFit, any_structure
from ambid.blackbox.model import (
    BlackBoxModel,
    Offsets,
    PolynomialModel,
    Polynomials,
    StateSpaceModel,
    TransferModel,
    pole_covariance,
)
from ambid.errors import ModelError
from ambid.estimation.estimate import (
    covariance_together,
    fields_json,
    fit_document,
    json_text,
    only_outputs,
    read_as,
    read_fit,
)

_LARGEST = 1e100  # what a number in a file may be: beyond, its square is not finite any more
NO_INNOVATIONS = (
    "none: a frequency response has no innovations; its noise is part of the covariance of the coefficients"
)


def fit_text(fit: BlackBoxFit) -> str:
    """Return the JSON text of a fit, with what was derived from it."""
    document = fit_to_json(fit)
    for name, x in fit.derived.items():
        entries = fields_json(x, without=("structure", "singular_values", "weakest") if name == "physical" else ())
        document[name] = covariance_together(entries) if name == "physical" else entries
    return json_text(document)


def fit_to_json(fit: BlackBoxFit) -> dict[str, Any]:
    """Return a fit in the form of schema ``ambid.fit/1``.

    With one input, B and F are lists of coefficients, with several a list of such lists; with several outputs
    ``polynomials`` and ``sd`` have one entry for each output. ``fit`` and ``validation`` have an entry for each output,
    and with one output ``one_step`` and ``simulation`` beside it. A fit to a frequency response has no innovations:
    ``noise_variance`` and ``noise_covariance`` are null, and ``noise`` says why.
    """
    kind, values = _model_json(fit.model, fit.model.theta, fit.outputs)
    of_response = fit.structure in RESPONSE_STRUCTURES
    noise = None if of_response else fit.noise_covariance
    more = {
        kind: values,
        "sd": None if fit.sd is None else _model_json(fit.model, fit.sd, fit.outputs)[1],
        "noise_variance": noise if noise is None or len(fit.outputs) > 1 else noise[0, 0],
        "noise_covariance": noise,
        "poles": _poles_json(fit),
        "offsets": {
            "inputs": dict(zip(fit.inputs, fit.offsets.u, strict=True)),
            "outputs": dict(zip(fit.outputs, fit.offsets.y, strict=True)),
        },
        **({"noise": NO_INNOVATIONS} if of_response else {}),
        "covariance": None if fit.covariance is None else {"names": fit.model.names, "matrix": fit.covariance},
        "continuous_time": fit.model.dt is None,
        "delay_s": fit.model.delay if isinstance(fit.model, TransferModel) else None,
    }
    return fit_document(fit, more, without=("offsets", "noise_covariance"))


def _model_json(model: BlackBoxModel, theta: Array, outputs: tuple[str, ...]) -> tuple[str, Any]:
    """Put numbers in the order of ``model.theta`` into the shape of the model's kind."""
    if isinstance(model, PolynomialModel):
        found: list[dict[str, Any]] = [{"A": None, "B": [], "C": None, "D": None, "F": []} for _ in outputs]
        for o, letter, i, place in model.blocks():
            p = theta[place].tolist()
            if i is None:
                found[o][letter] = p
            else:
                found[o][letter].append(p)
        for p in found if model.n_inputs == 1 else []:
            p["B"], p["F"] = p["B"][0], p["F"][0]
        return "polynomials", found[0] if len(outputs) == 1 else dict(zip(outputs, found, strict=True))
    if isinstance(model, StateSpaceModel):
        parts, first = {}, 0
        for letter in "ABCDK":
            shape = getattr(model, letter).shape
            parts[letter] = theta[first : first + shape[0] * shape[1]].reshape(shape)
            first += shape[0] * shape[1]
        return "state_space", parts
    if isinstance(model, TransferModel):
        rows: dict[str, list[list[Array]]] = {"num": [], "den": []}
        for o, which, i, place in model.blocks():
            if not i:
                rows[which].append([])
            rows[which][o].append(theta[place])
        return "transfer_function", rows
    raise ModelError(f"a model of type {type(model).__name__} cannot be stored in a file")


def _poles_json(fit: BlackBoxFit) -> list[dict[str, Any]]:
    poles = fit.model.poles()
    spread = None if fit.covariance is None else pole_covariance(fit.model, fit.covariance)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = poles if fit.model.dt is None else np.log(poles) / fit.dt
        return [
            {
                "value": complex(p),
                "sd": None if spread is None else np.sqrt(np.maximum(np.diag(spread[k]), 0.0)),
                "frequency_hz": abs(s[k]) / (2 * np.pi),
                "damping": -s[k].real / abs(s[k]),
            }
            for k, p in enumerate(poles)
        ]


def fit_from_json(document: Mapping[str, Any], where: str) -> BlackBoxFit:
    """Read a fit back; `where` is the name of its file, for messages."""
    return read_fit(_from_json, document, where)


def _from_json(d: Mapping[str, Any]) -> BlackBoxFit:
    inputs, outputs = (read_as(tuple[str, ...], d[which], which) for which in ("inputs", "outputs"))
    any_structure(d["structure"])
    silent = d["noise_covariance"] is None and d["structure"] in RESPONSE_STRUCTURES
    offsets = Offsets(
        u=_finite([d["offsets"]["inputs"][x] for x in inputs], "offsets"),
        y=_finite([d["offsets"]["outputs"][x] for x in outputs], "offsets"),
    )
    fit = read_as(
        BlackBoxFit,
        {
            **only_outputs(d, outputs),
            "model": _model_from_json(d, inputs, outputs),
            "covariance": None if d["covariance"] is None else d["covariance"]["matrix"],
            "offsets": offsets,
            "noise_covariance": np.zeros((len(outputs),) * 2) if silent else d["noise_covariance"],
            "dt": 1.0 / _rate(d),
        },
    )
    if np.any(np.diag(_finite(fit.noise_covariance, "noise_covariance")) < 0):
        raise ValueError("a noise variance is negative")
    if fit.covariance is not None:
        _finite(fit.covariance, "covariance")
    return fit


def _finite(value: Any, what: str) -> Array:
    """Return an array of numbers that can be computed with."""
    found = read_as(Array, value, what)
    if not np.all(np.abs(found) <= _LARGEST):
        raise ValueError(f"{what} is not finite, or too large")
    return found


def _rate(d: Mapping[str, Any]) -> float:
    rate = d["rate_hz"]
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not 1 / _LARGEST < rate < _LARGEST:
        raise ValueError("the rate is not a positive number")
    return float(rate)


def _model_from_json(d: Mapping[str, Any], inputs: tuple[str, ...], outputs: tuple[str, ...]) -> BlackBoxModel:
    if not isinstance(d["continuous_time"], bool):
        raise ValueError("continuous_time is neither true nor false")
    dt = None if d["continuous_time"] else 1.0 / _rate(d)
    if "state_space" in d:
        n = len(d["state_space"]["A"])
        shapes = {"A": (n, n), "B": (n, len(inputs)), "C": (len(outputs), n), "D": (len(outputs), len(inputs))}
        shapes["K"] = (n, len(outputs))
        parts = {k: _finite(d["state_space"][k], k) for k in shapes}
        for k, shape in shapes.items():
            if parts[k].shape != shape and (parts[k].size or 0 not in shape):
                raise ValueError(f"{k} has shape {parts[k].shape}; {shape} belongs to states, inputs and outputs")
        parts = {k: parts[k].reshape(shape) for k, shape in shapes.items()}
        return StateSpaceModel(dt=dt, **parts)
    if "transfer_function" in d:
        tf, delay = d["transfer_function"], d["delay_s"]
        if not isinstance(delay, list) or len(delay) != len(inputs) or np.any(_finite(delay, "delay_s") < 0):
            raise ValueError("delay_s is not a time for each input")
        num, den = (tuple(tuple(_finite(x, k) for x in row) for row in tf[k]) for k in ("num", "den"))
        names = () if d["covariance"] is None else d["covariance"]["names"]
        return TransferModel(num=num, den=den, dt=dt, delay=tuple(delay), delay_estimated="delay[0]" in names)
    found = [d["polynomials"]] if len(outputs) == 1 else [d["polynomials"][o] for o in outputs]
    one = len(inputs) == 1
    sets = tuple(
        Polynomials(
            A=_finite(p["A"], "A"),
            B=tuple(_finite(x, "B") for x in ([p["B"]] if one else p["B"])),
            C=_finite(p["C"], "C"),
            D=_finite(p["D"], "D"),
            F=tuple(_finite(x, "F") for x in ([p["F"]] if one else p["F"])),
        )
        for p in found
    )
    if dt is None:
        raise ValueError("a polynomial model is discrete")
    return PolynomialModel(outputs=sets, dt=dt)
