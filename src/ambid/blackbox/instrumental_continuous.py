"""Continuous-time transfer functions by refined instrumental variables: srivc without feedback, clsrivc in a loop.

srivc finds F, B_i in y = sum of B_i(s)/F(s) exp(-s delay_i) u_i + constant + free responses + noise from sampled data.
Each step solves Z' (e - Phi step) = 0, signals filtered by 1/F, Z from the simulated and Phi from the measured output
(Young and Jakeman 1980; Young 2011, ch. 8); where it settles, the output error is least. A step that enlarges the error
is shortened, or made with Z for Phi (Gauss-Newton). Filtering by 1/F fails for an unstable plant: clsrivc runs cliv,
and takes the continuous coefficients whose exact zero-order-hold equivalent is nearest in the metric of its information
(the problem of Gilson, Garnier, Young and Van den Hof 2008). Time inside is in units of 1/w0 (p = s/w0), and p^k/F(p)
is state k of F's companion form, exact for inputs held over a sample or straight between samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import (
    IOData,
    Orders,
    check_length,
    check_order_names,
    left_open,
    order_per_input,
    single_order,
)
from ambid.blackbox.fit import BlackBoxFit, build_fit
from ambid.blackbox.instrumental import (
    ArxEstimate,
    Signals,
    Solution,
    autoregression,
    centre,
    estimate_output,
    operating_point,
    reference_part,
    require_reference,
    score_covariance,
    solve,
    span,
    weak_instruments,
)
from ambid.blackbox.model import Offsets, TransferModel
from ambid.blackbox.polynomial_predictor import arx_layout
from ambid.blackbox.prediction import Numbers, Responses, companion, filter_states, free_response, responses
from ambid.errors import EstimationError
from ambid.estimation.linear import one_thread
from ambid.physics.linear_model import zero_order_hold
from ambid.settings.caller import setting

_ROUGH, _FINE = 6, 60  # steps spent on a start, and on the best of them
_HALVINGS = 6
_SETTLED = 1e-6  # change of the output by a step, relative to the error
_NUMERIC = 5e-4  # the same, where rounding keeps the error from falling further
_AGREE = 1e-6  # relative difference in loss of two starts that found the same model
_EXACT = 1e-13  # error relative to the output that counts as none
_NOISE_ORDER = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class TransferOrders:
    """Orders of B_i/F in p = s/w0; its coefficients are f_0 ... f_(n-1), then b_0 ... of each input."""

    nb: tuple[int, ...]  # numerator coefficients, p^0 ... p^(nb - 1), by input
    n: int  # degree of F, which all inputs share
    nk: tuple[int, ...] | None  # delay in samples by input; None: to be scanned

    @property
    def size(self) -> int:
        """Number of coefficients of one output."""
        return self.n + sum(self.nb)

    def split(self, theta: Array) -> tuple[Array, Array]:
        """Return F, (n + 1,), and the numerators, (n_inputs, n + 1), highest power first."""
        n, num = self.n, np.zeros((len(self.nb), self.n + 1))
        for i, b in enumerate(np.split(theta[n:], np.cumsum(self.nb)[:-1])):
            num[i, n + 1 - b.size :] = b[::-1]
        return np.append(1.0, theta[:n][::-1]), num


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Setting:
    """One output with the inputs, delays taken off, and what its coefficients are."""

    y: Array  # (n_samples,)
    u: Array  # (n_samples, n_inputs)
    step: float  # sampling interval in units of 1/w0
    orders: TransferOrders


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearised:
    """Error, instruments and regressors about one set of coefficients, offsets and free responses taken off."""

    error: Array  # (n_samples,)
    Z: Array  # (n_samples, n_coefficients)
    Phi: Array
    constant: float  # estimated offset of the output

    @property
    def loss(self) -> float:
        """Sum of squares of the error."""
        return float(self.error @ self.error)

    def solve(self, rows: Array | None = None) -> Solution:
        """Return the instrumental variable step, with `rows` in the place of the regressors."""
        return solve(self.Z, self.Phi if rows is None else rows, self.error, who="srivc")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Found:
    """Outcome of a search."""

    setting: Setting
    theta: Array  # (n_coefficients,)
    at: Linearised  # there
    settled: bool
    steps: int


def linearise(setting: Setting, theta: Array) -> Linearised:
    """Simulate, and set up one step."""
    den, num = setting.orders.split(theta)
    simulated = responses(den, num, setting.step, setting.u)
    raw, nuisance = setting.y - simulated.y, _nuisance(setting, den)
    basis = span(nuisance)
    error = raw - basis @ (basis.T @ raw)
    size = np.linalg.norm(nuisance, axis=0)
    weights = np.linalg.lstsq(nuisance / size, raw, rcond=1e-8)[0] / size
    free = nuisance[:, 1:] @ weights[1:]
    Z = _output_columns(setting, den, simulated.of_output + filter_states(den, setting.step, free), simulated)
    Phi = _output_columns(setting, den, filter_states(den, setting.step, simulated.y + free + error), simulated)
    both = np.hstack([Z, Phi])
    both -= basis @ (basis.T @ both)
    return Linearised(error=error, Z=both[:, : theta.size], Phi=both[:, theta.size :], constant=float(weights[0]))


def refine(setting: Setting, theta: Array, steps: int) -> Found:
    """Step from a stable `theta` until settled, at most `steps` times."""
    at = linearise(setting, theta)
    floor = (_EXACT * float(np.linalg.norm(setting.y))) ** 2
    for k in range(steps):
        if at.loss <= floor:
            return Found(setting=setting, theta=theta, at=at, settled=True, steps=k)
        better = None
        for rows in (at.Phi, at.Z):
            change = at.solve(rows).theta
            small = float(np.linalg.norm(at.Z @ change)) / np.sqrt(at.loss)
            if small <= _SETTLED:
                return Found(setting=setting, theta=theta, at=at, settled=True, steps=k)
            # the longest of the step, its half, quarter ... that makes the error smaller
            moved = (_mirror_poles(theta + 0.5**j * change, setting.orders.n) for j in range(_HALVINGS))
            trials = ((trial, linearise(setting, trial)) for trial in moved)
            better = next((trial for trial in trials if trial[1].loss < at.loss), None)
            if better is not None:
                break
        if better is None:
            return Found(setting=setting, theta=theta, at=at, settled=small <= _NUMERIC, steps=k)
        theta, at = better
    return Found(setting=setting, theta=theta, at=at, settled=False, steps=steps)


def search(y: Array, u: Array, dt: float, orders: TransferOrders) -> tuple[Found, float]:
    """Start from several time scales, refine the best, and return it with w0 in rad/s; `y`: (n_samples,); `u`:
    (n_samples, n_inputs), delays taken off.
    """
    rough = list[tuple[Found, float]]()
    # corner frequencies of the start filters, from the record's length to half the sampling rate, middle first
    grid = np.geomspace(max(20.0 / (y.size * dt), 1e-4 / dt), 1.5 / dt, 9)
    for w0 in grid[[4, 6, 2, 5, 3, 7, 1, 8, 0]]:
        setting = Setting(y=y, u=u, step=w0 * dt, orders=orders)
        try:
            rough.append((refine(setting, _start(setting), _ROUGH), w0))
        except (EstimationError, np.linalg.LinAlgError):
            continue
        rough.sort(key=lambda r: r[0].at.loss)
        if len(rough) > 1 and rough[1][0].at.loss <= rough[0][0].at.loss * (1 + _AGREE) + 1e-18 * y.size:
            break
    if not rough:
        raise EstimationError(
            "srivc: no stable continuous-time model fits this record. Check the orders and the sampling rate; for an "
            "unstable plant give the reference of its loop and use clsrivc"
        )
    fine = [(end if end.settled else refine(end.setting, end.theta, _FINE), w0) for end, w0 in rough[:2]]
    return min(fine, key=lambda r: r[0].at.loss)


def _start(setting: Setting) -> Array:
    """Least squares on signals through 1/(p + 1)^n (state variable filters)."""
    smooth = np.asarray(np.poly(-np.ones(setting.orders.n)), dtype=np.float64)
    y = filter_states(smooth, setting.step, setting.y)
    r = responses(smooth, np.zeros((setting.u.shape[1], smooth.size)), setting.step, setting.u)
    rows = np.column_stack([_output_columns(setting, smooth, y, r), setting.y - y @ smooth[:0:-1]])
    basis = span(_nuisance(setting, smooth))
    rows -= basis @ (basis.T @ rows)
    return _mirror_poles(solve(rows[:, :-1], rows[:, :-1], rows[:, -1], who="srivc").theta, setting.orders.n)


def _output_columns(setting: Setting, den: Array, of_y: Array, simulated: Responses) -> Array:
    """Derivatives of the simulated output: -p^k/F y, then p^k/F u of each input."""
    n, columns = setting.orders.n, [-of_y]
    for i, nb in enumerate(setting.orders.nb):
        columns.append(simulated.of_inputs[:, i, : min(nb, n)])
        if nb == n + 1:  # p^n/F u = u - sum of f_k p^k/F u
            columns.append((setting.u[:, i] - simulated.of_inputs[:, i] @ den[:0:-1])[:, None])
    return np.hstack(columns)


def _nuisance(setting: Setting, den: Array) -> Array:
    """A constant, and the free responses."""
    n = setting.y.size
    return np.hstack([np.ones((n, 1)), free_response(den, setting.step, n)])


def _mirror_poles(theta: Array, n: int) -> Array:
    """Mirror poles of the right half plane: a simulated output must not run away. The error decides if it stays."""
    roots = np.roots(np.append(1.0, theta[:n][::-1]))
    if not np.all(np.isfinite(roots)) or np.max(roots.real) < 0:
        return theta
    roots = np.where(roots.real >= 0, -np.maximum(roots.real, 1e-9) + 1j * roots.imag, roots)
    return np.concatenate([np.poly(roots).real[:0:-1], theta[n:]])


_DELAYS = tuple(range(6))  # scanned where nk is not given


def srivc(data: IOData, orders: Orders) -> BlackBoxFit:
    """Estimate continuous-time transfer functions without feedback, inputs held over a sample, every output by itself.
    `orders`: ``nb`` numerator coefficients (1: a constant) and ``nk`` samples of delay, one or one for each input,
    ``nf`` degree of the common denominator; without ``nk`` the common delay up to 5 that fits best is taken.
    """
    degrees = transfer_orders("srivc", data, orders)
    deviations, means, _ = centre(data)
    settings = [degrees.nk] if degrees.nk is not None else [(k,) * data.n_inputs for k in _DELAYS]
    first = max(max(k) for k in settings)
    check_length("srivc", data, data.n_samples - first, degrees.size + 1)
    with one_thread():
        tried = list[tuple[float, int, list[tuple[Found, float]]]]()
        for k, nk in enumerate(settings):
            u = np.stack([deviations.u[first - d : data.n_samples - d, i] for i, d in enumerate(nk)], axis=1)
            ends = [search(y / y.std(), u / u.std(axis=0), data.dt, degrees) for y in deviations.y[first:].T]
            tried.append((float(sum(np.log(f.at.loss / data.n_samples + 1e-300) for f, _ in ends)), k, ends))
        _, best, searches = min(tried, key=lambda t: t[:2])
        nk = settings[best]
        return _srivc_fit(data, degrees, nk, searches, means)


def transfer_orders(who: str, data: IOData, orders: Orders, more: int = 1) -> TransferOrders:
    """Check nb, nf and nk; `more`: numerator coefficients that there may be beyond nf."""
    check_order_names(who, orders, ("nb", "nf", "nk"), ("nb", "nf"))
    n_u = data.n_inputs
    if not n_u:
        raise EstimationError(
            f"{who}: no input was named; it estimates the path from inputs to outputs. Give {setting('input')}"
        )
    nb, n = order_per_input(who, orders, "nb", 1, n_u), single_order(who, orders, "nf", 1)
    if max(nb) > n + more:
        raise EstimationError(
            f"{who}: {max(nb)} numerator coefficients over a denominator of degree {n}; at most {n + more}. "
            "Lower nb, or raise nf"
        )
    nk = None if left_open(orders, "nk") else order_per_input(who, orders, "nk", 0, n_u)
    return TransferOrders(nb=nb, n=n, nk=nk)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScaledTransfer:
    """Transfer functions of one output in p = s/w0: f_0 ... f_(n-1), then b_0 ... of each input."""

    theta: Array  # (n_theta,)
    covariance: Array  # (n_theta, n_theta)
    orders: TransferOrders
    w0: float  # rad/s
    gain: Array  # (n_inputs,), SI unit of a numerator coefficient

    def in_s(self) -> tuple[list[Array], list[Array], Array]:
        """Return numerators and denominators by input in s and SI, and their derivative by `theta`."""
        n, unit, num, rows = self.orders.n, np.eye(self.theta.size), list[Array](), list[Array]()
        worth = self.w0 ** np.arange(n, -1, -1.0)  # of p^0 ... p^n
        by_den = np.vstack([np.zeros(self.theta.size), (unit[:n] * worth[:n, None])[::-1]])
        den = np.append(1.0, by_den[1:] @ self.theta)
        for gain, own in zip(self.gain, np.split(unit[n:], np.cumsum(self.orders.nb)[:-1]), strict=True):
            by_num = (own * (worth[: own.shape[0]] * gain)[:, None])[::-1]
            num.append(by_num @ self.theta)
            rows += [by_num, by_den]
        return num, [den] * len(num), np.vstack(rows)


def continuous_model(outputs: Sequence[ScaledTransfer], delay: tuple[float, ...]) -> tuple[TransferModel, Array]:
    """Return the continuous model of all outputs in SI, and the covariance of all its coefficients."""
    from scipy.linalg import block_diag

    entries = [one.in_s() for one in outputs]
    model = TransferModel(
        num=tuple(tuple(num) for num, _, _ in entries),
        den=tuple(tuple(den) for _, den, _ in entries),
        dt=None,
        delay=delay,
    )
    slopes = zip(outputs, entries, strict=True)
    return model, block_diag(*[slope @ one.covariance @ slope.T for one, (_, _, slope) in slopes])


def _srivc_fit(
    data: IOData,
    orders: TransferOrders,
    nk: tuple[int, ...],
    searches: list[tuple[Found, float]],
    means: tuple[Array, ...],
) -> BlackBoxFit:
    rows = searches[0][0].at.error.size
    y_size = data.y[-rows:].std(axis=0)
    first = data.n_samples - rows
    u_size = np.array([data.u[first - k : data.n_samples - k, i].std() for i, k in enumerate(nk)])
    scaled = []
    for (f, w0), size in zip(searches, y_size, strict=True):
        error = f.at.error
        inner = f.at.solve().covariance(autoregression(error, _NOISE_ORDER))
        scaled.append(
            ScaledTransfer(
                theta=f.theta,
                covariance=error.size / max(error.size - orders.size - 1, 1) * inner,
                orders=orders,
                w0=w0,
                gain=size / u_size,
            )
        )
    model, covariance = continuous_model(scaled, tuple(k * data.dt for k in nk))
    e = np.stack([f.at.error * s for (f, _), s in zip(searches, y_size, strict=True)], axis=1)
    return build_fit(
        "srivc",
        data,
        orders={"nb": orders.nb, "nf": orders.n, "nk": nk},
        model=model,
        covariance=covariance,
        n_estimated=data.n_outputs * orders.size,
        offsets=Offsets(u=means[0], y=means[1] + y_size * [f.at.constant for f, _ in searches]),
        noise_covariance=e.T @ e / max(rows - orders.size - 1, 1),
        status="converged" if all(f.settled for f, _ in searches) else "stalled",
        details={
            "condition": [f.at.solve().condition for f, _ in searches],
            "steps": [f.steps for f, _ in searches],
        },
    )


_UNLIKELY = 1e-4  # probability under which the sampled estimate is not that of the continuous structure
_TINY = 1e-20  # complex step


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Continuous:
    """Coefficients in p = s w0 of one output."""

    theta: Array  # (size,), f_0 ... f_(n-1), then b_0 ... of each input.
    root: Array  # (n_rows, size), square root of the information of `theta`
    misfit: float  # squared distance from the sampled estimate, in standard deviations
    freedom: int  # of the misfit
    settled: bool


def clsrivc(data: IOData, orders: Orders) -> BlackBoxFit:
    """Estimate continuous-time transfer functions of a plant in a loop, inputs held over a sample, every output by
    itself, from a reference that the noise does not reach; `orders`: as `srivc`, ``nk`` 0 where it is left out.
    """
    who = "clsrivc"
    require_reference(who, data)
    degrees = transfer_orders(who, data, {"nk": 0, **orders})
    n, nk = degrees.n, degrees.nk or ()
    through = [b == n + 1 for b in degrees.nb]
    sampled = arx_layout(n, tuple(n + t for t in through), tuple(k + (not t) for k, t in zip(nk, through, strict=True)))
    check_length(who, data, data.n_samples - sampled.first_row, sampled.free.size + 1)
    deviations, means, sds = centre(data)
    with one_thread():
        clean_u, clean_y = reference_part(who, deviations)
        estimates = list[ArxEstimate]()
        for o in range(data.n_outputs):
            own = Signals(y=deviations.y[:, o] / sds[1][o], u=deviations.u / sds[0])
            pure = Signals(y=clean_y[:, o] / sds[1][o], u=clean_u / sds[0])
            estimates.append(estimate_output("cliv", own, pure, sampled))
        w0 = [_time_scale(f.polynomials.A, data.dt) for f in estimates]
        nearest = [_nearest(f, degrees, w * data.dt) for f, w in zip(estimates, w0, strict=True)]
    return _clsrivc_fit(data, degrees, estimates, nearest, w0, means, sds)


def sampled_coefficients(theta: Numbers, n: int, nb: tuple[int, ...], step: float) -> Numbers:
    """Return the zero-order-hold equivalent of B_i(p)/F(p), F of degree `n`: a_1 ... a_n, then the numerator of every
    input (n, or n + 1 with feedthrough). `theta`, real or complex: f_0 ... f_(n-1), b_0 ... of each input; `step` in
    1/w0.
    """
    den = np.concatenate([[1.0], theta[:n][::-1]])
    E, first_state = zero_order_hold(companion(den), np.eye(n)[:, -1:], step)
    a = _characteristic(E)
    states = [first_state[:, 0]]
    for _ in range(n - 1):
        states.append(E @ states[-1])
    out, first = [a[1:]], n
    for b in nb:
        num = np.zeros(n + 1, dtype=theta.dtype)
        num[:b] = theta[first : first + b]
        first += b
        row = num[:n] - num[n] * theta[:n]
        response = np.concatenate([num[n:], [row @ x for x in states]])  # impulse response, feedthrough first
        full = np.convolve(a, response)[: n + 1]
        out.append(full if b == n + 1 else full[1:])
    return np.concatenate(out)


def _characteristic(A: Numbers) -> Numbers:
    """Characteristic polynomial by matrix products alone (Faddeev and LeVerrier), so that complex steps pass."""
    n = A.shape[0]
    out, M = [np.ones((), dtype=A.dtype)], np.eye(n, dtype=A.dtype)
    for k in range(1, n + 1):
        AM = A @ M
        c = -np.trace(AM) / k
        out.append(c)
        M = AM + c * np.eye(n, dtype=A.dtype)
    return np.array(out)


def _time_scale(A: Array, dt: float) -> float:
    """Geometric mean of the pole frequencies that the sampled denominator shows, in rad/s."""
    rates = np.abs(_logarithms(A)) / dt
    return float(np.exp(np.mean(np.log(np.clip(rates, 1e-3 / dt, 3.0 / dt)))))


def _logarithms(A: Array) -> NDArray[np.complex128]:
    z = np.roots(A).astype(np.complex128)
    z = np.where((z.imag == 0) & (z.real <= 1e-8), np.maximum(np.abs(z), 1e-3), z)  # no continuous pole lies there
    return np.asarray(np.log(z))


def _nearest(estimate: ArxEstimate, orders: TransferOrders, step: float) -> _Continuous:
    """Continuous coefficients nearest to a sampled estimate in the metric of its information."""
    from scipy.linalg import solve_triangular
    from scipy.optimize import least_squares

    n, nb = orders.n, orders.nb
    # square root of the information of a_1 ..., b ..., the constant eliminated, and the estimate itself

    s = estimate.solution
    spread = np.linalg.cholesky(score_covariance(s.Q, autoregression(estimate.innovations, 10)))
    whole = solve_triangular(spread, np.linalg.inv(s.inverse), lower=True)
    R = np.asarray(np.linalg.qr(whole[:, [-1, *range(whole.shape[1] - 1)]], mode="r"))
    root, eta = R[1:, 1:], s.theta[:-1]

    def error(theta: Array) -> Array:
        return np.asarray(root @ (sampled_coefficients(theta, n, nb, step) - eta))

    def slope(theta: Array) -> Array:
        columns = []
        for k in range(theta.size):
            moved = theta.astype(np.complex128)
            moved[k] += 1j * _TINY
            columns.append(sampled_coefficients(moved, n, nb, step).imag / _TINY)
        return np.asarray(root @ np.stack(columns, axis=1))

    poles = _logarithms(estimate.polynomials.A) / step
    f = np.asarray(np.poly(poles).real, dtype=np.float64)[:0:-1]
    start = np.concatenate([f, np.zeros(sum(nb))])
    rows = slope(start)[:, n:]  # the numerators enter linearly
    start[n:] = np.linalg.lstsq(rows, -error(start), rcond=None)[0]
    done = least_squares(error, start, jac=slope, method="lm", x_scale="jac", ftol=1e-13, xtol=1e-13, gtol=1e-13)
    return _Continuous(
        theta=done.x,
        root=slope(done.x),
        misfit=2 * float(done.cost),
        freedom=root.shape[1] - start.size,
        settled=done.status > 0,
    )


def _clsrivc_fit(
    data: IOData,
    orders: TransferOrders,
    estimates: list[ArxEstimate],
    nearest: list[_Continuous],
    w0: list[float],
    means: tuple[Array, Array],
    sds: tuple[Array, Array],
) -> BlackBoxFit:
    from scipy.stats import chi2

    n, nk = orders.n, orders.nk or ()
    scaled, warnings = [], []
    for o, (c, w) in enumerate(zip(nearest, w0, strict=True)):
        half = np.linalg.pinv(c.root, rcond=1e-14)
        scaled.append(
            ScaledTransfer(theta=c.theta, covariance=half @ half.T, orders=orders, w0=w, gain=sds[1][o] / sds[0])
        )
        if c.freedom and chi2.sf(c.misfit, c.freedom) < _UNLIKELY:
            warnings.append(
                f"output {data.outputs[o]!r}: no continuous model of these orders matches the sampled model of the "
                f"data (chi-square {c.misfit:.3g} with {c.freedom} degrees of freedom): check nb, nf and the delay "
                "nk, and that the input is held over a sample"
            )
    warnings += weak_instruments([f.solution for f in estimates], data.outputs)
    model, covariance = continuous_model(scaled, tuple(k * data.dt for k in nk))
    rows = min(f.innovations.size for f in estimates)
    e = np.stack([f.innovations[-rows:] for f in estimates], axis=1) * sds[1]
    one = np.ones(len(estimates))
    shift = operating_point(estimates, means[0] / sds[0], 0 * one, np.ones(data.n_inputs), one)
    return build_fit(
        "clsrivc",
        data,
        orders={"nb": orders.nb, "nf": n, "nk": nk},
        model=model,
        covariance=covariance,
        n_estimated=data.n_outputs * orders.size,
        offsets=Offsets(u=shift.u * sds[0], y=means[1] + shift.y * sds[1]),
        noise_covariance=e.T @ e / max(rows - orders.size - 1, 1),
        status="converged" if all(c.settled for c in nearest) else "stalled",
        warnings=warnings,
        details={
            "condition": [f.solution.condition for f in estimates],
            "noise_order": [f.noise.order for f in estimates],
            "instrument_strength": [f.solution.strength() for f in estimates],
            "misfit": [c.misfit for c in nearest],
            "freedom": [c.freedom for c in nearest],
        },
    )
