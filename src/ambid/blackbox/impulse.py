"""Impulse responses: many taps by regularised least squares (`rfir`), and by correlation (Ljung 1999, sec. 6.1).

A prior of fading, smooth responses (stable spline of order one, "TC") replaces an order; its sizes come from the
marginal likelihood (Pillonetto and De Nicolao 2010; Chen, Ohlsson and Ljung 2012), noise variance profiled out. The
triangle of [1 Phi y] is taken once; every evaluation is a QR of its size (Chen and Ljung 2013).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag

from ambid.arrays import Array
from ambid.blackbox.data import IOData, Orders, check_length, check_order_names, compact_order, order_per_input
from ambid.blackbox.fit import BlackBoxFit, build_fit
from ambid.blackbox.instrumental import autoregression
from ambid.blackbox.model import Offsets, PolynomialModel
from ambid.blackbox.polynomial_predictor import arx_layout
from ambid.estimation.linear import one_thread
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
    """Reduce a regression of `outputs` (n_samples, n_outputs) on a constant and lagged signals to a triangle, from row
    `first` on; `regressors`: signal (n_samples,) and lag of every column of Phi.
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


_WHITENING = 10  # order of the autoregression that whitens an input before it is correlated
_NOISE_ORDER = 20  # highest of the noise's autoregression
_OLDER = 10  # lags beyond the taps that are looked at
_SEEN = 1e-3  # chance of a false alarm


def rfir(data: IOData, orders: Orders) -> BlackBoxFit:
    """Estimate a long FIR model with a fading prior; every output by itself, without feedback. The covariance is that
    of the posterior; `n_estimated` is the effective number of coefficients.
    """
    check_order_names("rfir", orders, ("nb", "nk"), ("nb",))
    nb = order_per_input("rfir", orders, "nb", 1, data.n_inputs)
    nk = order_per_input("rfir", {"nk": 0, **orders}, "nk", 0, data.n_inputs)
    layout = arx_layout(0, nb, nk)
    check_length("rfir", data, 4 * (data.n_samples - layout.first_row), sum(nb) + 1)
    means, u_sd = data.u.mean(axis=0), data.u.std(axis=0)
    y_mean, y_sd = data.y.mean(axis=0), data.y.std(axis=0)
    u, y = (data.u - means) / u_sd, (data.y - y_mean) / y_sd
    lags = [(i, k) for i in range(layout.n_inputs) for k in layout.free_lags(("B", i))]
    with one_thread():
        t = triangle([(u[:, i], k) for i, k in lags], y, layout.first_row)
        rough = [posterior(t, o, nb) for o in range(data.n_outputs)]
        taps = [_whiten(f, u, y[:, o], nb, lags, layout.first_row) for o, f in enumerate(rough)]
    theta, covariance = list[Array](), list[Array]()
    for f, sd in zip(taps, y_sd, strict=True):
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
        n_estimated=int(np.ceil(sum(f.freedom for f in taps))),
        offsets=Offsets(u=means, y=y_mean + y_sd * np.array([f.constant for f in taps])),
        noise_covariance=np.diag([f.noise_variance * sd**2 for f, sd in zip(taps, y_sd, strict=True)]),
        details={
            "hyperparameters": [f.hyper.tolist() for f in taps],
            "effective_coefficients": [f.freedom for f in taps],
        },
    )


def _whiten(
    rough: Posterior, u: Array, y: Array, nb: tuple[int, ...], lags: Sequence[tuple[int, int]], first: int
) -> Posterior:
    """Fit once more with signals filtered so that the noise is white, unless it was: noise of another colour would make
    the band of the step response too narrow by a factor of its memory.
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
    white = posterior(triangle([(v[:, i], k) for i, k in lags], z[:, None], first), 0, nb)
    constant = white.constant / float(noise.D.sum())
    left = _left(white.mean, constant, u, y, lags, first)
    total = float(left @ left) / max(left.size - 1 - white.freedom, 1.0)
    return replace(white, constant=constant, noise_variance=total)


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


def correlation(data: IOData, orders: Orders) -> BlackBoxFit:
    """Estimate a FIR model without feedback by g(k) = R_yu(k) / R_uu(0), both channels filtered so that the input is
    white (Ljung 1999, sec. 6.1); one input at a time. Standard deviations are those of taps where there is no response;
    warns of correlated inputs, and of significant taps of negative lag (feedback).
    """
    from scipy.fft import irfft, next_fast_len, rfft
    from scipy.signal import lfilter
    from scipy.stats import binom, norm

    check_order_names("correlation", orders, ("nb", "nk"), ("nb",))
    nb = order_per_input("correlation", orders, "nb", 1, data.n_inputs)
    nk = order_per_input("correlation", {"nk": 0, **orders}, "nk", 0, data.n_inputs)
    layout, warnings = arx_layout(0, nb, nk), list[str]()
    n = data.n_samples - _WHITENING
    check_length("correlation", data, n - layout.first_row, sum(nb) + 1)
    u, y = data.u - data.u.mean(axis=0), data.y - data.y.mean(axis=0)
    taps, sd = np.empty((data.n_outputs, sum(nb))), np.empty((data.n_outputs, sum(nb)))
    for i, place in enumerate(np.split(np.arange(sum(nb)), np.cumsum(nb)[:-1])):
        last = nk[i] + nb[i]
        rows = np.column_stack([u[_WHITENING - k : data.n_samples - k, i] for k in range(_WHITENING + 1)])
        # a periodic input leaves directions open
        whitening = np.append(1.0, -np.linalg.lstsq(rows[:, 1:], rows[:, 0], rcond=1e-10)[0])
        white = lfilter(whitening, 1.0, u[:, i])[_WHITENING:]
        size = next_fast_len(n + last)
        for o, name in enumerate(data.outputs):
            out = lfilter(whitening, 1.0, y[:, o])[_WHITENING:]
            g = irfft(rfft(out, size) * np.conj(rfft(white, size)), size) / float(white @ white)  # lag -k at its end
            taps[o, place], sd[o, place] = g[nk[i] : last], out.std() / (white.std() * np.sqrt(n))
            outside = int(np.sum(np.abs(g[-last:]) > norm.isf(0.005) * sd[o, place[0]]))
            if outside > binom.isf(_SEEN, last, 0.01):
                warnings.append(
                    f"{outside} of {last} negative lags from {data.inputs[i]!r} to {name!r} are significant: there is "
                    "feedback, and these responses are biased. Use pbsid, or cliv with a reference"
                )
    together = np.abs(np.corrcoef(u.T) - np.eye(data.n_inputs)).max() if data.n_inputs > 1 else 0.0
    if together > 4 / np.sqrt(n):
        warnings.append(f"inputs are correlated (up to {together:.2f}), which biases one-at-a-time estimates. Use rfir")
    theta, variance = np.tile(layout.start(), (data.n_outputs, 1)), np.zeros((data.n_outputs, layout.n_theta))
    theta[:, layout.free], variance[:, layout.free] = taps, sd**2
    model = PolynomialModel(outputs=tuple(map(layout.polynomials, theta)), dt=data.dt)
    error = y - sum(np.stack([lfilter(p.B[i], 1.0, x) for p in model.outputs], axis=1) for i, x in enumerate(u.T))
    return build_fit(
        "correlation",
        data,
        orders={"nb": compact_order(nb), "nk": compact_order(nk)},
        model=model,
        covariance=np.diag(variance.ravel()),
        n_estimated=taps.size,
        offsets=Offsets(u=data.u.mean(axis=0), y=data.y.mean(axis=0)),
        noise_covariance=error[layout.first_row :].T @ error[layout.first_row :] / (data.n_samples - layout.first_row),
        warnings=warnings,
    )
