"""The job of designing an experiment: a bench in, an excitation out, and what a record of it will show."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ambid.acquisition.scales import TABLE_LENGTH, scale_of
from ambid.acquisition.settings import controller_settings, with_default_daq
from ambid.acquisition.trials import USE, VOLTAGE, Room
from ambid.arrays import Array
from ambid.control.closed import Plant
from ambid.control.curvature import advised, expected_shift, judge_shift
from ambid.control.drawn import Spread, draw_plants, laws_of, magnet_check
from ambid.control.experiment import (
    Design,
    ExcitedLoop,
    Expected,
    Experiment,
    Lines,
    Shown,
    SignalUse,
    Task,
    design,
    hardest,
    lines_of,
    played,
    uses,
)
from ambid.control.information import Information, Innovation, reported
from ambid.errors import AmbidError, nearest
from ambid.estimation.estimate import Check, Estimate
from ambid.estimation.linear import one_thread
from ambid.estimation.progress import Tick, silent
from ambid.estimation.uncertainty import WEAK
from ambid.job.closed_loop import plant_of
from ambid.job.data import Clock, RigSource, known_rig, rig_entry
from ambid.job.results import load_result, rig_of
from ambid.job.simulation import BenchSource, bench_of_source, samples_of
from ambid.physics.loop import Loop, Noise
from ambid.physics.presets import Preset
from ambid.physics.rotor_model import RotorModel
from ambid.record import Channel, Record
from ambid.rig import Rig, rig_of_preset
from ambid.rotor.estimate import RotorEstimate
from ambid.rotor.spectra import LEAST_LINES, LEAST_PERIODS
from ambid.settings.caller import check_band, check_positive, check_share, check_switch, check_whole, saved, setting
from ambid.settings.calls import of_job
from ambid.signals.excitations import schroeder_phases
from ambid.simulation.plant import LinearPlant
from ambid.simulation.rig_bench import Bench, loop_of_rig
from ambid.simulation.rotor_bench import RotorBench, kind_of

SPREAD = 0.1
"""Part of their values within which free parameters of a rig lie, two standard deviations, for the drawn plants."""
TARGET = 0.01
"""Relative standard deviation for which the length of the record is told."""
HIGHEST = 0.4
"""Part of the rate up to which lines may be."""
_PLANTS = 200  # drawn
_SCATTER = Spread(delay=0.0, position=0.0, current=0.0, eddy=0.0, warm_k=(0.0, 0.0), frequency=0.0, damping=0.0)
_RESERVE = 4.0  # standard deviations of noise that are kept free
_SECONDS = 10.0
_PERIODS = 4  # of a record
_LONGEST = 8192  # samples of a period, unless another is given
_MOST = 65536  # samples of a period that is given
_LINES = 100
_WHOLE = 0.1  # of a sample, from which identify estimates a fraction of the delay
_LENGTHS, _LEVELS = np.geomspace(0.1, 100.0, 31), np.geomspace(0.1, 1.0, 11)  # of the record, of its amplitude
_DIGITS = 6  # of what is drawn
_EVER, _HALVINGS = 1e12, 40  # periods beyond which no length is sought, and steps of the search
_KEPT = 1.0 + 1e-6  # largest pole
_FULL = 1.0 + 1e-6  # use of a limit
_ESTIMATES, _UNSURE = 8, 0.1  # drawn by what is promised; scatter of a promise, relative, from which it is said
_TURNS_S = 1.0  # in which unbalance sets in, and is looked at
_ROUNDINGS = 4  # of a table, each a little smaller


Known = Estimate | RotorEstimate
AnyBench = Bench | RotorBench


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """Settings of a design."""

    seconds: float | None = None
    period_s: float | None = None
    band: tuple[float, float] | None = None
    lines: int = _LINES
    criterion: str = "all"
    target: float = TARGET
    use: float = USE
    spread: float = SPREAD
    seed: int = 0


@of_job("design experiment")
def design_experiment(
    source: BenchSource,
    rig: RigSource | None = None,
    *,
    seconds: float | None = None,
    period: float | None = None,
    band: tuple[float, float] | None = None,
    lines: int = _LINES,
    criterion: str = "all",
    target: float = TARGET,
    use: float = USE,
    spread: float = SPREAD,
    rate_hz: float | None = None,
    closed: bool | None = None,
    seed: int = 0,
    tick: Tick | None = None,
) -> Experiment:
    """Design the periodic excitation that shows the parameters of a bench best within its limits.

    Amplitudes and phases of a multisine are optimised together: the criterion is the mean square relative standard
    deviation that `ambid.identify` will report, by the Fisher information of the plant in its loop and its noise; the
    limits are peaks of position, current and voltage, as the model predicts them, for drawn plants and from rest too.

    Parameters
    ----------
    source : str, Path, Rig, Preset, Estimate or RotorEstimate
        A preset by its name; a rig or its file, designed for its values; a linear estimate, of one axis or of a rotor,
        or its file, designed for what it found, with its noise.
    rig : Rig, path, dict or TOML text, optional
        Of an estimate: with other limits, loop or controller than its own.
    seconds : float, optional
        Length of the record in s; default 10.
    period : float, optional
        Of the excitation, s; default: a quarter of the record, at most 8192 samples; of a rig with ``[daq]`` what the
        controller's table of 1000 elements holds.
    band : (float, float), optional
        Hz; default from one line to a fifth of the rate.
    lines : int, optional
        How many are excited, at most.
    criterion : str, optional
        ``"all"``: mean over the parameters; or the name of one.
    target : float, optional
        Relative standard deviation for which the length of the record is told.
    use : float, optional
        Part of the way from rest to the limits of position and current that may be used; of a controller's rig to its
        trips. The bench is not linear, and what is estimated of a linear model moves with the amplitude.
    spread : float, optional
        Two relative standard deviations of free parameters of a rig, for the drawn plants; priors and estimates bring
        their own.
    rate_hz : float, optional
        Sampling rate; default the bench's.
    closed : bool, optional
        With or without the loop; default: as the bench usually works.
    seed : int, optional
        Of the drawn plants.
    tick : callable, optional
        Called with the name of the present stage; may raise to interrupt.

    Returns
    -------
    Experiment

    Raises
    ------
    AmbidError
        If a setting breaks a rule, or the bench lacks a value, a limit, a loop or its noise.

    Examples
    --------
    >>> import ambid
    >>> found = ambid.design_experiment("prototype", seconds=1.0, lines=20)
    >>> found.expected["k_x"].sd < 0.5 * found.expected["k_x"].flat_sd
    True
    """
    say, clock = tick or silent, Clock()
    check_positive(
        {
            "seconds": seconds,
            "period": period,
            "rate_hz": rate_hz,
            "target": target or 0,
            "use": use or 0,
        }
    )
    if use > 1.0:
        raise AmbidError(f"{setting('use')} is {use:g}; it must be at most 1. Lower it")
    check_share({"spread": spread})
    check_whole({"lines": lines}, 2, _MOST // 2)
    check_whole({"seed": seed})
    check_band(band)
    check_switch({"closed": closed})
    wanted = Wanted(
        seconds=seconds, period_s=period, band=band, lines=lines, criterion=criterion, target=target, use=use,
        spread=spread, seed=seed,
    )  # fmt: skip
    say("read")
    known, bench = _given(source, rig, rate_hz, closed)
    clock.lap("read")
    with one_thread():
        found = _designed(known, bench, wanted, say)
    clock.lap("design")
    assert bench.rig is not None
    return replace(found, timing_s=clock.laps, rig=rig_entry(bench.rig))


def _given(
    source: BenchSource, rig: RigSource | None, rate_hz: float | None, closed: bool | None
) -> tuple[Known | None, AnyBench]:
    """Return the estimate, where that is the source, and the bench with the numbers that are designed for."""
    if isinstance(source, (str, Path)) and str(source).lower().endswith(".json"):
        source = load_result(source)
    known = source if isinstance(source, (Estimate, RotorEstimate)) else None
    given = None if rig is None else known_rig(rig)
    if given is not None and known is None:
        raise AmbidError(f"{setting('rig')} is for an estimate; a rig is there already. Omit {setting('rig')}")
    if isinstance(source, RotorEstimate):
        return source, _rotor_of(source, given or rig_of(source, "the estimate"), rate_hz, closed)
    if not isinstance(source, (str, Path, Rig, Mapping, Preset, Estimate)):
        raise AmbidError(
            f"a {type(source).__name__} is no linear estimate, for which an experiment is designed. Give "
            f"{saved('identify')}, or a rig"
        )
    of = bench_of_source(source)
    of = rig_of_preset(of) if isinstance(of, Preset) else of
    if given is not None:
        loop = None if given.loop is None else replace(given.loop, delay=of.loop.delay if of.loop else 0.0)
        of = replace(given, parameters=of.parameters, operating_point=of.operating_point, loop=loop)
    if of.rotor is not None:
        return None, RotorBench.of(of, rate_hz, closed)
    if rate_hz is None and of.daq is not None:
        rate_hz = of.daq.rate_hz
    if of.magnet is not None and any(p.value is None for p in of.parameters):
        at_rest = Bench.of(of, rate_hz, closed, nonlinear=True).parameters
        filled = tuple(replace(p, value=at_rest[p.name] if p.value is None else p.value) for p in of.parameters)
        of = replace(of, parameters=filled)
    return known, Bench.of(of if of.daq is None else _with_steps(of), rate_hz, closed)


def _rotor_of(known: RotorEstimate, rig: Rig, rate_hz: float | None, closed: bool | None) -> RotorBench:
    """Return the bench of a rotor's estimate, at its speed."""
    if rig.rotor is None:
        raise AmbidError(f"rig {rig.name!r} has no [bearings.X]; the estimate is of a rotor. Give its rig")
    plant = plant_of(known, rate_hz or float(str(known.record["rate_hz"])), known.speed)
    loop = replace(loop_of_rig(rig, closed) or Loop(), delay=float(np.mean(plant.delays)))
    return RotorBench(
        rig=rig, plant=LinearPlant(model=plant.model, parameters=plant.theta), loop=loop, rate_hz=plant.rate_hz,
        shapes={},
    )  # fmt: skip


def _with_steps(rig: Rig) -> Rig:
    """Return a controller's rig whose noise has the steps of its converters."""
    full, noise = with_default_daq(rig), rig.noise or Noise()
    rest = controller_settings(full)
    counts = {"position": rest.setpoint, "current": rest.current_rest}
    steps = {f"{role}_resolution": abs(scale_of(full, role).slope(at)) for role, at in counts.items()}
    return replace(rig, noise=replace(noise, **steps))


def _designed(known: Known | None, bench: AnyBench, wanted: Wanted, say: Tick) -> Experiment:
    """Draw plants, set the task, design, and say what comes of it."""
    plant, prior_sd = _plant(known, bench)
    loop = ExcitedLoop.of(plant, bench.loop)
    if bench.loop.closed:
        bench.refuse_unstable()
    elif loop.pole > _KEPT:
        raise AmbidError(
            f"the plant is unstable (largest pole {loop.pole:.5g}) and has no loop; no excitation keeps it within "
            "limits. Give [loop] in the rig"
        )
    noise = _innovation(known, bench, plant)
    low, high = _room(bench, loop, wanted)
    spare = _RESERVE * loop.noise_sd(noise) + _turning(known, bench, loop)
    _refuse_full(loop.signals, spare, low, high)
    _refuse_criterion(wanted.criterion, plant.names)
    drawn = [ExcitedLoop.of(x, bench.loop) for x in _drawn(known, bench, plant, wanted)]
    loops = [loop, *(x for x in drawn if x.pole <= _KEPT)]
    unstable = 1 + len(drawn) - len(loops)
    task = _task(
        bench, loops, lambda of: _innovation(known, bench, of), (low + spare, high - spare), wanted, prior_sd
    )  # fmt: skip
    if isinstance(bench, RotorBench) and (
        min(wanted.lines, task.candidates().size) < LEAST_LINES or task.periods < LEAST_PERIODS
    ):
        raise AmbidError(
            f"{min(wanted.lines, task.candidates().size)} lines in {task.periods} periods; a rotor is identified from "
            f"{LEAST_LINES} lines and {LEAST_PERIODS} periods at least. Change "
            f"{setting('band')}, {setting('period')} or {setting('seconds')}"
        )
    say("design")
    found = design(task, tick=lambda: say("design"))
    return _told(bench, task, found, (low, high, spare), wanted, unstable)


def _plant(known: Known | None, bench: AnyBench) -> tuple[Plant, dict[str, float]]:
    """Return the nominal plant with the names that identify estimates, and the priors' standard deviations."""
    rig = bench.rig if known is None else rig_of(known, "the estimate")
    assert rig is not None
    linear = bench.plant if isinstance(bench, RotorBench) else bench.linear
    of = linear.model
    names = [p.name for p in rig.parameters if p.role != "fixed"]
    if isinstance(of, RotorModel):
        names += [p.name for p in of.mode_parameters]
    if not names:
        raise AmbidError("every parameter of the rig is fixed, and none is left to identify. Free at least one")
    part = bench.loop.delay % 1.0
    if known is not None:
        late = [role for role in of.inputs if known.delay[role].sd is not None]
    else:
        fraction = _WHOLE <= part <= 1.0 - _WHOLE
        late = [role for role in of.inputs if fraction and rig.channel(role).delay == "auto"]
    if isinstance(known, RotorEstimate):
        names = [p.name for p in of.parameters if p.name in known.covariance_names]
    plant = Plant(
        model=of, theta=linear.parameters, delays=np.full(len(of.inputs), bench.loop.delay),
        rate_hz=bench.rate_hz, names=(*names, *(f"{role}.delay" for role in late)),
    )  # fmt: skip
    return plant, {p.name: p.sd for p in rig.parameters if p.sd is not None}


def _innovation(known: Known | None, bench: AnyBench, plant: Plant) -> Innovation:
    """Return the noise that an estimate found, else that of the rig."""
    if known is None:
        return Innovation.of(plant, bench.noise)
    if isinstance(known, RotorEstimate):
        sd = [np.array([known.noise[n] for n in x]) for x in (plant.model.outputs, plant.model.disturbances)]
        return Innovation.of_sources(plant, *sd)
    return Innovation(gain=known.noise.gain, covariance=known.noise.innovation_covariance)


def _drawn(known: Known | None, bench: AnyBench, plant: Plant, wanted: Wanted) -> list[Plant]:
    """Return drawn plants: of an estimate by its covariance, of a rig by priors and spread."""
    assert bench.rig is not None
    own = {p.name: p.sd for p in bench.rig.parameters}
    names = tuple(n for n in plant.names if n in plant.theta)
    if known is not None:
        names, covariance = known.covariance_names, known.covariance
    else:
        half = [abs(plant.theta[n]) * wanted.spread / 2.0 for n in names]
        covariance = np.diag([own.get(n) or x for n, x in zip(names, half, strict=True)]) ** 2
    around = replace(plant, names=names, covariance=covariance)
    drawn = draw_plants(around, bench.rig, 1 + _PLANTS, seed=wanted.seed, spread=_SCATTER).plants[1:]
    return [replace(d.plant, names=plant.names) for d in drawn]


def _room(bench: AnyBench, loop: ExcitedLoop, wanted: Wanted) -> tuple[Array, Array]:
    """Return how far each signal may go down and up from rest, SI."""
    assert bench.rig is not None
    room, point = Room.of(bench.rig), {} if isinstance(bench, RotorBench) else bench.point._asdict()
    low, high = [], []
    for name in loop.signals:
        kind = kind_of(name)
        trip = bench.rig.trip("current" if kind == "current" else "position")
        ends, share = (room.voltage, VOLTAGE) if kind == "voltage" else (trip, wanted.use)
        rest = point.get(name, 0.0)
        low.append(share * (ends[0] - rest))
        high.append(share * (ends[1] - rest))
    if not np.any(np.isfinite([*low, *high])):
        raise AmbidError(
            f"rig {bench.rig.name!r} has no limits of voltage, current or position; an excitation is designed for "
            "them. Give [loop.limits]"
        )
    return np.array(low), np.array(high)


def _turning(known: Known | None, bench: AnyBench, loop: ExcitedLoop) -> Array:
    """Return how far unbalance and runout move the signals of a rotor that turns, (n_signals,)."""
    if not isinstance(bench, RotorBench) or not bench.model.speed:
        return np.zeros(len(loop.signals))
    if isinstance(known, RotorEstimate):
        seen = [r["response"] for r in known.synchronous.get("records", ())]
        moved = {n: max((sum(r[n]["amplitude"]) for r in seen if n in r), default=0.0) for n in loop.signals}
    else:
        n, still = round(_TURNS_S * bench.rate_hz), replace(bench, rig=replace(bench.rig, noise=None))
        unexcited = np.zeros((2 * n, len(bench.model.inputs)))
        record = still.simulate(unexcited, seed=0, columns=False, settle=n).record
        moved = {c.name: float(np.max(np.abs(c.values))) for c in record.channels}
    return np.array([moved.get(name, 0.0) for name in loop.signals])


def _refuse_full(signals: tuple[str, ...], spare: Array, low: Array, high: Array) -> None:
    """Refuse where noise alone, or rest, uses the limits."""
    room = np.minimum(-low, high) - spare
    k = int(np.argmin(room))
    if room[k] <= 0.0:
        raise AmbidError(
            f"{signals[k]} may move {min(-low[k], high[k]):.3g} from rest, noise needs {spare[k]:.3g} of it (4 sd), "
            f"so that nothing is left for an excitation. Extend the limit, correct [noise], or raise {setting('use')}"
        )


def _refuse_criterion(criterion: str, names: tuple[str, ...]) -> None:
    """Refuse the name of what is not estimated."""
    names = tuple(n for n in names if reported(n) and not n.endswith(".delay"))
    if criterion not in ("all", *names):
        raise AmbidError(
            f"{setting('criterion')} {criterion!r}; it must be all or an estimated parameter: "
            f"{', '.join(names)}."
            f"{nearest(criterion, list(names))} Correct it"
        )


def _task(
    bench: AnyBench, loops: list[ExcitedLoop], noise: Callable[[Plant], Innovation], ends: tuple[Array, Array],
    wanted: Wanted, prior_sd: dict[str, float],
) -> Task:  # fmt: skip
    """Return the task: period, lines and length beside plants and limits."""
    rate = bench.rate_hz
    assert bench.rig is not None
    seconds = wanted.seconds or _SECONDS
    samples_of(seconds, rate, "seconds")  # no longer than can be simulated
    hold, period = 1, min(round(seconds * rate / _PERIODS), _LONGEST)
    if wanted.period_s is not None:
        period = round(wanted.period_s * rate)
    if bench.rig.daq is not None and bench.rig.rotor is None:
        if wanted.period_s is None:
            low = wanted.band[0] if wanted.band else 0.0
            period = int(np.ceil(rate / low - 1e-9)) if low else TABLE_LENGTH
        hold = int(np.ceil(period / TABLE_LENGTH - 1e-9))
        period -= period % hold
    if not 4 <= period <= _MOST:
        raise AmbidError(
            f"the period has {period} samples; it must be 4 to {_MOST}. Correct {setting('period')} or "
            f"{setting('band')}"
        )
    band, highest = wanted.band or (rate / period, rate / 5.0), HIGHEST * rate
    if band[1] > highest:
        raise AmbidError(
            f"{setting('band')} goes up to {band[1]:g} Hz; it may go to {highest:g} Hz, {HIGHEST:g} of the rate. "
            "Lower it"
        )
    periods = max(1, round(seconds * rate / period))
    return Task(
        loops=loops, noise=noise, low=ends[0], high=ends[1], period=period, periods=periods,
        band_hz=(band[0], min(band[1], highest / hold)), n_lines=wanted.lines, criterion=wanted.criterion,
        prior_sd=prior_sd, hold=hold, speed=abs(getattr(loops[0].plant.model, "speed", 0.0)),
    )  # fmt: skip


def _told(
    bench: AnyBench, task: Task, found: Design, ends: tuple[Array, Array, Array], wanted: Wanted, unstable: int
) -> Experiment:
    """Play the design, and say what it uses and what a record of it will show."""
    assert bench.rig is not None
    loop, of, quantum = task.loops[0], task.loops[0].plant.model, None
    if bench.rig.daq is not None and bench.rig.rotor is None:
        full = with_default_daq(bench.rig)
        quantum = abs(scale_of(full, "voltage").slope(controller_settings(full).duty_bias))
    for _ in range(_ROUNDINGS):
        wave, table = played(found, task, quantum)
        lines, c = lines_of(wave)
        used = uses(task, lines, c)
        if table is None or quantum is None or used.max() <= _FULL:
            break
        found = replace(found, c=found.c / (used.max() + quantum / table.amplitude))  # a step less at least
    information, power = task.information(lines, [0]), np.abs(c) ** 2
    expected = _expected(task, information, power, _flat_sd(task, found), wanted.target)
    curved = agrees = None
    if isinstance(bench, Bench) and of.name == "one-axis":
        laws, assumed = laws_of(loop.plant, bench.rig, bench.point._asdict())
        agrees = magnet_check(laws, loop.plant.theta)
        if laws:
            shift = expected_shift(task, lines, c, information, laws[""]).tolist()
            expected = {
                n: replace(expected[n], shift=x) for n, x in zip(information.names, shift, strict=True) if n in expected
            }
            curved = _curvature(expected, assumed[0])
    waves = dict(zip(loop.signals, task.limited(lines, [0]).waves(c).T, strict=True))
    by_length = [information.relative_sd(power, x * task.samples) for x in _LENGTHS]
    by_level = [information.relative_sd(power * x**2, task.samples) for x in _LEVELS]
    curves = [
        {name: x for name, x in zip(information.names, np.transpose(sd), strict=True) if name in expected}
        for sd in (by_length, by_level)
    ]
    drive = np.eye(len(of.inputs))[task.inputs(found.lines)] * found.c[:, None]
    by_input = dict(zip(of.inputs, drive.T, strict=True))
    return Experiment(
        model=of.name, criterion=task.criterion, rate_hz=task.rate_hz, period=task.period, periods=task.periods,
        frequency_hz=task.frequency_hz(found.lines), amplitude={name: np.abs(c) for name, c in by_input.items()},
        phase={name: np.angle(c) for name, c in by_input.items()},
        excitation=dict(zip(of.inputs, wave.T, strict=True)), table=table,
        closed=bench.loop.closed, signals=_signals(loop, ends, used, waves), expected=expected, target=wanted.target,
        gap=found.gap, drawn=len(task.loops) - 1,
        checks=_checks(used, expected, unstable) | {
            n: c for n, c in (("curvature", curved), ("magnet_agrees", agrees)) if c is not None
        },
        warnings=(*_lowered(task, wanted), *_cautions(bench.rig, task, lines, power, information)),
        shown=Shown(
            waves={name: rounded(x) for name, x in waves.items()},
            seconds=_LENGTHS * (task.samples / task.rate_hz),
            by_length=curves[0], levels=_LEVELS, by_level=curves[1],
        ),
    )  # fmt: skip


def _lowered(task: Task, wanted: Wanted) -> tuple[str, ...]:
    """Say where the controller's table, which holds each element for some samples, cannot play the band."""
    asked, top = (0.0, 0.0) if wanted.band is None else wanted.band, task.band_hz[1]
    return () if asked[1] <= top else (
        f"{setting('band')} goes up to {asked[1]:g} Hz; the controller's table holds each of its elements for "
        f"{task.hold} samples "
        f"and plays up to {top:.4g} Hz. Shorten {setting('period')}, or raise the lower end of the band",
    )  # fmt: skip


def _cautions(rig: Rig, task: Task, lines: Lines, power: Array, known: Information) -> tuple[str, ...]:
    """Say what is promised of a rotor with modes by weakly shown numbers: a turning one trades frequencies at rest for
    gyroscopic terms, and the information at the estimate, which scatters, is another.
    """
    plant = task.loops[0].plant
    if not getattr(plant.model, "n_modes", 0):
        return ()
    covariance = np.linalg.pinv(known.total(power, task.samples)[0], hermitian=True) * np.outer(
        known.sizes, known.sizes
    )
    around = draw_plants(replace(plant, covariance=covariance), rig, 1 + _ESTIMATES, seed=0, spread=_SCATTER)
    loops = [ExcitedLoop.of(replace(d.plant, names=plant.names), task.loops[0].loop) for d in around.plants]
    found = [replace(task, loops=[x]).information(lines, [0]) for x in loops]
    sd = np.array([x.relative_sd(power, task.samples) * x.sizes for x in found])
    scatter = np.sqrt(np.mean((sd[1:] / sd[0] - 1.0) ** 2, axis=0))
    said = [f"{n} {100 * x:.0f} %" for n, x in zip(known.names, scatter, strict=True) if reported(n) and x > _UNSURE]
    return () if not said else (
        f"promised standard deviations are themselves uncertain ({', '.join(said)}): they depend on gyroscopic terms "
        "that a record at one speed shows weakly. Add a record at another speed, or one at rest",
    )  # fmt: skip


def _flat_sd(task: Task, found: Design) -> Array:
    """Return the relative standard deviations of a flat multisine with Schroeder's phases at the same use, (n,)."""
    lines = task.candidates()
    flat = np.exp(1j * schroeder_phases(np.ones(lines.size)))
    plants = [0, *hardest(task, found.lines, found.c)]
    flat = flat / float(np.max(task.limited(lines, plants).use(flat)))
    return task.information(lines, [0]).relative_sd(np.abs(flat) ** 2, task.samples)


def _expected(task: Task, known: Information, power: Array, flat: Array, target: float) -> dict[str, Expected]:
    """Return what a record will show, by parameter."""
    plant, relative = task.loops[0].plant, known.relative_sd(power, task.samples)
    units, found = {p.name: p.unit for p in plant.model.parameters}, {}
    for k, name in enumerate(known.names):
        if not reported(name):
            continue
        seen = bool(relative[k] < WEAK)
        found[name] = Expected(
            value=plant.theta.get(name, float(plant.delays.mean())), unit=units.get(name, "1"),
            sd=float(relative[k] * known.sizes[k]), relative_sd=float(relative[k]),
            flat_sd=float(flat[k] * known.sizes[k]), identifiable=seen,
            seconds=_seconds(task, known, power, (k, target)) if seen else None,
        )  # fmt: skip
    return found


def _seconds(task: Task, known: Information, power: Array, aim: tuple[int, float]) -> float:
    """Return the record length, a period at least, for a relative standard deviation; no root rule, as priors do not
    grow.
    """
    low, high = 0.0, math.log(_EVER)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        reached = known.relative_sd(power, task.period * math.exp(middle))[aim[0]] <= aim[1]
        low, high = (low, middle) if reached else (middle, high)
    return task.period * (math.exp(high) if low else 1.0) / task.rate_hz


def _signals(
    loop: ExcitedLoop, ends: tuple[Array, Array, Array], used: Array, waves: Mapping[str, Array]
) -> dict[str, SignalUse]:
    """Return what the excitation moves, by signal."""
    of, found = loop.plant.model, {}
    low, high, spare = ends
    for k, (name, wave) in enumerate(waves.items()):
        finite = [float(x) if np.isfinite(x) else None for x in (low[k], high[k])]
        found[name] = SignalUse(
            unit=of.units[name],
            low=finite[0], high=finite[1], steady=float(used[0, 0, k]), from_rest=float(used[0, 1, k]),
            drawn=float(used[:, :, k].max()), peak=float(np.max(np.abs(wave))), reserve=float(spare[k]),
        )  # fmt: skip
    return found


def rounded(x: Array) -> Array:
    """Return numbers with as many digits as are drawn, so that a file of them is short."""
    top = float(np.max(np.abs(x)))
    return x if top == 0.0 else np.round(x, _DIGITS - 1 - int(np.floor(np.log10(top))))


def _checks(used: Array, expected: Mapping[str, Expected], unstable: int) -> dict[str, Check]:
    """Judge limits, drawn plants and what stays unseen."""
    weak = [name for name, x in expected.items() if not x.identifiable]
    most = float(used.max())
    return {
        "limits": Check(
            passed=most <= _FULL, values={"use": most},
            detail=f"the nominal plant and {used.shape[0] - 1} drawn ones stay within the limits, from rest too"
            if most <= _FULL else
            f"rounding to the controller's table takes a drawn plant to {100.0 * most:.1f} % of a limit. Lower "
            f"{setting('use')}",
        ),
        "loop": Check(
            passed=unstable == 0, values={"unstable": float(unstable)},
            detail="all drawn plants are stable, in their loop if there is one" if not unstable else
            f"{unstable} of {_PLANTS} drawn plants are unstable in this loop; limits are kept for the others alone. "
            f"Know the plant better ({setting('spread')}, priors, an estimate)",
        ),
        "identifiable": Check(
            passed=not weak,
            detail="every parameter will be seen" if not weak else
            f"the record will not show {', '.join(weak)} (25 % or worse). Record longer, use more of the limits, or "
            "give a prior",
        ),
    }  # fmt: skip


def _curvature(expected: Mapping[str, Expected], assumed: str) -> Check:
    """Judge what curvature will move."""
    shift = {name: x.shift for name, x in expected.items() if x.shift is not None and not name.endswith(".delay")}
    size = {name: far * expected[name].sd for name, far in shift.items()}
    passed, said = judge_shift(shift, size, {name: expected[name].value for name in shift}, in_interval=False)
    if not passed:
        said += (
            f" ({assumed}). Play {advised(shift):.2g} of it or less ({setting('use')}), or identify with "
            f"{setting('identify_nonlinear')}"
        )
    return Check(passed=passed, values=shift, detail=said)


def one_period(found: Experiment) -> Record:
    """Return one period of the excitation as a record, a column an input."""
    channels = tuple(
        Channel(name=f"{name}.excitation", unit=found.signals[name].unit, values=x)
        for name, x in found.excitation.items()
    )
    return Record(channels=channels, rate_hz=found.rate_hz)
