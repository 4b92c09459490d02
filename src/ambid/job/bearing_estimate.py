"""Judging of a nonlinear bearing's fit on its own records, and putting its estimate together."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal

import numpy as np
from scipy.spatial import ConvexHull

from ambid.arrays import Array
from ambid.bearing.magnet_likelihood import BearingFit, BearingUncertainty
from ambid.bearing.magnet_problem import LEVELS, UNITS, weight_carried
from ambid.bearing.magnet_result import NonlinearBearingEstimate
from ambid.estimation.estimate import Check, Delay, EstimatedParameter, OutputFit, warnings_of
from ambid.estimation.uncertainty import WEAK
from ambid.job.bearing_records import TakenRecord
from ambid.validation.nonlinear_bearing import WhitenessTest, whiteness, whiteness_checks

_INFLATION = 1.5  # robust over information standard deviation from which the model, not the noise, sets the error
_ROLES = ("position", "current")


def judge_bearing(
    fit: BearingFit, spread: BearingUncertainty, readings: Sequence[TakenRecord], *, delay_given: bool
) -> NonlinearBearingEstimate:
    """Check a fit that has not failed, with its `spread`, on its own `readings`; estimate without validation, timings
    and rig. `delay_given`: the rig gives the delay.
    """
    problem, names = fit.problem, _names(fit)
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as threads:
        tests = list(threads.map(lambda r: whiteness(fit, r), range(len(problem.records))))
    residuals = whiteness_checks(tests, names)
    robust = not all(c.passed for c in residuals.values()) or spread.inflation > _INFLATION or fit.status != "converged"
    parameters = _parameters(fit, spread, robust=robust)
    checks = {**residuals, "identifiable": _shown(parameters)} | _gravity(fit)
    noise = {
        n: dict(zip((LEVELS[j] for j in problem.levels(r)), np.exp(fit.vector[place]).tolist(), strict=True))
        for r, (n, place) in enumerate(zip(names, problem.noise_slices, strict=True))
    }
    points = np.concatenate([r.kept for r in problem.records])
    moving = np.concatenate([r.kept for r in problem.records if not r.held])
    changed = tuple(w for t in readings for w in t.warnings)
    return NonlinearBearingEstimate(
        status="converged" if fit.status == "converged" else "stalled",
        law=problem.law, eddy=problem.eddy, drift=problem.drift, records=tuple(t.remembered for t in readings),
        parameters=parameters, covariance_names=spread.names, covariance=spread.covariance(robust=robust),
        covariance_method="robust" if robust else "information", delay=_delays(fit, spread, given=delay_given),
        noise=noise, fit=_fits(fit, tests, names), range=_between(moving.min(axis=0), moving.max(axis=0)),
        usual=_between(*np.quantile(moving, (0.025, 0.975), axis=0)),
        operating_point=dict(zip(_ROLES, moving.mean(axis=0).tolist(), strict=True)),
        hull=_hull(moving), coil_hull=_hull(points), criterion=fit.criterion,
        bic=fit.criterion + problem.size * float(np.log(problem.n_used)), checks=checks,
        warnings=_warnings(fit, checks, robust=robust) + changed,
    )  # fmt: skip


def _delays(fit: BearingFit, spread: BearingUncertainty, *, given: bool) -> dict[str, Delay]:
    return {
        f"{rate:g} Hz": Delay.of(
            fit.problem.delay_at(fit.vector, rate), spread.delay_sd.get(rate), "given" if given else "estimated"
        )
        for rate in fit.problem.delays
    }


def _fits(fit: BearingFit, tests: Sequence[WhitenessTest], names: Sequence[str]) -> dict[str, dict[str, OutputFit]]:
    fits: dict[str, dict[str, OutputFit]] = {}
    for name, record, test in zip(names, fit.problem.records, tests, strict=True):
        spread = record.kept.std(axis=0).tolist()
        fits[name] = {
            role: OutputFit(one_step=1.0 - sd / spread[c], simulation=None, innovation_sd=sd)
            for c, (role, sd) in enumerate(zip(_ROLES, test.innovation_sd, strict=True))
            if math.isfinite(sd)
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
    law, values, parameters = fit.problem.law, fit.problem.values(fit.vector), []
    sds = np.sqrt(np.diag(spread.covariance(robust=robust)))
    acts = {"sigma": law.saturation, "L_rise": law.rise, "i_knee": law.rise, "i0": law.pair, "a": fit.problem.eddy}
    acts |= dict.fromkeys(("k_asym", "i0_asym"), law.asymmetric)
    drop = values["v_drop"] != 0.0 or any(n.name == "v_drop" and n.estimated for n in fit.problem.numbers)
    acts |= dict.fromkeys(("v_drop", "i_drop"), drop)
    for n in fit.problem.numbers:
        if not acts.get(n.name, True):
            continue
        j = spread.names.index(n.name) if n.estimated else -1
        sd, value = float(sds[j]) if n.estimated else 0.0, values[n.name]
        prior = np.isfinite(n.prior_sd)
        size = max(n.magnitude, abs(value)) if n.signed else value
        share = None
        if prior and n.estimated:
            share = float(np.clip(1.0 - spread.information[j, j] / n.prior_sd**2, 0.0, 1.0))
        role: Literal["free", "fixed", "prior"] = "fixed" if not n.estimated else "prior" if prior else "free"
        identifiable = not n.estimated or sd < WEAK * abs(size)
        parameters.append(EstimatedParameter(
            name=n.name, unit=UNITS[n.name], value=value, sd=sd, ci95=(value - 1.96 * sd, value + 1.96 * sd),
            role=role, identifiable=identifiable, data_share=share,
        ))  # fmt: skip
    return tuple(parameters)


def _shown(parameters: Sequence[EstimatedParameter]) -> Check:

    hidden = [p.name for p in parameters if not p.identifiable]
    detail = "every estimated parameter is identifiable" if not hidden else (
        f"not identifiable from these records: {', '.join(hidden)} (relative standard deviation above 25 %). Fix them, "
        "give a prior, or record with more motion"
    )  # fmt: skip
    return Check(passed=not hidden, detail=detail)


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
    warnings = [*warnings_of(fit, checks, "scatter over the records" if robust else ""), *_unseen(fit)]
    if fit.problem.drift:
        warnings.append("a random-walk force absorbs what the force law does not explain; static forces count for less")
    return tuple(warnings)
