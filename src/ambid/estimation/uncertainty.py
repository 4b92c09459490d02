"""Statistics of a fit: information criteria, and covariances where errors are not taken as white.

Covariances come from the scores of a fit (slope of each sample's error times the error), where errors are not
taken as white: the sandwich in closed form, and a bootstrap in blocks of time.

Both keep the correlation of the scores over about n^0.6 samples (Kuensch 1989; Newey and West 1987). The inputs are
what was measured and are never made again, so that a controller's reaction to the noise stays in: no residual bootstrap
that holds the inputs fixed would be right under feedback.

Information criteria, so defined that all structures on the same data compare.

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

from collections.abc import Mapping, Sequence
from itertools import pairwise
from math import erfc, exp, inf, lgamma, log, sqrt

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError, nearest
from ambid.estimation.linear import BLIND, directions, information_inverse, least_squares, triangle_of
from ambid.estimation.progress import Tick

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
    """Return what a linear regression on the past makes of errors; little where a search ended well.

    `parts`: by record the errors (n_samples, n_outputs), and signals (n_samples, n) each with how many of its last
    samples are looked at; rows that are not finite are left out; `least`: rows that each column asks for. Returns the
    part of the variance that it explains, corrected for chance, and chi-squared with its degrees of freedom if the past
    says nothing; 0 where rows are fewer.
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
REPEATS = 200
_MANY = 20  # records from which on whole records are drawn
_FEWEST = 8  # blocks of a record
_BEGINS = 4  # of blocks, that are averaged over
_SHOWN_ALONE = 0.1  # share of a direction's information that all other blocks count as having at least


def block_length(n: int) -> int:
    """Return the samples over which scores are taken to hang together.

    `n`: of a record.
    """
    length: int = max(min(round(float(n) ** 0.6), n // _FEWEST), 1)
    return length


def score_covariance(scores: Sequence[Array], part: float = 0.0, slopes: Sequence[Array] | None = None) -> Array:
    """Return the covariance of the sum of all scores, from blocks of time that begin at several places.

    With `slopes`, each block's sum is that which the estimate moves by when the block is left out (jackknife; Cameron,
    Gelbach and Miller 2008, CV3): errors at samples that pull the fit towards themselves are too small.

    `scores`: (n_samples, n_theta), of each record; `slopes`: (n_samples, n_outputs, n_theta). Returns (n_theta,
    n_theta).
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
    """Return what a covariance from few blocks is to be multiplied by, so that 1.96 deviations still hold 95 %.

    `scores`: (n_samples, n_theta); `part`: as for `score_covariance`. Returns square of Student's quantile over the
    normal one.
    """
    from scipy.special import stdtrit

    blocks = sum(max(round(s.shape[0] / k), 1) for s, k in zip(scores, _lengths(scores, part), strict=True))
    return float((stdtrit(max(blocks - 1, 2), 0.975) / 1.959964) ** 2)


def sandwich(
    R: Array, scores: Sequence[Array], prior: Array | None = None, slopes: Sequence[Array] | None = None
) -> tuple[Array | None, float]:
    """Return the covariance of the estimate, inverse information times score covariance times inverse information.

    `R`: (n_rows, n_theta), triangle of the slopes, priors included; `scores`: (n_samples, n_theta), of each record,
    without those of priors; `prior`: (n_theta, n_theta), information of the priors, which counts as that much data;
    `slopes`: (n_samples, n_outputs, n_theta). Returns `covariance`: (n_theta, n_theta), or None, none where a direction
    is not seen.
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


def bootstrapped(
    rows: Sequence[Array], priors: Array, seed: int, tick: Tick | None = None, *, repeats: int = REPEATS
) -> Array:
    """Return the covariance of weights after a Gauss-Newton step on blocks of time drawn with replacement.

    One step from the optimum stays where the network is linear in its weights: whole trainings end in weights that
    differ while the function does not, and their covariance says nothing of the function. Errors of a block are those
    of a fit without it, and few blocks widen, as in the sandwich. The first block of a record is always there: it alone
    shows the first state. Whole records are drawn where there are 20 or more.

    `rows`: (n_samples, n_outputs, n_theta + 1), slopes and errors of each record, of unit variance; `priors`:
    (n_priors, n_theta + 1), rows that stay as they are. Returns (n_theta, n_theta).
    """
    whole = len(rows) >= _MANY
    blocks = [_triangles(r, r.shape[0] if whole else block_length(r.shape[0])) for r in rows]
    _lift(blocks, priors)
    rng = np.random.default_rng([seed, 1])
    estimates = []
    for k in range(repeats):
        if tick is not None:
            tick("bootstrap", k / repeats)
        if whole:
            drawn = [blocks[j][0] for j in rng.integers(0, len(blocks), size=len(blocks))]
        else:
            drawn = []
            for own in blocks:
                times = np.bincount(rng.integers(1, len(own), size=len(own) - 1), minlength=len(own))
                times[0] = 1
                drawn += [np.sqrt(t) * b for t, b in zip(times, own, strict=True) if t]
        R = triangle_of([np.concatenate([*drawn, priors])])
        estimates.append(least_squares(R[:, :-1], R[:, -1]))
    return np.atleast_2d(np.cov(np.array(estimates), rowvar=False)) * widening([r[:, 0] for r in rows])


def _lift(blocks: list[list[Array]], priors: Array) -> None:
    """Raise each block's errors to those that the fit without it has: its own are too small by what it pulled."""
    R = triangle_of([np.concatenate([*(b for own in blocks for b in own), priors])])[:, :-1]
    root = directions(R).root(BLIND)
    for own in blocks:
        for k, block in enumerate(own):
            U, leverage, _ = np.linalg.svd(block[:, :-1] @ root, full_matrices=False)
            along = U.T @ block[:, -1]
            own[k] = block.copy()
            own[k][:, -1] += U @ (along / np.maximum(1.0 - leverage**2, _SHOWN_ALONE) - along)


def _triangles(rows: Array, length: int) -> list[Array]:
    """Each block of time reduced to a triangle; the last one takes what is left over."""
    n, width = rows.shape[0], rows.shape[2]
    edges = [*range(0, n - length + 1, length), n]
    if len(edges) > 2 and edges[-2] + length > n:
        edges.pop(-2)
    if len(edges) < 3 and length < n:
        edges = [0, n // 2, n]
    return [triangle_of([rows[a:b].reshape(-1, width)]) for a, b in pairwise(edges)]


def natural_sizes(names: Sequence[str], theta: Mapping[str, float], reference: Mapping[str, float]) -> Array:
    """Return what standard deviations are judged against: the value, or the natural scale of one that may be zero.

    `theta`, `reference`: values and natural scales by name, SI. Returns (n,).
    """
    return np.array([max(abs(theta[k]), reference.get(k, 0.0), 1e-300) for k in names])


def weakest_direction(names: Sequence[str], covariance: Array, size: Array) -> tuple[Array, dict[str, float]]:
    """Return 1 over the relative standard deviation along each direction, largest first, and the last direction.

    `covariance`: (n, n); `size`: (n,), see `natural_sizes`; the share of each parameter, largest in magnitude 1.
    """
    eigenvalues, axes = np.linalg.eigh(covariance / np.outer(size, size))
    weak = axes[:, -1] / axes[np.argmax(np.abs(axes[:, -1])), -1]
    return 1 / np.sqrt(np.maximum(eigenvalues, 1e-300)), dict(zip(names, weak.tolist(), strict=True))
