"""Physical parameters from any identified black-box model, with covariance (theory.md sec. 1).

Matrices of a state space are not unique, transfer functions are: the frequency response of the physical model is laid
through that of the black box, weighted by what the black box knows at each frequency; its whole covariance then gives
that of the parameters (minimum distance; Ljung 1999, sec. 7.4 and 9.7). What is left over tells by a chi-square test
whether the black box is this physics at all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.bearing.physical_match import Match, Spread, matched, spread
from ambid.bearing.physical_target import Target, target_of
from ambid.blackbox.fit import BlackBoxFit
from ambid.errors import EstimationError
from ambid.estimation.linear import one_thread
from ambid.estimation.parts import Check, Delay, EstimatedParameter, Parametric
from ambid.estimation.uncertainty import WEAK
from ambid.physics.linear_model import LinearModel
from ambid.physics.parameters import Parameter

_NORMAL_95 = 1.959963984540054
_MISFIT = 1e-3  # probability of the misfit below which a black box does not agree with this physics
_GROSS = 25.0  # chi-square over degrees of freedom from which nothing of it is believed


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PhysicalFit(Parametric):
    """Physical parameters that follow from a black-box model."""

    model: str  # name of the physical model
    structure: str  # black-box structure they came from
    parameters: tuple[EstimatedParameter, ...]  # in the model's order, SI
    covariance_names: tuple[str, ...]  # estimated parameters
    covariance: Array  # (n, n), SI, by the delta method, priors included; widened by the misfit where there is one
    delay: Delay  # of the inputs
    misfit: Check  # whether the black box can be this physics: chi-square of what the match leaves over
    band_hz: tuple[float, float]  # frequencies between which the black box was used: where it knows its own response
    singular_values: Array  # (n,), 1 / relative standard deviation along each direction, largest first
    # direction with the smallest singular value: share of each parameter, largest in magnitude 1
    weakest: Mapping[str, float]
    warnings: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether the black box can be this physics and shows every parameter."""
        return self.misfit.passed and all(p.identifiable for p in self.parameters)


def physical_parameters(
    fit: BlackBoxFit,
    model: LinearModel,
    parameters: Sequence[Parameter],
    *,
    delay: float | Literal["auto"] = "auto",
    roles: Mapping[str, str] | None = None,
    band_hz: tuple[float, float] | None = None,
) -> PhysicalFit:
    """Return the physical parameters of a black-box model.

    Parameters
    ----------
    fit : BlackBoxFit
        Any structure with a covariance; discrete, or in continuous time.
    model : LinearModel
    parameters : sequence of Parameter
        One for each of the model's: free, fixed, or with a prior.
    delay : float or "auto"
        Delay of the inputs in samples beyond the hold; "auto": whole samples from 0 to 6, and a fraction where the
        response shows one; the black box's own where it is in continuous time or has no number to spare.
    roles : Mapping[str, str], optional
        Role -> channel; by default by name, else by unit where only one channel has it.
    band_hz : (float, float), optional
        Use no frequencies outside; by default all that the black box knows to a third of its response.

    Returns
    -------
    PhysicalFit
        See ``passed``.

    Raises
    ------
    EstimationError
        If the black box lacks inputs, outputs, poles or a covariance, or no physical plant comes near it.
    """
    free = [p for p in parameters if p.role != "fixed"]
    missing = [p.name for p in model.parameters if p.name not in {q.name for q in parameters}]
    if missing:
        raise EstimationError(f"nothing is said of parameter {missing[0]!r} of {model.name!r}. Give it, free or fixed")
    if not free:
        raise EstimationError("every parameter is fixed; nothing is left to find. Free at least one")
    with one_thread():
        return _found(fit, model, parameters, free, delay, roles or {}, band_hz)


def _found(
    fit: BlackBoxFit,
    model: LinearModel,
    parameters: Sequence[Parameter],
    free: Sequence[Parameter],
    delay: float | Literal["auto"],
    roles: Mapping[str, str],
    band_hz: tuple[float, float] | None,
) -> PhysicalFit:
    """Match, and judge the match."""
    target = target_of(fit, model, roles, band_hz)
    if target.rank < len(free):
        raise EstimationError(
            f"the {fit.structure} model has {target.rank} independent numbers for {len(free)} free parameters. Fix "
            "parameters, raise its order, or excite more"
        )
    found = matched(target, model, parameters, delay)
    own = target.dt is None or target.rank <= len(free)
    return _result(fit, model, parameters, target, found, delay_how="given" if delay != "auto" or own else "estimated")


def agreement(found: PhysicalFit, names: Sequence[str], values: Array, covariance: Array) -> Check:
    """Compare with another estimate of the same parameters, as that of the grey box.

    `values`: (n,), SI; `covariance`: (n, n), SI. Returns wald test of the difference against the sum of both
    covariances: wide for two estimates from one record, whose errors go together.
    """
    from scipy.stats import chi2

    shared = [k for k in found.covariance_names if k in names]
    if not shared:
        raise EstimationError("the two estimates share no estimated parameter; nothing can be compared. Free the same")
    here, there = [found.covariance_names.index(k) for k in shared], [list(names).index(k) for k in shared]
    difference = np.array([found.values[k] for k in shared]) - np.asarray(values)[there]
    total = found.covariance[np.ix_(here, here)] + np.asarray(covariance)[np.ix_(there, there)]
    sd = np.sqrt(np.diag(total))
    size, ways = np.linalg.eigh(total / np.outer(sd, sd))
    statistic = float(np.sum((ways.T @ (difference / sd)) ** 2 / np.maximum(size, 1e-12)))
    p = float(chi2.sf(statistic, len(shared)))
    worst = max(zip(shared, np.abs(difference) / sd, strict=True), key=lambda pair: pair[1])
    return Check(
        passed=p > _MISFIT,
        p=p,
        detail=f"black box and other estimate differ by chi-square {statistic:.3g} in {len(shared)} parameters "
        f"(p = {p:.2g}); most in {worst[0]}, by {worst[1]:.2g} joint standard deviations",
        values={"statistic": statistic, "parameters": float(len(shared))},
    )


def _result(
    fit: BlackBoxFit,
    model: LinearModel,
    parameters: Sequence[Parameter],
    target: Target,
    found: Match,
    *,
    delay_how: Literal["estimated", "given"],
) -> PhysicalFit:
    """Covariance, misfit and identifiability of a finished match."""
    names, theta, n = found.names, found.theta, len(found.names)
    own = spread(target, found)
    check, factor = _misfit(fit, model, target, found, own)
    whole = own.covariance * factor**2 * _roughness(target)
    reference = model.references(theta)
    scale = np.array([max(abs(theta[k]), reference.get(k, 0.0), 1e-300) for k in names])
    relative = whole[:n, :n] / np.outer(scale, scale)
    sizes, ways = np.linalg.eigh(relative)
    sd = dict(zip(names, np.sqrt(np.diag(whole)).tolist(), strict=False))
    near = factor**2 < _GROSS
    seen = {k: near and bool(r < WEAK**2) for k, r in zip(names, np.diag(relative), strict=True)}
    weak = ways[:, -1] / ways[np.argmax(np.abs(ways[:, -1])), -1]
    warnings = [] if check.passed else [check.detail]
    warnings += [f"the black box fails its own check: {c.detail}" for c in fit.checks.values() if not c.passed]
    hidden = [k for k in names if not relative[names.index(k), names.index(k)] < WEAK**2]
    if hidden:
        warnings.append(f"the black box does not show {', '.join(hidden)}: relative sd above {WEAK:.0%}")
    samples = found.delay / fit.dt
    steps = int(np.floor(samples + 1e-9))
    return PhysicalFit(
        model=model.name,
        structure=fit.structure,
        parameters=tuple(_parameter(p, theta, sd, seen) for p in _ordered(model, parameters)),
        covariance_names=names,
        covariance=whole[:n, :n],
        delay=Delay(
            samples=steps,
            fraction=max(0.0, samples - steps),
            sd=float(np.sqrt(whole[-1, -1])) / fit.dt if found.delay_free else None,
            how=delay_how,
        ),
        misfit=check,
        band_hz=target.band_hz,
        singular_values=1 / np.sqrt(np.maximum(sizes, 1e-300)),
        weakest=dict(zip(names, weak.tolist(), strict=True)),
        warnings=(*(w for w in fit.warnings if "biased" in w or "converge" in w), *warnings),
    )


def _roughness(target: Target) -> float:
    """Factor on variances from few groups of a jackknife: the variance of Student's t."""
    freedom = np.inf if target.groups is None else max(target.groups - 1.0, 3.0)
    return 1.0 if np.isinf(freedom) else freedom / (freedom - 2.0)


def _misfit(fit: BlackBoxFit, model: LinearModel, target: Target, found: Match, own: Spread) -> tuple[Check, float]:
    """Test of what the match leaves over, and by how much standard deviations widen.

    A sum of chi-squares of several sizes is one chi-square by its mean and variance (Satterthwaite 1946); where the
    sizes come from a jackknife, it is judged by Fisher's F.
    """
    from scipy.stats import chi2, f

    if target.rank - len(found.names) - found.delay_free + found.n_priors <= 0:
        return Check(passed=True, detail="the black box has no number left to test the physics by", p=None), 1.0
    mean = float(np.sum(own.left))
    freedom = mean**2 / float(np.sum(own.left**2))
    left = found.criterion / mean * freedom
    if target.groups is None:
        p = float(chi2.sf(left, freedom))
    else:
        p = float(f.sf(left / freedom, freedom, freedom * (target.groups - 1)))
    text = f"chi-square {left:.4g} for {freedom:.3g} degrees of freedom (p = {p:.2g})"
    passed, factor = p > _MISFIT, max(1.0, float(np.sqrt(left / freedom)))
    if passed:
        detail = f"the {fit.structure} model agrees with {model.name!r}: {text}"
    elif factor**2 < _GROSS:
        detail = (
            f"the {fit.structure} model agrees with {model.name!r} only roughly: {text}. Standard deviations are "
            f"widened by {factor:.2g}; other orders or the grey-box method may do better"
        )
    else:
        detail = (
            f"the {fit.structure} model is not a {model.name!r} plant: {text}. Other orders (a delay takes poles too), "
            "a structure that stands feedback, or the grey-box method"
        )
    values = {"statistic": left, "freedom": freedom}
    return Check(passed=passed, detail=detail, p=p, values=values), factor


def _ordered(model: LinearModel, parameters: Sequence[Parameter]) -> list[Parameter]:
    by_name = {p.name: p for p in parameters}
    return [by_name[p.name] for p in model.parameters]


def _parameter(
    p: Parameter, theta: Mapping[str, float], sd: Mapping[str, float], seen: Mapping[str, bool]
) -> EstimatedParameter:
    value, spread = theta[p.name], sd.get(p.name, 0.0)
    return EstimatedParameter(
        name=p.name,
        unit=p.unit,
        value=value,
        sd=spread,
        ci95=(value - _NORMAL_95 * spread, value + _NORMAL_95 * spread),
        role=p.role,
        identifiable=seen.get(p.name, True),
    )
