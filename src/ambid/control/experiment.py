"""The excitation that shows the parameters of a model best within limits; file schema ``ambid.experiment/1``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

import numpy as np

from ambid.acquisition.device import Program
from ambid.acquisition.program import FULL, expected
from ambid.arrays import Array, Complex
from ambid.control.closed import Plant
from ambid.control.excited import ExcitedLoop, begin_at, from_rest
from ambid.control.information import Information, Innovation, informed_lines, power_design
from ambid.control.waves import Limited, Lines, joint_design, spread_power
from ambid.errors import EstimationError
from ambid.estimation.estimate import Check, Estimate, Judged
from ambid.rotor.estimate import RotorEstimate
from ambid.rotor.spectra import beside_harmonics
from ambid.settings.caller import check_positive, check_whole, setting
from ambid.signals.excitations import schroeder_phases

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
        "all", "worst" or the name of a parameter.
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
            of, now = ("closed", "open") if self.closed else ("open", "closed")
            raise EstimationError(
                f"the experiment is designed for the {of} loop, here the loop is {now}: it may pass limits. Design it "
                f"with {setting('closed')} {now}, or play it with the {of} loop"
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
    """Compare the standard deviations of an estimate with what the experiment promised for records of that length."""
    records = estimate.records if isinstance(estimate, RotorEstimate) else (estimate.record,)
    seconds = sum(float(str(r["samples"])) / float(str(r["rate_hz"])) for r in records)
    found, ratio = {p.name: p.sd for p in estimate.parameters if p.sd > 0.0}, dict[str, float]()
    if isinstance(estimate, RotorEstimate):  # frequencies and dampings of its modes too
        found = dict(zip(estimate.covariance_names, np.sqrt(np.diag(estimate.covariance)).tolist(), strict=True))
    lengths = experiment.shown.seconds
    nearest = np.clip(seconds, lengths[0], lengths[-1])
    for name, x in experiment.expected.items():
        if name in found:
            curve = np.log(experiment.shown.by_length[name])
            there = np.exp(np.interp(np.log(nearest), np.log(lengths), curve)) * np.sqrt(nearest / seconds)
            ratio[name] = float(found[name] / (x.sd / x.relative_sd * there))
    if not ratio:
        raise EstimationError(
            f"the experiment was designed for {', '.join(experiment.expected)}, none of which was estimated. Give the "
            "experiment of this record"
        )
    said = ", ".join(f"{name} {x:.2f}" for name, x in ratio.items())
    good = max(ratio.values()) < _WORSE
    return Check(
        passed=good, values=ratio,
        detail=f"standard deviations over those that the experiment promised: {said}" if good else
        f"standard deviations are larger than the experiment promised ({said} times): there is more noise than it was "
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
        on, of = self.inputs(lines), self.loops[plant]
        rows = of.rows[len(of.plant.model.outputs) :]
        return np.asarray(of.states(lines, self.period, on) @ rows.T + np.eye(of.e.shape[1])[on])


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
    """Return the largest part of each signal's way to its limits, (n_plants, 2, n_signals): steady, and from rest.

    From rest are the plant itself and those drawn ones that use most in steady state.
    """
    steady = np.array([task.limited(lines, [k]).use(c) for k in range(len(task.loops))])
    found = np.repeat(steady[:, None], 2, axis=1)
    for k in {0, *np.argsort(-steady.max(axis=1))[:_FROM_REST].tolist()}:
        found[k, 1] = from_rest(task.loops[k], task.limited(lines, [k]), c, task.inputs(lines), np.zeros(1, dtype=int))[
            0
        ]
    return found


def played(design: Design, task: Task, quantum: float | None) -> tuple[Array, Table | None]:
    """Return one period of the excitation, (period, n_inputs), and the controller's table that plays it.

    `quantum`: step of the voltage that the controller orders; None: there is no table.
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
