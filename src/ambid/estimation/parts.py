"""What results are made of: estimated parameters, delays, checks, and how well outputs are predicted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError, nearest
from ambid.physics.parameters import Parameter

_NORMAL_95 = 1.959963984540054


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

    @classmethod
    def of(
        cls,
        p: Parameter,
        theta: Mapping[str, float],
        sd: Mapping[str, float],
        seen: Mapping[str, bool],
        alone: Mapping[str, float] | None = None,
    ) -> EstimatedParameter:
        """Return a parameter as it came out.

        `theta`, `sd`, `seen`: by name, value, standard deviation and whether the data show it; `alone`: standard
        deviations that the data alone would give, for the share of a prior.
        """
        value, spread, share = theta[p.name], sd.get(p.name, 0.0), None
        if alone is not None and p.role == "prior" and p.sd:
            share = float(1 / (1 + (alone[p.name] / p.sd) ** 2))
        return cls(
            name=p.name,
            unit=p.unit,
            value=value,
            sd=spread,
            ci95=(value - _NORMAL_95 * spread, value + _NORMAL_95 * spread),
            role=p.role,
            identifiable=seen.get(p.name, True),
            data_share=share,
        )


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


class Judged:
    """A result with a status and checks."""

    __slots__ = ()
    status: str
    checks: Mapping[str, Check]

    @property
    def passed(self) -> bool:
        """Whether the search converged and every check passed."""
        return self.status == "converged" and all(c.passed for c in self.checks.values())


class Parametric:
    """A result that has named parameters."""

    __slots__ = ()
    parameters: tuple[EstimatedParameter, ...]

    @property
    def values(self) -> dict[str, float]:
        """All parameter values, SI."""
        return {p.name: p.value for p in self.parameters}

    def parameter(self, name: str) -> EstimatedParameter:
        """Return one parameter by name; EstimationError where there is none of that name."""
        for p in self.parameters:
            if p.name == name:
                return p
        names = [p.name for p in self.parameters]
        raise EstimationError(
            f"the estimate has no parameter {name!r}; it has {', '.join(names)}.{nearest(name, names)} Check the name"
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FittedModel(Judged):
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
    def sd(self) -> Array | None:
        """Standard deviation of ``model.theta``, shape (n_theta,), or None."""
        return None if self.covariance is None else np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
