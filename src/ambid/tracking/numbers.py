"""What is tracked beside the physical parameters, where tracking begins, and how sure one is of that.

q, over magnitudes: physical parameters not fixed, sensor gains (1 unless a fault is found), a delay estimated as a real
number, noise description (the start estimate's, where its predictor forgets soon enough), offsets, and unbalance where
the angle is known: f = m e (speed^2) cos(angle + phase) (theory.md sec. 1) is a speed^2 cos(angle) + b speed^2
sin(angle), a = m e cos(phase), b = -m e sin(phase), held over a sample at its middle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.colours import Colour, Coloured, scaled_for
from ambid.estimation.estimate import Estimate, NoiseModel
from ambid.estimation.predictor import NoiseForm, PredictorProblem, Scales, assemble, predictor_gain, scales_for
from ambid.physics.linear_model import LinearModel, discretise, model
from ambid.physics.sensor_errors import SensorGains
from ambid.record import Record

MEMORY_S = 0.02  # longest memory of the predictor: it is deaf for ten of them after a gap, and slow to show a change
_LEAST_MEMORY = 200  # samples that the predictor may remember at any rate
_LOG_LEVEL_SD = 0.3  # of a log noise level taken over from an estimate that explains its record
_PART = 0.1  # of a mode, that is the plant's where it is one of the plant
_GAIN_SD = 0.1  # relative, of an entry of the predictor gain


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoiseNumbers:
    """The noise of a predictor."""

    form: NoiseForm
    numbers: Array  # (n_noise,), that describe it, and their standard deviations
    sd: Array
    gain: Array  # (n_states, n_outputs), predictor gain in scaled units


def rate_of(estimate: Estimate) -> float:
    """Return the sampling rate of the record behind an estimate, Hz."""
    return float(str(estimate.record["rate_hz"]))


def left_out(estimate: Estimate) -> tuple[str, ...]:
    """Return what the model of an estimate was extended by and tracking leaves out, where that moves a value by more
    than it is wide: all but coloured noise.
    """
    if all(estimate.bias_sd.get(name, math.inf) <= estimate[name].sd for name in estimate.covariance_names):
        return ()
    kept = ("slow_", "coloured_") if estimate.coloured else ()
    return tuple(cause for cause in estimate.extended if not cause.startswith(kept))


def overdispersion_of(estimate: Estimate) -> float:
    """Return by how much the variance of weighted innovations' sums exceeds the model's; 1 where it explains its
    record.
    """
    if estimate.covariance_method == "information":
        return 1.0
    return max(float(str(estimate.information.get("robust_over_information_sd", 1.0))) ** 2, 1.0)


def noise_numbers(plant: LinearModel, estimate: Estimate, noise: NoiseModel, scales: Scales) -> NoiseNumbers:
    """Return the noise with which tracking begins: form "given", with a gain that forgets, where the estimate's own
    predictor does not forget soon enough.
    """
    gain = noise.gain * scales.output / scales.state[:, None]
    if noise.form == "gain":
        entries = gain.ravel()
        return NoiseNumbers(form="gain", numbers=entries, sd=_GAIN_SD * (np.abs(entries) + 0.1), gain=gain)
    A, C, E = _discrete(plant, estimate, scales)
    longest = max(MEMORY_S * rate_of(estimate), _LEAST_MEMORY)
    if noise.form == "levels":
        sensor = np.array([noise.sensor_sd[o] for o in plant.outputs]) / scales.output
        disturbance = np.array([noise.disturbance_sd[d] for d in plant.disturbances]) / scales.disturbance
        with np.errstate(divide="ignore"):
            numbers = np.log(np.concatenate([disturbance, sensor[1:]]) / sensor[0])
        if np.all(np.isfinite(numbers)) and memory_of(A - gain @ C, noise.colours) <= longest:
            sd = np.full(numbers.size, _LOG_LEVEL_SD * np.sqrt(overdispersion_of(estimate)))
            return NoiseNumbers(form="levels", numbers=numbers, sd=sd, gain=gain)
    nothing = np.zeros(0)
    return NoiseNumbers(form="given", numbers=nothing, sd=nothing, gain=_bounded_gain(A, C, E, longest, noise.colours))


def _discrete(plant: LinearModel, estimate: Estimate, scales: Scales) -> tuple[Array, Array, Array]:
    """A, C and E of the sampled plant in scaled units."""
    at, _ = discretise(plant.matrices(estimate.values), 1.0 / rate_of(estimate))
    state = scales.state
    return (
        at.A * state / state[:, None],
        at.C * state / scales.output[:, None],
        at.E * scales.disturbance / state[:, None],
    )


def memory_of(F: Array, colours: Sequence[Colour]) -> float:
    """Return the memory of a predictor in samples, but for modes in which the plant takes no part (Pérez-Arriaga 1982):
    coloured parts of the noise begin at rest, which is as near as any other state.
    """
    modes, V = np.linalg.eig(F)
    radius = np.abs(modes)
    if colours:
        part = np.abs(V * np.linalg.inv(V).T)
        radius = radius[part[: -sum(c.order for c in colours)].sum(axis=0) > _PART * part.sum(axis=0)]
    return np.inf if np.abs(modes).max() >= 1.0 else 1.0 / (1.0 - float(radius.max()))


def _bounded_gain(A: Array, C: Array, E: Array, longest: float, colours: Sequence[Colour]) -> Array:
    """Gain of a predictor that forgets soon enough, disturbances taken a little larger: without any, the initial state
    is remembered for ever. It costs innovation variance, about the number of states over the memory in samples.
    """
    for level in 10.0 ** np.arange(-4.0, 2.1, 0.25):
        try:
            gain = predictor_gain(A, C, level**2 * E @ E.T, np.eye(C.shape[0])).K
        except np.linalg.LinAlgError:
            continue
        if memory_of(A - gain @ C, colours) <= longest:
            return gain
    raise EstimationError(
        "every predictor of this estimate is too slow to forget its start. Give a model whose states are observable"
    )


_PARTS, _PART_RAD = 25, 10.0  # parts of a record in which speed and angle are compared, each at least so long
_AGREE = 0.05  # relative difference of speed and turning that sensors make


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Forcing:
    """Regressors of the unbalance."""

    # (n_samples, 2), (speed/top speed)^2 times cosine and sine of the angle, in the middle of each sample
    columns: Array
    top_speed: float  # rad/s


def forcing_of(record: Record) -> Forcing | None:
    """Return the regressors of a record with its rotor's speed or angle; None without either, or at standstill."""
    if "angle" not in record.names and "speed" not in record.names:
        return None
    period = 1.0 / record.rate_hz
    if "speed" in record.names:
        speed = record["speed"].values
        filled = np.nan_to_num(speed)  # after a gap the phase is lost; the recursion finds it anew
        turned = np.concatenate([[0.0], np.cumsum(0.5 * (filled[1:] + filled[:-1]) * period)])
        angle = record["angle"].values if "angle" in record else turned
    else:
        angle = record["angle"].values
        speed = np.gradient(np.unwrap(angle), period)
    top = float(np.nanmax(np.abs(speed), initial=0.0))
    if top == 0.0:
        return None
    if top * period > np.pi:
        raise EstimationError(
            f"the speed reaches {top:.4g} rad/s, more than half a turn a sample at {record.rate_hz:g} Hz."
            " Check its unit"
        )
    if "speed" in record.names and "angle" in record.names:
        _check_agreement(speed, angle, period)
    middle = angle + 0.5 * period * speed
    size = (speed / top) ** 2
    return Forcing(columns=np.column_stack([size * np.cos(middle), size * np.sin(middle)]), top_speed=top)


def _check_agreement(speed: Array, angle: Array, period: float) -> None:
    """Refuse a speed that is not the derivative of the angle; a unit that is wrong is off by a factor."""
    expected = 0.5 * (speed[1:] + speed[:-1]) * period
    turned = np.mod(np.diff(angle) + np.pi, 2.0 * np.pi) - np.pi  # an angle may be wrapped
    finite = np.isfinite(expected) & np.isfinite(turned)
    expected, turned = expected[finite], turned[finite]
    way = np.cumsum(np.abs(expected))
    parts = 0 if way.size == 0 else min(_PARTS, int(way[-1] / _PART_RAD))
    if parts == 0:
        return
    ends = np.searchsorted(way, way[-1] * np.arange(1, parts) / parts)
    begins = np.concatenate([[0], ends])
    along = np.add.reduceat(turned * np.sign(expected), begins)
    ratio = float(np.median(along / np.add.reduceat(np.abs(expected), begins)))  # gaps spoil few of the parts
    if abs(ratio - 1.0) > _AGREE:
        raise EstimationError(
            f"the angle turns at {ratio:.4g} times the speed; they must agree within {_AGREE:.0%}. Check the units"
            " of both (rpm or rad/s, deg or rad) and their signs, or omit one of them"
        )


def amplitude_and_phase(a: float, b: float, covariance: Array) -> tuple[float, float, float, float]:
    """Return the unbalance's `amplitude, amplitude_sd` in kg m and `phase, phase_sd` in rad (sd pi where the amplitude
    is within its own of zero), from `a`, `b`, m e cos(phase) and -m e sin(phase), and their `covariance`.
    """
    size = float(np.hypot(a, b))
    if size == 0.0:
        return 0.0, float(np.sqrt(covariance.trace() / 2)), 0.0, float(np.pi)
    along, across = np.array([a, b]) / size, np.array([b, -a]) / size
    sd, turned = float(np.sqrt(along @ covariance @ along)), float(np.sqrt(across @ covariance @ across)) / size
    return size, sd, float(np.arctan2(-b, a)), min(turned, float(np.pi))


Kind = Literal["parameter", "gain", "noise", "offset", "unbalance"]

UNBALANCE = ("unbalance_cos", "unbalance_sin")
# what one cause moves together, each number by a power of its factor: the flux of the magnets, the bias of a pair
JOINT = {"strength": {"k_i": 1.0, "k_x": 1.0, "L": 1.0}, "bias": {"k_i": 1.0, "k_x": 2.0}}
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
    bias_sd: Array  # (p,), part of the deviations that more data would not average out
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
        """Return where the numbers of some kinds stand in q, (n_places,)."""
        return np.array([j for j, k in enumerate(self.kinds) if k in kinds], dtype=np.int64)

    @property
    def joints(self) -> tuple[str, ...]:
        """Causes that move several of the parameters."""
        own = [self.names[j] for j in self.places("parameter")]
        return tuple(cause for cause, moved in JOINT.items() if sum(name in own for name in moved) > 1)

    def direction(self, name: str) -> Array:
        """Return how q moves, (p,), with one of its numbers, or with the factor of a joint cause around the start."""
        powers = JOINT.get(name, {})
        if not powers:
            return np.array([float(n == name) for n in self.names])
        return np.array([powers.get(n, 0.0) * at for n, at in zip(self.names, self.start, strict=True)])

    def vector(self, q: Array) -> Array:
        """Return q (p,) in the layout (problem.size,) of `PredictorProblem`, initial state zero."""
        out = np.zeros(self.problem.size)
        n = self.problem.slices["initial"].start
        out[:n] = q[:n]
        return out


def tracked_numbers(estimate: Estimate, *, synchronous: bool = False, top_speed: float = 1.0) -> TrackedNumbers:
    """Set up tracking from an off-line estimate's parameters, covariance, noise, delay and operating point.
    `synchronous`: the angle is known, track an unbalance too; `top_speed`: at which it is felt most, rad/s.
    """
    from scipy.linalg import block_diag

    plain, noise_of = SensorGains(model(estimate.model)), estimate.whole_noise
    plant = Coloured(plain=plain, colours=noise_of.colours) if noise_of.colours else plain
    if estimate.status == "failed" or not estimate.covariance_names:
        raise EstimationError("the start estimate has no estimated parameters. Identify with free parameters first")
    scales = scaled_for(_scales(plain, estimate, noise_of), plain, noise_of.colours)
    noise = noise_numbers(plant, estimate, noise_of, scales)
    free = tuple(estimate.covariance_names)
    values, reference = estimate.values, plant.references(estimate.values)
    sizes = [max(abs(values[k]), reference.get(k, 0.0)) or 1.0 for k in free] + [1.0] * len(plain.gains)
    problem = _problem(plant, estimate, scales, noise, (*free, *plain.gains), np.array(sizes), noise_of)
    groups = _groups(problem, estimate, noise, free, top_speed if synchronous else None)
    numbers = TrackedNumbers(
        names=tuple(name for g in groups for name in g.names),
        kinds=tuple(g.kind for g in groups for _ in g.names),
        units=tuple(unit for g in groups for unit in g.units),
        magnitude=np.concatenate([g.magnitude for g in groups]),
        start=np.concatenate([g.start for g in groups]),
        covariance=block_diag(*(g.covariance for g in groups)),
        problem=problem,
        point=np.array([estimate.operating_point[role] for role in (*plant.inputs, *plant.outputs)]),
        innovation_covariance=noise_of.innovation_covariance / np.outer(scales.output, scales.output),
        information_s=float(str(estimate.record["samples"])) / problem.rate_hz,
        overdispersion=overdispersion_of(estimate),
        bias_sd=np.array([estimate.bias_sd.get(name, 0.0) for g in groups for name in g.names])
        / np.concatenate([g.magnitude for g in groups]),
        speed=top_speed,
        warnings=_poorly_known(estimate),
    )
    if assemble(problem, numbers.vector(numbers.start), with_derivatives=False) is None:
        raise EstimationError("the start estimate gives no stable predictor. Identify the bench again")
    return numbers


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
    plant: LinearModel,
    estimate: Estimate,
    scales: Scales,
    noise: NoiseNumbers,
    names: tuple[str, ...],
    sizes: Array,
    noise_of: NoiseModel,
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
        unsteady=len(noise_of.colours),
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
    steady = plant.disturbances[: problem.slices["offset"].stop - problem.slices["offset"].start]
    n, count, specs = len(free), noise.numbers.size, {s.name: s.unit for s in plant.parameters}
    gains = problem.estimated[n:]
    size, unit = problem.magnitude[:n], scales.disturbance[: len(steady)]
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
            kind="offset", names=tuple(f"offset_{d}" for d in steady),
            units=tuple(plant.units[d] for d in steady), magnitude=unit, start=np.zeros(unit.size),
            covariance=_OFFSET_SD**2 * np.eye(unit.size),
        ),
    ]  # fmt: skip
    if top_speed is not None and "force" in steady:
        size = np.full(2, unit[steady.index("force")] / top_speed**2)
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
        f"the start determines {', '.join(wide)} only: their tracked intervals may be too narrow. Start from a "
        "longer or better excited record",
    )


def _tracks_delay(plant: LinearModel, estimate: Estimate) -> bool:
    return bool(estimate.delay[plant.inputs[0]].sd)


def _delay(problem: PredictorProblem, estimate: Estimate) -> list[_Group]:
    """The delay beyond the whole samples, in samples, where the start has estimated it."""
    if not problem.fractional:
        return []
    delay = estimate.delay[problem.model.inputs[0]]
    return [
        _Group(
            kind="noise", names=("delay",), units=("1",), magnitude=np.ones(1), start=np.array([delay.fraction]),
            covariance=np.array([[float(delay.sd or 0.0) ** 2]]),
        )
    ]  # fmt: skip


def _scales(plant: LinearModel, estimate: Estimate, noise: NoiseModel) -> Scales:
    """Scales from the innovations; an input is measured by what moves an output by about its innovation in a sample."""
    outputs = np.sqrt(np.diag(noise.innovation_covariance))
    rate = rate_of(estimate)
    scales = scales_for(plant, estimate.values, np.ones(len(plant.inputs)), outputs, rate)
    discrete, _ = discretise(plant.matrices(estimate.values), 1.0 / rate)
    reach = np.abs(discrete.C @ discrete.B) + np.abs(discrete.C @ discrete.A @ discrete.B)
    return replace(scales, input=1.0 / np.max(reach / outputs[:, None], axis=0))
