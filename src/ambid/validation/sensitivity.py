"""Sensitivity analysis: how much each estimated number matters to the fit, the poles and the frequency response.

A step d costs d' I d of -2 log L, I = covariance^-1. I_jj is what a number does by itself, 1/covariance_jj with all
others free; their ratio is how well others stand in for it (variance inflation). The collinearity index 1/smallest
singular value of the scaled sensitivities (Brun, Reichert and Kuensch 2001): at 10 others undo a change to a tenth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.model import pole_covariance
from ambid.errors import EstimationError
from ambid.estimation.uncertainty import skipped

_PAIR = 0.9  # correlation from which two numbers are named as a pair
_DEPENDENT = 1e-10  # eigenvalue of the correlation matrix under which a direction is not independent
_FREQUENCIES = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class Influence:
    """One estimated number."""

    name: str
    value: float
    sd: float
    fit_alone: float  # rise of -2 log L when it alone moves by 1 %
    fit_free: float  # the same when the others are fitted again: (0.01 value/sd)^2
    inflation: float  # first over second: how much of its effect the others can undo; 1 is none
    # largest relative move of a pole when it moves by 1 %: |dp|/|p| (of log z for a discrete model, which is p times
    # the sampling interval). None where there are no poles, or no structure is at hand.
    poles: float | None
    # the same for the frequency response, root mean square over the band up to half the sampling rate
    response: float | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SensitivityAnalysis:
    """What matters, and what cannot be distinguished."""

    influences: tuple[Influence, ...]  # largest effect on the fit first
    collinearity: float  # index of all numbers together; under 10 is good, infinite where they are not independent
    dependent: int  # directions that are not independent (a full state space always has some: states can be exchanged)
    # numbers whose estimates are correlated by more than 0.9, strongest first, with the correlation
    pairs: tuple[tuple[str, str, float], ...]
    # combination that the data see least, relative changes, largest share first; up to four
    weakest: tuple[tuple[str, float], ...]
    # (n_poles,), relative standard deviation of each pole, in the order of the model's poles; empty without structure
    pole_sd: Array


def sensitivity_analysis(fit: BlackBoxFit, data: IOData) -> SensitivityAnalysis:
    """Analyse a black-box fit with a covariance; the length of its `data` sets the lowest frequency looked at."""
    if fit.covariance is None or not np.any(np.diag(fit.covariance) > 0):
        raise EstimationError(
            f"{fit.structure} gave no covariance for these data, and sensitivities need one. Lower the orders"
        )
    model = fit.model
    free = np.nonzero(np.diag(fit.covariance) > 0)[0]
    theta = model.theta[free]
    poles, slopes = model.poles(), model.pole_derivative()[:, free]
    with np.errstate(divide="ignore", invalid="ignore"):
        size = np.abs(poles) if model.dt is None else np.abs(poles * np.log(poles))
        moves = np.abs(slopes * theta) / size[:, None]
        spread = np.sqrt(np.trace(pole_covariance(model, fit.covariance), axis1=1, axis2=2)) / size
    moves = np.where(np.isfinite(moves), moves, 0.0)
    longest = max(data.n_samples - skipped(data.n_samples), 2) * fit.dt
    omega = np.geomspace(2 * np.pi / longest, 0.999 * np.pi / fit.dt, _FREQUENCIES)
    response = None
    if model.n_inputs:
        g = model.frequency_response(omega)
        change = model.frequency_response_derivative(omega)[..., free] * theta
        level = np.sqrt(np.mean(np.abs(g) ** 2, axis=0))
        relative = np.sqrt(np.mean(np.abs(change) ** 2, axis=0)) / np.maximum(level, 1e-300)[..., None]
        response = np.max(relative, axis=(0, 1))
    return _analysis(
        [model.names[k] for k in free],
        theta,
        fit.covariance[np.ix_(free, free)],
        np.max(moves, axis=0) if poles.size else None,
        response,
        np.asarray(spread),
    )


def _analysis(
    names: Sequence[str], theta: Array, covariance: Array, poles: Array | None, response: Array | None, pole_sd: Array
) -> SensitivityAnalysis:
    sd = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sd, sd)
    values, vectors = np.linalg.eigh(correlation)
    visible = values > _DEPENDENT * values[-1]
    inverse = (vectors[:, visible] / values[visible]) @ vectors[:, visible].T
    information = np.diag(inverse)  # times sd^2: I_jj covariance_jj
    influences = [
        Influence(
            name=name,
            value=float(theta[j]),
            sd=float(sd[j]),
            fit_alone=float((0.01 * theta[j] / sd[j]) ** 2 * information[j]),
            fit_free=float((0.01 * theta[j] / sd[j]) ** 2),
            inflation=float(max(information[j], 1.0)),
            poles=None if poles is None else float(0.01 * poles[j]),
            response=None if response is None else float(0.01 * response[j]),
        )
        for j, name in enumerate(names)
    ]
    return SensitivityAnalysis(
        influences=tuple(sorted(influences, key=lambda x: -x.fit_alone)),
        collinearity=_collinearity(inverse) if np.all(visible) else float("inf"),
        dependent=int(np.count_nonzero(~visible)),
        pairs=_pairs(names, correlation),
        weakest=_weakest(names, theta, sd, vectors[:, -1]),
        pole_sd=pole_sd,
    )


def _collinearity(inverse: Array) -> float:
    """Index of the sensitivities, each scaled to length 1: their Gram matrix is the scaled information."""
    size = np.sqrt(np.diag(inverse))
    return float(1 / np.sqrt(np.linalg.eigvalsh(inverse / np.outer(size, size))[0]))


def _pairs(names: Sequence[str], correlation: Array) -> tuple[tuple[str, str, float], ...]:
    pairs = [
        (names[j], names[k], float(correlation[j, k]))
        for j in range(len(names))
        for k in range(j)
        if abs(correlation[j, k]) > _PAIR
    ]
    return tuple(sorted(pairs, key=lambda x: -abs(x[2])))


def _weakest(names: Sequence[str], theta: Array, sd: Array, direction: Array) -> tuple[tuple[str, float], ...]:
    """Direction of the largest spread, as relative changes of the numbers, largest 1."""
    step = direction * sd / np.where(theta == 0, 1.0, np.abs(theta))
    step = step / step[np.argmax(np.abs(step))]
    order = np.argsort(-np.abs(step))[:4]
    return tuple((names[k], float(step[k])) for k in order)
