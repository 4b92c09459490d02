"""Joint Kalman filters of plant states, physical parameters and offsets, z = [x, o, q], x+ = A(q) x + B(q) u + E(q) (o
+ w), y = C x + v: extended, or scaled unscented (Julier and Uhlmann 2004; van der Merwe and Wan 2001).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError, choices
from ambid.estimation.predictor import scales_for
from ambid.physics.linear_model import LinearModel, StateSpace, discretise
from ambid.physics.linear_model import model as model_named
from ambid.recursive.estimator import Copied, as_blocks, covariance_of, factors_of, kernels

if TYPE_CHECKING:
    from ambid.estimation.estimate import Estimate

Ints = NDArray[np.int64]

EVERY = 32  # samples between two steps of the random walk, and two looks at the linearisation point
_SETTLED, _OFF = 4096, 0.1  # samples before a level of the innovations is judged, and how far off it may be
_WIDE = 1e4  # units of the states, about their sensor noise: what is known of a state that is lost
_LARGEST = 0.1  # a number's walk rests while its relative standard deviation is above this, and above its start
_CURVED = 0.1  # of the squared relative error at the start: what linearising may leave
_AMOUNT = 2e-3  # relative movement of a parameter after which the matrices are renewed: what is left is its square
_MOST_TERMS = 40
_REST = 1e-15  # of the Taylor series, relative


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
        for name in ("values", "sensor_sd", "disturbance_sd", "operating_point", "offset_sd", "rates"):
            object.__setattr__(self, name, dict(getattr(self, name)))  # a copy, and one that can be pickled
        parameters = [p.name for p in self.model.parameters]
        _check_names("values", self.values, parameters, complete=True)
        _check_names("free parameters", dict.fromkeys(self.free, 1.0), parameters)
        _check_names("sensor_sd", self.sensor_sd, self.model.outputs, complete=True)
        _check_names("disturbance_sd", self.disturbance_sd, self.model.disturbances, complete=True)
        _check_names("operating_point", self.operating_point, (*self.model.inputs, *self.model.outputs))
        _check_names("offset_sd", self.offset_sd, self.model.disturbances)
        _check_names("rates", self.rates, self.names)
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


def _check_names(
    what: str, table: Mapping[str, float], known: tuple[str, ...] | list[str], *, complete: bool = False
) -> None:
    for name in table:
        if name not in known:
            raise EstimationError(f"{what} names {name!r}; there are {choices(name, known)} Correct the name")
    lacking = [name for name in known if complete and name not in table]
    if lacking:
        raise EstimationError(f"{what} lacks {', '.join(lacking)}; each needs a number. Give it")


def _check_covariance(start: JointStart) -> None:
    p = len(start.free)
    if p == 0:
        raise EstimationError("no parameter is free, and none can be tracked. Free at least one")
    if np.shape(start.covariance) != (p, p):
        raise EstimationError(
            f"the covariance has shape {np.shape(start.covariance)}; {p} free parameters need ({p}, {p}). Reshape it"
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
                f"parameter {name!r} starts with a standard deviation of {sd:.3g}, more than its size {one:.3g}, "
                "which a linearised filter cannot track. Fix it, give it a prior, or identify longer"
            )


def parameter_scales(start: JointStart) -> Array:
    """Return the size (n_free,), SI, of each free parameter: its value, or the model's reference where larger."""
    reference = start.model.references(start.values)
    positive = {p.name for p in start.model.parameters if p.positive}
    return np.array(
        [
            abs(start.values[k]) if k in positive else max(abs(start.values[k]), reference.get(k, 0.0))
            for k in start.free
        ]
    )


class JointFilter(Copied):
    """A Kalman filter of plant states, parameters and offsets (`names`) at once, in square-root form; see its two
    kinds.

    Parameters that must be positive are carried as logarithms. Parameters and offsets make a step of their random walk
    every 32 samples; it rests while the standard deviation is over a tenth of the number's size (or over that at the
    start), so that the covariance does not wind up where nothing excites.

    A missing output leaves the other in use; a sample without any moves only the state. One without input is rejected,
    and the state begins again from the next outputs, as after 32 samples without outputs and after an innovation of
    both beyond a thousand standard deviations. Smaller errors of sensors are taken for noise: screen the samples
    before.
    """

    def __init__(self, start: JointStart) -> None:
        self.start, self.names = start, start.names
        model, p = start.model, len(start.free)
        n_d = len(model.disturbances)
        sensor = np.array([start.sensor_sd[r] for r in model.outputs])
        disturbance = np.array([start.disturbance_sd[r] for r in model.disturbances])
        scales = scales_for(model, start.values, np.ones(len(model.inputs)), sensor, start.rate_hz)
        self._state, self._disturbance = scales.state, scales.disturbance
        positive = {s.name for s in model.parameters if s.positive}
        self._logs = np.array([k in positive for k in start.free])
        self._size = parameter_scales(start)
        self._values0 = np.array([start.values[k] for k in start.free])
        unit = np.r_[self._size, scales.disturbance]
        roles = (*model.inputs, *model.outputs)
        self._io = np.array(
            [
                [start.operating_point.get(r, 0.0) for r in roles],
                np.r_[np.ones(len(model.inputs)), sensor],
                np.ones(len(roles)),
            ]
        )
        self._C = np.ascontiguousarray(model.matrices(start.values).C * scales.state / sensor[:, None])
        self._dist = disturbance / scales.disturbance
        self._wide = np.full(len(model.states), _WIDE)
        whole = int(np.floor(start.delay))
        self._fraction = float(start.delay - whole)
        self._past = np.zeros((whole + 2, len(model.inputs)))
        s = len(model.states) + n_d
        self._z = np.r_[np.zeros(s), np.where(self._logs, 0.0, self._values0 / self._size)]
        given = np.array([start.offset_sd.get(r, 0.0) for r in model.disturbances])
        offset = np.where(given > 0, given, np.where(disturbance > 0, 10 * disturbance, scales.disturbance))
        P = np.diag(np.r_[self._wide, offset / scales.disturbance, np.zeros(p)] ** 2)
        P[s:, s:] = start.covariance / np.outer(self._size, self._size)
        self._F = factors_of(P)
        rates = np.array([start.rates.get(k, 0.0) for k in self.names]) / unit * np.sqrt(EVERY / start.rate_hz)
        rest = np.maximum(np.sqrt(np.diag(P)), np.r_[np.zeros(s), np.full(p, _LARGEST)])
        self._walk = np.array([np.r_[np.zeros(s - n_d), rates[p:], rates[:p]], rest])
        self._counts = np.zeros(8, dtype=np.int64)
        self._counts[5] = 1

    @classmethod
    def from_estimate(cls, estimate: Estimate, rate_hz: float, *, rates: Mapping[str, float] | None = None) -> Self:
        """Return a filter that starts from an off-line estimate of the same rate; `rates` as in `JointStart`."""
        if estimate.status == "failed":
            raise EstimationError("the estimate failed; a filter cannot start from it. Identify again")
        rate = estimate.record.get("rate_hz")
        if isinstance(rate, int | float) and abs(rate / rate_hz - 1.0) > 1e-6:
            raise EstimationError(
                f"the estimate is of a record at {rate:g} Hz and the samples come at {rate_hz:g} Hz; noise and delay "
                "are per sample. Identify at the rate of the samples"
            )
        plant, noise = model_named(estimate.model), estimate.noise
        if not noise.sensor_sd or not noise.disturbance_sd:
            raise EstimationError(
                f"the estimate describes its noise as a {noise.form}; a joint filter needs levels. Identify with "
                "noise levels, or give a JointStart"
            )
        delay = estimate.delay[plant.inputs[0]]
        start = JointStart(
            model=plant,
            rate_hz=rate_hz,
            values=estimate.values,
            free=estimate.covariance_names,
            covariance=estimate.covariance,
            sensor_sd=noise.sensor_sd,
            disturbance_sd=noise.disturbance_sd,
            delay=delay.samples + delay.fraction,
            operating_point={r: estimate.operating_point.get(r, 0.0) for r in (*plant.inputs, *plant.outputs)},
            rates=rates or {},
        )
        return cls(start)

    @property
    def estimate(self) -> Array:
        """Parameters and offsets, shape (p,), SI; a copy."""
        q = self._scaled_parameters
        q = np.where(self._logs, self._values0 * np.exp(np.where(self._logs, q, 0.0)), q * self._size)
        return np.asarray(np.r_[q, self._z[self._wide.size : -q.size] * self._disturbance])

    @property
    def covariance(self) -> Array:
        """Covariance of `estimate`, shape (p, p), SI; a copy. To first order where a logarithm is carried."""
        n, p = self._wide.size, self._logs.size
        last = np.roll(np.arange(len(self.names)), p)  # offsets stand before the parameters
        unit = self._unit()
        return np.asarray(covariance_of(self._F[n:, n:])[np.ix_(last, last)] * np.outer(unit, unit))

    @property
    def values(self) -> dict[str, float]:
        """All parameters of the model, those that stand still too, SI."""
        return {**self.start.values, **dict(zip(self.start.free, self.estimate.tolist(), strict=False))}

    @property
    def state(self) -> Array:
        """Plant state before the next sample, shape (n_states,), SI deviations from the operating point; a copy."""
        return np.asarray(self._z[: self._wide.size] * self._state)

    @property
    def n_used(self) -> int:
        """Samples that were used, those included that only filled the memory of inputs."""
        return int(self._counts[1])

    @property
    def n_rejected(self) -> int:
        """Samples without input, without any output, or with an absurd innovation."""
        return int(self._counts[2])

    @property
    def n_partial(self) -> int:
        """Used samples of which an output was missing."""
        return int(self._counts[3])

    @property
    def error(self) -> float:
        """Root mean square of the innovations over what is expected, over about 1000 samples: one where model and noise
        are right. Not every wrong estimate shows: sixty thousand can be ordinary to a per cent and yet speak clearly
        against it.
        """
        return float(np.sqrt(np.mean(self._io[2, self._past.shape[1] :])))

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a reader has to know before using the numbers; empty where nothing is known against them."""
        error = self.error
        if self.n_used < _SETTLED or abs(error - 1.0) < _OFF:
            return ()
        kind = "small" if error > 1.0 else "large"
        return (
            f"innovations are {error:.2f} times as large as the filter expects: its noise levels are too {kind}, "
            "and so are its standard deviations; poorly excited parameters are biased too",
        )

    @property
    def _scaled_parameters(self) -> Array:
        """View of the parameters as they are carried, shape (n_free,)."""
        return np.asarray(self._z[-self._logs.size :])

    def _relative_sd(self) -> Array:
        """Standard deviation of the parameters as they are carried, shape (n_free,)."""
        s = self._z.size - self._logs.size
        return np.asarray(np.sqrt(np.diag(covariance_of(self._F[s:, s:]))))

    def _unit(self) -> Array:
        """Derivative of `estimate` by the scaled numbers."""
        q = np.where(self._logs, self._scaled_parameters, 0.0)
        return np.asarray(np.r_[np.where(self._logs, self._values0 * np.exp(q), self._size), self._disturbance])

    def update(self, inputs: ArrayLike, outputs: ArrayLike) -> Array:
        """Take in one sample or a block, SI; return innovations made before each sample was used, NaN where none."""
        u, y, shape = as_blocks("joint filter", inputs, outputs, self._past.shape[1], self._C.shape[0])
        e = np.empty(y.shape)
        self._run(u, y, e)
        return e.reshape(shape)

    def _run(self, u: Array, y: Array, e: Array) -> None:
        raise NotImplementedError


class JointEkf(JointFilter):
    """Joint extended Kalman filter, its matrices exact at a linearisation point and first-order about it.

    Consistent under feedback where the noise levels are right and the start lies where the plant is about linear in its
    parameters: an off-line estimate is such a start. It leaves out how its own gain depends on the parameters, and is
    therefore biased where the levels are wrong and the noise itself moves the plant (Ljung 1979): on the unstable
    bearing without excitation, a force level three times too low moves the mass by 12 % while 2 % are claimed; with
    excitation far above the noise a factor of ten does not move it. From a start that is further off (20 % on that
    bearing, 5 % on a lightly damped resonance), it settles beside the truth and claims far too small a standard
    deviation; `warnings` says so where it must be feared. `JointUkf` keeps the second order. Prefer the recursive
    prediction error method of `ambid.tracking.rpem`, whose noise is estimated off-line with the parameters and whose
    gain knows of them.

    Parameters
    ----------
    start : JointStart

    Attributes
    ----------
    start : JointStart
    names : tuple of str
        Parameters, then offsets of the disturbances.
    """

    def __init__(self, start: JointStart) -> None:
        super().__init__(start)
        n, p = self._wide.size, self._logs.size
        wide = n + 2 * self._past.shape[1] + self._dist.size
        self._at = self._scaled_parameters.copy()
        self._begun = self._relative_sd()
        self._M, self._dM = np.zeros((n, wide)), np.zeros((p, n, wide))
        self._renew()

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a reader has to know before using the numbers; empty where nothing is known against them.

        A relative error d at the start leaves an error of order d^2 in the first linearisations, which the filter takes
        for measured. On four benches it came to a tenth of that at most: once less is claimed, it may be what is left.
        """
        now = self._relative_sd()
        lost = _CURVED * self._begun**2 / now
        worst = int(np.argmax(lost))
        if lost[worst] <= 1.0:
            return super().warnings
        return (
            f"{self.start.free[worst]} started with a standard deviation of {self._begun[worst]:.2%} and is now "
            f"claimed to {now[worst]:.2%}: linearisation about the start may have caused an error of "
            f"{lost[worst] * now[worst]:.2%}. Start from an off-line estimate, or use JointUkf",
            *super().warnings,
        )

    def _run(self, u: Array, y: Array, e: Array) -> None:
        done = 0
        while True:
            done = kernels("kalman").ekf_block(
                done, u, y, e, self._z, self._F, self._at, self._M, self._dM, self._C, self._dist, self._walk, self._io,
                self._wide, self._past, self._counts, EVERY, _AMOUNT,
            )  # fmt: skip
            if self._counts[6]:
                self._renew()
                self._counts[6] = 0
            if done == u.shape[0]:
                return

    def _renew(self) -> None:
        """Put the linearisation point at the estimate: exact matrices, exact derivatives by the scaled parameters."""
        model, free, unit, theta = self.start.model, self.start.free, self._unit(), self.values
        with np.errstate(over="ignore", invalid="ignore"):
            spaces = [model.matrices(theta), *(model.derivative(theta, name) for name in free)]
            scaled = [
                StateSpace(
                    A=k * s.A * self._state / self._state[:, None],
                    B=k * s.B / self._state[:, None],
                    E=k * s.E * self._disturbance / self._state[:, None],
                    C=s.C,
                )
                for k, s in zip(np.r_[1.0, unit[: len(free)]], spaces, strict=True)
            ]
            now, slopes = discretise(
                scaled[0], 1.0 / self.start.rate_hz, fraction=self._fraction, derivatives=scaled[1:]
            )
        slopes = slopes[: len(free)]
        if not all(np.isfinite(d.A).all() and np.isfinite(d.E).all() for d in (now, *slopes)):
            return  # an estimate beyond all numbers: the last matrices stay, innovations say the rest
        self._at[:] = self._scaled_parameters
        self._M[:] = np.hstack([now.A, now.B, now.B_late, now.E])
        for j, d in enumerate(slopes):
            self._dM[j] = np.hstack([d.A, d.B, d.B_late, d.E])


class JointUkf(JointFilter):
    """Joint unscented Kalman filter, which keeps the second-order terms of mean and covariance.

    Only the parameters enter nonlinearly: points are needed along their columns alone, go through the plant's A(q) by
    the Taylor series of its exponential, and give the result of all 2 n + 1. Measurements are linear and taken in
    exactly. It converges from farther than `JointEkf` (5 % on a lightly damped resonance) at about a quarter of its
    speed; near the truth they agree to a hundredth of a standard deviation. What is said there of wrong noise levels
    holds here too: prefer `ambid.tracking.rpem`.

    Parameters
    ----------
    start : JointStart

    Attributes
    ----------
    start : JointStart
    names : tuple of str
        Parameters, then offsets of the disturbances.

    Raises
    ------
    EstimationError
        If the model is no product of powers, or its sampling too slow for the series.
    """

    def __init__(self, start: JointStart) -> None:
        super().__init__(start)
        self._logs = self._logs.astype(np.int64)
        # [A, B, E] T in scaled units as products of powers of the followed numbers: places, sizes, exponents
        model = start.model
        nonzero = np.where(self._values0 != 0.0, self._values0, self._size)
        at = {**start.values, **dict(zip(start.free, nonzero.tolist(), strict=True))}
        self._place, entries, self._power = powers_of(model, at, start.free)
        columns = np.r_[self._state, np.ones(len(model.inputs)), self._disturbance]
        entries = entries * columns[self._place[:, 1]] / self._state[self._place[:, 0]] / start.rate_hz
        # a followed number stands in units of its start (a logarithm) or of its size
        unit = nonzero / np.where(self._logs, self._values0, self._size)
        self._entry = entries / np.prod(unit ** self._power.astype(float), axis=1)
        # terms of the Taylor series that leave nothing, with parameters twice as large as at the start
        A = model.matrices(start.values).A * self._state / self._state[:, None] / start.rate_hz
        norm, order, term = 2.0 * float(np.abs(A).sum(axis=1).max()), 0, 1.0
        while order <= norm or term >= _REST:
            order += 1
            term *= norm / order
            if order > _MOST_TERMS:
                raise EstimationError(
                    f"at {start.rate_hz:g} Hz the plant moves too far per sample (|A| T = {norm / 2:.3g}) for the "
                    "series of the unscented filter. Use JointEkf, or sample faster"
                )
        self._terms = order

    def _run(self, u: Array, y: Array, e: Array) -> None:
        kernels("kalman").ukf_block(
            u, y, e, self._z, self._F, self._logs, self._place, self._entry, self._power, self._C, self._dist,
            self._walk, self._io, self._wide, self._past, self._counts, EVERY, self._terms, self._fraction,
        )  # fmt: skip


def powers_of(model: LinearModel, at: Mapping[str, float], free: Sequence[str]) -> tuple[Ints, Array, Ints]:
    """Return places (n_entries, 2), values at parameters `at` (no free one zero) and exponents (n_entries, n_free) of
    the entries of [A, B, E] that are not zero, each a product of powers of the free parameters.
    """
    here = _joined(model.matrices(at))
    rows, columns = np.nonzero(here)
    entries, values = here[rows, columns], np.array([at[name] for name in free])
    slopes = np.array([_joined(model.derivative(at, name))[rows, columns] for name in free])
    power = np.rint(values * slopes.T / entries[:, None]).astype(np.int64)
    for factor in (0.7, -1.1, 3.1):
        ratio = factor ** np.arange(1.0, values.size + 1.0)
        exact = _joined(model.matrices({**at, **dict(zip(free, (values * ratio).tolist(), strict=True))}))
        found = np.zeros(here.shape)
        found[rows, columns] = entries * np.prod(ratio ** power.astype(float), axis=1)
        if not np.allclose(found, exact, rtol=1e-12, atol=0.0):
            raise EstimationError(
                f"the matrices of model {model.name!r} are not products of powers of its parameters, which the "
                "unscented filter needs. Use JointEkf"
            )
    return np.column_stack([rows, columns]).astype(np.int64), entries, power


def _joined(space: StateSpace) -> Array:
    return np.hstack([space.A, space.B, space.E])
