"""The job of a rotor on many axes: records and a rig in, one estimate of the machine out; several speeds, or one
bearing excited at a time, give one machine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import isfinite, pi
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from ambid.errors import EstimationError, RecordError, counted
from ambid.estimation.estimate import Check, disowned
from ambid.estimation.linear import one_thread
from ambid.estimation.progress import Tick, silent
from ambid.job.data import Clock, Reading, Source, load_bench, origin, overlap, rig_entry, stretch_of
from ambid.physics.linear_model import Parameter
from ambid.record import Record
from ambid.rig import Rig
from ambid.rotor.estimate import RotorEstimate
from ambid.settings.caller import setting

if TYPE_CHECKING:
    from ambid.arrays import Complex
    from ambid.control.closed import ClosedLoop
    from ambid.rotor.conclusion import Evidence
    from ambid.rotor.estimator import RotorFit
    from ambid.rotor.lines import Line
    from ambid.rotor.prediction import PredictorFit
    from ambid.rotor.replay import RotorReplay
    from ambid.rotor.spectra import Excitation, PeriodSpectra
    from ambid.rotor.synchronous import Separated

LEAST = 200  # samples
_TURNING = ("angle", "speed", "tacho")
_SAME_RATE = 1e-6
_ROUNDS = 4  # in which lines of hum are taken out


def identify_rotor(
    records: Sequence[Source],
    rig: Rig,
    *,
    speed_rpm: float | Sequence[float] | None = None,
    tick: Tick | None = None,
    apart: Sequence[Separated] = (),
    **reading: Unpack[Reading],
) -> RotorEstimate:
    """Identify a rotor by a `rig` with bearings: two or more whole periods by the estimator on period spectra, else by
    the predictor. `speed_rpm`: of each record; `apart`: their synchronous parts, where each is one experiment whose
    part is known; `reading`: of files. EstimationError where nothing can be identified.
    """
    from ambid.estimation.calibration import calibrated, linear_moves
    from ambid.job.closed_loop import loop_and_peaks
    from ambid.rotor.conclusion import conclude, lines_seen
    from ambid.rotor.synchronous import separate

    say, clock, model = tick or silent, Clock(), rig.rotor
    assert model is not None
    readings = read_records(records, rig, speed_rpm, say, **reading)
    benches = [r.bench for r in readings]
    for bench in benches:
        _check(bench, rig)
    clock.lap("read")
    say("periods")
    turning = apart or [separate(r.bench, model, r.speed) for r in readings]
    warnings = [said for r in readings for said in r.warnings]
    for r, x in zip(readings, turning, strict=True):
        rig_speed = model.speed if len(readings) == 1 else 0.0  # the rig's is that of one record
        warnings += x.warnings(r.name, rig_speed if r.speed is None else r.speed)
    clean, speeds, excitations = ([getattr(x, q) for x in turning] for q in ("record", "speed", "excitation"))
    _check_speeds(readings, speeds)
    rig = _turning_rig(rig, max(speeds, key=abs))
    clock.lap("periods")
    with one_thread():
        periodic = [x for x in excitations if x is not None]
        if len(periodic) == len(benches):
            outcome = _from_periods(clean, speeds, periodic, rig, say, clock)
        else:
            outcome = _from_innovations(clean, speeds, excitations, rig, say, clock)
        estimate = conclude(
            outcome.fit, outcome.evidence, rig.parameters, outcome.records,
            delay_how=["given" if d is not None else "estimated" for d in _delays(rig)],
            more_checks={**_record_checks(benches, clean, rig), "method": Check(passed=True, detail=outcome.why),
                         **outcome.checks},
            rig=rig_entry(rig), warnings=[*warnings, *outcome.warnings],
        )  # fmt: skip
        estimate = replace(estimate, checks={**estimate.checks, **_plausible(estimate, rig, benches[0])})
        names = tuple(name for name in estimate.covariance_names if name in estimate.numbers)
        known = rig, estimate.plant, estimate.numbers, names
        moves = partial(linear_moves, *known, estimate.covariance_of(names), lines_seen(outcome.fit))
        estimate = disowned(calibrated(estimate, *known, moves))
        fastest = max(range(len(clean)), key=lambda k: abs(speeds[k]))  # its speed is that of the estimate's plant
        loop, sensitivity, said = loop_and_peaks(estimate, rig, clean[fastest], outcome.seen[fastest], estimate.speed)
        try:
            synchronous = _synchronous(estimate, turning, outcome.seen, loop, rig)
        except np.linalg.LinAlgError:  # an estimate far from a rotor, such as one that did not converge
            synchronous = {}
            said = (*said, "unbalance was not worked out: the estimated rotor has no finite response at the speed")
    clock.lap("checks")
    return replace(
        estimate, sensitivity=sensitivity, synchronous=synchronous, warnings=(*estimate.warnings, *said),
        timing_s=clock.laps, used=tuple(benches),
    )  # fmt: skip


def _turning_rig(rig: Rig, speed: float) -> Rig:
    """Return a rig with the polar moment of inertia of a rotor that turns, also where it thinks of a rotor at rest."""
    assert rig.rotor is not None
    if not rig.rotor.at_speed(speed).turning or any(p.name == "Ip" for p in rig.parameters):
        return rig
    polar = Parameter(name="Ip", unit="kg m^2", role="free")
    return replace(rig, rotor=replace(rig.rotor, polar=True), parameters=(*rig.parameters, polar))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Found:
    """What either estimator leaves to be concluded from; `why` it was chosen."""

    fit: RotorFit | PredictorFit
    evidence: Evidence
    records: Sequence[Mapping[str, object]]
    spectra: PeriodSpectra  # of the record at the highest speed, which is that of the estimate's plant
    why: str
    seen: Sequence[PeriodSpectra | None]  # of each record
    warnings: Sequence[str] = ()
    checks: Mapping[str, Check] = field(default_factory=dict)


def _from_periods(
    benches: Sequence[Record],
    speeds: Sequence[float],
    excitations: Sequence[Excitation],
    rig: Rig,
    say: Tick,
    clock: Clock,
) -> _Found:
    """Estimate from period spectra."""
    from ambid.rotor.conclusion import experiments_hint, of_periods
    from ambid.rotor.estimator import estimate_rotor
    from ambid.rotor.likelihood import Experiment
    from ambid.rotor.lines import apart, find_lines, without_lines
    from ambid.rotor.spectra import period_spectra

    model = rig.rotor
    assert model is not None
    remembered, warnings = [], list[str]()
    lines: list[list[Line]] = [[] for _ in benches]
    for left in reversed(range(_ROUNDS)):
        pairs = zip(benches, speeds, excitations, lines, strict=True)
        experiments = [
            Experiment(spectra=apart(period_spectra(bench, model, excitation, speed), out), speed=speed)
            for bench, speed, excitation, out in pairs
        ]
        clock.lap("periods")
        fit = estimate_rotor(experiments, model, rig.parameters, delays=_delays(rig), modes=rig.modes, tick=say)
        clock.lap("fit")
        order = [experiments.index(e) for e in fit.problem.experiments]
        more = dict(zip(order, find_lines(fit), strict=True))
        if not left or not any(more.values()):
            break
        roles = (*model.inputs, *model.outputs)
        cleaned = [
            without_lines(b, x, roles, more[k]) for k, (b, x) in enumerate(zip(benches, excitations, strict=True))
        ]
        benches, lines = [c[0] for c in cleaned], [[*a, *c[1]] for a, c in zip(lines, cleaned, strict=True)]
    for k, (bench, speed, e, found) in enumerate(zip(benches, speeds, experiments, lines, strict=True)):
        spectra = e.spectra
        remembered.append(
            {**origin(bench), "speed": speed, "periods": spectra.n_periods, "period_s": spectra.period / bench.rate_hz}
        )
        if spectra.dropped:
            lost = spectra.dropped / bench.rate_hz
            warnings.append(f"{name_of(bench)}: the first {lost:.4g} s were left out: a transient, or part of a period")
        if found:
            warnings.append(
                f"{name_of(bench)}: lines were taken out: {_listed(found)}. Hum, motion of the base, or a tone"
            )
        if more[k]:
            warnings.append(f"{name_of(bench)}: lines remain: {_listed(more[k])}. Look for their source")
    say("check")
    hint = experiments_hint(experiments, model)
    least = min(x.count for x in excitations)
    return _Found(
        fit=fit, evidence=of_periods(fit), records=remembered, warnings=[*warnings, *([hint] if hint else [])],
        checks=_excited(benches, [[*a, *more[k]] for k, a in enumerate(lines)]),
        spectra=max(experiments, key=lambda e: abs(e.speed)).spectra, seen=[e.spectra for e in experiments],
        why=f"the excitation is periodic ({least} whole periods): maximum likelihood on period spectra",
    )  # fmt: skip


def _listed(lines: Sequence[Line]) -> str:
    return ", ".join(f"{x.frequency_hz:.4g} Hz in {x.channel}" for x in lines)


def _excited(benches: Sequence[Record], lines: Sequence[Sequence[Line]]) -> dict[str, Check]:
    """Judge lines on excited ones, if there are any: a mode between their neighbours looks alike."""
    on = [(b, [x for x in found if x.excited]) for b, found in zip(benches, lines, strict=True)]
    said = "; ".join(f"{_listed(found)} of {name_of(b)}" for b, found in on if found)
    if not said:
        return {}
    check = Check(
        passed=False, cause="line", alternatives=("mode",),
        detail=f"{said} stands at a single excited line: hum, or a bending mode that the model lacks. Look for hum "
        "with the excitation off; else let modes.count be auto, or one more, and excite with lines closer together",
    )  # fmt: skip
    return {"lines": check}


def _from_innovations(
    benches: Sequence[Record],
    speeds: Sequence[float],
    excitations: Sequence[Excitation | None],
    rig: Rig,
    say: Tick,
    clock: Clock,
) -> _Found:
    """Estimate from the innovations of a predictor."""
    from ambid.rotor.prediction import predict_rotor
    from ambid.validation.rotor import of_predictor

    model, odd = rig.rotor, name_of(next(b for b, x in zip(benches, excitations, strict=True) if x is None))
    assert model is not None
    why = f"{odd} is not periodic or has less than two whole periods"
    if len(benches) > 1:
        raise EstimationError(
            f"{why}; several records together need them. Excite with a multisine of whole periods, or give one record"
        )
    if any(role.endswith("_current") for role in model.inputs):
        raise EstimationError(
            f"{why}; without voltages the estimator needs them, as measured currents carry noise of their own. Excite "
            "with a multisine of whole periods, or log the voltages"
        )
    fit = predict_rotor(
        benches[0], model, rig.parameters, speed=speeds[0], delays=_delays(rig), modes=rig.modes, tick=say
    )
    clock.lap("fit")
    say("check")
    return _Found(
        fit=fit, evidence=of_predictor(fit), records=[{**origin(benches[0]), "speed": speeds[0]}],
        spectra=fit.spectra, seen=[None], why=f"{why}: maximum likelihood on the innovations of a predictor",
    )  # fmt: skip


def _delays(rig: Rig) -> list[float | None]:
    """Return the delay of each input in samples, None where it is to be estimated."""
    assert rig.rotor is not None
    delays = [rig.channel(role).delay for role in rig.rotor.inputs]
    return [None if d == "auto" else float(d) for d in delays]


def _synchronous(
    estimate: RotorEstimate,
    turning: Sequence[Separated],
    spectra: Sequence[PeriodSpectra | None],
    loop: ClosedLoop | None,
    rig: Rig,
) -> Mapping[str, Any]:
    """Return what the synchronous responses say of unbalance and runout; empty where the rotor stood still."""
    from ambid.rotor.balance import Machine, Turned, balance_rotor

    def controller(speed: float) -> Complex | None:
        return None if loop is None else loop.controller.response(np.array([abs(speed) / (2.0 * np.pi)]))[0][0]

    turned = [
        Turned(record=k, response=x.response, spectra=s, controller=controller(x.speed))
        for k, (x, s) in enumerate(zip(turning, spectra, strict=True))
        if x.response is not None
    ]
    if not turned:
        return {}
    read = {b.name: [b.sensor_parameter(k) for k in range(len(b.z_sensors))] for b in estimate.plant.bearings}
    runout = {place: r.value * np.exp(1j * r.phase) for r in rig.runout for place in read[r.name]}
    machine = Machine.of(estimate, balance_planes(estimate, rig))
    return balance_rotor(machine, turned, runout=runout, clearance=rig.clearance)


def balance_planes(estimate: RotorEstimate, rig: Rig) -> dict[str, tuple[float, ...]]:
    """Return a rig's planes of unbalance: z, and each mode's shape there, the rig's or its drawing's, turned to the
    side of the identified mode.
    """
    modes, numbers = range(1, estimate.n_modes + 1), rig.modes.numbers
    places = estimate.plant.places
    z = {p: estimate.numbers[p] for p in places}
    drawn = rig.shaft.free_rotor(estimate.n_modes, planes=list(z.values())) if rig.shaft and estimate.n_modes else None
    planes = {}
    for u in rig.unbalance:
        shapes = []
        for r in modes:
            own = np.array([estimate.numbers[f"mode{r}.{p}"] for p in places])
            if drawn is not None:
                shape = drawn.deflection(np.array([*z.values(), u.z]))[:, r + 1]
            elif f"mode{r}.unbalance.{u.name}" in numbers:
                shape = np.array([numbers[f"mode{r}.{p}"] for p in (*places, f"unbalance.{u.name}")])
            else:
                return {}
            shapes.append(float(shape[-1] * np.sign(own @ shape[:-1])))
        planes[u.name] = (u.z, *shapes)
    return planes


def replays_of(estimate: RotorEstimate, benches: Sequence[Record]) -> tuple[RotorReplay, ...]:
    """Return an estimate on those of its own or other records whose excitation is periodic, channels named by role."""
    from ambid.rotor.likelihood import Experiment
    from ambid.rotor.replay import replays
    from ambid.rotor.spectra import period_spectra
    from ambid.rotor.synchronous import separate

    found, own = [], benches is estimate.used
    for k, bench in enumerate(benches):
        separated = separate(bench, estimate.plant, float(str(estimate.records[k]["speed"])) if own else None)
        if separated.excitation is not None:
            spectra = period_spectra(separated.record, estimate.plant, separated.excitation, separated.speed)
            found.append(Experiment(spectra=spectra, speed=separated.speed))
    return replays(estimate, found)


def validated(estimate: RotorEstimate, benches: Sequence[Record]) -> dict[str, Any]:
    """Return ``fit``, ``checks`` and ``samples`` of an estimate on further records; EstimationError without periods."""
    from ambid.rotor.replay import validation

    runs = replays_of(estimate, benches)
    if not runs:
        raise EstimationError(
            f"{name_of(benches[0])} is not periodic or has less than two whole periods; validating a rotor needs "
            "them. Excite with a multisine of whole periods"
        )
    fit, checks = validation(runs)
    return {"fit": fit, "checks": checks, "samples": sum(b.n_samples for b in benches)}


def name_of(bench: Record) -> str:
    """Return the name of a record's file."""
    return str(bench.provenance.get("file") or "record")


def _check(bench: Record, rig: Rig) -> None:
    """Refuse what no number can come from."""
    if bench.n_samples < LEAST:
        raise EstimationError(
            f"{name_of(bench)} has {bench.n_samples} samples; a rotor needs {LEAST}. Give a longer record"
        )
    for role in (*rig.plant.inputs, *rig.plant.outputs):
        if not np.ptp(bench[role].values) > 0.0:
            raise EstimationError(
                f"{name_of(bench)}: channel {role!r} is constant in the whole record. Check its column and unit"
            )


def _check_speeds(readings: Sequence[RotorRecord], speeds: Sequence[float]) -> None:
    """Refuse a speed that no record of its rate shows."""
    for one, speed in zip(readings, speeds, strict=True):
        if abs(speed) >= np.pi * one.bench.rate_hz:
            raise EstimationError(
                f"{one.name}: a speed of {speed * 30.0 / np.pi:.4g} rpm is more than half of its sampling rate, "
                f"{one.bench.rate_hz:g} Hz; it would not show. Correct {setting('speed_rpm')}, or [speed] and its "
                "unit in the rig"
            )


def _plausible(estimate: RotorEstimate, rig: Rig, bench: Record) -> Mapping[str, Check]:
    """Judge signs and sizes of an estimate."""
    from ambid.validation.rotor import plausible_checks

    sd = dict(zip(estimate.covariance_names, np.sqrt(np.diag(estimate.covariance)).tolist(), strict=True))
    return plausible_checks(estimate.plant, estimate.numbers, sd, rig.parameters, bench)


def _record_checks(benches: Sequence[Record], clean: Sequence[Record], rig: Rig) -> dict[str, Check]:
    """Judge the records themselves: lost samples of those without synchronous parts, saturation of the voltages."""
    from ambid.rotor.spectra import find_slip

    slips = [(name_of(b), slip) for b in clean if (slip := find_slip(b, rig.plant)) is not None]
    said = "; ".join(
        f"{name} {'lacks' if slip.samples > 0 else 'holds twice'} {counted(abs(slip.samples), 'sample')}, but for "
        f"whole periods of {slip.period}, at about {slip.at_s:.3g} s"
        for name, slip in slips
    )
    complete = Check(
        passed=not slips, cause="lost_samples" if slips else "", size=float(slips[0][1].samples) if slips else None,
        detail=f"{said}: the phase of the excitation jumps. Log without gaps, or use a part before or after" if slips
        else "no phase of the excitation jumps",
    )  # fmt: skip
    return {"samples_complete": complete, **_saturation(benches, rig)}


def _saturation(benches: Sequence[Record], rig: Rig) -> dict[str, Check]:
    if rig.limits is None:
        return {}
    low, high = rig.limits.voltage
    for bench in benches:
        for role in rig.plant.inputs:
            if not role.endswith("_voltage"):
                continue
            at = float(np.mean((bench[role].values <= low) | (bench[role].values >= high)))
            if at > 0.0:
                return {
                    "saturation": Check(
                        passed=False, values={"share": at},
                        detail=f"{role} of {name_of(bench)} is at its limit in {at:.2%} of the samples. Excite less",
                    )
                }  # fmt: skip
    return {"saturation": Check(passed=True, detail="no voltage reaches its limit")}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RotorRecord:
    """A record of a rotor."""

    bench: Record  # channels named by role
    speed: float | None  # rad/s; None: its own channels or the rig say it
    warnings: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The name of its file."""
        return name_of(self.bench)


def read_records(
    records: Sequence[Source],
    rig: Rig,
    speed_rpm: float | Sequence[float] | None,
    say: Tick,
    **reading: Unpack[Reading],
) -> list[RotorRecord]:
    """Read the records of one rotor; `speed_rpm`: of each, or a single one; None: each says its own, and one without
    the channel that another has was taken at rest. One of several experiments becomes several.
    """
    from ambid.rotor.spectra import experiments_of

    speeds = _speeds(speed_rpm, len(records))
    readings = []
    for source, speed in zip(records, speeds, strict=True):
        say("read")
        readings.append(RotorRecord(bench=_read(source, rig, speed, len(records), reading), speed=speed))
    _check_together(readings)
    assert rig.rotor is not None
    readings = [replace(r, bench=part) for r in readings for part in experiments_of(r.bench, rig.rotor)]
    turning = [r for r in readings if any(role in r.bench for role in _TURNING)]
    if not turning or len(turning) == len(readings) or speed_rpm is not None:
        return readings
    warning = (
        "has no column of the angle or speed that other records have: it is taken to be at rest. Else give "
        f"{setting('speed_rpm')}"
    )
    return [r if r in turning else replace(r, speed=0.0, warnings=(f"{r.name} {warning}",)) for r in readings]


def _speeds(speed_rpm: float | Sequence[float] | None, n: int) -> list[float | None]:
    if speed_rpm is None:
        return [None] * n
    speeds = [speed_rpm] if isinstance(speed_rpm, (int, float)) else list(speed_rpm)
    if len(speeds) != n:
        raise EstimationError(
            f"{counted(n, 'record')} and {counted(len(speeds), 'speed')} are given. Give {setting('speed_rpm')} once "
            "for each record, "
            "in their order"
        )
    wrong = next((x for x in speeds if not isfinite(x)), None)
    if wrong is not None:
        raise EstimationError(f"{setting('speed_rpm')} is {wrong}; it must be a speed in rpm. Give a number")
    return [x * 2.0 * pi / 60.0 for x in speeds]


def _read(source: Source, rig: Rig, speed: float | None, n: int, reading: Reading) -> Record:
    """Read a record; where its speed is known otherwise, or other records may show it, it need not have its column."""
    try:
        return load_bench(source, rig, **reading)
    except RecordError:
        still = tuple(c for c in rig.channels if c.role not in _TURNING)
        if len(still) == len(rig.channels) or (speed is None and n == 1):
            raise
        try:
            return load_bench(source, replace(rig, channels=still), **reading)
        except RecordError as error:
            raise error from None


def _check_together(readings: Sequence[RotorRecord]) -> None:
    """Refuse what cannot be one machine at one rate, or would count twice."""
    first = readings[0]
    for k, one in enumerate(readings):
        rate, other = one.bench.rate_hz, first.bench.rate_hz
        if abs(rate / other - 1.0) > _SAME_RATE:
            raise EstimationError(
                f"{one.name} is sampled at {rate:g} Hz, {first.name} at {other:g} Hz; delays count in samples of one "
                "rate. Identify them apart"
            )
        twice = next((r for r in readings[:k] if _same(r.bench, one.bench)), None)
        if twice is not None:
            raise EstimationError(f"{twice.name} and {one.name} hold the same samples and would count twice. Omit one")


def _same(a: Record, b: Record) -> bool:
    """Whether two records share samples: of one file, or one column of noise that repeats."""
    return overlap(stretch_of(a), stretch_of(b)) or np.array_equal(a.channels[0].values, b.channels[0].values)
