"""What results are made of: estimated parameters, delays, checks, and how well outputs are predicted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

from ambid.errors import EstimationError, nearest


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimatedParameter:
    """One parameter as it came out."""

    name: str  # name and SI unit
    unit: str
    value: float  # SI; `sd` is 0 for a fixed parameter
    sd: float
    ci95: tuple[float, float]  # 95 % interval, value -+ 1.96 sd
    role: Literal["free", "fixed", "prior"]
    # whether the data (with the priors) show it: relative sd under 25 %. True for a fixed parameter.
    identifiable: bool
    data_share: float | None = None  # for a prior: part of the information that comes from the data, 0 to 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Delay:
    """Delay of an input: `samples` whole periods and a `fraction` of one."""

    samples: int
    fraction: float  # 0 <= fraction < 1
    sd: float | None  # standard deviation of samples + fraction, where it was estimated as a real number
    how: Literal["estimated", "given"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """Outcome of one check."""

    passed: bool
    detail: str  # one line for people: what was looked at, what was found, what to do
    p: float | None = None  # probability of a result at least as extreme if the model is right
    values: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))  # further numbers


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputFit:
    """How well one output is predicted: 1 - |e| / |y - mean|, 1 is perfect."""

    one_step: float  # from all samples before
    simulation: float | None  # from the input alone; None where the plant is unstable in open loop
    innovation_sd: float  # SI


def parameter_named(parameters: Sequence[EstimatedParameter], name: str) -> EstimatedParameter:
    """Return one of several parameters."""
    for p in parameters:
        if p.name == name:
            return p
    names = [p.name for p in parameters]
    raise EstimationError(
        f"the estimate has no parameter {name!r}; it has {', '.join(names)}.{nearest(name, names)} Check the name"
    )
