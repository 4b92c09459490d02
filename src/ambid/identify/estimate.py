"""The estimate: parameters with covariance, model, fit, checks, warnings, timings, provenance; and its JSON form."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ambid.errors import EstimationError

Array = NDArray[np.float64]
SCHEMA = "ambid.estimate/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimatedParameter:
    """One parameter as it came out.

    Attributes
    ----------
    name, unit : str
        Name and SI unit.
    value, sd : float
        SI; `sd` is 0 for a fixed parameter.
    ci95 : (float, float)
        95 % interval, value -+ 1.96 sd.
    role : {"free", "fixed", "prior"}
    identifiable : bool
        Whether the data (with the priors) show it: relative sd under 25 %. True for a fixed parameter.
    data_share : float or None
        For a prior: part of the information that comes from the data, 0 to 1.
    """

    name: str
    unit: str
    value: float
    sd: float
    ci95: tuple[float, float]
    role: Literal["free", "fixed", "prior"]
    identifiable: bool
    data_share: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Delay:
    """Delay of an input: `samples` whole periods and a `fraction` of one.

    Attributes
    ----------
    samples : int
    fraction : float
        0 <= fraction < 1.
    sd : float or None
        Standard deviation of samples + fraction, where it was estimated as a real number.
    how : {"estimated", "given"}
    """

    samples: int
    fraction: float
    sd: float | None
    how: Literal["estimated", "given"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """Outcome of one check.

    Attributes
    ----------
    passed : bool
    detail : str
        One line for people: what was looked at, what was found, what to do.
    p : float or None
        Probability of a result at least as extreme if the model is right.
    values : Mapping[str, float]
        Further numbers.
    """

    passed: bool
    detail: str
    p: float | None = None
    values: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputFit:
    """How well one output is predicted: 1 - |e| / |y - mean|, 1 is perfect.

    Attributes
    ----------
    one_step : float
        From all samples before.
    simulation : float or None
        From the input alone; None where the plant is unstable in open loop.
    innovation_sd : float
        SI.
    """

    one_step: float
    simulation: float | None
    innovation_sd: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Continuous:
    """Identified continuous-time plant x' = A x + B u, y = C x in SI units.

    Attributes
    ----------
    states : tuple of str
    A : ndarray, shape (n_states, n_states)
    B : ndarray, shape (n_states, n_inputs)
    C : ndarray, shape (n_outputs, n_states)
    poles : ndarray, shape (n_states,), complex, rad/s
    """

    states: tuple[str, ...]
    A: Array
    B: Array
    C: Array
    poles: NDArray[np.complex128]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoiseModel:
    """Noise as the predictor describes it, SI units.

    Attributes
    ----------
    form : {"sensors", "levels", "gain"}
        Sensor noise alone; disturbance and sensor levels; or a free predictor gain.
    gain : ndarray, shape (n_states, n_outputs)
        Predictor gain K of x[k+1] = A x[k] + B u + K e[k].
    innovation_covariance : ndarray, shape (n_outputs, n_outputs)
    disturbance_sd, sensor_sd : Mapping[str, float]
        Held-over-a-sample disturbances and sensor noise; empty for a free gain.
    """

    form: Literal["sensors", "levels", "gain"]
    gain: Array
    innovation_covariance: Array
    disturbance_sd: Mapping[str, float]
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
        for p in self.parameters:
            if p.name == name:
                return p
        raise EstimationError(
            f"the estimate has no parameter {name!r}; it has {', '.join(p.name for p in self.parameters)}. Check the name"
        )

    @property
    def values(self) -> dict[str, float]:
        """All parameter values, SI."""
        return {p.name: p.value for p in self.parameters}

    @property
    def passed(self) -> bool:
        """Whether the search converged and every check passed."""
        return self.status == "converged" and all(c.passed for c in self.checks.values())

    def with_timing(self, **seconds: float) -> Estimate:
        """Return a copy with further entries in its timings.

        Parameters
        ----------
        **seconds : float

        Returns
        -------
        Estimate
        """
        return replace(self, timing_s={**self.timing_s, **seconds})

    def to_json(self) -> dict[str, Any]:
        """Return the estimate in the form of schema ``ambid.estimate/1``: SI values, JSON numbers only.

        Returns
        -------
        dict
        """
        poles = self.continuous.poles
        document: dict[str, Any] = {
            "schema": SCHEMA,
            "status": self.status,
            "record": dict(self.record),
            "model": self.model,
            "parameters": {p.name: _parameter_json(p) for p in self.parameters},
            "covariance": {
                "names": list(self.covariance_names),
                "matrix": self.covariance.tolist(),
                "method": self.covariance_method,
            },
            "delay": {
                role: {
                    "samples": d.samples,
                    "fraction": d.fraction,
                    "total": d.samples + d.fraction,
                    "sd": d.sd,
                    "how": d.how,
                }
                for role, d in self.delay.items()
            },
            "continuous": {
                "states": list(self.continuous.states),
                "A": self.continuous.A.tolist(),
                "B": self.continuous.B.tolist(),
                "C": self.continuous.C.tolist(),
                "poles": [[float(p.real), float(p.imag)] for p in poles],
            },
            "noise": {
                "form": self.noise.form,
                "gain": self.noise.gain.tolist(),
                "innovation_covariance": self.noise.innovation_covariance.tolist(),
                "disturbance_sd": dict(self.noise.disturbance_sd),
                "sensor_sd": dict(self.noise.sensor_sd),
            },
            "operating_point": dict(self.operating_point),
            "fit": {
                role: {"one_step": f.one_step, "simulation": f.simulation, "innovation_sd": f.innovation_sd}
                for role, f in self.fit.items()
            },
            "checks": {name: _check_json(c) for name, c in self.checks.items()},
            "information": dict(self.information),
            "validation": None if self.validation is None else dict(self.validation),
            "warnings": list(self.warnings),
            "timing_s": dict(self.timing_s),
            "rig": dict(self.rig),
        }
        return _finite(document)

    def dumps(self) -> str:
        """Return the JSON text.

        Returns
        -------
        str
        """
        return json.dumps(self.to_json(), indent=1, allow_nan=False) + "\n"


def _parameter_json(p: EstimatedParameter) -> dict[str, Any]:
    share = {} if p.data_share is None else {"data_share": p.data_share}
    return {
        "value": p.value, "sd": p.sd, "ci95": list(p.ci95), "unit": p.unit, "role": p.role, "identifiable": p.identifiable,
        **share,
    }  # fmt: skip


def _check_json(c: Check) -> dict[str, Any]:
    p = {} if c.p is None else {"p": c.p}
    return {"passed": c.passed, **p, **dict(c.values), "detail": c.detail}


def _finite(value: Any) -> Any:
    """Turn mappings and arrays into plain JSON, numbers that are not finite into null."""
    if isinstance(value, Mapping):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    if isinstance(value, (bool, str)) or value is None:
        return value
    if isinstance(value, np.ndarray):
        return _finite(value.tolist())
    if isinstance(value, (int, np.integer)):
        return int(value)
    number = float(value)
    return number if math.isfinite(number) else None


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
    if not isinstance(document, Mapping) or document.get("schema") != SCHEMA:
        found = document.get("schema") if isinstance(document, Mapping) else type(document).__name__
        raise EstimationError(
            f"{where} has schema {found!r}; an estimate has {SCHEMA!r}. Give a file that 'ambid identify --json' wrote"
        )
    try:
        return _from_json(document)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise EstimationError(
            f"{where} is not a whole estimate ({type(error).__name__}: {error}). Write it again with 'ambid identify --json'"
        ) from error


def _from_json(d: Mapping[str, Any]) -> Estimate:
    plant, noise, cov = d["continuous"], d["noise"], d["covariance"]
    return Estimate(
        status=d["status"],
        model=d["model"],
        record=d["record"],
        parameters=tuple(
            EstimatedParameter(
                name=name, unit=p["unit"], value=float(p["value"]), sd=float(p["sd"]), ci95=(p["ci95"][0], p["ci95"][1]),
                role=p["role"], identifiable=bool(p["identifiable"]), data_share=p.get("data_share"),
            )
            for name, p in d["parameters"].items()
        ),
        covariance_names=tuple(cov["names"]),
        covariance=np.array(cov["matrix"], dtype=np.float64),
        covariance_method=cov["method"],
        delay={
            role: Delay(samples=int(x["samples"]), fraction=float(x["fraction"]), sd=x["sd"], how=x["how"])
            for role, x in d["delay"].items()
        },
        continuous=Continuous(
            states=tuple(plant["states"]),
            A=np.array(plant["A"], dtype=np.float64),
            B=np.array(plant["B"], dtype=np.float64),
            C=np.array(plant["C"], dtype=np.float64),
            poles=np.array([complex(*p) for p in plant["poles"]]),
        ),
        noise=NoiseModel(
            form=noise["form"],
            gain=np.array(noise["gain"], dtype=np.float64),
            innovation_covariance=np.array(noise["innovation_covariance"], dtype=np.float64),
            disturbance_sd=noise["disturbance_sd"],
            sensor_sd=noise["sensor_sd"],
        ),
        operating_point=d["operating_point"],
        fit={role: OutputFit(**f) for role, f in d["fit"].items()},
        checks={
            name: Check(
                passed=bool(c["passed"]), detail=c["detail"], p=c.get("p"),
                values={k: v for k, v in c.items() if k not in ("passed", "detail", "p")},
            )
            for name, c in d["checks"].items()
        },
        validation=d["validation"],
        warnings=tuple(d["warnings"]),
        timing_s=d["timing_s"],
        information=d["information"],
        rig=d["rig"],
    )  # fmt: skip
