"""An estimate on other data: the model is kept as it is, only offsets and initial state are fitted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.bearing.multistart import Signals
from ambid.errors import EstimationError, counted
from ambid.estimation.colours import Coloured, scaled_for
from ambid.estimation.estimate import Check, Estimate
from ambid.estimation.likelihood import (
    Fit,
    expected_prediction_sd,
    innovations,
    linearise,
    prediction_error,
    search,
    simulation_error,
    weight_of,
)
from ambid.estimation.linear import one_thread
from ambid.estimation.predictor import PredictorProblem, noise_floor, scales_for
from ambid.estimation.result import Reason, Result
from ambid.physics.linear_model import model
from ambid.validation.physical import innovation_products, innovation_tests
from ambid.validation.residuals import fit_of, uncorrelated_check, white_check

_RATIO = 1.5  # innovation standard deviation against the one at identification that a check lets pass
_HORIZONS = (1, 10, 100)  # samples ahead
_NO_PREDICTOR = "the estimate gives no stable predictor for this record. Check that both come from the same bench"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Replay:
    """A record run through an estimate, SI units."""

    # offsets and initial state on this record; the parameters stay as they were, with their covariance as a prior, so
    # that tests on it allow for what was not known of them
    fit: Fit
    first: int  # sample of the record at which row 0 of the arrays stands
    measured: Array  # (n_used, n_outputs), outputs, and their predictions from all samples before
    predicted: Array
    innovations: Array  # (n_used, n_outputs), their difference
    # (n_used, n_outputs), or None, outputs from the input alone; None where the plant is unstable in open loop
    simulated: Array | None


def replay(estimate: Estimate, signals: Signals) -> Replay:
    """Run a record's `signals`, of the same bench and rate, through the predictor of an estimate."""
    with one_thread():
        fit = _fit(estimate, signals)
    problem = fit.problem
    e = innovations(problem, fit.vector)
    if e is None:
        raise EstimationError(_NO_PREDICTOR)
    e = e * problem.scales.output
    mean = signals.y.mean(axis=0)
    measured, error = problem.y[problem.skip :] + mean, simulation_error(fit)
    return Replay(
        fit=fit,
        first=problem.skip,
        measured=measured,
        predicted=measured - e,
        innovations=e,
        simulated=None if error is None else measured - error,
    )


def _fit(estimate: Estimate, signals: Signals) -> Fit:
    plant = model(estimate.model)
    rate = float(str(estimate.record["rate_hz"]))
    if abs(signals.rate_hz / rate - 1) > 1e-6:
        raise EstimationError(
            f"the record is sampled at {signals.rate_hz:g} Hz, the estimate's predictor at {rate:g} Hz; the rates "
            "must agree. Resample the record, or identify from it"
        )
    delay = estimate.delay[plant.inputs[0]]
    skip = delay.samples + 2
    if signals.y.shape[0] < skip + 20 * len(plant.states):
        raise EstimationError(
            f"the record has {counted(signals.y.shape[0], 'sample')}, too few to test an estimate. Give a longer one"
        )
    u, y = signals.u - signals.u.mean(axis=0), signals.y - signals.y.mean(axis=0)
    for role, column in zip((*plant.inputs, *plant.outputs), np.hstack([u, y]).T, strict=True):
        if not np.any(column):
            raise EstimationError(
                f"channel {role!r} is constant in the whole record, which cannot test an estimate. Check it"
            )
    noise = estimate.whole_noise
    scales = scales_for(plant, estimate.values, np.std(u, axis=0), noise_floor(y), signals.rate_hz)
    scales = scaled_for(scales, plant, noise.colours)
    problem = PredictorProblem(
        model=Coloured(plain=plant, colours=noise.colours) if noise.colours else plant,
        rate_hz=signals.rate_hz,
        u=u,
        y=y,
        estimated=(),
        known=estimate.values,
        magnitude=np.zeros(0),
        prior_mean=np.zeros(0),
        prior_sd=np.zeros(0),
        scales=scales,
        delay=delay.samples,
        lag=delay.fraction,
        skip=skip,
        noise="given",
        gain=noise.gain * scales.output / scales.state[:, None],
        unsteady=len(noise.colours),
    )
    fit = search(problem, np.zeros(problem.size))
    if fit.status == "failed":
        raise EstimationError(_NO_PREDICTOR)
    return _with_covariance(fit, estimate)


def _with_covariance(fit: Fit, estimate: Estimate) -> Fit:
    """Give the parameters their covariance back: as numbers with a prior, at the values they have."""
    names = estimate.covariance_names
    values = np.array([estimate.values[k] for k in names])
    sd = np.sqrt(np.diag(estimate.covariance))
    problem = replace(
        fit.problem,
        estimated=names,
        known={k: v for k, v in estimate.values.items() if k not in names},
        magnitude=sd,
        prior_mean=values,
        prior_sd=sd,
    )
    vector = np.concatenate([values / sd, fit.vector])
    at = linearise(problem, vector, weight_of(fit.covariance))
    if at is None:
        return fit
    correlation = estimate.covariance / np.outer(sd, sd)
    rows = np.zeros((len(names), problem.size))
    rows[:, : len(names)] = np.linalg.inv(np.linalg.cholesky(correlation + 1e-9 * np.eye(len(names))))
    return replace(fit, problem=problem, vector=vector, J=at.J, J_prior=rows, r_prior=np.zeros(len(names)))


def validation(estimate: Estimate, signals: Signals) -> dict[str, object]:
    """Judge an estimate on a second record. ``fit`` by output: one_step, simulation, rms of the innovation in SI,
    k_step fits, and k_step_ratio, errors so many steps ahead over the expected; ``checks``: residuals_white,
    residuals_uncorrelated, innovations_consistent (sizes as at identification), each with ``passed`` and ``detail``;
    ``passed``.
    """
    with one_thread():
        return _judged(estimate, signals)


def _judged(estimate: Estimate, signals: Signals) -> dict[str, object]:
    run = replay(estimate, signals)
    one_step = fit_of(run.innovations, run.measured)
    simulation = None if run.simulated is None else fit_of(run.measured - run.simulated, run.measured)
    rms = np.sqrt(np.mean(run.innovations**2, axis=0))
    before = np.sqrt(np.diag(estimate.whole_noise.innovation_covariance))
    roles = model(estimate.model).outputs
    horizons = [k for k in _HORIZONS if k < run.measured.shape[0] // 2]
    errors = {k: prediction_error(run.fit, k) for k in horizons}
    ahead = {k: fit_of(e, run.measured[k - 1 :]) for k, e in errors.items()}
    expected = _expected_sd(run, estimate, horizons)
    ratio = {k: np.sqrt(np.mean(e**2, axis=0)) / expected[k] for k, e in errors.items()}
    checks = _checks(run, dict(zip(roles, (rms / before).tolist(), strict=True)))
    return {
        "fit": {
            role: {
                "one_step": float(one_step[j]),
                "simulation": None if simulation is None else float(simulation[j]),
                "innovation_rms": float(rms[j]),
                "k_step": {str(k): float(f[j]) for k, f in ahead.items()},
                "k_step_ratio": {str(k): float(r[j]) for k, r in ratio.items()},
            }
            for j, role in enumerate(roles)
        },
        **conclude(checks, signals.y.shape[0]),
    }


def conclude(checks: Mapping[str, Check], samples: int) -> dict[str, object]:
    """Return what every judgement on a second record ends with: ``checks``, ``passed`` and ``samples``."""
    return {
        "checks": {name: {"passed": c.passed, "p": c.p, "detail": c.detail, **c.values} for name, c in checks.items()},
        "passed": all(c.passed for c in checks.values()),
        "samples": samples,
    }


def consistency_check(ratios: Mapping[str, float], where: str) -> Check:
    """Check that residuals are as large as at identification, within a factor; `ratios` are given by output."""
    worst = max(ratios, key=lambda role: abs(np.log(ratios[role])))
    return Check(
        passed=all(1 / _RATIO < r < _RATIO for r in ratios.values()),
        values={f"{role}_ratio": r for role, r in ratios.items()},
        detail=f"residuals of {worst} are {ratios[worst]:.2f} times as large as {where} (limit: a factor {_RATIO:g})",
    )


def _expected_sd(run: Replay, estimate: Estimate, horizons: list[int]) -> dict[int, Array]:
    """Standard deviations of the errors ahead that the estimate expects, with the innovations of its own record."""
    scale = run.fit.problem.scales.output
    own = replace(run.fit, covariance=estimate.whole_noise.innovation_covariance / np.outer(scale, scale))
    return {k: expected_prediction_sd(own, k) for k in horizons}


def _checks(run: Replay, ratios: dict[str, float]) -> dict[str, Check]:
    e = run.innovations / run.fit.problem.scales.output
    own, inputs = innovation_tests(run.fit, innovation_products(run.fit, e))
    return {
        "residuals_white": white_check(own),
        "residuals_uncorrelated": uncorrelated_check(inputs),
        "innovations_consistent": consistency_check(ratios, "at identification"),
    }


SCHEMA = "ambid.validation/1"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Validation(Result):
    """A result judged on a further record."""

    estimate: str  # names of the result and the record; empty where they have no file
    record: str
    model: str  # what was judged
    samples: int  # of the record
    fit: Mapping[str, Any]  # by output: one step, simulation and so on
    checks: Mapping[str, Check]

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Each check that failed; grave where an output is predicted worse than by its mean."""
        failed = [Reason(check=k, text=c.detail) for k, c in self.checks.items() if not c.passed]
        for output, fit in self.fit.items():
            one = fit["one_step"]
            size = one.get("fit") if isinstance(one, Mapping) else one
            if size is None or not size > 0:
                text = f"{output} is predicted worse than by its mean. Check that both are of the same bench"
                failed.append(Reason(check="one_step", text=text, grave=True))
        return tuple(failed)
