"""The core of every instrumental variable method: Z' (target - Phi theta) = 0 through orthogonal factors.

Neither Z' Z nor Z' Phi is formed from raw columns: Z = Q R, and Q' Phi theta = Q' target is solved by singular values.
With more instruments than unknowns this is two-stage least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.instrumental.noise import Autoregression, autoregression, score_covariance
from ambid.errors import EstimationError

_BLIND = 1e-11  # relative singular value under which the instruments do not see a direction
_INCLUDED = 1e-10  # part of a regressor outside the instruments under which it is an instrument itself
_COLOUR = 20  # highest order of its noise
_WEAK = 16.0  # first-stage F under which instruments are called weak
_EXACT = 1e12  # strength of instruments that explain everything


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solution:
    """Estimate of one instrumental variable step."""

    theta: Array  # (n_theta,)
    residual: Array  # (n_samples,), target - Phi theta
    Q: Array  # (n_samples, n_instruments), orthonormal instruments
    inverse: Array  # (n_theta, n_instruments), generalised inverse of Q' Phi
    condition: float  # of Q' Phi, its columns scaled
    regressors: Array  # (n_samples, n_theta), phi, columns of unit length

    def covariance(self, noise: Autoregression) -> Array:
        """Return (Q' Phi)^-1 Cov(Q' e) (Q' Phi)^-T (Soderstrom and Stoica 1989, sec. 8.2).

        `noise`: of the residual. Returns (n_theta, n_theta).
        """
        return np.asarray(self.inverse @ score_covariance(self.Q, noise) @ self.inverse.T)

    def strength(self) -> float:
        """Return the first-stage F of the direction of the regressors that the instruments see least.

        It is that of the least canonical correlation (Cragg and Donald 1993). What the instruments leave of it is no
        white noise: the variance of its product with them is that of its colour (Kleibergen and Paap 2006). Regressors
        that are instruments themselves have the correlation 1. Wald tests of 5 % have a size of at most 10 % from about
        16 on (Stock and Yogo 2005).

        Returns at most 1e12.
        """
        basis = np.linalg.qr(self.regressors)[0]
        left, seen, right = np.linalg.svd(self.Q.T @ basis, full_matrices=False)
        if 1.0 - seen[-1] < _INCLUDED:
            return _EXACT
        way, direction = self.Q @ left[:, -1], basis @ right[-1]
        noise = autoregression(direction - seen[-1] * way, _COLOUR)
        variance = float(score_covariance(way[:, None], noise)[0, 0])
        return float(min(seen[-1] ** 2 / max(variance, 1.0 / _EXACT), _EXACT))


def solve(instruments: Array, regressors: Array, target: Array, *, who: str) -> Solution:
    """Solve one instrumental variable step.

    `instruments`: (n_samples, n_instruments), at least as many as regressors; `regressors`: (n_samples, n_theta);
    `target`: (n_samples,); `who`: method, for the error.
    """
    z_size, size = _norms(instruments), _norms(regressors)
    Q = np.linalg.qr(instruments / z_size)[0]
    left, values, right = np.linalg.svd(Q.T @ (regressors / size), full_matrices=False)
    if not np.all(np.isfinite(values)) or values[-1] <= _BLIND * values[0]:
        raise EstimationError(
            f"{who}: the input or reference does not move every term of this model, so that its coefficients have no "
            "single solution. Lower the orders, excite more frequencies, or give more independent references"
        )
    inverse = (right.T / values) @ left.T / size[:, None]
    theta = inverse @ (Q.T @ target)
    return Solution(
        theta=theta,
        residual=target - regressors @ theta,
        Q=Q,
        inverse=inverse,
        condition=float(values[0] / values[-1]),
        regressors=regressors / size,
    )


def weak(solutions: Sequence[Solution], outputs: Sequence[str]) -> list[str]:
    """Warn of outputs whose instruments are weak: errors are then not normal, and their spread is not the one given.

    `solutions`: last step of each output.
    """
    found = [(x.strength(), name) for x, name in zip(solutions, outputs, strict=True)]
    return [
        f"the instruments of {name!r} are weak: the reference or input moves one combination of the terms hardly more "
        f"than noise does (first-stage F = {F:.2g}, under {_WEAK:g}). The estimate leans towards least squares, and "
        "errors may be many times the standard deviations given. Excite more, take a longer record, or use bj or armax"
        for F, name in found
        if F < _WEAK
    ]


def without(nuisance: Array, columns: Array) -> Array:
    """Take off what offsets and initial states explain: the part of `columns` in the span of `nuisance`.

    `nuisance`: (n_samples, n_nuisance), may be rank deficient; `columns`: (n_samples, n_columns). Returns (n_samples,
    n_columns).
    """
    basis = span(nuisance)
    return np.asarray(columns - basis @ (basis.T @ columns))


def span(columns: Array) -> Array:
    """Return an orthonormal basis of the columns, dependent ones left out.

    `columns`: (n_samples, n_columns). Returns (n_samples, rank).
    """
    from scipy.linalg import qr

    Q, R, _ = qr(columns / _norms(columns), mode="economic", pivoting=True)
    diagonal = np.abs(np.diag(R))
    return np.ascontiguousarray(Q[:, diagonal > 1e-10 * diagonal[0]])


def _norms(columns: Array) -> Array:
    size = np.linalg.norm(columns, axis=0)
    return np.where(size > 0, size, 1.0)
