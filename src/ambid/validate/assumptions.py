"""What was taken for known, held against the record: fixed values, priors, the delay, the length of the record."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ambid.bearing.multistart import MAX_DELAY
from ambid.bearing.uncertainty import Uncertainty
from ambid.estimation.estimate import Check
from ambid.estimation.likelihood import Fit, freed
from ambid.estimation.linear import directions

_P_LEAST = 1e-3
_FAR = 3.3  # standard deviations between a prior and the record


def assumption_checks(fit: Fit, known: Uncertainty, delay_how: Literal["estimated", "given"]) -> dict[str, Check]:
    """Check what was taken for known.

    Returns ``fixed_agree``, ``priors_agree``, ``delay_in_range``, ``long_enough``.
    """
    return {
        "fixed_agree": _fixed_agree(fit),
        "priors_agree": _priors_agree(fit),
        "delay_in_range": _delay_in_range(fit, delay_how),
        "long_enough": _long_enough(known),
    }


def _fixed_agree(fit: Fit) -> Check:
    """Score test of each fixed value: would the record, if asked, put it elsewhere?"""
    from scipy.special import chdtrc

    units = {p.name: p.unit for p in fit.problem.model.parameters}
    worst, detail = 1.0, "the record does not speak against any fixed value"
    for name, value in fit.problem.known.items():
        statistic, there = freed(fit, name)
        p = float(chdtrc(1, statistic))
        if p < min(worst, _P_LEAST):
            detail = (
                f"the record speaks against {name} = {value:.4g} {units[name]}, which was fixed, and wants a "
                f"{'larger' if there > value else 'smaller'} value (p = {p:.2g}). Check that value, or free it"
            )
        worst = min(worst, p)
    return Check(passed=worst >= _P_LEAST, p=worst, detail=detail)


def _priors_agree(fit: Fit) -> Check:
    """Each prior against where one Newton step without it would take its parameter."""
    problem = fit.problem
    worst, name = 0.0, ""
    for row, r in zip(fit.J_prior, fit.r_prior, strict=True):
        j = int(np.argmax(np.abs(row)))
        if j >= problem.n_physical:
            continue
        others = fit.J_prior[fit.J_prior[:, j] == 0.0]
        # at the optimum the pull of the prior is what the data and the other priors hold against
        without = directions(np.vstack([fit.J, others])).inverse()
        step, variance = float(without[j] @ row) * float(r), float(without[j, j])
        size = problem.magnitude[j]
        # r = (value - mean) / sd, so that the data alone would be at mean + r sd + step
        far = abs(step * size + float(r) * problem.prior_sd[j])
        far /= float(np.hypot(np.sqrt(variance) * size, problem.prior_sd[j]))
        if not name or far > worst:
            worst, name = far, problem.estimated[j]
    if worst > _FAR:
        detail = f"the record puts {name} {worst:.1f} sd away from its prior: one of them is wrong. Check the prior"
    else:
        detail = "priors and record agree" if name else "there are no priors"
    return Check(passed=worst <= _FAR, values={"largest_sd": worst}, detail=detail)


def _delay_in_range(fit: Fit, how: Literal["estimated", "given"]) -> Check:
    total = fit.problem.delay_samples(fit.vector)
    inside = how == "given" or total < 2 * MAX_DELAY
    doubt = "" if inside else ". That is long for a bench: check the columns, or give channels.<input>.delay"
    return Check(passed=inside, values={"samples": total}, detail=f"the input acts {total:.3g} samples late{doubt}")


def _long_enough(known: Uncertainty) -> Check:
    enough = known.widening == 1.0
    detail = (
        "the record is long enough to tell the noise levels"
        if enough
        else "the record is too short to tell the noise levels: standard deviations are widened by up to "
        f"{known.widening:.2g}. Record longer"
    )
    return Check(passed=enough, values={"widening": known.widening}, detail=detail)
