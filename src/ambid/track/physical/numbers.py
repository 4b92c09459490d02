"""What is tracked beside the physical parameters, where tracking begins, and how sure one is of that.

The tracked numbers q are, in this order: physical parameters that are not fixed, gains of the sensors (1 unless a fault
is found), the delay where it was estimated as a real number (what is known of the parameters hangs on it), the noise
description, constant disturbances (offsets), and unbalance where the angle is known. All are in
units of their own magnitude.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.estimate import Estimate
from ambid.estimation.predictor import assemble
from ambid.estimation.problem import PredictorProblem, Scales
from ambid.estimation.scaling import scales_for
from ambid.physics.discretise import discretise
from ambid.physics.linear_model import LinearModel
from ambid.physics.models import model
from ambid.physics.sensor_gain import SensorGains
from ambid.track.physical.start_noise import NoiseNumbers, noise_numbers, overdispersion_of, rate_of

Kind = Literal["parameter", "gain", "noise", "offset", "unbalance"]

UNBALANCE = ("unbalance_cos", "unbalance_sin")
_WIDE = 0.15  # relative standard deviation above which a first-order step is too long
_GAIN_KNOWN = 1e-6  # of a sensor's gain as long as no fault is found
_OFFSET_SD = 1e3  # disturbance scales: nothing is known of an offset
_UNBALANCE_SD = 10.0  # forces that would throw the rotor through the noise in one sample


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackedNumbers:
    """The tracked numbers of a bench and their state at the start."""

    names: tuple[str, ...]
    kinds: tuple[Kind, ...]  # the delay counts as noise: it belongs to the predictor, not to the bench
    units: tuple[str, ...]  # SI units of parameters and gains; "1" for the others, except ``kg m`` for the unbalance
    magnitude: Array  # (p,), SI size of one unit of q
    start: Array  # (p,), q at the start
    covariance: Array  # (p, p), of q at the start
    problem: PredictorProblem  # without data: model, scales, delay and noise form from which predictors are assembled
    point: Array  # (n_inputs + n_outputs,), SI, operating point that is taken off the samples: inputs, then outputs
    innovation_covariance: Array  # (n_outputs, n_outputs), at the start, in scaled output units
    information_s: float  # length of the record behind the start, s
    # variance of weighted innovations' sums over what the model says of them: above 1 where the start estimate
    # explains its record only in part
    overdispersion: float = 1.0
    speed: float = 1.0  # rad/s at which the unbalance force has the size of its magnitude
    warnings: tuple[str, ...] = ()  # what to mistrust, one line each

    @property
    def rate_hz(self) -> float:
        """Sampling rate in Hz."""
        return self.problem.rate_hz

    @property
    def synchronous(self) -> bool:
        """Whether the unbalance is among the numbers."""
        return "unbalance" in self.kinds

    @property
    def positive(self) -> NDArray[np.bool_]:
        """Which numbers physics allows positive values of only, shape (p,): mass, resistance, inductance, gains."""
        allowed = {s.name for s in self.problem.model.parameters if s.positive}
        return np.array([name in allowed for name in self.names])

    def places(self, *kinds: Kind) -> NDArray[np.int64]:
        """Return where the numbers of some kinds stand in q.

        Returns (n_places,).
        """
        return np.array([j for j, k in enumerate(self.kinds) if k in kinds], dtype=np.int64)

    def values(self, q: Array) -> dict[str, float]:
        """Return numbers in SI units.

        `q`: (p,).
        """
        return dict(zip(self.names, (q * self.magnitude).tolist(), strict=True))

    def physical(self, q: Array) -> Array:
        """Return the physical parameters in SI units.

        `q`: (p,). Returns (n_parameters,).
        """
        own = self.places("parameter")
        return np.asarray(q[own] * self.magnitude[own])

    def physical_covariance(self, covariance: Array) -> Array:
        """Return the covariance of the physical parameters in SI units.

        `covariance`: (p, p), of q. Returns (n_parameters, n_parameters).
        """
        own = self.places("parameter")
        return np.asarray(covariance[np.ix_(own, own)] * np.outer(self.magnitude[own], self.magnitude[own]))

    def vector(self, q: Array) -> Array:
        """Return q in the layout of `PredictorProblem`, initial state zero.

        `q`: (p,). Returns (problem.size,).
        """
        out = np.zeros(self.problem.size)
        n = self.problem.slices["initial"].start
        out[:n] = q[:n]
        return out


def tracked_numbers(estimate: Estimate, *, synchronous: bool = False, top_speed: float = 1.0) -> TrackedNumbers:
    """Set up tracking from an off-line estimate.

    `estimate`: parameters, covariance, noise, delay and operating point are taken from it; `synchronous`: track an
    unbalance too: the angle of the rotor is known; `top_speed`: speed at which the unbalance is felt most, rad/s.
    """
    from scipy.linalg import block_diag

    plant = SensorGains(model(estimate.model))
    if estimate.status == "failed" or not estimate.covariance_names:
        raise EstimationError("the start estimate has no estimated parameters. Identify with free parameters first")
    scales = _scales(plant, estimate)
    noise = noise_numbers(plant, estimate, scales)
    free = tuple(estimate.covariance_names)
    sizes = [_size(plant, estimate, k) for k in free] + [1.0] * len(plant.gains)
    problem = _problem(plant, estimate, scales, noise, (*free, *plant.gains), np.array(sizes))
    groups = _groups(problem, estimate, noise, free, top_speed if synchronous else None)
    found = TrackedNumbers(
        names=tuple(name for g in groups for name in g.names),
        kinds=tuple(g.kind for g in groups for _ in g.names),
        units=tuple(unit for g in groups for unit in g.units),
        magnitude=np.concatenate([g.magnitude for g in groups]),
        start=np.concatenate([g.start for g in groups]),
        covariance=block_diag(*(g.covariance for g in groups)),
        problem=problem,
        point=np.array([estimate.operating_point[role] for role in (*plant.inputs, *plant.outputs)]),
        innovation_covariance=estimate.noise.innovation_covariance / np.outer(scales.output, scales.output),
        information_s=float(str(estimate.record["samples"])) / problem.rate_hz,
        overdispersion=overdispersion_of(estimate),
        speed=top_speed,
        warnings=_poorly_known(estimate),
    )
    if assemble(problem, found.vector(found.start), with_derivatives=False) is None:
        raise EstimationError("the start estimate makes no predictor. Identify the bench anew")
    return found


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Group:
    """Numbers of one kind."""

    kind: Kind
    names: tuple[str, ...]
    units: tuple[str, ...]
    magnitude: Array
    start: Array
    covariance: Array


def _problem(
    plant: SensorGains, estimate: Estimate, scales: Scales, noise: NoiseNumbers, names: tuple[str, ...], sizes: Array
) -> PredictorProblem:
    delay = estimate.delay[plant.inputs[0]]
    few = delay.samples + 3
    return PredictorProblem(
        model=plant,
        rate_hz=rate_of(estimate),
        u=np.zeros((few, len(plant.inputs))),
        y=np.zeros((few, len(plant.outputs))),
        estimated=names,
        known={k: v for k, v in estimate.values.items() if k not in names},
        magnitude=sizes,
        prior_mean=np.zeros(len(names)),
        prior_sd=np.full(len(names), np.inf),
        scales=scales,
        delay=delay.samples,
        lag=0.0 if _tracks_delay(plant, estimate) else delay.fraction,
        fractional=_tracks_delay(plant, estimate),
        skip=delay.samples + 2,
        noise=noise.form,
        gain=noise.gain,
    )


def _groups(
    problem: PredictorProblem,
    estimate: Estimate,
    noise: NoiseNumbers,
    free: tuple[str, ...],
    top_speed: float | None,
) -> list[_Group]:
    """The tracked numbers, kind by kind, in the order of the predictor's vector."""
    plant, scales = problem.model, problem.scales
    n, count, specs = len(free), noise.numbers.size, {s.name: s.unit for s in plant.parameters}
    gains = problem.estimated[n:]
    size, held = problem.magnitude[:n], scales.disturbance
    groups = [
        _Group(
            kind="parameter", names=free, units=tuple(specs[k] for k in free), magnitude=size,
            start=np.array([estimate.values[k] for k in free]) / size,
            covariance=estimate.covariance / np.outer(size, size),
        ),
        _Group(
            kind="gain", names=gains, units=("1",) * len(gains), magnitude=np.ones(len(gains)),
            start=np.ones(len(gains)), covariance=_GAIN_KNOWN**2 * np.eye(len(gains)),
        ),
        *_delay(problem, estimate),
        _Group(
            kind="noise", names=tuple(f"noise_{k}" for k in range(count)), units=("1",) * count,
            magnitude=np.ones(count), start=noise.numbers, covariance=np.diag(noise.sd**2),
        ),
        _Group(
            kind="offset", names=tuple(f"offset_{d}" for d in plant.disturbances),
            units=tuple(plant.units[d] for d in plant.disturbances), magnitude=held, start=np.zeros(held.size),
            covariance=_OFFSET_SD**2 * np.eye(held.size),
        ),
    ]  # fmt: skip
    if top_speed is not None and "force" in plant.disturbances:
        size = np.full(2, held[plant.disturbances.index("force")] / top_speed**2)
        groups.append(
            _Group(
                kind="unbalance", names=UNBALANCE, units=("kg m",) * 2, magnitude=size, start=np.zeros(2),
                covariance=_UNBALANCE_SD**2 * np.eye(2),
            )
        )  # fmt: skip
    return groups


def _poorly_known(estimate: Estimate) -> tuple[str, ...]:
    """Parameters so wide that evidence linearised at the start is worth less than it claims."""
    wide = [
        f"{name} to {sd / abs(value):.0%}"
        for name, sd in zip(estimate.covariance_names, np.sqrt(np.diag(estimate.covariance)).tolist(), strict=True)
        if sd > _WIDE * abs(value := estimate.values[name])
    ]
    if not wide:
        return ()
    return (
        f"the start knows {', '.join(wide)} only: what is tracked of them may claim too narrow an interval. Start from"
        " a longer or better excited record",
    )


def _tracks_delay(plant: SensorGains, estimate: Estimate) -> bool:
    return bool(estimate.delay[plant.inputs[0]].sd)


def _delay(problem: PredictorProblem, estimate: Estimate) -> list[_Group]:
    """The delay beyond the whole samples, in samples, where the start has estimated it."""
    if not problem.fractional:
        return []
    found = estimate.delay[problem.model.inputs[0]]
    return [
        _Group(
            kind="noise", names=("delay",), units=("1",), magnitude=np.ones(1), start=np.array([found.fraction]),
            covariance=np.array([[float(found.sd or 0.0) ** 2]]),
        )
    ]  # fmt: skip


def _size(plant: LinearModel, estimate: Estimate, name: str) -> float:
    value = estimate.values[name]
    return max(abs(value), plant.references(estimate.values).get(name, 0.0)) or 1.0


def _scales(plant: LinearModel, estimate: Estimate) -> Scales:
    """Scales from the innovations; an input is measured by what moves an output by about its innovation in a sample."""
    outputs = np.sqrt(np.diag(estimate.noise.innovation_covariance))
    rate = rate_of(estimate)
    scales = scales_for(plant, estimate.values, np.ones(len(plant.inputs)), outputs, rate)
    discrete, _ = discretise(plant.matrices(estimate.values), 1.0 / rate)
    reach = np.abs(discrete.C @ discrete.B) + np.abs(discrete.C @ discrete.A @ discrete.B)
    return replace(scales, input=1.0 / np.max(reach / outputs[:, None], axis=0))
