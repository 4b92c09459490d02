"""The excitation that shows the parameters of a model best within limits; file schema ``ambid.experiment/1``.

Re Σ c_k exp(jω_k t) moves signal s as Re Σ T_sk c_k exp(jω_k t); its use is the largest part of the way to any limit.
As criteria fall with the squared amplitude, ln criterion + 2 ln use is minimised over amplitudes and phases by L-BFGS,
the use as a p-norm of rising p (Guillaume, Schoukens, Pintelon and Kollar 1991 for phases alone). A part of the power
is spread evenly: few lines would blind the tests of delay and residuals.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.acquisition.device import Program
from ambid.acquisition.program import FULL, expected
from ambid.arrays import Array, Complex
from ambid.control.closed import Plant
from ambid.control.controller import controller_of_loop
from ambid.control.information import Information, Innovation, informed_lines, power_design
from ambid.errors import EstimationError
from ambid.estimation.estimate import Check, Estimate, Judged
from ambid.physics.loop import Loop
from ambid.rotor.estimate import RotorEstimate
from ambid.rotor.spectra import beside_harmonics
from ambid.settings.caller import check_positive, check_whole, setting
from ambid.signals.excitations import schroeder_phases
from ambid.simulation.plant import closed_loop_poles, excited_loop

Lines = NDArray[np.int64]
"""Numbers of lines, or of what belongs to each."""

BROADBAND = 0.2
"""Part of the power that is spread evenly over the lines."""
MOST = 1.5
"""Standard deviations by which curvature may move a number: its 95 % interval then holds it in two of three records.
Beyond, what it has done becomes part of the interval."""
_NORMS = (6.0, 20.0, 60.0, 200.0)  # p
_STEPS = (80, 60, 60, 80)  # of the search at each p
_LEAST = 1e-12  # share of power of a line that the search begins with


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Limited:
    """Signals that an excitation moves, of one plant or of several."""

    lines: Lines  # (n_lines,), whole periods in `period` samples
    period: int
    T: Complex  # (n_lines, n_signals)
    low: Array  # (n_signals,), negative; -inf: no limit
    high: Array

    def waves(self, c: Complex) -> Array:
        """Return the signals over one period, (period, n_signals)."""
        X = np.zeros((self.period // 2 + 1, self.T.shape[1]), dtype=complex)
        X[self.lines] = 0.5 * self.period * c[:, None] * self.T
        return np.asarray(np.fft.irfft(X, self.period, axis=0), dtype=np.float64)

    def part(self, waves: Array) -> Array:
        """Return the part of the way to their limits that waves use, as `waves`."""
        return np.asarray(np.maximum(waves / self.high, waves / self.low))

    def use(self, c: Complex) -> Array:
        """Return the largest part of each signal, (n_signals,)."""
        return np.asarray(self.part(self.waves(c)).max(axis=0))

    def norm(self, c: Complex, p: float) -> tuple[float, Complex]:
        """Return the logarithm of the p-norm of the parts, and its slope G: Re Σ G_k dc_k is the change."""
        waves = self.waves(c)
        part = self.part(waves)
        top = float(part.max())
        powers = (part / top) ** (p - 1.0)
        total = float(np.sum(powers * part / top))
        pull = powers / (top * total) / np.where(waves > 0.0, self.high, self.low)
        back = np.conj(np.fft.rfft(pull, axis=0))[self.lines]
        return float(np.log(top) + np.log(total / waves.shape[0]) / p), np.asarray(np.sum(self.T * back, axis=1))

    def among(self, keep: Sequence[int]) -> Limited:
        """Return some of the signals."""
        k = list(keep)
        return Limited(lines=self.lines, period=self.period, T=self.T[:, k], low=self.low[k], high=self.high[k])


def spread_power(share: Array) -> Array:
    """Return shares of the power of which a part is spread evenly."""
    return np.asarray((1.0 - BROADBAND) * share / share.sum() + BROADBAND / share.size)


def joint_design(
    information: Information, limited: Limited, starts: Sequence[Complex], samples: float,
    *, tick: Callable[[], object] = lambda: None,
) -> Complex:  # fmt: skip
    """Return amplitudes and phases with the least criterion at a largest use of 1, (n_lines,)."""

    def judged(c: Complex) -> float:
        return information.judge(information.total(np.abs(c / np.max(limited.use(c))) ** 2, samples))[0]

    tried = list(starts)
    for p, steps in zip(_NORMS, _STEPS, strict=True):
        tried = [_search(information, limited, c, samples, p, steps) for c in tried]
        tried = [min(tried, key=judged)]  # the best start alone goes on
        tick()
    return tried[0] / np.max(limited.use(tried[0]))


def _search(
    information: Information, limited: Limited, start: Complex, samples: float, p: float, steps: int
) -> Complex:
    """Return the amplitudes of least criterion, the use taken as a p-norm."""
    from scipy.optimize import minimize

    n = start.size
    share = np.abs(start) ** 2 / np.sum(np.abs(start) ** 2)
    own = np.maximum((share - BROADBAND / n) / (1.0 - BROADBAND), _LEAST)

    def unpack(v: Array) -> tuple[Array, Array, Complex]:
        q = np.exp(2.0 * (v[:n] - v[:n].max()))
        q = q / q.sum()
        power = spread_power(q)
        return q, power, np.asarray(np.sqrt(power) * np.exp(1j * v[n:]))

    def value(v: Array) -> tuple[float, Array]:
        q, power, c = unpack(v)
        size, G = limited.norm(c, p)
        scaled = samples * np.exp(-2.0 * size)
        M = information.total(power, scaled)
        judged, slope = information.judge(M)
        by_power = scaled * np.einsum("pkij,pij->k", information.lines, slope) / judged
        by_size = -2.0 * float(np.sum(slope * (M - information.prior))) / judged
        turned = G * c
        by_power = by_power + by_size * np.real(turned) / (2.0 * power)
        by_share = 2.0 * (1.0 - BROADBAND) * q * (by_power - q @ by_power)
        return float(np.log(judged)), np.concatenate([by_share, -by_size * np.imag(turned)])

    answer = minimize(
        value, np.concatenate([0.5 * np.log(own), np.angle(start)]), jac=True, method="L-BFGS-B",
        options={"maxiter": steps, "maxcor": 20},
    )  # fmt: skip
    return unpack(answer.x)[2]


# A plant in its loop with an excitation added to the commands: what moves, in steady state and from rest.
#
# The state of plant, delay and controller goes by z+ = Z z + e r, the signals are rows z + through r (`excited_loop`).
# From rest the signals are those of the steady state less rows Zᵏ z(0), z(0) the state of the steady state where the
# period begins: where that is small, the transient is.

"""What follows the name of an input in that of its rate of change."""
_NOISE_LINES = 2048
_STARTS = 24  # beginnings of the period that are simulated
_PERIODS = 2  # in which a transient is looked at


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExcitedLoop:
    """A plant in its loop; signals: outputs, inputs."""

    plant: Plant
    loop: Loop
    Z: Array  # (n, n)
    e: Array  # (n, n_inputs)
    rows: Array  # (n_outputs + n_inputs, n)

    @classmethod
    def of(cls, plant: Plant, loop: Loop) -> ExcitedLoop:
        """Return the loop around a plant."""
        Z, command, e = excited_loop(plant.theta, loop, plant.rate_hz, of=plant.model)
        C = plant.space.C
        outputs = np.hstack([C, np.zeros((C.shape[0], Z.shape[0] - C.shape[1]))])
        return cls(
            plant=plant, loop=loop, Z=Z, e=e.reshape(Z.shape[0], -1),
            rows=np.vstack([outputs, command.reshape(-1, Z.shape[0])]),
        )  # fmt: skip

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the signals."""
        return (*self.plant.model.outputs, *self.plant.model.inputs)

    @property
    def pole(self) -> float:
        """Largest modulus of the poles."""
        return float(np.abs(closed_loop_poles(self.plant.theta, self.loop, self.plant.rate_hz, of=self.plant.model)[0]))

    def states(self, lines: Lines, period: int, inputs: Lines) -> Complex:
        """Return the states by unit excitation of each line's input, (n_lines, n)."""
        z = np.exp(2j * np.pi * lines / period)[:, None, None]
        right = self.e.T[inputs][:, :, None].astype(complex)
        return np.asarray(np.linalg.solve(z * np.eye(self.Z.shape[0]) - self.Z, right)[:, :, 0])

    def response(self, lines: Lines, period: int, inputs: Lines) -> Complex:
        """Return the signals by unit excitation of each line's input, (n_lines, n_signals)."""
        T = self.states(lines, period, inputs) @ self.rows.T
        n_u = self.e.shape[1]
        T[:, -n_u:] += np.eye(n_u)[inputs]
        return np.asarray(T)

    def decay(self, samples: int) -> Array:
        """Return what is left of a state, (samples, n_signals, n), by doubling."""
        rows, power = self.rows[None], self.Z
        while rows.shape[0] < samples:
            rows = np.concatenate([rows, rows @ power])
            power = power @ power
        return rows[:samples]

    def noise_sd(self, noise: Innovation) -> Array:
        """Return the standard deviation that noise gives the signals as they are logged, (n_signals,)."""
        plant_model, rate = self.plant.model, self.plant.rate_hz
        f = np.asarray((np.arange(_NOISE_LINES) + 0.5) * (0.5 * rate / _NOISE_LINES), dtype=np.float64)
        H, K = self.plant.sampled(f).transfer(), controller_of_loop(self.loop, plant_model, rate).response(f)[0]
        V = np.asarray(np.linalg.inv(np.asarray(noise.whiten(self.plant, 2.0 * np.pi * f))))
        answer = -np.linalg.solve(np.eye(H.shape[2]) + K @ H, K @ V)
        power = [np.mean(np.sum(np.abs(x) ** 2, axis=2), axis=0) for x in (H @ answer + V, answer)]
        return np.asarray(np.sqrt(np.concatenate(power)))


def begin_at(excited: ExcitedLoop, limited: Limited, c: Complex, inputs: Lines) -> tuple[int, Array]:
    """Return the sample at which the period best begins from rest, and the largest part of each signal from there."""
    starts = _candidates(excited, limited, c, inputs)
    parts = from_rest(excited, limited, c, inputs, starts)
    best = int(np.argmin(parts.max(axis=1)))
    return int(starts[best]), parts[best]


def from_rest(excited: ExcitedLoop, limited: Limited, c: Complex, inputs: Lines, starts: Lines) -> Array:
    """Return the largest part of each signal from rest, the period begun at some samples, (n_starts, n_signals)."""
    waves, n = limited.waves(c), limited.period
    z, decay, parts = _steady(excited, limited, c, inputs), excited.decay(_PERIODS * n), []
    for start in starts:
        moved = np.tile(np.roll(waves, -start, axis=0), (_PERIODS, 1)) - decay @ z[start]
        parts.append(limited.part(moved).max(axis=0))
    return np.array(parts)


def _steady(excited: ExcitedLoop, limited: Limited, c: Complex, inputs: Lines) -> Array:
    """Return the states of the steady state, (period, n)."""
    X = excited.states(limited.lines, limited.period, inputs)
    unlimited = np.full(X.shape[1], np.inf)
    return Limited(lines=limited.lines, period=limited.period, T=X, low=-unlimited, high=unlimited).waves(c)


def _candidates(excited: ExcitedLoop, limited: Limited, c: Complex, inputs: Lines) -> Lines:
    """Return the beginnings whose states move the signals least over a period, by their squares over the limits."""
    size = np.minimum(-limited.low, limited.high)
    left = excited.decay(limited.period) / size[:, None]
    gram = np.einsum("tsi,tsj->ij", left, left)
    z = _steady(excited, limited, c, inputs)
    score = np.einsum("ti,ij,tj->t", z, gram, z)
    least = np.flatnonzero((score <= np.roll(score, 1)) & (score <= np.roll(score, -1)))
    return np.asarray(least[np.argsort(score[least])][:_STARTS])


SCHEMA = "ambid.experiment/1"
_CANDIDATES = 3000  # lines from which those of the design are taken
_FROM_REST = 12  # drawn plants that are simulated from rest
_HARD = 4  # drawn plants beside the nominal one for which amplitudes and phases are searched
_SAME_RATE = 1e-6
_WORSE = 1.5  # standard deviations over promised ones, from which a record is not the one that was designed
_SILENT = 1e-9  # of the largest line


@dataclass(frozen=True, slots=True, kw_only=True)
class Expected:
    """What a record is expected to show of a parameter."""

    value: float  # by which it was designed, SI
    unit: str
    sd: float  # SI
    relative_sd: float
    flat_sd: float  # of a flat multisine with Schroeder's phases in the same band, at the same use of the limits
    identifiable: bool
    seconds: float | None  # of record until the relative sd that is aimed at, a period at least; None: hardly seen
    shift: float | None = None  # by which the magnet's curvature moves it, sd; None: no law is known


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalUse:
    """What the excitation moves a signal, as deviations from rest."""

    unit: str
    low: float | None  # limits; None: no limit
    high: float | None
    steady: float  # largest part of the way to a limit in steady state, 0 to 1
    from_rest: float  # while it sets in
    drawn: float  # the larger of both, of the worst drawn plant
    peak: float  # largest deviation, SI
    reserve: float  # what is kept free of the limits for noise, four standard deviations, SI


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """The excitation as a controller's table."""

    amplitude: float  # V at the coil, of an element of 127
    hold: int  # ticks an element
    elements: tuple[int, ...]

    @property
    def program(self) -> Program:
        """It as a device takes it."""
        return Program(
            kind="table", amplitude=self.amplitude, hold=self.hold, length=len(self.elements), table=self.elements
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shown:
    """Curves of a design."""

    waves: Mapping[str, Array]  # signals over one period in steady state, SI, by name
    seconds: Array  # (n,), lengths of a record
    by_length: Mapping[str, Array]  # relative sd by parameter, (n,)
    levels: Array  # (n,), amplitudes over that of the design
    by_level: Mapping[str, Array]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Experiment(Judged):
    """An excitation that was designed, and what a record of it will show.

    Attributes
    ----------
    status : {"converged"}
    model : str
    criterion : str
        "all" or the name of a parameter.
    rate_hz : float
    period : int
        Samples of one period.
    periods : int
        Of the record.
    frequency_hz : ndarray, shape (n_lines,)
    amplitude, phase : Mapping[str, ndarray], shape (n_lines,)
        Of the lines, by input; peak in its unit, rad. Of several inputs each line excites one; zero at the others.
    excitation : Mapping[str, ndarray], shape (period,)
        What is added to the controller's output over one period, by input.
    table : Table or None
        The same for the controller, of a rig with ``[daq]``.
    closed : bool
        Whether it is for the closed loop.
    signals : Mapping[str, SignalUse]
    expected : Mapping[str, Expected]
    target : float
        Relative standard deviation to which `Expected.seconds` belong.
    gap : float
        By how much a design of the powers alone could be better than the one that the search began with, relative.
    drawn : int
        Plants for which the limits are kept.
    checks : Mapping[str, Check]
    shown : Shown
    warnings : tuple of str
    timing_s : Mapping[str, float]
    rig : Mapping[str, object]
    """

    status: Literal["converged"] = "converged"
    model: str
    criterion: str
    rate_hz: float
    period: int
    periods: int
    frequency_hz: Array
    amplitude: Mapping[str, Array]
    phase: Mapping[str, Array]
    excitation: Mapping[str, Array]
    table: Table | None
    closed: bool
    signals: Mapping[str, SignalUse]
    expected: Mapping[str, Expected]
    target: float
    gap: float
    drawn: int
    checks: Mapping[str, Check]
    shown: Shown
    warnings: tuple[str, ...] = ()
    timing_s: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    rig: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def seconds(self) -> float:
        """Length of the record."""
        return self.periods * self.period / self.rate_hz

    def __post_init__(self) -> None:
        """Refuse an experiment without an excitation, as a damaged file may hold."""
        if not self.excitation:
            raise EstimationError("an experiment holds no excitation. Design it again")

    def played(self, samples: int, rate_hz: float, *, closed: bool | None = None) -> Array:
        """Return the excitation of the inputs, from the beginning of a period.

        Parameters
        ----------
        samples : int
        rate_hz : float
            At which it is to be played.
        closed : bool, optional
            Whether it is to be played in the closed loop: its limits hold for the loop that it is designed for alone.

        Returns
        -------
        ndarray, shape (samples, n_inputs), in the units of the inputs

        Raises
        ------
        EstimationError
            If it was designed for another rate, or with another loop.
        """
        check_whole({"samples": samples})
        check_positive({"rate_hz": rate_hz or 0})
        if abs(rate_hz / self.rate_hz - 1.0) > _SAME_RATE:
            raise EstimationError(
                f"the experiment is designed for {self.rate_hz:g} Hz, the bench samples at {rate_hz:g} Hz. Design it "
                f"with {setting('rate_hz')}, or correct the rate"
            )
        if closed not in (None, self.closed):
            designed, now = ("closed", "open") if self.closed else ("open", "closed")
            raise EstimationError(
                f"the experiment is designed for the {designed} loop, here the loop is {now}: it may pass limits. "
                f"Design it with {setting('closed')} {now}, or play it with the {designed} loop"
            )
        waves = np.column_stack(list(self.excitation.values()))
        return np.asarray(np.resize(waves, (samples, waves.shape[1])))

    @property
    def program(self) -> Program:
        """What the controller plays.

        Raises
        ------
        EstimationError
            If it was designed for a rig without ``[daq]``, and has no table.
        """
        if self.table is None:
            raise EstimationError(
                "the experiment has no table for a controller: its rig has no [daq]. Design it with a rig that has one"
            )
        return self.table.program


def reached(experiment: Experiment, estimate: Estimate | RotorEstimate) -> Check:
    """Compare the standard deviations of an estimate with what the experiment promised for records of that length,
    without the shift by curvature that intervals hold: that is no noise.
    """
    records = estimate.records if isinstance(estimate, RotorEstimate) else (estimate.record,)
    seconds = sum(float(str(r["samples"])) / float(str(r["rate_hz"])) for r in records)
    sds, ratio = {p.name: p.sd for p in estimate.parameters if p.sd > 0.0}, dict[str, float]()
    if isinstance(estimate, RotorEstimate):  # frequencies and dampings of its modes too
        sds = dict(zip(estimate.covariance_names, np.sqrt(np.diag(estimate.covariance)).tolist(), strict=True))
    curved = estimate.checks.get("curvature")
    shift = {} if curved is None else {name: abs(curved.values.get(name, 0.0)) for name in sds}
    if any(x > MOST for x in shift.values()):
        sds = {name: sd / np.hypot(1.0, shift[name]) for name, sd in sds.items()}
    lengths = experiment.shown.seconds
    nearest = np.clip(seconds, lengths[0], lengths[-1])
    for name, x in experiment.expected.items():
        if name in sds:
            curve = np.log(experiment.shown.by_length[name])
            there = np.exp(np.interp(np.log(nearest), np.log(lengths), curve)) * np.sqrt(nearest / seconds)
            ratio[name] = float(sds[name] / (x.sd / x.relative_sd * there))
    if not ratio:
        raise EstimationError(
            f"the experiment was designed for {', '.join(experiment.expected)}, none of which was estimated. Give the "
            "experiment of this record"
        )
    text = ", ".join(f"{name} {x:.2f}" for name, x in ratio.items())
    good = max(ratio.values()) < _WORSE
    return Check(
        passed=good, values=ratio,
        detail=f"standard deviations over those that the experiment promised: {text}" if good else
        f"standard deviations are larger than the experiment promised ({text} times): there is more noise than it was "
        "designed for, or it was not played. Design the next one from this estimate",
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Task:
    """What an experiment is designed for."""

    loops: Sequence[ExcitedLoop]  # the nominal plant's, then those of drawn plants
    noise: Callable[[Plant], Innovation]  # of a plant
    low: Array  # (n_signals,), limits of what the excitation moves, noise taken off; -inf: none
    high: Array
    period: int
    periods: int
    band_hz: tuple[float, float]
    n_lines: int
    criterion: str
    prior_sd: Mapping[str, float]
    hold: int = 1  # samples an element of the excitation
    speed: float = 0.0  # of the rotor, rad/s: lines beside its harmonics are left out

    @property
    def samples(self) -> float:
        """Samples of the record."""
        return float(self.period * self.periods)

    @property
    def rate_hz(self) -> float:
        """Sampling rate."""
        return self.loops[0].plant.rate_hz

    def frequency_hz(self, lines: Lines) -> Array:
        """Return the frequencies of lines."""
        return np.asarray(lines * (self.rate_hz / self.period))

    def candidates(self) -> Lines:
        """Return the lines of the band, thinned by octave where they are very many."""
        first = max(1, int(np.ceil(self.band_hz[0] * self.period / self.rate_hz - 1e-9)))
        last = min((self.period // self.hold - 1) // 2, int(self.band_hz[1] * self.period / self.rate_hz + 1e-9))
        if last < first:
            raise EstimationError(
                f"a period of {self.period / self.rate_hz:.4g} s has no line between {self.band_hz[0]:g} and "
                f"{self.band_hz[1]:g} Hz. Widen the band, or make the period longer"
            )
        every = np.arange(first, last + 1)
        every = every[
            ~beside_harmonics(self.frequency_hz(every), self.speed / (2.0 * np.pi), self.rate_hz / self.period)
        ]
        if every.size <= _CANDIDATES:
            return every
        half = _CANDIDATES // 2
        return np.union1d(every[:half], np.geomspace(every[half], last, _CANDIDATES).astype(np.int64))

    def inputs(self, lines: Lines) -> Lines:
        """Return the input that each line excites: those of the period belong to inputs in turn (zippered)."""
        return np.asarray(lines % self.loops[0].e.shape[1])

    def limited(self, lines: Lines, plants: Sequence[int]) -> Limited:
        """Return the signals of some of the plants."""
        on, many = self.inputs(lines), len(plants)
        T = np.hstack([self.loops[k].response(lines, self.period, on) for k in plants])
        return Limited(
            lines=lines, period=self.period, T=T, low=np.tile(self.low, many), high=np.tile(self.high, many)
        )  # fmt: skip

    def bounded(self, lines: Lines, plants: Sequence[int]) -> Limited:
        """Return those of the signals that have a limit."""
        limited = self.limited(lines, plants)
        return limited.among(np.flatnonzero(np.isfinite(limited.low) | np.isfinite(limited.high)).tolist())

    def information(self, lines: Lines, plants: Sequence[int]) -> Information:
        """Return the information of lines, of some of the plants."""
        return Information.of(
            [self.loops[k].plant for k in plants], [self.noise(self.loops[k].plant) for k in plants],
            self.frequency_hz(lines), [self.driven(lines, k) for k in plants], prior_sd=self.prior_sd,
            criterion=self.criterion,
        )  # fmt: skip

    def driven(self, lines: Lines, plant: int) -> Complex:
        """Return the inputs of a plant by unit excitation of each line's input, (n_lines, n_inputs)."""
        on, excited = self.inputs(lines), self.loops[plant]
        rows = excited.rows[len(excited.plant.model.outputs) :]
        return np.asarray(excited.states(lines, self.period, on) @ rows.T + np.eye(excited.e.shape[1])[on])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Design:
    """Amplitudes and phases of the lines, and how far their start was from the best powers."""

    lines: Lines  # (n_lines,)
    c: Complex  # (n_lines,), of the elements where these are held
    gap: float


def design(task: Task, *, tick: Callable[[], object] = lambda: None) -> Design:
    """Return the lines, amplitudes and phases of least criterion that keep the limits for all plants, from rest too."""
    every = task.candidates()
    of_all, all_limited = task.information(every, [0]), task.bounded(every, [0])
    size = np.minimum(-all_limited.low, all_limited.high)
    cost = 0.5 * np.sum(np.abs(all_limited.T / size) ** 2, axis=1)
    power, gap = power_design(of_all, cost, task.samples)
    tick()
    keep = informed_lines(power, cost, task.n_lines)
    lines, information, limited = every[keep], of_all.among(keep), task.bounded(every[keep], [0])
    starts = [_with_schroeder(spread_power(p)) for p in (power[keep], np.ones(keep.size), np.sqrt(power[keep]))]
    c = joint_design(information, limited, starts, task.samples, tick=tick)
    hard = hardest(task, lines, c)
    if hard:
        plants = [0, *hard]
        c = joint_design(
            task.information(lines, plants), task.bounded(lines, plants), [c], task.samples, tick=tick
        )  # fmt: skip
    start, _ = begin_at(task.loops[0], task.limited(lines, [0]), c, task.inputs(lines))
    start -= start % task.hold
    c = c * np.exp(2j * np.pi * lines * start / task.period)
    return Design(lines=lines, c=c / np.max(uses(task, lines, c)), gap=gap)


def _with_schroeder(power: Array) -> Complex:
    size = np.sqrt(power)
    return np.asarray(size * np.exp(1j * schroeder_phases(size)))


def hardest(task: Task, lines: Lines, c: Complex) -> list[int]:
    """Return the drawn plants whose signals come nearest to their limits."""
    use = [task.bounded(lines, [k]).use(c).max() for k in range(1, len(task.loops))]
    return [1 + int(k) for k in np.argsort(-np.array(use))[:_HARD]]


def uses(task: Task, lines: Lines, c: Complex) -> Array:
    """Return the largest part of each signal's way to its limits, (n_plants, 2, n_signals), steady and from rest: the
    plant and those drawn ones that use most in steady state.
    """
    steady = np.array([task.limited(lines, [k]).use(c) for k in range(len(task.loops))])
    parts = np.repeat(steady[:, None], 2, axis=1)
    for k in {0, *np.argsort(-steady.max(axis=1))[:_FROM_REST].tolist()}:
        parts[k, 1] = from_rest(task.loops[k], task.limited(lines, [k]), c, task.inputs(lines), np.zeros(1, dtype=int))[
            0
        ]
    return parts


def played(design: Design, task: Task, quantum: float | None) -> tuple[Array, Table | None]:
    """Return one period of the excitation, (period, n_inputs), and the controller's table that plays it, by voltage
    steps of `quantum`; None: there is no table.
    """
    n_u, X = task.loops[0].e.shape[1], np.zeros((task.period // 2 + 1, task.loops[0].e.shape[1]), dtype=complex)
    X[design.lines, task.inputs(design.lines)] = 0.5 * task.period * design.c
    if quantum is None:
        return np.asarray(np.fft.irfft(X, task.period, axis=0)), None
    assert n_u == 1
    ticks = np.arange(task.hold)
    turn = np.exp(-2j * np.pi * np.outer(design.lines, ticks) / task.period).mean(axis=1)  # what holding does
    X[design.lines, 0] /= turn
    wave = np.fft.irfft(X[:, 0], task.period)[:: task.hold]
    counts = max(1, int(np.floor(np.max(np.abs(wave)) / quantum)))
    elements = np.rint(FULL * wave / np.max(np.abs(wave))).astype(int)
    table = Table(amplitude=counts * quantum, hold=task.hold, elements=tuple(elements.tolist()))
    return np.asarray(quantum * expected(table.program, task.period, counts=counts))[:, None], table


def lines_of(wave: Array) -> tuple[Lines, Complex]:
    """Return the lines of one period of an excitation, (period, n_inputs), and their amplitudes: a line, an input."""
    X = np.fft.rfft(wave, axis=0) / (0.5 * wave.shape[0])
    size = np.abs(X).max(axis=1)
    lines = np.flatnonzero(size > _SILENT * np.max(size))
    lines = lines[(lines > 0) & (2 * lines < wave.shape[0])]
    return lines, np.asarray(X[lines, lines % wave.shape[1]])
