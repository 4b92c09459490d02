"""One run of a Monte Carlo experiment, and many of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.bearing.linear import greybox
from ambid.bearing.uncertainty import uncertainty
from ambid.estimation.likelihood import innovations, linearise, weight_of
from ambid.estimation.linear import one_thread
from ambid.estimation.predictor import assemble
from ambid.validation.physical import innovation_products, innovation_tests
from tests.bearing.benches import parameters, problem_of, run

NAMES = ("m", "k_x", "k_i", "R", "L")
EXCITATION_SEED = 5


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """What one run found, in units of the truth.

    `score` (half the gradient of the squared innovations) and `information` belong to the whole vector at the truth,
    weighted by the true innovation covariance: the score has mean zero whatever the estimator does.
    """

    estimate: np.ndarray
    sd: np.ndarray
    white: float
    uncorrelated: float
    converged: bool
    score: np.ndarray
    information: np.ndarray
    unit: np.ndarray


def one_run(seed: int, *, n: int) -> Outcome:
    """Simulate and identify once; only the noise differs between seeds (and through the loop the voltage)."""
    bench = run("bearing", n, 1000 + seed, delay=0.0, excitation_seed=EXCITATION_SEED)
    wanted = parameters(bench, fixed=("c",), start=bench.truth)
    fit = greybox(bench.model, bench.signals, wanted, delay=0, noise="levels")
    known, e = uncertainty(fit), innovations(fit.problem, fit.vector)
    theta = fit.problem.parameters(fit.vector)
    truth = np.array([bench.truth[k] for k in NAMES])
    problem, vector = problem_of(bench, estimated=NAMES)
    # the problem's unit of output is 1.5 times the sensor noise
    covariance = assemble(problem, vector, with_derivatives=False).innovations.S / 1.5**2
    at = linearise(problem, vector, weight_of(covariance))
    own, inputs = innovation_tests(fit, innovation_products(fit, e))
    return Outcome(
        estimate=np.array([theta[k] for k in NAMES]) / truth,
        sd=known.standard_deviations(robust=False) / np.abs(truth),
        white=own.p,
        uncorrelated=inputs.p,
        converged=fit.status == "converged",
        score=at.J.T @ at.r,
        information=at.J.T @ at.J,
        unit=problem.magnitude / truth,
    )


def many(n_runs: int, *, n: int) -> list[Outcome]:
    """Run one after another, with one thread of linear algebra: other files of tests keep the other cores busy."""
    with one_thread():
        return [one_run(seed, n=n) for seed in range(n_runs)]
