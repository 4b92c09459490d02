"""Predictions further ahead than one sample, from a fit of the predictor: their errors, what to expect of them, gains.

From x+ = A x + B u + K e, y = C x + D u + e the error k steps ahead, inputs known, is the sum of the innovations since,
e(t) + C K e(t-1) + ... + C A^(k-2) K e(t-k+1) (Ljung 1999, sec. 3.2).
"""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.estimation.innovations import predictor_gain
from ambid.estimation.likelihood import Fit
from ambid.estimation.predictor import Predictor, assemble
from ambid.estimation.sensitivity import Workspace, innovations, run


def sparse_gain(fit: Fit, stride: int) -> Array:
    """Return the predictor gain for every stride-th output, from the innovations form of the fit."""
    predictor = _predictor(fit)
    A, C, K, S = predictor.A, predictor.C, predictor.gain, fit.covariance
    if not np.any(K):  # sensor noise alone: no state is ever corrected
        return K
    powers = [np.linalg.matrix_power(A, stride - 1 - j) for j in range(stride)]
    Q = sum((p @ K @ S @ K.T @ p.T for p in powers), np.zeros_like(A))
    cross, whole = powers[0] @ K @ S, A @ powers[0]
    # what the innovation says of the noise that comes after it is known, and leaves noises that do not correlate
    shown = np.linalg.solve(S, cross.T).T
    return np.asarray(predictor_gain(whole - shown @ C, C, Q - shown @ cross.T, S).K + shown)


def simulation_error(fit: Fit) -> Array | None:
    """Return y minus its simulation from the input, offsets and initial state alone, SI.

    Returns (n_used, n_outputs); None where the plant is unstable in open loop: its simulation runs away and says
    nothing.
    """
    predictor = _predictor(fit)
    A = predictor.A
    if np.max(np.abs(np.linalg.eigvals(A))) >= 1.0:
        return None
    n, work = A.shape[0], Workspace(fit.problem) if fit.work is None else fit.work.of(fit.problem)
    M = predictor.M.copy()
    M[:, :n] = A
    M[:, -1 - work.y.shape[1] : -1] = 0.0  # the gain is off: measurements do not correct the state
    e = work.y - run(M, work.z, predictor.x0)[:-1] @ predictor.C.T
    return np.asarray(e * fit.problem.scales.output)


def prediction_error(fit: Fit, steps: int) -> Array:
    """Return y minus its prediction `steps` samples ahead, SI, with the inputs known up to then.

    Returns (n_used - steps + 1, n_outputs), row k is the error at sample k + steps - 1, predicted from outputs before
    sample k.
    """
    predictor, e = _predictor(fit), innovations(fit.problem, fit.vector)
    if e is None:
        raise ValueError("the fit has no predictor; it has failed")
    n, out, power = e.shape[0], e[steps - 1 :].copy(), predictor.gain
    for j in range(1, steps):
        out += e[steps - 1 - j : n - j] @ (predictor.C @ power).T
        power = predictor.A @ power
    return np.asarray(out * fit.problem.scales.output)


def expected_prediction_sd(fit: Fit, steps: int) -> Array:
    """Return the standard deviation (n_outputs,) that the model gives its predictions `steps` samples ahead, SI."""
    predictor = _predictor(fit)
    total, power = fit.covariance.copy(), predictor.gain
    for _ in range(1, steps):
        h = predictor.C @ power
        total += h @ fit.covariance @ h.T
        power = predictor.A @ power
    return np.asarray(np.sqrt(np.diag(total)) * fit.problem.scales.output)


def _predictor(fit: Fit) -> Predictor:
    predictor = assemble(fit.problem, fit.vector, with_derivatives=False)
    if predictor is None:
        raise ValueError("the fit has no predictor; it has failed")
    return predictor
