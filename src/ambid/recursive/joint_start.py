"""What a joint filter starts from: model, parameters with covariance, noise, delay, operating point, rates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError, nearest
from ambid.physics.linear_model import LinearModel

if TYPE_CHECKING:
    from ambid.estimation.estimate import Estimate


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointStart:
    """Start of a joint filter; SI units.

    Attributes
    ----------
    model : LinearModel
    rate_hz : float
    values : Mapping[str, float]
        All of the model's parameters.
    free : tuple of str
        Those that are followed.
    covariance : ndarray, shape (n_free, n_free)
        Of the free ones at the start; positive definite.
    sensor_sd : Mapping[str, float]
        Noise of each output; positive.
    disturbance_sd : Mapping[str, float]
        Each disturbance, held over a sample; zero where there is none.
    delay : float
        Of the inputs, samples: whole ones and a fraction.
    operating_point : Mapping[str, float]
        Taken off inputs and outputs, by role; zero where it is not named.
    offset_sd : Mapping[str, float]
        What is known at the start of the constant part of each disturbance, which is zero; a role that is not named
        gets ten times its disturbance, or, where there is none, what moves an output by its noise within two samples.
    rates : Mapping[str, float]
        Standard deviation that a number of `names` gains in one second of its random walk, in its unit times
        s^(-1/2). A number that is not named stands still: its variance falls as long as data come.
    """

    model: LinearModel
    rate_hz: float
    values: Mapping[str, float]
    free: tuple[str, ...]
    covariance: Array
    sensor_sd: Mapping[str, float]
    disturbance_sd: Mapping[str, float]
    delay: float = 0.0
    operating_point: Mapping[str, float] = field(default_factory=dict)
    offset_sd: Mapping[str, float] = field(default_factory=dict)
    rates: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for kept in ("values", "sensor_sd", "disturbance_sd", "operating_point", "offset_sd", "rates"):
            object.__setattr__(self, kept, dict(getattr(self, kept)))  # a copy, and one that can be pickled
        known = [p.name for p in self.model.parameters]
        _named("values", self.values, known, complete=True)
        _named("free parameters", dict.fromkeys(self.free, 1.0), known)
        _named("sensor_sd", self.sensor_sd, self.model.outputs, complete=True)
        _named("disturbance_sd", self.disturbance_sd, self.model.disturbances, complete=True)
        _named("operating_point", self.operating_point, (*self.model.inputs, *self.model.outputs))
        _named("offset_sd", self.offset_sd, self.model.disturbances)
        _named("rates", self.rates, self.names)
        if not (np.isfinite(self.rate_hz) and self.rate_hz > 0 and np.isfinite(self.delay) and self.delay >= 0):
            raise EstimationError(
                f"rate_hz {self.rate_hz} must be positive and delay {self.delay} not negative. Correct them"
            )
        for what, table, least in (
            ("sensor_sd", self.sensor_sd, True),
            ("disturbance_sd", self.disturbance_sd, False),
            ("offset_sd", self.offset_sd, True),
            ("rates", self.rates, False),
        ):
            for name, value in table.items():
                if not (np.isfinite(value) and (value > 0 if least else value >= 0)):
                    rule = "positive" if least else "zero or positive"
                    raise EstimationError(f"{what}[{name!r}] is {value}; it must be {rule}. Correct it")
        for spec in self.model.parameters:
            if spec.positive and not self.values[spec.name] > 0:
                raise EstimationError(
                    f"parameter {spec.name!r} starts at {self.values[spec.name]} {spec.unit}; it must be positive. "
                    "Start from another estimate"
                )
        _check_covariance(self)

    @property
    def names(self) -> tuple[str, ...]:
        """Followed numbers: free parameters, then the offset of each disturbance (``force_offset``)."""
        return (*self.free, *(f"{d}_offset" for d in self.model.disturbances))


def _named(
    what: str, table: Mapping[str, float], known: tuple[str, ...] | list[str], *, complete: bool = False
) -> None:
    for name in table:
        if name not in known:
            raise EstimationError(
                f"{what} names {name!r}; there are {', '.join(known)}.{nearest(name, list(known))} Correct the name"
            )
    lacking = [name for name in known if complete and name not in table]
    if lacking:
        raise EstimationError(f"{what} lacks {', '.join(lacking)}; each wants a number. Give it")


def _check_covariance(start: JointStart) -> None:
    p = len(start.free)
    if p == 0:
        raise EstimationError("no parameter is free; nothing can be followed. Free at least one")
    if np.shape(start.covariance) != (p, p):
        raise EstimationError(
            f"the covariance has shape {np.shape(start.covariance)}; {p} free parameters want ({p}, {p}). Reshape it"
        )
    spread = np.sqrt(np.maximum(np.diag(start.covariance), 0.0))
    try:
        if not np.all(np.isfinite(start.covariance)):
            raise np.linalg.LinAlgError
        np.linalg.cholesky(start.covariance / np.outer(spread, spread) if np.all(spread > 0) else -np.eye(p))
    except np.linalg.LinAlgError:
        raise EstimationError("the covariance at the start is not positive definite. Give another") from None
    size = parameter_scales(start)
    for name, sd, one in zip(start.free, spread, size, strict=True):
        if sd > one:
            raise EstimationError(
                f"parameter {name!r} starts with a standard deviation of {sd:.3g}, more than its size {one:.3g}; a "
                "filter that is linear around its start cannot follow that. Fix it, give it a prior, or identify longer"
            )


def parameter_scales(start: JointStart) -> Array:
    """Return the size of each free parameter: its value, or the model's reference where that is larger.

    Returns (n_free,), SI.
    """
    reference = start.model.references(start.values)
    positive = {p.name for p in start.model.parameters if p.positive}
    return np.array(
        [
            abs(start.values[k]) if k in positive else max(abs(start.values[k]), reference.get(k, 0.0))
            for k in start.free
        ]
    )


def start_from(
    estimate: Estimate,
    rate_hz: float,
    *,
    rates: Mapping[str, float] | None = None,
    offset_sd: Mapping[str, float] | None = None,
    sensor_sd: Mapping[str, float] | None = None,
    disturbance_sd: Mapping[str, float] | None = None,
) -> JointStart:
    """Return the start that an off-line estimate makes.

    `estimate`: parameters, covariance, delay, noise levels and operating point are taken from it; `rates`, `offset_sd`:
    as in `JointStart`; `sensor_sd`, `disturbance_sd`: in place of the estimate's.
    """
    from ambid.physics.models import model

    if estimate.status == "failed":
        raise EstimationError("the estimate has failed; a filter cannot start from it. Identify again")
    rate = estimate.record.get("rate_hz")
    if isinstance(rate, int | float) and abs(rate / rate_hz - 1.0) > 1e-6:
        raise EstimationError(
            f"the estimate is of a record at {rate:g} Hz and the samples come at {rate_hz:g} Hz; noise and delay are "
            "per sample. Identify at the rate of the samples"
        )
    of, noise = model(estimate.model), estimate.noise
    sensor, disturbance = sensor_sd or noise.sensor_sd, disturbance_sd or noise.disturbance_sd
    if not sensor or not disturbance:
        raise EstimationError(
            f"the estimate describes its noise as a {noise.form}; a joint filter wants levels. Give sensor_sd and "
            "disturbance_sd, or identify with noise levels"
        )
    delay = estimate.delay[of.inputs[0]]
    return JointStart(
        model=of,
        rate_hz=rate_hz,
        values=estimate.values,
        free=estimate.covariance_names,
        covariance=estimate.covariance,
        sensor_sd=sensor,
        disturbance_sd=disturbance,
        delay=delay.samples + delay.fraction,
        operating_point={r: estimate.operating_point.get(r, 0.0) for r in (*of.inputs, *of.outputs)},
        offset_sd=offset_sd or {},
        rates=rates or {},
    )


def rates_of(share: Mapping[str, float], values: Mapping[str, float]) -> dict[str, float]:
    """Return rates of random walks from relative ones.

    `share`: by parameter: relative standard deviation gained in one second, s^(-1/2); `values`: parameters, SI. Returns
    as `JointStart.rates` wants them.
    """
    return {name: rate * abs(values[name]) for name, rate in share.items()}
