"""Lay the frequency response of a physical model through that of a black box.

Starts come from the weak-form regressions of `ambid.estimation.start`, on the response instead of spectra; the search
is SciPy's Levenberg-Marquardt with exact derivatives.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.bearing.physical_target import Target, physical_response
from ambid.errors import EstimationError
from ambid.estimation.start import candidates
from ambid.physics.linear_model import LinearModel
from ambid.physics.parameters import Parameter

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


def spread(target: Target, found: Match) -> Spread:
    """Propagate the black box's covariance S through a weighted match: (J'WJ)^-1 J'W S W J (J'WJ)^-1.

    What the black box's covariance does not reach at all gets the weight's own noise, so that a direction without
    information is not taken for one without error.
    """
    norm = np.maximum(np.linalg.norm(found.J, axis=0), 1e-100)
    U, s, Vt = np.linalg.svd(found.J / norm, full_matrices=False)
    back = (Vt.T / np.maximum(s, 1e-15 * s[0])) / norm[:, None]  # J^+ = back U'
    points, priors = target.noise.shape[0], found.J.shape[0] - target.noise.shape[0]
    noise = np.zeros((found.J.shape[0], target.rank + priors))
    noise[:points, : target.rank] = target.noise
    noise[points:, target.rank :] = np.eye(priors)
    reached = np.linalg.qr(noise)[0]
    seen, blind = U.T @ noise, U.T - (U.T @ reached) @ reached.T
    inner = seen @ seen.T + blind @ blind.T
    over = noise - U @ seen
    size = found.size
    covariance = back @ inner @ back.T * np.outer(size, size)
    return Spread(
        covariance=0.5 * (covariance + covariance.T), left=np.asarray(np.linalg.svd(over, compute_uv=False) ** 2)
    )


def matched(
    target: Target, model: LinearModel, parameters: Sequence[Parameter], delay: float | Literal["auto"]
) -> Match:
    """Search from the best starts of all bands and delays; a delay is whole unless the response shows a fraction.

    `delay`: samples.
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
            "comes near this black box. Check channels and signs, or give start values"
        )
    scored.sort(key=lambda s: s[0])
    found: list[Match] = []
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
            found.append(search(target, replace(blank, delay=at, delay_free=False)))
        found.append(search(target, blank))
    physical = [m for m in found if all(m.theta[p.name] > 0 for p in model.parameters if p.positive)]
    if not physical or not np.isfinite(min(m.criterion for m in physical)):
        raise EstimationError(
            f"the black box leads to a negative {' or '.join(p.name for p in model.parameters if p.positive)}: it is "
            f"no {model.name!r} plant. Check channels and signs, and use a structure that stands feedback"
        )
    best = min(physical, key=lambda m: m.criterion + _FRACTION * m.delay_free)
    if not best.delay_free:
        return best
    nearest = max(0, round(best.delay / target.period_s)) * target.period_s
    whole = search(target, replace(best, delay=nearest, delay_free=False))
    return whole if best.delay < 0 or whole.criterion - best.criterion < _FRACTION else best


def search(target: Target, start: Match) -> Match:
    """Search from a start by Levenberg-Marquardt.

    `start`: its `theta`, `delay` and `delay_free` count.
    """
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
        for _, values in candidates(model.name, m, {}, [delay], 1.0 / target.period_s, fixed):
            for trial in (values, {**values, **given}) if given != fixed else (values,):
                finite = all(np.isfinite(v) for v in trial.values())
                if finite and all(trial[p.name] > 0 for p in model.parameters if p.positive):
                    yield trial


def _different(
    scored: list[tuple[float, float, dict[str, float]]], names: list[str]
) -> list[tuple[float, dict[str, float]]]:
    """The best starts that are not alike."""
    kept: list[tuple[float, dict[str, float]]] = []
    for _, delay, values in scored:
        alike = any(
            d == delay and all(abs(v[k] - values[k]) <= 0.1 * max(abs(v[k]), abs(values[k])) for k in names)
            for d, v in kept
        )
        if not alike:
            kept.append((delay, values))
        if len(kept) == _TRIED:
            break
    return kept
