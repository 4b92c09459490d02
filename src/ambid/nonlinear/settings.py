"""Settings of nonlinear structures: one frozen dataclass a family, whose fields say what they are and what they may be.

A field is made by `whole`, `number` or `choice`. What is left out, or ``auto`` where a field has no default of its own,
the method chooses.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

from ambid.errors import EstimationError, nearest

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
                near = nearest(str(value), list(self.options))
                raise EstimationError(
                    f"{structure}: {name} is {value!r}; it must be one of {', '.join(self.options)}.{near}"
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


def read_settings(settings: type[S], structure: str, given: Mapping[str, object]) -> S:
    """Check what was given by name, and complete it."""
    known = rules(settings)
    default = {f.name: f.default for f in fields(settings)}  # type: ignore[arg-type]
    taken: dict[str, object] = {}
    for name, value in given.items():
        if name not in known:
            raise EstimationError(
                f"{structure}: setting {name!r} is unknown; known: {', '.join(known)}.{nearest(name, list(known))}"
            )
        if value == "auto" and default[name] is None:
            continue
        known[name].check(structure, name, value)
        taken[name] = value
    return settings(**taken)
