"""The core of every instrumental variable method: noise models, Z' (target - Phi theta) = 0, parts made by a reference.

Neither Z' Z nor Z' Phi is formed from raw columns: Z = Q R, and Q' Phi theta = Q' target is solved by singular values.
With more instruments than unknowns this is two-stage least squares. Noise is modelled as an autoregression by Burg's
recursion (Burg 1967): stable by construction, all orders at once, no normal equations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.kernels import state_scan
from ambid.settings.caller import setting
from ambid.signals.delay import lagged_triangle


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Autoregression:
    """Noise e with D(q) e = w, w white."""

    D: Array  # (order + 1,), monic, all roots inside the unit circle
    variance: float  # of w

    @property
    def order(self) -> int:
        """Number of coefficients."""
        return self.D.size - 1


def autoregression(residual: Array, highest: int) -> Autoregression:
    """Model a residual as an autoregression, its order by Akaike's criterion with the small-sample term.

    `residual`: (n_samples,).
    """
    n = residual.size
    forward = backward = residual
    most, power = min(highest, n // 4), float(residual @ residual) / n
    d = np.eye(1, most + 1)[0]
    best, lowest = Autoregression(D=d[:1].copy(), variance=power), n * math.log(power + 1e-300)
    for order in range(1, most + 1):
        f, b = forward[1:], backward[:-1]
        size = float(f @ f + b @ b)
        if size <= 0 or power <= 0:
            break
        k = -2.0 * float(f @ b) / size
        forward, backward = f + k * b, b + k * f
        d[: order + 1] += k * d[order::-1]
        power *= 1 - k * k
        criterion = n * math.log(power + 1e-300) + 2 * order * n / max(n - order - 1, 1)
        if criterion < lowest:
            best, lowest = Autoregression(D=d[: order + 1].copy(), variance=power), criterion
    return best


def score_covariance(instruments: Array, noise: Autoregression) -> Array:
    """Return Cov(Z' e) = variance * (H* Z)' (H* Z), H* running backwards in time (Ljung 1999, eq. 9.83).

    `instruments`: (n_samples, n_instruments), Z, independent of the noise; `noise`: H = 1/D of e. Returns
    (n_instruments, n_instruments).
    """
    from scipy.signal import lfilter

    shaped = instruments if not noise.order else lfilter([1.0], noise.D, instruments[::-1], axis=0)
    return np.asarray(noise.variance * (shaped.T @ shaped), dtype=np.float64)


def noise_covariance(noise: Autoregression, n_samples: int) -> Array:
    """Return the covariance of the coefficients of D, leading one included (Ljung 1999, eq. 9.62).

    Returns (order + 1, order + 1).
    """
    p = noise.order
    out = np.zeros((p + 1, p + 1))
    if not p:
        return out
    a, b = np.zeros((p, p)), np.zeros((p, p))  # Gohberg-Semencul: inverse of the autocovariance matrix of 1/D
    for i in range(p):
        a[i, : i + 1] = noise.D[i::-1]
        b[i, : i + 1] = noise.D[p - i :]
    out[1:, 1:] = (a @ a.T - b @ b.T) / n_samples
    return out


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
            f"{who}: the input or reference does not excite every term of this model, so that its coefficients are "
            "not unique. Lower the orders, excite more frequencies, or give more independent references"
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


def weak_instruments(solutions: Sequence[Solution], outputs: Sequence[str]) -> list[str]:
    """Warn of outputs whose instruments are weak: errors are then not normal, and their spread is not the one given.

    `solutions`: last step of each output.
    """
    found = [(x.strength(), name) for x, name in zip(solutions, outputs, strict=True)]
    return [
        f"the instruments of {name!r} are weak: the reference or input excites one combination of the terms hardly "
        f"more than noise does (first-stage F = {F:.2g}, below {_WEAK:g}). The estimate tends to least squares, "
        "and errors may be many times the standard deviations. Excite more, use a longer record, or use bj or armax"
        for F, name in found
        if F < _WEAK
    ]


def project_out(nuisance: Array, columns: Array) -> Array:
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


_HIGHEST = 16  # lags of the autoregression that are looked at
_FORGOTTEN = 1e-6  # of an impulse response, where it is cut
_SMALL = 1e-3  # weight of that, relative to signals of unit spread
_ROUNDING = 1e-12  # variance, relative to the signal's, that counts as none: a controller without noise is exact


def require_reference(who: str, data: IOData) -> None:
    """Refuse data without a reference."""
    if not data.references:
        raise EstimationError(
            f"{who}: no reference was named; its instruments come from the loop's external excitation, which is "
            f"free of noise. Give {setting('reference', 'COLUMN')}, or use bj, armax or pbsid, which need none"
        )


def reference_part(who: str, data: IOData) -> tuple[Array, Array]:
    """Return inputs and outputs of the loop without noise, simulated from its reference.

    `who`: method, for errors; `data`: means taken off.
    """
    require_reference(who, data)
    w = np.hstack([data.y, data.u])
    scale = (w.std(axis=0), data.reference.std(axis=0))
    w, r = w / scale[0], data.reference / scale[1]
    n, n_w, n_r = data.n_samples, w.shape[1], r.shape[1]
    highest = min(_HIGHEST, n // (10 * (n_w + n_r)))
    if highest < 1:
        raise EstimationError(f"{who}: {n} samples are too few to identify the loop. Give a longer record")
    R, width = _triangle(w, r, highest), n_w + n_r
    for p in _by_criterion(R, n - highest, n_w, n_r, highest):
        size = 1 + n_r + p * width
        # a reference of narrow band leaves its own lags open: keep their coefficients small
        small = np.sqrt(n) * _SMALL * np.diag(_of_reference(n_w, n_r, p).astype(np.float64))
        rows = np.vstack([R[:size, :size], small])
        target = np.vstack([R[:size, -n_w:], np.zeros((size, n_w))])
        theta = np.asarray(np.linalg.lstsq(rows, target, rcond=None)[0][1:], dtype=np.float64)
        found = _impulse(theta, n_w, n_r, p, n)
        if found is not None:
            from scipy.signal import oaconvolve

            out = sum(oaconvolve(found[:, :, j], r[:, j : j + 1], axes=0)[:n] for j in range(n_r)) * scale[0]
            n_y = data.n_outputs
            return out[:, n_y:], out[:, :n_y]
    raise EstimationError(
        f"{who}: no stable loop from {', '.join(data.references)} to inputs and outputs fits this record. Check "
        "the reference column, or cut out the part where the loop is unstable"
    )


def _triangle(w: Array, r: Array, highest: int) -> Array:
    """R of the regression of w on 1, r(t) and lags 1, 2, ... of [w, r], lag by lag, so that orders are nested."""
    columns = [(np.ones(w.shape[0]), 0), *((x, 0) for x in r.T)]
    both = np.hstack([w, r])
    columns += [(x, k) for k in range(1, highest + 1) for x in both.T]
    return lagged_triangle([*columns, *((x, 0) for x in w.T)], highest)


def _by_criterion(R: Array, rows: int, n_w: int, n_r: int, highest: int) -> list[int]:
    """Orders, best first by Akaike's criterion."""
    score = []
    for p in range(1, highest + 1):
        size = 1 + n_r + p * (n_w + n_r)
        left = R[size:, -n_w:]
        _, logdet = np.linalg.slogdet(left.T @ left / rows + _ROUNDING * np.eye(n_w))
        score.append(rows * logdet + 2 * size * n_w)
    return [int(k) + 1 for k in np.argsort(score, kind="stable")]


def _of_reference(n_w: int, n_r: int, p: int) -> NDArray[np.bool_]:
    """Which coefficients, constant first, belong to the reference."""
    lag = [False] * n_w + [True] * n_r
    return np.array([False] + [True] * n_r + lag * p)


def _impulse(theta: Array, n_w: int, n_r: int, p: int, n: int) -> Array | None:
    """Impulse responses from r to w until forgotten, shape (m, n_w, n_r); None for an unstable loop."""
    width, n_s = n_w + n_r, p * n_w
    lags = [theta[n_r + k * width : n_r + (k + 1) * width].T for k in range(p)]
    F = np.zeros((n_s, n_s))
    F[:n_w] = np.hstack([m[:, :n_w] for m in lags])
    F[n_w:, :-n_w] = np.eye(n_s - n_w)
    radius = float(np.max(np.abs(np.linalg.eigvals(F))))
    if radius > 1 + 1.0 / n:  # over one record a pole this near to the circle grows by less than e: still an instrument
        return None
    radius = min(radius, 1 - 1e-12)
    m = min(n, p + 50 + int(np.log(_FORGOTTEN) / np.log(max(radius, 1e-3))))
    drive = [theta[:n_r].T] + [lag[:, n_w:] for lag in lags]
    out = np.empty((m, n_w, n_r))
    M = np.ascontiguousarray(np.hstack([F, np.eye(n_s)[:, :n_w]]))
    for j in range(n_r):
        # the drive enters the newest output, which leads the state after the step
        work = np.zeros((m + 1, n_s + n_w))
        work[: p + 1, n_s:] = np.stack([d[:, j] for d in drive])[: m + 1]
        state_scan(M, work, np.zeros(n_s))
        out[:, :, j] = work[1:, :n_w]
    peak = np.max(np.abs(out), axis=(1, 2))
    last = int(np.nonzero(peak > _FORGOTTEN * peak.max())[0][-1]) + 1
    return out[:last]
