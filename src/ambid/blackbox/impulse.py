"""Impulse responses by regularised least squares, their running sum, and by correlation.

A prior of fading, smooth responses (the stable spline of order one, "TC") takes the place of an order; its sizes come
from the marginal likelihood (Pillonetto and De Nicolao 2010; Chen, Ohlsson and Ljung 2012). In open loop the taps are
estimated directly (`rfir`); where a controller may be at work, past outputs of all channels stand beside past inputs (a
long regularised autoregression, consistent under feedback; Pillonetto, Chiuso and De Nicolao 2011), and the impulse
response follows from both.

All that the data say stands in the triangle of [1 Phi y], taken once, by pieces; every evaluation is then a QR of that
size (Chen and Ljung 2013). The noise variance is profiled out; the gradient is exact. Correlation analysis is that of
Ljung 1999, sec. 6.1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from ambid.arrays import Array
from ambid.blackbox.data import IOData, Orders, check_length, check_order_names, compact_order, order_per_input
from ambid.blackbox.fit import BlackBoxFit, build_fit
from ambid.blackbox.instruments import autoregression
from ambid.blackbox.model import Offsets, PolynomialModel
from ambid.blackbox.polynomial_predictor import Layout, arx_layout
from ambid.errors import EstimationError, counted
from ambid.estimation.linear import one_thread
from ambid.estimation.uncertainty import p_text
from ambid.signals.delay import lagged_triangle


def kernel_matrix(n: int, decay: float) -> Array:
    """Return the stable-spline kernel of order one (TC), decay^max(i, j): taps that fade, neighbours alike."""
    i = np.arange(1, n + 1)
    return np.asarray(decay ** np.maximum.outer(i, i))


def kernel_root(n: int, decay: float) -> Array:
    """Return the lower triangle L with L L^T = K."""
    i = np.arange(n)
    lower = np.tril(decay ** (0.5 * np.abs(np.subtract.outer(i, i))))
    lower[:, 1:] *= np.sqrt(max(1.0 - decay, 0.0))
    return np.asarray(decay ** ((i + 1) / 2)[:, None] * lower)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Triangle:
    """Triangle of [Phi y] with the constant taken out."""

    R: Array  # (p, p)
    r: Array  # (p, n_outputs), the part of y within the columns of Phi
    left: Array  # (n_outputs, n_outputs), squares of y outside them
    head: Array  # (1 + p + n_outputs,), first row: means times sqrt(rows)
    rows: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Posterior:
    """Coefficients given the data."""

    mean: Array  # (p,)
    covariance: Array  # (p, p)
    noise_variance: float
    constant: float
    freedom: float  # effective number of coefficients
    hyper: Array  # (2 n_blocks,), block by block: size over noise variance, then decay


def triangle(regressors: Sequence[tuple[Array, int]], outputs: Array, first: int) -> Triangle:
    """Reduce a regression on lagged signals and a constant to a triangle.

    `regressors`: (n_samples,), and int), signal and lag of every column of Phi; `outputs`: (n_samples, n_outputs);
    `first`: first row, at least the largest lag.
    """
    rows, p = outputs.shape[0], len(regressors)
    R = lagged_triangle([(np.ones(rows), 0), *regressors, *((y, 0) for y in outputs.T)], first)
    phi, y = slice(1, 1 + p), slice(1 + p, None)
    return Triangle(R=R[phi, phi], r=R[phi, y], left=R[y, y].T @ R[y, y], head=R[0], rows=rows - first)


def posterior(t: Triangle, output: int, blocks: Sequence[int]) -> Posterior:
    """Choose size and decay of each block by marginal likelihood; `output`: column of y."""
    from scipy.optimize import minimize

    search = _Evidence(t, output, blocks)
    best = min((search.start(decay) for decay in (0.5, 0.8, 0.95)), key=lambda v: search(v)[0])
    done = minimize(search, best, jac=True, method="L-BFGS-B", bounds=search.bounds, options={"maxiter": 60})
    return search.posterior(done.x)


def _qr(rows: Array) -> Array:
    return np.asarray(np.linalg.qr(rows, mode="r"))


class _Evidence:
    """-2 log p(y) at v: for each block log(size / noise variance), then log(-log decay)."""

    def __init__(self, t: Triangle, output: int, blocks: Sequence[int]) -> None:
        self.t, self.blocks = t, list(blocks)
        self.output, self.r, self.left = output, t.r[:, output], float(t.left[output, output])
        self.count = t.rows - 1
        edges = np.cumsum([0, *blocks])
        self.places = [slice(int(a), int(b)) for a, b in pairwise(edges)]
        power = [max(float(np.mean(np.sum(t.R[:, p] ** 2, axis=0))) / t.rows, 1e-300) for p in self.places]
        self.center = -np.log(power)  # a coefficient of this variance over the noise's changes y by about the noise
        self.bounds = [b for c in self.center for b in [(c - 25, c + 40), (-9.0, 1.1)]]

    def start(self, decay: float) -> Array:
        return np.array([x for c in self.center for x in (c + 4.0, np.log(-np.log(decay)))])

    def _prior(self, v: Array) -> tuple[Array, list[tuple[slice, Array]]]:
        """Root of P over the noise variance, and dP/dv, block by block."""
        p = self.t.R.shape[1]
        L, slopes = np.zeros((p, p)), []
        for n, place, size, decay in zip(self.blocks, self.places, *self._numbers(v), strict=True):
            K, i = size * kernel_matrix(n, decay), np.arange(1, n + 1)
            L[place, place] = np.sqrt(size) * kernel_root(n, decay)
            slopes += [(place, K), (place, np.log(decay) * np.maximum.outer(i, i) * K)]
        return L, slopes

    @staticmethod
    def _numbers(v: Array) -> tuple[Array, Array]:
        """Size and decay of each block."""
        return np.exp(v[::2]), np.exp(-np.exp(v[1::2]))

    def __call__(self, v: Array) -> tuple[float, Array]:
        from scipy.linalg import solve_triangular

        L, slopes = self._prior(v)
        p = L.shape[0]
        M = self.t.R @ L
        T = _qr(np.vstack([M.T, np.eye(p)]))  # M M^T + I = T^T T
        white = solve_triangular(T, np.column_stack([self.r, self.t.R]), trans="T")
        z, X = white[:, 0], white[:, 1:]
        quadratic = self.left + float(z @ z)
        value = self.count * np.log(quadratic / self.count) + 2 * float(np.sum(np.log(np.abs(np.diag(T)))))
        g = X.T @ z
        weight = X.T @ X - np.outer(g, g) * (self.count / quadratic)
        return value, np.array([float(np.sum(weight[place, place] * d)) for place, d in slopes])

    def posterior(self, v: Array) -> Posterior:
        L, _ = self._prior(v)
        p, M = L.shape[0], self.t.R @ L
        T = _qr(np.vstack([M, np.eye(p)]))  # M^T M + I = T^T T
        half = np.linalg.solve(T.T, L.T).T  # covariance = noise variance * half half^T
        inner = np.linalg.solve(T.T, M.T)
        w = inner @ self.r
        quadratic = self.left + float(self.r @ self.r - w @ w)
        noise = max(quadratic, 0.0) / self.count
        mean = half @ w
        head = self.t.head
        constant = (head[1 + p + self.output] - head[1 : 1 + p] @ mean) / head[0]
        return Posterior(
            mean=mean,
            covariance=noise * half @ half.T,
            noise_variance=noise,
            constant=float(constant),
            freedom=float(np.sum(inner**2)),
            hyper=np.column_stack(self._numbers(v)).ravel(),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictorTaps:
    """Taps of the one-step predictor, for signals over their standard deviations."""

    mean: Array  # for each output: past of every output, then of every input, lag 1 first
    covariance: Array  # (n_outputs, n_outputs, p, p), between the taps of two outputs
    noise: Array  # (n_outputs, n_outputs), covariance of e
    y_sd: Array  # (n_outputs,)
    u_sd: Array  # (n_inputs,)
    # probability of the correlation that is left between outputs and inputs of one sample, if there is no path between
    # them that is faster than a sample; 1 where the record is too short to see one
    within_sample: float


def predictor_taps(data: IOData, lags: int) -> PredictorTaps:
    """Estimate the taps of the predictor."""
    y_sd, u_sd = data.y.std(axis=0), data.u.std(axis=0)
    z = np.hstack([(data.y - data.y.mean(axis=0)) / y_sd, (data.u - data.u.mean(axis=0)) / u_sd])
    n_y = data.n_outputs
    whole = triangle([(x, k) for x in z.T for k in range(1, lags + 1)], z, lags)
    t = replace(whole, r=whole.r[:, :n_y], left=whole.left[:n_y, :n_y])
    found = [posterior(t, o, (lags,) * z.shape[1]) for o in range(n_y)]
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


_WHITENING = 10  # order of the autoregression that whitens an input before it is correlated
_NOISE_ORDER = 20  # highest of the noise's autoregression
_OLDER = 10  # lags beyond the taps that are looked at
_SEEN = 1e-3  # chance that a tap of a dead time is taken for the response
_WITHIN = (
    "inputs and outputs depend on each other within the same sample ({p}). This is normal if the controller acts "
    "without delay; if the plant does, its first tap is not zero, as is assumed here, and the later ones are "
    "biased. Without feedback give open_loop (--open-loop): then the first tap is estimated"
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Response:
    time_s: Array  # (n_times,), s, beginning at zero delay
    values: Array  # (n_times, n_outputs, n_inputs), output unit per input unit
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: Mapping[str, str]
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImpulseResponse(_Response):
    """Sampled impulse responses: y = sum of values[k] u[t - k], plus noise."""

    covariance: Array  # (n_outputs, n_inputs, n_taps, n_taps), within each response
    noise_sd: Array  # (n_outputs,), of the innovations
    method: Literal["rfir", "rarx"]

    @property
    def sd(self) -> Array:
        """Standard deviations, shape (n_taps, n_outputs, n_inputs)."""
        return _deviations(self.covariance)


def _deviations(covariance: Array) -> Array:
    return np.moveaxis(np.sqrt(np.maximum(np.diagonal(covariance, axis1=2, axis2=3), 0.0)), 2, 0)


def rfir(data: IOData, orders: Orders) -> BlackBoxFit:
    """Estimate a long FIR model with a fading prior; every output by itself.

    `data`: without feedback. Returns a PolynomialModel whose covariance is that of the posterior; `n_estimated` is the
    effective number of coefficients.
    """
    check_order_names("rfir", orders, ("nb", "nk"), ("nb",))
    nb = order_per_input("rfir", orders, "nb", 1, data.n_inputs)
    nk = order_per_input("rfir", {"nk": 0, **orders}, "nk", 0, data.n_inputs)
    layout = arx_layout(0, nb, nk)
    check_length("rfir", data, 4 * (data.n_samples - layout.first_row), sum(nb) + 1)
    with one_thread():
        found, (means, u_sd), (y_mean, y_sd) = _regress(data, layout)
    theta, covariance = list[Array](), list[Array]()
    for f, sd in zip(found, y_sd, strict=True):
        scale = np.concatenate([np.full(b, sd / s) for b, s in zip(nb, u_sd, strict=True)])
        theta.append(layout.start())
        theta[-1][layout.free] = f.mean * scale
        covariance.append(np.zeros((layout.n_theta,) * 2))
        covariance[-1][np.ix_(layout.free, layout.free)] = f.covariance * np.outer(scale, scale)
    return build_fit(
        "rfir",
        data,
        orders={"nb": compact_order(nb), "nk": compact_order(nk)},
        model=PolynomialModel(outputs=tuple(map(layout.polynomials, theta)), dt=data.dt),
        covariance=block_diag(*covariance),
        n_estimated=int(np.ceil(sum(f.freedom for f in found))),
        offsets=Offsets(u=means, y=y_mean + y_sd * np.array([f.constant for f in found])),
        noise_covariance=np.diag([f.noise_variance * sd**2 for f, sd in zip(found, y_sd, strict=True)]),
        details={
            "hyperparameters": [f.hyper.tolist() for f in found],
            "effective_coefficients": [f.freedom for f in found],
        },
    )


def impulse_response(data: IOData, n_taps: int) -> ImpulseResponse:
    """Estimate impulse responses with their spread.

    In open loop (``data.open_loop``) the taps are estimated directly, ``rfir``. Where feedback may act they follow from
    a long autoregression, ``rarx``, and the first tap is zero: without a delay in the loop input and output cannot be
    separated.

    Parameters
    ----------
    data : IOData
    n_taps : int
        Taps from zero delay on.

    Returns
    -------
    ImpulseResponse

    Raises
    ------
    EstimationError
        If the record is too short, or fewer than two taps are asked for.
    """
    if n_taps < 2:
        raise EstimationError(f"impulse response: {counted(n_taps, 'tap')}; at least 2 make a response. Ask for more")
    values = np.zeros((n_taps, data.n_outputs, data.n_inputs))
    covariance = np.zeros((data.n_outputs, data.n_inputs, n_taps, n_taps))
    noise_sd, warnings = (_direct if data.open_loop else _through_autoregression)(data, values, covariance)
    return ImpulseResponse(
        time_s=np.arange(n_taps, dtype=np.float64) * data.dt,
        values=values,
        covariance=covariance,
        noise_sd=noise_sd,
        inputs=data.inputs,
        outputs=data.outputs,
        units=data.units,
        method="rfir" if data.open_loop else "rarx",
        warnings=warnings,
    )


def _direct(data: IOData, values: Array, covariance: Array) -> tuple[Array, tuple[str, ...]]:
    """Fill in values and covariance; noise and warnings."""
    fit = rfir(data, {"nb": values.shape[0], "nk": 0})
    assert isinstance(fit.model, PolynomialModel)
    assert fit.covariance is not None
    for o, letter, i, place in fit.model.blocks():
        if letter == "B" and i is not None:
            values[:, o, i] = fit.model.theta[place]
            covariance[o, i] = fit.covariance[place, place]
    return np.sqrt(np.diag(fit.noise_covariance)), fit.warnings


def _through_autoregression(data: IOData, values: Array, covariance: Array) -> tuple[Array, tuple[str, ...]]:
    """Fill in values and covariance; noise and warnings."""
    lags, n_y, n_u = values.shape[0] - 1, data.n_outputs, data.n_inputs
    check_length("impulse response", data, 2 * (data.n_samples - lags), lags * (n_y + n_u) + 1)
    with one_thread():
        taps = predictor_taps(data, lags)
        found, spread = responses(taps, n_y, n_u, lags)
    scale = taps.y_sd[:, None] / taps.u_sd
    values[1:] = found * scale
    covariance[:, :, 1:, 1:] = spread * scale[:, :, None, None] ** 2
    warnings = () if taps.within_sample > _SEEN else (_WITHIN.format(p=p_text(taps.within_sample)),)
    return np.sqrt(np.diag(taps.noise)) * taps.y_sd, warnings


def _regress(data: IOData, layout: Layout) -> tuple[list[Posterior], tuple[Array, Array], tuple[Array, Array]]:
    """Scale, reduce to a triangle, and fit each output."""
    means, u_sd = data.u.mean(axis=0), data.u.std(axis=0)
    y_mean, y_sd = data.y.mean(axis=0), data.y.std(axis=0)
    u, y = (data.u - means) / u_sd, (data.y - y_mean) / y_sd
    lags = [(i, k) for i in range(layout.n_inputs) for k in layout.free_lags(("B", i))]
    nb, first = layout.nb, layout.first_row
    t = triangle([(u[:, i], k) for i, k in lags], y, first)
    rough = [posterior(t, o, nb) for o in range(data.n_outputs)]
    found = [_whiten(f, u, y[:, o], nb, lags, first) for o, f in enumerate(rough)]
    return found, (means, u_sd), (y_mean, y_sd)


def _whiten(
    rough: Posterior, u: Array, y: Array, nb: tuple[int, ...], lags: Sequence[tuple[int, int]], first: int
) -> Posterior:
    """Fit once more with all signals filtered so that the noise is white; as it is where it was white already.

    Noise of another colour would be averaged too well and too badly: the band of the step response would be too narrow
    by a factor of the noise's memory.
    """
    from scipy.signal import lfilter

    left = _left(rough.mean, rough.constant, u, y, lags, first)
    noise = autoregression(left, _NOISE_ORDER)
    p = noise.order
    if not p or left.size - p <= 4 * rough.freedom:
        return rough
    v, z = (np.asarray(lfilter(noise.D, 1.0, x, axis=0)[p:]) for x in (u, y))
    if _truncated(np.asarray(lfilter(noise.D, 1.0, left)[p:]), v, lags):
        return rough  # what is left comes from inputs older than the taps: no noise, and not to be whitened
    found = posterior(triangle([(v[:, i], k) for i, k in lags], z[:, None], first), 0, nb)
    constant = found.constant / float(noise.D.sum())
    left = _left(found.mean, constant, u, y, lags, first)
    total = float(left @ left) / max(left.size - 1 - found.freedom, 1.0)
    return replace(found, constant=constant, noise_variance=total)


def _truncated(error: Array, v: Array, lags: Sequence[tuple[int, int]]) -> bool:
    """Return whether inputs older than the taps still move a white error (chi-square of their regression)."""
    from scipy.stats import chi2

    last = {i: max(k for j, k in lags if j == i) for i in range(v.shape[1])}
    n = v.shape[0] - max(last.values()) - _OLDER
    if n < 4 * _OLDER * v.shape[1]:
        return False
    older = [v[v.shape[0] - n - last[i] - k : v.shape[0] - last[i] - k, i] for i in last for k in range(1, _OLDER + 1)]
    Q, e = np.linalg.qr(np.stack(older, axis=1))[0], error[-n:]
    share = float(np.sum((Q.T @ e) ** 2) / max(float(e @ e), 1e-300))
    return bool(n * share > float(chi2.isf(_SEEN, Q.shape[1])))


def _left(taps: Array, constant: float, u: Array, y: Array, lags: Sequence[tuple[int, int]], first: int) -> Array:
    """What the taps leave of an output, shape (n_samples - first,)."""
    from scipy.signal import oaconvolve

    out = y - constant
    for i in range(u.shape[1]):
        full = np.zeros(1 + max([k for j, k in lags if j == i], default=0))
        for g, (j, k) in zip(taps, lags, strict=True):
            if j == i:
                full[k] = g
        out = out - oaconvolve(u[:, i], full)[: y.size]
    return np.asarray(out[first:])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StepResponse(_Response):
    """Response to a unit step, with its spread."""

    sd: Array  # (n_times, n_outputs, n_inputs)


def step_response(impulse: ImpulseResponse) -> StepResponse:
    """Sum an impulse response.

    Parameters
    ----------
    impulse : ImpulseResponse

    Returns
    -------
    StepResponse
        Its band takes the correlation between taps into account.
    """
    summed = np.cumsum(np.cumsum(impulse.covariance, axis=2), axis=3)
    return StepResponse(
        time_s=impulse.time_s,
        values=np.cumsum(impulse.values, axis=0),
        sd=_deviations(summed),
        inputs=impulse.inputs,
        outputs=impulse.outputs,
        units=impulse.units,
        warnings=impulse.warnings,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correlation(_Response):
    """Impulse responses by correlation, one input at a time; times of negative lags come first."""

    lags: NDArray[np.int64]  # (n_times,), samples
    band: Array  # (n_outputs, n_inputs), 99 % of the values lie within it where there is no response


def correlation_analysis(data: IOData, n_lags: int) -> Correlation:
    """Estimate impulse responses by correlation.

    Parameters
    ----------
    data : IOData
        Inputs that do not go together.
    n_lags : int
        Lags on either side.

    Returns
    -------
    Correlation
        Warns where inputs are correlated, or negative lags stand out (feedback).

    Raises
    ------
    EstimationError
        If the record is too short, or has no input.
    """
    from scipy.signal import lfilter
    from scipy.stats import norm

    if not data.n_inputs:
        raise EstimationError("correlation analysis: no input was named. Give --input")
    n, order = data.n_samples - _WHITENING, _WHITENING
    if n_lags < 1 or n < 4 * n_lags + 4 * order + 20:
        raise EstimationError(
            f"correlation analysis: {data.n_samples} samples for {n_lags} lags; at least {4 * n_lags + 5 * order + 20} "
            "are needed. Record longer, or ask for fewer lags"
        )
    values = np.empty((2 * n_lags + 1, data.n_outputs, data.n_inputs))
    band, warnings = np.empty((data.n_outputs, data.n_inputs)), list[str]()
    for i, name in enumerate(data.inputs):
        u = data.u[:, i] - data.u[:, i].mean()
        if not np.any(u):
            raise EstimationError(f"input {name!r} is constant; it carries no information. Excite it")
        whitening = _whitening_filter(u, order)
        white = lfilter(whitening, 1.0, u)[order:]
        for o in range(data.n_outputs):
            y = lfilter(whitening, 1.0, data.y[:, o] - data.y[:, o].mean())[order:]
            values[:, o, i] = _cross(y, white, n_lags) / float(white @ white)
            band[o, i] = norm.isf(0.005) * y.std() / (white.std() * np.sqrt(n))
            outside = int(np.sum(np.abs(values[:n_lags, o, i]) > band[o, i]))
            if outside > _allowed(n_lags):
                warnings.append(
                    f"{outside} of {n_lags} negative lags from {name!r} to {data.outputs[o]!r} are significant: "
                    "there is feedback, and these responses are biased. Use impulse_response"
                )
    if data.n_inputs > 1:
        together = np.abs(np.corrcoef(data.u.T) - np.eye(data.n_inputs)).max()
        if together > 4 / np.sqrt(n):
            warnings.append(
                f"inputs are correlated (up to {together:.2f}), which biases one-at-a-time estimates. Use "
                "impulse_response"
            )
    lags = np.arange(-n_lags, n_lags + 1)
    return Correlation(
        lags=lags,
        time_s=np.asarray(lags * data.dt, dtype=np.float64),
        values=values,
        band=band,
        inputs=data.inputs,
        outputs=data.outputs,
        units=data.units,
        warnings=tuple(warnings),
    )


def _whitening_filter(u: Array, order: int) -> Array:
    """Coefficients of the autoregression of u, 1 first, by QR."""
    rows = np.column_stack([u[order - k : u.size - k] for k in range(order + 1)])
    found = np.linalg.lstsq(rows[:, 1:], rows[:, 0], rcond=1e-10)[0]  # a periodic input leaves directions open
    return np.concatenate([[1.0], -found])


def _cross(y: Array, u: Array, n_lags: int) -> Array:
    """Sums of y[t] u[t - k] for k = -n_lags to n_lags."""
    from scipy.fft import irfft, next_fast_len, rfft

    size = next_fast_len(y.size + n_lags)
    whole = irfft(rfft(y, size) * np.conj(rfft(u, size)), size)
    return np.concatenate([whole[-n_lags:], whole[: n_lags + 1]])


def _allowed(n: int) -> int:
    """How many of n values may lie outside a 99 % band by chance (one in a thousand records has more)."""
    from scipy.stats import binom

    return int(binom.isf(1e-3, n, 0.01))
