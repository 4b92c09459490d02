"""The steps of a commissioning that judge what came of it: record, identification, other data, live tracking."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ambid.estimation.estimate import Estimate
from ambid.job.acquire import Acquired
from ambid.job.commission.step import Step, Wishes
from ambid.job.look import ended
from ambid.job.track_live import LiveTrack
from ambid.report.numbers import quantity

_SATURATED = 1e-3  # of the samples at the end of a converter's range
_RESIDUAL = ("residuals_white", "residuals_uncorrelated", "uncertainty_consistent", "estimates_agree")
"""Checks that a model which explains the record only in part fails: the standard deviations then allow for it."""


def record(name: str, done: Acquired) -> Step:
    """Judge a record as it was taken.

    `name`: what it is for; `done`: from `acquire`. Returns not passed where samples were lost or not stored, or a
    sensor saturates or stands still. Little signal over noise is a caution: whether it is enough is decided by the
    intervals of what is identified.
    """
    reasons = list(ended(done.run, f"the {name}"))
    if done.not_stored:
        reasons += [f"{done.not_stored} samples of the {name} are not stored: {done.troubles[0]}"]
    findings = [
        f"{name}: {done.run.samples} samples at {done.info.rate_hz:g} Hz, {done.run.lost} lost,"
        f" {done.counters.damaged} frames damaged"
    ]
    reasons += [
        f"{column.name} is at the end of its range in {100 * column.saturated:.1f} % of the {name}'s samples"
        for column in done.quality.columns
        if column.role in ("position", "current") and column.saturated > _SATURATED
    ]
    reasons += [
        f"{column.name} does not move by one count in the {name}: no sensor there? Look at its cable and supply"
        for column in done.quality.columns
        if column.role in ("position", "current") and column.sd == 0.0
    ]
    cautions = [str(t) for t in done.troubles if not done.not_stored] + [f"{name}: {v}" for v in done.quality.verdict]
    return Step(name="record", findings=tuple(findings), reasons=tuple(reasons), cautions=tuple(cautions))


def identification(estimate: Estimate, wishes: Wishes) -> Step:
    """Judge an estimate: found at all, each parameter identifiable and known well enough, nothing implausible.

    `estimate`: of the record; `wishes`: how wide an interval may be. Returns tests of residuals that fail are cautions,
    because the standard deviations allow for them; all else stops.
    """
    findings: list[str] = []
    reasons: list[str] = []
    cautions: list[str] = []
    numbers: dict[str, float] = {}
    if estimate.status != "converged":
        reasons.append(f"the search ended {estimate.status}: look at columns, signs and calibrations")
    for p in estimate.parameters:
        if p.role == "fixed":
            continue
        half = (p.ci95[1] - p.ci95[0]) / 2.0
        wide = half / abs(p.value) if p.value else math.inf
        findings.append(f"{p.name} = {quantity(p.value, p.sd, p.unit).text} (95 % interval ± {100 * wide:.2g} %)")
        numbers |= {p.name: p.value, f"{p.name}_sd": p.sd}
        if not p.identifiable:
            reasons.append(f"{p.name} is not identifiable from this record: excite more, or fix what is known")
        elif wide > wishes.widest:
            reasons.append(
                f"{p.name} is known to ± {100 * wide:.2g} % only, {100 * wishes.widest:g} % is wanted: record longer,"
                " or excite more"
            )
    for name, check in estimate.checks.items():
        if not check.passed:
            (cautions if name in _RESIDUAL else reasons).append(f"{name}: {check.detail}")
    return Step(
        name="identify", findings=tuple(findings), reasons=tuple(reasons), cautions=tuple(cautions), numbers=numbers
    )


def validation(estimate: Estimate) -> Step:
    """Judge how an estimate does on the second record.

    `estimate`: with `validation`. Returns not passed where the second record is predicted worse than the first allows.
    """
    checks: Mapping[str, Any] = (estimate.validation or {}).get("checks", {})  # type: ignore[assignment]
    findings = tuple(f"{name}: {c['detail']}" for name, c in checks.items() if c["passed"])
    if not checks:
        return Step(name="validate", reasons=("nothing was checked on the second record: it cannot be judged",))
    failed = {name: f"{name}: {c['detail']}" for name, c in checks.items() if not c["passed"]}
    reasons = tuple(text for name, text in failed.items() if name not in _RESIDUAL)
    cautions = tuple(text for name, text in failed.items() if name in _RESIDUAL)
    return Step(name="validate", findings=findings, reasons=reasons, cautions=cautions)


def tracking(done: LiveTrack, limit: float) -> Step:
    """Judge live tracking: the bench that was identified is the bench that runs.

    `done`: from `track_live`, with its lines; `limit`: acceptable model error. Returns not passed where it ended early,
    the error is beyond the limit, or a change was found.
    """
    reasons = list(ended(done.run, "tracking"))
    summary, lines = done.track.summary, done.track.lines
    if not lines or summary is None:
        return Step(name="track", reasons=tuple(reasons) or ("no line of the track came: track longer",))
    last = lines[-1]
    findings = [
        f"{summary.samples} samples in {summary.seconds_of_record:.3g} s, {summary.rejected_samples} rejected,"
        f" {done.overruns} blocks overrun, model error {last.error:.3g}, state {last.state}"
    ]
    reasons += [f"the tracker saw a change at {change.t:.3g} s: {change.why}" for change in summary.changes]
    if not last.error <= limit:
        reasons.append(
            f"the model error is {last.error:.3g} at the end, beyond {limit:g}: the bench is another one now"
        )
    if done.overruns:
        reasons.append(f"{done.overruns} blocks found the ring full: the machine is too busy to track this rate")
    return Step(
        name="track", findings=tuple(findings), reasons=tuple(reasons), numbers={"error": last.error, "limit": limit}
    )
