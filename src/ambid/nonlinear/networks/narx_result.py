"""The fit that comes out of a neural NARX training: model in SI, covariance, noise, warnings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from ambid.blackbox.data import IOData
from ambid.nonlinear.cloud import cloud_of
from ambid.nonlinear.failed import NO_WEIGHTS, failed_fit, provenance
from ambid.nonlinear.fit import NonlinearFit
from ambid.nonlinear.networks.narx_choice import problem_at
from ambid.nonlinear.networks.narx_model import NeuralNarx
from ambid.nonlinear.networks.narx_spread import laplace, sandwiched
from ambid.nonlinear.records import Scaled

if TYPE_CHECKING:
    from ambid.nonlinear.networks.narx import Work


def finished(
    records: Sequence[IOData], used: Mapping[str, object], data: Scaled, work: Work, *, seed: int
) -> NonlinearFit:
    """Return the fit of trained weights.

    `used`: settings. Returns failed where the weights or the errors are not finite.
    """
    began = perf_counter()
    shape, theta = work.shape, work.theta
    problem = problem_at(shape, data.parts, theta, float(used["prior"]), free=work.free)  # type: ignore[arg-type]
    if not np.isfinite(problem.cost(theta)):
        return failed_fit("narx", records, used, seed, NO_WEIGHTS, work.timing_s)
    covariance, noise, effective = laplace(problem, theta)
    covariance_from = "laplace"
    warnings = [*work.warnings, *_cautions(records, data, work)]
    if work.covariance is not None:
        covariance, covariance_from = work.covariance, "bootstrap"
    elif used["uncertainty"] == "none":
        covariance = None
        warnings.append("no covariance was asked for, and so there are no standard deviations")
    elif used["uncertainty"] == "sandwich" or (work.free and used["uncertainty"] == "auto"):
        covariance, covariance_from = sandwiched(problem, theta), "sandwich"
    elif work.free:
        covariance = None
        warnings.append(
            "no standard deviations: simulation errors are coloured, and Laplace's approximation takes them as white. "
            "Say uncertainty = sandwich or bootstrap"
        )
    if covariance is None and used["uncertainty"] != "none" and not (work.free and used["uncertainty"] == "laplace"):
        warnings.append("no standard deviations: data and prior do not determine the weights. Fewer neurons or lags")
    regressors = np.concatenate([shape.regressors(y, u) for y, u in data.parts])
    model = NeuralNarx(
        dt=records[0].dt,
        shape=shape,
        theta=theta,
        u_level=data.u_level,
        u_scale=data.u_scale,
        y_level=data.y_level,
        y_scale=data.y_scale,
        cloud=cloud_of(regressors),
    )
    work.timing_s["result"] = perf_counter() - began
    work.timing_s["all"] = sum(work.timing_s.values())
    return NonlinearFit(
        structure="narx",
        settings={**used, "focus": "simulation" if work.free else "prediction"},
        model=model,
        covariance=covariance,
        covariance_from="" if covariance is None else covariance_from,
        n_estimated=int(theta.size),
        noise_covariance=noise * data.y_scale[:, None] * data.y_scale,
        seed=seed,
        status=work.status,
        curves=tuple(work.curves),
        warnings=tuple(warnings),
        timing_s=dict(work.timing_s),
        details={
            "effective_parameters": effective,
            "stopped_early": work.stopped_early,
            "held_out_rms": work.held_out,
            "tried": [{"ny": x.ny, "nu": x.nu, "neurons": x.neurons, "held_out_rms": x.held_out} for x in work.tried],
        },
        **provenance(records),
    )


def _cautions(records: Sequence[IOData], data: Scaled, work: Work) -> list[str]:
    found = []
    if records[0].n_inputs and not all(x.open_loop for x in records):
        what = "the free run" if work.free else "one-step errors"
        found.append(
            f"narx has no noise model: trained on {what}, it is biased under feedback unless its errors are white, and "
            "nothing says that these records are open loop. Use narmax or nn, or say --open-loop"
        )
    if work.stopped_early:
        found.append(
            "training was stopped where the held-out error was least: more neurons than the data carry; standard "
            "deviations are those of a linearisation there"
        )
    free = problem_at(work.shape, data.parts, work.theta, 1.0, free=True)
    if not work.free and not np.isfinite(free.cost(work.theta)):
        found.append(
            "the free run diverges on the records that the model was trained on: it predicts, but does not simulate"
        )
    return found
