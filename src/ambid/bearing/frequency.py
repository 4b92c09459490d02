"""Physical parameters of a linear model from a frequency response, by maximum likelihood.

Minimises the sum of e^H C^-1 e against the model, exactly sampled where the input is held. Consistent under feedback as
far as the response is: take it with the reference (`ambid.signals.response`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.bearing.multistart import Moments, weak_form_values
from ambid.bearing.physical_target import physical_response
from ambid.blackbox.frequency import Lines, check_lines
from ambid.errors import EstimationError, nearest
from ambid.estimation.estimate import Check, Continuous, Delay, EstimatedParameter, Judged, Parametric
from ambid.estimation.linear import directions, one_thread
from ambid.estimation.result import Linear
from ambid.estimation.uncertainty import WEAK, natural_sizes, weakest_direction
from ambid.physics.linear_model import LinearModel, Parameter
from ambid.signals.response import FrequencyResponse

Complex = NDArray[np.complex128]

_WRONG = 0.05  # of the response's power that a model with too large a cost may leave unexplained
_COPIES = 2000  # rows for the bands of the weak form, which count in parts of a long spectrum


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Channels:
    """Which inputs and outputs of the model were measured."""

    outputs: tuple[int, ...]  # rows of the model's C, in the order of the response's outputs
    inputs: tuple[int, ...]  # columns of its B


def response(
    model: LinearModel,
    theta: Mapping[str, float],
    names: Sequence[str],
    ln: Lines,
    channels: Channels,
    delay: float,
    *,
    moving: bool = False,
) -> tuple[Complex, Complex]:
    """Return the model's response (n_frequencies, n_outputs, n_inputs) at `theta` (SI), and its derivative by
    parameters `names`, on one more axis, where `moving` with that by the delay (samples) last.
    """
    physical = physical_response(
        model, theta, ln.omega, dt=ln.dt if ln.held else None, delay_s=delay * ln.dt, along=names, with_delay=moving
    )
    G, slope = (x[:, channels.outputs][:, :, channels.inputs] for x in physical)
    if moving:
        slope[..., -1] *= ln.dt
    return G, slope


def start_values(
    model: LinearModel, ln: Lines, channels: Channels, delay: float, known: Mapping[str, float]
) -> Iterator[dict[str, float]]:
    """Yield start values by regression of the equations of motion over bands of lines, as `weak_form_values`, with
    input 1 (times its hold) and outputs G: all parameters, SI, not always a plant; none where an output it needs was
    not measured.
    """
    copies = max(1, _COPIES // ln.n_lines)
    omega = np.repeat(ln.omega, copies)
    angle = omega * ln.dt
    hold = np.sinc(angle / (2 * np.pi)) * np.exp(-0.5j * angle) if ln.held else np.ones(omega.size, dtype=np.complex128)
    signals = {model.inputs[channels.inputs[0]]: (hold, 1j * omega * hold, -(omega**2) * hold)}
    noise = {}
    for j, k in enumerate(channels.outputs):
        g = np.repeat(ln.G[:, j, 0], copies)
        signals[model.outputs[k]] = (g, 1j * omega * g, -(omega**2) * g)
        noise[model.outputs[k]] = float(np.sqrt(np.mean(ln.sd[:, j, 0] ** 2)))
    if set(model.outputs) - set(signals):
        return
    moments = Moments(omega=omega, signals=signals)
    for _, values in weak_form_values(model.name, moments, noise, [delay], 1.0 / ln.dt, known):
        yield values


_FAR = 1e100  # standard deviations: worse than anything


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PhysicalProblem:
    """What is estimated, and how a vector of order one means it: logarithms of what is positive, the rest over
    sizes.
    """

    model: LinearModel
    lines: Lines
    channels: Channels
    estimated: tuple[Parameter, ...]
    known: Mapping[str, float]  # the others, SI
    # (n_estimated,), SI
    size: Array  # SI
    positive: NDArray[np.bool_]  # (n_estimated,), bool, what is searched as a logarithm
    # the lower whole one where `fractional` and the input is held
    delay: float  # samples, or the lower whole one of a fraction that is estimated
    fractional: bool = False  # whether the delay is estimated as a real number, last in the vector

    def theta(self, v: Array) -> dict[str, float]:
        """Return all physical parameters in SI."""
        x = v[: self.size.size]
        values = self.size * np.where(self.positive, np.exp(np.clip(np.where(self.positive, x, 0.0), -50.0, 50.0)), x)
        return {**self.known, **{p.name: float(x) for p, x in zip(self.estimated, values, strict=True)}}

    def delay_at(self, v: Array) -> float:
        """Return the delay in samples."""
        if not self.fractional:
            return self.delay
        return self.delay + (float(1 / (1 + np.exp(-v[-1]))) if self.lines.held else float(v[-1]))

    def vector(self, values: Mapping[str, float]) -> Array:
        """Return the vector (n_estimated,) of parameters in SI, without a delay."""
        x = np.array([values[p.name] for p in self.estimated]) / self.size
        return np.where(self.positive, np.log(np.maximum(x, 1e-300)), x)

    def residual(self, v: Array) -> Array:
        """Return whitened model - measured, then the priors', (n_rows,)."""
        n_rows = 2 * self.lines.n_lines * self.lines.entries
        try:
            with np.errstate(all="ignore"):  # a step too far overflows: the search turns back from what is not finite
                G, _ = response(self.model, self.theta(v), (), self.lines, self.channels, self.delay_at(v))
                rows = self.lines.whitened(G - self.lines.G)
        except (np.linalg.LinAlgError, ValueError):
            rows = np.full(n_rows, _FAR)
        return np.concatenate([np.where(np.isfinite(rows), rows, _FAR), self._prior(v)])

    def slope(self, v: Array, *, by_parameters: bool = False) -> Array:
        """Return the derivative of `residual` (n_rows, n_vector), or `by_parameters` that by SI parameters and delay in
        samples.
        """
        theta, names = self.theta(v), [p.name for p in self.estimated]
        _, d = response(self.model, theta, names, self.lines, self.channels, self.delay_at(v), moving=self.fractional)
        J = self.lines.whitened(d)
        rows = np.zeros((sum(p.role == "prior" for p in self.estimated), J.shape[1]))
        for row, (j, p) in zip(rows, ((j, p) for j, p in enumerate(self.estimated) if p.role == "prior"), strict=True):
            row[j] = 1.0 / float(p.sd or np.inf)
        J = np.vstack([J, rows])
        if not by_parameters:
            n = self.size.size
            J[:, :n] *= np.where(self.positive, [theta[k] for k in names], self.size)
            if self.fractional and self.lines.held:
                part = self.delay_at(v) - self.delay
                J[:, n] *= part * (1 - part)
        return J

    def _prior(self, v: Array) -> Array:
        theta = self.theta(v)
        return np.array([(theta[p.name] - float(p.value or 0.0)) / float(p.sd or np.inf)
                         for p in self.estimated if p.role == "prior"])  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class FrequencyEstimate(Parametric, Judged, Linear):
    """Physical parameters from a frequency response."""

    status: Literal["converged", "stalled"]
    model: str
    parameters: tuple[EstimatedParameter, ...]  # in the model's order
    covariance_names: tuple[str, ...]  # estimated parameters, order of `covariance`
    covariance: Array  # (n, n), SI
    # robust (scatter of the scores over the lines, never smaller) where the check ``cost`` fails
    covariance_method: Literal["information", "robust"]
    delay: Delay  # of the inputs, in samples
    continuous: Continuous
    checks: Mapping[str, Check]  # ``cost``, ``response_fit`` and ``identifiable``
    warnings: tuple[str, ...] = ()
    # singular values of the scaled information matrix and the weakest direction
    information: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    record: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))


def frequency_estimate(
    frf: FrequencyResponse,
    problem: PhysicalProblem,
    parameters: tuple[Parameter, ...],
    cost: float,
    v: Array,
    converged: bool,
    how: Literal["estimated", "given"],
) -> FrequencyEstimate:
    """Put an estimate together; `parameters`: what was known before, in the model's order; `cost`: at `v`, priors
    included; `how`: the delay.
    """
    ln, n = problem.lines, problem.size.size
    r, J = problem.residual(v), problem.slope(v, by_parameters=True)
    n_priors = J.shape[0] - 2 * ln.n_lines * ln.entries
    data = J[: J.shape[0] - n_priors] / np.sqrt(ln.widening)
    whole = directions(np.vstack([data, J[J.shape[0] - n_priors :]])).inverse()
    check = ln.verdict(cost, v.size, n_priors)
    # each line weighted by its variance
    left = 2 * cost / max(float(np.sum(ln.whitened(ln.G) ** 2)), 1e-300)
    fits = check.passed or left < _WRONG
    theta = problem.theta(v)
    covariance = whole[:n, :n]
    if not check.passed:
        covariance = _robust(ln, whole, J, r)[:n, :n]
    names = tuple(p.name for p in problem.estimated)
    scale = natural_sizes(names, theta, problem.model.references(theta))
    singular_values, weakest = weakest_direction(names, covariance, scale)
    sd = np.sqrt(np.diag(covariance))
    shows = {k: converged and bool(s < WEAK) for k, s in zip(names, sd / scale, strict=True)}
    alone = np.sqrt(np.diag(directions(data).inverse())[:n])
    spread, own = (dict(zip(names, x.tolist(), strict=True)) for x in (sd, alone))
    unseen = [k for k in names if not shows[k]]
    checks = {
        "cost": check,
        "response_fit": Check(
            passed=fits,
            detail=f"the model explains all but {100 * left:.2g} % of the response's power"
            + ("" if fits else ". Check columns, hold and reference, or use 'ambid identify'"),
        ),
        "identifiable": Check(
            passed=not unseen,
            detail=f"not identifiable from these lines: {', '.join(unseen)}. Excite another band, or give a prior"
            if unseen
            else "every estimated parameter has a relative standard deviation under 25 %",
        ),
    }
    warnings = [*frf.warnings, *(f"{k}: {c.detail}" for k, c in checks.items() if not c.passed)]
    if not converged:
        warnings.insert(0, "the search did not converge: treat the values as a first guess")
    return FrequencyEstimate(
        status="converged" if converged else "stalled",
        model=problem.model.name,
        parameters=tuple(EstimatedParameter.of(p, theta, spread, shows, own) for p in parameters),
        covariance_names=names,
        covariance=covariance,
        covariance_method="information" if check.passed else "robust",
        delay=Delay.of(problem.delay_at(v), float(np.sqrt(whole[-1, -1])) if problem.fractional else None, how),
        continuous=Continuous.of(problem.model, theta),
        checks=checks,
        warnings=tuple(warnings),
        information={
            "singular_values": singular_values.tolist(),
            "weakest_direction": weakest,
        },
        record={"lines": ln.n_lines, "rate_hz": frf.rate_hz, "method": frf.method, "hold": frf.hold},
    )


def _robust(ln: Lines, whole: Array, J: Array, r: Array) -> Array:
    """Covariance from the scatter of the scores over the lines, with standard deviations never below those of noise."""
    rows = 2 * ln.n_lines * ln.entries
    scores = (J[:rows] * r[:rows, None]).reshape(2, ln.n_lines, ln.entries, -1).sum(axis=(0, 2))
    half = scores @ (whole / ln.widening)
    own = half.T @ half * ln.alike
    larger = np.maximum(1.0, np.sqrt(np.diag(whole) / np.maximum(np.diag(own), 1e-300)))
    return np.asarray(own * np.outer(larger, larger))


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
    ordered = _order_parameters(model, parameters)
    if delay != "auto" and not (np.isfinite(delay) and delay >= 0):
        raise EstimationError(f"a delay of {delay} samples; it must be zero or positive, or 'auto'. Correct it")
    free = tuple(p for p in ordered if p.role != "fixed")
    if not free:
        raise EstimationError("no parameter is free; nothing is left to estimate. Give one the role 'free' or 'prior'")
    ln = check_lines(frf, len(free) + 1)
    with one_thread():
        problem, v = _race(model, ln, channels, ordered, delay)
        cost, v, converged = _search(problem, v)
        if delay == "auto":
            problem, cost, v, converged = _free_fraction(problem, cost, v, converged)
    return frequency_estimate(frf, problem, ordered, cost, v, converged, "estimated" if delay == "auto" else "given")


def _channels(frf: FrequencyResponse, model: LinearModel, roles: Mapping[str, str]) -> Channels:
    places: dict[str, list[int]] = {"input": [], "output": []}
    for what, names, known in (("input", frf.inputs, model.inputs), ("output", frf.outputs, model.outputs)):
        for name in names:
            role = roles.get(name, name)
            if role not in known:
                raise EstimationError(
                    f"{what} {name!r} of the response is no {what} of model {model.name!r}, which has "
                    f"{', '.join(known)}.{nearest(role, list(known))} Give roles={{{name!r}: ...}}"
                )
            places[what].append(known.index(role))
    return Channels(outputs=tuple(places["output"]), inputs=tuple(places["input"]))


def _order_parameters(model: LinearModel, parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
    entries = {p.name: p for p in parameters}
    wanted = [p.name for p in model.parameters]
    if sorted(entries) != sorted(wanted) or len(parameters) != len(wanted):
        raise EstimationError(
            f"parameters {', '.join(sorted(p.name for p in parameters))} for model {model.name!r}, which has "
            f"{', '.join(wanted)}. Give each once"
        )
    return tuple(entries[k] for k in wanted)


def _race(
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

    solution = least_squares(
        problem.residual, v, jac=problem.slope, method="lm", x_scale="jac", xtol=1e-11, ftol=1e-12, gtol=1e-11,
        max_nfev=evaluations,
    )  # fmt: skip
    return float(solution.cost), np.asarray(solution.x, dtype=np.float64), bool(solution.status > 0)


def _free_fraction(
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
        freed = _search(at, np.append(v, begin))
        good = at.delay_at(freed[1]) >= 0 and np.isfinite(freed[0])
        if good and 2 * (best[1] - freed[0]) > (_WORTH if best[0] is problem else 0.0):
            best = (at, *freed)
    return best
