"""The estimate: parameters with covariance, model, fit, checks, warnings, timings, provenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Continuous:
    """Identified continuous-time plant x' = A x + B u, y = C x in SI units."""

    states: tuple[str, ...]
    A: Array  # (n_states, n_states)
    B: Array  # (n_states, n_inputs)
    C: Array  # (n_outputs, n_states)
    poles: NDArray[np.complex128]  # (n_states,), complex, rad/s


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoiseModel:
    """Noise as the predictor describes it, SI units."""

    # sensor noise alone; disturbance and sensor levels; or a free predictor gain
    form: Literal["sensors", "levels", "gain"]
    gain: Array  # (n_states, n_outputs), predictor gain K of x[k+1] = A x[k] + B u + K e[k]
    innovation_covariance: Array  # (n_outputs, n_outputs)
    disturbance_sd: Mapping[str, float]  # held-over-a-sample disturbances and sensor noise; empty for a free gain
    sensor_sd: Mapping[str, float]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate:
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
    validation: Mapping[str, object] | None = None
    warnings: tuple[str, ...] = ()
    timing_s: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    information: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    rig: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    global_search: Mapping[str, object] | None = None

    def parameter(self, name: str) -> EstimatedParameter:
        """Return one parameter by name.

        Parameters
        ----------
        name : str

        Returns
        -------
        EstimatedParameter

        Raises
        ------
        EstimationError
            If the model has none of that name.
        """
        return parameter_named(self.parameters, name)

    @property
    def values(self) -> dict[str, float]:
        """All parameter values, SI."""
        return {p.name: p.value for p in self.parameters}

    @property
    def passed(self) -> bool:
        """Whether the search converged and every check passed."""
        return self.status == "converged" and all(c.passed for c in self.checks.values())

    def dumps(self) -> str:
        """Return the estimate as JSON text, schema ``ambid.estimate/1``.

        Returns
        -------
        str
        """
        from ambid.estimation.estimate_file import estimate_text

        return estimate_text(self)


def parameter_named(parameters: Sequence[EstimatedParameter], name: str) -> EstimatedParameter:
    """Return one of several parameters."""
    for p in parameters:
        if p.name == name:
            return p
    names = [p.name for p in parameters]
    raise EstimationError(
        f"the estimate has no parameter {name!r}; it has {', '.join(names)}.{nearest(name, names)} Check the name"
    )
