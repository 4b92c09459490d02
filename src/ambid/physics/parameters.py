"""Parameters: what is known of each number of a model before the data are looked at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ambid.errors import ModelError

Role = Literal["free", "fixed", "prior"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterSpec:
    """A number that a model has."""

    name: str  # name in code, SI unit, and one line that says what it is (theory.md sec. 0).
    unit: str
    meaning: str
    positive: bool = False  # physics allows positive values only (mass, resistance, inductance)
    default: float | None = None  # value taken as fixed when nothing is said of it; None: it is free


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """What is known of one parameter, in SI units.

    Attributes
    ----------
    name, unit : str
        Name and SI unit.
    role : {"free", "fixed", "prior"}
        Estimated; held at `value`; estimated with a Gaussian prior (`value`, `sd`).
    value : float or None
        Start value (free, optional), value (fixed) or mean (prior).
    sd : float or None
        Standard deviation of the prior; None otherwise.
    """

    name: str
    unit: str
    role: Role = "free"
    value: float | None = None
    sd: float | None = None

    def __post_init__(self) -> None:
        if self.role in ("fixed", "prior") and self.value is None:
            raise ModelError(f"parameter {self.name!r} is {self.role} but has no value. Give value = ...")
        if self.role == "prior" and not (self.sd is not None and self.sd > 0):
            raise ModelError(
                f"parameter {self.name!r} has a prior without a positive sd (got {self.sd}). Give sd = ..."
            )
        if self.role != "prior" and self.sd is not None:
            raise ModelError(f"parameter {self.name!r} is {self.role} but has an sd. Remove sd, or set role = 'prior'")
