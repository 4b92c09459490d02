"""From a fit and its uncertainty to the estimate that people and programs read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.bearing.uncertainty import Uncertainty
from ambid.estimation.estimate import Continuous, Estimate, NoiseModel
from ambid.estimation.likelihood import Fit
from ambid.estimation.parts import Check, Delay, EstimatedParameter, OutputFit
from ambid.estimation.predictor import Predictor, assemble
from ambid.physics.parameters import Parameter


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
    """Put an estimate together.

    `fit`: not failed; `known`: of that fit; `parameters`: what was known before, in the model's order; `robust`: use
    the larger of information and robust standard deviations; `means`: operating point that was taken off, by role, SI;
    `one_step`, `simulation`: (n_outputs,), fits; `simulation` None where the plant is unstable; `record`, `rig`:
    provenance.
    """
    problem = fit.problem
    theta = problem.parameters(fit.vector)
    sd = dict(zip(known.names, known.standard_deviations(robust=robust).tolist(), strict=True))
    settled = fit.status == "converged"  # of a search that has not ended nothing is certain
    seen = {k: settled and ok for k, ok in zip(known.names, known.identifiable_at(robust=robust), strict=True)}
    alone = dict(zip(known.names, known.data_only_sd.tolist(), strict=True))
    space = problem.model.matrices(theta)
    total = problem.delay_samples(fit.vector)
    whole = int(np.floor(total))
    inputs_delay = Delay(samples=whole, fraction=total - whole, sd=known.delay_sd, how=delay_how)
    return Estimate(
        status=fit.status,
        model=problem.model.name,
        record=record,
        parameters=tuple(EstimatedParameter.of(p, theta, sd, seen, alone) for p in parameters),
        covariance_names=known.names,
        covariance=known.covariance(robust=robust),
        covariance_method="robust" if robust else "information",
        delay=dict.fromkeys(problem.model.inputs, inputs_delay),
        continuous=Continuous(
            states=problem.model.states,
            A=space.A,
            B=space.B,
            C=space.C,
            poles=np.linalg.eigvals(space.A).astype(complex),
        ),
        noise=_noise(fit),
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
        disturbance, sensor = _levels(fit, predictor)
    elif not np.any(predictor.gain):
        disturbance = dict.fromkeys(problem.model.disturbances, 0.0)
        sensor = dict(zip(problem.model.outputs, (np.sqrt(np.diag(fit.covariance)) * sc.output).tolist(), strict=True))
    return NoiseModel(
        form="levels" if problem.noise == "levels" else "gain" if np.any(predictor.gain) else "sensors",
        gain=predictor.gain * sc.state[:, None] / sc.output,
        innovation_covariance=fit.covariance * np.outer(sc.output, sc.output),
        disturbance_sd=disturbance,
        sensor_sd=sensor,
    )


def _levels(fit: Fit, predictor: Predictor) -> tuple[dict[str, float], dict[str, float]]:
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
