"""Nonlinear models, fits, their files (schema ``ambid.fit/1``), their settings, and the register of structures.

An ``estimator(records, settings, *, seed=0, tick=None) -> NonlinearFit`` takes `IOData` of one bench (same channels and
rate) and calls `tick` (`ambid.estimation.estimate.Tick`), whose KeyboardInterrupt ends in the best model so far, status
``stalled``. Divergence ends in ``failed`` with a reason; an exception is a request that makes no sense.
`ambid.validation.fits` adds `fit`, `criteria`, `checks`; `tests/nonlinear/test_conformance.py` runs on every entry.
Settings are a frozen dataclass of `whole`, `number`, `choice` or `text`; what is left out, or ``auto`` without a
default of its own, the method chooses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from importlib import import_module
from operator import attrgetter
from time import perf_counter
from types import MappingProxyType
from typing import Any, Literal, Protocol, TypeVar

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError, choices
from ambid.estimation.estimate import FittedModel, fit_document, json_text, only_outputs, read_as, read_fit
from ambid.estimation.search import Found

Settings = Mapping[str, int | float | str | tuple[int, ...]]
"""What a structure is told: lags, degrees, neurons, ..., by name; what is left out the method chooses and reports."""


class NonlinearModel(Protocol):
    """A discrete-time model of inputs and outputs, in SI units of the record; time is axis 0.

    A model that works on scaled or centred signals does so inside. All arrays are read only for it.

    Attributes
    ----------
    kind : str
        Under which `nonlinear.fit` writes and finds it.
    dt : float
        Sampling interval in s.
    n_inputs, n_outputs : int
        Channels.
    lag : int
        Samples of the past that a prediction needs.
    names : tuple of str
        Of all parameters, in the order of `theta`.
    theta : ndarray, shape (n_theta,)
        All parameters.
    """

    @property
    def kind(self) -> str: ...  # noqa: D102
    @property
    def dt(self) -> float: ...  # noqa: D102
    @property
    def n_inputs(self) -> int: ...  # noqa: D102
    @property
    def n_outputs(self) -> int: ...  # noqa: D102
    @property
    def lag(self) -> int: ...  # noqa: D102
    @property
    def names(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def theta(self) -> Array: ...  # noqa: D102

    def predict(self, u: Array, y: Array) -> Array:
        """Return one-step-ahead predictions of the outputs from past outputs and inputs.

        Parameters
        ----------
        u : ndarray, shape (n_samples, n_inputs), SI
        y : ndarray, shape (n_samples, n_outputs), SI

        Returns
        -------
        ndarray, shape (n_samples, n_outputs), SI
            The first `lag` rows are NaN: there is no past to predict them from.

        Raises
        ------
        EstimationError
            If the signals are not of the model's shape.
        """
        ...

    def jacobian(self, u: Array, y: Array) -> Array:
        """Return the exact derivative of `predict` by `theta`.

        Parameters
        ----------
        u : ndarray, shape (n_samples, n_inputs), SI
        y : ndarray, shape (n_samples, n_outputs), SI

        Returns
        -------
        ndarray, shape (n_samples, n_outputs, n_theta)
            The first `lag` rows are zero.

        Raises
        ------
        EstimationError
            If the signals are not of the model's shape.
        """
        ...

    def simulate(self, u: Array, y: Array) -> Array:
        """Run freely from the first `lag` measured samples on, without noise.

        Parameters
        ----------
        u : ndarray, shape (n_samples, n_inputs), SI
        y : ndarray, shape (at least lag, n_outputs), SI
            Only the first `lag` rows are looked at.

        Returns
        -------
        ndarray, shape (n_samples, n_outputs), SI
            The first `lag` rows are those of `y`. NaN from where a run diverges on (here: leaves
            a million times the size of the training data); never clipped.

        Raises
        ------
        EstimationError
            If the signals are not of the model's shape.
        """
        ...

    def novelty(self, u: Array, y: Array) -> Array:
        """Say how far from the training data a prediction is made.

        Parameters
        ----------
        u : ndarray, shape (n_samples, n_inputs), SI
        y : ndarray, shape (n_samples, n_outputs), SI

        Returns
        -------
        ndarray, shape (n_samples,)
            0 in the middle of what was trained on, 1 at its edge, above 1 outside: there the model extrapolates. The
            first `lag` rows are NaN.

        Raises
        ------
        EstimationError
            If the signals are not of the model's shape.
        """
        ...

    def as_json(self) -> dict[str, Any]:
        """Return all that `nonlinear.fit` needs to read it back; numbers survive bit by bit."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LearningCurve:
    """How a training went."""

    method: str  # what trained, e.g. ``"Levenberg-Marquardt"``.
    seconds: Array  # (n_iterations,), s, since it began
    # (n_iterations,), root mean square errors in multiples of the outputs' standard deviations; `held_out` is empty
    # where nothing was
    training: Array
    held_out: Array = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class NonlinearFit(FittedModel):
    """An identified nonlinear model, file schema ``ambid.fit/1``.

    Attributes
    ----------
    structure : str
        Name in `ambid.nonlinear.fit`.
    settings : Mapping[str, object]
        As used, nothing left open.
    model : NonlinearModel or None
        None where `status` is ``failed``.
    covariance : ndarray, shape (n_theta, n_theta) or None
        Of ``model.theta``; zeros where a parameter was not estimated. None where the method has none to give.
    covariance_from : str
        ``"information"``, ``"laplace"``, ``"sandwich"`` (errors not taken as white); empty without.
    n_estimated : int
        Numbers that were estimated.
    noise_covariance : ndarray, shape (n_outputs, n_outputs), SI
        Of the one-step errors (of the simulation errors for a model that was fitted to those).
    inputs, outputs, warnings : tuple of str
    units : Mapping[str, str]
        SI unit by channel.
    dt : float, s
    records : tuple of Mapping
        ``samples``, ``rate_hz``, ``sha256``, ``file`` of each record that it was estimated from.
    seed : int
        Of everything random: equal seeds give equal results.
    status : {"converged", "stalled", "failed"}
    reason : str
        Of a failed fit, one line; else empty.
    curves : tuple of LearningCurve
        Of each training that was done.
    fit : Mapping[str, OutputFit]
        By output, over all records.
    criteria, timing_s : Mapping[str, float]
        ``aic``, ``aicc``, ``bic``, ``mdl``, ``fpe``; seconds by stage.
    checks : Mapping[str, Check]
        Made by `ambid.validation.fits`.
    validation : Mapping[str, object] or None
        By output, on a second record.
    details : Mapping[str, object]
        Further results of the method as JSON-able values (terms with their error reduction ratios, chosen lags).
    """

    settings: Mapping[str, object]
    model: NonlinearModel | None
    records: tuple[Mapping[str, object], ...]
    seed: int = 0
    covariance_from: str = ""
    status: Literal["converged", "stalled", "failed"] = "converged"
    reason: str = ""
    curves: tuple[LearningCurve, ...] = ()


NO_WEIGHTS = "no finite weights were found: the columns vary too much in size from sample to sample; check them"
"""Why the weights of a network that looks at measured signals alone come to nothing."""


@dataclass(slots=True, kw_only=True)
class Attempt:
    """What a fit has come to, so that an interruption loses nothing."""

    structure: str
    records: Sequence[IOData]
    settings: dict[str, Any]  # as used
    seed: int = 0
    status: Literal["converged", "stalled"] = "converged"
    curves: list[LearningCurve] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    timing_s: dict[str, float] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time of what is done inside to a stage."""
        began = perf_counter()
        try:
            yield
        finally:
            self.timed(name, began)

    def timed(self, stage: str, began: float) -> float:
        """Add what a stage took since `began`, and return when the next one begins."""
        now = perf_counter()
        self.timing_s[stage] = self.timing_s.get(stage, 0.0) + now - began
        return now

    def note_curve(self, ended: Found, method: str, n: int, size: float) -> None:
        """Add the learning curve of a search over `n` errors of unit variance, `size` in deviations of the outputs."""
        curve = LearningCurve(
            method=method,
            seconds=np.array(ended.seconds),
            training=np.sqrt(np.array(ended.costs) / max(n, 1)) * size,
            held_out=np.array(ended.held_out),
        )
        self.curves.append(curve)

    def interrupt(self) -> None:
        """Say that the search was interrupted."""
        self.status = "stalled"
        self.warnings.insert(0, "interrupted: the best model so far")

    def guarded(self, identify: Callable[[], None]) -> str:
        """Run the stages of a fit and return why they broke down; an interruption leaves the best model so far."""
        began = perf_counter()
        try:
            identify()
        except KeyboardInterrupt:
            self.interrupt()
        except (np.linalg.LinAlgError, FloatingPointError) as error:
            self.timing_s["all"] = perf_counter() - began
            return f"the training failed: {error}"
        return ""

    def failed(self, reason: str) -> NonlinearFit:
        """Return a fit without a model, for a reason of one line."""
        p = self.records[0].n_outputs
        return self._fit(
            model=None, covariance=None, n_estimated=0, noise_covariance=np.full((p, p), np.nan), status="failed",
            reason=reason,
        )  # fmt: skip

    def result(self, **fields: Any) -> NonlinearFit:
        """Return the fit of a model; `fields` are the other fields of `NonlinearFit`."""
        return self._fit(
            status=self.status, curves=tuple(self.curves), warnings=tuple(self.warnings), details=dict(self.details),
            **fields,
        )  # fmt: skip

    def _fit(self, **fields: Any) -> NonlinearFit:
        first = self.records[0]
        return NonlinearFit(
            structure=self.structure, settings=dict(self.settings), seed=self.seed, timing_s=dict(self.timing_s),
            inputs=first.inputs, outputs=first.outputs, units=dict(first.units), dt=first.dt,
            records=tuple(dict(x.record) for x in self.records), **fields,
        )  # fmt: skip


S = TypeVar("S")


@dataclass(frozen=True, slots=True)
class _Rule:
    """What a setting may be, and the line that the register of structures has for it."""

    says: str
    low: float = 0.0
    high: float = 0.0
    whole: bool = False
    options: tuple[str, ...] = ()
    name: bool = False

    def check(self, structure: str, name: str, value: object) -> None:
        """Refuse what it may not be."""
        if self.options:
            if value not in self.options:
                raise EstimationError(
                    f"{structure}: {name} is {value!r}; it must be one of {choices(value, self.options)}"
                )
            return
        if self.name:
            return
        number = isinstance(value, int if self.whole else (int, float)) and not isinstance(value, bool)
        if not number or not self.low <= value <= self.high:  # type: ignore[operator]
            kind = "whole number" if self.whole else "number"
            raise EstimationError(
                f"{structure}: {name} is {value!r}; it must be a {kind} from {self.low} to {self.high}"
            )


def whole(says: str, low: int, high: int, default: int | None = None) -> Any:
    """Return a field for a whole number from `low` to `high`; without a default the method chooses."""
    return field(default=default, metadata={"rule": _Rule(says, low, high, whole=True)})


def number(says: str, low: float, high: float, default: float | None = None) -> Any:
    """Return a field for a number from `low` to `high`; without a default the method chooses."""
    return field(default=default, metadata={"rule": _Rule(says, low, high)})


def choice(says: str, *options: str, default: str = "") -> Any:
    """Return a field for one of some words; the first of them is the default where nothing else is said."""
    return field(default=default or options[0], metadata={"rule": _Rule(says, options=options)})


def text(says: str, default: str) -> Any:
    """Return a field for a name, which whoever reads it checks."""
    return field(default=default, metadata={"rule": _Rule(says, name=True)})


def rules(settings: type) -> dict[str, _Rule]:
    """Return the rule of each setting."""
    return {f.name: f.metadata["rule"] for f in fields(settings)}


def read_settings(settings: type[S], structure: str, values: Mapping[str, object]) -> S:
    """Check what was given by name, and complete it."""
    allowed = rules(settings)
    default = {f.name: f.default for f in fields(settings)}  # type: ignore[arg-type]
    chosen: dict[str, object] = {}
    for name, value in values.items():
        if name not in allowed:
            raise EstimationError(f"{structure}: setting {name!r} is unknown; known: {choices(name, allowed)}")
        if value == "auto" and default[name] is None:
            continue
        allowed[name].check(structure, name, value)
        chosen[name] = value
    return settings(**chosen)


@dataclass(frozen=True, slots=True, kw_only=True)
class NonlinearStructure:
    """One nonlinear structure, which a noise model makes consistent under feedback as long as it holds the true one; a
    module of `ambid.nonlinear` of its name has its estimator and its settings.
    """

    name: str  # for lists
    summary: str
    feedback: Literal["consistent", "biased", "with noise model"] = "with noise model"  # what that does to it

    @property
    def estimator(self) -> Callable[..., NonlinearFit]:
        """The function that fits it."""
        function: Callable[..., NonlinearFit] = getattr(import_module(f"ambid.nonlinear.{self.name}"), self.name)
        return function

    @property
    def settings(self) -> Mapping[str, str]:
        """Settings by name, each with a line that says what it is and what is chosen without it."""
        own = getattr(import_module(f"ambid.nonlinear.{self.name}"), f"{self.name.capitalize()}Settings")
        return {name: rule.says for name, rule in rules(own).items()}


NONLINEAR_STRUCTURES: Mapping[str, NonlinearStructure] = {
    name: NonlinearStructure(name=name, summary=summary)
    for name, summary in {
        "narmax": "polynomial difference equation; terms by orthogonal least squares; noise model",
        "nn": "state-space network whose weights are A and B (thesis fig. 5.9), with a network G(x, u)",
        "narx": "neural NARX: linear part and one hidden layer of tanh units on lagged outputs and inputs",
        "lpv": "linear model whose coefficients follow a scheduling signal such as the set point; error model",
        "hybrid": "polynomial, network for its residual, noise model C (thesis eqs 3.23-3.24)",
        "rbf": "radial basis functions of lagged outputs and inputs, with a linear part (thesis eqs 1.13-1.14)",
    }.items()
}


def nonlinear_structure(name: str) -> NonlinearStructure:
    """Return a nonlinear structure of the register by name, such as ``"narmax"``."""
    if name not in NONLINEAR_STRUCTURES:
        raise EstimationError(f"structure {name!r} is unknown; known: {choices(name, NONLINEAR_STRUCTURES)}")
    return NONLINEAR_STRUCTURES[name]


def nonlinear_fit_text(fit: NonlinearFit) -> str:
    """Return the JSON text of a nonlinear fit; equal fits give equal text."""
    return json_text(nonlinear_fit_to_json(fit))


def nonlinear_fit_to_json(fit: NonlinearFit) -> dict[str, Any]:
    """Return a nonlinear fit in the form of schema ``ambid.fit/1``. ``orders`` and ``settings`` are the same, for
    readers of linear fits; ``parameters`` names the numbers of ``model``, ``sd`` has one for each; all three null for a
    failed fit.
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

    def read(d: Mapping[str, Any]) -> NonlinearFit:
        nonlinear_structure(d["structure"])
        spread = {"matrix": None, "from": ""} if d["covariance"] is None else d["covariance"]
        fields = {
            **only_outputs(d, tuple(d["outputs"])),
            "model": None if d["model"] is None else model_from_json(d["model"]),
            "settings": {k: tuple(v) if isinstance(v, list) else v for k, v in d["settings"].items()},
            "covariance": spread["matrix"],
            "covariance_from": spread["from"],
            "dt": d["dt_s"],
        }
        fit = read_as(NonlinearFit, fields)
        if (fit.model is None) != (fit.status == "failed"):
            raise ValueError("a failed fit has no model, every other has one")
        return fit

    return read_fit(read, document, where)


MODEL_KINDS: Mapping[str, str] = MappingProxyType(
    {
        "narmax": "ambid.nonlinear.polynomial:PolynomialFunction.read_model",
        "hybrid": "ambid.nonlinear.hybrid:HybridFunction.read_model",
        "rbf": "ambid.nonlinear.rbf:RbfFunction.read_model",
        "nn": "ambid.nonlinear.state_network:StateNetwork.from_json",
        "narx": "ambid.nonlinear.narx:NarxFunction.read_model",
        "lpv": "ambid.nonlinear.lpv_model:LpvModel.from_json",
    }
)
"""Who reads a model, ``module:function`` by `NonlinearModel.kind`; imported only when one of that kind is read."""


def model_to_json(model: NonlinearModel) -> dict[str, Any]:
    """Return a model as JSON-able values: its ``kind``, and what `NonlinearModel.as_json` returns."""
    _home(model.kind)
    return {"kind": model.kind, **model.as_json()}


def model_from_json(document: Mapping[str, Any]) -> NonlinearModel:
    """Read back a model that `model_to_json` wrote."""
    if not isinstance(document, Mapping) or not isinstance(document.get("kind"), str):
        raise EstimationError("the model has no kind; a file of a nonlinear fit names it. Write the file again")
    module, name = _home(document["kind"]).split(":")
    read: Callable[[dict[str, Any]], NonlinearModel] = attrgetter(name)(import_module(module))
    try:
        return read({k: v for k, v in document.items() if k != "kind"})
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise EstimationError(
            f"no model of kind {document['kind']} ({type(error).__name__}: {error}). Write the file again"
        ) from error


def _home(kind: str) -> str:
    if kind not in MODEL_KINDS:
        raise EstimationError(f"model kind {kind!r} is unknown; known: {choices(kind, MODEL_KINDS)}")
    return MODEL_KINDS[kind]
