"""Physical parameters from any identified black-box model, with covariance (theory.md sec. 1).

The physical model's frequency response is laid through the black box's, weighted by what that knows at each frequency;
its whole covariance gives the parameters' (minimum distance; Ljung 1999, sec. 7.4 and 9.7), and a chi-square test of
what is left tells whether it is this physics at all. Starts: `ambid.bearing.multistart`'s regressions on the response;
search: SciPy's Levenberg-Marquardt with exact derivatives.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.bearing.multistart import weak_form_values
from ambid.bearing.physical_target import Target, physical_response, target_of
from ambid.blackbox.fit import BlackBoxFit
from ambid.errors import EstimationError
from ambid.estimation.estimate import Check, Delay, EstimatedParameter, Parametric
from ambid.estimation.linear import one_thread
from ambid.estimation.result import Reason, Result
from ambid.estimation.uncertainty import WEAK, natural_sizes, p_text, weakest_direction
from ambid.physics.linear_model import LinearModel, Parameter

_MISFIT = 1e-3  # probability of the misfit below which a black box does not agree with this physics
_GROSS = 25.0  # chi-square over degrees of freedom from which nothing of it is believed


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class PhysicalFit(Parametric, Result):
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
    def reasons(self) -> tuple[Reason, ...]:
        """A black box that cannot be this physics, and parameters that it does not show."""
        v = self.misfit.values
        gross = bool(v) and v["statistic"] >= _GROSS * v["freedom"]
        reasons = [] if self.misfit.passed else [Reason(check="misfit", text=self.misfit.detail, grave=gross)]
        unseen = ", ".join(p.name for p in self.parameters if not p.identifiable)
        if unseen:
            text = f"not identifiable from the fit: {unseen}. Excite more, or give a prior"
            reasons.append(Reason(check="identifiable", text=text))
        return tuple(reasons)


def physical_parameters(
    fit: BlackBoxFit,
    model: LinearModel,
    parameters: Sequence[Parameter],
    *,
    delay: float | Literal["auto"] = "auto",
    roles: Mapping[str, str] | None = None,
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
        raise EstimationError(f"parameter {missing[0]!r} of {model.name!r} is missing. Give it, free or fixed")
    if not free:
        raise EstimationError("every parameter is fixed, and none is left to estimate. Free at least one")
    with one_thread():
        return _find(fit, model, parameters, free, delay, roles or {})


def _find(
    fit: BlackBoxFit,
    model: LinearModel,
    parameters: Sequence[Parameter],
    free: Sequence[Parameter],
    delay: float | Literal["auto"],
    roles: Mapping[str, str],
) -> PhysicalFit:
    """Match, and judge the match."""
    target = target_of(fit, model, roles)
    if target.rank < len(free):
        raise EstimationError(
            f"the {fit.structure} model has {target.rank} independent numbers for {len(free)} free parameters. Fix "
            "parameters, raise its order, or excite more"
        )
    best = match(target, model, parameters, delay)
    own = target.dt is None or target.rank <= len(free)
    return _result(fit, model, parameters, target, best, delay_how="given" if delay != "auto" or own else "estimated")


def _result(
    fit: BlackBoxFit,
    model: LinearModel,
    parameters: Sequence[Parameter],
    target: Target,
    best: Match,
    *,
    delay_how: Literal["estimated", "given"],
) -> PhysicalFit:
    """Covariance, goodness of fit and identifiability of a finished match."""
    names, theta, n = best.names, best.theta, len(best.names)
    own = spread(target, best)
    check, factor = _misfit(fit, model, target, best, own)
    whole = own.covariance * factor**2 * _roughness(target)
    scale = natural_sizes(names, theta, model.references(theta))
    singular_values, weakest = weakest_direction(names, whole[:n, :n], scale)
    relative = np.diag(whole)[:n] / scale**2
    sd = dict(zip(names, np.sqrt(np.diag(whole)).tolist(), strict=False))
    near = factor**2 < _GROSS
    shows = {k: near and bool(r < WEAK**2) for k, r in zip(names, relative, strict=True)}
    warnings = [] if check.passed else [check.detail]
    warnings += [
        f"a check of the {fit.structure} model failed: {c.detail}" for c in fit.checks.values() if not c.passed
    ]
    hidden = [k for k, r in zip(names, relative, strict=True) if not r < WEAK**2]
    if hidden:
        warnings.append(f"not identifiable from the {fit.structure} model (sd above {WEAK:.0%}): {', '.join(hidden)}")
    return PhysicalFit(
        model=model.name,
        structure=fit.structure,
        parameters=tuple(EstimatedParameter.of(p, theta, sd, shows) for p in _ordered(model, parameters)),
        covariance_names=names,
        covariance=whole[:n, :n],
        delay=Delay.of(
            best.delay / fit.dt, float(np.sqrt(whole[-1, -1])) / fit.dt if best.delay_free else None, delay_how
        ),
        misfit=check,
        band_hz=target.band_hz,
        singular_values=singular_values,
        weakest=weakest,
        warnings=(*(w for w in fit.warnings if "biased" in w or "converge" in w), *warnings),
    )


def _roughness(target: Target) -> float:
    """Factor on variances from few groups of a jackknife: the variance of Student's t."""
    freedom = np.inf if target.groups is None else max(target.groups - 1.0, 3.0)
    return 1.0 if np.isinf(freedom) else freedom / (freedom - 2.0)


def _misfit(fit: BlackBoxFit, model: LinearModel, target: Target, best: Match, own: Spread) -> tuple[Check, float]:
    """Test of what the match leaves over, and by how much standard deviations widen: a sum of chi-squares of several
    sizes is one by mean and variance (Satterthwaite 1946), judged by Fisher's F where the sizes come from a jackknife.
    """
    from scipy.stats import chi2, f

    if target.rank - len(best.names) - best.delay_free + best.n_priors <= 0:
        return Check(passed=True, detail="no degrees of freedom are left to test the physical model", p=None), 1.0
    mean = float(np.sum(own.left))
    freedom = mean**2 / float(np.sum(own.left**2))
    left = best.criterion / mean * freedom
    if target.groups is None:
        p = float(chi2.sf(left, freedom))
    else:
        p = float(f.sf(left / freedom, freedom, freedom * (target.groups - 1)))
    text = f"chi-square {left:.4g} with {freedom:.3g} degrees of freedom, {p_text(p)}"
    passed, factor = p > _MISFIT, max(1.0, float(np.sqrt(left / freedom)))
    if passed:
        detail = f"the {fit.structure} model agrees with {model.name!r} ({text})"
    elif factor**2 < _GROSS:
        detail = (
            f"the {fit.structure} model agrees only roughly with {model.name!r} ({text}): standard deviations are "
            f"multiplied by {factor:.2g}. Try other orders, or the grey-box method"
        )
    else:
        detail = (
            f"the {fit.structure} model contradicts {model.name!r} ({text}). Try other orders (a delay needs poles "
            "too), a structure that is consistent in closed loop, or the grey-box method"
        )
    values = {"statistic": left, "freedom": freedom}
    return Check(passed=passed, detail=detail, p=p, values=values), factor


def _ordered(model: LinearModel, parameters: Sequence[Parameter]) -> list[Parameter]:
    by_name = {p.name: p for p in parameters}
    return [by_name[p.name] for p in model.parameters]


_MAX_DELAY = 6  # samples
_FRACTION = 9.0  # fall of chi-square from which a fraction of a sample is believed
_TRIED = 4  # starts that are searched


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Match:
    """A physical model laid through a target."""

    model: LinearModel
    names: tuple[str, ...]  # free parameters
    theta: Mapping[str, float]  # all parameters, SI
    magnitude: Array  # (n,), SI, sizes by which the free parameters are scaled
    prior_mean: Array  # (n,), SI, infinite sd: no prior
    prior_sd: Array
    delay: float
    delay_free: bool  # whether the delay is estimated as a real number
    criterion: float  # sum of squares, priors included
    J: Array  # (n_rows, n or n + 1), its Jacobian, by parameters over their magnitudes, then by the delay in samples
    period_s: float

    @property
    def n_priors(self) -> int:
        """Number of parameters with a prior."""
        return int(np.sum(np.isfinite(self.prior_sd)))

    @property
    def size(self) -> Array:
        """What the columns of `J` are scaled by, the delay's last where it is free, shape (n,) or (n + 1,), SI."""
        return np.append(self.magnitude, self.period_s) if self.delay_free else self.magnitude


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Spread:
    """What the black box's own covariance makes of a match."""

    covariance: Array  # of the free parameters, the delay in s last where it is free
    # (rank,), variances along which the match leaves something over: the criterion is a sum of chi-squares with these
    # sizes
    left: Array


def spread(target: Target, best: Match) -> Spread:
    """Propagate the black box's covariance S through a weighted match: (J'WJ)^-1 J'W S W J (J'WJ)^-1. What S does not
    reach gets the weight's own noise: a direction without information is not one without error.
    """
    norm = np.maximum(np.linalg.norm(best.J, axis=0), 1e-100)
    U, s, Vt = np.linalg.svd(best.J / norm, full_matrices=False)
    back = (Vt.T / np.maximum(s, 1e-15 * s[0])) / norm[:, None]  # J^+ = back U'
    points, priors = target.noise.shape[0], best.J.shape[0] - target.noise.shape[0]
    noise = np.zeros((best.J.shape[0], target.rank + priors))
    noise[:points, : target.rank] = target.noise
    noise[points:, target.rank :] = np.eye(priors)
    reached = np.linalg.qr(noise)[0]
    visible, blind = U.T @ noise, U.T - (U.T @ reached) @ reached.T
    inner = visible @ visible.T + blind @ blind.T
    over = noise - U @ visible
    size = best.size
    covariance = back @ inner @ back.T * np.outer(size, size)
    return Spread(
        covariance=0.5 * (covariance + covariance.T), left=np.asarray(np.linalg.svd(over, compute_uv=False) ** 2)
    )


def match(target: Target, model: LinearModel, parameters: Sequence[Parameter], delay: float | Literal["auto"]) -> Match:
    """Search from the best starts of all bands and delays; a `delay` in samples is whole unless the response shows a
    fraction.
    """
    free = [p for p in parameters if p.role != "fixed"]
    fixed = {p.name: float(p.value) for p in parameters if p.role == "fixed" and p.value is not None}
    given = {p.name: float(p.value) for p in parameters if p.value is not None}
    # a model in continuous time holds its own delay apart; one without a number to spare cannot tell of another
    free_delay = delay == "auto" and target.dt is not None and target.rank > len(free)
    delays = [target.own_delay] if delay == "auto" else [float(delay)]
    if free_delay:
        delays = [d / 2 for d in range(2 * _MAX_DELAY + 1)]
    scored = []
    for samples in delays:
        for values in _possible(target, model, fixed, given, samples):
            g, _ = physical_response(model, values, target.omega, dt=target.dt, delay_s=samples * target.period_s)
            off = np.abs(g[target.known] / target.response[target.known] - 1.0)
            scored.append((float(np.mean(np.minimum(off, 1.0) ** 2)), samples, values))
    if not scored:
        raise EstimationError(
            f"no plant of {model.name!r} with positive {', '.join(p.name for p in model.parameters if p.positive)} "
            f"resembles this black-box model. Check channels and signs, or give start values"
        )
    scored.sort(key=lambda s: s[0])
    matches: list[Match] = []
    for samples, values in _different(scored, [p.name for p in free]):
        reference = model.references(values)
        size = [max(abs(values[p.name]), 1e-3 * reference.get(p.name, 0.0)) or 1.0 for p in free]
        blank = Match(
            model=model,
            names=tuple(p.name for p in free),
            theta=values,
            magnitude=np.array(size),
            prior_mean=np.array([p.value if p.role == "prior" and p.value is not None else 0.0 for p in free]),
            prior_sd=np.array([p.sd if p.sd is not None else np.inf for p in free]),
            delay=samples * target.period_s,
            delay_free=free_delay,
            criterion=np.inf,
            J=np.empty((0, 0)),
            period_s=target.period_s,
        )
        if free_delay:
            at = round(samples) * target.period_s
            matches.append(search(target, replace(blank, delay=at, delay_free=False)))
        matches.append(search(target, blank))
    physical = [m for m in matches if all(m.theta[p.name] > 0 for p in model.parameters if p.positive)]
    if not physical or not np.isfinite(min(m.criterion for m in physical)):
        raise EstimationError(
            f"the match to {model.name!r} gives a negative "
            f"{' or '.join(p.name for p in model.parameters if p.positive)}. Check channels and signs, and use a "
            "structure that is consistent in closed loop"
        )
    best = min(physical, key=lambda m: m.criterion + _FRACTION * m.delay_free)
    if not best.delay_free:
        return best
    nearest = max(0, round(best.delay / target.period_s)) * target.period_s
    whole = search(target, replace(best, delay=nearest, delay_free=False))
    return whole if best.delay < 0 or whole.criterion - best.criterion < _FRACTION else best


def search(target: Target, start: Match) -> Match:
    """Search by Levenberg-Marquardt from the `theta`, `delay` and `delay_free` of `start`."""
    from scipy.optimize import least_squares

    n = len(start.names)
    wanted = target.numbers(target.response)
    has = np.isfinite(start.prior_sd)
    rows = np.eye(n, n + start.delay_free)[has] * (start.magnitude / start.prior_sd)[has, None]

    def at(v: Array) -> tuple[dict[str, float], float]:
        theta = {**start.theta, **dict(zip(start.names, (v[:n] * start.magnitude).tolist(), strict=True))}
        return theta, float(v[n] * target.period_s) if start.delay_free else start.delay

    def both(v: Array) -> tuple[Array, Array]:
        theta, delay = at(v)
        g, slope = physical_response(
            start.model, theta, target.omega, dt=target.dt, delay_s=delay, along=start.names,
            with_delay=start.delay_free,
        )  # fmt: skip
        prior = (v[:n] * start.magnitude - start.prior_mean)[has] / start.prior_sd[has]
        r = np.concatenate([target.numbers(g) - wanted, prior])
        return r, np.vstack([target.numbers(slope) * start.size, rows])

    first = np.array([start.theta[k] for k in start.names]) / start.magnitude
    if start.delay_free:
        first = np.append(first, start.delay / target.period_s)
    try:
        done = least_squares(
            lambda v: both(v)[0], first, jac=lambda v: both(v)[1], method="lm", xtol=1e-10, ftol=1e-10, max_nfev=200
        )
    except (ValueError, np.linalg.LinAlgError, FloatingPointError, OverflowError):  # ran out of all sizes
        return replace(start, criterion=np.inf)
    theta, delay = at(done.x)
    r, J = both(done.x)
    return replace(start, theta=theta, delay=delay, criterion=float(r @ r), J=J)


def _possible(
    target: Target, model: LinearModel, fixed: Mapping[str, float], given: Mapping[str, float], delay: float
) -> Iterator[dict[str, float]]:
    """Start values that make a plant: from the response, and with the values that were given."""
    for m in target.moments:
        for _, values in weak_form_values(model.name, m, {}, [delay], 1.0 / target.period_s, fixed):
            for trial in (values, {**values, **given}) if given != fixed else (values,):
                finite = all(np.isfinite(v) for v in trial.values())
                if finite and all(trial[p.name] > 0 for p in model.parameters if p.positive):
                    yield trial


def _different(
    scored: list[tuple[float, float, dict[str, float]]], names: list[str]
) -> list[tuple[float, dict[str, float]]]:
    """The best starts that are not alike."""
    distinct: list[tuple[float, dict[str, float]]] = []
    for _, delay, values in scored:
        alike = any(
            d == delay and all(abs(v[k] - values[k]) <= 0.1 * max(abs(v[k]), abs(values[k])) for k in names)
            for d, v in distinct
        )
        if not alike:
            distinct.append((delay, values))
        if len(distinct) == _TRIED:
            break
    return distinct
