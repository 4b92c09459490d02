"""Continuous-time transfer functions by refined instrumental variables: srivc without feedback, clsrivc in a loop.

srivc finds F, B_i in y = sum of B_i(s)/F(s) exp(-s delay_i) u_i + constant + free responses + noise from sampled data
directly. Each step solves Z' (e - Phi step) = 0 with all signals filtered by 1/F: Z from the simulated output, Phi from
the measured one (Young and Jakeman 1980; Young 2011, ch. 8). Where it settles, Z' e = 0: the output error is as small
as it can be. A step that makes the error larger is shortened, or replaced by one with Z for Phi (Gauss-Newton).

Filtering by 1/F fails for an unstable plant: clsrivc estimates the sampled equation with instruments from the reference
(cliv), and takes the continuous coefficients whose exact zero-order-hold equivalent is nearest in the metric of its
information (the problem of Gilson, Garnier, Young and Van den Hof 2008).

Time is measured in units of 1/w0 inside (p = s/w0), which keeps the coefficients of stiff plants near one. The filter
p^k/F(p) is state k of the companion form of F, exact for inputs held over a sample or straight between samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData, Orders, check_length, check_order_names, left_open, order_per_input
from ambid.blackbox.fit import BlackBoxFit, build_fit
from ambid.blackbox.instrumental import ArxEstimate, ArxOrders, Signals, centre, estimate_output, operating_point
from ambid.blackbox.instruments import (
    Autoregression,
    Solution,
    autoregression,
    reference_part,
    require_reference,
    score_covariance,
    solve,
    span,
    weak_instruments,
)
from ambid.blackbox.response import Numbers, Offsets, Responses, companion, filter_states, free_response, responses
from ambid.blackbox.transfer_model import ScaledTransfer, continuous_model
from ambid.errors import EstimationError
from ambid.estimation.linear import one_thread
from ambid.physics.discretise import zero_order_hold

WHITE = Autoregression(D=np.ones(1), variance=1.0)

_ROUGH, _FINE = 6, 60  # steps spent on a start, and on the best of them
_HALVINGS = 6
_SETTLED = 1e-6  # change of the output by a step, relative to the error
_NUMERIC = 5e-4  # the same, where rounding keeps the error from falling further
_AGREE = 1e-6  # relative difference in loss of two starts that found the same model
_EXACT = 1e-13  # error relative to the output that counts as none
_NOISE_ORDER = 20


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chain:
    """One denominator and the inputs that go through it, in p = s/w0."""

    inputs: tuple[int, ...]
    nb: tuple[int, ...]  # numerator coefficients, p^0 ... p^(nb - 1), for each of these inputs.
    den: Array  # (n + 1,), highest power first, monic
    num: Array  # (n_inputs, n + 1), highest power first

    @property
    def degree(self) -> int:
        """Degree of the denominator."""
        return self.den.size - 1

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return self.degree + sum(self.nb)

    @property
    def theta(self) -> Array:
        """Coefficients f_0 ... f_(n-1), then b_0 ... of each input."""
        by_input = (num[self.degree + 1 - nb :][::-1] for num, nb in zip(self.num, self.nb, strict=True))
        return np.concatenate([self.den[:0:-1], *by_input])

    def moved(self, change: Array) -> Chain:
        """Return the chain with its coefficients (f_0 ... f_(n-1), then b_0 ... of each input) changed.

        `change`: (size,).
        """
        n, den, num = self.degree, self.den.copy(), self.num.copy()
        den[:0:-1] += change[:n]
        first = n
        for i, nb in enumerate(self.nb):
            num[i, n + 1 - nb :] += change[first : first + nb][::-1]
            first += nb
        return replace(self, den=den, num=num)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Setting:
    """One output with the inputs, delays taken off."""

    y: Array  # (n_samples,)
    u: Array  # (n_samples, n_inputs)
    step: float  # sampling interval in units of 1/w0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearised:
    """Error, instruments and regressors about one set of coefficients, offsets and free responses taken off."""

    error: Array  # (n_samples,), filtered by the noise model
    Z: Array  # (n_samples, n_coefficients)
    Phi: Array
    output_error: Array  # (n_samples,), not filtered
    constant: float  # estimated offset of the output

    @property
    def loss(self) -> float:
        """Sum of squares of the error."""
        return float(self.error @ self.error)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Found:
    """Outcome of a search."""

    chains: tuple[Chain, ...]
    at: Linearised  # there
    noise: Autoregression  # by which the error is filtered
    settled: bool
    steps: int

    def solution(self) -> Solution:
        """Return the instrumental variable step at the end, from which the covariance follows."""
        return solve(self.at.Z, self.at.Phi, self.at.error, who="srivc")


def linearise(setting: Setting, chains: Sequence[Chain], noise: Autoregression = WHITE) -> Linearised:
    """Simulate, and set up one step."""
    made = [responses(c.den, c.num, setting.step, setting.u[:, c.inputs]) for c in chains]
    raw = setting.y - sum(m.y for m in made)
    nuisance = _nuisance(setting, chains)
    basis = span(nuisance)
    error = raw - basis @ (basis.T @ raw)
    size = np.linalg.norm(nuisance, axis=0)
    weights = np.linalg.lstsq(nuisance / size, raw, rcond=1e-8)[0] / size
    Z_parts, Phi_parts, first = list[Array](), list[Array](), 1
    for c, m in zip(chains, made, strict=True):
        free = nuisance[:, first : first + c.degree] @ weights[first : first + c.degree]
        first += c.degree
        Z_parts.append(_output_columns(c, m.of_output + filter_states(c.den, setting.step, free), m, setting.u))
        Phi_parts.append(_output_columns(c, filter_states(c.den, setting.step, m.y + free + error), m, setting.u))
    Z, Phi, constant = np.hstack(Z_parts), np.hstack(Phi_parts), float(weights[0])
    all_columns = np.column_stack([error, Z, Phi])
    if noise.order:
        from scipy.signal import lfilter

        p = noise.order
        all_columns = lfilter(noise.D, [1.0], all_columns, axis=0)[p:]
        basis = span(lfilter(noise.D, [1.0], nuisance, axis=0)[p:])
    clean = all_columns - basis @ (basis.T @ all_columns)
    n = Z.shape[1]
    return Linearised(
        error=clean[:, 0], Z=clean[:, 1 : n + 1], Phi=clean[:, n + 1 :], output_error=error, constant=constant
    )


def refine(setting: Setting, chains: Sequence[Chain], steps: int, noise: Autoregression = WHITE) -> Found:
    """Step until settled.

    `chains`: start, stable; `steps`: at most.
    """
    now, at = tuple(chains), linearise(setting, chains, noise)
    floor = (_EXACT * float(np.linalg.norm(setting.y))) ** 2
    for k in range(steps):
        if at.loss <= floor:
            return Found(chains=now, at=at, noise=noise, settled=True, steps=k)
        better = None
        for rows in (at.Phi, at.Z):
            change = solve(at.Z, rows, at.error, who="srivc").theta
            small = float(np.linalg.norm(at.Z @ change)) / np.sqrt(at.loss)
            if small <= _SETTLED:
                return Found(chains=now, at=at, noise=noise, settled=True, steps=k)
            better = _shorten(setting, now, at, change, noise)
            if better is not None:
                break
        if better is None:
            return Found(chains=now, at=at, noise=noise, settled=small <= _NUMERIC, steps=k)
        now, at = better
    return Found(chains=now, at=at, noise=noise, settled=False, steps=steps)


def search(
    y: Array, u: Array, dt: float, degrees: tuple[int, ...], nb: tuple[int, ...], *, common: bool, colour: bool
) -> tuple[Found, float]:
    """Start from several time scales and refine the best.

    `y`: (n_samples,); `u`: (n_samples, n_inputs), delays taken off; `degrees`: of the denominators: one for each input,
    or one where it is common; `nb`: numerator coefficients by input; `common`: whether all inputs share one
    denominator; `colour`: whether the noise is modelled and the data filtered by that model. Returns w0 in rad/s.
    """
    rough = []
    for w0 in _time_scales(y.size, dt):
        setting = Setting(y=y, u=u, step=w0 * dt)
        try:
            start = _start_chains(setting, degrees, nb, common=common)
            rough.append((refine(setting, start, _ROUGH), setting, w0))
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
    fine = [
        (found if found.settled else refine(setting, found.chains, _FINE), setting, w0)
        for found, setting, w0 in rough[:2]
    ]
    found, setting, w0 = min(fine, key=lambda r: r[0].at.loss)
    if colour:
        for _ in range(5):
            noise = autoregression(found.at.output_error, _NOISE_ORDER)
            if not noise.order:
                break
            before, found = found, refine(setting, found.chains, _FINE, noise)
            if np.allclose(_theta(before.chains), _theta(found.chains), rtol=1e-7, atol=0):
                break
    return found, w0


def _time_scales(n: int, dt: float) -> Array:
    """Corner frequencies of the start filters, from the record's length to half the sampling rate, middle first."""
    grid = np.geomspace(max(20.0 / (n * dt), 1e-4 / dt), 1.5 / dt, 9)
    return grid[[4, 6, 2, 5, 3, 7, 1, 8, 0]]


def _start_chains(
    setting: Setting, degrees: tuple[int, ...], nb: tuple[int, ...], *, common: bool
) -> tuple[Chain, ...]:
    """Least squares on signals through 1/(p + 1)^n (state variable filters), then each input by itself."""
    n, n_u = max(degrees), setting.u.shape[1]
    whole = _state_variable_filter(setting, n, nb if common else tuple(min(n + 1, max(nb)) for _ in nb))
    if common or n_u == 1:
        return (whole,)
    whole = refine(setting, (whole,), _ROUGH).chains[0]
    chains = []
    for i in range(n_u):
        part = responses(whole.den, whole.num[i : i + 1], setting.step, setting.u[:, i : i + 1]).y
        alone = Setting(y=part, u=setting.u[:, i : i + 1], step=setting.step)
        chain = refine(alone, (_state_variable_filter(alone, degrees[i], nb[i : i + 1]),), _ROUGH).chains[0]
        chains.append(replace(chain, inputs=(i,)))
    return tuple(chains)


def _state_variable_filter(setting: Setting, n: int, nb: tuple[int, ...]) -> Chain:
    smooth = np.asarray(np.poly(-np.ones(n)), dtype=np.float64)
    y, n_u = filter_states(smooth, setting.step, setting.y), setting.u.shape[1]
    r = responses(smooth, np.zeros((n_u, n + 1)), setting.step, setting.u)
    top = setting.y - y @ smooth[:0:-1]
    blank = Chain(inputs=tuple(range(n_u)), nb=nb, den=smooth, num=np.zeros((n_u, n + 1)))
    rows = _output_columns(blank, y, r, setting.u)
    nuisance = span(_nuisance(setting, (blank,)))
    rows, top = rows - nuisance @ (nuisance.T @ rows), top - nuisance @ (nuisance.T @ top)
    found = solve(rows, rows, top, who="srivc").theta
    change = found.copy()
    change[:n] -= smooth[:0:-1]
    return _mirror_poles(blank.moved(change))


def _output_columns(chain: Chain, of_y: Array, made: Responses, u: Array) -> Array:
    """Derivatives of the simulated output: -p^k/F y, then p^k/F u of each input."""
    n = chain.degree
    columns = [-of_y]
    for i, nb in enumerate(chain.nb):
        columns.append(made.of_inputs[:, i, : min(nb, n)])
        if nb == n + 1:  # p^n/F u = u - sum of f_k p^k/F u
            columns.append((u[:, chain.inputs[i]] - made.of_inputs[:, i] @ chain.den[:0:-1])[:, None])
    return np.hstack(columns)


def _nuisance(setting: Setting, chains: Sequence[Chain]) -> Array:
    n = setting.y.size
    return np.hstack([np.ones((n, 1)), *[free_response(c.den, setting.step, n) for c in chains]])


def _shorten(
    setting: Setting, now: tuple[Chain, ...], at: Linearised, change: Array, noise: Autoregression
) -> tuple[tuple[Chain, ...], Linearised] | None:
    """The longest of the step, its half, quarter ... that makes the error smaller; None if none does."""
    for k in range(_HALVINGS):
        moved, first = list[Chain](), 0
        for c in now:
            moved.append(_mirror_poles(c.moved(0.5**k * change[first : first + c.size])))
            first += c.size
        new = linearise(setting, moved, noise)
        if new.loss < at.loss:
            return tuple(moved), new
    return None


def _mirror_poles(chain: Chain) -> Chain:
    """Mirror poles of the right half plane: a simulated output must not run away. The error decides if it stays."""
    roots = np.roots(chain.den)
    if not np.all(np.isfinite(roots)) or np.max(roots.real) < 0:
        return chain
    roots = np.where(roots.real >= 0, -np.maximum(roots.real, 1e-9) + 1j * roots.imag, roots)
    return replace(chain, den=np.asarray(np.poly(roots).real, dtype=np.float64))


def _theta(chains: Sequence[Chain]) -> Array:
    return np.concatenate([c.theta for c in chains])


_DELAYS = tuple(range(6))  # scanned where nk is not given


@dataclass(frozen=True, slots=True, kw_only=True)
class TransferOrders:
    """Orders of a continuous-time transfer function."""

    nb: tuple[int, ...]  # numerator coefficients by input
    nf: tuple[int, ...]  # denominator degree by input
    nk: tuple[int, ...] | None  # delay in samples by input; None: to be scanned
    common: bool  # whether the inputs share one denominator

    @property
    def size(self) -> int:
        """Number of coefficients of one output."""
        return sum(self.nb) + (self.nf[0] if self.common else sum(self.nf))


def srivc(
    data: IOData,
    orders: Orders,
    *,
    noise: Literal["white", "coloured"] = "white",
    delays: Sequence[int] = _DELAYS,
) -> BlackBoxFit:
    """Estimate continuous-time transfer functions by refined instrumental variables; every output by itself.

    Parameters
    ----------
    data : IOData
        Without feedback; inputs held over a sample.
    orders : Mapping[str, int or tuple of int]
        ``nb``: numerator coefficients (1: a constant), one or one for each input. ``nf``: denominator degree; one
        number for a denominator that all inputs share, a tuple for one of each input's own. ``nk``: delay in samples,
        one or one for each input; left out: the one of `delays`, common to all inputs, that fits best.
    noise : {"white", "coloured"}, optional
        ``coloured`` also models the noise, as an autoregression of the sampled output error, and filters by it (RIVC):
        sharper where the noise is far from white.
    delays : sequence of int, optional
        Delays to scan where nk is left out, in samples.

    Returns
    -------
    BlackBoxFit
        TransferModel with ``dt`` None.

    Raises
    ------
    EstimationError
        If an order breaks a rule, the record is too short or does not excite the plant, or no stable model fits.
    """
    if noise not in ("white", "coloured"):
        raise EstimationError(f"srivc: noise {noise!r}; it must be 'white' or 'coloured'. Give one of them")
    used = transfer_orders("srivc", data, orders)
    deviations, means, _ = centre(data)
    settings = [used.nk] if used.nk is not None else [(int(k),) * data.n_inputs for k in delays]
    first = max(max(k) for k in settings)
    check_length("srivc", data, data.n_samples - first, used.size + 1)
    with one_thread():
        tried = [(_all_outputs(deviations, used, nk, first, colour=noise == "coloured"), nk) for nk in settings]
        found, nk = min(tried, key=lambda t: _loss(t[0], deviations))
        return _srivc_fit(data, used, nk, found, means)


def transfer_orders(who: str, data: IOData, orders: Orders) -> TransferOrders:
    """Check nb, nf and nk."""
    check_order_names(who, orders, ("nb", "nf", "nk"), ("nb", "nf"))
    n_u = data.n_inputs
    if not n_u:
        raise EstimationError(f"{who}: no input is named; it estimates the way from inputs to outputs. Give --input")
    nb, nf = order_per_input(who, orders, "nb", 1, n_u), order_per_input(who, orders, "nf", 1, n_u)
    for b, f in zip(nb, nf, strict=True):
        if b > f + 1:
            raise EstimationError(
                f"{who}: {b} numerator coefficients over a denominator of degree {f}; a plant that can be sampled has "
                f"at most {f + 1}. Lower nb, or raise nf"
            )
    nk = None if left_open(orders, "nk") else order_per_input(who, orders, "nk", 0, n_u)
    return TransferOrders(nb=nb, nf=nf, nk=nk, common=not isinstance(orders["nf"], tuple) or n_u == 1)


def _all_outputs(
    data: IOData, orders: TransferOrders, nk: tuple[int, ...], first: int, *, colour: bool
) -> list[tuple[Found, float]]:
    n = data.n_samples
    u = np.stack([data.u[first - k : n - k, i] for i, k in enumerate(nk)], axis=1)
    size = u.std(axis=0)
    out = []
    for o in range(data.n_outputs):
        y = data.y[first:, o]
        found, w0 = search(
            y / y.std(),
            u / size,
            data.dt,
            orders.nf[:1] if orders.common else orders.nf,
            orders.nb,
            common=orders.common,
            colour=colour,
        )
        out.append((found, w0))
    return out


def _loss(found: list[tuple[Found, float]], data: IOData) -> float:
    return float(sum(np.log(f.at.loss / data.n_samples + 1e-300) for f, _ in found))


def _srivc_fit(
    data: IOData,
    orders: TransferOrders,
    nk: tuple[int, ...],
    found: list[tuple[Found, float]],
    means: tuple[Array, ...],
) -> BlackBoxFit:
    rows = min(f.at.output_error.size for f, _ in found)
    y_size = data.y[-rows:].std(axis=0)
    first = data.n_samples - rows
    u_size = np.array([data.u[first - k : data.n_samples - k, i].std() for i, k in enumerate(nk)])
    scaled = []
    for (f, w0), size in zip(found, y_size, strict=True):
        error = f.at.error
        inner = f.solution().covariance(autoregression(error, _NOISE_ORDER))
        scaled.append(
            ScaledTransfer(
                theta=_theta(f.chains),
                covariance=error.size / max(error.size - orders.size - 1, 1) * inner,
                groups=tuple((c.degree, c.nb) for c in f.chains),
                w0=w0,
                gain=size / u_size,
            )
        )
    model, covariance = continuous_model(scaled, tuple(k * data.dt for k in nk))
    e = np.stack([f.at.output_error[-rows:] * s for (f, _), s in zip(found, y_size, strict=True)], axis=1)
    return build_fit(
        "srivc",
        data,
        orders={"nb": orders.nb, "nf": orders.nf[0] if orders.common else orders.nf, "nk": nk},
        model=model,
        covariance=covariance,
        n_estimated=data.n_outputs * orders.size,
        offsets=Offsets(u=means[0], y=means[1] + y_size * [f.at.constant for f, _ in found]),
        noise_covariance=e.T @ e / max(rows - orders.size - 1, 1),
        status="converged" if all(f.settled for f, _ in found) else "stalled",
        details={
            "condition": [f.solution().condition for f, _ in found],
            "steps": [f.steps for f, _ in found],
            "noise_order": [f.noise.order for f, _ in found],
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
    require_reference(who, data)
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
    check_length(who, data, data.n_samples - sampled.first, sampled.size + 1)
    deviations, means, sds = centre(data)
    with one_thread():
        clean = reference_part(who, deviations)
        found = list[ArxEstimate]()
        for o in range(data.n_outputs):
            own = Signals(y=deviations.y[:, o] / sds[1][o], u=deviations.u / sds[0])
            pure = Signals(y=clean.y[:, o] / sds[1][o], u=clean.u / sds[0])
            found.append(estimate_output("cliv", own, pure, sampled))
        w0 = [_time_scale(f.A, data.dt) for f in found]
        nearest = [_nearest(f, used, w * data.dt) for f, w in zip(found, w0, strict=True)]
    return _clsrivc_fit(data, used, found, nearest, w0, means, sds)


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


def _clsrivc_fit(
    data: IOData,
    orders: TransferOrders,
    found: list[ArxEstimate],
    nearest: list[_Continuous],
    w0: list[float],
    means: tuple[Array, Array],
    sds: tuple[Array, Array],
) -> BlackBoxFit:
    from scipy.stats import chi2

    n, nk = orders.nf[0], orders.nk or ()
    scaled, warnings = [], []
    for o, (c, w) in enumerate(zip(nearest, w0, strict=True)):
        half = np.linalg.pinv(c.root, rcond=1e-14)
        scaled.append(
            ScaledTransfer(
                theta=c.theta, covariance=half @ half.T, groups=((n, orders.nb),), w0=w, gain=sds[1][o] / sds[0]
            )
        )
        if c.freedom and chi2.sf(c.misfit, c.freedom) < _UNLIKELY:
            warnings.append(
                f"output {data.outputs[o]!r}: no continuous model of these orders has the sampled model that the data "
                f"show (misfit {c.misfit:.3g} for {c.freedom} degrees of freedom): check nb, nf and the delay nk, and "
                "that the input is held over a sample"
            )
    warnings += weak_instruments([f.solution for f in found], data.outputs)
    model, covariance = continuous_model(scaled, tuple(k * data.dt for k in nk))
    rows = min(f.innovations.size for f in found)
    e = np.stack([f.innovations[-rows:] for f in found], axis=1) * sds[1]
    one = np.ones(len(found))
    shift = operating_point(found, means[0] / sds[0], 0 * one, np.ones(data.n_inputs), one)
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
            "condition": [f.solution.condition for f in found],
            "noise_order": [f.noise.order for f in found],
            "instrument_strength": [f.solution.strength() for f in found],
            "misfit": [c.misfit for c in nearest],
            "freedom": [c.freedom for c in nearest],
        },
    )
