"""The estimate: parameters with covariance, model, fit, checks, warnings, timings, provenance; and its JSON, written
and read by annotations of frozen dataclasses. Numbers that are not finite are null; null is read as NaN for a number.
"""

from __future__ import annotations

import json
import math
import types
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from functools import lru_cache
from pathlib import PurePath
from types import MappingProxyType
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import AmbidError, EstimationError
from ambid.estimation.colours import Colour
from ambid.estimation.global_search import describe_search
from ambid.estimation.parameters import EstimatedParameter as EstimatedParameter
from ambid.estimation.parameters import Parametric as Parametric
from ambid.estimation.result import NORMAL_95, Linear, Predicting, Reason, Result, Simulating
from ambid.physics.linear_model import LinearModel, model
from ambid.settings.caller import command, saved

_ROUNDING = 1e-9  # samples
_EDITED, _ROUNDED = 1e-9, 1e-12  # relative difference, and share of the largest, that rounding does not explain
_SEEN = 0.25  # relative standard deviation up to which data show a coefficient


@dataclass(frozen=True, slots=True, kw_only=True)
class Delay:
    """Delay of an input: `samples` whole periods and a `fraction` of one."""

    samples: int
    fraction: float  # 0 <= fraction < 1
    sd: float | None  # standard deviation of samples + fraction, where it was estimated as a real number
    how: Literal["estimated", "given"]

    @classmethod
    def of(cls, total: float, sd: float | None, how: Literal["estimated", "given"]) -> Delay:
        """Return a delay of `total` samples; a whole one less the rounding of its sum stays whole."""
        whole = math.floor(total + _ROUNDING)
        return cls(samples=whole, fraction=max(float(total) - whole, 0.0), sd=sd, how=how)


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """Outcome of one check."""

    passed: bool
    detail: str  # one line for people: what was looked at, what was found, what to do
    p: float | None = None  # probability of a result at least as extreme if the model is right
    values: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))  # further numbers
    grave: bool = False  # where it failed: no number is to be used
    cause: str = ""  # what explains a failure best, its size, and causes that explain it about as well
    size: float | None = None
    alternatives: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputFit:
    """How well one output is predicted: 1 - |e| / |y - mean|, 1 is perfect."""

    one_step: float  # from all samples before
    simulation: float | None  # from the input alone; None where the plant is unstable in open loop
    innovation_sd: float  # SI


_GRAVE = frozenset(
    {
        "units", "plausible", "delay_in_range", "in_time", "finite_prediction", "stable_predictor", "response_fit",
        "belonging", "position_size",
    }
)  # fmt: skip
"""Checks after whose failure no number is to be used."""
_OF_THE_RECORD = ("belonging", "position_size", "resolution", "signals_sound", "log_runs", "sampling")
"""Checks of the record itself: what they find is told first, in this order."""
_EVIDENCE = frozenset({"ohm", "gravity_balance", "carries_its_weight", "fixed_agree", "loop_agrees", "sampling"})
"""Checks of a fact each: two that contradict the estimate are as grave as one above."""


def _independent(against: Mapping[str, Check]) -> int:
    """Count facts against an estimate; those that one fault explains, a reversed position or an offset, count once."""
    facts = _EVIDENCE & against.keys()
    once = {"gravity_balance", "loop_agrees"} <= facts
    offsets = [against[k].values.get("current_offset", 0.0) for k in ("ohm", "gravity_balance") if k in facts]
    same = len(offsets) == 2 and offsets[0] * offsets[1] > 0.0 and 0.5 < offsets[0] / offsets[1] < 2.0
    return len(facts) - once - same


_UNFINISHED = {
    "stalled": "the search did not converge: its numbers are a first guess. Excite more, or give start values",
    "failed": "the search found no model of this record. Check columns, signs and fixed values",
}


class Judged(Result):
    """A result with a status and checks."""

    __slots__ = ()
    status: str
    checks: Mapping[str, Check]

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """A search that did not end well, and each check that failed, on a second record too."""
        failed = (
            [] if self.status == "converged" else [Reason(check="status", text=_UNFINISHED[self.status], grave=True)]
        )
        against = {k: c for k, c in self.checks.items() if not c.passed}
        contradicted = _independent(against) > 1
        grave = {k for k, c in against.items() if c.grave or k in _GRAVE or (contradicted and k in _EVIDENCE)}
        if grave:  # a fault of the record is what made the others grave
            grave |= {k for k, c in against.items() if k in _OF_THE_RECORD and c.cause}
        names = [*filter(against.__contains__, _OF_THE_RECORD)]
        names += sorted(against.keys() - set(names), key=lambda k: (not against[k].cause, [*against].index(k)))
        failed += [
            Reason(check=k, text=c.detail, grave=k in grave, cause=c.cause, size=c.size, alternatives=c.alternatives)
            for k, c in ((k, against[k]) for k in names)
        ]
        failed.sort(key=lambda r: r.check not in _OF_THE_RECORD)
        second = (getattr(self, "validation", None) or {}).get("checks", {})
        failed += [Reason(check=f"validation.{k}", text=c["detail"]) for k, c in second.items() if not c["passed"]]
        return tuple(failed)


E = TypeVar("E", bound=Parametric)


def disowned(estimate: E) -> E:
    """Return an estimate; where its own checks let none of it be used, no number of it is identifiable."""
    made = cast("Any", estimate)
    if made.verdict.word != "unusable":
        return estimate
    parameters = tuple(replace(p, identifiable=p.role == "fixed") for p in estimate.parameters)
    return cast("E", replace(made, parameters=parameters))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class FittedModel(Parametric, Judged, Predicting, Simulating):
    """What the fits of all structures hold, linear or not; their own classes say what it means there."""

    structure: str
    covariance: Array | None
    n_estimated: int
    noise_covariance: Array
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: Mapping[str, str]
    dt: float
    fit: Mapping[str, OutputFit] = field(default_factory=lambda: MappingProxyType({}))
    criteria: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    checks: Mapping[str, Check] = field(default_factory=lambda: MappingProxyType({}))
    validation: Mapping[str, object] | None = None
    warnings: tuple[str, ...] = ()
    timing_s: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    details: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def parameters(self) -> tuple[EstimatedParameter, ...]:  # type: ignore[override]
        """Coefficients by the model's names, SI; one that was not estimated is fixed."""
        model: Any = getattr(self, "model", None)
        if model is None:
            return ()
        spread = np.full(model.theta.size, np.nan) if self.sd is None else self.sd
        return tuple(
            EstimatedParameter(
                name=name, unit="1", value=x, sd=sd, ci95=(x - NORMAL_95 * sd, x + NORMAL_95 * sd),
                role="fixed" if sd == 0 else "free", identifiable=bool(sd <= _SEEN * abs(x)),
            )
            for name, x, sd in zip(model.names, model.theta.tolist(), spread.tolist(), strict=True)
        )  # fmt: skip

    @property
    def sd(self) -> Array | None:
        """Standard deviation of ``model.theta``, shape (n_theta,), or None."""
        return None if self.covariance is None else np.sqrt(np.maximum(np.diag(self.covariance), 0.0))


T = TypeVar("T")
FIT_SCHEMA = "ambid.fit/1"

COVARIANCE = types.MappingProxyType(
    {"names": "covariance_names", "matrix": "covariance", "method": "covariance_method"}
)
"""Fields that stand together as the entry ``covariance``."""


def plain_json(value: Any) -> Any:
    """Return anything that a result holds as plain JSON values: complex numbers as pairs, None where not finite."""
    if isinstance(value, (bool, str)) or value is None:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, (PurePath, AmbidError)):
        return str(value)
    if isinstance(value, Mapping):
        return {str(k): plain_json(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        if value and all(isinstance(v, EstimatedParameter) for v in value):
            return {p.name: plain_json(p) for p in value}
        return [plain_json(v) for v in value]
    if isinstance(value, np.ndarray):
        regular = value.dtype.kind == "f" and bool(np.isfinite(value).all())
        return value.tolist() if regular else plain_json(value.tolist())
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (complex, np.complexfloating)):
        return [plain_json(value.real), plain_json(value.imag)]
    if is_dataclass(value) and not isinstance(value, type):
        return _WRITERS.get(type(value), fields_json)(value)
    number = float(value)
    return number if math.isfinite(number) else None


def fields_json(value: Any, *, without: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return the fields of a dataclass as JSON values, by name, and the verdict of a result that has one."""
    written = (f.name for f in fields(value) if f.name not in without and f.metadata.get("written", True))
    entries = {name: plain_json(getattr(value, name)) for name in written}
    return {"verdict": plain_json(value.verdict), **entries} if isinstance(value, Result) else entries


def covariance_together(document: dict[str, Any]) -> dict[str, Any]:
    """Return a document whose fields of the covariance stand together as one entry."""
    entry = {key: document[name] for key, name in COVARIANCE.items() if name in document}
    rest = {key: value for key, value in document.items() if key not in COVARIANCE.values()}
    return {**rest, "covariance": entry}


def covariance_apart(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document whose fields of the covariance stand as the dataclass has them."""
    together = document["covariance"]
    return {**document, **{name: together[key] for key, name in COVARIANCE.items() if key in together}}


def by_output(document: dict[str, Any]) -> dict[str, Any]:
    """Return a document whose ``fit`` and ``validation``, where there is one output, stand at their top as well."""
    for entry in ("fit", "validation"):
        entry_by_output = document[entry]
        if entry_by_output is not None and len(entry_by_output) == 1:
            first = next(iter(entry_by_output.values()))
            document[entry] = {**first, **{o: v for o, v in entry_by_output.items() if o not in first}}
    return document


def only_outputs(document: Mapping[str, Any], outputs: tuple[str, ...]) -> dict[str, Any]:
    """Return a document whose ``fit`` and ``validation`` have the outputs alone."""
    judged = document["validation"]
    return {
        **document,
        "fit": {o: document["fit"][o] for o in outputs if o in document["fit"]},
        "validation": None if judged is None else {o: judged[o] for o in outputs},
    }


def fit_document(fit: FittedModel, more: Mapping[str, Any], without: tuple[str, ...]) -> dict[str, Any]:
    """Return a fit in the form of schema ``ambid.fit/1``: its fields but some, and `more`."""
    document = fields_json(fit, without=("model", "dt", "covariance", *without))
    return by_output({"schema": FIT_SCHEMA, **document, **plain_json({"rate_hz": 1.0 / fit.dt, **more})})


def read_fit(read: Callable[[Mapping[str, Any]], T], document: Mapping[str, Any], where: str) -> T:
    """Read a fit back; `where` is the name of its file, for messages."""
    check_schema(document, FIT_SCHEMA, where, "a fit", "fit")

    def whole() -> Any:
        fit: Any = read(document)
        model, p = fit.model, len(fit.outputs)
        if fit.noise_covariance.shape != (p, p):
            raise ValueError("the noise covariance is not of the outputs")
        if model is not None and (model.n_inputs, model.n_outputs) != (len(fit.inputs), p):
            raise ValueError("inputs, outputs and model are not of the same size")
        if model is not None and fit.covariance is not None and fit.covariance.shape != (model.theta.size,) * 2:
            raise ValueError("the covariance is not of the model's numbers")
        return fit

    return cast("T", read_whole(whole, where, "fit", "fit"))


def json_text(document: Mapping[str, Any]) -> str:
    """Return the text of a document, with a line feed at its end."""
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def check_schema(document: object, schema: str, where: str, what: str, job: str) -> None:
    """Refuse a document of another schema."""
    own = document.get("schema") if isinstance(document, Mapping) else type(document).__name__
    if own != schema:
        raise EstimationError(f"{where} has schema {own!r}; {what} has {schema!r}. Give {saved(job)}")


def read_whole(read: Callable[[], T], where: str, what: str, job: str) -> T:
    """Return what a reader makes of a document; whatever it stumbles over is one line that names the file."""
    try:
        return read()
    except (AmbidError, AttributeError, ArithmeticError, KeyError, TypeError, ValueError, IndexError) as error:
        raise EstimationError(
            f"{where} is not a complete {what} ({type(error).__name__}: {error}). "
            f"Write it again with '{command(job, json=True)}'"
        ) from error


def read_as(kind: type[T], value: Any, at: str = "") -> T:
    """Read JSON as what an annotation says, or raise ValueError with the path of an entry that is missing or of another
    type. Kinds that no rule is for, such as ``object``, take the value as it is.
    """
    return cast("T", _read(kind, value, at))


def _read(kind: Any, value: Any, at: str) -> Any:
    origin, inner = get_origin(kind), get_args(kind)
    if isinstance(kind, type) and issubclass(kind, (PurePath, AmbidError)):
        return kind(_READERS[str](value, at))
    if kind in _READERS:
        return _READERS[kind](value, at)
    if is_dataclass(kind):
        return value if isinstance(value, cast("type", kind)) else _dataclass(kind, value, at)
    if origin is np.ndarray:
        return _array(inner[1], value, at)
    if origin in (Union, types.UnionType):
        return _first(inner, value, at)
    if origin is Literal:
        return value if value in inner else _refuse(value, at, " or ".join(map(repr, inner)))
    if origin is tuple:
        return _tuple(inner, value, at)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        entries = value if isinstance(value, Mapping) else _refuse(value, at, "an object")
        return {str(k): _read(inner[1], v, f"{at}.{k}") for k, v in entries.items()}
    return value


def _dataclass(kind: Any, value: Any, at: str) -> Any:
    if not isinstance(value, Mapping):
        _refuse(value, at, "an object")
    hints, entries = _hints(kind), {}
    for f in fields(kind):
        place = f"{at}.{f.name}".lstrip(".")
        if f.name in value:
            entries[f.name] = _read(hints[f.name], value[f.name], place)
        elif f.default is MISSING and f.default_factory is MISSING:
            raise ValueError(f"{place!r} is missing")
    return kind(**entries)


@lru_cache(maxsize=64)
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind)


def _first(kinds: tuple[Any, ...], value: Any, at: str) -> Any:
    """Read a union: None where it may stand, else as the first kind that takes the value."""
    if value is None and types.NoneType in kinds:
        return None
    others = [kind for kind in kinds if kind is not types.NoneType]
    for kind in others[:-1]:
        try:
            return _read(kind, value, at)
        except (TypeError, ValueError):
            continue
    return _read(others[-1], value, at)


def _tuple(kinds: tuple[Any, ...], value: Any, at: str) -> tuple[Any, ...]:
    if kinds == (EstimatedParameter, ...) and isinstance(value, Mapping):
        return tuple(_parameter(name, p, f"{at}.{name}") for name, p in value.items())
    if not isinstance(value, (list, tuple)):
        _refuse(value, at, "a list")
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        return tuple(_read(kinds[0], v, f"{at}[{k}]") for k, v in enumerate(value))
    if len(value) != len(kinds):
        _refuse(value, at, f"{len(kinds)} values")
    return tuple(_read(kind, v, f"{at}[{k}]") for k, (kind, v) in enumerate(zip(kinds, value, strict=True)))


def _array(dtype: Any, value: Any, at: str) -> Any:
    """Read numbers, null as NaN; text and truth values are no numbers. An array is taken as it is."""
    if isinstance(value, np.ndarray):
        return value
    array, kinds = np.array(value), get_args(dtype)
    if kinds == (np.bool_,) and array.dtype.kind == "b":
        return array
    if array.size and array.dtype.kind == "O":
        array = np.array(value, dtype=np.float64)  # null becomes NaN; anything else raises
    if array.size and array.dtype.kind not in "iuf":
        _refuse(value, at, "numbers")
    if kinds == (np.complex128,):
        pairs = array.astype(np.float64).reshape(-1, 2)
        return pairs[:, 0] + 1j * pairs[:, 1]
    return array.astype(np.int64 if kinds == (np.int64,) and array.dtype.kind in "iu" else np.float64)


def _number(value: Any, at: str) -> float:
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        _refuse(value, at, "a number")
    return float(value)


def _exactly(kind: type, what: str) -> Callable[[Any, str], Any]:
    def read(value: Any, at: str) -> Any:
        wrong = not isinstance(value, kind) or (kind is int and isinstance(value, bool))
        return _refuse(value, at, what) if wrong else value

    return read


def _check(value: Any, at: str) -> Check:
    numbers = {name: x for name, x in value.items() if name not in _OF_CHECKS}
    return cast("Check", _dataclass(Check, {**value, "values": numbers}, at))


def _parameter(name: str, value: Any, at: str) -> EstimatedParameter:
    if not isinstance(value, Mapping):
        _refuse(value, at, "an object")
    return cast("EstimatedParameter", _dataclass(EstimatedParameter, {**value, "name": name}, at))


def _refuse(value: Any, at: str, wanted: str) -> Any:
    text = repr(value)
    raise ValueError(f"{at or 'it'} is {text if len(text) <= 40 else text[:37] + '...'} instead of {wanted}")


_OF_CHECKS = tuple(f.name for f in fields(Check) if f.name != "values")


def _write_check(check: Check) -> dict[str, Any]:
    p = {} if check.p is None else {"p": plain_json(check.p)}
    named = {"cause": check.cause, "size": check.size, "alternatives": check.alternatives, "grave": check.grave}
    given = {name: plain_json(x) for name, x in named.items() if x not in ("", None, (), False)}
    return {"passed": bool(check.passed), **p, **plain_json(check.values), **given, "detail": check.detail}


def _write_delay(delay: Delay) -> dict[str, Any]:
    return {**fields_json(delay), "total": plain_json(delay.samples + delay.fraction)}


def _write_parameter(p: EstimatedParameter) -> dict[str, Any]:
    return fields_json(p, without=("name",) if p.data_share is not None else ("name", "data_share"))


_WRITERS: dict[type, Callable[[Any], dict[str, Any]]] = {
    Check: _write_check,
    Delay: _write_delay,
    EstimatedParameter: _write_parameter,
}
_READERS: dict[Any, Callable[[Any, str], Any]] = {
    Check: _check,
    float: _number,
    int: _exactly(int, "a whole number"),
    bool: _exactly(bool, "true or false"),
    str: _exactly(str, "text"),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Continuous:
    """Identified continuous-time plant x' = A x + B u, y = C x in SI units."""

    states: tuple[str, ...]
    A: Array  # (n_states, n_states)
    B: Array  # (n_states, n_inputs)
    C: Array  # (n_outputs, n_states)
    poles: NDArray[np.complex128]  # (n_states,), complex, rad/s

    @classmethod
    def of(cls, plant: LinearModel, theta: Mapping[str, float]) -> Continuous:
        """Return the plant of a model with its numbers."""
        at = plant.matrices(theta)
        poles = np.linalg.eigvals(at.A).astype(np.complex128)
        return cls(states=plant.states, A=at.A, B=at.B, C=at.C, poles=poles)

    def check_is_of(self, plant: LinearModel, theta: Mapping[str, float]) -> None:
        """Raise ValueError where this is not the plant of a model with its numbers: one of both was edited."""
        at = plant.matrices(theta)
        for name, here, there in (("A", self.A, at.A), ("B", self.B, at.B), ("C", self.C, at.C)):
            if here.shape != there.shape or not np.allclose(
                here, there, rtol=_EDITED, atol=_ROUNDED * abs(there).max()
            ):
                raise ValueError(f"continuous.{name} does not follow from the parameters: one of both was edited")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoiseModel:
    """Noise as the predictor describes it, SI units."""

    # sensor noise alone; disturbance and sensor levels; or a free predictor gain
    form: Literal["sensors", "levels", "gain"]
    gain: Array  # (n_states, n_outputs), predictor gain K of x[k+1] = A x[k] + B u + K e[k]
    innovation_covariance: Array  # (n_outputs, n_outputs)
    disturbance_sd: Mapping[str, float]  # held-over-a-sample disturbances and sensor noise; empty for a free gain
    sensor_sd: Mapping[str, float]
    colours: tuple[Colour, ...] = ()  # coloured parts, whose states and disturbances come last


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Estimate(Parametric, Judged, Predicting, Simulating, Linear):
    """Result of the main job.

    Attributes
    ----------
    status : {"converged", "stalled", "failed"}
    model : str
    record : Mapping[str, object]
        ``samples``, ``rate_hz``, ``sha256``, ``file`` and history of the record.
    parameters : tuple of EstimatedParameter
        In the model's order.
    covariance_names : tuple of str
        Estimated parameters, order of `covariance`.
    covariance : ndarray, shape (n, n), SI
        Of the estimated parameters, as used for their standard deviations.
    covariance_method : {"information", "robust"}
    delay : Mapping[str, Delay]
        By input role.
    continuous : Continuous
    noise : NoiseModel
    operating_point : Mapping[str, float]
        Means of the record that were taken off, by role, SI.
    fit : Mapping[str, OutputFit]
        By output role.
    checks : Mapping[str, Check]
    sensitivity : Mapping[str, Any]
        Peak of the sensitivity of axis ``x``, where a loop is known or a reference is logged.
    calibration : Mapping[str, Mapping[str, float]]
        By channel, ``"rate"`` and fixed value, the per cent by which an error of 1 % would move each estimated
        parameter.
    calibration_sd : Mapping[str, float]
        What the rig says of these errors: relative standard deviations of gains and rate, SI ones of offsets
        (``"current.offset"``), which move the operating point alone.
    validation : Mapping[str, object] or None
        Results on a second record.
    warnings : tuple of str
    timing_s : Mapping[str, float]
    information : Mapping[str, object]
        Singular values of the scaled information matrix and the weakest direction.
    rig : Mapping[str, object]
        Name and channels of the rig, so that another record can be judged alike.
    global_search : Mapping[str, object] or None
        What a global search did where the ordinary starts failed: ``why``, ``evaluations``, ``seconds``,
        ``criterion_before`` and ``criterion_after`` (per sample; None where there was none), ``taken``,
        ``interrupted``. None: it was not needed.
    extended : tuple of str
        Causes that checks named and the model was extended by, whose sizes were estimated too.
    bias_sd : Mapping[str, float]
        Part of each estimated parameter's deviation that more data would not average out, SI, and by how much causes in
        `extended` moved it, which a model without them does not hold.
    coloured : NoiseModel or None
        Noise with its coloured parts, where it has any: `noise` is the likeliest white one.
    """

    status: Literal["converged", "stalled", "failed"]
    model: str
    record: Mapping[str, object]
    parameters: tuple[EstimatedParameter, ...]
    covariance_names: tuple[str, ...]
    covariance: Array
    covariance_method: Literal["information", "robust"]
    delay: Mapping[str, Delay]
    continuous: Continuous
    noise: NoiseModel
    operating_point: Mapping[str, float]
    fit: Mapping[str, OutputFit]
    checks: Mapping[str, Check]
    sensitivity: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    calibration: Mapping[str, Mapping[str, float]] = field(default_factory=lambda: MappingProxyType({}))
    calibration_sd: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    validation: Mapping[str, object] | None = None
    warnings: tuple[str, ...] = ()
    timing_s: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    information: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    rig: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    global_search: Mapping[str, object] | None = None
    extended: tuple[str, ...] = ()
    bias_sd: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    coloured: NoiseModel | None = None

    @property
    def whole_noise(self) -> NoiseModel:
        """Noise with its coloured parts, where it has any."""
        return self.coloured or self.noise

    def dumps(self) -> str:
        """Return the estimate as JSON text, schema ``ambid.estimate/1``.

        Returns
        -------
        str
        """
        return estimate_text(self)


SCHEMA = "ambid.estimate/1"


def estimate_text(estimate: Estimate) -> str:
    """Return the JSON text of an estimate."""
    return json_text(estimate_to_json(estimate))


def estimate_to_json(estimate: Estimate) -> dict[str, Any]:
    """Return an estimate in the form of schema ``ambid.estimate/1``: SI values, JSON numbers only.

    Parameters
    ----------
    estimate : Estimate

    Returns
    -------
    dict
    """
    return {"schema": SCHEMA, **covariance_together(fields_json(estimate))}


def estimate_from_json(document: Mapping[str, Any], where: str) -> Estimate:
    """Read an estimate back.

    Parameters
    ----------
    document : Mapping
        Parsed JSON of schema ``ambid.estimate/1``.
    where : str
        Name of the file, for messages.

    Returns
    -------
    Estimate

    Raises
    ------
    EstimationError
        If the document is not an estimate, or lacks an entry.
    """
    check_schema(document, SCHEMA, where, "an estimate", "identify")

    def read() -> Estimate:
        estimate = read_as(Estimate, covariance_apart(document))
        _check_consistent(estimate)
        return estimate

    return read_whole(read, where, "estimate", "identify")


def _check_consistent(estimate: Estimate) -> None:
    """Raise ValueError where the parts do not belong together: an edited file, or one of another program."""
    plant = model(estimate.model)
    specs = {p.name: p for p in plant.parameters}
    n, n_y = len(plant.states), len(plant.outputs)
    if [p.name for p in estimate.parameters] != list(specs):
        raise ValueError(f"the parameters are not those of model {estimate.model!r}")
    for p in estimate.parameters:
        if p.sd < 0:
            raise ValueError(f"{p.name} has the standard deviation {p.sd:g}")
        if p.unit != specs[p.name].unit:
            raise ValueError(f"{p.name} is in {p.unit!r} instead of {specs[p.name].unit!r}")
        if not 1e-15 < abs(p.value) < 1e15 and (p.name in ("m", "L") or p.value != 0):
            raise ValueError(f"{p.name} = {p.value:g} is not a number that a plant can have")
    at, rest = estimate.continuous, estimate.operating_point
    if not all(math.isfinite(rest.get(role, math.nan)) for role in (*plant.inputs, *plant.outputs)):
        raise ValueError("the operating point is not that of the inputs and outputs")
    if at.A.shape != (n, n) or at.B.shape != (n, len(plant.inputs)) or at.C.shape != (n_y, n):
        raise ValueError("the continuous plant is not of the model's size")
    colours = estimate.whole_noise.colours
    if estimate.noise.colours or any(
        c.source not in (*plant.disturbances, *plant.outputs) or not c.omega > 0.0 for c in colours
    ):
        raise ValueError("the coloured noise is not of the model's disturbances and outputs")
    for noise, more in ((estimate.noise, 0), (estimate.whole_noise, sum(c.order for c in colours))):
        if noise.gain.shape != (n + more, n_y) or noise.innovation_covariance.shape != (n_y, n_y):
            raise ValueError("the noise model is not of the model's size")
    size = len(estimate.covariance_names)
    if set(estimate.covariance_names) - set(specs) or estimate.covariance.shape != (size, size):
        raise ValueError("the covariance is not of the parameters")
    at.check_is_of(plant, estimate.values)
    if int(str(estimate.record["samples"])) < 1:
        raise ValueError("the record has no samples")
    if not float(str(estimate.record["rate_hz"])) > 0 or estimate.status not in ("converged", "stalled"):
        raise ValueError("the record's rate or the status is not that of a finished estimate")
    for delay in (estimate.delay[role] for role in plant.inputs):
        if not 0 <= delay.samples < 10**6 or not 0 <= delay.fraction < 1:
            raise ValueError("the delay is not whole samples and a fraction")


def warnings_of(fit: Any, checks: Mapping[str, Check], inflated_by: str) -> tuple[str, ...]:
    """Return what a reader has to know of a `fit` before using its values, most important first. `inflated_by`: where
    its robust standard deviations come from; empty if not used.
    """
    warnings = [] if fit.status == "converged" else ["the search did not converge: treat the values as a first guess"]
    warnings += [] if fit.global_search is None else [describe_search(fit.global_search)]
    warnings += [c.detail for c in checks.values() if not c.passed]
    if inflated_by:
        warnings.append(
            f"the model does not fully fit; standard errors are inflated ({inflated_by}) but cannot cover a systematic "
            "bias"
        )
    return tuple(warnings)
