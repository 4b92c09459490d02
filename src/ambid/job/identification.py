"""The main jobs: one record and one rig in, one checked estimate out; or several, for one nonlinear bearing.

Read -> cut -> identify -> validate. Each arrow is one call below; what a step does stands in its own room.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Unpack

from ambid.errors import EstimationError
from ambid.estimation.progress import Tick, silent
from ambid.job.data import Clock, Reading, known_rig, load, origin, remembered, signals_of
from ambid.physics.models import model
from ambid.record import Record
from ambid.rig import Rig

if TYPE_CHECKING:
    from ambid.bearing.magnet.result import NonlinearBearingEstimate
    from ambid.bearing.uncertainty import Uncertainty
    from ambid.estimation.estimate import Estimate
    from ambid.estimation.likelihood import Fit
    from ambid.estimation.parts import Check
    from ambid.job.bearing_records import MagnetWords, TakenRecord
    from ambid.report.figures import BearingEvidence, Evidence


def identify(
    record: Record | str | Path,
    rig: Rig | str | Path | None = None,
    *,
    validate: Record | str | Path | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: str | None = None,
    tick: Tick | None = None,
) -> Estimate:
    """Identify the physical parameters of a bench from one record, and check the result.

    Parameters
    ----------
    record : Record, str or Path
        A file in the rig's columns, or a record whose channels are named by role.
    rig : Rig, str or Path, optional
        What is known of the bench; default: columns voltage, current and position, everything free.
    validate : Record, str or Path, optional
        A second record of the same bench to judge the estimate on.
    from_s, to_s : float, optional
        Part of the record (and of the second) to use, in s; overrides the rig's.
    rate_hz : float, optional
        Sampling rate for a file without a time column.
    gaps : {"error", "interpolate", "cut"}, optional
        What to do about gaps in a file.
    tick : callable, optional
        Called with the name of the present stage now and then (progress); may raise to interrupt.

    Returns
    -------
    Estimate
        With `checks` made and `warnings` set; see ``passed``.

    Raises
    ------
    AmbidError
        If record or rig break a rule.
    EstimationError
        If nothing can be identified from the record.
    """
    from ambid.bearing.linear import greybox
    from ambid.bearing.uncertainty import uncertainty
    from ambid.estimation.linear import one_thread

    say, clock, rig = tick or silent, Clock(), known_rig(rig)
    bench = load(record, rig, from_s=from_s, to_s=to_s, rate_hz=rate_hz, gaps=gaps)
    plant = model(rig.model)
    clock.lap("read")
    say("identify")
    signals = signals_of(bench, plant)
    wanted = {role: rig.channel(role).delay for role in plant.inputs}
    delay = wanted[plant.inputs[0]]
    fit = greybox(plant, signals, rig.parameters, delay=delay, tick=lambda: say("identify"))
    if fit.status == "failed":
        raise EstimationError("the search found no predictor for this record. Check columns, signs and fixed values")
    clock.lap("fit")
    clock.split("fit", "initial", fit.start_s)
    if fit.global_search is not None:
        clock.split("fit", "global_search", float(str(fit.global_search["seconds"])))
    say("check")
    with one_thread():
        estimate = judged(fit, uncertainty(fit), rig, bench, delay_how="estimated" if delay == "auto" else "given")
    clock.lap("checks")
    if validate is not None:
        from ambid.validate.second_record import validation

        say("validate")
        other = load(validate, rig, from_s=from_s, to_s=to_s, rate_hz=rate_hz, gaps=gaps)
        estimate = replace(estimate, validation=validation(estimate, signals_of(other, plant)))
        clock.lap("validate")
    return replace(estimate, timing_s=clock.laps)


def judged(
    fit: Fit, known: Uncertainty, rig: Rig, bench: Record, *, delay_how: Literal["estimated", "given"]
) -> Estimate:
    """Check a fit on its own record and put the estimate together.

    Parameters
    ----------
    fit : Fit
        Not failed.
    known : Uncertainty
        Of that fit.
    rig : Rig
    bench : Record
        The record it came from, channels named by role.
    delay_how : {"estimated", "given"}

    Returns
    -------
    Estimate
        Without timings.

    Raises
    ------
    EstimationError
        If the fit has no predictor.
    """
    import numpy as np

    from ambid.bearing.result import estimate_of
    from ambid.estimation.sensitivity import innovations
    from ambid.validate.physical import (
        agreement,
        assumption_checks,
        innovation_checks,
        physical_checks,
        simulation_error,
    )
    from ambid.validate.residuals import fit_of

    problem = fit.problem
    e = innovations(problem, fit.vector)
    if e is None:
        raise EstimationError("the search found no predictor for this record. Check columns, signs and fixed values")
    moved = agreement(fit)
    checks = innovation_checks(fit, e, known, moved)
    robust = fit.status != "converged" or not all(c.passed for c in checks.values())
    known = replace(known, disagreement=moved.disagreement() if robust else np.zeros(len(known.names)))
    checks |= assumption_checks(fit, known, delay_how)
    checks |= physical_checks(fit, known, bench, robust=robust)
    y, error = problem.y[problem.skip :], simulation_error(fit)
    estimate = estimate_of(
        fit,
        known,
        rig.parameters,
        robust=robust,
        delay_how=delay_how,
        means={role: float(bench[role].mean()) for role in (*problem.model.inputs, *problem.model.outputs)},
        one_step=fit_of(e * problem.scales.output, y),
        simulation=None if error is None else fit_of(error, y),
        checks=checks,
        warnings=_warnings(fit, checks, robust=robust),
        record=origin(bench),
        rig=remembered(rig),
    )
    return replace(estimate, global_search=fit.global_search)


def _warnings(fit: Fit, checks: Mapping[str, Check], *, robust: bool) -> tuple[str, ...]:
    """What a reader has to know before using the numbers, most important first."""
    from ambid.bearing.rescue import describe_search

    found = [] if fit.status == "converged" else ["the search did not converge: treat the numbers as a first guess"]
    if fit.global_search is not None:
        found.append(describe_search(fit.global_search))
    found += [c.detail for c in checks.values() if not c.passed]
    if robust:
        found.append(
            "the model explains the record only in part: standard deviations are robust ones (scatter over the record "
            "and disagreement of refits included), and still cannot cover a bias that is the same everywhere"
        )
    return tuple(found)


def identify_nonlinear(
    records: Sequence[Record | str | Path],
    rig: Rig | str | Path | None = None,
    *,
    held: Sequence[Record | str | Path] = (),
    validate: Record | str | Path | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: str | None = None,
    tick: Tick | None = None,
    **magnet: Unpack[MagnetWords],
) -> NonlinearBearingEstimate:
    """Identify one nonlinear bearing from several records at several operating points at once.

    Prediction error with an extended Kalman predictor, consistent under feedback as far as its linearised noise is.

    Parameters
    ----------
    records : sequence of Record, str or Path
        In which the rotor moves.
    rig : Rig, str or Path, optional
        What is known of the bench, of the magnet in ``[magnet]``.
    held : sequence of Record, str or Path, optional
        With the rotor held at rest at different distances: they show the coil.
    validate : Record, str or Path, optional
        A further record, of a rotor that moves, to judge the estimate on.
    from_s, to_s, rate_hz, gaps, tick : optional
        As `identify`; the part is of every record in which the rotor moves.
    **magnet
        ``magnet``, ``parameters``, ``eddy``, ``drift`` and ``off_below``: what is known beside the rig, see
        `ambid.job.bearing_records.MagnetWords`.

    Returns
    -------
    NonlinearBearingEstimate

    Raises
    ------
    AmbidError
        If a record or the rig breaks a rule.
    EstimationError
        If nothing can be identified from the records.
    """
    how = Reading(from_s=from_s, to_s=to_s, rate_hz=rate_hz, gaps=gaps)
    return identify_taken(
        read_records(records, rig, held=held, validate=validate, how=how, tick=tick, **magnet), tick=tick
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BearingJob:
    """What was read for one identification."""

    rig: Rig  # with a `magnet` that says all that is known and wished
    taken: tuple[TakenRecord, ...]  # those in which the rotor moves, then those in which it is held
    second: TakenRecord | None  # to judge on
    clock: Clock


def read_records(
    records: Sequence[Record | str | Path],
    rig: Rig | str | Path | None,
    *,
    held: Sequence[Record | str | Path],
    validate: Record | str | Path | None,
    how: Reading,
    tick: Tick | None = None,
    **magnet: Unpack[MagnetWords],
) -> BearingJob:
    """Read all records of one identification; arguments as those of `identify_nonlinear`."""
    from ambid.job.bearing_records import bearing_rig, check_together, take_record

    say, clock = tick or silent, Clock()
    bench = bearing_rig(rig, **magnet)
    if not records:
        raise EstimationError("no record, or every one holds the rotor; forces want one in which it moves. Give one")
    taken: list[TakenRecord] = []
    for source, is_held in [*((r, False) for r in records), *((r, True) for r in held)]:
        say("read")
        taken.append(take_record(source, bench, how, held=is_held))
    second = None if validate is None else take_record(validate, bench, how)
    rates = {t.record.rate_hz for t in taken if not t.record.held}
    if second is not None and second.record.rate_hz not in rates:  # the predictor could not judge it: say so now
        known = ", ".join(f"{rate:g} Hz" for rate in sorted(rates))
        raise EstimationError(
            f"{second.record.name}, to judge on, is sampled at {second.record.rate_hz:g} Hz, the records at {known}; "
            "they have to agree. Resample it, or leave --validate out"
        )
    checked = check_together(taken, second)
    clock.lap("read")
    return BearingJob(rig=bench, taken=checked, second=second, clock=clock)


def identify_taken(job: BearingJob, *, tick: Tick | None = None) -> NonlinearBearingEstimate:
    """Identify from records that were read.

    `tick`: as `identify_nonlinear`.
    """
    from ambid.bearing.magnet.estimate import estimate_bearing
    from ambid.bearing.magnet.likelihood import uncertainty
    from ambid.job.bearing_estimate import judged as judged_bearing
    from ambid.job.bearing_records import laws_of, numbers_of
    from ambid.validate.nonlinear_bearing import validation

    say, bench, clock = tick or silent, job.rig, job.clock
    assert bench.magnet is not None
    laws, extend = laws_of(bench.magnet, [t.record for t in job.taken if not t.record.held])
    wanted = bench.channel("voltage").delay
    fit = estimate_bearing(
        [t.record for t in job.taken], numbers_of(bench), laws=laws,
        delay=None if wanted == "auto" else float(wanted), extend=extend, eddy=bench.magnet.eddy,
        drift=bench.magnet.drift, tick=say,
    )  # fmt: skip
    if fit.status == "failed":
        raise EstimationError(
            "the search led to numbers without a predictor for these records; no law explains them. Check columns, "
            "signs and units"
        )
    clock.lap("fit")
    say("check")
    estimate = judged_bearing(fit, uncertainty(fit), job.taken, delay_given=wanted != "auto")
    clock.lap("checks")
    estimate = replace(estimate, timing_s=clock.laps, rig=remembered(bench))
    if job.second is None:
        return estimate
    return replace(estimate, validation=validation(estimate, job.second.record))


def evidence_of(estimate: Estimate, used: Record) -> Evidence:
    """Return what figures and report show beside an estimate: the record `used`, cut, run through it again."""
    from ambid.report.figures import Evidence
    from ambid.validate.second_record import replay

    run = replay(estimate, signals_of(used, model(estimate.model)))
    return Evidence(estimate=estimate, run=run, start_s=used.start_s)


def report_of(evidence: Evidence | BearingEvidence) -> str:
    """Return the report of an estimate with the present date."""
    from datetime import UTC, datetime

    from ambid.report.page import report_html

    return report_html(evidence, made=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"))
