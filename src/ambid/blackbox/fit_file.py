"""Black-box fits as JSON, schema ``ambid.fit/1`` (contracts.md), written and read back."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.model import BlackBoxModel
from ambid.blackbox.polynomial_model import PolynomialModel, Polynomials
from ambid.blackbox.response import Offsets
from ambid.blackbox.spread import pole_covariance
from ambid.blackbox.state_space import StateSpaceModel
from ambid.blackbox.structures import RESPONSE_STRUCTURES, any_structure
from ambid.blackbox.transfer_model import TransferModel
from ambid.errors import EstimationError, ModelError
from ambid.estimation.estimate import OutputFit
from ambid.estimation.json_values import check_from_json, check_json, plain_json

SCHEMA = "ambid.fit/1"
_LARGEST = 1e100  # what a number in a file may be: beyond, its square is not finite any more
NO_INNOVATIONS = (
    "none: a frequency response has no innovations, and its noise stands in the covariance of the coefficients"
)


def fit_text(fit: BlackBoxFit) -> str:
    """Return the JSON text of a fit."""
    return json.dumps(fit_to_json(fit), indent=1, allow_nan=False) + "\n"


def fit_to_json(fit: BlackBoxFit) -> dict[str, Any]:
    """Return a fit in the form of schema ``ambid.fit/1``.

    With one input, B and F are lists of coefficients, with several a list of such lists; with several outputs
    ``polynomials`` and ``sd`` have one entry for each output. ``fit`` and ``validation`` have an entry for each output,
    and with one output ``one_step`` and ``simulation`` beside it. A fit to a frequency response has no innovations:
    ``noise_variance`` and ``noise_covariance`` are null, and ``noise`` says why.

    Returns SI values; numbers that are not finite are null.
    """
    kind, values = _model_json(fit.model, fit.model.theta, fit.outputs)
    sd = None if fit.sd is None else _model_json(fit.model, fit.sd, fit.outputs)[1]
    of_response = fit.structure in RESPONSE_STRUCTURES
    noise = None if of_response else fit.noise_covariance
    document = {
        "schema": SCHEMA,
        "structure": fit.structure,
        "status": fit.status,
        "orders": {k: list(v) if isinstance(v, tuple) else v for k, v in fit.orders.items()},
        kind: values,
        "sd": sd,
        "noise_variance": noise if noise is None or len(fit.outputs) > 1 else noise[0, 0],
        "fit": _by_output({o: _fit_json(f) for o, f in fit.fit.items()}),
        "criteria": fit.criteria,
        "rate_hz": 1.0 / fit.dt,
        "checks": {name: check_json(c) for name, c in fit.checks.items()},
        "validation": None if fit.validation is None else _by_output(fit.validation),
        "warnings": list(fit.warnings),
        "poles": _poles_json(fit),
        "inputs": list(fit.inputs),
        "outputs": list(fit.outputs),
        "units": fit.units,
        "offsets": {
            "inputs": dict(zip(fit.inputs, fit.offsets.u.tolist(), strict=True)),
            "outputs": dict(zip(fit.outputs, fit.offsets.y.tolist(), strict=True)),
        },
        "noise_covariance": noise,
        **({"noise": NO_INNOVATIONS} if of_response else {}),
        "covariance": None if fit.covariance is None else {"names": fit.model.names, "matrix": fit.covariance},
        "n_estimated": fit.n_estimated,
        "continuous_time": fit.model.dt is None,
        "delay_s": list(fit.model.delay) if isinstance(fit.model, TransferModel) else None,
        "record": fit.record,
        "details": fit.details,
        "timing_s": fit.timing_s,
    }
    return {name: plain_json(value) for name, value in document.items()}


def _by_output(found: Mapping[str, Any]) -> dict[str, Any]:
    """With one output its results stand at the top as well."""
    first = dict(next(iter(found.values()))) if len(found) == 1 else {}
    return {**first, **{o: v for o, v in found.items() if o not in first}}


def _fit_json(f: OutputFit) -> dict[str, Any]:
    return {"one_step": f.one_step, "simulation": f.simulation, "innovation_sd": f.innovation_sd}


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
        for o, i, which, p, place in model.parts():
            if not i:
                rows[which].append([])
            rows[which][o].append(theta[place.start : place.start + p.size])
        return "transfer_function", rows
    raise ModelError(f"a model of type {type(model).__name__} has no place in a file")


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
    """Read a fit back.

    `document`: parsed JSON of schema ``ambid.fit/1``; `where`: name of the file, for messages.
    """
    if not isinstance(document, Mapping) or document.get("schema") != SCHEMA:
        found = document.get("schema") if isinstance(document, Mapping) else type(document).__name__
        raise EstimationError(
            f"{where} has schema {found!r}; a fit has {SCHEMA!r}. Give a file that 'ambid fit --json' wrote"
        )
    try:
        return _from_json(document)
    except (ModelError, AttributeError, ArithmeticError, KeyError, TypeError, ValueError, IndexError) as error:
        raise EstimationError(
            f"{where} is not a whole fit ({type(error).__name__}: {error}). Write it again with 'ambid fit --json'"
        ) from error


def _from_json(d: Mapping[str, Any]) -> BlackBoxFit:
    inputs, outputs = _names(d, "inputs"), _names(d, "outputs")
    model = _model_from_json(d, inputs, outputs)
    any_structure(d["structure"])
    covariance = None if d["covariance"] is None else _array(d["covariance"]["matrix"], "covariance")
    silent = d["noise_covariance"] is None and d["structure"] in RESPONSE_STRUCTURES
    noise = np.zeros((len(outputs),) * 2) if silent else _array(d["noise_covariance"], "noise_covariance")
    if (model.n_inputs, model.n_outputs) != (len(inputs), len(outputs)) or noise.shape != (len(outputs),) * 2:
        raise ValueError("inputs, outputs, noise and model are not of the same size")
    if covariance is not None and covariance.shape != (model.theta.size,) * 2:
        raise ValueError("the covariance is not of the model's coefficients")
    if np.any(np.diag(noise) < 0):
        raise ValueError("a noise variance is negative")
    if not isinstance(d["units"], dict) or not all(isinstance(x, str) for x in d["units"].values()):
        raise ValueError("units are not text")
    offsets = Offsets(
        u=_array([d["offsets"]["inputs"][x] for x in inputs], "offsets"),
        y=_array([d["offsets"]["outputs"][x] for x in outputs], "offsets"),
    )
    return BlackBoxFit(
        structure=d["structure"],
        orders={k: tuple(v) if isinstance(v, list) else int(v) for k, v in d["orders"].items()},
        model=model,
        covariance=covariance,
        n_estimated=int(d["n_estimated"]),
        offsets=offsets,
        noise_covariance=noise,
        inputs=inputs,
        outputs=outputs,
        units=d["units"],
        dt=1.0 / _rate(d),
        record=d["record"],
        status=d["status"],
        fit={o: OutputFit(**_numbers(d["fit"][o])) for o in outputs if o in d["fit"]},
        criteria=d["criteria"],
        checks={name: check_from_json(c) for name, c in d["checks"].items()},
        validation=None if d["validation"] is None else {o: d["validation"][o] for o in outputs},
        warnings=tuple(d["warnings"]),
        timing_s=d["timing_s"],
        details=d["details"],
    )


def _numbers(f: Mapping[str, Any]) -> dict[str, Any]:
    """Read null as "not a number", but for the simulation, which may be missing."""
    return {k: float("nan") if v is None and k != "simulation" else v for k, v in f.items()}


def _names(d: Mapping[str, Any], which: str) -> tuple[str, ...]:
    names = d[which]
    if not isinstance(names, list) or not all(isinstance(x, str) for x in names):
        raise ValueError(f"{which} is not a list of names")
    return tuple(names)


def _array(value: Any, what: str) -> Array:
    """Numbers as an array; text, truth values and what could not be computed with are no numbers."""
    found = np.array(value)
    if found.size and found.dtype.kind not in "iuf":
        raise ValueError(f"{what} does not consist of numbers")
    if not np.all(np.abs(found.astype(np.float64)) <= _LARGEST):
        raise ValueError(f"{what} is not finite, or too large")
    return found.astype(np.float64)


def _rate(d: Mapping[str, Any]) -> float:
    rate = d["rate_hz"]
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not 1 / _LARGEST < rate < _LARGEST:
        raise ValueError("the rate is no positive number")
    return float(rate)


def _model_from_json(d: Mapping[str, Any], inputs: tuple[str, ...], outputs: tuple[str, ...]) -> BlackBoxModel:
    if not isinstance(d["continuous_time"], bool):
        raise ValueError("continuous_time is neither true nor false")
    dt = None if d["continuous_time"] else 1.0 / _rate(d)
    if "state_space" in d:
        n = len(d["state_space"]["A"])
        shapes = {"A": (n, n), "B": (n, len(inputs)), "C": (len(outputs), n), "D": (len(outputs), len(inputs))}
        shapes["K"] = (n, len(outputs))
        parts = {k: _array(d["state_space"][k], k) for k in shapes}
        for k, shape in shapes.items():
            if parts[k].shape != shape and (parts[k].size or 0 not in shape):
                raise ValueError(f"{k} has shape {parts[k].shape}; {shape} belongs to states, inputs and outputs")
        parts = {k: parts[k].reshape(shape) for k, shape in shapes.items()}
        return StateSpaceModel(dt=dt, **parts)
    if "transfer_function" in d:
        tf, delay = d["transfer_function"], d["delay_s"]
        if not isinstance(delay, list) or len(delay) != len(inputs) or np.any(_array(delay, "delay_s") < 0):
            raise ValueError("delay_s is not a time for each input")
        num, den = (tuple(tuple(_array(x, k) for x in row) for row in tf[k]) for k in ("num", "den"))
        names = () if d["covariance"] is None else d["covariance"]["names"]
        return TransferModel(num=num, den=den, dt=dt, delay=tuple(delay), delay_estimated="delay[0]" in names)
    found = [d["polynomials"]] if len(outputs) == 1 else [d["polynomials"][o] for o in outputs]
    one = len(inputs) == 1
    sets = tuple(
        Polynomials(
            A=_array(p["A"], "A"),
            B=tuple(_array(x, "B") for x in ([p["B"]] if one else p["B"])),
            C=_array(p["C"], "C"),
            D=_array(p["D"], "D"),
            F=tuple(_array(x, "F") for x in ([p["F"]] if one else p["F"])),
        )
        for p in found
    )
    if dt is None:
        raise ValueError("a polynomial model is discrete")
    return PolynomialModel(outputs=sets, dt=dt)
