"""Covariance of the estimated physical parameters, what the data do not show, and the estimate made of both.

It is the inverse of the information matrix (right model, Gaussian noise: the Cramer-Rao bound; Ljung 1999, sec. 9.3),
by singular values of the scaled Jacobian. Beside it the robust one, from the scores of stretches of the record, holds
where the model is only near the truth (the sandwich of White 1982, by batches).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.estimation.colours import colours_of, without_colours
from ambid.estimation.estimate import Check, Continuous, Delay, Estimate, EstimatedParameter, NoiseModel, OutputFit
from ambid.estimation.likelihood import (
    Fit,
    Workspace,
    evaluate,
    linearise,
    prior_rows,
    products,
    weight_of,
    workspace_near,
)
from ambid.estimation.linear import directions
from ambid.estimation.predictor import Predictor, assemble, stable
from ambid.estimation.uncertainty import WEAK, natural_sizes, weakest_direction
from ambid.physics.linear_model import Parameter

_SHORT = 25.0  # memories below which the likelihood of a noise level is itself too rough, and all is widened once more
_LONG = 75.0  # memories of the predictor from which noise levels are known well enough not to ask
_FELT = 1.1  # factor on standard deviations below which rough noise levels do not matter
STRETCHES = 30  # stretches of the record for the robust covariance
_ADVICE = {
    "k_x": "for k_x, excite more at low frequency (from {low:.2g} Hz) or with a larger amplitude",
    "k_i": "for k_i, excite larger motion near {mid:.3g} Hz",
    "m": "for m, excite larger motion at {mid:.3g} Hz and above",
    "R": "for R, add voltage steps held for {settle:.2g} s or longer",
    "L": "for L, excite at {corner:.3g} Hz and above",
    "c": "for c, excite near the mechanical resonance, around {low:.3g} Hz",
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Uncertainty:
    """What a fit knows of its physical parameters; `memories`: the record's length in memories of the predictor,
    infinite where the gain is not estimated.
    """

    names: tuple[str, ...]  # estimated physical parameters
    # (n, n), SI, covariance from the information matrix, priors included, and from what a short record leaves open of
    # the noise levels
    information: Array
    robust: Array  # (n, n), SI, covariance from the scores of stretches of the record
    # (n,), SI, standard deviations that the data alone would give; very large where they show nothing
    data_only_sd: Array
    # (n,), SI, size against which a standard deviation is judged: the value, or the natural scale of a parameter that
    # may be zero
    scale: Array
    # (n,), of the information matrix of the physical parameters scaled by their values, largest first, as 1 / relative
    # standard deviation along each direction
    singular_values: Array
    # direction with the smallest singular value: share of each parameter, largest in magnitude 1
    weakest: dict[str, float]
    delay_sd: float | None  # standard deviation of an estimated delay in samples
    # (n, n), SI, covariance with the noise levels taken as known well: what `information` is for a long record
    fisher: Array
    # (n_ways, n), SI, how far the parameters move when the data are used differently, where that is more than chance
    # allows; else 0. Part of the robust standard deviations: a bias of this size cannot be ruled out.
    disagreement: Array
    bias: Array  # (n,), SI, what causes that the tests name have done to the estimate; part of all intervals
    # (n_facts, n), SI, how far the estimate moves to what facts without a fit say that contradict it; part of them too
    apart: Array

    @property
    def widening(self) -> float:
        """Largest ratio of standard deviations with noise levels known roughly to those with them known well."""
        return float(np.max(np.sqrt(np.diag(self.information) / np.maximum(np.diag(self.fisher), 1e-300))))

    @property
    def inflation(self) -> float:
        """Largest ratio of robust to information standard deviation."""
        return float(np.max(np.sqrt(np.diag(self.robust) / np.maximum(np.diag(self.fisher), 1e-300))))

    def covariance(self, *, robust: bool) -> Array:
        """Return the covariance (n, n), SI, that goes with `standard_deviations`; if `robust`, as where the model is
        only near the truth: correlations from the scores, the larger of both deviations, plus the disagreement.
        """
        away = self.away(robust=robust)
        if not robust:
            return np.asarray(self.information + away.T @ away)
        plain, own = np.sqrt(np.diag(self.information)), np.sqrt(np.diag(self.robust))
        larger = np.maximum(1.0, plain / np.maximum(own, 1e-300))
        return np.asarray(self.robust * np.outer(larger, larger) + away.T @ away)

    def away(self, *, robust: bool) -> Array:
        """Return what of it more data would not average out, (n_ways, n), SI."""
        return np.vstack([*([self.disagreement] if robust else []), self.bias, self.apart])

    def standard_deviations(self, *, robust: bool) -> Array:
        """Return deviations (n,), SI, from the information matrix, or `robust` ones, which are never smaller."""
        return np.asarray(np.sqrt(np.diag(self.covariance(robust=robust))))

    def relative_sd(self, *, robust: bool) -> Array:
        """Return standard deviations (n,) over `scale`."""
        return np.asarray(self.standard_deviations(robust=robust) / self.scale)

    def weighed(self, gain: Array, slope: Array, sd: float, scale: Array) -> Uncertainty:
        """Return it after the numbers were moved by gain (z - slopeᵀ θ), (n,) each, for a fact z of deviation `sd`;
        `scale`: that of the moved numbers.
        """
        kept = np.eye(len(self.names)) - np.outer(gain, slope)
        own = sd**2 * np.outer(gain, gain)
        parts = {name: kept @ getattr(self, name) @ kept.T + own for name in ("information", "robust", "fisher")}
        away = {name: getattr(self, name) @ kept.T for name in ("disagreement", "bias", "apart")}
        values, weakest = weakest_direction(self.names, parts["information"], scale)
        return replace(self, **parts, **away, scale=scale, singular_values=values, weakest=weakest)

    def identifiable_at(self, *, robust: bool) -> tuple[bool, ...]:
        """Return which parameters have a relative standard deviation below 25 %."""
        return tuple(bool(r < WEAK) for r in self.relative_sd(robust=robust))


def uncertainty(fit: Fit, scores: Array | None = None) -> Uncertainty:
    """Compute covariances and identifiability of a fit that has not failed; `scores` (n_stretches, size), where a pass
    gave them.
    """
    problem, sl = fit.problem, fit.problem.slices
    n, size = problem.n_physical, problem.magnitude
    whole = directions(np.vstack([fit.J, fit.J_prior])).inverse()
    unit = np.outer(size, size)
    more = 0.0 if fit.beside is None else fit.beside
    information = (whole[:n, :n] + _left_open(fit) + more) * unit
    noise_only = fit.J_prior.copy()
    noise_only[:, :n] = 0.0
    data_only = np.sqrt(np.diag(directions(np.vstack([fit.J, noise_only])).inverse())[:n]) * size
    theta = problem.parameters(fit.vector)
    scale = natural_sizes(problem.estimated, theta, problem.model.references(theta))
    singular_values, weakest = weakest_direction(problem.estimated, information, scale)
    delay_sd = float(np.sqrt(whole[sl["fraction"], sl["fraction"]][0, 0])) if problem.fractional else None
    return Uncertainty(
        names=problem.estimated,
        information=information,
        robust=(_gram(whole[:n] @ scatter(_scores(fit) if scores is None else scores).T) + more) * unit,
        data_only_sd=data_only,
        scale=scale,
        singular_values=singular_values,
        weakest=weakest,
        delay_sd=delay_sd,
        fisher=(whole[:n, :n] + more) * unit,
        disagreement=np.zeros((0, n)),
        bias=np.zeros(n),
        apart=np.zeros((0, n)),
    )


def _left_open(fit: Fit) -> Array:
    """Covariance (n, n), over the magnitudes, that a short record adds by leaving noise levels open: at the upper end
    of what the likelihood allows each disturbance, how far information shrinks and parameters move; else nothing.
    """
    problem, predictor = fit.problem, assemble(fit.problem, fit.vector, with_derivatives=False)
    n, extra = problem.n_physical, np.zeros((problem.n_physical, problem.n_physical))
    if problem.noise != "levels" or predictor is None or stable(predictor.A):
        return extra
    own = sum(c.order for c in colours_of(problem))  # what colours forget slowly is counted by their places
    slowest = np.sort(np.abs(np.linalg.eigvals(predictor.M[:, : predictor.x0.size])))[-1 - own]
    memories = problem.n_used * (1.0 - slowest)
    if memories > _LONG:
        return extra
    work = Workspace(problem) if fit.work is None else fit.work.of(problem)
    here = directions(np.vstack([fit.J, fit.J_prior])).inverse()[:n, :n]
    for j in range(len(problem.model.disturbances)):
        upper = _upper_level(fit, j, work)
        _, covariance = evaluate(problem, upper, work)
        at = None if covariance is None else linearise(problem, upper, weight_of(covariance), work)
        if at is not None:
            r, rows = prior_rows(problem, upper)
            J, free = np.vstack([at.J, rows]), np.ones(problem.size, dtype=bool)
            free[problem.slices["noise"].start + j] = False  # this level stays where it was put
            there = directions(J[:, free]).inverse()
            step = -(there @ (J[:, free].T @ np.concatenate([at.r, r])))[:n]
            wider = max(0.0, float(np.max(np.diag(there)[:n] / np.diag(here))) - 1.0)
            extra += wider * here + np.outer(step, step)
    extra += max(0.0, _SHORT / max(memories, 1e-3) - 1.0) * (here + extra)
    felt = np.sqrt(np.max(1.0 + np.diag(extra) / np.diag(here))) > _FELT
    return extra if felt else np.zeros_like(extra)


def _upper_level(fit: Fit, j: int, work: Workspace) -> Array:
    """The fit with one log disturbance level raised to the end of its 95 % interval: the criterion has risen by 4."""
    place, inside, outside = fit.problem.slices["noise"].start + j, 0.0, 0.1

    def rise(step: float) -> float:
        moved = fit.vector.copy()
        moved[place] += step
        return evaluate(fit.problem, moved, work)[0] - fit.criterion

    while outside < 20.0 and rise(outside) < 4.0:
        inside, outside = outside, 2 * outside
    for _ in range(4):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if rise(middle) < 4.0 else (inside, middle)
    upper = fit.vector.copy()
    upper[place] += inside
    return upper


def farthest(moves: Sequence[Array]) -> Array:
    """Return by how far each number (n,) is moved by that of several `moves`, (n,) each, which moves it farthest."""
    stacked = np.array(moves)
    return np.asarray(np.take_along_axis(stacked, np.argmax(np.abs(stacked), axis=0)[None], axis=0)[0])


def _gram(a: Array) -> Array:
    """Positive semidefinite product a a^T."""
    return np.asarray(a @ a.T)


def _scores(fit: Fit) -> Array:
    """Scores of the stretches of the record, (n_stretches, size)."""
    work = workspace_near(fit, fit.problem)
    sums = products(fit.problem, fit.vector, weight_of(fit.covariance), work, stretches=STRETCHES)
    if sums is None:
        raise ValueError("the fit has no predictor; it has failed")
    return sums.scores


def scatter(scores: Array) -> Array:
    """Rows whose squares are the middle of the sandwich: scores less their mean."""
    count = scores.shape[0]
    return np.asarray((scores - scores.mean(axis=0)) * np.sqrt(count / max(count - 1, 1)))


def experiment_hint(
    u: Uncertainty, values: Mapping[str, float], band_hz: tuple[float, float, float], *, robust: bool
) -> str | None:
    """Return the experiment that would make the weakest direction identifiable, None where all is; `values`: all
    parameters, SI; `robust`: which deviations count.
    """
    unseen = [name for name, seen in zip(u.names, u.identifiable_at(robust=robust), strict=True) if not seen]
    if not unseen:
        return None
    in_direction = {name for name, share in u.weakest.items() if abs(share) > 0.5}
    if {"m", "k_x", "k_i"} <= in_direction or (
        "R" not in values and {"k_x", "k_i", "m"} & in_direction and len(in_direction) > 1
    ):
        return (
            "Only the ratios of m, k_x and k_i are identifiable: the back-EMF k_i dx/dt is lost in the noise. Weigh "
            "the rotor and fix m (or give a prior), or excite faster and larger motion"
        )
    frequencies = _frequencies(values, band_hz)
    texts = dict(_ADVICE)
    if values.get("R", 0.0) > 2.0 * np.pi * band_hz[-1] * values.get("L", np.inf):  # beyond what a record can hold
        texts["L"] = "for L, sample faster"
    advice = [texts[name].format(**frequencies) for name in unseen if name in texts]
    worst = float(max(u.relative_sd(robust=robust)))
    factor = worst / WEAK
    more = (
        f"in the same band, {factor:.2g} times the amplitude or {factor**2:.2g} times the length suffices"
        if factor < 1e3
        else ""
    )
    hint = "; ".join([*advice, *([more] if more else [])])
    return hint[:1].upper() + hint[1:]


def _frequencies(values: Mapping[str, float], band_hz: tuple[float, float, float]) -> dict[str, float]:
    """Frequencies at which the parameters show, Hz, within what a record can hold, and the coil's settling time, s."""
    first, lowest, last = band_hz
    v = {k: max(abs(x), 1e-300) for k, x in values.items()}
    stiff = np.sqrt(v["k_x"] / v["m"]) / (2 * np.pi) if {"k_x", "m"} <= v.keys() else lowest
    coupled = np.sqrt(v["k_i"] ** 2 / (v["m"] * v["L"])) / (2 * np.pi) if {"k_i", "m", "L"} <= v.keys() else stiff
    corner = v["R"] / v["L"] / (2 * np.pi) if {"R", "L"} <= v.keys() else stiff
    corners = {"low": min(stiff, lowest) / 3, "mid": max(coupled, stiff), "corner": corner}
    within = {name: float(np.clip(f, first, last)) for name, f in corners.items()}
    return {**within, "settle": 5 / (2 * np.pi * within["corner"])}


def estimate_of(
    fit: Fit,
    known: Uncertainty,
    parameters: tuple[Parameter, ...],
    *,
    robust: bool,
    delay_how: Literal["estimated", "given"],
    means: Mapping[str, float],
    one_step: Array,
    simulation: Array | None,
    checks: Mapping[str, Check],
    warnings: tuple[str, ...],
    record: Mapping[str, object],
    rig: Mapping[str, object],
) -> Estimate:
    """Put an estimate together of a `fit` that has not failed and what is `known` of it. `parameters`: what was known
    before, in the model's order; `robust`: the larger of information and robust deviations; `means`: operating point
    taken off, by role, SI; `one_step`, `simulation` (n_outputs,): fits, the latter None where the plant is unstable.
    """
    problem, plain = fit.problem, without_colours(fit)
    theta = problem.parameters(fit.vector)
    sd = dict(zip(known.names, known.standard_deviations(robust=robust).tolist(), strict=True))
    settled = fit.status == "converged"  # of a search that has not ended nothing is certain
    shows = {k: settled and ok for k, ok in zip(known.names, known.identifiable_at(robust=robust), strict=True)}
    alone = dict(zip(known.names, known.data_only_sd.tolist(), strict=True))
    delay = Delay.of(problem.delay_samples(fit.vector), known.delay_sd, delay_how)
    return Estimate(
        status=fit.status,
        model=problem.model.name,
        record=record,
        parameters=tuple(EstimatedParameter.of(p, theta, sd, shows, alone) for p in parameters),
        covariance_names=known.names,
        covariance=known.covariance(robust=robust),
        covariance_method="robust" if robust else "information",
        delay=dict.fromkeys(problem.model.inputs, delay),
        continuous=Continuous.of(plain.problem.model, theta),
        noise=_noise(plain),
        coloured=_noise(fit) if colours_of(problem) else None,
        bias_sd=dict(zip(known.names, np.sqrt(np.sum(known.away(robust=robust) ** 2, axis=0)).tolist(), strict=True)),
        operating_point=means,
        fit={
            role: OutputFit(
                one_step=float(one_step[j]),
                simulation=None if simulation is None else float(simulation[j]),
                innovation_sd=float(np.sqrt(fit.covariance[j, j]) * problem.scales.output[j]),
            )
            for j, role in enumerate(problem.model.outputs)
        },
        checks=checks,
        warnings=warnings,
        information={
            "singular_values": known.singular_values.tolist(),
            "condition": float(known.singular_values[0] / known.singular_values[-1]),
            "weakest_direction": known.weakest,
            "robust_over_information_sd": known.inflation,
        },
        rig=rig,
    )


def _noise(fit: Fit) -> NoiseModel:
    """Noise model in SI: K, the innovation covariance, and levels where they describe it."""
    problem, sc = fit.problem, fit.problem.scales
    predictor = assemble(problem, fit.vector, with_derivatives=False)
    if predictor is None:
        raise ValueError("the fit has no predictor; it has failed")
    disturbance: dict[str, float] = {}
    sensor: dict[str, float] = {}
    if problem.noise == "levels":
        disturbance, sensor = noise_levels(fit, predictor)
    elif not np.any(predictor.gain):
        disturbance = dict.fromkeys(problem.model.disturbances, 0.0)
        sensor = dict(zip(problem.model.outputs, (np.sqrt(np.diag(fit.covariance)) * sc.output).tolist(), strict=True))
    return NoiseModel(
        form="levels" if problem.noise == "levels" else "gain" if np.any(predictor.gain) else "sensors",
        gain=predictor.gain * sc.state[:, None] / sc.output,
        innovation_covariance=fit.covariance * np.outer(sc.output, sc.output),
        disturbance_sd=disturbance,
        sensor_sd=sensor,
        colours=colours_of(problem),
    )


def noise_levels(fit: Fit, predictor: Predictor) -> tuple[dict[str, float], dict[str, float]]:
    """Noise standard deviations in SI: the log levels give ratios, the innovation covariance their common size."""
    problem, sc, model = fit.problem, fit.problem.scales, fit.problem.model
    numbers = fit.vector[problem.slices["noise"]]
    assert predictor.innovations is not None
    inner = predictor.innovations.S
    common = float(np.sqrt(np.trace(np.linalg.solve(inner, fit.covariance)) / len(model.outputs)))
    n_d = len(model.disturbances)
    disturbance = np.exp(numbers[:n_d]) * sc.disturbance * common
    # the part of each innovation that the sensor makes up: right also where there is no disturbance to compare with
    part = np.concatenate([[1.0], np.exp(2 * numbers[n_d:])]) / np.diag(inner)
    sensor = np.sqrt(part * np.diag(fit.covariance)) * sc.output
    return (
        dict(zip(model.disturbances, disturbance.tolist(), strict=True)),
        dict(zip(model.outputs, sensor.tolist(), strict=True)),
    )
