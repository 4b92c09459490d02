"""Information criteria, so defined that all structures on the same data compare.

With N samples, n_y outputs, S = (1/N) sum e e' of the one-step errors and d estimated numbers (offsets and initial
states, which every structure has, not counted), the Gaussian log likelihood at its maximum is
log L = -(N/2) (log det S + n_y (1 + log 2 pi)), and k = d + n_y (n_y + 1)/2 counts the numbers in S too:

- AIC = -2 log L + 2 k (Akaike 1974);
- AICc = -2 log L + 2 k N/(N - d/n_y - n_y - 1), exact to second order for regressions (Bedrick and Tsai 1994); for one
  output it is AIC + 2 k (k + 1)/(N - k - 1) (Hurvich and Tsai 1989);
- BIC = -2 log L + k log N (Schwarz 1978);
- MDL = det S (1 + (d/n_y) log N/N)^n_y (Rissanen 1978; Ljung 1999, sec. 16.4);
- FPE = det S ((N + d/n_y)/(N - d/n_y))^n_y (Akaike 1971; Ljung 1999, sec. 16.4; Luetkepohl 2005, sec. 4.3).

The first samples are left out, equally for every structure, because there the initial states fit the errors away, more
so the more states there are. AIC, AICc and BIC are in nats times two, MDL and FPE in the outputs' units squared,
multiplied.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import erfc, exp, inf, lgamma, log, sqrt

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError, nearest
from ambid.estimation.linear import least_squares

CRITERIA: tuple[str, ...] = ("ebic", "bic", "mdl", "aic", "aicc", "fpe", "lilc")
EXACT = 1e-26  # part of the output's energy below which nothing is left to explain
_SKIP = 100  # samples left out at the start, at most a tenth of the record
_VANISHED = 1e-14  # variance of errors, scaled, below which nothing is left
_FLOOR = 1e-13  # least error over the size of the output: below is rounding


def skipped(n_samples: int) -> int:
    """Return how many samples are left out at the start."""
    return min(_SKIP, n_samples // 10)


def criteria(e: Array, y: Array, n_estimated: int) -> dict[str, float]:
    """Compute the criteria.

    `e`: (n_samples, n_outputs), SI, one-step errors; `y`: (n_samples, n_outputs), SI, outputs, to tell an error from
    rounding; `n_estimated`: numbers estimated, offsets and initial states not counted. Returns ``aic``, ``aicc``,
    ``bic``, ``mdl``, ``fpe``; ``aicc`` and ``fpe`` are left out where the samples are too few for them.
    """
    used = e[skipped(e.shape[0]) :]
    N, n_y = used.shape
    log_det = log_determinant(used, y)
    per_output = n_estimated / n_y
    k = n_estimated + n_y * (n_y + 1) / 2
    deviance = N * (log_det + n_y * (1 + np.log(2 * np.pi)))
    found = {
        "aic": deviance + 2 * k,
        "aicc": deviance + 2 * k * N / (N - per_output - n_y - 1) if per_output + n_y + 1 < N else np.inf,
        "bic": deviance + k * np.log(N),
        "mdl": np.exp(log_det + n_y * np.log1p(per_output * np.log(N) / N)),
        "fpe": np.exp(log_det + n_y * np.log((N + per_output) / (N - per_output))) if per_output < N else np.inf,
    }
    return {name: float(x) for name, x in found.items() if np.isfinite(x)}


def log_determinant(e: Array, y: Array) -> float:
    """Return log det of the error covariance, no error counted smaller than rounding.

    `e`: (n_used, n_outputs), SI; `y`: (n_samples, n_outputs), SI.
    """
    size = np.maximum(np.max(np.abs(y), axis=0), 1e-300)
    s = np.linalg.svd(e / size, compute_uv=False) / np.sqrt(e.shape[0])
    return float(2 * np.sum(np.log(np.maximum(s, _FLOOR))) + 2 * np.sum(np.log(size)))


def information(criterion: str, left: float, k: int, n: int, m: int) -> float:
    """Return an information criterion of a least-squares fit, up to a constant.

    `criterion`: one of `CRITERIA`; `left`: mean square error, in any unit; `k`, `n`, `m`: terms, samples, candidates.
    """
    return n * log(max(left, EXACT)) + penalty(criterion, k, n, m)


def penalty(criterion: str, k: int, n: int, m: int) -> float:
    """Return what k of m candidates cost on n samples.

    Returns infinite where there are too few samples.
    """
    if criterion in ("bic", "mdl"):
        return k * log(n)
    if criterion == "ebic":
        j = min(k, m // 2)  # beyond, fewer and fewer choices would make terms cheap: none of all could go again
        return k * log(n) + 2.0 * (lgamma(m + 1) - lgamma(j + 1) - lgamma(m - j + 1))
    if criterion == "aic":
        return 2.0 * k
    if criterion == "aicc":
        return 2.0 * k * n / (n - k - 1) if n > k + 1 else float("inf")
    if criterion == "fpe":
        return n * log((n + k) / (n - k)) if n > k else float("inf")
    if criterion == "lilc":
        return 2.0 * k * log(max(log(n), 1.0))
    raise EstimationError(
        f"criterion {criterion!r} is not known; known: {', '.join(CRITERIA)}.{nearest(criterion, list(CRITERIA))}"
    )


def chi_squared_tail(degrees: int, x: float) -> float:
    """Return the probability that chi-squared with that many degrees of freedom exceeds `x`: a finite sum, all of one
    sign (Abramowitz and Stegun 1964, 26.4.4 and 26.4.5). A statistic that is no number has no probability: NaN.
    """
    half, shift = 0.5 * x, 0.5 * (degrees % 2)
    if half != half:  # 1 would pass every test
        return half
    if not 0.0 < half < inf:
        return 0.0 if half == inf else 1.0
    terms = (exp((j + shift) * log(half) - half - lgamma(j + shift + 1.0)) for j in range(degrees // 2))
    return min(1.0, sum(terms, erfc(sqrt(half)) if shift else 0.0))


def explained_by_past(parts: Sequence[tuple[Array, Sequence[tuple[Array, int]]]]) -> tuple[float, float, int]:
    """Return what a linear regression on the past makes of errors; little where a search ended well.

    `parts`: by record the errors (n_samples, n_outputs), and signals (n_samples, n) each with how many of its last
    samples are looked at; rows that are not finite are left out. Returns the part of the variance that it explains,
    corrected for chance, and chi-squared with its degrees of freedom if the past says nothing; 0 where rows are few.
    """
    rows, targets = [], []
    for e, known in parts:
        first, n = max(most for _, most in known), e.shape[0]
        past = [x[first - k : n - k] for x, most in known for k in range(1, most + 1)]
        rows.append(np.hstack([*past, np.ones((max(n - first, 0), 1))]))
        targets.append(e[first:])
    Z, E = np.concatenate(rows), np.concatenate(targets)
    sound = np.all(np.isfinite(Z), axis=1) & np.all(np.isfinite(E), axis=1)
    Z, E = Z[sound], E[sound]
    (n, p), k = E.shape, Z.shape[1]
    if n < 4 * k:
        return 0.0, 0.0, p * k
    left = E - Z @ least_squares(Z, E)
    before, after = (np.linalg.slogdet(x.T @ x / n + _VANISHED * np.eye(p))[1] for x in (E, left))
    gained, by_chance = float(before - after), -p * log(1.0 - k / n)
    if not np.isfinite(gained):
        return 0.0, 0.0, p * k
    return 1.0 - exp((by_chance - gained) / p), n * gained, p * k
