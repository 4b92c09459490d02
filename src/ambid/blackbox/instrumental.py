"""Instrumental variables in discrete time: iv4 without feedback; cliv with the reference of a loop.

Instruments that the noise did not make take the bias of least squares off A y = B u + noise of any colour; filtering
with a noise model, repeated until both settle, makes the estimate as sharp as one without a noise model of G can be
(Ljung 1999, sec. 15.3; Gilson and Van den Hof 2005). Z = Q R, and Q' Phi theta = Q' target by singular values:
two-stage least squares where instruments are to spare. Noise is an autoregression by Burg's recursion (Burg 1967).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.signal import lfilter

from ambid.arrays import Array
from ambid.blackbox.data import IOData, Orders, check_length, check_order_names, order_per_input, single_order
from ambid.blackbox.fit import BlackBoxFit, build_fit
from ambid.blackbox.model import Offsets, PolynomialModel, Polynomials, reflect
from ambid.blackbox.polynomial_predictor import Layout, arx_layout
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
    """Model a residual (n_samples,) as an autoregression, order by Akaike's criterion with the small-sample term."""
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
    """Return Cov(Z' e) = variance * (H* Z)' (H* Z), H* the filter H = 1/D of e backwards in time (Ljung 1999, eq.
    9.83); instruments Z (n_samples, n_instruments) independent of the noise.
    """
    from scipy.signal import lfilter

    shaped = instruments if not noise.order else lfilter([1.0], noise.D, instruments[::-1], axis=0)
    return np.asarray(noise.variance * (shaped.T @ shaped), dtype=np.float64)


def noise_covariance(noise: Autoregression, n_samples: int) -> Array:
    """Return the (order + 1, order + 1) covariance of D's coefficients, leading one included (Ljung 1999, eq. 9.62)."""
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
        """Return (Q' Phi)^-1 Cov(Q' e) (Q' Phi)^-T, `noise` that of e (Soderstrom and Stoica 1989, sec. 8.2)."""
        return np.asarray(self.inverse @ score_covariance(self.Q, noise) @ self.inverse.T)

    def strength(self) -> float:
        """Return the first-stage F, at most 1e12, of the regressors' direction that instruments see least, that of the
        least canonical correlation (Cragg and Donald 1993), for what they leave coloured (Kleibergen and Paap 2006).
        Regressors that are instruments have correlation 1; from about 16 on Wald tests of 5 % have a size of at most 10
        % (Stock and Yogo 2005).
        """
        basis = np.linalg.qr(self.regressors)[0]
        left, correlations, right = np.linalg.svd(self.Q.T @ basis, full_matrices=False)
        if 1.0 - correlations[-1] < _INCLUDED:
            return _EXACT
        way, direction = self.Q @ left[:, -1], basis @ right[-1]
        noise = autoregression(direction - correlations[-1] * way, _COLOUR)
        variance = float(score_covariance(way[:, None], noise)[0, 0])
        return float(min(correlations[-1] ** 2 / max(variance, 1.0 / _EXACT), _EXACT))


def solve(instruments: Array, regressors: Array, target: Array, *, who: str) -> Solution:
    """Solve one instrumental variable step of `target` (n_samples,) by at least as many instruments as regressors, both
    (n_samples, n); `who`: method, for the error.
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
    """Warn of outputs whose instruments are weak: errors are then not normal, and their spread is not the one given."""
    strengths = [(x.strength(), name) for x, name in zip(solutions, outputs, strict=True)]
    return [
        f"the instruments of {name!r} are weak: the reference or input excites one combination of the terms hardly "
        f"more than noise does (first-stage F = {F:.2g}, below {_WEAK:g}). The estimate tends to least squares, "
        "and errors may be many times the standard deviations. Excite more, use a longer record, or use bj or armax"
        for F, name in strengths
        if F < _WEAK
    ]


def project_out(nuisance: Array, columns: Array) -> Array:
    """Return what offsets and initial states, `nuisance` (perhaps rank deficient), leave of (n_samples, n) columns."""
    basis = span(nuisance)
    return np.asarray(columns - basis @ (basis.T @ columns))


def span(columns: Array) -> Array:
    """Return an orthonormal basis (n_samples, rank) of the columns, dependent ones left out."""
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
_EXACT_LOOP = 1e-12  # variance, relative to the signal's, that counts as none: a controller without noise is exact


def require_reference(who: str, data: IOData) -> None:
    """Refuse data without a reference."""
    if not data.references:
        raise EstimationError(
            f"{who}: no reference was named; its instruments come from the loop's external excitation, which is "
            f"free of noise. Give {setting('reference', 'COLUMN')}, or use bj, armax or pbsid, which need none"
        )


def reference_part(who: str, data: IOData) -> tuple[Array, Array]:
    """Return inputs and outputs of the loop without noise, simulated from its reference; means are off the data."""
    require_reference(who, data)
    w = np.hstack([data.y, data.u])
    scale = (w.std(axis=0), data.reference.std(axis=0))
    w, r = w / scale[0], data.reference / scale[1]
    n, n_w, n_r = data.n_samples, w.shape[1], r.shape[1]
    highest = min(_HIGHEST, n // (10 * (n_w + n_r)))
    if highest < 1:
        raise EstimationError(f"{who}: {n} samples are too few to identify the loop. Give a longer record")
    # regression of w on 1, r(t) and lags 1, 2, ... of [w, r], lag by lag, so that orders are nested.
    columns = [(np.ones(w.shape[0]), 0), *((x, 0) for x in r.T)]
    both = np.hstack([w, r])
    columns += [(x, k) for k in range(1, highest + 1) for x in both.T]
    R, width, score = lagged_triangle([*columns, *((x, 0) for x in w.T)], highest), n_w + n_r, list[float]()
    for p in range(1, highest + 1):  # Akaike's criterion
        size = 1 + n_r + p * width
        left = R[size:, -n_w:]
        _, logdet = np.linalg.slogdet(left.T @ left / (n - highest) + _EXACT_LOOP * np.eye(n_w))
        score.append((n - highest) * float(logdet) + 2 * size * n_w)
    for p in (int(k) + 1 for k in np.argsort(score, kind="stable")):
        size = 1 + n_r + p * width
        # a reference of narrow band leaves its own lags open: keep their coefficients small
        lag = [0.0] * n_w + [1.0] * n_r
        small = np.sqrt(n) * _SMALL * np.diag([0.0] + [1.0] * n_r + lag * p)
        rows = np.vstack([R[:size, :size], small])
        target = np.vstack([R[:size, -n_w:], np.zeros((size, n_w))])
        theta = np.asarray(np.linalg.lstsq(rows, target, rcond=None)[0][1:], dtype=np.float64)
        impulse = _impulse(theta, n_w, n_r, p, n)
        if impulse is not None:
            from scipy.signal import oaconvolve

            out = sum(oaconvolve(impulse[:, :, j], r[:, j : j + 1], axes=0)[:n] for j in range(n_r)) * scale[0]
            n_y = data.n_outputs
            return out[:, n_y:], out[:, :n_y]
    raise EstimationError(
        f"{who}: no stable loop from {', '.join(data.references)} to inputs and outputs fits this record. Check "
        "the reference column, or cut out the part where the loop is unstable"
    )


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


_NO_NOISE_MODEL = Autoregression(D=np.ones(1), variance=0.0)
_NO_AVERAGE = np.ones(1)
_SETTLED = 1e-4  # change of the filtered output by a round, relative to the innovations
_INSIDE = 0.9999  # radius to which poles on the unit circle are drawn


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Signals:
    """One output and the inputs, offsets roughly off."""

    y: Array  # (n_samples,)
    u: Array  # (n_samples, n_inputs)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ArxEstimate:
    """Outcome of one output: A y = B u + constant + C w/D."""

    layout: Layout  # of A and B
    # C is 1, or A with the poles outside the unit circle mirrored (noise that enters at the output); D of `noise`
    polynomials: Polynomials
    noise: Autoregression  # of the equation error
    solution: Solution  # last step; its unknowns are a_1 ..., b of every input, and the constant

    @property
    def innovations(self) -> Array:
        """What the last step leaves, (n_rows,), ending with the last sample."""
        return self.solution.residual


def regressors(signals: Signals, layout: Layout) -> Array:
    """Return -y(t-1) ... -y(t-na), u_i(t-nk) ..., 1 from `first_row` on, shape (n_rows, n_coefficients + 1)."""
    n, first = signals.y.size, layout.first_row
    columns = [-signals.y[first - k : n - k] for k in range(1, layout.na + 1)]
    for i, (nb, nk) in enumerate(zip(layout.nb, layout.nk, strict=True)):
        columns += [signals.u[first - k : n - k, i] for k in range(nk, nk + nb)]
    return np.stack([*columns, np.ones(n - first)], axis=1)


def instrumental_step(
    who: str,
    data: Signals,
    instruments: Signals,
    layout: Layout,
    noise: Autoregression = _NO_NOISE_MODEL,
    C: Array = _NO_AVERAGE,
) -> Solution:
    """Make one instrumental variable step for the method `who`; all columns are filtered by D/C, C (n + 1,)."""
    p = noise.order
    rows, Z, target = regressors(data, layout), regressors(instruments, layout), data.y[layout.first_row :]
    if p or C.size > 1:
        rows, Z, target = (lfilter(noise.D, C, x, axis=0)[p:] for x in (rows, Z, target))
    if C.size > 1:  # what the filter does not know of the time before the record fades with the plant's own poles
        free = _free(C, rows.shape[0])
        rows, Z, target = project_out(free, rows), project_out(free, Z), project_out(free, target[:, None])[:, 0]
    return solve(Z, rows, target, who=who)


def least_squares(who: str, data: Signals, layout: Layout) -> Array:
    """Return least-squares coefficients (n_coefficients + 1,): regressors as instruments; biased by coloured noise."""
    return instrumental_step(who, data, data, layout).theta


def optimal_step(
    who: str, data: Signals, instruments: Signals, layout: Layout, theta: Array, highest: int
) -> ArxEstimate:
    """Model the noise of the equation at the consistent `theta` (n_coefficients + 1,) and make the filtered, optimal
    step (Ljung 1999, eq. 15.25-15.29). The sharper noise model is taken of 1/D and C/D, C the stable counterpart of A
    (unstable poles mirrored): noise on a fast-sampled output has zeros next to the unit circle, which no moderate
    autoregression holds.
    """
    error = data.y[layout.first_row :] - regressors(data, layout) @ theta
    noise, C = autoregression(error, highest), _NO_AVERAGE
    mirrored = reflect(_polynomials(layout, theta).A, _INSIDE)
    outer = np.asarray(lfilter([1.0], mirrored, error))
    at_output = autoregression(project_out(_free(mirrored, outer.size), outer[:, None])[:, 0], highest)
    if _cost(at_output, error.size) < _cost(noise, error.size):
        noise, C = at_output, mirrored
    solution = instrumental_step(who, data, instruments, layout, noise, C)
    polynomials = replace(_polynomials(layout, solution.theta), C=C, D=noise.D)
    return ArxEstimate(layout=layout, polynomials=polynomials, noise=noise, solution=solution)


def iterate_optimal(
    who: str,
    data: Signals,
    instruments: Callable[[Array], Signals],
    layout: Layout,
    theta: Array,
    rounds: int,
) -> ArxEstimate:
    """Repeat `optimal_step`, at most `rounds` times, until noise model and estimate `theta` agree."""
    for _ in range(rounds):
        estimate = optimal_step(who, data, instruments(theta), layout, theta, layout.free.size + NOISE_ORDER)
        before, theta = theta, estimate.solution.theta
        moved = np.linalg.pinv(estimate.solution.inverse) @ (theta - before)
        if np.linalg.norm(moved) <= _SETTLED * np.linalg.norm(estimate.innovations):
            break
    return estimate


def _polynomials(layout: Layout, theta: Array) -> Polynomials:
    """A and B of a solution, whose last number is the constant."""
    full = layout.start()
    full[layout.free] = theta[:-1]
    return layout.polynomials(full)


def _free(C: Array, n: int) -> Array:
    """Free responses of 1/C, shape (n, order of C)."""
    return np.asarray(lfilter([1.0], C, np.eye(n, C.size - 1), axis=0))


def _cost(noise: Autoregression, n: int) -> float:
    return float(n * np.log(noise.variance + 1e-300) + 2 * noise.order)


def covariance(estimate: ArxEstimate) -> Array:
    """Return the covariance of all coefficients, leading ones and zeros included; C follows from A and has zeros. The
    filtered equation's noise is modelled once more: too low an order costs efficiency, but makes no deviations too
    small.
    """
    rows, layout, p = estimate.innovations.size, estimate.layout, estimate.polynomials
    left = autoregression(estimate.innovations, 10)
    spare = rows / max(rows - layout.free.size - 1, 1)
    first = layout.places["C", None].start + p.C.size
    d = slice(first, first + p.D.size)
    out = np.zeros((d.stop + len(p.F),) * 2)
    out[np.ix_(layout.free, layout.free)] = estimate.solution.covariance(left)[:-1, :-1] * spare
    out[d, d] = noise_covariance(estimate.noise, rows)
    return out


def operating_point(estimates: list[ArxEstimate], u_mean: Array, y_mean: Array, u_sd: Array, y_sd: Array) -> Offsets:
    """Share the equations' constants, A(1) y0 - B(1) u0, out over offsets of input and output in SI, each moved as
    little as possible; where A(1) is near zero (an integrating plant) the input takes it. `estimates`, one for each
    output, are of signals with the means off.
    """
    n_y = y_mean.size
    rows = np.zeros((n_y, n_y + u_mean.size))
    for o, f in enumerate(estimates):
        rows[o, o] = f.polynomials.A.sum() * y_sd[o]
        rows[o, n_y:] = -np.array([b.sum() for b in f.polynomials.B]) * u_sd
    move = np.linalg.lstsq(rows, np.array([f.solution.theta[-1] for f in estimates]), rcond=None)[0]
    return Offsets(u=u_mean + move[n_y:] * u_sd, y=y_mean + move[:n_y] * y_sd)


NOISE_ORDER = 20  # added to na + nb; Akaike's criterion chooses below it
_CORNERS = (np.inf, 0.5, 0.1, 0.02)  # of the filters of the first step, in radians a sample
_ROUGH = 3
_ROUNDING = 1e-11
_NOISE_ROUNDS = 30  # noise model and estimate in turn, at most


def estimate_output(who: str, signals: Signals, clean: Signals, layout: Layout) -> ArxEstimate:
    """Estimate one output by given instruments; `signals`, `clean`: as measured, and without what the noise does."""
    best, failed = list[ArxEstimate](), list[EstimationError]()
    for corner in _CORNERS if layout.na else _CORNERS[:1]:
        C = np.asarray(np.poly(np.full(layout.na, np.exp(-corner)))) if np.isfinite(corner) else _NO_AVERAGE
        try:
            theta = instrumental_step(who, signals, clean, layout, C=C).theta
            best.append(iterate_optimal(who, signals, lambda _: clean, layout, theta, _ROUGH))
        except EstimationError as error:
            failed.append(error)
    if not best:
        raise failed[-1]
    rough = min(best, key=lambda f: f.noise.variance)
    if is_exact(rough, signals):
        return rough
    return iterate_optimal(who, signals, lambda _: clean, layout, rough.solution.theta, _NOISE_ROUNDS)


def is_exact(estimate: ArxEstimate, signals: Signals) -> bool:
    """Return whether nothing but rounding is left, of which no noise model can be made."""
    return bool(np.linalg.norm(estimate.innovations) <= _ROUNDING * np.linalg.norm(signals.y))


_ROUNDS = 10  # of instruments from the model itself, at most
_INSTRUMENT_RADIUS = 0.999  # radius to which the poles of an unstable instrument are drawn


def iv4(data: IOData, orders: Orders) -> BlackBoxFit:
    """Estimate G = B/A by the four-step instrumental variable method, without feedback, every output by itself; past
    inputs are instruments. `orders`: ``na``; ``nb`` and ``nk`` (default 1), one or one for each input. The noise model
    is C/D with C 1, or the stable counterpart of A.
    """
    layout = arx_orders("iv4", data, orders)
    deviations, means, sds = centre(data)
    # what the inputs alone make of the outputs, by an autoregression of many lags
    u, names = deviations.u, deviations.inputs
    alone = replace(deviations, u=np.empty((u.shape[0], 0)), inputs=(), reference=u, references=names)
    try:
        explained: Array | None = reference_part("iv4", alone)[1]
    except EstimationError:  # none is stable
        explained = None
    estimates = [
        _one_output(Signals(y=y, u=u), layout, None if explained is None else explained[:, o])
        for o, y in enumerate(deviations.y.T)
    ]
    return arx_fit("iv4", data, estimates, means, sds)


def arx_orders(who: str, data: IOData, orders: Orders) -> Layout:
    """Check na, nb and nk, and that the record is long enough for them."""
    check_order_names(who, orders, ("na", "nb", "nk"), ("na", "nb"))
    n_u = data.n_inputs
    layout = arx_layout(
        single_order(who, orders, "na", 0),
        order_per_input(who, orders, "nb", 1, n_u),
        order_per_input(who, {"nk": 1, **orders}, "nk", 0, n_u),
    )
    check_length(who, data, data.n_samples - layout.first_row, layout.free.size + 1)
    return layout


def centre(data: IOData) -> tuple[IOData, tuple[Array, Array], tuple[Array, Array]]:
    """Return data with means off (for the numbers' sake; constants are estimated), means and standard deviations."""
    means = (data.u.mean(axis=0), data.y.mean(axis=0))
    sds = (data.u.std(axis=0), data.y.std(axis=0))
    reference = data.reference - data.reference.mean(axis=0)
    return replace(data, u=data.u - means[0], y=data.y - means[1], reference=reference), means, sds


def arx_fit(
    who: str,
    data: IOData,
    estimates: list[ArxEstimate],
    means: tuple[Array, Array],
    sds: tuple[Array, Array],
) -> BlackBoxFit:
    """Put the estimates of all outputs together, those of the data with the means off."""
    layout = estimates[0].layout
    rows = min(f.innovations.size for f in estimates)
    e = np.stack([f.innovations[-rows:] for f in estimates], axis=1)
    return build_fit(
        who,
        data,
        orders={"na": layout.na, "nb": layout.nb, "nk": layout.nk},
        model=PolynomialModel(outputs=tuple(f.polynomials for f in estimates), dt=data.dt),
        covariance=block_diag(*[covariance(f) for f in estimates]),
        n_estimated=sum(layout.free.size + f.noise.order for f in estimates),
        offsets=operating_point(estimates, *means, *sds),
        noise_covariance=e.T @ e / max(rows - layout.free.size - 1, 1),
        warnings=weak_instruments([f.solution for f in estimates], data.outputs),
        details={
            "noise_order": [f.noise.order for f in estimates],
            "condition": [f.solution.condition for f in estimates],
            "instrument_strength": [f.solution.strength() for f in estimates],
        },
    )


def _one_output(signals: Signals, layout: Layout, explained: Array | None) -> ArxEstimate:
    """Instruments from what the inputs explain of the output, then from the model itself, until it stands still."""

    def simulate(theta: Array) -> Signals:
        """Output of the model from the inputs alone; poles outside the unit circle are drawn inside."""
        p = _polynomials(layout, theta)
        A = reflect(p.A, _INSTRUMENT_RADIUS)
        return replace(signals, y=sum(lfilter(b, A, u) for b, u in zip(p.B, signals.u.T, strict=True)))

    clean = simulate(least_squares("iv4", signals, layout)) if explained is None else replace(signals, y=explained)
    estimate = estimate_output("iv4", signals, clean, layout)
    if is_exact(estimate, signals):
        return estimate
    return iterate_optimal("iv4", signals, simulate, layout, estimate.solution.theta, _ROUNDS)


def cliv(data: IOData, orders: Orders) -> BlackBoxFit:
    """Estimate as `iv4` does, of a plant in a loop, with instruments from a reference that the noise does not reach."""
    require_reference("cliv", data)
    layout = arx_orders("cliv", data, orders)
    deviations, means, sds = centre(data)
    clean_u, clean_y = reference_part("cliv", deviations)
    estimates = [
        estimate_output("cliv", Signals(y=y, u=deviations.u), Signals(y=clean, u=clean_u), layout)
        for y, clean in zip(deviations.y.T, clean_y.T, strict=True)
    ]
    return arx_fit("cliv", data, estimates, means, sds)
