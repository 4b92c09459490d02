"""The job of a rotor on many axes: records and a rig in, one estimate of the machine out.

Read -> periods -> estimate -> judge. Records at several speeds, or with one bearing excited at a time, give one
machine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
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
    from ambid.rotor.likelihood import Experiment
    from ambid.rotor.replay import RotorReplay
    from ambid.rotor.spectra import PeriodSpectra

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

    `rig`: with bearings; `speed_rpm`: of each record; `reading`: how files are read. EstimationError where nothing can
    be identified.
    """
    from ambid.rotor.conclusion import conclude, experiments_hint
    from ambid.rotor.estimator import estimate_rotor
    from ambid.rotor.likelihood import Experiment
    from ambid.rotor.spectra import find_excitation, period_spectra

    say, clock, model = tick or silent, Clock(), rig.rotor
    assert model is not None
    taken = read_records(records, rig, speed_rpm, say, **reading)
    benches = [r.bench for r in taken]
    for bench in benches:
        _check(bench, rig)
    clock.lap("read")
    experiments, remembered, warnings = [], [], [said for r in taken for said in r.warnings]
    for r in taken:
        say("periods")
        bench, speed = r.bench, speed_of(r.bench, model) if r.speed is None else r.speed
        excitation = find_excitation(bench, model)
        if excitation is None:
            raise EstimationError(
                f"{name_of(bench)} is not periodic or has less than two whole periods; the estimator of rotors needs "
                "them. Excite with a multisine of whole periods"
            )
        spectra = period_spectra(bench, model, excitation, speed)
        experiments.append(Experiment(spectra=spectra, speed=speed))
        remembered.append(
            {**origin(bench), "speed": speed, "periods": spectra.n_periods, "period_s": spectra.period / bench.rate_hz}
        )
        if spectra.dropped:
            lost = spectra.dropped / bench.rate_hz
            warnings.append(f"{name_of(bench)}: the first {lost:.4g} s were left out: a transient, or part of a period")
    clock.lap("periods")
    given = [rig.channel(role).delay for role in model.inputs]
    with one_thread():
        fit = estimate_rotor(
            experiments, model, rig.parameters, delays=[None if d == "auto" else float(d) for d in given],
            n_modes=rig.modes.count, tick=say,
        )  # fmt: skip
        clock.lap("fit")
        say("check")
        hint = experiments_hint(experiments, model)
        estimate = conclude(
            fit, rig.parameters, remembered, delay_how=["estimated" if d == "auto" else "given" for d in given],
            more_checks=_record_checks(benches, rig), rig=rig_entry(rig),
            warnings=[*warnings, *([hint] if hint else [])],
        )  # fmt: skip
        sensitivity = _sensitivity(estimate, rig, fastest(experiments).spectra)
    clock.lap("checks")
    return replace(estimate, sensitivity=sensitivity, timing_s=clock.laps, used=tuple(benches))


def fastest(experiments: Sequence[Experiment]) -> Experiment:
    """Return the experiment at the highest speed, which is that of the estimate's plant."""
    return max(experiments, key=lambda e: abs(e.speed))


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
