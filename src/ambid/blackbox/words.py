"""Orders and coefficients as they are written: on the command line, in notebooks, in tests."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from ambid.errors import EstimationError
from ambid.settings.caller import by_name, setting

if TYPE_CHECKING:
    from ambid.blackbox.data import Orders

Candidate = str | tuple[str, "Orders | str | None"]
"""A structure to compare: ``"arx:na=2,nb=2"``, ``"n4sid"``, or its name beside its orders."""


def orders_of(given: Mapping[str, Any] | str | None) -> Orders | None:
    """Return orders by name; None where all are to be chosen."""
    if not isinstance(given, str):
        return given and by_name(given, "orders")
    if given.strip() == "auto":
        return None
    where, remedy = f"{setting('orders')} {given!r}", "Write na=2,nb=2,nk=1 (nb=2/3 for two inputs), or auto"
    pairs = _pairs(given.split(","), where, f"{where}: {{}} is not NAME=NUMBER", remedy)
    found: dict[str, int | str | tuple[int, ...]] = {}
    for name, value in pairs.items():
        if value != "auto" and not all(n.strip().isdecimal() and len(n) < 7 for n in value.split("/")):
            raise EstimationError(f"{where}: {f'{name}={value}'!r} is not NAME=NUMBER. {remedy}")
        found[name] = _read_first(value, int, _whole_numbers)
    return found


def candidates_of(given: Sequence[Candidate]) -> list[tuple[str, Orders | None]]:
    """Return structures with their orders."""
    found = list[tuple[str, "Orders | None"]]()
    for x in given:
        if isinstance(x, str):
            name, _, orders = x.partition(":")
            found.append((name.strip(), orders_of(orders or "auto")))
        else:
            found.append((x[0], orders_of(x[1])))
    return found


def settings_of(given: Mapping[str, Any] | str | None) -> dict[str, Any]:
    """Return the orders of a nonlinear structure by name; what is ``auto`` is left to the method."""
    if given is None or not isinstance(given, str):
        return dict(by_name(given, "orders"))
    if given.strip() in ("auto", ""):
        return {}
    where = f"{setting('orders')} {given!r}"
    pairs = _pairs(given.split(","), where, f"{where}: {{}} is not NAME=VALUE", "Write ny=2,nu=2,degree=3")
    return {name: _read_first(x, _whole_numbers, int, float) for name, x in pairs.items() if x != "auto"}


def fixed_of(given: Mapping[str, float] | Sequence[str] | str | None) -> dict[str, float]:
    """Return known coefficients by name, from ``a1=-1.5`` and so on."""
    if isinstance(given, Mapping):
        return dict(given)
    said, remedy = f"{setting('fix')} {{}} is not NAME=NUMBER", f"Give {setting('fix', 'a1=-1')}, for example"
    pairs = _pairs(given.split(",") if isinstance(given, str) else given or (), setting("fix"), said, remedy)
    found = {name: _read_first(value, float) for name, value in pairs.items()}
    for name, number in found.items():
        if isinstance(number, str):
            raise EstimationError(f"{said.format(repr(f'{name}={number}'))}. {remedy}")
    return found


def _pairs(parts: Iterable[str], where: str, said: str, remedy: str) -> dict[str, str]:
    """Read NAME=VALUE, each name once; ``{}`` in `said` stands for a part that is not of that form."""
    found: dict[str, str] = {}
    for part in parts:
        name, _, value = (x.strip() for x in part.partition("="))
        if not (name and value):
            raise EstimationError(f"{said.format(repr(part.strip()))}. {remedy}")
        if name in found:
            raise EstimationError(f"{where}: {name} is given twice. Omit one")
        found[name] = value
    return found


def _read_first(text: str, *kinds: Callable[[str], Any]) -> Any:
    """Read a text as the first kind that takes it; as it is where none does."""
    for kind in kinds:
        with suppress(ValueError):
            return kind(text)
    return text


def _whole_numbers(text: str) -> tuple[int, ...]:
    parts = [x.strip() for x in text.split("/")]
    if len(parts) < 2 or not all(x.isdecimal() for x in parts):
        raise ValueError(text)
    return tuple(map(int, parts))
