"""Physical parameters of a linear model from a frequency response, by maximum likelihood.

Minimises the sum of e^H C^-1 e between the measured response and that of the model, exactly sampled where the input is
held, with exact derivatives; starts come from the response itself. Consistent under feedback as far as the response is:
take it with the reference (`ambid.signals.frf`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.frequency.lines import Lines, lines
from ambid.blackbox.frequency.physical import Channels, start_values
from ambid.blackbox.frequency.physical_estimate import FrequencyEstimate, frequency_estimate
from ambid.blackbox.frequency.physical_problem import PhysicalProblem
from ambid.errors import EstimationError, nearest
from ambid.estimation.threads import one_thread
from ambid.physics.linear_model import LinearModel
from ambid.physics.parameters import Parameter
from ambid.signals.response import FrequencyResponse

MAX_DELAY = 6  # samples, searched when the delay is "auto"
_KEPT = 6  # starts that are searched a little way
_SHORT = 12  # evaluations of that
_WORTH = 10.0  # fall of twice the cost that a delay in fractions has to be worth


def greybox_frf(
    frf: FrequencyResponse,
    model: LinearModel,
    parameters: Sequence[Parameter],
    *,
    delay: float | Literal["auto"] = "auto",
    roles: Mapping[str, str] | None = None,
) -> FrequencyEstimate:
    """Estimate the physical parameters of a model from a frequency response."""
    channels = _channels(frf, model, roles or {})
    ordered = _ordered(model, parameters)
    if delay != "auto" and not (np.isfinite(delay) and delay >= 0):
        raise EstimationError(f"a delay of {delay} samples; it must be zero or positive, or 'auto'. Correct it")
    free = tuple(p for p in ordered if p.role != "fixed")
    if not free:
        raise EstimationError("no parameter is free; nothing is left to estimate. Give one the role 'free' or 'prior'")
    ln = lines(frf, len(free) + 1)
    with one_thread():
        problem, v = _raced(model, ln, channels, ordered, delay)
        cost, v, converged = _search(problem, v)
        if delay == "auto":
            problem, cost, v, converged = _with_fraction(problem, cost, v, converged)
    return frequency_estimate(frf, problem, ordered, cost, v, converged, "estimated" if delay == "auto" else "given")


def _channels(frf: FrequencyResponse, model: LinearModel, roles: Mapping[str, str]) -> Channels:
    found: dict[str, list[int]] = {"input": [], "output": []}
    for what, names, known in (("input", frf.inputs, model.inputs), ("output", frf.outputs, model.outputs)):
        for name in names:
            role = roles.get(name, name)
            if role not in known:
                raise EstimationError(
                    f"{what} {name!r} of the response is no {what} of model {model.name!r}, which has "
                    f"{', '.join(known)}.{nearest(role, list(known))} Give roles={{{name!r}: ...}}"
                )
            found[what].append(known.index(role))
    return Channels(outputs=tuple(found["output"]), inputs=tuple(found["input"]))


def _ordered(model: LinearModel, parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
    given = {p.name: p for p in parameters}
    wanted = [p.name for p in model.parameters]
    if sorted(given) != sorted(wanted) or len(parameters) != len(wanted):
        raise EstimationError(
            f"parameters {', '.join(sorted(p.name for p in parameters))} for model {model.name!r}, which has "
            f"{', '.join(wanted)}. Give each once"
        )
    return tuple(given[k] for k in wanted)


def _raced(
    model: LinearModel,
    ln: Lines,
    channels: Channels,
    parameters: tuple[Parameter, ...],
    delay: float | Literal["auto"],
) -> tuple[PhysicalProblem, Array]:
    """All starts of all delays by their cost, the best searched a little way, the best of those."""
    fixed = {p.name: p.value for p in parameters if p.role == "fixed" and p.value is not None}
    given = {p.name: p.value for p in parameters if p.value is not None}
    positive = {s.name for s in model.parameters if s.positive}
    scored: list[tuple[float, int, PhysicalProblem, Array]] = []
    for lag in [float(d) for d in range(MAX_DELAY + 1)] if delay == "auto" else [float(delay)]:
        from_data = list(start_values(model, ln, channels, lag, fixed))
        for found in [*from_data, *({**x, **given} for x in [*from_data[:3], {}] if given != fixed or not x)]:
            # noise may turn the sign of what hardly shows (a resistance at a sharp resonance): its size is a start
            values = {k: abs(x) if k in positive else x for k, x in found.items()}
            problem = _problem(model, ln, channels, parameters, fixed, values, lag)
            if problem is not None:
                v = problem.vector(values)
                cost = _cost(problem, v)
                if cost < 1e100:
                    scored.append((cost, len(scored), problem, v))
    if not scored:
        raise EstimationError(
            "no start values make a plant (positive m and L) with this response: an output is missing, or signs, units "
            "or channels are not what the model says. Check them, or give every parameter a start value"
        )
    scored.sort()
    race = []
    for _, k, problem, v in scored[:_KEPT]:
        cost, end, _ = _search(problem, v, evaluations=_SHORT)
        race.append((cost, k, problem, end))
    best = min(race)
    return best[2], best[3]


def _problem(
    model: LinearModel,
    ln: Lines,
    channels: Channels,
    parameters: tuple[Parameter, ...],
    fixed: Mapping[str, float],
    values: Mapping[str, float],
    delay: float,
) -> PhysicalProblem | None:
    """Set up from start values; None where they are no plant."""
    positive = {s.name: s.positive for s in model.parameters}
    if set(positive) - set(values) or not all(np.isfinite(x) for x in values.values()):
        return None
    if any(values[k] <= 0 for k, must in positive.items() if must):
        return None
    free, reference = tuple(p for p in parameters if p.role != "fixed"), model.references(values)
    size = [max(abs(values[p.name]), 1e-3 * reference.get(p.name, 0.0)) or 1.0 for p in free]
    return PhysicalProblem(
        model=model,
        lines=ln,
        channels=channels,
        estimated=free,
        known=dict(fixed),
        size=np.array(size),
        positive=np.array([positive[p.name] for p in free]),
        delay=delay,
    )


def _cost(problem: PhysicalProblem, v: Array) -> float:
    return float(np.sum(problem.residual(v) ** 2)) / 2


def _search(problem: PhysicalProblem, v: Array, *, evaluations: int = 200) -> tuple[float, Array, bool]:
    """Levenberg-Marquardt; cost (priors included), vector, whether it converged."""
    from scipy.optimize import least_squares

    found = least_squares(
        problem.residual, v, jac=problem.slope, method="lm", x_scale="jac", xtol=1e-11, ftol=1e-12, gtol=1e-11,
        max_nfev=evaluations,
    )  # fmt: skip
    return float(found.cost), np.asarray(found.x, dtype=np.float64), bool(found.status > 0)


def _with_fraction(
    problem: PhysicalProblem, cost: float, v: Array, converged: bool
) -> tuple[PhysicalProblem, float, Array, bool]:
    """Free the delay on both sides of the whole sample, and keep it where that is worth it."""
    best = (problem, cost, v, converged)
    sides = [problem.delay - 1, problem.delay] if problem.lines.held else [problem.delay]
    for lower in sides:
        if lower < 0:
            continue
        at = replace(problem, delay=lower, fractional=True)
        begin = (1.0 if lower < problem.delay else -1.0) if problem.lines.held else 0.0
        found = _search(at, np.append(v, begin))
        good = at.delay_at(found[1]) >= 0 and np.isfinite(found[0])
        if good and 2 * (best[1] - found[0]) > (_WORTH if best[0] is problem else 0.0):
            best = (at, *found)
    return best
