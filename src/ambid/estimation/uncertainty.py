"""Statistics of a fit: information criteria, and covariances (sandwich) that keep the
correlation of scores over n^0.6 samples (Kuensch 1989; Newey and West 1987). Inputs stay as measured under feedback.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from math import erfc, exp, inf, lgamma, log, sqrt

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError, nearest
from ambid.estimation.linear import information_inverse, triangle_of

CRITERIA: tuple[str, ...] = ("ebic", "bic", "mdl", "aic", "aicc", "fpe", "lilc")
EXACT = 1e-26  # part of the output's energy below which nothing is left to explain
_SKIP = 100  # samples left out at the start, at most a tenth of the record
_VANISHED = 1e-14  # variance of errors, scaled, below which nothing is left
_FLOOR = 1e-13  # least error over the size of the output: below is rounding


def skipped(n_samples: int) -> int:
    """Return how many samples are left out at the start."""
    return min(_SKIP, n_samples // 10)


def criteria(e: Array, y: Array, n_estimated: int) -> dict[str, float]:
    """Return ``aic``, ``aicc``, ``bic``, ``mdl``, ``fpe`` of one-step errors `e` (n_samples, n_outputs), SI, so that
    all structures on the same data compare; ``aicc`` and ``fpe`` are left out where samples are too few.

    With S = (1/N) sum e e', d = `n_estimated` numbers (offsets and initial states not counted), k = d + n_y (n_y + 1)/2
    and log L = -(N/2) (log det S + n_y (1 + log 2 pi)): AIC = -2 log L + 2 k (Akaike 1974); AICc = -2 log L + 2 k N/(N
    - d/n_y - n_y - 1) (Bedrick and Tsai 1994; of one output Hurvich and Tsai 1989); BIC = -2 log L + k log N (Schwarz
    1978); MDL = det S (1 + (d/n_y) log N/N)^n_y (Rissanen 1978); FPE = det S ((N + d/n_y)/(N - d/n_y))^n_y (Akaike
    1971; Ljung 1999, sec. 16.4; Luetkepohl 2005, sec. 4.3). The first samples, which initial states fit, are left out
    equally. The first three are in nats times two, MDL and FPE in the outputs' units squared, multiplied.
    """
    settled = e[skipped(e.shape[0]) :]
    N, n_y = settled.shape
    log_det = log_determinant(settled, y)
    per_output = n_estimated / n_y
    k = n_estimated + n_y * (n_y + 1) / 2
    deviance = N * (log_det + n_y * (1 + np.log(2 * np.pi)))
    values = {
        "aic": deviance + 2 * k,
        "aicc": deviance + 2 * k * N / (N - per_output - n_y - 1) if per_output + n_y + 1 < N else np.inf,
        "bic": deviance + k * np.log(N),
        "mdl": np.exp(log_det + n_y * np.log1p(per_output * np.log(N) / N)),
        "fpe": np.exp(log_det + n_y * np.log((N + per_output) / (N - per_output))) if per_output < N else np.inf,
    }
    return {name: float(x) for name, x in values.items() if np.isfinite(x)}


def log_determinant(e: Array, y: Array) -> float:
    """Return log det of the covariance of errors `e` (n_used, n_outputs), SI, none smaller than the rounding of `y`."""
    size = np.maximum(np.max(np.abs(y), axis=0), 1e-300)
    s = np.linalg.svd(e / size, compute_uv=False) / np.sqrt(e.shape[0])
    return float(2 * np.sum(np.log(np.maximum(s, _FLOOR))) + 2 * np.sum(np.log(size)))


def information(criterion: str, left: float, k: int, n: int, m: int) -> float:
    """Return a criterion of `CRITERIA` up to a constant; `left`: mean square error; `k`, `n`, `m`: terms, samples,
    candidates.
    """
    return n * log(max(left, EXACT)) + penalty(criterion, k, n, m)


def penalty(criterion: str, k: int, n: int, m: int) -> float:
    """Return what k of m candidates cost on n samples, infinite where these are too few."""
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
        f"criterion {criterion!r} is unknown; known: {', '.join(CRITERIA)}.{nearest(criterion, list(CRITERIA))}"
    )


def chi_squared_tail(degrees: int, x: float) -> float:
    """Return the probability that chi-squared with that many degrees of freedom exceeds `x`: a finite sum, all of one
    sign (Abramowitz and Stegun 1964, 26.4.4 and 26.4.5). A statistic that is not a number has no probability: NaN.
    """
    half, shift = 0.5 * x, 0.5 * (degrees % 2)
    if half != half:  # 1 would pass every test
        return half
    if not 0.0 < half < inf:
        return 0.0 if half == inf else 1.0
    terms = (exp((j + shift) * log(half) - half - lgamma(j + shift + 1.0)) for j in range(degrees // 2))
    return min(1.0, sum(terms, erfc(sqrt(half)) if shift else 0.0))


def p_text(p: float) -> str:
    """Return a probability as it is printed: one that has underflowed to zero is given as a bound."""
    return "p < 1e-16" if p < 1e-16 else f"p = {p:.2g}"


def explained_by_past(
    parts: Sequence[tuple[Array, Sequence[tuple[Array, int]]]], *, least: float = 4.0
) -> tuple[float, float, int]:
    """Return the part of errors' variance that a linear regression on the past explains, corrected for chance, little
    where a search ended well, and chi-squared with its degrees of freedom if the past says nothing; 0 where rows are
    fewer than `least` a column. `parts`: by record errors (n_samples, n_outputs) and signals, each with how many past
    samples.
    """
    rows, targets = [], []
    for e, signals in parts:
        first, n = max(most for _, most in signals), e.shape[0]
        past = [x[first - k : max(n, first) - k] for x, most in signals for k in range(1, most + 1)]
        rows.append(np.hstack([*past, np.ones((max(n - first, 0), 1))]))
        targets.append(e[first:])
    Z, E = np.concatenate(rows), np.concatenate(targets)
    sound = np.all(np.isfinite(Z), axis=1) & np.all(np.isfinite(E), axis=1)
    Z, E = Z[sound], E[sound]
    (n, p), k = E.shape, Z.shape[1]
    if n < max(least * k, k + 2):
        return 0.0, 0.0, p * k
    left = triangle_of([np.hstack([Z, E])])[k:, k:]
    before, after = (np.linalg.slogdet(x.T @ x / n + _VANISHED * np.eye(p))[1] for x in (E, left))
    gained, by_chance = float(before - after), -p * log(1.0 - k / n)
    if not np.isfinite(gained):
        return 0.0, 0.0, p * k
    return 1.0 - exp((by_chance - gained) / p), n * gained, p * k


WEAK = 0.25  # relative standard deviation from which a parameter counts as not identifiable
_MANY = 20  # records from which on whole records are drawn
_FEWEST = 8  # blocks of a record
_BEGINS = 4  # of blocks, that are averaged over
_SHOWN_ALONE = 0.1  # share of a direction's information that all other blocks count as having at least


def block_length(n: int) -> int:
    """Return the samples over which scores are taken to hang together, of a record of `n`."""
    length: int = max(min(round(float(n) ** 0.6), n // _FEWEST), 1)
    return length


def score_covariance(scores: Sequence[Array], part: float = 0.0, slopes: Sequence[Array] | None = None) -> Array:
    """Return the covariance (n_theta, n_theta) of the sum of all scores (n_samples, n_theta), of each record, from
    blocks of time that begin at several places. With `slopes` (n_samples, n_outputs, n_theta) a block's sum is what
    leaving it out moves (jackknife; Cameron, Gelbach and Miller 2008, CV3): errors that pull the fit towards themselves
    are too small.
    """
    by_record = len(scores) >= _MANY
    lengths = _lengths(scores, part)
    begins = [0] if by_record else [(k * max(lengths)) // _BEGINS for k in range(min(_BEGINS, max(lengths)))]
    out = np.zeros((scores[0].shape[1],) * 2)
    for begin in begins:
        sums_of_blocks = []
        for k, (own, length) in enumerate(zip(scores, lengths, strict=True)):
            n = own.shape[0]
            edges = [0, *range(begin % length or length, n - length // 2, length), n]
            for a, b in pairwise(edges):
                block = own[a:b].sum(axis=0)
                sums_of_blocks.append(block if slopes is None else _left_out(slopes[k][a:b], block))
        sums = np.array(sums_of_blocks)
        sums -= sums.mean(axis=0)
        out += sums.T @ sums * (len(sums_of_blocks) / max(len(sums_of_blocks) - 1.0, 1.0))
    mean: Array = out / len(begins)
    return mean


def _lengths(scores: Sequence[Array], part: float) -> list[int]:
    """Samples of a block, by record; whole records where there are many."""
    sizes = [s.shape[0] for s in scores]
    return sizes if len(sizes) >= _MANY else [max(block_length(n), round(part * n)) for n in sizes]


def _left_out(slopes: Array, score: Array) -> Array:
    """(I - Q'Q)^-1 Q'e of a block; along what the block alone shows (its record's first state) nothing is blown up."""
    Q = slopes.reshape(-1, slopes.shape[-1])
    leverage, V = np.linalg.eigh(Q.T @ Q)
    out: Array = V @ ((V.T @ score) / np.maximum(1.0 - leverage, _SHOWN_ALONE))
    return out


def widening(scores: Sequence[Array], part: float = 0.0) -> float:
    """Return Student's quantile over the normal one, squared, by which a covariance from few blocks is multiplied so
    that 1.96 deviations still hold 95 %; arguments as `score_covariance`.
    """
    from scipy.special import stdtrit

    blocks = sum(max(round(s.shape[0] / k), 1) for s, k in zip(scores, _lengths(scores, part), strict=True))
    return float((stdtrit(max(blocks - 1, 2), 0.975) / 1.959964) ** 2)


def sandwich(
    R: Array, scores: Sequence[Array], prior: Array | None = None, slopes: Sequence[Array] | None = None
) -> tuple[Array | None, float]:
    """Return inverse information times score covariance times inverse information, (n_theta, n_theta), None where a
    direction is not seen. `R`: triangle of the slopes, priors included; `scores`, `slopes`: as `score_covariance`,
    without priors; `prior` (n_theta, n_theta): their information, which counts as that much data.
    """
    P, condition = information_inverse(R)
    if P is None:
        return None, condition
    scale = np.sqrt(np.diag(P))
    root = np.linalg.cholesky(P / scale[:, None] / scale) * scale[:, None]  # root root' = P
    if slopes is None:
        n = sum(s.shape[0] for s in scores)
        middle = score_covariance([s @ root for s in scores]) * (n / max(n - R.shape[1], 1.0))
    else:
        middle = score_covariance([s @ root for s in scores], 0.0, [s @ root for s in slopes])
    middle *= widening(scores)
    if prior is not None:
        middle += root.T @ prior @ root
    out: Array = root @ middle @ root.T
    return (out + out.T) / 2.0, condition


def natural_sizes(names: Sequence[str], theta: Mapping[str, float], reference: Mapping[str, float]) -> Array:
    """Return (n,) what standard deviations are judged against: the value, or a natural scale where it may be zero."""
    return np.array([max(abs(theta[k]), reference.get(k, 0.0), 1e-300) for k in names])


def weakest_direction(names: Sequence[str], covariance: Array, size: Array) -> tuple[Array, dict[str, float]]:
    """Return 1 over the relative standard deviation along each direction, largest first, and the last direction: the
    share of each parameter, largest in magnitude 1. `size` (n,): see `natural_sizes`.
    """
    eigenvalues, axes = np.linalg.eigh(covariance / np.outer(size, size))
    weak = axes[:, -1] / axes[np.argmax(np.abs(axes[:, -1])), -1]
    return 1 / np.sqrt(np.maximum(eigenvalues, 1e-300)), dict(zip(names, weak.tolist(), strict=True))
