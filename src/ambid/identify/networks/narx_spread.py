"""Covariance of the weights of a neural NARX model: Laplace's approximation, or a bootstrap in blocks of time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ambid.identify.networks.narx_train import NarxProblem
from ambid.identify.networks.search import Tick, information_inverse

Array = NDArray[np.float64]

_REPEATS = 100


def laplace(problem: NarxProblem, theta: Array) -> tuple[Array | None, Array, float]:
    """Return the inverse of the information, the prior's included, at the most probable weights (MacKay 1992).

    Parameters
    ----------
    problem : NarxProblem
    theta : ndarray, shape (n_theta,)

    Returns
    -------
    covariance : ndarray, shape (n_theta, n_theta), or None
        None where the data and the prior together leave a direction open.
    noise : ndarray, shape (n_outputs, n_outputs), scaled
        Covariance of the errors.
    effective : float
        Numbers that the data determine: n_theta less what the prior alone does.
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


def bootstrapped(problem: NarxProblem, theta: Array, seed: int, tick: Tick | None) -> Array:
    """Return the covariance of weights after a Gauss-Newton step on blocks of time drawn with replacement.

    Blocks keep the correlation of the errors (Kuensch 1989), which Laplace's approximation takes as white. One step
    from the optimum stays where the network is linear in its weights: whole trainings end in weights that differ while
    the function does not, and their covariance says nothing of the function.

    Parameters
    ----------
    problem : NarxProblem
    theta : ndarray, shape (n_theta,)
        At the optimum.
    seed : int
    tick : callable or None

    Returns
    -------
    ndarray, shape (n_theta, n_theta)
    """
    rng = np.random.default_rng([seed, 1])
    lag, found = problem.shape.lag, []
    lengths = [y.shape[0] - lag for y, _ in problem.parts]
    for _ in range(_REPEATS):
        counts = tuple(_drawn(n, rng) for n in lengths)
        drawn = replace(problem, counts=counts, _rows=problem._rows)
        if tick is not None:
            tick("bootstrap")
        R = drawn.triangle(theta)
        scale = np.maximum(np.linalg.norm(R[:, :-1], axis=0), 1e-150)
        found.append(np.linalg.lstsq(R[:, :-1] / scale, R[:, -1], rcond=1e-10)[0] / scale)
    return np.atleast_2d(np.cov(np.array(found), rowvar=False))


def _drawn(n: int, rng: np.random.Generator) -> Array:
    """How often each sample counts when blocks of about sqrt(n) samples are drawn around the circle."""
    length = max(int(np.sqrt(n)), 1)
    out = np.zeros(n)
    for start in rng.integers(0, n, size=-(-n // length)):
        np.add.at(out, (start + np.arange(length)) % n, 1.0)
    return out
