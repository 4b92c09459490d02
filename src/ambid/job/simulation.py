"""A record from the physics, of a preset or of a rig."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ambid.arrays import Array
from ambid.bearing.magnet_result import NonlinearBearingEstimate
from ambid.control.experiment import Experiment
from ambid.errors import AmbidError, EstimationError, nearest
from ambid.estimation.estimate import Estimate
from ambid.job.data import RigSource, known_rig
from ambid.job.results import experiment_of, load_result, rig_of
from ambid.physics.linear_model import Parameter
from ambid.physics.loop import Loop
from ambid.physics.presets import Preset, preset_of
from ambid.record import Channel, Record
from ambid.rig import Rig, RigMagnet, rig_of_preset
from ambid.rig.draft import as_logged
from ambid.settings.caller import (
    check_band,
    check_number,
    check_positive,
    check_switch,
    check_whole,
    refuse_given,
    setting,
)  # fmt: skip
from ambid.settings.calls import of_job
from ambid.signals import excitation as make_excitation
from ambid.signals import excitation_of_axes
from ambid.simulation.bench import Simulation
from ambid.simulation.rig_bench import Bench, plant_of_law
from ambid.simulation.rotor_bench import RotorBench
from ambid.simulation.variation import Schedule

BenchSource = RigSource | Preset | Estimate | NonlinearBearingEstimate
"""Who has the numbers of a bench: a preset by name, a rig in any form, an estimate of one axis, or a file of one."""

LEAST_PERIODS = 4
"""Periods of a rotor's record: their scatter is its noise."""
_RPM = 30.0 / math.pi
_ONE_WAY_S = 20.0  # a run-up or a coast-down unless told otherwise
_BEFORE_S = 0.5  # at the first speed, before the record begins
_LOOKED_AT = 5  # speeds at which the loop of a run-up has to be stable
_REACH = 10.0  # of the rate over the highest line of a rotor's excitation
FRACTION = 0.5
"""Part of the limits that an amplitude chosen by the program uses."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Excited:
    """The excitation of a simulated record."""

    kind: str
    peak: float  # in the unit of the input; rms of a gaussian; 0: there is none
    unit: str = "V"

    def words(self, digits: int = 4) -> str:
        """Say what it is."""
        return f"{self.kind} of {self.peak:.{digits}g} {self.unit}" if self.peak else self.kind


@of_job("simulate")
def simulate(
    source: BenchSource,
    duration: float | None = None,
    *,
    rate_hz: float | None = None,
    excitation: str | Path | Experiment | None = None,
    amplitude: float | None = None,
    band: tuple[float, float] | None = None,
    periods: int | None = None,
    axes: Sequence[str] | None = None,
    settle: int | None = None,
    run_up: str | Sequence[float] | None = None,
    seed: int = 0,
    closed: bool | None = None,
    nonlinear: bool = False,
    position: float | None = None,
    log_excitation: bool = False,
    force: bool = False,
) -> Record:
    """Simulate a bench and return the record that it would log; equal seeds give equal records.

    Parameters
    ----------
    source : str, Path, Rig, dict, Preset, Estimate or NonlinearBearingEstimate
        A preset by its name; a rig, its file, its text or its tables; an estimate of one axis
        or its file: its rig with the estimated values.
    duration : float, optional
        Length in s; default 1, or the experiment's.
    rate_hz : float, optional
        Sampling rate in Hz; default the bench's.
    excitation : str, Path or Experiment, optional
        One of `ambid.signals.EXCITATIONS`, or for a rotor of `ambid.signals.AXES_EXCITATIONS`; default ``multisine``,
        for a rotor ``zippered``. Or what `ambid.design_experiment` designed, or its file.
    amplitude : float, optional
        Peak in V (rms for ``gaussian``); default: what half of the limits allows.
    band : (float, float), optional
        Band of the excitation in Hz; default: one period over the record to a fifth of the rate, of a rotor from its
        first line to a tenth.
    periods : int, optional
        Number of repetitions of the excitation; default 1, for a rotor about one a second and at least 4.
    axes : sequence of str, optional
        Of a rotor: the axes that are excited; default all.
    settle : int, optional
        Of a rotor: periods that run before the record begins, so that it begins in steady state; default 1.
    run_up : str or sequence of float, optional
        Of a rotor, without excitation: speeds in rpm that it runs through evenly, (0, 20000) or ``"0:20000"`` for a
        run-up, (20000, 0) for a coast-down. Channels ``angle`` and ``speed`` are logged; by default 20 s each way.
    seed : int, optional
        Seed of excitation and noise.
    closed : bool, optional
        With or without the controller; default: as the bench usually works.
    nonlinear : bool, optional
        Simulate the nonlinear magnet instead of its linearisation.
    position : float, optional
        With `nonlinear`: position at which the loop holds the rotor, m.
    log_excitation : bool, optional
        Add a channel ``excitation``, the reference for `ambid.frf`. A rotor always has ``<axis>_reference``.
    force : bool, optional
        Simulate a loop that is predicted unstable too.

    Returns
    -------
    Record
        Columns are named as in the rig; those of a preset as in the rig file that ``ambid init`` writes of it.

    Raises
    ------
    AmbidError
        If a setting breaks a rule, the rig lacks a value, or the loop is predicted unstable.

    Examples
    --------
    >>> import ambid
    >>> record = ambid.simulate("thesis", duration=0.1, seed=1)
    >>> record.n_samples, record.names
    (1000, ('voltage', 'current', 'position'))
    """
    done, _ = simulate_used(
        source, duration=duration, rate_hz=rate_hz, excitation=excitation, amplitude=amplitude, band=band,
        periods=periods, axes=axes, settle=settle, run_up=run_up, seed=seed, closed=closed, nonlinear=nonlinear,
        position=position, log_excitation=log_excitation, force=force,
    )  # fmt: skip
    for line in done.warnings:
        warnings.warn(line, stacklevel=2)
    return done.record


def simulate_used(
    source: BenchSource,
    *,
    duration: float | None = None,
    rate_hz: float | None = None,
    excitation: str | Path | Experiment | None = None,
    amplitude: float | None = None,
    band: tuple[float, float] | None = None,
    periods: int | None = None,
    axes: Sequence[str] | None = None,
    settle: int | None = None,
    run_up: str | Sequence[float] | None = None,
    seed: int = 0,
    closed: bool | None = None,
    nonlinear: bool = False,
    position: float | None = None,
    log_excitation: bool = False,
    force: bool = False,
) -> tuple[Simulation, Excited]:
    """Return what `simulate` does with what happened, and the excitation."""
    check_positive({"duration": duration, "rate_hz": rate_hz, "amplitude": amplitude})
    check_whole({"seed": seed} | {n: x for n, x in (("periods", periods), ("settle", settle)) if x is not None})
    check_band(band)
    check_number({"position": position})
    check_switch({"closed": closed})
    if run_up is not None:
        of_others = {"excitation": excitation, "amplitude": amplitude, "band": band, "periods": periods, "axes": axes,
                     "settle": settle, "position": position, "log_excitation": log_excitation or None}  # fmt: skip
        refuse_given(of_others, f"{setting('run_up')} takes no {{}}. Omit {{}}")
        return _run_up(source, speeds_of(run_up), duration, rate_hz, seed, closed, nonlinear, force)
    bench, experiment = _bench(source, rate_hz, closed, nonlinear, position), experiment_of(excitation)
    if duration is None:
        duration = 1.0 if experiment is None else experiment.seconds
    n = samples_of(duration, bench.rate_hz)
    if not force:
        bench.refuse_unstable()
    if experiment is not None:
        of_others = {"amplitude": amplitude, "band": band, "periods": periods, "axes": axes}
        refuse_given(of_others, f"{setting('excitation')} is an experiment, which takes no {{}}. Omit {{}}")
        moved = tuple(experiment.excitation)
        if moved != bench.model.inputs if isinstance(bench, RotorBench) else len(moved) > 1:
            has = ", ".join(bench.model.inputs) if isinstance(bench, RotorBench) else "one axis"
            raise AmbidError(
                f"{setting('excitation')} is an experiment of {', '.join(moved)}, the bench has {has}. Give another"
            )
        if isinstance(bench, RotorBench):
            if log_excitation:
                raise AmbidError(_no_log())
            sets_in = experiment.period * (1 if settle is None else settle)
            waves = experiment.played(sets_in + n, bench.rate_hz, closed=bench.loop.closed)
            excited = Excited(
                kind="experiment", peak=float(np.max(np.abs(waves))), unit=bench.model.units[moved[0]]
            )  # fmt: skip
            return bench.simulate(waves, seed=seed, settle=sets_in), excited
        refuse_given({"settle": settle}, f"{setting('excitation')} is an experiment, which takes no {{}}. Omit {{}}")
        wave = experiment.played(n, bench.rate_hz, closed=bench.loop.closed)[:, 0]
        return _noted(bench.simulate(wave, seed=seed), bench.rig, wave if log_excitation else None), Excited(
            kind="experiment", peak=float(np.max(np.abs(wave)))
        )
    if amplitude is None and bench.rig is not None and bench.rig.limits is None:
        raise AmbidError(
            f"no amplitude was given, and the rig has no limits to derive one from. Give {setting('amplitude', 'A')} "
            "in V"
        )
    if isinstance(bench, RotorBench):
        if log_excitation:
            raise AmbidError(_no_log())
        kind, held = str(excitation or "zippered"), 1 if settle is None else settle
        shape, period = waves_of_axes(bench, kind, n, periods, axes, band, seed)
        trial = shape[: 2 * period]  # begins at rest: what it needs is no less than later
        peak = bench.largest(trial, seed, FRACTION) if amplitude is None else amplitude
        before = np.tile(shape[:period], (held, 1))
        done = bench.simulate(peak * np.vstack([before, shape]), seed=seed, settle=held * period)
        return done, Excited(kind=kind, peak=peak, unit=bench.model.units[bench.model.inputs[0]])
    if axes is not None or settle is not None:
        raise AmbidError(f"{setting('axes')} and {setting('settle')} are for a rotor on many axes. Omit them")
    kind = str(excitation or "multisine")
    shape = _repeat(
        lambda part: make_excitation(kind, part, bench.rate_hz, amplitude=1.0, band=band, seed=seed), n, periods or 1
    )
    peak = bench.largest(shape, seed, FRACTION) if amplitude is None else amplitude
    done = bench.simulate(peak * shape, seed=seed)
    return _noted(done, bench.rig, peak * shape if log_excitation else None), Excited(kind=kind, peak=peak)


def speeds_of(run_up: str | Sequence[float]) -> tuple[float, ...]:
    """Return the speeds of a run-up in rpm."""
    try:
        speeds = tuple(float(x) for x in (run_up.split(":") if isinstance(run_up, str) else run_up))
    except (TypeError, ValueError):
        speeds = ()
    if len(speeds) < 2 or not all(0.0 <= x < math.inf for x in speeds) or not any(speeds):
        raise AmbidError(
            f"{setting('run_up')} is {run_up!r:.40}; it must be two speeds in rpm or more, none negative, such as "
            "0:20000. Correct it"
        )
    return speeds


def _run_up(
    source: BenchSource, rpm: tuple[float, ...], duration: float | None, rate: float | None, seed: int,
    closed: bool | None, nonlinear: bool, force: bool,
) -> tuple[Simulation, Excited]:  # fmt: skip
    """Return a run through some speeds, and its words."""
    speeds = [x / _RPM for x in rpm]
    bench = _bench(source, rate, closed, nonlinear, None, speed=max(speeds))
    if not isinstance(bench, RotorBench):
        raise AmbidError(f"{setting('run_up')} is for a rotor on many axes. Omit it")
    if max(rpm) > 30.0 * bench.rate_hz:
        raise AmbidError(
            f"{setting('run_up')} goes to {max(rpm):g} rpm; at {bench.rate_hz:g} Hz it must be at most "
            f"{30.0 * bench.rate_hz:g}, two samples in a turn. Correct it, or {setting('rate_hz')}"
        )
    for speed in np.linspace(0.0, max(speeds), _LOOKED_AT) if not force else ():
        bench.at_speed(float(speed)).refuse_unstable()
    ways = len(speeds) - 1
    n = samples_of(_ONE_WAY_S * ways if duration is None else duration, bench.rate_hz)
    times = tuple((np.arange(ways + 1) * n / ways / bench.rate_hz).tolist())
    course = Schedule(times_s=times, values=tuple(speeds))
    words = f"run through {':'.join(f'{x:g}' for x in rpm)} rpm"
    return bench.run_up(course, n, seed=seed, settle=round(_BEFORE_S * bench.rate_hz)), Excited(kind=words, peak=0.0)


def _noted(done: Simulation, rig: Rig | None, wave: Array | None) -> Simulation:
    """Add a column of the excitation, where it is to be logged, and what the rig would read wrongly."""
    if rig is not None and rig.measured_input:
        text = "the current of this record is a command, held over each sample, and the rig's is measured. Read it with"
        done = replace(done, notes=(f"{text} [channels.command] in place of [channels.current]",))
    if wave is None:
        return done
    logged = Channel(name="excitation", unit="V", values=wave)
    return replace(done, record=replace(done.record, channels=(*done.record.channels, logged)))


def waves_of_axes(
    bench: RotorBench,
    kind: str,
    n: int,
    periods: int | None,
    axes: Sequence[str] | None,
    band: tuple[float, float] | None,
    seed: int,
) -> tuple[Array, int]:
    """Return the excitation of a rotor of peak one, (n_samples, n_axes), and the samples of its period."""
    known = bench.model.axes
    for axis in axes or ():
        if axis not in known:
            raise AmbidError(
                f"{setting('axes')} has {axis!r}; the rotor has {', '.join(known)}.{nearest(axis, known)} Correct it"
            )
    excited = [known.index(axis) for axis in axes or known]
    blocks = len(excited) if kind == "orthogonal" else 1
    if periods is None:
        periods = max(LEAST_PERIODS, round(n / bench.rate_hz / blocks))
        while n % (periods * blocks) and periods > 1:
            periods -= 1
    period = n // (periods * blocks)
    shape = excitation_of_axes(
        kind, n, bench.rate_hz, axes=len(known), excited=excited, amplitude=1.0, periods=periods, seed=seed,
        band=band or (None if kind == "steps" else (bench.rate_hz / max(period, 1), bench.rate_hz / _REACH)),
    )  # fmt: skip
    return shape, period


def _no_log() -> str:
    return f"{setting('log_excitation')} is for one axis; a rotor's record has <axis>_reference. Omit it"


def only_references(record: Record) -> Record:
    """Return the excitation of a rotor's record alone, to be played by its own controller."""
    kept = tuple(c for c in record.channels if c.name.endswith("_reference"))
    if not kept:
        raise AmbidError(f"{setting('excitation_only')} is for a rotor on many axes. Omit it")
    return replace(record, channels=kept)


def bench_of_source(source: BenchSource) -> Rig | Preset:
    """Return the preset or rig that a name, a file or an estimate stands for."""
    named = preset_of(source) if isinstance(source, str) else None
    if named is not None:
        return named
    if isinstance(source, (str, Path)) and str(source).lower().endswith(".json"):
        path, source = source, load_result(source)
        if not isinstance(source, Estimate | NonlinearBearingEstimate):
            raise EstimationError(f"{path} is no estimate of one axis; a simulation needs one. Give a rig")
    if isinstance(source, Estimate | NonlinearBearingEstimate):
        return rig_of_estimate(source)
    return source if isinstance(source, Preset) else known_rig(source)


def _bench(
    given: BenchSource, rate: float | None, closed: bool | None, nonlinear: bool, position: float | None,
    speed: float | None = None,
) -> Bench | RotorBench:  # fmt: skip
    """Return the bench of a preset or a rig, its rotor at a position, or at a speed in rad/s, where it is given."""
    source = bench_of_source(given)
    if isinstance(source, Preset):
        source = rig_of_preset(source) if source.rotor is not None else as_logged(source)
    if isinstance(source, Preset):
        if position is not None and source.plant is not None:
            source = replace(source, operating_point=source.plant.equilibrium(position))
        return Bench.of(source, rate, source.usually_closed if closed is None else closed, nonlinear=nonlinear)
    if position is not None:
        source = replace(source, operating_point={**source.operating_point, "position": position})
    rate = source.rate_for(rate)
    if source.rotor is not None:
        if position is not None:
            raise AmbidError(f"{setting('position')} is for one axis. Omit it")
        source = source if speed is None else replace(source, rotor=source.rotor.at_speed(speed))
        return RotorBench.of(source, rate, closed, nonlinear=nonlinear)
    return Bench.of(source, rate, closed, nonlinear=nonlinear)


def rig_of_estimate(estimate: Estimate | NonlinearBearingEstimate) -> Rig:
    """Return the rig that an estimate remembers, with the numbers that it found."""
    rig = rig_of(estimate, "the estimate")
    values, point, late = estimate.values, dict(estimate.operating_point), next(iter(estimate.delay.values()))
    if isinstance(estimate, NonlinearBearingEstimate):
        law, plant = estimate.law, plant_of_law(estimate.law, values, eddy=estimate.eddy)
        own = [p for p in estimate.parameters if p.name not in ("m", "R", "c")]
        magnet = RigMagnet(
            kind="pair" if law.pair else "single", gap=law.gap, asymmetric=law.asymmetric, saturation=law.saturation,
            rise=law.rise, eddy=estimate.eddy,
            parameters=tuple(Parameter(name=p.name, unit=p.unit, role="fixed", value=p.value) for p in own),
        )  # fmt: skip
        rig, point = replace(rig, magnet=magnet), plant.equilibrium(point["position"])._asdict()
        values, record = {**plant.linearise(point["position"]), "R": values["R"]}, estimate.records[0]
    else:
        record = estimate.record
    known = tuple(replace(p, role="fixed", value=values[p.name], sd=None) for p in rig.parameters)
    loop = replace(rig.loop or Loop(), delay=late.samples + late.fraction)
    rate = rig.record.rate_hz or float(str(record["rate_hz"]))
    return replace(
        rig, parameters=known, loop=loop, operating_point=point, record=replace(rig.record, rate_hz=rate)
    )  # fmt: skip


def samples_of(duration: float, rate_hz: float, name: str = "duration") -> int:
    """Return the samples of a record, and refuse one that is none or does not fit into memory."""
    count = duration * rate_hz
    if not 1 <= count <= 1e8:
        raise AmbidError(
            f"{setting(name)} {duration:g} s at {rate_hz:g} Hz is {count:g} samples; it must be 1 to 1e8. Correct one"
        )
    return round(count)


def _repeat(make: Callable[[int], Array], n: int, periods: int) -> Array:
    """Lay equal periods one behind the other."""
    if n % periods:
        raise AmbidError(
            f"{setting('periods', periods)}: {n} samples do not divide into that many periods. Change "
            f"{setting('duration')} or {setting('periods')}"
        )
    return np.tile(make(n // periods), periods)
