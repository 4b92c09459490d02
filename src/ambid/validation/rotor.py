"""What the innovations of a rotor's predictor say of its model."""

from __future__ import annotations

import numpy as np

from ambid.bearing.uncertainty import noise_levels
from ambid.estimation.estimate import OutputFit
from ambid.estimation.likelihood import innovations
from ambid.estimation.predictor import assemble
from ambid.rotor.conclusion import Evidence
from ambid.rotor.prediction import PredictorFit
from ambid.validation.physical import innovation_products, innovation_tests
from ambid.validation.residuals import fit_of, uncorrelated_check, white_check


def of_predictor(found: PredictorFit) -> Evidence:
    """Return the evidence of innovations: score tests of whiteness and against past inputs, one-step fit, levels."""
    fit, problem = found.fit, found.fit.problem
    predictor, e = assemble(problem, fit.vector, with_derivatives=False), innovations(problem, fit.vector, fit.work)
    if predictor is None or e is None:
        raise ValueError("the fit has no predictor; it has failed")
    white, past = innovation_tests(fit, innovation_products(fit, e))
    disturbance, sensor = noise_levels(fit, predictor)
    e = e * problem.scales.output
    share, size = fit_of(e, problem.y[problem.skip :]), np.sqrt(np.mean(e**2, axis=0))
    return Evidence(
        method="predictor",
        noise={**sensor, **disturbance},
        fit={
            role: OutputFit(one_step=float(a), simulation=None, innovation_sd=float(b))
            for role, a, b in zip(found.model.outputs, share, size, strict=True)
        },
        checks={"residuals_white": white_check(white), "residuals_uncorrelated": uncorrelated_check(past)},
    )
