"""Covariance of a state-space estimate by leaving out one group of time after another.

Solves: cov(theta) = (G-1)/G sum_g (theta_g - mean)(theta_g - mean)' + b b', with theta_g the estimate without group g
and b = (G-1)(mean - theta) the bias that shows when data are left out: what oblique projections owe to short records.
A regression with a prior gets no b: fewer data only make its prior weigh more. States have no natural basis: each
estimate is first turned into the basis of the full one through the observability matrices, which fixes the gauge, so
that spreads of poles and responses follow by the delta method (delete-a-group jackknife; Shao and Tu 1995, ch. 2).
Residuals count as they are: correlated, of changing size, of a model that is too small.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.subspace.realisation import Realisation, least_squares, observability


def aligned(one: Realisation, like: Realisation, length: int) -> Realisation:
    """Return a realisation in the state basis of another.

    `one`, `like`: of equal order; `length`: block rows of the observability matrices that are compared.
    """
    T = least_squares(observability(one.A, one.C, length), observability(like.A, like.C, length))
    back = np.linalg.inv(T)
    return Realisation(
        A=back @ one.A @ T,
        B=back @ one.B,
        C=one.C @ T,
        D=one.D,
        K=back @ one.K,
        innovation=one.innovation,
        Q=back @ one.Q @ back.T,
        S=back @ one.S,
        R=one.R,
        stable_predictor=one.stable_predictor,
    )


def jackknife(full: Realisation, others: Sequence[Realisation], length: int, *, with_bias: bool) -> Array | None:
    """Return the covariance of vec(A, B, C, D, K), each row by row.

    `full`: from all groups; `others`: each without one group; `length`: block rows of the observability matrices that
    are compared; `with_bias`: whether to add the square of the bias that leaving out data shows. Returns (n_theta,
    n_theta), or None, none where a basis cannot be matched.
    """
    rows = []
    for one in others:
        try:
            same = aligned(one, full, length)
        except np.linalg.LinAlgError:
            return None
        rows.append(theta(same))
    values = np.array(rows)
    if not np.all(np.isfinite(values)):
        return None
    deviations = values - values.mean(0)
    groups = values.shape[0]
    covariance = (groups - 1) / groups * deviations.T @ deviations
    if with_bias:
        bias = (groups - 1) * (values.mean(0) - theta(full))
        covariance = covariance + np.outer(bias, bias)
    return np.asarray(covariance)


def theta(one: Realisation) -> Array:
    """Return the coefficients in the order of `StateSpaceModel.theta`.

    Returns (n_theta,).
    """
    return np.concatenate([getattr(one, m).ravel() for m in "ABCDK"])
