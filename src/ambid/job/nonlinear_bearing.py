"""The job of a nonlinear bearing: records as its predictor sees them, through a rig that says what is known of the
magnet (not the same data or channel twice, the stage off, a held rotor that moves), and its fit judged on them.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, Unpack

import numpy as np
from scipy.spatial import ConvexHull

from ambid.arrays import Array
from ambid.bearing.magnet_estimate import PARTS
from ambid.bearing.magnet_likelihood import BearingFit, BearingUncertainty, bearing_moves, uncertainty
from ambid.bearing.magnet_problem import LEVELS, UNITS, BearingRecord, touching, weight_carried
from ambid.bearing.magnet_result import NonlinearBearingEstimate
from ambid.errors import EstimationError, counted
from ambid.estimation.calibration import calibrated
from ambid.estimation.estimate import Check, Delay, EstimatedParameter, OutputFit, warnings_of
from ambid.estimation.progress import Tick
from ambid.estimation.uncertainty import WEAK
from ambid.job.data import Reading, RigSource, Source, known_rig, load_bench, origin, overlap
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.linear_model import Parameter
from ambid.record import Record
from ambid.rig import Rig, RigMagnet
from ambid.settings.caller import setting
from ambid.validation.bearing_causes import bearing_causes, bearing_look, extended_bearing
from ambid.validation.causes import Cause, causes_check, named_bias, told_of, worse
from ambid.validation.nonlinear_bearing import (
    Whiteness,
    agreement,
    agreement_check,
    innovation_sd,
    record_facts,
    whiteness,
    whiteness_checks,
)

_OFF_SD = 1.0  # of the voltage of a stage that is off, V: a diode's, or none
_LINEAR = ("m", "R", "c")  # numbers that stand with the linear model's
_LEAST = 100  # samples
_REVERSED = 0.2  # largest current backwards over that forwards from which two magnets are taken
_SAME = 1e-9  # part of a channel's spread that another one leaves over, at or below which both are the same signal
_ROCKS = 0.25  # spread of a held position over that of the moving ones from which it is told
_INFLATION = 1.5  # robust over information standard deviation from which the model, not the noise, sets the error
_CAUSES = 6  # by which a model is extended
_ROLES = ("position", "current")
_OFFSETS = {"voltage": "v_offset", "current": "i_offset", "position": "x_offset"}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TakenRecord:
    """A record that was read for a nonlinear bearing."""

    record: BearingRecord  # what the predictor runs over
    bench: Record  # what that was made of, channels by role
    # ``samples``, ``rate_hz``, ``sha256``, ``file``, ``held`` and ``history``, for the estimate
    remembered: Mapping[str, object]
    warnings: tuple[str, ...]  # what was changed in it
    start_s: float  # time of its first sample in s


class BearingWords(Reading, total=False):
    """What a caller says of a nonlinear bearing beside its rig, and how records are read."""

    eddy: bool
    drift: bool


def bearing_rig(rig: RigSource | None, **words: Unpack[BearingWords]) -> Rig:
    """Return a rig whose `magnet` is known as it says, but for what is given here."""
    bench = known_rig(rig)
    if bench.model != "one-axis":
        raise EstimationError(
            f"the rig's model is {bench.model!r}; a nonlinear bearing needs 'one-axis'. Correct model, or use "
            "another rig"
        )
    magnet = bench.magnet or RigMagnet()
    magnet = replace(
        magnet, eddy=magnet.eddy or words.get("eddy", False), drift=magnet.drift or words.get("drift", False)
    )
    return replace(bench, magnet=magnet)


def numbers_of(rig: Rig) -> dict[str, Parameter]:
    """Return what a rig with a `magnet` knows of a nonlinear bearing: m, R and c, and the magnet's numbers."""
    assert rig.magnet is not None
    return {**{n: rig.parameter(n) for n in _LINEAR}, **{p.name: p for p in rig.magnet.parameters}}


def laws_of(magnet: RigMagnet, records: Sequence[BearingRecord]) -> tuple[list[MagnetLaw], list[str]]:
    """Return the laws between which the likelihood of moving rotors' `records` decides, and the parts that it may add
    to them, since the rig says nothing of them.
    """
    kind = magnet.kind
    if kind == "auto" and magnet.gap == "exponential":
        kind = "single"
    if kind == "auto" and records:
        low, high = min(r.kept[:, 1].min() for r in records), max(r.kept[:, 1].max() for r in records)
        kind = "pair" if low < -_REVERSED * high else "single"
    pair, rise, saturation = kind == "pair", bool(magnet.rise), bool(magnet.saturation)
    gaps: tuple[Literal["hyperbolic", "exponential"], ...] = ("hyperbolic", "exponential")
    if magnet.gap or pair:
        gaps = (magnet.gap or "hyperbolic",)
    laws = [
        MagnetLaw(gap=gap, pair=pair, asymmetric=bool(magnet.asymmetric), saturation=saturation, rise=rise)
        for gap in gaps
    ]
    return laws, [*(part for part in PARTS if getattr(magnet, part) is None), "drift", "zeros"]


def take_record(record: Source, rig: Rig, how: Reading, *, held: bool = False) -> TakenRecord:
    """Read a record as the predictor sees it, by a rig with a `magnet`; all of it where the rotor is `held` at rest."""
    if held:
        rig = replace(rig, record=replace(rig.record, from_s=None, to_s=None))
        how = {**how, "from_s": None, "to_s": None}
    bench = load_bench(record, rig, **how)
    u, name = np.array(bench["voltage"].values), str(bench.provenance.get("file") or "record")
    warnings, off = list[str](), None if rig.magnet is None else rig.magnet.off_below
    if rig.limits is not None:
        low, high = rig.limits.voltage
        beyond = int(np.count_nonzero((u < low) | (u > high)))
        if beyond:
            u = np.clip(u, low, high)
            warnings.append(
                f"{name}: {counted(int(beyond), 'sample')} of the voltage beyond loop.limits.voltage; replaced by "
                "the limit"
            )
    y = np.column_stack([bench["position"].values, bench["current"].values])
    loose = np.zeros(u.size) if off is None else np.where(u <= off, _OFF_SD, 0.0)
    valid = np.ones(y.shape, dtype=np.bool_)
    reading = BearingRecord(name=name, rate_hz=bench.rate_hz, u=u, loose=loose, y=y, valid=valid, held=held)
    _check_moves(reading)
    if rig.limits is not None:
        reading = touching(reading, rig.limits.position)
        warnings += _stops(reading)
    provenance = {**origin(bench), "held": held}
    return TakenRecord(
        record=reading, bench=bench, remembered=provenance, warnings=tuple(warnings), start_s=bench.start_s
    )


def _stops(record: BearingRecord) -> list[str]:
    """Say where the rotor touched its stops and where it lay on them; refuse where too little is left."""
    warnings = list[str]()
    if record.knock is not None and record.knock.any():
        warnings.append(
            f"{record.name}: the rotor touches a stop (loop.limits.position) in {np.count_nonzero(record.knock)} "
            "samples; the force there is treated as unknown"
        )
    if record.cut is not None:
        lies, left = float(np.mean(record.cut)), int(np.count_nonzero(~record.cut))
        if max((end - first for first, end in record.parts), default=0) < _LEAST:
            raise EstimationError(
                f"{record.name}: the rotor rests on a stop (loop.limits.position) in {lies:.0%} of the record and "
                f"is nowhere free for {_LEAST} samples. Correct the limits, or record with the rotor levitated"
            )
        warnings.append(
            f"{record.name}: the rotor rests on a stop (loop.limits.position) in {lies:.1%} of the record; that "
            f"part was cut out, and {left} samples in {counted(len(record.parts), 'part')} remain"
        )
    return warnings


def _check_moves(record: BearingRecord) -> None:
    """Refuse what no number can come from."""
    if record.u.size < _LEAST:
        raise EstimationError(
            f"{record.name} has {counted(record.u.size, 'sample')}; a nonlinear bearing needs {_LEAST}. Give a "
            "longer record, or omit it"
        )
    channels = {"voltage": record.u, "current": record.y[:, 1]} | ({} if record.held else {"position": record.y[:, 0]})
    for role, x in channels.items():
        if not np.ptp(x) > 0.0:
            raise EstimationError(
                f"{record.name}: channel {role!r} is constant in the whole record. Check its column and unit, or "
                "omit the record"
            )


def take_all(
    records: Sequence[Source],
    held: Sequence[Source],
    validate: Source | None,
    rig: Rig,
    words: BearingWords,
    say: Tick,
) -> tuple[tuple[TakenRecord, ...], TakenRecord | None]:
    """Read the records of one identification: those to identify from, and the one to validate on."""
    how: Reading = {k: words[k] for k in Reading.__annotations__ if k in words}  # type: ignore[assignment, literal-required]
    if not records:
        raise EstimationError(
            "no record with a moving rotor was given; forces cannot be estimated without one. Give one"
        )
    readings: list[TakenRecord] = []
    for source, is_held in [*((r, False) for r in records), *((r, True) for r in held)]:
        say("read")
        readings.append(take_record(source, rig, how, held=is_held))
    second = None if validate is None else take_record(validate, rig, how)
    rates = {t.record.rate_hz for t in readings if not t.record.held}
    if second is not None and second.record.rate_hz not in rates:  # the predictor could not judge it: say so now
        rates_text = ", ".join(f"{rate:g} Hz" for rate in sorted(rates))
        raise EstimationError(
            f"{second.record.name}, for validation, is sampled at {second.record.rate_hz:g} Hz, the records at "
            f"{rates_text}; the rates must agree. Resample it, or omit {setting('validate')}"
        )
    return check_together(readings, second), second


def check_together(readings: Sequence[TakenRecord], second: TakenRecord | None) -> tuple[TakenRecord, ...]:
    """Check what only values show, or `readings` and `second` (to judge on) together; warn of a moving held rotor."""
    for j, one in enumerate(readings):
        _refuse_senseless(one.record)
        for other in readings[:j]:
            if _overlap(one, other):
                raise EstimationError(
                    f"{other.record.name} and {one.record.name} hold the same samples and would count twice. Omit one"
                )
    for one in readings:
        if second is not None and _overlap(one, second):
            raise EstimationError(
                f"{second.record.name}, for validation, holds samples that the estimate is fitted to. Give another "
                f"record, or omit {setting('validate')}"
            )
    moving = max((float(t.record.y[:, 0].std()) for t in readings if not t.record.held), default=0.0)
    return tuple(_warn_moving(t, moving) for t in readings)


def _refuse_senseless(record: BearingRecord) -> None:
    if np.all(record.loose > 0.0):
        raise EstimationError(
            f"{record.name}: every voltage is at or below off_below, where the stage is off, so none would be "
            "known. Correct magnet.off_below of the rig (in V)"
        )
    channels = {"voltage": record.u, "position": record.y[:, 0], "current": record.y[:, 1]}
    if record.held:
        del channels["position"]
    names = list(channels)
    unit = {name: (x - x.mean()) / x.std() for name, x in channels.items()}
    for j, one in enumerate(names):
        for other in names[:j]:
            a, b = unit[one], unit[other]
            if np.std(a - np.sign(a @ b) * b) <= _SAME:
                raise EstimationError(
                    f"{record.name}: {other} and {one} are the same signal up to scale and offset. Correct "
                    f"channels.{other}.column or channels.{one}.column"
                )


def _overlap(a: TakenRecord, b: TakenRecord) -> bool:
    """Whether both come from one file and one stretch of its time."""
    return overlap(*((t.remembered["sha256"], t.start_s, t.record.u.size, t.record.rate_hz) for t in (a, b)))


def _warn_moving(one: TakenRecord, moving: float) -> TakenRecord:
    rocks = float(one.record.y[:, 0].std())
    if not one.record.held or rocks <= _ROCKS * moving:
        return one
    warning = (
        f"{one.record.name}: the rotor is declared held, but its position scatters by {1e6 * rocks:.3g} um, "
        f"{rocks / moving:.0%} of its motion in the other records; R and L are biased if it moved"
    )
    return replace(one, warnings=(*one.warnings, warning))


def grown_bearing(fit: BearingFit, readings: Sequence[TakenRecord], rig: Rig) -> NonlinearBearingEstimate:
    """Judge a fit that has not failed on its own `readings`, and, while a check names a cause that changes in time and
    that the model can take in, one with it; see `identification`. Estimate without validation, timings and rig.
    """
    estimate, found = _judged(fit, readings, rig)
    first, given = estimate, rig.channel("voltage").delay != "auto"
    taken: tuple[Cause, ...] = ()
    while len(taken) < _CAUSES and not estimate.checks["causes"].passed:
        more = extended_bearing(fit, found, readings[0].record, taken, delay_given=given)
        if more is None:
            break
        fit, taken = more
        estimate, found = _judged(fit, readings, rig)
        estimate = replace(estimate, extended=tuple(dict.fromkeys([*estimate.extended, *map(told_of, taken)])))
    return first if worse(first.checks, estimate.checks) else estimate


def _judged(fit: BearingFit, readings: Sequence[TakenRecord], rig: Rig) -> tuple[NonlinearBearingEstimate, list[Cause]]:
    """Check a fit on its own `readings`; return the estimate and the causes that innovations may have."""
    problem, names, spread = fit.problem, _names(fit), uncertainty(fit)
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as threads:
        tests = list(threads.map(partial(whiteness, fit), range(len(names)), names if len(names) > 1 else [""]))
    residuals = whiteness_checks(tests)
    alone = agreement(fit, spread, alone=True)
    residuals |= {"records_agree": agreement_check(alone)} if alone.strides else {}
    failed = not all(c.passed for c in residuals.values())
    robust = failed or spread.inflation > _INFLATION or fit.status != "converged"
    moves = [alone.beyond_chance(), agreement(fit, spread, alone=False).beyond_chance()] if robust else []
    told, contradicted = record_facts(fit, spread, [t.bench for t in readings], names, rig, robust=robust)
    given = rig.channel("voltage").delay != "auto"
    spread = replace(spread, disagreement=np.vstack([*moves, contradicted]))
    sd = np.sqrt(np.diag(spread.covariance(robust=robust)))  # as stated: what moves numbers within it does no harm,
    sd[np.isin(spread.names, "tau")] = np.inf  # nor what moves the noise
    found, named, biased = _causes(
        fit, sd, {**told, **residuals}, tests, readings, robust=robust, failed=failed, delay_given=given
    )
    spread = replace(spread, disagreement=np.vstack([spread.disagreement, biased]))
    wide = robust or bool(np.any(spread.disagreement))
    parameters = _parameters(fit, spread, robust=wide)
    checks = {**told, **residuals, **named, "identifiable": _shown(parameters)} | _gravity(fit) | _law(fit)
    noise = {
        n: dict(zip((LEVELS[j] for j in problem.levels(r)), np.exp(fit.vector[place]).tolist(), strict=True))
        for r, (n, place) in enumerate(zip(names, problem.noise_slices, strict=True))
    }
    points = np.concatenate([r.kept for r in problem.records])
    moving = np.concatenate([r.kept for r in problem.records if not r.held])
    changed = tuple(w for t in readings for w in t.warnings)
    delays = _delays(fit, spread, given=given)
    estimate = NonlinearBearingEstimate(
        status="converged" if fit.status == "converged" else "stalled",
        law=problem.law, eddy=problem.eddy, drift=problem.drift, records=tuple(t.remembered for t in readings),
        parameters=parameters, covariance_names=spread.names, covariance=spread.covariance(robust=wide),
        covariance_method="robust" if wide else "information", delay=delays,
        noise=noise, fit=_fits(fit, names), range=_between(moving.min(axis=0), moving.max(axis=0)),
        usual=_between(*np.quantile(moving, (0.025, 0.975), axis=0)),
        operating_point=dict(zip(_ROLES, moving.mean(axis=0).tolist(), strict=True)),
        hull=_hull(moving), coil_hull=_hull(points), criterion=fit.criterion,
        bic=fit.criterion + problem.size * float(np.log(problem.n_used)), checks=checks,
        extended=_extended_by(fit, rig),
        warnings=_warnings(fit, checks, robust=robust) + changed,
    )  # fmt: skip
    moves_of = partial(bearing_moves, fit)
    estimate = calibrated(
        estimate, rig, rig.plant, estimate.values, spread.names, moves_of, offsets=_OFFSETS,
        places=sum(not r.held for r in problem.records) > 1 and all(r.zero is None for r in problem.records),
    )  # fmt: skip
    return estimate, found


def less_zeros(readings: Sequence[TakenRecord], fit: BearingFit) -> tuple[TakenRecord, ...]:
    """Return readings whose records are less the zeros of their own that a fit has taken out."""
    return tuple(
        t if r.zero is None else replace(t, record=replace(t.record, y=r.y))
        for t, r in zip(readings, fit.problem.records, strict=True)
    )


def _extended_by(fit: BearingFit, rig: Rig) -> tuple[str, ...]:
    asked = rig.magnet is not None and rig.magnet.drift
    own = any(r.zero is not None for r in fit.problem.records)
    return ("zeros",) * own + ("drift",) * (fit.problem.drift and not asked)


def _delays(fit: BearingFit, spread: BearingUncertainty, *, given: bool) -> dict[str, Delay]:
    return {
        f"{rate:g} Hz": Delay.of(
            fit.problem.delay_at(fit.vector, rate), spread.delay_sd.get(rate), "given" if given else "estimated"
        )
        for rate in fit.problem.delays
    }


def _causes(
    fit: BearingFit, sd: Array, checks: Mapping[str, Check], tests: Sequence[Whiteness],
    readings: Sequence[TakenRecord], *, robust: bool, failed: bool, delay_given: bool,
) -> tuple[list[Cause], dict[str, Check], Array]:  # fmt: skip
    """Return the causes that the innovations of the moving record which fits worst may have, judged, and how far those
    seen, and bands left out where deviations are `robust`, move the numbers, (n_moves, n), SI; `failed`: whether a test
    of the innovations did.
    """
    worst = min((r for r, x in enumerate(fit.problem.records) if not x.held), key=lambda r: tests[r].p)
    look = bearing_look(fit, worst)
    if look is None:
        return [], {"causes": Check(passed=True, detail="no cause could be looked for")}, np.zeros((0, sd.size))
    found, judged = list[Cause](), dict[str, Check]()
    for thorough in (True,) if robust else (False, True):  # what takes long only where there is a reason
        found = bearing_causes(look, thorough=thorough, delay_given=delay_given)
        judged = causes_check(found, checks, sd, robust=failed, record=readings[worst].bench)
        if judged["causes"].passed:
            break
    return found, judged, np.vstack([named_bias(found, np.zeros(sd.size)), *([look.bands()] if robust else [])])


def _fits(fit: BearingFit, names: Sequence[str]) -> dict[str, dict[str, OutputFit]]:
    fits: dict[str, dict[str, OutputFit]] = {}
    for r, (name, record) in enumerate(zip(names, fit.problem.records, strict=True)):
        spread = dict(zip(_ROLES, record.kept.std(axis=0).tolist(), strict=True))
        fits[name] = {
            role: OutputFit(one_step=1.0 - sd / spread[role], simulation=None, innovation_sd=sd)
            for role, sd in innovation_sd(fit, r).items()
        }
    return fits


def _between(low: Array, high: Array) -> dict[str, tuple[float, float]]:
    return {role: (a, b) for role, a, b in zip(_ROLES, low.tolist(), high.tolist(), strict=True)}


def _names(fit: BearingFit) -> list[str]:
    """Names of the records, each its own."""
    names: list[str] = []
    for r in fit.problem.records:
        names.append(r.name if r.name not in names else f"{r.name} ({len(names) + 1})")
    return names


def _parameters(fit: BearingFit, spread: BearingUncertainty, *, robust: bool) -> tuple[EstimatedParameter, ...]:
    """Return every number that acts."""
    law, values, numbers = fit.problem.law, fit.problem.values(fit.vector), fit.problem.numbers
    acts = {
        "sigma": law.saturation,
        "L_rise": law.rise,
        "i_knee": law.rise,
        "i0": law.pair,
        "a": fit.problem.eddy,
        "tau": fit.problem.drift,
    }
    acts |= dict.fromkeys(("k_asym", "i0_asym"), law.asymmetric)
    drop = values["v_drop"] != 0.0 or any(n.name == "v_drop" and n.estimated for n in numbers)
    acts |= dict.fromkeys(("v_drop", "i_drop"), drop)
    both = np.diag(spread.information), np.sqrt(np.diag(spread.covariance(robust=robust)))
    own, sd = (dict(zip(spread.names, x.tolist(), strict=True)) for x in both)
    moves = _moves(fit)
    size = {n.name: max(n.magnitude, abs(values[n.name])) if n.signed else values[n.name] for n in numbers}
    seen = {n: x < WEAK * abs(size[n]) or x * moves.get(n, np.inf) < WEAK for n, x in sd.items()}
    parameters = list[EstimatedParameter]()
    for n in (n for n in numbers if acts.get(n.name, True)):
        prior = n.estimated and np.isfinite(n.prior_sd)
        known = Parameter(
            name=n.name, unit=UNITS[n.name], value=n.value, sd=n.prior_sd if prior else None,
            role="prior" if prior else "free" if n.estimated else "fixed",
        )  # fmt: skip
        alone = {n.name: float(max(1.0 / own[n.name] - 1.0 / n.prior_sd**2, 1e-300) ** -0.5)} if prior else None
        parameters.append(EstimatedParameter.of(known, values, sd, seen, alone))
    return tuple(parameters)


def _moves(fit: BearingFit) -> dict[str, float]:
    """Return by how much of themselves k_x, k_i and L at the records' mean, and the voltage, move at most with a number
    that may be zero; a leakage that is none is not known by a part of itself, and need not be.
    """
    problem, law, values = fit.problem, fit.problem.law, fit.problem.values(fit.vector)
    moving = [r for r in problem.records if not r.held]
    at = np.concatenate([r.kept for r in moving]).mean(axis=0) - [values["x_offset"], values["i_offset"]]
    table, slopes = law.table(at[:1], at[1:], values)
    turned = law.gradients(at[:1], at[1:], values)[0]
    by = {n: slopes[0, :, j] for j, n in enumerate(law.names)} | {"x_offset": turned[:, 0], "i_offset": turned[:, 1]}
    voltage = float(np.sqrt(np.mean(np.concatenate([r.u for r in moving]) ** 2)))
    known = {n.name for n in problem.numbers if n.signed} | {"L_leak", "L_rise", "i_knee"}
    found = {n: float(np.max(np.abs(x[1:] / table[0, 1:]))) for n, x in by.items() if n in known}
    return {**found, "v_offset": 1.0 / voltage, "v_drop": 1.0 / voltage, "tau": 0.0}


def _shown(parameters: Sequence[EstimatedParameter]) -> Check:
    hidden = [p.name for p in parameters if not p.identifiable]
    detail = "every estimated parameter is identifiable" if not hidden else (
        f"not identifiable from these records: {', '.join(hidden)} (relative standard deviation above 25 %). Fix them, "
        "give a prior, or record with more motion"
    )  # fmt: skip
    return Check(passed=not hidden, detail=detail)


def _law(fit: BearingFit) -> dict[str, Check]:
    """Say where the gap law of the rig is contradicted by the other one."""
    gap, other = sorted(("hyperbolic", "exponential"), key=lambda x: x != fit.problem.law.gap)
    detail = (
        f"the {other} law explains the records better than the {gap} one of the rig (its criterion is {fit.beaten:.0f} "
        "lower): residuals may be white, and numbers wrong all the same. Omit magnet.gap"
    )
    return {"law": Check(passed=False, detail=detail, values={"criterion": fit.beaten})} if fit.beaten else {}


def _gravity(fit: BearingFit) -> dict[str, Check]:
    """Check, for one magnet, that the force law carries the weight at the mean position of every record."""
    law, values = fit.problem.law, fit.problem.values(fit.vector)
    weight = values["m"] * values["g"]
    if law.pair or weight == 0.0:
        return {}
    shares = [weight_carried(law, values, r) for r in fit.problem.records if not r.held]
    carried = [c for c in shares if c is not None]
    if not carried:
        return {}
    off = max(abs(c - 1.0) for c in carried)
    detail = f"the magnet's mean force differs from the weight by at most {off:.1%} on any record"
    return {"carries_its_weight": Check(passed=off < 0.1, detail=detail, values={"largest": off})}


def _hull(points: Array) -> Array:
    """Corners of the convex hull, counter-clockwise."""
    corners: Array = points[ConvexHull(points / points.std(axis=0)).vertices]
    return corners


def _unseen(fit: BearingFit) -> list[str]:
    """What no record can identify, however good the fit: a gain of the position sensor, the source of an offset."""
    free, values = {n.name for n in fit.problem.estimated if n.prior_sd == float("inf")}, fit.problem.values(fit.vector)
    warnings = []
    scaled = ("k", "s") if fit.problem.law.gap == "hyperbolic" else ("zeta",)
    if "m" in free and values["g"] == 0.0 and set(scaled) <= free:
        warnings.append(
            "a gain error of the position sensor cannot be detected while m is free: 1 % too much makes m and k_x 2 % "
            "and k_i 1 % too small, and s and k 1 % too large. Weigh the rotor and fix m: the residuals then reveal it"
        )
    if "i0_asym" in free and "i_offset" not in free:
        warnings.append("i0_asym cannot be distinguished from an offset of the current sensor")
    return warnings


def _warnings(fit: BearingFit, checks: Mapping[str, Check], *, robust: bool) -> tuple[str, ...]:
    """What a reader has to know before using the numbers, most important first."""
    warnings = [
        *warnings_of(fit, checks, "scatter over the records, disagreement of refits" if robust else ""),
        *_unseen(fit),
    ]
    means = checks.get("ohm")
    if means is not None and means.passed and means.size is not None:
        warnings.append("R and v_offset are only known together, as far as the means of voltage and current go")
    first, *others = (x for x in zip(fit.problem.records, _names(fit), strict=True) if not x[0].held)
    warnings += [
        f"{name}: its zero of the position is {1e3 * abs(r.zero):.3g} mm {'above' if r.zero > 0.0 else 'below'} "
        f"that of {first[1]}; taken out of it"
        for r, name in others
        if r.zero is not None
    ]
    if fit.problem.drift:
        warnings.append("a force and a voltage that drift absorb what the law does not explain")
    return tuple(warnings)
