"""Continuous-time transfer functions of a plant in a loop, by instrumental variables.

cliv is run, and the continuous coefficients are taken whose exact zero-order-hold equivalent is nearest in the metric
of its information (the problem of Gilson, Garnier, Young and Van den Hof 2008). Time inside is in units of 1/w0 (p =
s/w0), and p^k/F(p) is state k of F's companion form, exact for inputs held over a sample.
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
    order_per_input,
    single_order,
)
from ambid.blackbox.fit import BlackBoxFit, build_fit
from ambid.blackbox.instrumental import (
    ArxEstimate,
    Signals,
    autoregression,
    centre,
    estimate_output,
    operating_point,
    reference_part,
    require_reference,
    score_covariance,
    weak_instruments,
)
from ambid.blackbox.model import Offsets, TransferModel
from ambid.blackbox.polynomial_predictor import arx_layout
from ambid.blackbox.prediction import Numbers, companion
from ambid.errors import EstimationError
from ambid.estimation.linear import one_thread
from ambid.physics.linear_model import zero_order_hold
from ambid.settings.caller import setting


@dataclass(frozen=True, slots=True, kw_only=True)
class TransferOrders:
    """Orders of B_i/F in p = s/w0; its coefficients are f_0 ... f_(n-1), then b_0 ... of each input."""

    nb: tuple[int, ...]  # numerator coefficients, p^0 ... p^(nb - 1), by input
    n: int  # degree of F, which all inputs share
    nk: tuple[int, ...]  # delay in samples by input

    @property
    def size(self) -> int:
        """Number of coefficients of one output."""
        return self.n + sum(self.nb)


def transfer_orders(who: str, data: IOData, orders: Orders) -> TransferOrders:
    """Check nb, nf and nk."""
    check_order_names(who, orders, ("nb", "nf", "nk"), ("nb", "nf"))
    n_u = data.n_inputs
    if not n_u:
        raise EstimationError(
            f"{who}: no input was named; it estimates the path from inputs to outputs. Give {setting('input')}"
        )
    nb, n = order_per_input(who, orders, "nb", 1, n_u), single_order(who, orders, "nf", 1)
    if max(nb) > n + 1:
        raise EstimationError(
            f"{who}: {max(nb)} numerator coefficients over a denominator of degree {n}; at most {n + 1}. "
            "Lower nb, or raise nf"
        )
    return TransferOrders(nb=nb, n=n, nk=order_per_input(who, {"nk": 0, **orders}, "nk", 0, n_u))


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
    itself, from a reference that the noise does not reach. `orders`: ``nb`` numerator coefficients (1: a constant) and
    ``nk`` samples of delay (default 0), one or one for each input, ``nf`` degree of the common denominator.
    """
    who = "clsrivc"
    require_reference(who, data)
    degrees = transfer_orders(who, data, orders)
    n, nk = degrees.n, degrees.nk
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

    n, nk = orders.n, orders.nk
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
