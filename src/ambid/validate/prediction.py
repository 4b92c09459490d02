"""Prediction and simulation with an identified model: how far ahead is it worth anything?"""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.estimation.likelihood import Fit
from ambid.estimation.predictor import Predictor, assemble
from ambid.estimation.sensitivity import Workspace, innovations, run
from ambid.validate.ahead import covariance_ahead, errors_ahead


def fit_of(error: Array, y: Array) -> Array:
    """Return ``1 - |e| / |y - mean|`` of each column: 1 is perfect, 0 as good as the mean.

    `error`, `y`: (n_samples, n_outputs). Returns (n_outputs,).
    """
    spread = np.linalg.norm(y - y.mean(axis=0), axis=0)
    return np.asarray(1 - np.linalg.norm(error, axis=0) / np.where(spread > 0, spread, np.nan))


def simulation_error(fit: Fit) -> Array | None:
    """Return y minus its simulation from the input, offsets and initial state alone, SI.

    Returns (n_used, n_outputs), or None, none where the plant is unstable in open loop: its simulation runs away and
    says nothing.
    """
    predictor = _predictor(fit)
    A = predictor.A
    if np.max(np.abs(np.linalg.eigvals(A))) >= 1.0:
        return None
    work, n = Workspace(fit.problem), A.shape[0]
    M = predictor.M.copy()
    M[:, :n] = A
    M[:, -1 - work.y.shape[1] : -1] = 0.0  # the gain is off: measurements do not correct the state
    e = work.y - run(M, work.z, predictor.x0)[:-1] @ predictor.C.T
    return np.asarray(e * fit.problem.scales.output)


def prediction_error(fit: Fit, steps: int) -> Array:
    """Return y minus its prediction `steps` samples ahead, SI, with the inputs known up to then.

    `steps`: at least 1. Returns (n_used - steps + 1, n_outputs), row k is the error at sample k + steps - 1, predicted
    from outputs before sample k.
    """
    predictor, e = _predictor(fit), innovations(fit.problem, fit.vector)
    if e is None:
        raise ValueError("the fit has no predictor; it has failed")
    ahead = errors_ahead(e, predictor.A, predictor.gain, predictor.C, steps)
    return np.asarray(ahead * fit.problem.scales.output)


def expected_prediction_sd(fit: Fit, steps: int) -> Array:
    """Return the standard deviation that the model gives its own predictions `steps` samples ahead, SI.

    Returns (n_outputs,).
    """
    predictor = _predictor(fit)
    total = covariance_ahead(fit.covariance, predictor.A, predictor.gain, predictor.C, steps)
    return np.asarray(np.sqrt(np.diag(total)) * fit.problem.scales.output)


def _predictor(fit: Fit) -> Predictor:
    predictor = assemble(fit.problem, fit.vector, with_derivatives=False)
    if predictor is None:
        raise ValueError("the fit has no predictor; it has failed")
    return predictor
