"""Covariance of the weights of a neural NARX model: Laplace's approximation, or the sandwich."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ambid.arrays import Array
from ambid.estimation.linear import information_inverse
from ambid.estimation.uncertainty import sandwich
from ambid.nonlinear.networks.narx_train import NarxProblem


def laplace(problem: NarxProblem, theta: Array) -> tuple[Array | None, Array, float]:
    """Return the inverse of the information, the prior's included, at the most probable weights (MacKay 1992).

    `theta`: (n_theta,). Returns `covariance`: (n_theta, n_theta), or None, none where the data and the prior together
    leave a direction open; `noise`: (n_outputs, n_outputs), scaled, covariance of the errors; `effective`: numbers that
    the data determine: n_theta less what the prior alone does.
    """
    errors = np.concatenate(problem.errors(theta))
    n, p = errors.shape
    noise = errors.T @ errors / n
    P, effective = None, float(theta.size)
    for _ in range(2):  # the degrees of freedom are those that the prior leaves
        weight = 1.0 / np.sqrt(np.maximum(np.diag(noise), 1e-14))
        at = replace(problem, weight=weight, _rows=problem._rows)
        P, _condition = information_inverse(at.triangle(theta)[:, :-1])
        if P is None:
            break
        effective = float(theta.size - np.sum(np.diag(P) * at._precision() ** 2))
        noise = errors.T @ errors / max(n - effective / p, 1.0)
    return P, noise, effective


def sandwiched(problem: NarxProblem, theta: Array) -> Array | None:
    """Return the covariance that does not take errors as white, as those of a free run are not.

    `theta`: (n_theta,), at the optimum. Returns (n_theta, n_theta), or None, none where the data and the prior together
    leave a direction open.
    """
    rows = problem.sample_rows(theta)
    scores = [np.einsum("tok,to->tk", r[:, :, :-1], r[:, :, -1]) for r in rows]
    prior = np.diag(problem._precision() ** 2)
    return sandwich(problem.triangle(theta)[:, :-1], scores, prior, [r[:, :, :-1] for r in rows])[0]
