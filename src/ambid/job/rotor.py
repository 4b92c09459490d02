"""The job of a rotor on many axes: records and a rig in, one estimate of the machine out.

Read -> periods, or none -> estimate -> judge. Records at several speeds, or with one bearing excited at a time, give
one machine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from ambid.errors import EstimationError
from ambid.estimation.estimate import Check
from ambid.estimation.linear import one_thread
from ambid.estimation.progress import Tick, silent
from ambid.job.data import Clock, Reading, Source, origin, rig_entry
from ambid.job.rotor_records import read_records
from ambid.record import Record
from ambid.rig import Rig
from ambid.rotor.estimate import RotorEstimate

if TYPE_CHECKING:
    from ambid.physics.rotor_model import RotorModel
    from ambid.rotor.conclusion import Evidence
    from ambid.rotor.estimator import Ending
    from ambid.rotor.replay import RotorReplay
    from ambid.rotor.spectra import Excitation, PeriodSpectra

_LEAST = 200  # samples
_AT_REST = 0.25 * 2.0 * np.pi  # rad that a rotor at rest may creep in a record


def identify_rotor(
    records: Sequence[Source],
    rig: Rig,
    *,
    speed_rpm: float | Sequence[float] | None = None,
    tick: Tick | None = None,
    **reading: Unpack[Reading],
) -> RotorEstimate:
    """Identify a rotor from one or several records.

    Records of two or more whole periods go to the estimator on period spectra, another one to the predictor. `rig`:
    with bearings; `speed_rpm`: of each record; `reading`: how files are read. EstimationError where nothing can be
    identified.
    """
    from ambid.rotor.conclusion import conclude
    from ambid.rotor.spectra import find_excitation

    say, clock, model = tick or silent, Clock(), rig.rotor
    assert model is not None
    taken = read_records(records, rig, speed_rpm, say, **reading)
    benches = [r.bench for r in taken]
    for bench in benches:
        _check(bench, rig)
    speeds = [speed_of(r.bench, model) if r.speed is None else r.speed for r in taken]
    clock.lap("read")
    say("periods")
    excitations = [find_excitation(bench, model) for bench in benches]
    clock.lap("periods")
    with one_thread():
        periodic = [x for x in excitations if x is not None]
        if len(periodic) == len(benches):
            found = _from_periods(benches, speeds, periodic, rig, say, clock)
        else:
            found = _from_innovations(benches, speeds, excitations, rig, say, clock)
        estimate = conclude(
            found.fit, found.evidence, rig.parameters, found.records,
            delay_how=["given" if d is not None else "estimated" for d in _delays(rig)],
            more_checks={**_record_checks(benches, rig), "method": Check(passed=True, detail=found.why)},
            rig=rig_entry(rig), warnings=[*(said for r in taken for said in r.warnings), *found.warnings],
        )  # fmt: skip
        sensitivity = _sensitivity(estimate, rig, found.spectra)
    clock.lap("checks")
    return replace(estimate, sensitivity=sensitivity, timing_s=clock.laps, used=tuple(benches))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Found:
    """What either estimator leaves to be concluded from; `why` it was chosen."""

    fit: Ending
    evidence: Evidence
    records: Sequence[Mapping[str, object]]
    spectra: PeriodSpectra  # of the record at the highest speed, which is that of the estimate's plant
    why: str
    warnings: Sequence[str] = ()


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
    from ambid.rotor.spectra import period_spectra

    model = rig.rotor
    assert model is not None
    experiments, remembered, warnings = [], [], list[str]()
    for bench, speed, excitation in zip(benches, speeds, excitations, strict=True):
        spectra = period_spectra(bench, model, excitation, speed)
        experiments.append(Experiment(spectra=spectra, speed=speed))
        remembered.append(
            {**origin(bench), "speed": speed, "periods": spectra.n_periods, "period_s": spectra.period / bench.rate_hz}
        )
        if spectra.dropped:
            lost = spectra.dropped / bench.rate_hz
            warnings.append(f"{name_of(bench)}: the first {lost:.4g} s were left out: a transient, or part of a period")
    clock.lap("periods")
    fit = estimate_rotor(experiments, model, rig.parameters, delays=_delays(rig), n_modes=rig.modes.count, tick=say)
    clock.lap("fit")
    say("check")
    hint = experiments_hint(experiments, model)
    least = min(x.count for x in excitations)
    return _Found(
        fit=fit, evidence=of_periods(fit), records=remembered, warnings=[*warnings, *([hint] if hint else [])],
        spectra=max(experiments, key=lambda e: abs(e.speed)).spectra,
        why=f"the excitation is periodic ({least} whole periods): maximum likelihood on period spectra",
    )  # fmt: skip


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
        benches[0], model, rig.parameters, speed=speeds[0], delays=_delays(rig), n_modes=rig.modes.count, tick=say
    )
    clock.lap("fit")
    say("check")
    return _Found(
        fit=fit, evidence=of_predictor(fit), records=[{**origin(benches[0]), "speed": speeds[0]}],
        spectra=fit.spectra, why=f"{why}: maximum likelihood on the innovations of a predictor",
    )  # fmt: skip


def _delays(rig: Rig) -> list[float | None]:
    """Return the delay of each input in samples, None where it is to be estimated."""
    assert rig.rotor is not None
    given = [rig.channel(role).delay for role in rig.rotor.inputs]
    return [None if d == "auto" else float(d) for d in given]


def _sensitivity(estimate: RotorEstimate, rig: Rig, spectra: PeriodSpectra) -> Mapping[str, Any]:
    """Return the peaks of the sensitivity by axis: the controller is that of the record, or of the rig's [loop]."""
    from ambid.control.margins import sensitivity_by_axis
    from ambid.control.measured import measured_sensitivity
    from ambid.job.margins import closed_loop

    try:
        loop = closed_loop(estimate, rig, spectra)
    except EstimationError:
        return {}
    return sensitivity_by_axis(loop, measured_sensitivity(spectra, loop.at(spectra.frequency_hz)))


def replays_of(estimate: RotorEstimate, benches: Sequence[Record]) -> tuple[RotorReplay, ...]:
    """Return an estimate on those of its own or other records whose excitation is periodic, channels named by role."""
    from ambid.rotor.likelihood import Experiment
    from ambid.rotor.replay import replays
    from ambid.rotor.spectra import find_excitation, period_spectra

    found, own = [], benches is estimate.used
    for k, bench in enumerate(benches):
        speed = float(str(estimate.records[k]["speed"])) if own else speed_of(bench, estimate.plant)
        excitation = find_excitation(bench, estimate.plant)
        if excitation is not None:
            spectra = period_spectra(bench, estimate.plant, excitation, speed)
            found.append(Experiment(spectra=spectra, speed=speed))
    return replays(estimate, found)


def name_of(bench: Record) -> str:
    """Return the name of a record's file."""
    return str(bench.provenance.get("file") or "record")


def speed_of(bench: Record, model: RotorModel) -> float:
    """Return the speed of a record in rad/s: of its angle or speed channel, else that of the model."""
    if "angle" in bench:
        turned = np.unwrap(bench["angle"].values)
        seconds, angle = (bench.n_samples - 1) / bench.rate_hz, float(turned[-1] - turned[0])
        return angle / seconds if abs(angle) > _AT_REST else 0.0
    if "speed" in bench:
        return float(np.mean(bench["speed"].values))
    return model.speed


def _check(bench: Record, rig: Rig) -> None:
    """Refuse what no number can come from."""
    if bench.n_samples < _LEAST:
        raise EstimationError(
            f"{name_of(bench)} has {bench.n_samples} samples; a rotor needs {_LEAST}. Give a longer record"
        )
    for role in (*rig.plant.inputs, *rig.plant.outputs):
        if not np.ptp(bench[role].values) > 0.0:
            raise EstimationError(
                f"{name_of(bench)}: channel {role!r} is constant in the whole record. Check its column and unit"
            )


def _record_checks(benches: Sequence[Record], rig: Rig) -> dict[str, Check]:
    """Judge the records themselves: saturation of the voltages."""
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
