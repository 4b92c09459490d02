"""The main jobs: one record and one rig in, one checked estimate out; or several, for one nonlinear bearing.

Read -> cut -> identify -> validate. Each arrow is one call below; what a step does stands in its own room.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Unpack

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.estimate import Estimate, disowned, plain_json, warnings_of
from ambid.estimation.linear import one_thread
from ambid.estimation.progress import Tick, silent
from ambid.estimation.uncertainty import chi_squared_tail
from ambid.job.data import (
    Clock,
    Reading,
    RigSource,
    Source,
    known_rig,
    load_bench,
    origin,
    overlap,
    rig_entry,
    signals_of,
    sources_of,
    stretch_of,
)
from ambid.record import GapPolicy, Record
from ambid.rig import Rig
from ambid.settings.caller import saved, setting
from ambid.settings.calls import of_job

if TYPE_CHECKING:
    from ambid.bearing.magnet_result import NonlinearBearingEstimate
    from ambid.bearing.multistart import Signals
    from ambid.bearing.uncertainty import Uncertainty
    from ambid.control.experiment import Experiment
    from ambid.estimation.estimate import Check
    from ambid.estimation.likelihood import Fit, Freed
    from ambid.rotor.estimate import RotorEstimate
    from ambid.validation.causes import Cause

_CAUSES = 6  # by which a model is extended, one after another


@of_job("identify")
def identify(
    record: Source | Sequence[Source],
    rig: RigSource | None = None,
    *,
    validate: Source | None = None,
    speed_rpm: float | Sequence[float] | None = None,
    experiment: Experiment | str | Path | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: GapPolicy | None = None,
    units: Mapping[str, str] | None = None,
    layout: Mapping[str, str] | None = None,
    tick: Tick | None = None,
) -> Estimate | RotorEstimate:
    """Identify the physical parameters of a bench from one record, and check the result.

    Of a rotor on many axes (a rig with ``[bearings.X]``) several records give one machine.

    Parameters
    ----------
    record : file, Record, DataFrame, Dataset or dict of arrays; of a rotor also a sequence of these
        In the rig's columns. A table is one of pandas or polars, with columns ``name [unit]`` (or `units`) and time as
        index, as a column ``time [s]`` or told by `rate_hz`; a Dataset one of xarray.
    rig : Rig, path, dict or TOML text, optional
        What is known of the bench; default: columns voltage, current and position, everything free.
    validate : as `record`, optional
        A second record of the same bench to validate the estimate on.
    speed_rpm : float or sequence of float, optional
        Speed of a rotor in each record, rpm; default: as its channel of angle or speed, or the rig, says.
    experiment : Experiment, str or Path, optional
        Of one axis: the designed excitation that was played, or its file; the check ``experiment`` compares the
        standard deviations with those that it promised.
    from_s, to_s : float, optional
        Part of a record in which the rotor moves, in s; overrides the rig's.
    rate_hz : float, optional
        Sampling rate of a record without time, Hz.
    gaps : {"error", "interpolate", "cut"}, optional
        What to do about missing values; default: as the rig says, else refuse them.
    units : Mapping of str to str, optional
        Unit by column, for tables in memory.
    layout : Mapping of str to str, optional
        What the files leave open, as `ambid.read_record`, beside the rig's ``record.layout``.
    tick : callable, optional
        Called with the name of the present stage now and then (progress); may raise to interrupt.

    Returns
    -------
    Estimate or RotorEstimate
        With `checks` made and `warnings` set; see ``passed``.

    Raises
    ------
    AmbidError
        If record or rig break a rule.
    EstimationError
        If nothing can be identified from the record.

    Examples
    --------
    >>> import ambid
    >>> record = ambid.simulate("thesis", duration=0.5, seed=1)
    >>> estimate = ambid.identify(record)
    >>> round(estimate["m"].value, 3), estimate["m"].unit, estimate.verdict.word
    (0.1, 'kg', 'usable')

    A table takes the place of the record: ``ambid.identify(record.to_dataframe(), "bench.toml")``.
    """
    bench, sources = known_rig(rig), sources_of(record)
    planned = None if experiment is None else _planned(experiment)
    reading = Reading(from_s=from_s, to_s=to_s, rate_hz=rate_hz, gaps=gaps, units=units, layout=layout)
    if bench.rotor is not None:
        from ambid.job.rotor import identify_rotor, validated

        rotor = identify_rotor(sources, bench, speed_rpm=speed_rpm, tick=tick, **reading)
        rotor = replace(rotor, checks={**rotor.checks, **_reached(planned, rotor)})
        if validate is None:
            return rotor
        second = validated(rotor, (load_bench(validate, bench, **reading),))
        return replace(rotor, validation={**second, "checks": plain_json(second["checks"])})
    if speed_rpm is not None:
        raise EstimationError(f"{setting('speed_rpm')} is of a rotor's records; the rig has no [bearings.X]. Omit it")
    if len(sources) != 1:
        raise EstimationError(
            f"{len(sources)} records are given; the linear model takes one, since k_x, k_i and L differ from one "
            f"operating point to the next. Give {setting('identify_nonlinear')} for one model of all, or one record"
        )
    estimate = identify_axis(sources[0], bench, validate=validate, tick=tick, **reading)
    return replace(estimate, checks={**estimate.checks, **_reached(planned, estimate)})


def demo(*, tick: Tick | None = None) -> Estimate:
    """Identify the embedded record: 0.4 s of an unstable bearing in closed loop, simulated with noise.

    Parameters
    ----------
    tick : callable, optional
        As `identify`.

    Returns
    -------
    Estimate
        Its record is ``used``; ``ambid.preset("unstable-bearing").parameters`` are the true ones.

    Raises
    ------
    AmbidError
        If the embedded files were changed.

    Examples
    --------
    >>> import ambid
    >>> ambid.demo().verdict.word
    'usable'
    """
    data = files("ambid").joinpath("data")
    with as_file(data / "demo.csv.gz") as record, as_file(data / "demo.toml") as rig:
        return identify_axis(record, known_rig(rig), tick=tick)


def _planned(experiment: Experiment | str | Path) -> Experiment:
    """Return the experiment that is meant."""
    from ambid.job.results import experiment_of

    plan = experiment_of(experiment)
    if plan is None:
        raise EstimationError(
            f"{setting('experiment', experiment)} is no experiment. Give {saved('design_experiment')}"
        )
    return plan


def _reached(planned: Experiment | None, estimate: Estimate | RotorEstimate) -> dict[str, Check]:
    """Return the check of what the experiment promised, where one is given."""
    if planned is None:
        return {}
    from ambid.control.experiment import reached

    return {"experiment": reached(planned, estimate)}


def identify_axis(
    record: Source,
    rig: Rig,
    *,
    validate: Source | None = None,
    tick: Tick | None = None,
    **reading: Unpack[Reading],
) -> Estimate:
    """Identify one axis, as `identify` does."""
    from ambid.bearing.linear import greybox

    say: Tick = tick or (lambda *_: None)
    clock = Clock()
    bench, plant = load_bench(record, rig, **reading), rig.plant
    second = None if validate is None else load_bench(validate, rig, **reading)
    if second is not None and overlap(stretch_of(bench), stretch_of(second)):
        raise EstimationError(
            "the record for validation holds samples that the estimate is fitted to. Give another record, or omit "
            f"{setting('validate')}"
        )
    clock.lap("read")
    say("identify")
    delay = rig.channel(plant.inputs[0]).delay
    try:
        fit = greybox(plant, signals_of(bench, plant), rig.parameters, delay=delay, tick=lambda: say("identify"))
    except EstimationError as refusal:
        raise EstimationError(_with_facts(str(refusal), bench, rig)) from None
    if fit.status == "failed":
        raise EstimationError(
            "the search found no stable predictor for this record. Check columns, signs and fixed values"
        )
    clock.lap("fit")
    clock.split("fit", "initial", fit.start_s)
    if fit.global_search is not None:
        clock.split("fit", "global_search", float(str(fit.global_search["seconds"])))
    say("check")
    with one_thread():
        estimate = disowned(_grown(fit, rig, bench, delay_how="estimated" if delay == "auto" else "given"))
        if "reference" in bench or (rig.loop is not None and not rig.open_loop):
            from ambid.job.closed_loop import loop_and_peaks

            _, sensitivity, warnings = loop_and_peaks(estimate, rig, bench, None)
            estimate = replace(estimate, sensitivity=sensitivity, warnings=(*estimate.warnings, *warnings))
    clock.lap("checks")
    if second is not None:
        from ambid.validation.second_record import validation

        say("validate")
        estimate = replace(estimate, validation=validation(estimate, signals_of(second, plant)))
        clock.lap("validate")
    return replace(estimate, timing_s=clock.laps, used=bench)


def _with_facts(refusal: str, bench: Record, rig: Rig) -> str:
    """Put what the means say before a refusal, whose guess may be wrong then."""
    from ambid.validation.facts import means_check

    if not {"voltage", "current"} <= set(bench.names):
        return refusal
    with np.errstate(all="ignore"):  # of values that no sensor shows
        means = means_check(bench, rig)
    return refusal if means.passed else f"{means.detail}. Further: {refusal}"


def _grown(fit: Fit, rig: Rig, bench: Record, *, delay_how: Literal["estimated", "given"]) -> Estimate:
    """Judge a fit; while a check names a cause that the model can take in, test one with it, and keep the last if the
    model fits now, fewer checks fail, and none that did not before, but that a fixed value shows as wrong. Else the
    first estimate stays, with its causes; also where a fixed value or a prior may be what is wrong, unless the cause
    changes in time.
    """
    from ambid.validation.causes import OF_THE_MODEL, extended, told, worse
    from ambid.validation.residuals import P_LEAST

    began = last = _tested(fit, rig, bench, delay_how)
    taken: tuple[Cause, ...] = ()
    plain, means = fit.problem, _means_of(bench, fit)
    for _ in range(_CAUSES):
        named, fixed = last.checks.get("causes"), last.checks["fixed_agree"].p
        if named is None or named.passed or not last.checks["long_enough"].passed:  # a walk is all that shows then
            break
        prior = chi_squared_tail(1, last.checks["priors_agree"].values["largest_sd"] ** 2)
        doubtful = min(prior, 1.0 if fixed is None else fixed) < P_LEAST
        more = extended(fit, means, last.named, plain, taken, doubtful=doubtful)
        if more is None:
            break
        fit, plain, taken = more
        last = _tested(fit, rig, bench, delay_how)
    first = _concluded(began, rig, bench, delay_how)
    if last is began or any(not last.checks[name].passed for name in OF_THE_MODEL & last.checks.keys()):
        return first
    grown = replace(_concluded(last, rig, bench, delay_how), extended=told(fit, taken))
    if worse(first.checks, grown.checks):
        return first
    if not taken:
        return grown
    moved = {name: math.hypot(sd, grown[name].value - first[name].value) for name, sd in grown.bias_sd.items()}
    return replace(grown, bias_sd=moved)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Tested:
    """A fit that has not failed, with the tests of its innovations and of what was taken for known."""

    fit: Fit
    e: Array  # (n_used, n_outputs), innovations, scaled
    spread: Uncertainty
    checks: dict[str, Check]
    robust: bool  # whether one of the innovations' tests failed
    freed: Freed
    named: list[Cause]  # that the innovations may have, the strongest first


def _tested(fit: Fit, rig: Rig, bench: Record, delay_how: Literal["estimated", "given"]) -> _Tested:
    """Test a fit on its own record `bench`, by role."""
    from ambid.bearing.columns import check_lag
    from ambid.bearing.linear import course_left_open
    from ambid.bearing.uncertainty import uncertainty
    from ambid.estimation.colours import colours_of, left_open
    from ambid.estimation.likelihood import free_one, innovations
    from ambid.validation import physical
    from ambid.validation.causes import causes, causes_check, named_bias
    from ambid.validation.residuals import P_LEAST

    between: dict[str, Check] = {}
    if rig.measured_input:
        fit, between["current_between_samples"] = course_left_open(fit)
    problem, means = fit.problem, _means_of(bench, fit)
    e = innovations(problem, fit.vector, None if fit.work is None else fit.work.of(problem))
    if e is None:
        raise EstimationError(
            "the search found no stable predictor for this record. Check columns, signs and fixed values"
        )
    products, moved = physical.innovation_products(fit, e), physical.agreement(fit)
    if colours_of(problem) and moved.passed and all(t.p >= P_LEAST for t in physical.innovation_tests(fit, products)):
        fit = replace(fit, beside=left_open(fit) + (0.0 if fit.beside is None else fit.beside))  # this one may stay
    spread = uncertainty(fit, products.scores)
    checks = physical.innovation_checks(fit, products, spread, moved)
    robust = fit.status != "converged" or not all(c.passed for c in checks.values())
    if robust:
        spread = replace(spread, disagreement=moved.disagreement()[None])
    freed = {name: free_one(fit, name) for name in problem.known}
    checks |= physical.assumption_checks(fit, spread, freed, delay_how)
    axis = problem.model.name == "one-axis"
    in_time = {"in_time": check_lag(signals_of(bench, problem.model))} if axis else {}
    curved, bent, own = None, False, np.sqrt(np.diag(spread.information))
    if axis and (rig.magnet is not None or rig.limits is not None):  # else no law of the magnet is known
        from ambid.control.curvature import magnet_checks
        from ambid.control.experiment import MOST

        sd = spread.standard_deviations(robust=robust)  # of refits, before bands, which bend too
        checks |= magnet_checks(fit, e, rig, means, sd)
        curved = checks.get("curvature")
    if curved is not None:
        shift = np.array([curved.values[name] for name in spread.names])
        bent = bool(np.any(np.abs(shift) > MOST))  # a law says more than powers of the motion
        spread = replace(spread, bias=shift * sd) if bent else spread
    before, given = dict(checks), delay_how == "given"
    for thorough in (True,) if robust else (False, True):  # what takes long only where there is a reason
        named = [
            c
            for c in causes(fit, means, rig, thorough=thorough, delay_given=given, freed=freed)
            if not bent or c.name != "curvature"
        ]
        judged = causes_check(named, {**before, **in_time}, own, robust=robust, record=bench)
        checks = {**before, **judged, **in_time}
        if checks["causes"].passed:
            break
    spread = replace(spread, bias=named_bias(named, spread.bias))
    checks |= between
    return _Tested(fit=fit, e=e, spread=spread, checks=checks, robust=robust, freed=freed, named=named)


def _concluded(tested: _Tested, rig: Rig, bench: Record, delay_how: Literal["estimated", "given"]) -> Estimate:
    """Compare a fit that was tested with what is known without it, and return the estimate, without timings."""
    from ambid.bearing.uncertainty import estimate_of
    from ambid.estimation.calibration import calibrated, linear_moves, lines_of
    from ambid.estimation.likelihood import simulation_error
    from ambid.validation import physical
    from ambid.validation.facts import informed
    from ambid.validation.residuals import fit_of

    fit, spread, checks, robust = tested.fit, tested.spread, tested.checks, tested.robust
    if robust:
        spread = replace(spread, disagreement=np.vstack([spread.disagreement, physical.by_bands(fit)]))
    alone, model = spread.information, fit.problem.model
    facts = physical.fact_checks(fit, rig, bench, spread, robust=robust, freed=tested.freed)
    fit, spread, used = informed(fit, rig, bench, {**checks, **facts}, spread, robust=robust)
    if used is not None:
        text = f"{facts['gravity_balance'].detail}. The estimate uses it"
        facts = {**facts, "gravity_balance": replace(facts["gravity_balance"], detail=text)}
    checks = checks | physical.physical_checks(fit, spread, bench, robust=robust)
    checks["units"] = _units(fit, rig, signals_of(bench, model), doubt=not checks["fixed_agree"].passed)
    checks |= facts
    problem, error = tested.fit.problem, simulation_error(fit)
    y, e = problem.y[problem.skip :], tested.e * problem.scales.output
    inflated = "scatter over the record, disagreement of refits" if robust else ""
    estimate = estimate_of(
        fit, spread, rig.parameters, robust=robust, delay_how=delay_how,
        means=_means_of(bench, fit), one_step=fit_of(e, y), simulation=None if error is None else fit_of(error, y),
        checks=checks, warnings=warnings_of(fit, checks, inflated), record=origin(bench), rig=rig_entry(rig),
    )  # fmt: skip
    estimate, theta = replace(estimate, global_search=fit.global_search), problem.parameters(fit.vector)
    known = rig, model, theta, spread.names
    moves = partial(linear_moves, *known, alone, [lines_of(fit)], weight=used)
    return calibrated(estimate, *known, moves)


def _means_of(bench: Record, fit: Fit) -> dict[str, float]:
    """Return the operating point of a fit's record, by role, SI."""
    model = fit.problem.model
    return {role: float(bench[role].values.mean()) for role in (*model.inputs, *model.outputs)}


def _units(fit: Fit, rig: Rig, signals: Signals, *, doubt: bool) -> Check:
    """Check an estimate's sizes; in `doubt` of the rig's values (contradicted by data) of one without them."""
    from ambid.bearing.linear import greybox
    from ambid.bearing.sizes import check_units

    check = check_units(fit.problem.parameters(fit.vector), rig.parameters, signals, fit.problem.model)
    constrained = [p for p in rig.parameters if p.role != "free" and p.value]
    doubt = doubt and fit.problem.extra is None
    if not constrained or not (doubt or check.values["unusual"]):
        return check
    free = [replace(p, role="free", value=None, sd=None) if p in constrained else p for p in rig.parameters]
    with contextlib.suppress(EstimationError, np.linalg.LinAlgError):
        alone = greybox(rig.plant, signals, free, delay=fit.problem.delay, evaluations=0)
        again = check_units(alone.problem.parameters(alone.vector), rig.parameters, signals, fit.problem.model)
        if alone.status == "converged" and not again.passed:
            return again
    return check


@of_job("identify")
def identify_nonlinear(
    records: Source | Sequence[Source],
    rig: RigSource | None = None,
    *,
    held: Source | Sequence[Source] = (),
    validate: Source | None = None,
    eddy: bool = False,
    drift: bool = False,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: GapPolicy | None = None,
    units: Mapping[str, str] | None = None,
    layout: Mapping[str, str] | None = None,
    tick: Tick | None = None,
) -> NonlinearBearingEstimate:
    """Identify one nonlinear bearing from several records at several operating points at once.

    Prediction error with an extended Kalman predictor, consistent under feedback as far as its linearised noise is.

    Parameters
    ----------
    records : file, Record, DataFrame, Dataset or dict of arrays, or sequence of these
        In which the rotor moves.
    rig : Rig, path, dict or TOML text, optional
        What is known of the bench, of the magnet in ``[magnet]``.
    held : as `records`, optional
        With the rotor held at rest at different distances: they show the coil.
    validate : as one of the `records`, optional
        A further record, of a rotor that moves, to validate the estimate on.
    eddy, drift : bool, optional
        Estimate an eddy pole, or a force and a voltage that drift, where the rig does not say so; a drift also where
        it pays.
    from_s, to_s, rate_hz, gaps, units, layout : optional
        As `identify`; the part of every record in which the rotor moves.
    tick : callable, optional
        As `identify`.

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
    from ambid.bearing.magnet_estimate import estimate_bearing
    from ambid.job.nonlinear_bearing import (
        BearingWords,
        bearing_rig,
        grown_bearing,
        laws_of,
        less_zeros,
        numbers_of,
        take_all,
    )
    from ambid.validation.nonlinear_bearing import validation, white

    words = BearingWords(
        eddy=eddy, drift=drift, from_s=from_s, to_s=to_s, rate_hz=rate_hz, gaps=gaps, units=units, layout=layout,
    )  # fmt: skip
    say, clock, bench = tick or silent, Clock(), bearing_rig(rig, **words)
    readings, second = take_all(sources_of(records), sources_of(held), validate, bench, words, say)
    clock.lap("read")
    assert bench.magnet is not None
    laws, extend = laws_of(bench.magnet, [t.record for t in readings if not t.record.held])
    wanted = bench.channel("voltage").delay
    fit = estimate_bearing(
        [t.record for t in readings], numbers_of(bench), laws=laws, delay=None if wanted == "auto" else float(wanted),
        extend=extend, white=white, eddy=bench.magnet.eddy, drift=bench.magnet.drift, tick=say,
    )  # fmt: skip
    if fit.status == "failed":
        raise EstimationError(
            "the search ended without a stable predictor for these records: no force law explains them. Check "
            "columns, signs and units"
        )
    clock.lap("fit")
    say("check")
    estimate = disowned(grown_bearing(fit, readings, bench))
    clock.lap("checks")
    estimate = replace(estimate, timing_s=clock.laps, rig=rig_entry(bench), used=less_zeros(readings, fit))
    if second is not None:
        estimate = replace(estimate, validation=validation(estimate, second.record))
    return estimate
