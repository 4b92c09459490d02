"""Covariance of output-error coefficients when the output's noise is coloured.

The estimate minimises the sum of squares of y - G(theta) u; with noise v = H w that is independent of the inputs its
covariance is (J'J)^-1 J' R J (J'J)^-1, R the covariance of v (Soederstrom and Stoica 1989, sec. 7.5; Ljung 1999, sec.
9.4), not the (J'J)^-1 var(v) of white noise, which may be many times too small for slow noise, or too large.
"""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.fit import BlackBoxFit
from ambid.validate.blackbox.gradient import Gradient
from ambid.validate.blackbox.score import coloured, power_gain, triangle


def coloured_covariance(fit: BlackBoxFit, e: Array, slopes: Gradient, colours: tuple[Array, ...]) -> Array | None:
    """Compute the covariance of the coefficients under coloured noise.

    `fit`: an output-error model; `e`: (n_samples, n_outputs), SI, its simulation errors; `slopes`: derivatives of its
    simulation; `colours`: autoregression of the errors of each output. Returns (n_theta, n_theta), or None, none where
    directions are not coefficients, or not independent. Errors of different outputs are taken to be independent of each
    other.
    """
    if slopes.theta is None or fit.covariance is None:
        return None
    out = np.zeros_like(fit.covariance)
    for o, (J, place) in enumerate(zip(slopes.rows, slopes.theta, strict=True)):
        if not place.size:
            continue
        size = np.linalg.norm(J, axis=0)
        if not np.all(size > 0):
            return None
        wide = np.hstack([J / size, np.full((J.shape[0], 1), 1 / np.sqrt(J.shape[0]))])  # the constant is estimated too
        Q, R = np.linalg.qr(wide)
        if np.min(np.abs(np.diag(R))) < 1e-10:
            return None
        noise = float(np.mean((e[:, o] - e[:, o].mean()) ** 2)) * J.shape[0] / max(J.shape[0] - wide.shape[1], 1)
        half = triangle(coloured(Q, colours[o])) @ np.linalg.inv(R).T
        inner = half.T @ half * noise / power_gain(colours[o])
        out[np.ix_(place, place)] = inner[:-1, :-1] / np.outer(size, size)
    return out
