"""Physical parameters as they come out of a frequency response, with covariance, identifiability and checks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.frequency.lines import Lines
from ambid.blackbox.frequency.physical_problem import PhysicalProblem
from ambid.estimation.estimate import Check, Continuous, Delay, EstimatedParameter, parameter_named
from ambid.estimation.linear import directions
from ambid.estimation.uncertainty import WEAK
from ambid.physics.parameters import Parameter
from ambid.signals.response import FrequencyResponse

_NORMAL_95 = 1.959963984540054


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrequencyEstimate:
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
    checks: Mapping[str, Check]  # ``cost`` and ``identifiable``
    warnings: tuple[str, ...] = ()
    # singular values of the scaled information matrix and the weakest direction
    information: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    record: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def values(self) -> dict[str, float]:
        """All parameter values, SI."""
        return {p.name: p.value for p in self.parameters}

    @property
    def passed(self) -> bool:
        """Whether the search converged and every check passed."""
        return self.status == "converged" and all(c.passed for c in self.checks.values())

    def parameter(self, name: str) -> EstimatedParameter:
        """Return one parameter by name."""
        return parameter_named(self.parameters, name)


def frequency_estimate(
    frf: FrequencyResponse,
    problem: PhysicalProblem,
    parameters: tuple[Parameter, ...],
    cost: float,
    v: Array,
    converged: bool,
    how: Literal["estimated", "given"],
) -> FrequencyEstimate:
    """Put an estimate together.

    `parameters`: what was known before, in the model's order; `cost`: at `v`, priors included; `v`: (n_vector,); `how`:
    the delay.
    """
    ln, n = problem.lines, problem.size.size
    r, J = problem.residual(v), problem.slope(v, by_parameters=True)
    n_priors = J.shape[0] - 2 * ln.n_lines * ln.entries
    data = J[: J.shape[0] - n_priors] / np.sqrt(ln.widening)
    whole = directions(np.vstack([data, J[J.shape[0] - n_priors :]])).inverse()
    check = ln.verdict(cost, v.size, n_priors)
    theta = problem.theta(v)
    covariance = whole[:n, :n]
    if not check.passed:
        covariance = _robust(ln, whole, J, r)[:n, :n]
    names = tuple(p.name for p in problem.estimated)
    reference = problem.model.references(theta)
    scale = np.array([max(abs(theta[k]), reference.get(k, 0.0), 1e-300) for k in names])
    sizes, axes = np.linalg.eigh(covariance / np.outer(scale, scale))
    weakest = axes[:, -1] / axes[np.argmax(np.abs(axes[:, -1])), -1]
    sd = np.sqrt(np.diag(covariance))
    seen = {k: converged and bool(s < WEAK) for k, s in zip(names, sd / scale, strict=True)}
    alone = np.sqrt(np.diag(directions(data).inverse())[:n])
    spread, own = (dict(zip(names, x.tolist(), strict=True)) for x in (sd, alone))
    unseen = [k for k in names if not seen[k]]
    checks = {
        "cost": check,
        "identifiable": Check(
            passed=not unseen,
            detail=f"not shown by these lines: {', '.join(unseen)}. Excite another band, or give a prior"
            if unseen
            else "every estimated parameter has a relative standard deviation under 25 %",
        ),
    }
    warnings = [*frf.warnings, *(f"{k}: {c.detail}" for k, c in checks.items() if not c.passed)]
    if not converged:
        warnings.insert(0, "the search did not converge: treat the numbers as a first guess")
    total = problem.delay_at(v)
    space = problem.model.matrices(theta)
    return FrequencyEstimate(
        status="converged" if converged else "stalled",
        model=problem.model.name,
        parameters=tuple(_parameter(p, theta[p.name], spread, seen, own) for p in parameters),
        covariance_names=names,
        covariance=covariance,
        covariance_method="information" if check.passed else "robust",
        delay=Delay(
            samples=int(np.floor(total)),
            fraction=total - float(np.floor(total)),
            sd=float(np.sqrt(whole[-1, -1])) if problem.fractional else None,
            how=how,
        ),
        continuous=Continuous(
            states=problem.model.states,
            A=space.A,
            B=space.B,
            C=space.C,
            poles=np.linalg.eigvals(space.A).astype(np.complex128),
        ),
        checks=checks,
        warnings=tuple(warnings),
        information={
            "singular_values": (1 / np.sqrt(np.maximum(sizes, 1e-300))).tolist(),
            "weakest_direction": dict(zip(names, weakest.tolist(), strict=True)),
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


def _parameter(
    p: Parameter, value: float, sd: Mapping[str, float], seen: Mapping[str, bool], alone: Mapping[str, float]
) -> EstimatedParameter:
    spread = sd.get(p.name, 0.0)
    share = float(1 / (1 + (alone[p.name] / p.sd) ** 2)) if p.role == "prior" and p.sd else None
    return EstimatedParameter(
        name=p.name,
        unit=p.unit,
        value=value,
        sd=spread,
        ci95=(value - _NORMAL_95 * spread, value + _NORMAL_95 * spread),
        role=p.role,
        identifiable=seen.get(p.name, True),
        data_share=share,
    )
