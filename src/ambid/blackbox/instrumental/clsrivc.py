"""Continuous-time transfer functions of a plant in a loop, stable or not, with instruments from the reference.

Solves: B(s)/F(s) of any relative degree from a closed-loop record with its reference (the problem of Gilson, Garnier,
Young and Van den Hof 2008). Filtering by 1/F fails for an unstable plant; instead the sampled equation is estimated
with instruments from the reference (cliv), and the continuous coefficients are those whose exact zero-order-hold
equivalent is nearest in the metric of its information. As sharp as a direct search, and nothing is simulated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.instrumental.arx_form import ArxEstimate, ArxOrders, Signals, operating_point
from ambid.blackbox.instrumental.cliv import in_loop
from ambid.blackbox.instrumental.continuous import Numbers, companion
from ambid.blackbox.instrumental.iv4 import centred
from ambid.blackbox.instrumental.noise import autoregression, score_covariance
from ambid.blackbox.instrumental.reference import reference_part, wants_reference
from ambid.blackbox.instrumental.solve import weak
from ambid.blackbox.instrumental.srivc import TransferOrders, transfer_orders
from ambid.blackbox.made import made
from ambid.blackbox.orders import Orders, long_enough
from ambid.blackbox.response import Offsets
from ambid.blackbox.transfer_model import TransferModel
from ambid.errors import EstimationError
from ambid.estimation.threads import one_thread
from ambid.physics.discretise import zero_order_hold

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
    """Estimate continuous-time transfer functions of a plant in a loop; every output by itself.

    Parameters
    ----------
    data : IOData
        With a reference that the noise does not reach; inputs held over a sample.
    orders : Mapping[str, int or tuple of int]
        ``nb``: numerator coefficients (1: a constant), one or one for each input. ``nf``: degree of the denominator,
        which all inputs share. ``nk`` (default 0): delay in samples, one or one for each input.

    Returns
    -------
    BlackBoxFit
        TransferModel with ``dt`` None.

    Raises
    ------
    EstimationError
        If there is no reference, an order breaks a rule, or the record is too short or does not excite the plant.
    """
    who = "clsrivc"
    wants_reference(who, data)
    used = transfer_orders(who, data, {"nk": 0, **orders})
    if len(set(used.nf)) > 1 or not used.common:
        raise EstimationError(
            f"{who}: order nf = {used.nf}; the inputs share one denominator here. Give nf as one number"
        )
    n, nk = used.nf[0], used.nk or ()
    through = [b == n + 1 for b in used.nb]
    sampled = ArxOrders(
        na=n,
        nb=tuple(n + t for t in through),
        nk=tuple(k + (not t) for k, t in zip(nk, through, strict=True)),
    )
    long_enough(who, data, data.n_samples - sampled.first, sampled.size + 1)
    deviations, means, sds = centred(data)
    with one_thread():
        clean = reference_part(who, deviations)
        found = list[ArxEstimate]()
        for o in range(data.n_outputs):
            own = Signals(y=deviations.y[:, o] / sds[1][o], u=deviations.u / sds[0])
            pure = Signals(y=clean.y[:, o] / sds[1][o], u=clean.u / sds[0])
            found.append(in_loop(own, pure, sampled))
        w0 = [_time_scale(f.A, data.dt) for f in found]
        nearest = [_nearest(f, used, w * data.dt) for f, w in zip(found, w0, strict=True)]
    return _fit(data, used, found, nearest, w0, means, sds)


def sampled_coefficients(theta: Numbers, n: int, nb: tuple[int, ...], step: float) -> Numbers:
    """Return the zero-order-hold equivalent of B_i(p)/F(p): a_1 ... a_n, then the numerator of every input.

    `theta`: (n + sum(nb), ), real or complex, f_0 ... f_(n-1), then b_0 ... of each input; `n`: degree of F; `step`:
    sampling interval in units of 1/w0. Returns (n + n of each input (one more with feedthrough), ).
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


def _nearest(found: ArxEstimate, orders: TransferOrders, step: float) -> _Continuous:
    """Continuous coefficients nearest to a sampled estimate in the metric of its information."""
    from scipy.optimize import least_squares

    n, nb = orders.nf[0], orders.nb
    root, eta = _information(found)

    def error(theta: Array) -> Array:
        return np.asarray(root @ (sampled_coefficients(theta, n, nb, step) - eta))

    def slope(theta: Array) -> Array:
        columns = []
        for k in range(theta.size):
            moved = theta.astype(np.complex128)
            moved[k] += 1j * _TINY
            columns.append(sampled_coefficients(moved, n, nb, step).imag / _TINY)
        return np.asarray(root @ np.stack(columns, axis=1))

    poles = _logarithms(found.A) / step
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


def _information(found: ArxEstimate) -> tuple[Array, Array]:
    """Square root of the information of a_1 ..., b ..., the constant eliminated, and the estimate itself."""
    from scipy.linalg import solve_triangular

    s = found.solution
    spread = np.linalg.cholesky(score_covariance(s.Q, autoregression(found.innovations, 10)))
    whole = solve_triangular(spread, np.linalg.inv(s.inverse), lower=True)
    R = np.asarray(np.linalg.qr(whole[:, [-1, *range(whole.shape[1] - 1)]], mode="r"))
    return R[1:, 1:], s.theta[:-1]


def _fit(
    data: IOData,
    orders: TransferOrders,
    found: list[ArxEstimate],
    nearest: list[_Continuous],
    w0: list[float],
    means: tuple[Array, Array],
    sds: tuple[Array, Array],
) -> BlackBoxFit:
    from scipy.linalg import block_diag
    from scipy.stats import chi2

    n, nk = orders.nf[0], orders.nk or ()
    num, den, blocks, warnings = [], [], [], []
    for o, (c, w) in enumerate(zip(nearest, w0, strict=True)):
        row_num, row_den, J = _coefficients(c.theta, orders, w, sds[1][o] / sds[0])
        num.append(row_num)
        den.append(row_den)
        half = J @ np.linalg.pinv(c.root, rcond=1e-14)
        blocks.append(half @ half.T)
        if c.freedom and chi2.sf(c.misfit, c.freedom) < _UNLIKELY:
            warnings.append(
                f"output {data.outputs[o]!r}: no continuous model of these orders has the sampled model that the data "
                f"show (misfit {c.misfit:.3g} for {c.freedom} degrees of freedom): check nb, nf and the delay nk, and "
                "that the input is held over a sample"
            )
    warnings += weak([f.solution for f in found], data.outputs)
    rows = min(f.innovations.size for f in found)
    e = np.stack([f.innovations[-rows:] for f in found], axis=1) * sds[1]
    scaled = operating_point(
        found, means[0] / sds[0], np.zeros(len(found)), np.ones(data.n_inputs), np.ones(len(found))
    )
    return made(
        "clsrivc",
        data,
        orders={"nb": orders.nb, "nf": n, "nk": nk},
        model=TransferModel(num=tuple(num), den=tuple(den), dt=None, delay=tuple(k * data.dt for k in nk)),
        covariance=block_diag(*blocks),
        n_estimated=data.n_outputs * orders.size,
        offsets=Offsets(u=scaled.u * sds[0], y=means[1] + scaled.y * sds[1]),
        noise_covariance=e.T @ e / max(rows - orders.size - 1, 1),
        status="converged" if all(c.settled for c in nearest) else "stalled",
        warnings=warnings,
        details={
            "condition": [f.solution.condition for f in found],
            "noise_order": [f.noise.order for f in found],
            "instrument_strength": [f.solution.strength() for f in found],
            "misfit": [c.misfit for c in nearest],
            "freedom": [c.freedom for c in nearest],
        },
    )


def _coefficients(
    theta: Array, orders: TransferOrders, w0: float, gain: Array
) -> tuple[tuple[Array, ...], tuple[Array, ...], Array]:
    """Numerators and denominators by input in s and SI, and the derivative of all their coefficients by `theta`."""
    n = orders.nf[0]
    powers = w0 ** np.arange(n, -1, -1.0)  # of f_0 ... f_n
    f_rows = np.zeros((n + 1, theta.size))
    f_rows[1:, :n] = np.diag(powers[:n])[::-1]
    den = np.concatenate([[1.0], (theta[:n] * powers[:n])[::-1]])
    num, rows, first = [], [], n
    for i, b in enumerate(orders.nb):
        b_rows = np.zeros((b, theta.size))
        b_rows[:, first : first + b] = np.diag(powers[:b] * gain[i])[::-1]
        num.append((theta[first : first + b] * powers[:b] * gain[i])[::-1])
        rows += [b_rows, f_rows]
        first += b
    return tuple(num), (den,) * len(orders.nb), np.vstack(rows)
