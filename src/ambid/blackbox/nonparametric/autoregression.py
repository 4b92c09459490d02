"""A long regularised autoregression of all outputs, and the impulse responses that follow from it.

y[t] = sum of A_k y[t-k] + B_k u[t-k] + e[t]: with enough lags e is white, and its taps are estimated without bias
whatever made u (feedback through a delay included). The responses of the plant are G = (1 - A)^-1 B; their spread
follows by the delta method, dG = (1 - A)^-1 (dB + dA G).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.nonparametric.bayes import Triangle, posterior, triangle
from ambid.blackbox.nonparametric.kernels import Kernel


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictorTaps:
    """Taps of the one-step predictor, for signals over their standard deviations."""

    mean: Array  # for each output: past of every output, then of every input, lag 1 first
    covariance: Array  # (n_outputs, n_outputs, p, p), between the taps of two outputs
    noise: Array  # (n_outputs, n_outputs), covariance of e
    y_sd: Array  # (n_outputs,)
    u_sd: Array  # (n_inputs,)
    kernels: tuple[str, ...]
    # probability of the correlation that is left between outputs and inputs of one sample, if there is no path between
    # them that is faster than a sample; 1 where the record is too short to see one
    within_sample: float


def predictor_taps(data: IOData, lags: int, kernels: Sequence[Kernel]) -> PredictorTaps:
    """Estimate the taps of the predictor."""
    y_sd, u_sd = data.y.std(axis=0), data.u.std(axis=0)
    z = np.hstack([(data.y - data.y.mean(axis=0)) / y_sd, (data.u - data.u.mean(axis=0)) / u_sd])
    n_y = data.n_outputs
    whole = triangle([(x, k) for x in z.T for k in range(1, lags + 1)], z, lags)
    t = replace(whole, r=whole.r[:, :n_y], left=whole.left[:n_y, :n_y])
    found = [posterior(t, o, (lags,) * z.shape[1], kernels) for o in range(n_y)]
    mean = np.stack([f.mean for f in found])
    error = t.r - t.R @ mean.T
    noise = (t.left + error.T @ error) / max(t.rows - 1 - float(np.mean([f.freedom for f in found])), 1.0)
    # between outputs: what noise of both leaves in both; within one: the posterior, prior's share included
    p = mean.shape[1]
    covariance = np.empty((n_y, n_y, p, p))
    weight = [(f.covariance / f.noise_variance) @ t.R.T for f in found]
    for a in range(n_y):
        for b in range(n_y):
            covariance[a, b] = found[a].covariance if a == b else noise[a, b] * weight[a] @ weight[b].T
    return PredictorTaps(
        mean=mean,
        covariance=covariance,
        noise=noise,
        y_sd=y_sd,
        u_sd=u_sd,
        kernels=tuple(f.kernel for f in found),
        within_sample=_within_sample(whole, n_y),
    )


def _within_sample(t: Triangle, n_y: int) -> float:
    """Wilks' test that what the past leaves of outputs and of inputs is independent (Bartlett's factor)."""
    from scipy.stats import chi2

    n_z, freedom = t.left.shape[0], t.rows - 1 - t.R.shape[0]
    rows = freedom - 0.5 * (n_z + 1)
    sizes = np.sqrt(np.diag(t.left))
    if rows < n_z or not np.all(sizes > 0):
        return 1.0
    r = t.left / np.outer(sizes, sizes)
    parts = [np.linalg.slogdet(x)[1] for x in (r, r[:n_y, :n_y], r[n_y:, n_y:])]
    return float(chi2.sf(max(rows * (parts[1] + parts[2] - parts[0]), 0.0), n_y * (n_z - n_y)))


def responses(taps: PredictorTaps, n_y: int, n_u: int, lags: int) -> tuple[Array, Array]:
    """Return the plant's impulse responses at lags 1 to `lags`, and the covariance of each.

    Returns `values`: (lags, n_y, n_u); `covariance`: (n_y, n_u, lags, lags).
    """
    parts = taps.mean.reshape(n_y, n_y + n_u, lags)
    A, B = np.moveaxis(parts[:, :n_y], 2, 0), np.moveaxis(parts[:, n_y:], 2, 0)
    inverse = np.zeros((lags, n_y, n_y))  # (1 - A)^-1, from lag 0
    inverse[0] = np.eye(n_y)
    for k in range(1, lags):
        inverse[k] = np.einsum("jab,jbc->ac", A[:k], inverse[k - 1 :: -1][:k])
    G = np.zeros((lags, n_y, n_u))
    for k in range(lags):
        G[k] = np.einsum("jab,jbc->ac", inverse[: k + 1], B[k::-1])
    covariance = np.empty((n_y, n_u, lags, lags))
    for o in range(n_y):
        for i in range(n_u):
            slopes = [_slope(inverse[:, o, p], G, i, n_y, n_u, lags) for p in range(n_y)]
            covariance[o, i] = sum(
                slopes[a] @ taps.covariance[a, b] @ slopes[b].T for a in range(n_y) for b in range(n_y)
            )
    return G, covariance


def _slope(through: Array, G: Array, i: int, n_y: int, n_u: int, lags: int) -> Array:
    """Derivative of one response, (lags, p), by the predictor taps of an output that acts by `through`."""
    from scipy.linalg import toeplitz

    out = np.zeros((lags, (n_y + n_u) * lags))
    zero = np.zeros(lags)
    own = slice((n_y + i) * lags, (n_y + i + 1) * lags)
    out[:, own] = toeplitz(through, zero)  # dB_j acts from lag j on
    for q in range(n_y):  # dA_j acts on G, which begins at lag 1: from lag j + 1 on
        echo = np.concatenate([[0.0], np.convolve(through, G[:, q, i])[: lags - 1]])
        out[:, q * lags : (q + 1) * lags] = toeplitz(echo, zero)
    return out
