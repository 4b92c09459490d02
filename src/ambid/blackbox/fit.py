"""The register of black-box structures; their results, how they are built, and their files: JSON, schema
``ambid.fit/1``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData, UsedOrders
from ambid.blackbox.model import (
    BlackBoxModel,
    Offsets,
    PolynomialModel,
    Polynomials,
    StateSpaceModel,
    TransferModel,
    pole_covariance,
)
from ambid.errors import EstimationError, ModelError, choices
from ambid.estimation.estimate import (
    FittedModel,
    covariance_together,
    fields_json,
    fit_document,
    json_text,
    only_outputs,
    read_as,
    read_fit,
)
from ambid.estimation.result import Linear, Reason
from ambid.settings.caller import setting

Feedback = Literal["consistent", "biased", "with noise model"]
Kind = Literal["polynomial", "state space", "transfer function"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Structure:
    """One black-box structure."""

    name: str
    summary: str
    orders: tuple[str, ...]  # orders it takes; all but nk are at least 0 (n: at least 1)
    module: str  # of `ambid.blackbox`, where its estimator stands under its own name
    # what feedback does to it: nothing; bias; nothing as long as its noise model holds the true one
    feedback: Feedback
    kind: Kind

    @property
    def inputs(self) -> bool:
        """Whether it takes inputs."""
        return bool({"nb", "nf", "n", "nk"} & set(self.orders))

    @property
    def prediction_error(self) -> bool:
        """Whether it is a polynomial structure fitted by prediction error: it takes `at_rest`, and can be tracked."""
        return self.module == "polynomial"

    @property
    def instrumental(self) -> bool:
        """Whether it is fitted by instrumental variables."""
        return self.module.startswith("instrumental")

    @property
    def estimator(self) -> Callable[..., Any]:
        """The function that fits it."""
        function: Callable[..., Any] = getattr(
            import_module(f"ambid.blackbox.{self.module}"), self.name.replace("-", "_")
        )
        return function


def _register(*rows: tuple[str, Kind, str, str, Feedback, str]) -> Mapping[str, Structure]:
    """Enter structures: name, kind, module, orders, what feedback does, summary."""
    return {
        name: Structure(
            name=name, summary=summary, orders=tuple(orders.split()), module=module, feedback=feedback, kind=kind
        )
        for name, kind, module, orders, feedback, summary in rows
    }


_INNOVATIONS = "x+ = A x + B u + K e"

STRUCTURES = _register(
    ("fir", "polynomial", "polynomial", "nb nk", "biased", "y = B u + e"),
    ("arx", "polynomial", "polynomial", "na nb nk", "with noise model", "A y = B u + e"),
    ("armax", "polynomial", "polynomial", "na nb nc nk", "with noise model", "A y = B u + C e"),
    ("arma", "polynomial", "polynomial", "na nc", "with noise model", "A y = C e"),
    ("ararx", "polynomial", "polynomial", "na nb nd nk", "with noise model", "A y = B u + 1/D e"),
    ("ararmax", "polynomial", "polynomial", "na nb nc nd nk", "with noise model", "A y = B u + C/D e"),
    ("oe", "polynomial", "polynomial", "nb nf nk", "biased", "y = B/F u + e"),
    ("bj", "polynomial", "polynomial", "nb nc nd nf nk", "with noise model", "y = B/F u + C/D e"),
    ("iv4", "polynomial", "instrumental", "na nb nk", "biased", "A y = B u + noise of any colour"),
    ("cliv", "polynomial", "instrumental", "na nb nk", "consistent",
     "A y = B u + noise of any colour, in closed loop with its reference"),
    ("n4sid", "state space", "subspace", "n", "biased", f"{_INNOVATIONS}, subspace by oblique projection"),
    ("moesp", "state space", "subspace", "n", "biased", f"{_INNOVATIONS}, subspace, past without future inputs"),
    ("cva", "state space", "subspace", "n", "biased", f"{_INNOVATIONS}, subspace by canonical variates"),
    ("pbsid", "state space", "subspace", "n", "consistent",
     f"{_INNOVATIONS}, subspace from a long autoregression; consistent in closed loop"),
    ("blocks", "transfer function", "blocks", "nk", "consistent",
     "i = K_a/(s+a) u + K_b/(s+b) x, x = K_c/(s+c) i, continuous time (mass 1, no inertia)"),
)  # fmt: skip

# Fitted to a measured frequency response (`FrequencyResponse`) instead of to inputs and outputs: their estimators take
# one in the place of the data, so they are kept apart from those that `fit` and `compare` can call. They are consistent
# under feedback as far as the response is; that says itself where it is not.
RESPONSE_STRUCTURES = _register(
    ("frf-ml", "transfer function", "frequency", "nb nf", "consistent",
     "G = N/D exp(-s delay), in s or z, by maximum likelihood"),
    ("frf-subspace", "state space", "frequency_subspace", "n", "consistent",
     "x' = A x + B u by subspace with the Laguerre operator, then maximum likelihood"),
)  # fmt: skip


def structure(name: str) -> Structure:
    """Return a structure that is fitted to inputs and outputs, by name."""
    if name in RESPONSE_STRUCTURES:
        raise EstimationError(
            f"structure {name} is fitted to a frequency response, not to inputs and outputs. Use 'ambid frf'"
        )
    if name not in STRUCTURES:
        raise EstimationError(f"structure {name!r} is unknown; known: {choices(name, STRUCTURES)}")
    return STRUCTURES[name]


def any_structure(name: str) -> Structure:
    """Return a structure by name, whatever it is fitted to: for those who read a finished fit."""
    return RESPONSE_STRUCTURES[name] if name in RESPONSE_STRUCTURES else structure(name)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class BlackBoxFit(FittedModel, Linear):
    """An identified black-box model, file schema ``ambid.fit/1``.

    Attributes
    ----------
    structure : str
        Name in `ambid.blackbox.fit`.
    orders : Mapping[str, int or tuple of int]
        ``na``, ``nb`` ..., or ``n``; a tuple where inputs differ.
    model : BlackBoxModel
        For deviations from `offsets`.
    covariance : ndarray, shape (n_theta, n_theta) or None
        Of ``model.theta``; zeros where a coefficient was not estimated. None where the method has none to give.
    n_estimated : int
        Numbers that were estimated, offsets and initial states not counted.
    offsets : Offsets
        Operating point, SI.
    noise_covariance : ndarray, shape (n_outputs, n_outputs), SI
        Of the innovations.
    inputs, outputs, warnings : tuple of str
    units : Mapping[str, str]
    dt : float, s
    record : Mapping[str, object]
    status : {"converged", "stalled"}
    fit : Mapping[str, OutputFit]
        By output.
    criteria, timing_s : Mapping[str, float]
        Criteria are ``aic``, ``aicc``, ``bic``, ``mdl``, ``fpe``.
    checks : Mapping[str, Check]
    validation : Mapping[str, object] or None
        By output, on a second record.
    details : Mapping[str, object]
        Further results of the method as JSON-able values (singular values, condition numbers, chosen horizons).
    derived : Mapping[str, object]
        What was worked out from it: ``physical`` parameters of a rig; written, but not read back.
    """

    orders: UsedOrders
    model: BlackBoxModel
    offsets: Offsets
    record: Mapping[str, object]
    status: Literal["converged", "stalled"] = "converged"
    derived: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}), metadata={"written": False})

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Those of the fit, and of the physical parameters that were derived from it."""
        physical = getattr(self.derived.get("physical"), "reasons", ())
        return (*super(BlackBoxFit, self).reasons, *(replace(r, check=f"physical.{r.check}") for r in physical))


def build_fit(
    name: str,
    data: IOData,
    *,
    orders: UsedOrders,
    model: BlackBoxModel,
    covariance: Array | None,
    n_estimated: int,
    offsets: Offsets,
    noise_covariance: Array,
    status: Literal["converged", "stalled"] = "converged",
    warnings: Sequence[str] = (),
    details: Mapping[str, object] | None = None,
) -> BlackBoxFit:
    """Put the result of the structure `name` together, with a warning where it is biased under feedback and `data` are
    not declared open loop. `orders`: as used, delays included; `noise_covariance`: (n_outputs, n_outputs), SI.
    """
    if not np.all(np.isfinite(model.theta)) or not np.all(np.isfinite(noise_covariance)):
        raise EstimationError(f"{name}: no finite coefficients fit this record. Lower the orders, or check the columns")
    remarks = list(warnings)
    if status != "converged":
        remarks.insert(0, "the search did not converge: treat the values as a first guess")
    if structure(name).feedback == "biased" and data.n_inputs and not data.open_loop:
        remarks.append(
            f"{name} is biased by feedback. Use bj, armax or pbsid, or give {setting('open_loop', True)} if the "
            "record is open loop"
        )
    return BlackBoxFit(
        structure=name,
        orders=dict(orders),
        model=model,
        covariance=covariance,
        n_estimated=n_estimated,
        offsets=offsets,
        noise_covariance=np.asarray(noise_covariance, dtype=np.float64),
        inputs=data.inputs,
        outputs=data.outputs,
        units=dict(data.units),
        dt=data.dt,
        record=dict(data.record),
        status=status,
        warnings=tuple(remarks),
        details={} if details is None else dict(details),
    )


_LARGEST = 1e100  # what a number in a file may be: beyond, its square is not finite any more
NO_INNOVATIONS = (
    "none: a frequency response has no innovations; its noise is part of the covariance of the coefficients"
)


def fit_text(fit: BlackBoxFit) -> str:
    """Return the JSON text of a fit, with what was derived from it."""
    document = fit_to_json(fit)
    for name, x in fit.derived.items():
        document[name] = covariance_together(fields_json(x, without=("structure", "singular_values", "weakest")))
    return json_text(document)


def fit_to_json(fit: BlackBoxFit) -> dict[str, Any]:
    """Return a fit in the form of schema ``ambid.fit/1``. With several inputs B and F are lists of lists of
    coefficients, with several outputs ``polynomials`` and ``sd`` have an entry for each; with one, ``one_step`` and
    ``simulation`` stand beside it. Of a response's fit ``noise_variance`` and ``noise_covariance`` are null, and
    ``noise`` says why.
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
        letters: list[dict[str, Any]] = [{"A": None, "B": [], "C": None, "D": None, "F": []} for _ in outputs]
        for o, letter, i, place in model.blocks():
            p = theta[place].tolist()
            if i is None:
                letters[o][letter] = p
            else:
                letters[o][letter].append(p)
        for p in letters if model.n_inputs == 1 else []:
            p["B"], p["F"] = p["B"][0], p["F"][0]
        return "polynomials", letters[0] if len(outputs) == 1 else dict(zip(outputs, letters, strict=True))
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
    array = read_as(Array, value, what)
    if not np.all(np.abs(array) <= _LARGEST):
        raise ValueError(f"{what} is not finite, or too large")
    return array


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
    entries = [d["polynomials"]] if len(outputs) == 1 else [d["polynomials"][o] for o in outputs]
    one = len(inputs) == 1
    sets = tuple(
        Polynomials(
            A=_finite(p["A"], "A"),
            B=tuple(_finite(x, "B") for x in ([p["B"]] if one else p["B"])),
            C=_finite(p["C"], "C"),
            D=_finite(p["D"], "D"),
            F=tuple(_finite(x, "F") for x in ([p["F"]] if one else p["F"])),
        )
        for p in entries
    )
    if dt is None:
        raise ValueError("a polynomial model is discrete")
    return PolynomialModel(outputs=sets, dt=dt)
