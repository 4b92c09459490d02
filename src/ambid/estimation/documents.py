"""Results as JSON documents and back: one writer and one reader for frozen dataclasses, driven by their annotations.

A field becomes an entry of the same name; what a schema writes in another shape (a check's numbers beside its verdict,
parameters by name) stands in the two tables below. Numbers that are not finite are null, and null is read as NaN where
a number has to stand.
"""

from __future__ import annotations

import json
import math
import types
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import lru_cache
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np

from ambid.errors import AmbidError, EstimationError
from ambid.estimation.parts import Check, Delay, EstimatedParameter

T = TypeVar("T")

COVARIANCE = types.MappingProxyType(
    {"names": "covariance_names", "matrix": "covariance", "method": "covariance_method"}
)
"""Fields that stand together as the entry ``covariance``."""


def plain_json(value: Any) -> Any:
    """Return dicts, lists, strings, booleans, numbers and None for anything that a result holds.

    Dataclasses become objects, complex numbers pairs; a number that is not finite becomes None.
    """
    if isinstance(value, (bool, str)) or value is None:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
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
    """Return the fields of a dataclass as JSON values, by name."""
    return {f.name: plain_json(getattr(value, f.name)) for f in fields(value) if f.name not in without}


def covariance_together(document: dict[str, Any]) -> dict[str, Any]:
    """Return a document whose fields of the covariance stand together as one entry."""
    found = {key: document[name] for key, name in COVARIANCE.items() if name in document}
    rest = {key: value for key, value in document.items() if key not in COVARIANCE.values()}
    return {**rest, "covariance": found}


def covariance_apart(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document whose fields of the covariance stand as the dataclass has them."""
    return {**document, **{name: document["covariance"][key] for key, name in COVARIANCE.items()}}


def by_output(document: dict[str, Any]) -> dict[str, Any]:
    """Return a document whose ``fit`` and ``validation``, where there is one output, stand at their top as well."""
    for entry in ("fit", "validation"):
        found = document[entry]
        if found is not None and len(found) == 1:
            first = next(iter(found.values()))
            document[entry] = {**first, **{o: v for o, v in found.items() if o not in first}}
    return document


def only_outputs(document: Mapping[str, Any], outputs: tuple[str, ...]) -> dict[str, Any]:
    """Return a document whose ``fit`` and ``validation`` have the outputs alone."""
    judged = document["validation"]
    return {
        **document,
        "fit": {o: document["fit"][o] for o in outputs if o in document["fit"]},
        "validation": None if judged is None else {o: judged[o] for o in outputs},
    }


def json_text(document: Mapping[str, Any]) -> str:
    """Return the text of a document, with a line feed at its end."""
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def check_schema(document: object, schema: str, where: str, what: str, verb: str) -> None:
    """Refuse a document of another schema."""
    found = document.get("schema") if isinstance(document, Mapping) else type(document).__name__
    if found != schema:
        raise EstimationError(
            f"{where} has schema {found!r}; {what} has {schema!r}. Give a file that 'ambid {verb} --json' wrote"
        )


def read_whole(read: Callable[[], T], where: str, what: str, verb: str) -> T:
    """Return what a reader makes of a document; whatever it stumbles over is one line that names the file."""
    try:
        return read()
    except (AmbidError, AttributeError, ArithmeticError, KeyError, TypeError, ValueError, IndexError) as error:
        raise EstimationError(
            f"{where} is not a whole {what} ({type(error).__name__}: {error}). "
            f"Write it again with 'ambid {verb} --json'"
        ) from error


def read_as(kind: type[T], value: Any, at: str = "") -> T:
    """Read JSON as what an annotation says: dataclasses, arrays, mappings, tuples, unions, literals, plain values.

    Raises ValueError with the path of the entry that is missing or of another type. Kinds that no rule is for, such as
    ``object``, take the value as it is.
    """
    return cast("T", _read(kind, value, at))


def _read(kind: Any, value: Any, at: str) -> Any:
    origin, inner = get_origin(kind), get_args(kind)
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
    hints, found = _hints(kind), {}
    for f in fields(kind):
        place = f"{at}.{f.name}".lstrip(".")
        if f.name in value:
            found[f.name] = _read(hints[f.name], value[f.name], place)
        elif f.default is MISSING and f.default_factory is MISSING:
            raise ValueError(f"{place!r} is missing")
    return kind(**found)


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
    """Read numbers, null as NaN; text and truth values are no numbers."""
    found = np.array(value)
    if found.size and found.dtype.kind == "O":
        found = np.array(value, dtype=np.float64)  # null becomes NaN; anything else raises
    if found.size and found.dtype.kind not in "iuf":
        _refuse(value, at, "numbers")
    if get_args(dtype) == (np.complex128,):
        pairs = found.astype(np.float64).reshape(-1, 2)
        return pairs[:, 0] + 1j * pairs[:, 1]
    return found.astype(np.float64)


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
    named = ("passed", "detail", "p")
    numbers = {name: x for name, x in value.items() if name not in named}
    return cast("Check", _dataclass(Check, {**value, "values": numbers}, at))


def _parameter(name: str, value: Any, at: str) -> EstimatedParameter:
    if not isinstance(value, Mapping):
        _refuse(value, at, "an object")
    return cast("EstimatedParameter", _dataclass(EstimatedParameter, {**value, "name": name}, at))


def _refuse(value: Any, at: str, wanted: str) -> Any:
    text = repr(value)
    raise ValueError(f"{at or 'it'} is {text if len(text) <= 40 else text[:37] + '...'} instead of {wanted}")


def _write_check(check: Check) -> dict[str, Any]:
    p = {} if check.p is None else {"p": plain_json(check.p)}
    return {"passed": bool(check.passed), **p, **plain_json(check.values), "detail": check.detail}


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
